"""`mocap models`: list of keypoint detectors, and download of their files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from mocap_cli.options import any_path, json_option
from mocap_cli.terminal import print_json, print_table, say, say_next

if TYPE_CHECKING:
    from pipelines.session.registries import Detector


@click.group("models", invoke_without_command=True, short_help="List and fetch keypoint detectors.")
@json_option
@click.pass_context
def models_command(context: click.Context, as_json: bool) -> None:
    """List the keypoint detectors and whether their files are here; `fetch` gets those that are missing.

    MPJPE is that of the sample flight with true poses. ms is processor time for one person in one picture,
    on one thread of a machine with other work. The same machine takes about half of it when idle
    (docs/results.md).
    """
    if context.invoked_subcommand is None:
        _list(as_json)


def _list(as_json: bool) -> None:
    from pipelines.session.registries import DETECTORS, DetectorFamily

    registered = DETECTORS.all()
    families = [d for d in registered if isinstance(d, DetectorFamily)]
    detectors = [d for d in registered if not isinstance(d, DetectorFamily)]
    if as_json:
        print_json(
            {
                "detectors": [_listed(d) for d in detectors],
                "families": [{"name": f.name, "title": f.title, "usage": f.usage} for f in families],
            }
        )
        return
    print_table(
        ("detector", "MPJPE mm", "ms", "file", "where"),
        [
            (d.name, *_figures(d).values(), file, path or "missing")
            for d in detectors
            for file, path in d.models().items()
        ],
    )
    for detector in detectors:
        if None in detector.models().values():
            say(f"Get what is missing with `mocap models fetch {detector.name}`.")
    for family in families:
        first, *more = family.usage.splitlines()
        say()
        say(f"{family.title}: --detector {first}")
        for line in more:
            say(f"  {line}")
    say_next("mocap reconstruct SESSION --detector {}", detectors[0].name, quiet=False)


@models_command.command("fetch")
@click.argument("name", metavar="DETECTOR")
@click.option(
    "--from",
    "source",
    type=any_path,
    help="Take the files from here instead of the network: the package that ships them, or a folder.",
)
@json_option
def fetch_command(name: str, source: Path | None, as_json: bool) -> None:
    """Get the model files of a detector."""
    from pipelines.session.registries import find_detector

    detector = find_detector(name)
    detector.fetch(source)
    if as_json:
        print_json(_listed(detector))
        return
    for path in detector.models().values():
        say(f"ready: {path}")
    say_next("mocap reconstruct SESSION --detector {}", name, quiet=False)


def _listed(detector: Detector) -> dict[str, object]:
    files = {file: None if path is None else str(path) for file, path in detector.models().items()}
    return {"name": detector.name, "title": detector.title, **_figures(detector), "files": files}


def _figures(detector: Detector) -> dict[str, float | None]:
    """Return the accuracy and the time of a detector; None if they were not measured."""
    from pipelines.session.registries import MeasuredDetector

    measured = detector.measured if isinstance(detector, MeasuredDetector) else None
    return {
        "sample_mpjpe_mm": None if measured is None else measured.sample_mpjpe_mm,
        "person_ms": None if measured is None else measured.person_ms,
    }
