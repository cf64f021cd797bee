"""Point clouds (PCD, PLY, LAS, LAZ) as voxels: occupied with a point in them, else unknown."""

import re
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.formats.common.files import first_bytes, read_bytes, split_header
from pipelines.formats.maps.voxel_grids import MapFile, VoxelSet
from pipelines.geometry.arrays import Bytes, Float
from pipelines.session.errors import DataError
from pipelines.session.records import Occupancy
from pipelines.session.registries import install_command, need
from pipelines.session.storage import damaged, empty

_SIZES = struct.Struct("<II")
MOST_EXPANSION = 88
"""Largest ratio of output to input (264 bytes for 3); a file that states more is refused."""


@dataclass(frozen=True)
class CloudFile(MapFile):
    """Reader of clouds in metres: `is_known` recognises their beginning, `read` returns points [N, 3]."""

    name: str
    title: str
    suffixes: tuple[str, ...]
    is_known: Callable[[bytes], bool]
    read: Callable[[Path], Float]

    def recognises(self, path: Path) -> bool:
        """Return True if the file begins as such files do."""
        return self.is_known(first_bytes(path, suffixes=self.suffixes))

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read points as voxels: occupied (1.0) with a point in it, else unknown; 0.2 m unless stated."""
        voxels = VoxelSet(path, resolution_m)
        voxels.add(self.read(path))
        return voxels.occupancy()


def _bad_header(path: Path, problem: object) -> DataError:
    return damaged(path, f"its header cannot be read ({str(problem)[:100]})")


def _refuse_cut(path: Path, stated: int, there: int) -> None:
    if stated > there:
        raise damaged(path, f"breaks off: {there} of {stated} points are there")


def _records(path: Path, body: Bytes, count: int, record: np.dtype[Any]) -> NDArray[Any]:
    _refuse_cut(path, count, len(body) // max(record.itemsize, 1))
    return body[: count * record.itemsize].view(record)


def _joined(columns: Sequence[NDArray[Any]]) -> Float:
    with np.errstate(invalid="ignore"):  # signalling NaNs of damaged floats warn; they are counted later
        return np.stack([column.astype(np.float64).ravel() for column in columns], axis=1)


def _written(path: Path, body: Bytes, skipped: int, count: int, columns: Sequence[int]) -> Float:
    """Parse `count` points [N, 3] from rows of text, behind `skipped` other rows."""
    lines = (line.strip() for line in body.tobytes().decode("latin-1").split("\n"))
    rows = [line for line in lines if line][skipped:]
    _refuse_cut(path, count, len(rows))
    try:
        return np.loadtxt(rows[:count], dtype=np.float64, comments=None, usecols=columns, ndmin=2)
    except (ValueError, OverflowError) as error:  # the latter for columns of an absurd number
        raise damaged(path, f"a row of points is damaged ({str(error)[:100]})") from error


# --- PCD: fields in any order and of any type -----------------------------------------------------------


def read_pcd(path: Path) -> Float:
    """Read the points [N, 3] of a PCD; its viewpoint is not applied."""
    lines, body = split_header(path, read_bytes(path), "DATA")
    words = {line[0]: line[1:] for line in lines if not line[0].startswith("#")}
    try:
        fields = words.get("FIELDS") or words["COLUMNS"]
        plain = [[value] * len(fields) for value in ("4", "F", "1")]
        sizes, types, counts = (
            words.get(*pair) for pair in zip(("SIZE", "TYPE", "COUNT"), plain, strict=True)
        )
        record = np.dtype(
            [
                (str(k), f"<{kind.lower()}{size}", (int(n),))
                for k, (_, size, kind, n) in enumerate(zip(fields, sizes, types, counts, strict=True))
            ]
        )
        names = [str(fields.index(axis)) for axis in "xyz"]
        if any(record[name].shape != (1,) or record[name].base.kind not in "fiu" for name in names):
            raise ValueError("x, y and z are no single numbers")
        count = int(words["WIDTH"][0]) * int(words.get("HEIGHT", ["1"])[0])
        if count < 1 or count != int(words.get("POINTS", [str(count)])[0]):
            raise ValueError(f"{count} points")
        data = words["DATA"][0].lower()
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise _bad_header(path, error) from error
    if data == "ascii":
        before = np.cumsum([0, *map(int, counts)]).tolist()
        return _written(path, body, 0, count, [before[int(name)] for name in names])
    if data == "binary":
        rows = _records(path, body, count, record)
        return _joined([rows[name] for name in names])
    if data != "binary_compressed":
        raise _bad_header(path, f"DATA {data}")
    values: Bytes = _decompressed(path, body, count * record.itemsize)
    fields_of: Any = record.fields
    columns = ((record[name].base, count * fields_of[name][1]) for name in names)
    return _joined([values[at : at + count * kind.itemsize].view(kind) for kind, at in columns])


def _decompressed(path: Path, body: Bytes, wanted: int) -> Bytes:
    """Decompress the values, which come field by field."""
    from pipelines.formats.maps.octree import decompress

    packed_size, size = _SIZES.unpack(body[: _SIZES.size].tobytes().ljust(_SIZES.size, b"\0"))
    packed = body[_SIZES.size :][:packed_size]
    values = np.zeros(size if size == wanted <= MOST_EXPANSION * len(packed) else 0, dtype=np.uint8)
    if len(packed) < packed_size or not len(values) or decompress(packed, values) != size:
        raise damaged(path, f"its compressed points are damaged: {len(packed)} bytes for {wanted}")
    return values


PCD = CloudFile(
    "pcd",
    "point cloud (PCD)",
    (".pcd",),
    lambda head: bool(re.search(rb"(?m)^(FIELDS|COLUMNS) ", head) and re.search(rb"(?m)^DATA ", head)),
    read_pcd,
)


# --- PLY: the vertices ----------------------------------------------------------------------------------

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_TYPES |= {"float": "f4", "double": "f8"}
_TYPES |= {np.dtype(kind).name: kind for kind in _TYPES.values()}
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_ply(path: Path) -> Float:
    """Read the vertices [N, 3] of a PLY."""
    lines, body = split_header(path, read_bytes(path), "end_header")
    encoding, elements = _ply_header(path, lines)
    names = [name for name, _, _ in elements]
    if "vertex" not in names:
        raise empty(path, "has no vertices")
    earlier, (_, count, properties) = elements[: names.index("vertex")], elements[names.index("vertex")]
    if not {"x", "y", "z"} <= properties.keys() or "list" in properties.values() or not count:
        stated = " ".join(properties)[:100]
        raise _bad_header(
            path, f"its {count} vertices have {stated or 'nothing'}; x, y, z and no lists are needed"
        )
    if encoding == "ascii":
        columns = [list(properties).index(axis) for axis in "xyz"]
        return _written(path, body, sum(number for _, number, _ in earlier), count, columns)
    if any("list" in each.values() for _, _, each in earlier):
        raise DataError(path, "has lists before its vertices", "export it with the vertices first")
    order = _BYTE_ORDERS[encoding]
    start = sum(number * sum(int(kind[1:]) for kind in each.values()) for _, number, each in earlier)
    record = np.dtype([(name, f"{order}{kind}") for name, kind in properties.items()])
    rows = _records(path, body[min(start, len(body)) :], count, record)
    return _joined([rows[axis] for axis in "xyz"])


def _ply_header(path: Path, lines: list[list[str]]) -> tuple[str, list[tuple[str, int, dict[str, str]]]]:
    """Return the encoding, and name, count and properties (numpy type, or list) of each element."""
    encoding, elements = "", list[tuple[str, int, dict[str, str]]]()
    for words in lines:
        match words:
            case ["format", stated, "1.0"] if stated in _BYTE_ORDERS:
                encoding = stated
            case ["element", name, count] if count.isdecimal() and len(count) < 19:
                elements.append((name, int(count), {}))
            case ["property", "list", length, item, name] if elements and {length, item} <= set(_TYPES):
                elements[-1][2][name] = "list"
            case ["property", kind, name] if elements and kind in _TYPES and name not in elements[-1][2]:
                elements[-1][2][name] = _TYPES[kind]
            case ["ply"] | ["end_header"] | ["comment", *_] | ["obj_info", *_]:
                pass
            case _:
                raise _bad_header(path, " ".join(words))
    if lines[0] != ["ply"] or not encoding:
        first = "its first lines must be `ply` and `format`"
        raise DataError(path, "is no PLY file of version 1.0", first, code="wrong-kind")
    return encoding, elements


PLY = CloudFile(
    "ply", "point cloud (PLY)", (".ply",), lambda head: head[:16].split(b"\n")[0].strip() == b"ply", read_ply
)


# --- LAS and LAZ (ASPRS, 1.0 to 1.4) by laspy, read in chunks -----------------------------------------------
#
# Points that the file marks as noise (classes 7 and 18) or as withheld are left out and counted. Coordinates
# are those of the file's reference system: usually a map projection, which the file may name.

# So many bytes of points are read at a time, which with their coordinates takes some 100 MB.
_CHUNK_BYTES = 30_000_000
_NOISE = (7, 18)  # low and high noise of ASPRS
_GEO_KEYS = (3072, 2048)  # GeoTIFF: the projected, or else the geographic system's EPSG number
# A variable length record of LAS has at least this many bytes.
_RECORD = 54
# GeoTIFF means by this number that the system has no number.
_USER_DEFINED = 32767


class LasFormat(MapFile):
    """Reader of the points of all returns; a LAS that is cut off gives the points that it still holds."""

    name = "las"
    title = "point cloud (LAS, LAZ)"
    suffixes: tuple[str, ...] = (".las", ".laz")

    def recognises(self, path: Path) -> bool:
        """Return True if the file begins with the signature of LAS."""
        return first_bytes(path, 4) == b"LASF"

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read points as voxels: occupied (1.0) with a point in it, else unknown; 0.2 m unless stated."""
        header, voxels = _header(path), VoxelSet(path, resolution_m)
        lost = _add_points(path, header, voxels)
        found = voxels.occupancy()
        return replace(found, dropped=found.dropped | lost, crs=crs_of(header))


