"""Reader of ULog files, as PX4 writes them, by pyulog (extra `drones`): their topics as columns.

Definitions are checked before pyulog expands them: damaged or malicious ones mean billions of fields.
"""

from __future__ import annotations

import contextlib
import io
import re
import struct
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Bool, Float
from pipelines.session.errors import DataError
from pipelines.session.records import Int64
from pipelines.session.registries import need

MAGIC = b"ULog\x01\x12\x35"
_MOST_FIELDS = 20_000  # of one message with its nested types; PX4's largest has some hundreds

Columns = Mapping[str, Any]  # by field name, arrays [N] in the log's own number types


@dataclass(frozen=True)
class Topic:
    """One instance of a topic."""

    name: str
    instance: int
    columns: Columns

    def __len__(self) -> int:
        return len(self.columns["timestamp"])

    def __contains__(self, field: str) -> bool:
        return field in self.columns

    def numbers(self, *fields: str) -> Float:
        """Return one field [N], or several [N, F]; NaN throughout if the log has no such field."""
        missing = np.full(len(self), np.nan)
        columns = [np.asarray(self.columns.get(field, missing), dtype=np.float64) for field in fields]
        return columns[0] if len(columns) == 1 else np.stack(columns, axis=1)

    def flags(self, field: str) -> Bool:
        """Return True where a field is set [N]; True throughout if the log has no such field."""
        return np.asarray(self.columns.get(field, np.ones(len(self))) != 0, dtype=np.bool_)

    def t_ns(self) -> Int64:
        """Return stamps [N] since boot: the time of sampling if the log has it, else of publishing."""
        published = np.asarray(self.columns["timestamp"]).astype(np.int64)
        sampled = np.asarray(self.columns.get("timestamp_sample", published)).astype(np.int64)
        stamps: Int64 = np.where(sampled > 0, sampled, published) * 1000
        return stamps


def open_ulog(path: Path, wanted: Collection[str] | None) -> Any:
    """Open a log with some topics, or all of them.

    Raises:
        DataError: pyulog is missing, or cannot read the file.
    """
    core = need("pyulog", "drones")
    _refuse_bombs(path)
    try:
        with path.open("rb") as file, contextlib.redirect_stdout(io.StringIO()):  # pyulog prints warnings
            return core.ULog(file, None if wanted is None else sorted(wanted))
    except DataError:
        raise
    except OSError as error:
        raise DataError(path, f"cannot be read ({error.strerror})", "check the path") from error
    except Exception as error:  # damaged files raise many kinds of errors in this parser
        problem = " ".join(str(error).split())[:100] or type(error).__name__
        raise DataError(path, f"is damaged ({problem})", "download it from the autopilot again") from error


def topics_of(log: Any) -> list[Topic]:
    """Return the topics with a stamp, sorted by name and instance."""
    found = [Topic(str(d.name), int(d.multi_id), d.data) for d in log.data_list if "timestamp" in d.data]
    return sorted(found, key=lambda topic: (topic.name, topic.instance))


def _refuse_bombs(path: Path) -> None:
    """Refuse definitions that expand without end: nested arrays may mean billions of fields.

    Raises:
        DataError: no ULog, or a definition beyond reason.
    """
    try:
        formats = dict(_definitions(path))
    except OSError as error:
        raise DataError(path, f"cannot be read ({error.strerror})", "check the path") from error
    sizes: dict[str, int] = {}

    def size(name: str, depth: int) -> int:
        if depth > 20:
            raise DataError(path, f"defines {name} by itself", "download it from the autopilot again")
        if name not in formats:
            return 1  # a plain type
        if name not in sizes:
            sizes[name] = sum(count * size(inner, depth + 1) for inner, count in formats[name])
        if sizes[name] > _MOST_FIELDS:
            raise DataError(
                path, f"defines {name} with {sizes[name]} fields", "download it from the autopilot again"
            )
        return sizes[name]

    for name in formats:
        size(name, 0)


def _definitions(path: Path) -> list[tuple[str, list[tuple[str, int]]]]:
    """Read the message definitions, (type, count) of the fields by name, up to the start of the data."""
    found: list[tuple[str, list[tuple[str, int]]]] = []
    with path.open("rb") as file:
        if file.read(16)[: len(MAGIC)] != MAGIC:
            raise DataError(path, "is no PX4 log", "give the .ulg that the autopilot wrote")
        while len(head := file.read(3)) == 3:
            size, kind = struct.unpack("<HB", head)
            body = file.read(size)
            if kind in {ord("A"), ord("D"), ord("L")} or len(body) < size:
                break
            if kind == ord("F"):
                name, _, fields = body.decode("utf-8", errors="replace").partition(":")
                parts = re.findall(r"([^\s;\[]+)(?:\[(\d{1,9})\])?\s+[^;]+;?", fields)
                found.append((name, [(inner, int(count or 1)) for inner, count in parts]))
    return found
