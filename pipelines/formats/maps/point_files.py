"""Point clouds (PCD, PLY, LAS, LAZ) as voxels: occupied with a point in them, else unknown."""

from __future__ import annotations

import re
import struct
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pipelines.formats.common.files import first_bytes, read_bytes, split_header
from pipelines.formats.maps.voxel_grids import (
    VoxelSet,
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
from pipelines.session.registries import install_command, need

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


# --- LAS and LAZ (ASPRS, 1.0 to 1.4) by laspy, read in chunks -----------------------------------------------
#
# Points that the file marks as noise (classes 7 and 18) or as withheld are left out and counted. Coordinates
# are those of the file's reference system: usually a map projection, which the file may name.
#
# LAZ is decompressed into a temporary LAS by a process of its own that runs this module as its main program:
# the decompressor, which is compiled, aborts its process on some damaged files.

# So many points are read at a time, which takes some 100 MB.
_CHUNK = 1_000_000
_NOISE = (7, 18)  # low and high noise of ASPRS
_GEO_KEYS = (3072, 2048)  # GeoTIFF: the projected, or else the geographic system's EPSG number
# A variable length record of LAS has at least this many bytes.
_RECORD = 54
# GeoTIFF means by this number that the system has no number.
_USER_DEFINED = 32767
_COPY = "copy it again, or export it again"

# Limits of the process that decompresses: no chunk needs more memory, and no file as much time.
_MOST_BYTES = 4 << 30
_LEAST_CPU_S, _SLOWEST_BYTES_PER_S = 60, 200_000


class LasFormat:
    """Reader of the points of all returns; a LAS that is cut off gives the points that it still holds."""

    name = "las"
    title = "point cloud (LAS, LAZ)"
    suffixes: tuple[str, ...] = (".las", ".laz")

    def recognises(self, path: Path) -> bool:
        """Return True if the file begins with the signature of LAS."""
        return first_bytes(path, 4) == b"LASF"

    def describe(self, path: Path) -> dict[str, object]:
        """Describe version, points, box, classes and the coordinate reference system."""
        header = _header(path)
        boxes: list[Float] = []  # lowest, highest point
        with _plain(path, header) as plain:
            usable, dropped = _hand_over(
                plain, header, lambda points: boxes.append(np.stack([points.min(axis=0), points.max(axis=0)]))
            )
        facts: dict[str, object] = {
            "version": f"{header.version.major}.{header.version.minor}",
            "point_format": int(header.point_format.id),
            "compressed": bool(header.are_points_compressed),
            "points": int(header.point_count),
            "crs": crs_of(header) or "not stated",
            "finite_points": usable,
            **{f"dropped: {cause}": count for cause, count in dropped.items()},
        }
        if boxes:
            low, high = np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]
            facts["points_box_min_m"] = [round(v, 4) for v in low.tolist()]
            facts["points_box_max_m"] = [round(v, 4) for v in high.tolist()]
        return facts

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read points as voxels: occupied (1.0) with a point in it, else unknown; 0.2 m unless stated."""
        header, voxels = _header(path), VoxelSet(path, resolution_m)
        with _plain(path, header) as plain:
            _, dropped = _hand_over(plain, header, voxels.add)
        found = voxels.occupancy()
        return replace(found, dropped=found.dropped | dropped, crs=crs_of(header))


def _header(path: Path) -> Any:
    """Read the header; refuse one with more records than the file has room for, as laspy looks for each."""
    laspy = need("laspy", "las")
    head = first_bytes(path, 375)
    counts = [int.from_bytes(head[place : place + 4], "little") for place in (100, 243)]
    counts = counts if head[25:26] >= b"\x04" and len(head) >= 375 else counts[:1]
    size = path.stat().st_size
    first_point = int.from_bytes(head[96:100], "little")
    if len(head) < 227 or first_point > size:
        raise DataError(path, f"is cut off within its header ({size} bytes)", _COPY, code="damaged")
    if first_point < 227 or sum(counts) * _RECORD > size:
        problem = f"states {sum(counts)} records and points from byte {first_point} on, in {size} bytes"
        raise DataError(path, problem, _COPY, code="damaged")
    try:
        with path.open("rb") as file:
            return laspy.LasHeader.read_from(file, read_evlrs=True)
    except Exception as error:  # laspy raises whatever it meets in a damaged header
        problem = f"laspy cannot read it ({str(error)[:100]})"
        raise DataError(path, problem, _COPY, code="damaged") from error


@contextmanager
def _plain(path: Path, header: Any) -> Iterator[Path]:
    """Yield the file if it is a LAS, else a temporary one with its decompressed points."""
    if not header.are_points_compressed:
        yield path
        return
    if not need("laspy", "las").LazBackend.detect_available():
        remedy = f"run `{install_command('las')}`"
        raise DataError(
            path, "is compressed (LAZ), and lazrs is not installed", remedy, code="missing-library"
        )
    with TemporaryDirectory() as folder:
        plain = Path(folder) / "plain.las"
        done = subprocess.run(_decompressor(path, plain), capture_output=True, check=False)  # noqa: S603
        if done.returncode or not plain.is_file():
            problem = f"cannot be decompressed (the decompressor ended with status {done.returncode})"
            raise DataError(path, problem, _COPY, code="damaged")
        yield plain


def _decompressor(path: Path, plain: Path) -> list[str]:
    # -P: a folder that happens to be called like a package here must not be imported.
    return [sys.executable, "-P", "-m", __name__, str(path.absolute()), str(plain)]


def _decompress(path: Path, plain: Path) -> None:
    """Write the points of a LAZ, as far as they can be read, into a LAS; in a process with limits."""
    import resource

    laspy = need("laspy", "las")
    seconds = _LEAST_CPU_S + path.stat().st_size // _SLOWEST_BYTES_PER_S
    for kind, most in ((resource.RLIMIT_DATA, _MOST_BYTES), (resource.RLIMIT_CPU, seconds)):
        _, hard = resource.getrlimit(kind)
        resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
    with (
        laspy.open(path) as packed,
        laspy.open(plain, "w", header=packed.header, do_compress=False) as target,
        suppress(BaseException),
    ):  # panics of the decompressor have the base of all exceptions
        for chunk in packed.chunk_iterator(_CHUNK):
            target.write_points(chunk)


def _hand_over(plain: Path, header: Any, take: Callable[[Float], None]) -> tuple[int, dict[str, int]]:
    """Hand over the usable points [N, 3] of each chunk; count them, and the others by cause."""
    laspy = need("laspy", "las")
    lost: Counter[str] = Counter()
    read = usable = 0
    with laspy.open(plain) as cloud:
        room = plain.stat().st_size - cloud.header.offset_to_point_data
        there = max(0, min(int(cloud.header.point_count), room // cloud.header.point_format.size))
        while read < there:
            chunk = cloud.read_points(min(_CHUNK, there - read))
            if not len(chunk):
                break
            read += len(chunk)
            bad = np.isin(np.asarray(chunk.classification), _NOISE)
            hidden = np.asarray(chunk.withheld).astype(bool) & ~bad
            with np.errstate(over="ignore", invalid="ignore"):  # a damaged scale: the box is then refused
                points = np.stack([np.asarray(chunk[axis], dtype=np.float64) for axis in "xyz"], axis=1)
            points = points[~bad & ~hidden]
            usable += len(points)
            if len(points):
                take(points)
            lost["points marked as noise"] += int(bad.sum())
            lost["points marked as withheld"] += int(hidden.sum())
    lost["points cut off"] = int(header.point_count) - read
    return usable, dict(+lost)


def crs_of(header: Any) -> str | None:
    """Return the coordinate reference system that a header names, as WKT or `EPSG:n`; None without one."""
    for record in header.vlrs:
        if type(record).__name__ == "WktCoordinateSystemVlr" and record.string.strip("\0 "):
            return str(record.string).strip("\0 ")
    for record in header.vlrs:
        if type(record).__name__ == "GeoKeyDirectoryVlr":
            keys = {key.id: key.value_offset for key in record.geo_keys}
            known = [keys[key] for key in _GEO_KEYS if 0 < keys.get(key, 0) < _USER_DEFINED]
            if known:
                return f"EPSG:{known[0]}"
    return None


LAS = LasFormat()

if __name__ == "__main__":
    _decompress(Path(sys.argv[1]), Path(sys.argv[2]))
