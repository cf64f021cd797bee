"""`mocap ingest`: the flight of a flight.yaml read into a session."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mocap_cli.options import FiniteRange, Shown, any_place, force_option, output_options, overwrite_option
from mocap_cli.several import each
from mocap_cli.terminal import one_line, print_table, say, say_next, say_warnings, watching

if TYPE_CHECKING:
    from pipelines.ingest import Ingested


@click.command("ingest", short_help="Read a flight into a session.")
@each("flight", "FLIGHT.yaml", suffix=".session")
@click.option(
    "-o",
    "--output",
    type=any_place,
    help="Session folder, or of several flights the folder around them [default: the manifest's name with"
    " .session].",
)
@click.option(
    "--max-pose-gap",
    type=FiniteRange(0, 1e6, min_open=True),
    default=0.5,
    show_default=True,
    metavar="SECONDS",
    help="Longest time between two logged poses across which a frame gets a pose.",
)
@click.option(
    "--max-extrapolation",
    type=FiniteRange(0, 1e6),
    default=0.1,
    show_default=True,
    metavar="SECONDS",
    help="Longest time before the first or after the last logged pose at which a frame gets a pose.",
)
@click.option("--strict", is_flag=True, help="Refuse a flight of which anything is lost, damaged or doubted.")
@overwrite_option
@force_option
@output_options
def ingest_command(
    flight: Path,
    output: Path | None,
    max_pose_gap: float,
    max_extrapolation: float,
    strict: bool,
    overwrite: bool,
    force: bool,
    shown: Shown,
) -> dict[str, Any] | None:
    """Read logs, keypoints, calibration and truth of each flight into a session."""
    from pipelines.ingest import ingest

    with watching(shown.level) as progress:
        result = ingest(
            flight,
            output,
            max_pose_gap_s=max_pose_gap,
            max_extrapolation_s=max_extrapolation,
            strict=strict,
            overwrite=overwrite,
            force=force,
            progress=progress,
        )
    say_warnings(result.description.warnings, shown.quiet)
    if shown.as_json:
        return result.description.model_dump(mode="json", by_alias=True)
    if not shown.quiet:
        _print(result)
        _print_stamps(result)
        _print_origin(result)
    say(f"{'unchanged' if result.skipped else 'written'}: {result.folder}")
    say_next("mocap reconstruct {}", result.folder, shown.quiet)
    return None


def _print_stamps(result: Ingested) -> None:
    for stamps in ("header", "receive"):
        names = [name for name, c in result.description.cameras.items() if c.poses.stamps == stamps]
        if names:
            say(f"poses are timed by the {stamps} stamps of their logs: {', '.join(names)}")


def _print_origin(result: Ingested) -> None:
    if origin := result.description.origin:
        say(
            f"world origin: {origin.latitude_deg:.7f}, {origin.longitude_deg:.7f}, {origin.altitude_m:.2f} m"
            f" ({one_line(origin.source)})"
        )


def _print(result: Ingested) -> None:
    description = result.description
    span = [
        min(camera.frames.first_t_ns for camera in description.cameras.values()),
        max(camera.frames.last_t_ns for camera in description.cameras.values()),
    ]
    say(f"{one_line(description.flight)}: {(span[1] - span[0]) / 1e9:.2f} s")
    print_table(
        ("camera", "picture", "frames", "Hz", "poses", "Hz", "no pose", "gaps", "keypoints", "people"),
        [
            (
                name,
                f"{camera.intrinsics.width}x{camera.intrinsics.height}",
                camera.frames.count,
                camera.frames.rate_hz,
                "still" if camera.poses.static else camera.poses.count,
                camera.poses.rate_hz,
                camera.poses.frames_without_pose,
                len(camera.poses.gaps_ns),
                camera.keypoints.format if camera.keypoints else None,
                camera.keypoints.people_at_once if camera.keypoints else None,
            )
            for name, camera in description.cameras.items()
        ],
    )
