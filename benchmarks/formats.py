"""Table of docs/formats.md: the outcome of `mocap info` for every file of the real inputs, and its numbers.

python -m benchmarks.formats --real FOLDER             # prints the table
python -m benchmarks.formats --real FOLDER --write     # and puts it into docs/formats.md

The ordinary readers' numbers are those of `facts.json` beside the inputs; of files that it does not list,
the readers below count again.
"""

import argparse
import csv
import json
import os
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from pipelines.session.errors import MocapError
from pipelines.session.registries import FORMATS, need
from pipelines.survey import survey

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "formats.md"
BEGIN, END = "<!-- python -m benchmarks.formats --real FOLDER --write -->", "<!-- end -->"
_ABOUT = {"README.md", "LICENSE", "facts.json"}  # describe the inputs
_APART = "hughes_filming"  # results of other planners: many files alike, one row for each kind

# Counts of our description, the first that it has, and the same count of the ordinary reader.
_COUNTS = {
    "messages": ("messages",),
    "positions": ("positions",),
    "occupied_voxels": ("occupied_voxels_at_finest",),
    "occupied_pixels": ("trinary_occupied",),
    "finite_points": ("finite_points",),
    "bones": ("joints",),
    "people": ("people_total", "with_keypoints", "entries", "people"),
    "cameras": ("images", "cameras"),
    "frames": ("frames",),
    "rows": ("rows", "frames"),
}
_MOST_KINDS = 3  # endings in a folder that is one input: a bag's metadata and storage, a calibration's files
_OCCUPIED = ("occupied_pixels", "finite_points")  # of maps, counted before voxels are made


def units(folder: Path) -> Iterator[tuple[str, list[Path]]]:
    """Find the inputs: a folder that a format recognises, else each file, of another project by kind."""
    alike: dict[str, list[Path]] = {}
    for here, folders, files in os.walk(folder):
        folders.sort()
        place = Path(here)
        kinds = {Path(name).suffix for name in files}
        if place != folder and len(kinds) <= _MOST_KINDS and any(f.recognises(place) for f in FORMATS.all()):
            folders.clear()
            yield place.relative_to(folder).as_posix(), [place]
            continue
        for name in sorted(set(files) - _ABOUT):
            path = (place / name).relative_to(folder)
            if path.parts[0] == _APART:
                alike.setdefault(f"{_APART}/**/*{path.suffix}", []).append(folder / path)
            else:
                yield path.as_posix(), [folder / path]
    yield from sorted(alike.items())


def row(folder: Path, name: str, paths: list[Path]) -> str:
    """Write the row of an input: the formats or the refusal, our count, the ordinary reader's."""
    shown = f"`{name}`" + (f" ({len(paths)} files)" if len(paths) > 1 else "")
    read, ours, theirs = outcome(folder, name, paths[0])
    return f"| {shown} | {read} | {ours} | {theirs} |"


def outcome(folder: Path, name: str, path: Path) -> tuple[str, str, str]:
    """Survey an input and count its content by the ordinary reader."""
    reader, counts = ordinary(folder, name, path)
    try:
        readings = survey(path)
    except MocapError as error:
        message = str(error).removeprefix(f"{path}: ").replace(str(folder), "").replace("|", " ")
        if _APART in name:
            message = re.sub(r" \d+ | with the (keys|columns) .*?(;|$)", r" \2", message)
        return f"refused: {message}", "", "refuses it, too" if "open_error" in counts else ""
    names = {f.title: f.name for f in FORMATS.all()}
    read = ", ".join(f"`{names[reading.title]}`" for reading in readings)
    facts = {key: value for reading in reversed(readings) for key, value in reading.facts.items()}
    counted = sorted(
        set(_COUNTS) & facts.keys(), key=lambda key: (key not in _OCCUPIED, [*_COUNTS].index(key))
    )
    for key in counted:
        value = next((counts[k] for k in (*_COUNTS[key], key) if k in counts), None)
        if value is not None:
            theirs = len(value) if isinstance(value, dict | list) else value
            return read, f"{facts[key]} {key.replace('_', ' ')}{_dropped(key, facts)}", f"{theirs} ({reader})"
    return read, f"{facts[counted[0]]} {counted[0].replace('_', ' ')}" if counted else "", reader


def _dropped(key: str, facts: dict[str, Any]) -> str:
    """Write the rows that our reader leaves out, by cause."""
    causes = [
        (name.removeprefix("dropped: "), n) for name, n in facts.items() if name.startswith("dropped: ")
    ]
    return "".join(f", {count} dropped ({cause})" for cause, count in causes) if key == "rows" else ""


