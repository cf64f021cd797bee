"""`mocap info`: the content of a file or folder."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from mocap_cli.options import json_option
from mocap_cli.several import each
from mocap_cli.terminal import one_line, say, say_next

# Longer lists are cut, so that each stays on a line or two.
_MAX_LISTED = 12
# Numbers from here on are written with all digits before the point: stamps and counts.
_LARGE = 1e6

_NEXT = {
    "session": "mocap report {}",
    "simulated flight": "mocap run {}",
    "flight manifest": "mocap check {}",
    "scenario": "mocap simulate {} -o FOLDER",
    "planner settings": "mocap replan-compare SESSION --config {}",
    "study, simulated": "mocap report SESSION --study {}",
}
"""The next command after a look at something that is no file of a flight, by its kind."""


@click.command("info", short_help="Print the content of a file or session.")
@each("path", "PATH", titled=False)
@json_option
def info_command(path: Path, as_json: bool) -> dict[str, Any] | None:
    """Print the content of a path: anything that mocap reads, and what it writes.

    Logs, videos, maps, calibrations, keypoint files and trajectories; manifests, scenarios and planner
    settings; sessions, simulated flights and studies.
    """
    from pipelines.session.storage import jsonable
    from pipelines.survey import survey

    readings = survey(path)
    if as_json:
        return {"path": str(path), "readings": [{"kind": r.title, **jsonable(r.facts)} for r in readings]}
    for reading in readings:
        say(f"{reading.path}: {reading.title}")
        _print_facts(reading.facts, indent=2)
    if readings:
        follows = _NEXT.get(readings[-1].title, "mocap init {}")
        if readings[-1].title == "session" and not (path / "reconstruct" / "stage.json").is_file():
            follows = "mocap reconstruct {}"
        say_next(follows, path, quiet=False)
    return None


def _print_facts(facts: Mapping[str, object], indent: int) -> None:
    width = max((len(name) for name in facts), default=0)
    for name, value in facts.items():
        label = " " * indent + one_line(name)
        if isinstance(value, Mapping) and value:
            say(label)
            _print_facts(value, indent + 2)
        else:
            digits = 10 if name.startswith(("latitude", "longitude")) else 6  # 0.01 m
            say(f"{label.ljust(indent + width)}  {_text(value, digits)}")


def _text(value: object, digits: int = 6) -> str:
    if value is None or value in ([], {}):
        return "-"
    if isinstance(value, float):
        # Times of day need their milliseconds: the page on drones says to take them over into flight.yaml.
        return f"{value:.3f}".rstrip("0").rstrip(".") if abs(value) >= _LARGE else f"{value:.{digits}g}"
    if isinstance(value, list | tuple):
        shown = ", ".join(_text(item, digits) for item in value[:_MAX_LISTED])
        return f"{shown}, ... ({len(value)})" if len(value) > _MAX_LISTED else shown
    return one_line(str(value))
