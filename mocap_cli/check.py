"""`mocap check`: whether a flight's description, logs and pictures fit together."""

from pathlib import Path
from typing import Any

import click

from mocap_cli.options import Shown, cores_option, output_options
from mocap_cli.several import each
from mocap_cli.terminal import say, say_next, say_warnings, watching
from pipelines.session.errors import DataError


@click.command("check", short_help="Find mistakes in a flight.yaml and show the line to change.")
@each("path", "FLIGHT.yaml|SESSION")
@click.option(
    "--pose-noise", metavar="MODEL", help="As of `mocap reconstruct`: what is known of the poses' errors."
)
@click.option("--detector", default="blazepose", show_default=True, help="See `mocap models`.")
@click.option("--strict", is_flag=True, help="Exit 1 if there is a doubt.")
@click.option("--fix", is_flag=True, help="Write the remedies that were tried into flight.yaml.")
@cores_option
@output_options
def check_command(
    path: Path, pose_noise: str | None, detector: str, strict: bool, fix: bool, workers: int, shown: Shown
) -> dict[str, Any] | None:
    """Find mistakes in a flight.yaml and show the line to change.

    Cameras, clocks, poses and people are compared with each other. Each mistake that flight.yaml can hold is
    undone in turn, and the one that explains what is odd is named (docs/mistakes.md). `mocap reconstruct`
    does the same. Of a flight without keypoints, the detector looks at a few seconds.
    """
    from pipelines import check

    with watching(shown.level) as progress:
        options: dict[str, Any] = {"pose_noise": pose_noise, "detector": detector, "workers": workers}
        options["progress"] = progress
        result, changes = check.fix(path, **options) if fix else (check.check(path, **options), [])
    say_warnings(result.warnings, shown.quiet)
    if strict and result.doubts:
        first = result.doubts[0]
        raise DataError(path, f"is doubted: {first.what} ({first.code})", first.remedy, code="doubted")
    if shown.as_json:
        found = {"path": str(path), "doubts": [doubt.as_json() for doubt in result.doubts]}
        return found | ({"changes": changes} if fix else {})
    for line in changes:
        say(line)
    for doubt in result.doubts:
        say(f"{doubt.code}: {doubt.what}")
        numbers = {name: value for name, value in doubt.evidence.items() if not isinstance(value, dict)}
        say("  " + ", ".join(f"{name} {value:g}" for name, value in numbers.items()))
        for line in doubt.instructions:
            say(f"  {line}")
    if not result.doubts:
        looked = f" (looked at: {result.pictures})" if result.pictures else ""
        say(f"{path}: no doubt{looked}")
    follows = "mocap ingest {}"
    if result.doubts and not fix:
        can_mend = any(doubt.instructions for doubt in result.doubts)
        follows = (
            "mocap check --fix {}" if can_mend else "correct what docs/mistakes.md names, then mocap check {}"
        )
    say_next(follows if path.suffix in {".yaml", ".yml"} else "mocap reconstruct {}", path, shown.quiet)
    return None
