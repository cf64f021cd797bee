"""`mocap reconstruct`: the actor's skeleton with its errors."""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mocap_cli.options import (
    FiniteRange,
    Shown,
    any_path,
    cores_option,
    force_option,
    grouped,
    output_options,
    pictures_option,
    scheduler_option,
)
from mocap_cli.several import each
from mocap_cli.terminal import print_table, say, say_next, say_warnings, watching

if TYPE_CHECKING:
    from mocap_cli.options import ChosenPictures
    from pipelines.reconstruct import Reconstructed, ReconstructSettings


# Further reasons stand in metrics.json, and as warnings.
_MAX_REASONS = 3


class People(click.ParamType["int | str"]):
    """A number of people, or `auto`."""

    name = "people"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int | str:
        """Convert the value, or raise a usage error."""
        if value == "auto":
            return "auto"
        if not str(value).isdecimal() or not 1 <= int(value) <= 20:
            self.fail(f"{value!r} is neither auto nor a number from 1 to 20.", param, ctx)
        return int(value)


def _settings(pictures: ChosenPictures, smooth: str | None, **others: Any) -> ReconstructSettings:
    from pipelines.reconstruct import ReconstructSettings

    fill = re.fullmatch(r"\s*fill:max_s=([0-9.eE-]+)\s*(?:\+(.*))?", smooth or "")
    fill_s = None
    if fill is not None:
        try:
            fill_s, smooth = float(fill[1]), fill[2]
        except ValueError:
            raise click.BadParameter(f"{fill[1]!r} is no number", param_hint="--smooth") from None
    return ReconstructSettings(**vars(pictures), fill_s=fill_s, smooth=smooth, **others)


_settings_options = grouped(
    "settings",
    _settings,
    click.option(
        "--method",
        type=click.Choice(["auto", "refined", "robust", "midpoint", "dlt"]),
        default="auto",
        show_default=True,
        help="auto: the best estimate that the flight allows, from backgrounds, keypoints, motion, bones,"
        " poses and clocks together. The others are parts of it, for comparison. refined: without"
        " backgrounds; robust: outlier views rejected, then least squares on the reprojection; midpoint: the"
        " point closest to the rays; dlt: linear triangulation.",
    ),
    click.option(
        "--rate",
        "rate_hz",
        type=FiniteRange(0, 10_000, min_open=True),
        metavar="HZ",
        help="Rate of the skeleton [default: the frames of the camera with the most].",
    ),
    click.option(
        "--persons",
        "people",
        type=People(),
        metavar="N|auto",
        help="Number of people to reconstruct. auto: those who were logged, and everybody else whom two"
        " cameras see for a second, on the ground, of a person's size [default: auto if flight.yaml has"
        " `actors:`, else 1].",
    ),
    click.option(
        "--pose-noise",
        metavar="MODEL",
        help="Known errors of the camera poses, instead of those that flight.yaml states; for example"
        ' "white:position_m=0.3,rotation_deg=1 + drift:position_m_per_sqrt_s=0.05".',
    ),
    click.option(
        "--disturb-poses",
        metavar='"MODEL [xN] [seed=N]"',
        help="Add errors to every logged pose, to measure their effect. The methods do not know them;"
        ' --pose-noise states them. "white:position_m=0.3 x20 seed=3" makes 20 draws: metrics.json has the'
        " figures of each, their mean, spread and interval; the skeleton is that of the first.",
    ),
    click.option(
        "--smooth",
        metavar="FILTER",
        help='"butterworth:cutoff_hz=6,order=4" (forwards and backwards, no lag), never across gaps.'
        ' "fill:max_s=0.2", alone or before it as in "fill:max_s=0.2 + butterworth", interpolates a joint'
        " across gaps of at most this length; its status there is `filled`.",
    ),
    click.option(
        "--detector",
        default="blazepose",
        show_default=True,
        help="Detector for cameras with pictures and without keypoints (see `mocap models`).",
    ),
    pictures_option,
)


@click.command("reconstruct", short_help="Detect, triangulate, measure the errors.")
@each("session", "SESSION", ".session")
@click.option(
    "-o",
    "--output",
    type=any_path,
    metavar="FOLDER",
    help="Work on a copy of the session there [default: in the session]; videos stay where they are.",
)
@_settings_options
@cores_option
@scheduler_option("Give the pictures, and a long flight, to the Dask cluster there, in parts.")
@force_option
@output_options
def reconstruct_command(
    session: Path,
    output: Path | None,
    settings: ReconstructSettings,
    workers: int,
    scheduler: str | None,
    force: bool,
    shown: Shown,
) -> dict[str, Any] | None:
    """Find the actor's joints in the pictures, triangulate them, and measure the errors."""
    from pipelines.reconstruct import reconstruct
    from pipelines.session.parallel import connected
    from pipelines.session.stages import copy_session, refuse_no_session

    refuse_no_session(session)
    if output is not None:
        copy_session(session, output)
        session = output
    with watching(shown.level) as progress, ExitStack() as stack:
        client = stack.enter_context(connected(scheduler, progress)) if scheduler else None
        result = reconstruct(
            session,
            settings,
            workers=workers,
            executor=client and client.get_executor(pure=False),
            force=force,
            progress=progress,
        )
    say_warnings(result.record.warnings, shown.quiet)
    if shown.as_json:
        return result.metrics
    if not shown.quiet:
        _print(result, every_joint=shown.verbose)
    say(f"{'unchanged' if result.skipped else 'written'}: {result.folder / 'reconstruct'}")
    if not shown.quiet:
        print_verdict(result.metrics["verdict"], result.folder)
    return None


