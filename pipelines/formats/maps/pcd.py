"""Reader of Point Cloud Library's PCD, versions .5 to .7: ascii, binary and binary_compressed.

Layout (PCL documentation, "The PCD file format"): lines VERSION, FIELDS (in old files COLUMNS), SIZE, TYPE,
COUNT, WIDTH, HEIGHT, VIEWPOINT, POINTS, DATA, then the points. binary: records, packed, little-endian.
binary_compressed: two uint32, bytes compressed and uncompressed, and an LZF stream of all values of the first
field, all of the second, and so on. VIEWPOINT, the pose of the sensor, is not applied to the points.
"""

import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.formats.common.files import first_bytes, read_bytes, split_header
from pipelines.formats.maps.voxel_grids import (
    check_count,
    describe_points,
    joined,
    occupancy_of,
    packed_points,
    written_points,
)
from pipelines.geometry.arrays import Bytes, Float
from pipelines.session.errors import DataError
from pipelines.session.records import Occupancy

_KINDS = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_NUMPY_KIND = {"F": "f", "I": "i", "U": "u"}
_EXPORT_AGAIN = "export it again"
_SIZES = struct.Struct("<II")
_NO_VIEWPOINT = [0, 0, 0, 1, 0, 0, 0]
MOST_EXPANSION = 88
"""Largest ratio of output to input (264 bytes for 3); a file that states more is refused."""


@dataclass(frozen=True)
class _Header:
    version: str
    fields: tuple[str, ...]
    sizes: tuple[int, ...]  # bytes of one value
    types: tuple[str, ...]  # F, I, U
    counts: tuple[int, ...]  # values of the field in one point
    width: int
    height: int
    points: int
    viewpoint: tuple[str, ...]
    data: str  # ascii, binary, binary_compressed

    @property
    def stride(self) -> int:
        """Bytes of a point."""
        return sum(size * count for size, count in zip(self.sizes, self.counts, strict=True))


class PcdFormat:
    """Reader of fields in any order and type, x, y, z in metres; points that are not finite are counted."""

    name = "pcd"
    title = "point cloud (PCD)"
    suffixes: tuple[str, ...] = (".pcd",)

    def recognises(self, path: Path) -> bool:
        """Return True if the file has the lines that every PCD has."""
        head = first_bytes(path, suffixes=self.suffixes)
        return bool(re.search(rb"(?m)^(FIELDS|COLUMNS) ", head) and re.search(rb"(?m)^DATA ", head))

    def describe(self, path: Path) -> dict[str, object]:
        """Describe header, points, and their map at the default resolution."""
        header, points = _read(path)
        summary: dict[str, object] = {
            "version": header.version,
            "fields": list(header.fields),
            "width": header.width,
            "height": header.height,
            "data": header.data,
        }
        if header.viewpoint:
            summary["viewpoint (not applied)"] = " ".join(header.viewpoint)
        return {**summary, **describe_points(path, points)}

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read points as voxels: occupied (1.0) with a point in it, else unknown; 0.2 m unless stated."""
        return occupancy_of(path, _read(path)[1], resolution_m)


def _read(path: Path) -> tuple[_Header, Float]:
    lines, body = split_header(path, read_bytes(path), "DATA")
    header = _header(path, lines)
    place = {name: header.fields.index(name) for name in ("x", "y", "z")}
    if any(header.counts[k] != 1 for k in place.values()):
        raise DataError(path, "has more than one x, y or z in a point", _EXPORT_AGAIN, code="bad-value")
    if header.data == "ascii":
        first = [sum(header.counts[:k]) for k in place.values()]
        return header, written_points(path, body, 0, header.points, (first[0], first[1], first[2]))
    types = {name: f"<{_NUMPY_KIND[header.types[k]]}{header.sizes[k]}" for name, k in place.items()}
    before = {
        name: sum(size * count for size, count in zip(header.sizes[:k], header.counts[:k], strict=True))
        for name, k in place.items()
    }
    if header.data == "binary":
        columns = {name: (types[name], before[name]) for name in place}
        return header, packed_points(path, body, header.points, columns, header.stride)
    values = _decompressed(path, body, header)
    n = header.points
    return header, joined(
        [values[n * before[name] :][: n * header.sizes[k]].view(types[name]) for name, k in place.items()]
    )


def _header(path: Path, lines: list[list[str]]) -> _Header:
    words = {line[0]: line[1:] for line in lines if not line[0].startswith("#")}
    fields = words.get("FIELDS") or words.get("COLUMNS") or []
    if not {"x", "y", "z"} <= set(fields):
        raise DataError(path, f"its fields are {' '.join(fields)[:100] or 'not named'}", "x, y, z are needed")
    try:
        sizes = [int(word) for word in words.get("SIZE", ["4"] * len(fields))]
        types = words.get("TYPE", ["F"] * len(fields))
        counts = [int(word) for word in words.get("COUNT", ["1"] * len(fields))]
        width = int(words["WIDTH"][0])
        height = int(words.get("HEIGHT", ["1"])[0])
        points = int(words.get("POINTS", [str(width * height)])[0])
        data = words["DATA"][0].lower()
    except (KeyError, IndexError, ValueError) as error:
        raise DataError(
            path, f"its header cannot be read ({str(error)[:100]})", _EXPORT_AGAIN, code="damaged"
        ) from error
    if not len(fields) == len(sizes) == len(types) == len(counts):
        raise DataError(path, "FIELDS, SIZE, TYPE and COUNT are not equally long", _EXPORT_AGAIN)
    for field, size, kind, count in zip(fields, sizes, types, counts, strict=True):
        if size not in _KINDS.get(kind, ()) or count < 1:
            raise DataError(path, f"field {field[:40]} is {count} times {kind[:8]}{size}", _EXPORT_AGAIN)
    if data not in {"ascii", "binary", "binary_compressed"}:
        raise DataError(path, f"DATA is {data[:40]!r}", "ascii, binary and binary_compressed are read")
    if points < 1 or width * height != points:
        raise DataError(path, f"states {width} x {height} and {points} points", _EXPORT_AGAIN)
    viewpoint = tuple(words.get("VIEWPOINT", []))
    return _Header(
        " ".join(words.get("VERSION", [])),
        tuple(fields),
        tuple(sizes),
        tuple(types),
        tuple(counts),
        width,
        height,
        points,
        viewpoint if not _is_identity(viewpoint) else (),
        data,
    )


def _is_identity(viewpoint: tuple[str, ...]) -> bool:
    try:
        return [float(word) for word in viewpoint] in ([], _NO_VIEWPOINT)
    except ValueError:
        return False


def _decompressed(path: Path, body: Bytes, header: _Header) -> Bytes:

    if len(body) < _SIZES.size:
        check_count(path, header.points, 0)
    packed_size, size = _SIZES.unpack(body[: _SIZES.size].tobytes())
    packed = body[_SIZES.size :][:packed_size]
    if len(packed) < packed_size:
        raise DataError(
            path,
            f"breaks off: {len(packed)} of {packed_size} bytes are there",
            "copy it again",
            code="damaged",
        )
    if size != header.points * header.stride or size > MOST_EXPANSION * packed_size:
        raise DataError(
            path,
            f"states {size} bytes for {header.points} points of {header.stride} bytes in {packed_size} bytes",
            _EXPORT_AGAIN,
            code="damaged",
        )
    from pipelines.formats.maps.lzf import decompress

    values = np.zeros(size, dtype=np.uint8)
    if decompress(packed, values) != size:
        raise DataError(
            path, "its compressed points are damaged", "copy it again or export it again", code="damaged"
        )
    return values


FORMAT = PcdFormat()
