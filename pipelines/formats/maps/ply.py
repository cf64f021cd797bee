"""Reader of Stanford's PLY: the vertices of a cloud or mesh, ascii or binary of either byte order.

Layout (Turk, "The PLY Polygon File Format", 1994): `ply`, `format`, then each `element` with its count and
its `property` lines, `end_header`, then the elements one after the other. Only `vertex` is read, so a mesh
gives its corners only: sample its faces densely before use as a map.
"""

from dataclasses import dataclass, field
from pathlib import Path

from pipelines.formats.common.files import first_bytes, read_bytes, split_header
from pipelines.formats.maps.voxel_grids import (
    check_count,
    describe_points,
    occupancy_of,
    packed_points,
    written_points,
)
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.records import Occupancy

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
_EXPORT_AGAIN = "export it again"


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
        encoding, elements, points = _read(path)
        return {
            "data": encoding,
            "elements": {element.name: element.count for element in elements},
            "fields": list(_vertex(path, elements)[1].properties),
            **describe_points(path, points),
        }

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read vertices as voxels: occupied (1.0) with a vertex in it, else unknown; 0.2 m unless stated."""
        return occupancy_of(path, _read(path)[2], resolution_m)


def _read(path: Path) -> tuple[str, list[_Element], Float]:
    lines, body = split_header(path, read_bytes(path), "end_header")
    encoding, elements = _header(path, lines)
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


def _header(path: Path, lines: list[list[str]]) -> tuple[str, list[_Element]]:
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


FORMAT = PlyFormat()
