"""Reading of whole files as bytes, text or YAML, and of their beginnings, by which formats are recognised."""

import os
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.geometry.arrays import Bytes, Float
from pipelines.session.errors import DataError
from pipelines.session.storage import (
    bad_value,
    damaged,
    is_special,
    on_disk,
    plain_text,
    read_text,
    refuse_special,
)
from pipelines.session.yaml_files import plain_yaml

HEAD_BYTES = 64 * 1024
"""Bytes that `recognises` reads: enough for any header, few enough to be instant."""

# Calibrations have far fewer characters, and the parser is slow.
_LARGEST_YAML = 1 << 20


def read_bytes(path: Path) -> bytes:
    """Read the whole file."""
    refuse_special(path)
    with on_disk(path):
        return path.read_bytes()


def first_bytes(path: Path, count: int = HEAD_BYTES, *, suffixes: Collection[str] = ()) -> bytes:
    """Read the beginning of a file; empty without one of the suffixes, and never an error."""
    if (suffixes and path.suffix.lower() not in suffixes) or is_special(path):
        return b""
    try:
        with path.open("rb") as file:
            return file.read(count)
    except (OSError, ValueError):  # ValueError: an impossible name
        return b""


def split_header(path: Path, content: bytes, last: str) -> tuple[list[list[str]], Bytes]:
    """Split a file into words of header lines, to the one that begins with `last`, and the bytes below."""
    lines: list[list[str]] = []
    start = 0
    while start < min(len(content), HEAD_BYTES):
        end = content.find(b"\n", start, HEAD_BYTES)
        end = end if end >= 0 else min(len(content), HEAD_BYTES)
        words = content[start:end].decode("ascii", "replace").split()
        if words:
            lines.append(words)
        start = end + 1
        if words and words[0] == last:
            return lines, np.frombuffer(content, np.uint8)[start:]
    raise damaged(path, f"its header has no line {last!r}")


def read_yaml(path: Path) -> dict[str, object]:
    """Read the mapping of a YAML file, of plain types only; the line `%YAML:1.0` of OpenCV is skipped."""
    text = read_text(path)
    if len(text) > _LARGEST_YAML:
        raise DataError(path, f"has {len(text)} characters", f"a calibration has less than {_LARGEST_YAML}")
    if text.startswith("%YAML:"):
        text = "#" + text
    value = plain_yaml(path, text)
    if not isinstance(value, dict):
        raise damaged(path, "is no YAML mapping of names to values")
    return {str(key): item for key, item in value.items()}


def numbers(source: Path, name: str, value: object) -> Float:
    """Return a list of numbers as an array [N]; `name` is for the message if it is none."""
    if not isinstance(value, list) or not all(
        isinstance(cell, int | float) and not isinstance(cell, bool) for cell in value
    ):
        raise bad_value(source, f"{name} is no list of numbers")
    try:
        return np.array(value, dtype=np.float64)
    except OverflowError as error:
        raise bad_value(source, f"{name} has a number of too many digits") from error


def leads_out(stated: str) -> bool:
    """Return True if a relative path leads out of its folder; links may, as a file cannot bring any."""
    return Path(os.path.normpath(stated)).parts[:1] == (os.pardir,)


def read_head(path: Path, suffixes: Collection[str] = ()) -> str:
    """Read the first lines of a text file, to recognise it; like `first_bytes`."""
    head = first_bytes(path, suffixes=suffixes)
    text = plain_text(head)
    return text if len(head) < HEAD_BYTES else text.rpartition("\n")[0]


@dataclass(frozen=True)
class TextFormat:
    """Base of readers of text: `is_known` recognises the beginning of such a file."""

    name: str
    title: str
    suffixes: tuple[str, ...]
    is_known: Callable[[str], bool]

    def recognises(self, path: Path) -> bool:
        """Return True if the file begins as such files do."""
        return self.is_known(read_head(path, self.suffixes))
