"""Point clouds of PCL (.pcd) and Stanford (.ply) as voxels: occupied with a point in them, else unknown."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field
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
class _PcdHeader:
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
        header, points = _read_pcd(path)
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
        return occupancy_of(path, _read_pcd(path)[1], resolution_m)


def _read_pcd(path: Path) -> tuple[_PcdHeader, Float]:
    lines, body = split_header(path, read_bytes(path), "DATA")
    header = _pcd_header(path, lines)
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


def _pcd_header(path: Path, lines: list[list[str]]) -> _PcdHeader:
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
    for name, size, kind, count in zip(fields, sizes, types, counts, strict=True):
        if size not in _KINDS.get(kind, ()) or count < 1:
            raise DataError(path, f"field {name[:40]} is {count} times {kind[:8]}{size}", _EXPORT_AGAIN)
    if data not in {"ascii", "binary", "binary_compressed"}:
        raise DataError(path, f"DATA is {data[:40]!r}", "ascii, binary and binary_compressed are read")
    if points < 1 or width * height != points:
        raise DataError(path, f"states {width} x {height} and {points} points", _EXPORT_AGAIN)
    viewpoint = tuple(words.get("VIEWPOINT", []))
    return _PcdHeader(
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


def _decompressed(path: Path, body: Bytes, header: _PcdHeader) -> Bytes:

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
    from pipelines.formats.maps.octree import decompress

    values = np.zeros(size, dtype=np.uint8)
    if decompress(packed, values) != size:
        raise DataError(
            path, "its compressed points are damaged", "copy it again or export it again", code="damaged"
        )
    return values


PCD = PcdFormat()


_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: dict[str, str] = field(default_factory=dict)  # to numpy type, or "list"

    @property
    def stride(self) -> int:
        """Bytes of one element; meaningless with lists."""
        return sum(int(kind[1:]) for kind in self.properties.values() if kind != "list")


class PlyFormat:
    """Reader of vertices; x, y and z are metres. Vertices that are not finite are counted."""

    name = "ply"
    title = "point cloud (PLY)"
    suffixes: tuple[str, ...] = (".ply",)

    def recognises(self, path: Path) -> bool:
        """Return True if the file begins with the line `ply`."""
        return first_bytes(path, 16, suffixes=self.suffixes).split(b"\n")[0].strip() == b"ply"

    def describe(self, path: Path) -> dict[str, object]:
        """Describe elements, properties, vertices, and their map at the default resolution."""
        encoding, elements, points = _read_ply(path)
        return {
            "data": encoding,
            "elements": {element.name: element.count for element in elements},
            "fields": list(_vertex(path, elements)[1].properties),
            **describe_points(path, points),
        }

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read vertices as voxels: occupied (1.0) with a vertex in it, else unknown; 0.2 m unless stated."""
        return occupancy_of(path, _read_ply(path)[2], resolution_m)


def _read_ply(path: Path) -> tuple[str, list[_Element], Float]:
    lines, body = split_header(path, read_bytes(path), "end_header")
    encoding, elements = _ply_header(path, lines)
    earlier, vertex = _vertex(path, elements)
    names = list(vertex.properties)
    if encoding == "ascii":
        x, y, z = (names.index(name) for name in ("x", "y", "z"))
        skipped = sum(element.count for element in earlier)
        return encoding, elements, written_points(path, body, skipped, vertex.count, (x, y, z))
    if any("list" in element.properties.values() for element in earlier):
        raise DataError(path, "has lists before its vertices", "export it with the vertices first")
    start = sum(element.count * element.stride for element in earlier)
    check_count(path, vertex.count, 0 if start > len(body) else vertex.count)
    columns, offset = {}, 0
    for name, kind in vertex.properties.items():
        columns[name] = (_BYTE_ORDERS[encoding] + kind, offset)
        offset += int(kind[1:])
    return encoding, elements, packed_points(path, body[start:], vertex.count, columns, vertex.stride)


def _ply_header(path: Path, lines: list[list[str]]) -> tuple[str, list[_Element]]:
    encoding, elements = "", list[_Element]()
    for words in lines:
        match words:
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as stated, "1.0"]:
                encoding = stated
            case ["element", name, count] if count.isdecimal() and len(count) < 19:
                elements.append(_Element(name, int(count)))
            case ["property", "list", length, item, name] if elements and {length, item} <= set(_TYPES):
                elements[-1].properties[name] = "list"
            case ["property", kind, name] if elements and kind in _TYPES:
                if name in elements[-1].properties:
                    raise DataError(
                        path, f"names the property {name[:40]} twice", _EXPORT_AGAIN, code="stated-twice"
                    )
                elements[-1].properties[name] = _TYPES[kind]
            case ["ply"] | ["end_header"] | ["comment", *_] | ["obj_info", *_]:
                pass
            case _:
                raise DataError(
                    path,
                    f"its header cannot be read (line {' '.join(words)[:60]!r})",
                    _EXPORT_AGAIN,
                    code="damaged",
                )
    if lines[0] != ["ply"] or not encoding:
        raise DataError(
            path,
            "is no PLY file of version 1.0",
            "its first lines must be `ply` and `format`",
            code="wrong-kind",
        )
    return encoding, elements


def _vertex(path: Path, elements: list[_Element]) -> tuple[list[_Element], _Element]:
    """Return the elements before the vertices, and the vertices."""
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise DataError(path, "has no vertices", _EXPORT_AGAIN)
    k = names.index("vertex")
    element = elements[k]
    if not {"x", "y", "z"} <= set(element.properties) or "list" in element.properties.values():
        stated = " ".join(element.properties)[:100]
        raise DataError(path, f"its vertices have {stated or 'nothing'}", "x, y, z and no lists are needed")
    if not element.count:
        raise DataError(path, "has 0 vertices", _EXPORT_AGAIN, code="empty")
    return elements[:k], element


PLY = PlyFormat()