def _header(path: Path) -> Any:
    """Read the header; refuse one with more records than the file has room for, as laspy looks for each."""
    laspy = need("laspy", "las")
    head = first_bytes(path, 375)
    counts = [int.from_bytes(head[place : place + 4], "little") for place in (100, 243)]
    counts = counts if head[25:26] >= b"\x04" and len(head) >= 375 else counts[:1]
    size = path.stat().st_size
    first_point = int.from_bytes(head[96:100], "little")
    if len(head) < 227 or first_point > size:
        raise damaged(path, f"is cut off within its header ({size} bytes)")
    if first_point < 227 or sum(counts) * _RECORD > size:
        problem = f"states {sum(counts)} records and points from byte {first_point} on, in {size} bytes"
        raise damaged(path, problem)
    try:
        with path.open("rb") as file:
            return laspy.LasHeader.read_from(file, read_evlrs=True)
    except Exception as error:  # laspy raises whatever it meets in a damaged header
        raise damaged(path, f"laspy cannot read it ({str(error)[:100]})") from error


def _add_points(path: Path, header: Any, voxels: VoxelSet) -> dict[str, int]:
    laspy = need("laspy", "las")
    lost: Counter[str] = Counter()
    read, stated = 0, int(header.point_count)
    if header.are_points_compressed and not laspy.LazBackend.detect_available():
        problem = "is compressed (LAZ), and lazrs is not installed"
        raise DataError(path, problem, f"run `{install_command('las')}`", code="missing-library")
    there = stated
    if not header.are_points_compressed:
        room = path.stat().st_size - header.offset_to_point_data
        there = max(0, min(stated, room // header.point_format.size))
    chunk_points = max(1, _CHUNK_BYTES // header.point_format.size)
    try:
        if header.are_points_compressed:
            _refuse_damaged_chunks(path, header)
        # In one thread: threads of the decompressor do not survive a fork.
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as cloud:
            while read < there and len(chunk := cloud.read_points(min(chunk_points, there - read))):
                read += len(chunk)
                bad = np.isin(np.asarray(chunk.classification), _NOISE)
                hidden = np.asarray(chunk.withheld).astype(bool) & ~bad
                with np.errstate(over="ignore", invalid="ignore"):  # a damaged scale: the box is then refused
                    points = np.stack([np.asarray(chunk[axis], dtype=np.float64) for axis in "xyz"], axis=1)
                voxels.add(points[~bad & ~hidden])
                lost["points marked as noise"] += int(bad.sum())
                lost["points marked as withheld"] += int(hidden.sum())
    except (DataError, KeyboardInterrupt, MemoryError, SystemExit):
        raise
    except BaseException as error:  # panics of the decompressor have the base of all exceptions
        if not read:
            raise damaged(path, f"laspy cannot read it ({str(error)[:100]})") from error
    lost["points cut off"] = stated - read
    return dict(+lost)


# Layers of an item of point formats 6 to 10 by its number (LASzip); of extra bytes, one for each byte.
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}


def _refuse_damaged_chunks(path: Path, header: Any) -> None:
    """Refuse a LAZ whose chunks or their layers are larger than it: lazrs takes memory for them or aborts."""
    lazrs, size = need("lazrs", "las"), path.stat().st_size
    record = next(vlr.record_data for vlr in header.vlrs if type(vlr).__name__ == "LasZipVlr")
    items = np.frombuffer(record[34:], "<u2").reshape(-1, 3)[:, :2].tolist()
    layers = sum(_LAYERS.get(kind, width) for kind, width in items) if items[0][0] in _LAYERS else 0
    first = header.offset_to_point_data

    def number_at(place: int) -> int:
        file.seek(place)
        return int.from_bytes(file.read(8), "little", signed=True)

    with path.open("rb") as file:
        table = number_at(first)
        # A writer that cannot go back puts the place of the table at the end.
        table = number_at(size - 8) if table < 0 else table
        stated = (number_at(table) >> 32 & 0xFFFFFFFF) * header.point_format.size
        place = first + 8
        file.seek(first)
        chunks = lazrs.read_chunk_table(file, lazrs.LazVlr(record)) if stated <= size else []
        for _, length in chunks or [(0, 0)]:
            file.seek(place + header.point_format.size + 4)
            sizes = np.frombuffer(file.read(4 * layers), "<u4")
            stated = max(stated, place - first + length, int(sizes.sum()))
            place += length
    if stated > size:
        raise damaged(path, f"states chunks of {stated} bytes in {size}")


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
