"""Readers of files that hold binary numbers below a few lines of text."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.geometry.arrays import Bytes
from pipelines.session.errors import DataError
from pipelines.session.storage import as_data_error, is_special, refuse_special

LONGEST_HEADER = 64 * 1024


def read_bytes(path: Path) -> bytes:
    """Read the whole file.

    Raises:
        DataError: missing or unreadable.
    """
    refuse_special(path)
    try:
        return path.read_bytes()
    except OSError as error:
        raise as_data_error(error, path) from error


def first_bytes(path: Path, count: int = LONGEST_HEADER) -> bytes:
    """Read the beginning of a file, to recognise it; empty if the file cannot be read. Never raises."""
    if is_special(path):
        return b""
    try:
        with path.open("rb") as file:
            return file.read(count)
    except OSError:
        return b""


def split_header(path: Path, content: bytes, last: str) -> tuple[list[list[str]], Bytes]:
    """Split a file into the words of each header line and the bytes below the header.

    Args:
        path: the file, for messages.
        content: all of it.
        last: the first word of the header's last line.

    Raises:
        DataError: no such line within the first 64 KiB.
    """
    lines: list[list[str]] = []
    start = 0
    while start < min(len(content), LONGEST_HEADER):
        end = content.find(b"\n", start, LONGEST_HEADER)
        end = end if end >= 0 else min(len(content), LONGEST_HEADER)
        words = content[start:end].decode("ascii", "replace").split()
        if words:
            lines.append(words)
        start = end + 1
        if words and words[0] == last:
            return lines, np.frombuffer(content, np.uint8)[start:]
    raise DataError(path, f"its header has no line {last!r}", "export the file again")
