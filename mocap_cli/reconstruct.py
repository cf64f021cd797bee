"""`mocap reconstruct`: the actor's skeleton with its errors."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mocap_cli.options import (
    FiniteRange,
    Shown,
    every_option,
    force_option,
    grouped,
    output_options,
    provider_option,
    scheduler_option,
    seed_option,
    with_provider,
)
from mocap_cli.several import each
from mocap_cli.terminal import print_table, say, say_warnings, watching

if TYPE_CHECKING:
    from pipelines.reconstruct import Reconstructed, Settings


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


def _settings(
    start_s: float | None, end_s: float | None, detector: str, provider: str | None, **others: Any
) -> Settings:
    from pipelines.reconstruct import Settings

    if start_s is not None and end_s is not None and start_s >= end_s:
        raise click.BadParameter(f"{end_s:g} is not after --start {start_s:g}", param_hint="--end")
    return Settings(detector=with_provider(detector, provider), start_s=start_s, end_s=end_s, **others)


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
        "--min-confidence",
        type=FiniteRange(0, 1),
        default=0.3,
        show_default=True,
        help="Keypoints below this are not used.",
    ),
    click.option(
        "--pixel-noise",
        "pixel_sigma",
        type=FiniteRange(0.01, 10_000),
        default=3.0,
        show_default=True,
        metavar="PX",
        help="Standard deviation of a good keypoint; raised where views disagree by more.",
    ),
    click.option(
        "--pose-noise",
        metavar="MODEL",
        help="What is known of the camera poses' errors, instead of what flight.yaml says; for example"
        ' "white:position_m=0.3,rotation_deg=1 + drift:position_m_per_sqrt_s=0.05".',
    ),
    click.option(
        "--refine-cameras",
        type=click.Choice(["background"]),
        help="Correct the poses of moving cameras by the background of their pictures before triangulation."
        " auto does it unasked.",
    ),
    click.option(
        "--disturb-poses",
        metavar="MODEL",
        help="Add such errors to every logged pose, to measure their effect. The methods do not know them;"
        " --pose-noise states them.",
    ),
    click.option(
        "--trials",
        type=click.IntRange(1, 1000),
        default=1,
        show_default=True,
        metavar="N",
        help="Draws of --disturb-poses. metrics.json has the figures of each, their mean, spread and"
        " interval; the skeleton is that of the first.",
    ),
    seed_option("Seed of --disturb-poses."),
    click.option(
        "--fill",
        "fill_s",
        type=FiniteRange(0, min_open=True),
        metavar="SECONDS",
        help="Interpolate a joint across gaps of at most this length; its status there is `filled`. Without"
        " this, gaps stay open.",
    ),
    click.option(
        "--smooth",
        metavar="FILTER",
        help='"butterworth:cutoff_hz=6,order=4" (forwards and backwards, no lag) or "rts" (Kalman smoother'
        ' that weighs covariances; "rts:model=jerk"). Never across gaps.',
    ),
    click.option(
        "--detector",
        default="blazepose",
        show_default=True,
        help="Detector for cameras with pictures and without keypoints (see `mocap models`).",
    ),
    provider_option,
    every_option,
    click.option(
        "--start",
        "start_s",
        type=FiniteRange(0, 1e9),
        metavar="SECONDS",
        help="First time at which the detector looks at pictures, since the flight's first picture.",
    ),
    click.option(
        "--end",
        "end_s",
        type=FiniteRange(0, 1e9),
        metavar="SECONDS",
        help="Time from which it looks at no pictures, counted alike.",
    ),
)


class _Reconstruct(click.Command):
    """Command whose `--overlay` needs no value, also right before a session."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments, with `skeleton` after a bare --overlay."""
        end = args.index("--") if "--" in args else len(args)
        for k in range(end - 1, -1, -1):
            if args[k] == "--overlay" and (k + 1 == end or not args[k + 1].startswith("angle:")):
                args = [*args[:k], "--overlay=skeleton", *args[k + 1 :]]
        return super().parse_args(ctx, args)