def ordinary(folder: Path, name: str, path: Path) -> tuple[str, dict[str, Any]]:
    """Return the ordinary reader's name and what it counts; both empty if none is known."""
    every: dict[str, dict[str, Any]] = json.loads((folder / "facts.json").read_text(encoding="utf-8"))
    facts = every.get(name) or every.get(re.sub(r"\.yaml$", ".pgm", name), {})
    if facts:
        return str(facts.get("reader", "")).split(" (")[0].split(",")[0], facts
    if path.is_dir():
        return _people(sorted(path.glob("*.json")))
    counter = _READERS.get(path.suffix.lower())
    return counter(path) if counter else ("", {})


def _people(files: list[Path]) -> tuple[str, dict[str, Any]]:
    """Count the people of OpenPose with any keypoint, or the instances of MMPose."""
    count = 0
    for path in files:
        content = json.loads(path.read_text(encoding="utf-8"))
        listed = content.get("people", []) if isinstance(content, dict) else content
        people: list[dict[str, Any]] = [each for each in listed if isinstance(each, dict)]
        keypoints = [each.get("pose_keypoints_2d") or each.get("keypoints") or [] for each in people]
        count += sum(map(any, keypoints))
    return ("json", {"people": count}) if files else ("", {})


def _filestorage(path: Path) -> tuple[str, dict[str, Any]]:
    if not path.read_bytes().startswith(b"%YAML"):
        return "", {}
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    names = ("Camera.fx", "Camera1.fx", "Camera2.fx")
    cameras = sum(not storage.getNode(name).empty() for name in names)
    storage.release()
    return "OpenCV", {"cameras": cameras}


def _bag(path: Path) -> tuple[str, dict[str, Any]]:
    with AnyReader([path]) as reader:
        return "rosbags", {"messages": reader.message_count}


def _mcap(path: Path) -> tuple[str, dict[str, Any]]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    return "mcap", {"messages": summary.statistics.message_count} if summary and summary.statistics else {}


def _mavlink(path: Path) -> tuple[str, dict[str, Any]]:
    log: Any = need("pymavlink.mavutil", "drones").mavlink_connection(str(path))
    count = 0
    while log.recv_match() is not None:
        count += 1
    log.close()
    return "pymavlink", {"messages": count}


def _video(path: Path) -> tuple[str, dict[str, Any]]:
    video = cv2.VideoCapture(str(path))
    count = 0
    while video.grab():
        count += 1
    return "OpenCV", {"frames": count}


def _table(path: Path) -> tuple[str, dict[str, Any]]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        return "csv", {"rows": sum(1 for _ in csv.reader(file)) - 1}


def _toml(path: Path) -> tuple[str, dict[str, Any]]:
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    tables = [*content.values(), *content.get("cameras", {}).values()]
    return "tomllib", {"cameras": sum(isinstance(each, dict) and "matrix" in each for each in tables)}


def _pcd(path: Path) -> tuple[str, dict[str, Any]]:
    header = path.read_bytes()[:1000].decode("ascii", "replace")
    return "header", {"finite_points": int(header.split("POINTS ")[1].split()[0])}


def _trc(path: Path) -> tuple[str, dict[str, Any]]:
    return "text", {"rows": sum(line[:1].isdigit() for line in path.read_text().splitlines()[5:])}


def _subtitles(path: Path) -> tuple[str, dict[str, Any]]:
    text = path.read_text(encoding="utf-8-sig")
    return "text", {"positions": len(re.findall(r"latitude|GPS ?\(", text))}


_READERS = {
    ".bag": _bag,
    ".mcap": _mcap,
    ".bin": _mavlink,
    ".tlog": _mavlink,
    ".mp4": _video,
    ".webm": _video,
    ".csv": _table,
    ".toml": _toml,
    ".pcd": _pcd,
    ".trc": _trc,
    ".srt": _subtitles,
    ".json": lambda path: _people([path]),
    ".yaml": _filestorage,
}


def table(folder: Path) -> list[str]:
    """Write the rows of every input."""
    return [row(folder, name, paths) for name, paths in units(folder)]


def main() -> None:
    parser = argparse.ArgumentParser(description="Survey every real input.")
    parser.add_argument("--real", type=Path, required=True, metavar="FOLDER", help="The real inputs.")
    parser.add_argument("--write", action="store_true", help="Put the table into docs/formats.md.")
    options = parser.parse_args()
    head = ["| input | read as | read | ordinary reader |", "| --- | --- | --- | --- |"]
    text = "\n".join([*head, *table(options.real)])
    print(text)
    if options.write:
        page = PAGE.read_text(encoding="utf-8")
        if BEGIN not in page:
            sys.exit(f"{PAGE}: has no line {BEGIN}")
        before, rest = page.split(BEGIN, 1)
        PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.split(END, 1)[1]}", encoding="utf-8")


if __name__ == "__main__":
    main()