def print_verdict(verdict: dict[str, Any], session: Path, flight: Path | None = None) -> None:
    """Print how good the result is without truth, what holds it back, and the next command.

    Args:
        verdict: of metrics.json.
        session: the session.
        flight: its manifest, if the page is written, so that the next command is another one.
    """
    expected = verdict["expected_error_mm"]
    error = "nothing was measured"
    if expected is not None:
        low, median, high = expected
        would = "without these doubts the error would be" if verdict["grade"] == "wrong" else "the error is"
        error = f"{would} about {median:.0f} mm, in 4 of 5 flights {low:.0f} to {high:.0f} mm"
    say(f"{verdict['grade']}: {error}")
    for reason in verdict["why"][:_MAX_REASONS]:
        say(f"  {reason}")
    follows = verdict["next"]
    if flight is None or "SESSION" in follows:
        follows = follows.replace("SESSION", "{}") if flight is None else "mocap export {} --to trc,angles"
        say_next(follows, session, quiet=False)
    else:
        say_next(follows.replace("flight.yaml", "{}"), flight, quiet=False)


def _print(result: Reconstructed, *, every_joint: bool) -> None:
    metrics: dict[str, Any] = result.metrics
    counts = metrics["status_counts"]
    filled = f", {counts['filled']} filled" if counts.get("filled") else ""
    say(f"{metrics['method']}: {counts['ok']} of {counts['all']} joint-frames reconstructed{filled}")
    if metrics["method"] == "auto" or metrics["method_used"]["clocks"]:
        say(metrics["method_used"]["summary"])
    if metrics.get("smoothing"):
        done = metrics["smoothing"]
        say(f"smoothed: {done['filter']}, cutoff {done['cutoff_hz']:.2g} Hz")
    _print_summary(metrics)
    if every_joint:
        say()
        _print_joints(result)


_ERRORS = {
    "mpjpe_mm": ("MPJPE mm", 1),
    "root_mpjpe_mm": ("root-relative MPJPE mm", 1),
    "pa_mpjpe_mm": ("PA-MPJPE mm", 1),
    "pck150": ("PCK@150 mm %", 100),
    "pck150_auc": ("its AUC %", 100),
    "acceleration_error_mm_s2": ("acceleration error mm/s2", 1),
}


def _print_summary(metrics: dict[str, Any]) -> None:
    reprojection, shape = metrics["reprojection_px"], metrics["shape"]
    shown = {"reconstructed_share": ("reconstructed %", 100)}
    if metrics["mpjpe_mm"] is not None:
        shown |= _ERRORS
    rows = [
        [title, _times(metrics[name], scale), _ends(metrics["intervals"][name], scale)]
        for name, (title, scale) in shown.items()
    ]
    trials = metrics.get("trials")
    header = ["figure", "value", "95 % interval"]
    if trials is not None:
        header += [f"mean of {trials['count']} trials", "std"]
        for row, (name, (_, scale)) in zip(rows, shown.items(), strict=True):
            row += [_times(trials["mean"][name], scale), _times(trials["std"][name], scale)]
    rows += [
        [title, value, interval, None, None][: len(header)]
        for title, value, interval in [
            (
                "reprojection px, mean",
                reprojection["mean"],
                _ends(metrics["intervals"]["reprojection_px_mean"]),
            ),
            ("reprojection px, median", reprojection["median"], None),
            ("leave-one-camera-out px, median", _mean_median(metrics["leave_one_camera_out_px"]), None),
            ("bone length spread mm", shape["bone_spread_mm"], None),
            ("left/right asymmetry mm", _mean(shape["asymmetry_mm"].values()), None),
            ("jerk m/s3, median", shape["jerk_m_s3"], None),
        ]
    ]
    print_table(header, rows)


def _times(value: float | None, scale: int) -> float | None:
    return None if value is None else scale * value


def _ends(interval: list[float] | None, scale: int = 1) -> str:
    return "" if interval is None else f"{scale * interval[0]:.1f} .. {scale * interval[1]:.1f}"


def _mean_median(figures: dict[str, Any] | None) -> float | None:
    """Compute the mean of the cameras' medians; None without figures (fewer than three cameras)."""
    return None if figures is None else _mean(figure["median"] for figure in figures.values())


def _mean(values: Iterable[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return sum(there) / len(there) if there else None


def _print_joints(result: Reconstructed) -> None:
    from pipelines.session.tables import JOINT_ERRORS, figures_by_joint, read_table

    metrics = result.metrics
    per_joint = figures_by_joint(
        read_table(result.folder / "reconstruct" / "joint_errors.parquet", JOINT_ERRORS)
    )
    overall = metrics | {"reprojection_px_median": metrics["reprojection_px"]["median"]}
    has_truth = metrics["mpjpe_mm"] is not None
    header = ["joint", "ok %", "reproj px"] + (["MPJPE mm", "root mm", "PA mm"] if has_truth else [])
    rows = []
    for name, joint in [*per_joint.items(), ("all", overall)]:
        row = [name, 100 * joint["reconstructed_share"], joint["reprojection_px_median"]]
        if has_truth:
            row += [joint.get("mpjpe_mm"), joint.get("root_mpjpe_mm"), joint.get("pa_mpjpe_mm")]
        rows.append(row)
    print_table(header, rows)