class Shows(click.ParamType[str]):
    """Content of an overlay: `skeleton`, or `angle:` and an angle."""

    name = "overlay"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the full name of an angle, or an empty text for the skeleton; or raise a usage error."""
        from pipelines.overlay import angle_named

        if value in ("", "skeleton"):
            return ""
        kind, _, name = str(value).partition(":")
        try:
            return angle_named(name if kind == "angle" else str(value))
        except ValueError as error:
            self.fail(f"{error}.", param, ctx)


@click.command("reconstruct", cls=_Reconstruct, short_help="Detect, triangulate, measure the errors.")
@each("session", "SESSION")
@_settings_options
@click.option(
    "--overlay",
    "overlays",
    type=Shows(),
    multiple=True,
    metavar="[angle:NAME]",
    help="Draw the skeleton over every picture: SESSION/overlay/CAMERA.mp4. angle:left_knee writes that joint"
    " angle beside it, with its standard deviation; repeat it for several.",
)
@click.option(
    "--workers",
    type=click.IntRange(1, 256),
    default=lambda: os.cpu_count() or 1,
    show_default="all cores",
    help="Threads, or processes for the segments of a long flight; the result does not depend on them.",
)
@scheduler_option("Give the pictures, and a long flight, to the Dask cluster there, in parts.")
@click.option("--strict", is_flag=True, help="Refuse a flight with a doubt (see `mocap check`).")
@force_option
@output_options
def reconstruct_command(
    session: Path,
    settings: Settings,
    overlays: tuple[str, ...],
    strict: bool,
    workers: int,
    scheduler: str | None,
    force: bool,
    shown: Shown,
) -> dict[str, Any] | None:
    """Find the actor's joints in the pictures, triangulate them, and measure the errors."""
    from pipelines.overlay import refuse_overlays, write_overlays
    from pipelines.precompile import precompile_for
    from pipelines.reconstruct import reconstruct
    from pipelines.session.clusters import Cluster, connected
    from pipelines.session.stages import open_session

    if overlays:
        refuse_overlays(session, force=force)
    open_session(session)  # a wrong session is refused before anything is compiled
    with watching(shown.level) as progress, ExitStack() as stack:
        cluster = Cluster.of(stack.enter_context(connected(scheduler))) if scheduler else None
        precompile_for("reconstruct", progress)
        result = reconstruct(
            session,
            settings,
            strict=strict,
            workers=workers,
            cluster=cluster,
            force=force,
            progress=progress,
        )
        angles = list(dict.fromkeys(filter(None, overlays)))
        videos = (
            write_overlays(session, angles=angles, workers=workers, force=force, progress=progress)
            if overlays
            else []
        )
    say_warnings(result.record.warnings, shown.quiet)
    if shown.as_json:
        return result.metrics
    if not shown.quiet:
        _print(result, every_joint=shown.verbose > 0)
    say(f"{'unchanged' if result.skipped else 'written'}: {result.folder / 'reconstruct'}")
    for video in videos:
        say(f"written: {video}")
    return None


def _print(result: Reconstructed, *, every_joint: bool) -> None:
    metrics: dict[str, Any] = result.metrics
    counts = metrics["status_counts"]
    filled = f", {counts['filled']} filled" if counts.get("filled") else ""
    say(f"{metrics['method']}: {counts['ok']} of {counts['all']} joint-frames reconstructed{filled}")
    if metrics["method"] == "auto" or metrics["method_used"]["clocks"]:
        say(metrics["method_used"]["summary"])
    if metrics.get("smoothing"):
        done = metrics["smoothing"]
        cutoff = done["cutoff_hz"]
        say(f"smoothed: {done['filter']}" + (f", cutoff {cutoff:.2g} Hz" if cutoff else ""))
    _print_summary(metrics)
    if every_joint:
        say()
        _print_joints(metrics)


_ERRORS = {
    "mpjpe_mm": ("MPJPE mm", 1),
    "root_mpjpe_mm": ("root-relative MPJPE mm", 1),
    "pa_mpjpe_mm": ("PA-MPJPE mm", 1),
    "pck150": ("PCK@150 mm %", 100),
    "pck150_auc": ("its AUC %", 100),
    "acceleration_error_mm_s2": ("acceleration error mm/s2", 1),
}


def _print_summary(metrics: dict[str, Any]) -> None:
    """Print the main figures: errors against the truth if there is one, and figures without truth."""
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


def _print_joints(metrics: dict[str, Any]) -> None:
    has_truth = metrics["mpjpe_mm"] is not None
    header = ["joint", "ok %", "reproj px"] + (["MPJPE mm", "root mm", "PA mm"] if has_truth else [])
    rows = []
    for name, joint in [*metrics["per_joint"].items(), ("all", metrics)]:
        row = [name, 100 * joint["reconstructed_share"], joint["reprojection_px"]["median"]]
        if has_truth:
            row += [joint.get("mpjpe_mm"), joint.get("root_mpjpe_mm"), joint.get("pa_mpjpe_mm")]
        rows.append(row)
    print_table(header, rows)
