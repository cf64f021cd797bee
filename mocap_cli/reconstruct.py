"""`mocap reconstruct`: the skeleton of the actor, joint by joint, with its errors."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from mocap_cli.options import (
    FiniteRange,
    force_option,
    json_option,
    level,
    session_argument,
    verbosity_options,
)
from mocap_cli.terminal import print_json, print_table, say_warnings, watching

if TYPE_CHECKING:
    from pipelines.geometry.triangulation import Method
    from pipelines.reconstruct import Reconstructed


@click.command("reconstruct", short_help="Detect, triangulate, measure the errors.")
@session_argument
@click.option(
    "--method",
    type=click.Choice(["dlt", "midpoint", "robust", "refined"]),
    default="robust",
    show_default=True,
    help="dlt: linear triangulation; midpoint: the point closest to the rays; robust: outlier views"
    " rejected, then least squares on the reprojection; refined: robust, then skeleton, camera poses and"
    " clocks estimated together.",
)
@click.option(
    "--rate",
    type=FiniteRange(0, 10_000, min_open=True),
    metavar="HZ",
    help="Rate of the skeleton [default: the frames of the camera with the most].",
)
@click.option("--persons", type=click.IntRange(1, 20), default=1, show_default=True, help="How many people.")
@click.option(
    "--min-confidence",
    type=FiniteRange(0, 1),
    default=0.3,
    show_default=True,
    help="Keypoints below this are not used.",
)
@click.option(
    "--pixel-noise",
    type=FiniteRange(0.01, 10_000),
    default=3.0,
    show_default=True,
    metavar="PX",
    help="Standard deviation of a good keypoint; more is found from the data.",
)
@click.option(
    "--pose-noise",
    metavar="MODEL",
    help="What is known of the camera poses' errors, instead of what flight.yaml says; for example"
    ' "white:position_m=0.3,rotation_deg=1 + drift:position_m_per_sqrt_s=0.05".',
)
@click.option(
    "--detector",
    default="blazepose",
    show_default=True,
    help="Runs on the pictures of cameras that came without keypoints (see `mocap models`).",
)
@click.option(
    "--every",
    type=click.IntRange(1, 1000),
    default=1,
    show_default=True,
    metavar="N",
    help="Let the detector look at every N-th picture only.",
)
@click.option(
    "--start",
    type=FiniteRange(0, 1e9),
    metavar="SECONDS",
    help="Let the detector look at pictures from then on, since the flight's first.",
)
@click.option("--end", type=FiniteRange(0, 1e9), metavar="SECONDS", help="And at pictures before then only.")
@click.option(
    "--overlay",
    is_flag=True,
    help="Draw the skeleton over every picture: SESSION/overlay/CAMERA.mp4.",
)
@click.option(
    "--workers",
    type=click.IntRange(1, 256),
    default=lambda: os.cpu_count() or 1,
    show_default="all cores",
    help="Threads; the result does not depend on them.",
)
@force_option
@json_option
@verbosity_options
def reconstruct_command(
    session: Path,
    method: Method | Literal["refined"],
    rate: float | None,
    persons: int,
    min_confidence: float,
    pixel_noise: float,
    pose_noise: str | None,
    detector: str,
    every: int,
    start: float | None,
    end: float | None,
    overlay: bool,
    workers: int,
    force: bool,
    as_json: bool,
    quiet: bool,
    verbose: int,
) -> None:
    """Find the actor's joints in the pictures, triangulate them, and measure the errors."""
    from pipelines.overlay import write_overlays
    from pipelines.reconstruct import Settings, reconstruct

    if start is not None and end is not None and start >= end:
        raise click.BadParameter(f"{end:g} is not after --start {start:g}", param_hint="--end")
    settings = Settings(
        method=method,
        rate_hz=rate,
        people=persons,
        min_confidence=min_confidence,
        pixel_sigma=pixel_noise,
        pose_noise=pose_noise,
        detector=detector,
        every=every,
        start_s=start,
        end_s=end,
    )
    with watching(level(quiet, verbose)) as progress:
        result = reconstruct(session, settings, workers=workers, force=force, progress=progress)
        videos = (
            write_overlays(session, workers=workers, overwrite=force, progress=progress) if overlay else []
        )
    say_warnings(result.record.warnings, quiet)
    if as_json:
        print_json(result.metrics)
        return
    if not quiet:
        _print(result)
    click.echo(f"{'unchanged' if result.skipped else 'written'}: {result.folder / 'reconstruct'}")
    for video in videos:
        click.echo(f"written: {video}")


def _print(result: Reconstructed) -> None:
    metrics: dict[str, Any] = result.metrics
    click.echo(
        f"{metrics['method']}: {metrics['status_counts']['ok']} of {metrics['status_counts']['all']}"
        f" joint-frames reconstructed"
    )
    has_truth = metrics["mpjpe_mm"] is not None
    header = ["joint", "ok %", "reproj px"] + (["MPJPE mm", "root mm", "PA mm"] if has_truth else [])
    rows = []
    for name, joint in [*metrics["per_joint"].items(), ("all", metrics)]:
        row = [name, 100 * joint["reconstructed_share"], joint["reprojection_px"]["median"]]
        if has_truth:
            row += [joint.get("mpjpe_mm"), joint.get("root_mpjpe_mm"), joint.get("pa_mpjpe_mm")]
        rows.append(row)
    print_table(header, rows)
