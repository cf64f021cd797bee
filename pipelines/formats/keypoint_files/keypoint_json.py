"""Careful reading of JSON keypoint files: content, samples to recognise a format, numbers, frame numbers."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError

_SAMPLED_FILES = 8
_FRAME_LIMIT = 2**62  # keeps frame numbers and their differences inside int64
# ".jpg" and ".jp2" are suffixes, the ".0004" of "cam01.0004" is a frame number.
_SUFFIX = re.compile(r"\.[A-Za-z]\w*$")


def load_json(path: Path) -> object:
    """Read a JSON file; NaN and Infinity are accepted, as Python writes them.

    Raises:
        DataError: it cannot be opened, is empty, is not JSON, or is nested too deeply.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(path, f"cannot be opened ({error.strerror})") from error
    if not content.strip():
        raise DataError(path, "is empty", "export the keypoints again")
    try:
        parsed: object = json.loads(content)
    except (ValueError, RecursionError) as error:
        reason = "is nested too deeply" if isinstance(error, RecursionError) else f"is not JSON ({error})"
        raise DataError(path, reason, "it may be truncated; export the keypoints again") from error
    return parsed


def json_files(folder: Path) -> list[Path]:
    """Return the JSON files of a folder, by name, without hidden ones (macOS leaves such on shared disks)."""
    return sorted(p for p in folder.glob("*.json") if p.is_file() and not p.name.startswith("."))


def samples(path: Path) -> list[object]:
    """Read enough of a JSON file, or of a few files across a folder, to recognise the format.

    Lists are cut after their first entry, at the top and one level below. Unreadable files are skipped.
    """
    if path.is_dir():
        files = json_files(path)
        files = files[:: max(1, len(files) // _SAMPLED_FILES)][:_SAMPLED_FILES]
    else:
        files = [path] if path.suffix.lower() == ".json" and path.is_file() else []
    found: list[object] = []
    for file in files:
        try:
            status = file.stat()
            found.append(_outline(file, status.st_size, status.st_mtime_ns))
        except (OSError, DataError):
            continue
    return found


@lru_cache(maxsize=64)
def _outline(path: Path, size: int, modified_ns: int) -> object:  # noqa: ARG001 - the key of the cache
    """Return the beginnings of a file's lists; cached, because every format asks for the same file."""
    content = load_json(path)
    if isinstance(content, dict):
        return {key: value[:1] if isinstance(value, list) else value for key, value in content.items()}
    return content[:1] if isinstance(content, list) else content


def first_entry(sample: object) -> dict[str, object]:
    """Return the first entry of a list of objects; empty for anything else."""
    entry = sample[0] if isinstance(sample, list) and sample else None
    return entry if isinstance(entry, dict) else {}


def is_alphapose_entry(entry: dict[str, object]) -> bool:
    """Return True if a result entry is AlphaPose's rather than COCO's, which has the same layout.

    AlphaPose adds `box` and `idx` (not in old versions) and names pictures; COCO numbers them.
    """
    image = entry.get("image_id")
    names_picture = isinstance(image, str) and _SUFFIX.search(image) is not None
    return (
        "keypoints" in entry and "image_id" in entry and ("box" in entry or "idx" in entry or names_picture)
    )


def objects(content: object, where: object, what: str) -> Iterator[tuple[str, dict[str, object]]]:
    """Yield each entry of a list of JSON objects, with its name for messages.

    Raises:
        DataError: not a list, or an entry is not an object.
    """
    if not isinstance(content, list):
        raise DataError(str(where), f"the {what} are not a list", "check the file's format")
    for index, entry in enumerate(content):
        name = f"{where}, {what} [{index}]"
        if not isinstance(entry, dict):
            raise DataError(name, "is not a JSON object", "check the file's format")
        yield name, entry


def numbers(values: object, where: str) -> Float:
    """Convert a JSON array of numbers; null is NaN.

    Raises:
        DataError: it is ragged or holds something else.
    """
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(where, "keypoints are not plain numbers", "check the file's format") from error


def triples(values: object, where: str) -> Float:
    """Reshape a flat array x, y, confidence, x, y, ... to rows [K, 3]."""
    flat = numbers(values, where)
    if flat.ndim != 1 or flat.size % 3 or not flat.size:
        raise DataError(where, f"{flat.size} values are not x, y, confidence for each keypoint")
    return flat.reshape(-1, 3)


def whole_number(value: object) -> int | None:
    """Return a JSON number as int, if it is an integer of plausible size; else None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return int(value) if abs(value) < _FRAME_LIMIT and value == int(value) else None


def frame_number(name: object) -> int | None:
    """Return the frame of an image id or a name: the number itself, or the last digits before the suffix."""
    if not isinstance(name, str):
        return whole_number(name)
    digits = re.findall(r"[0-9]+", _SUFFIX.sub("", name))
    return whole_number(int(digits[-1])) if digits and len(digits[-1]) < 20 else None
