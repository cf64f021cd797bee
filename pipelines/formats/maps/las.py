"""LAS and LAZ point clouds (ASPRS, 1.0 to 1.4) by laspy, read in chunks.

Points that the file marks as noise (classes 7 and 18) or as withheld are left out and counted. Coordinates
are those of the file's reference system: usually a map projection, which the file may name.

LAZ is decoded by a process of its own, which this module runs as its main program: the decompressor, which
is compiled, aborts its process on some damaged files. What it decoded until then is used.
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np

from pipelines.formats.common.files import first_bytes
from pipelines.formats.maps.voxel_grids import DEFAULT_RESOLUTION_M
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.maps import check_resolution, check_size
from pipelines.session.records import Occupancy
from pipelines.session.registries import install_command, need

_CHUNK = 1_000_000  # points
_NOISE = (7, 18)  # low and high noise of ASPRS
_GEO_KEYS = (3072, 2048)  # GeoTIFF: the projected, or else the geographic system's EPSG number
_RECORD = 54  # bytes of the shortest variable length record
_USER_DEFINED = 32767
_COPY = "copy it again, or export it again"

# Limits of the process that decodes LAZ: no chunk needs more memory, and no file as much time.
_MOST_BYTES = 4 << 30
_LEAST_CPU_S, _SLOWEST_BYTES_PER_S = 60, 200_000
_BLOCK = struct.Struct("<3Q")  # what comes before its points: their number, points of noise, withheld ones


class LasFormat:
    """Reader of the points of all returns; a file that is cut off gives the points that it still holds."""

    name = "las"
    title = "point cloud (LAS, LAZ)"
    suffixes: tuple[str, ...] = (".las", ".laz")

    def recognises(self, path: Path) -> bool:
        """Return True if the file begins with the signature of LAS."""
        return first_bytes(path, 4) == b"LASF"

    def describe(self, path: Path) -> dict[str, object]:
        """Describe version, points, box, classes and the coordinate reference system."""
        box = _Box()
        with _opened(path) as cloud:
            dropped = cloud.hand_over(box.add)
        facts: dict[str, object] = {**cloud.facts, "crs": cloud.crs or "not stated"}
        facts["finite_points"] = box.count
        facts |= {f"dropped: {cause}": count for cause, count in dropped.items()}
        if box.count:
            facts["points_box_min_m"] = [round(v, 4) for v in box.low.tolist()]
            facts["points_box_max_m"] = [round(v, 4) for v in box.high.tolist()]
        return facts

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read points as voxels: occupied (1.0) with a point in it, else unknown; 0.2 m unless stated.

        The file is read twice, first for the box of the points, so that memory grows with the voxels only.
        """
        side = check_resolution(path, DEFAULT_RESOLUTION_M if resolution_m is None else resolution_m)
        box = _Box()
        with _opened(path) as cloud:
            dropped = cloud.hand_over(box.add)
        if not box.count:
            raise DataError(path, "holds no point that can be used", _COPY)
        with np.errstate(over="ignore", invalid="ignore"):  # coordinates of a damaged scale
            low = np.floor(box.low / side)
            cells = np.nan_to_num(np.floor(box.high / side) - low + 1, nan=np.inf)
            span = " x ".join(f"{v:.0f}" for v in box.high - box.low)
        shape = np.clip(cells, 1, 2**40).astype(np.int64)  # more is refused
        check_size(path, shape.tolist(), side, f"crop it (its box is {span} m)")
        grid = np.full(shape.tolist(), np.nan, dtype=np.float32)

        def fill(points: Float) -> None:
            grid[*(np.floor(points / side) - low).astype(np.int64).T] = 1.0

        with _opened(path) as cloud:
            cloud.hand_over(fill)
        return Occupancy(grid, low * side, side, dropped=dropped, crs=cloud.crs)


class _Box:
    """Box of all points so far."""

    def __init__(self) -> None:
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self.count = 0

    def add(self, points: Float) -> None:
        if len(points):
            self.low = np.minimum(self.low, points.min(axis=0))
            self.high = np.maximum(self.high, points.max(axis=0))
            self.count += len(points)


@dataclass(frozen=True)
class _Block:
    """Usable points of a chunk, and the number of those that the file marks."""

    points: Float  # [N, 3]
    noise: int
    withheld: int


@dataclass
class _Cloud:
    """Open file: what its header says, and its points, which can be taken once."""

    facts: dict[str, object]
    crs: str | None
    blocks: Iterator[_Block] = field(repr=False)

    def hand_over(self, take: Callable[[Float], None]) -> dict[str, int]:
        """Hand over the usable points [N, 3] of each chunk; return counts of the others by cause."""
        read = noise = withheld = 0
        for block in self.blocks:
            take(block.points)
            noise, withheld = noise + block.noise, withheld + block.withheld
            read += len(block.points) + block.noise + block.withheld
        lost = {
            "points marked as noise": noise,
            "points marked as withheld": withheld,
            "points cut off": int(str(self.facts["points"])) - read,
        }
        return {cause: count for cause, count in lost.items() if count}


@contextmanager
def _opened(path: Path) -> Iterator[_Cloud]:
    laspy = need("laspy", "las")
    _refuse_impossible_records(path)
    if first_bytes(path, 105)[104] & 0xC0 != 0x80:  # the bit of LAZ
        with _opened_here(path) as cloud:
            yield cloud
        return
    if not laspy.LazBackend.detect_available():
        remedy = f"run `{install_command('las')}`"
        raise DataError(
            path, "is compressed (LAZ), and lazrs is not installed", remedy, code="missing-library"
        )
    pipe, silent = subprocess.PIPE, subprocess.DEVNULL
    with subprocess.Popen(_decoder(path), stdin=silent, stdout=pipe, stderr=silent) as process:  # noqa: S603
        assert process.stdout is not None  # noqa: S101
        try:
            yield _received(path, process.stdout, process)
        finally:
            process.kill()


def _decoder(path: Path) -> list[str]:
    # -P: a folder that happens to be called like a package here must not be imported.
    return [sys.executable, "-P", "-m", __name__, str(path.absolute())]


def _received(path: Path, pipe: IO[bytes], process: subprocess.Popen[bytes]) -> _Cloud:
    """Return the file as the process that decodes it describes it."""
    line = pipe.readline()
    if not line.endswith(b"\n"):
        status = process.wait()
        raise DataError(
            path,
            f"cannot be decompressed (the decompressor ended with status {status})",
            _COPY,
            code="damaged",
        )
    stated = json.loads(line)
    if "problem" in stated:
        raise DataError(path, stated["problem"], _COPY)
    return _Cloud(stated["facts"], stated["crs"], _received_blocks(pipe))


def _received_blocks(pipe: IO[bytes]) -> Iterator[_Block]:
    while len(head := pipe.read(_BLOCK.size)) == _BLOCK.size:
        count, noise, withheld = _BLOCK.unpack(head)
        content = pipe.read(count * 24)
        if len(content) < count * 24:
            return
        yield _Block(np.frombuffer(content, np.float64).reshape(-1, 3), noise, withheld)


def _send(path: Path, pipe: IO[bytes]) -> None:
    """Decode a file for the process that waits at the pipe: a line of JSON, then its blocks."""
    import resource

    seconds = _LEAST_CPU_S + path.stat().st_size // _SLOWEST_BYTES_PER_S
    for kind, most in ((resource.RLIMIT_DATA, _MOST_BYTES), (resource.RLIMIT_CPU, seconds)):
        _, hard = resource.getrlimit(kind)
        resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
    try:
        with _opened_here(path) as cloud:
            pipe.write(json.dumps({"facts": cloud.facts, "crs": cloud.crs}).encode() + b"\n")
            for block in cloud.blocks:
                pipe.write(_BLOCK.pack(len(block.points), block.noise, block.withheld))
                pipe.write(np.ascontiguousarray(block.points).tobytes())
    except DataError as error:
        pipe.write(json.dumps({"problem": error.problem}).encode() + b"\n")


@contextmanager
def _opened_here(path: Path) -> Iterator[_Cloud]:
    laspy = need("laspy", "las")
    try:
        cloud = laspy.open(path)
    # The decompressor raises whatever it meets in a damaged header, its panics by the base of all exceptions.
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        raise DataError(path, f"laspy cannot read it ({str(error)[:100]})", _COPY) from error
    with cloud:
        header = cloud.header
        facts: dict[str, object] = {
            "version": f"{header.version.major}.{header.version.minor}",
            "point_format": int(header.point_format.id),
            "compressed": bool(header.are_points_compressed),
            "points": int(header.point_count),
        }
        yield _Cloud(facts, crs_of(header), _blocks(path, cloud))


def _refuse_impossible_records(path: Path) -> None:
    """Refuse a header with more records than the file has room for: laspy would look for each of them."""
    head = first_bytes(path, 375)
    counts = [int.from_bytes(head[place : place + 4], "little") for place in (100, 243)]
    counts = counts if head[25:26] >= b"\x04" and len(head) >= 375 else counts[:1]
    size = path.stat().st_size
    first_point = int.from_bytes(head[96:100], "little")
    if len(head) < 227 or first_point > size:
        raise DataError(path, f"is cut off within its header ({size} bytes)", _COPY, code="damaged")
    if first_point < 227:
        raise DataError(path, f"has points from byte {first_point} on, within its header", _COPY)
    if sum(counts) * _RECORD > size:
        raise DataError(
            path, f"has a header that states {sum(counts)} records, more than it has room for", _COPY
        )


def _blocks(path: Path, cloud: Any) -> Iterator[_Block]:
    header = cloud.header
    there = int(header.point_count)
    if not header.are_points_compressed:
        room = path.stat().st_size - header.offset_to_point_data
        there = max(0, min(there, room // header.point_format.size))
    read = 0
    while read < there:
        try:
            chunk = cloud.read_points(min(_CHUNK, there - read))
        except BaseException as error:  # compressed points end where the file was cut, with any error
            if isinstance(error, KeyboardInterrupt):
                raise
            return
        if not len(chunk):
            return
        read += len(chunk)
        bad = np.isin(np.asarray(chunk.classification), _NOISE)
        hidden = np.asarray(chunk.withheld).astype(bool) & ~bad
        with np.errstate(over="ignore", invalid="ignore"):  # a damaged scale: the box is then refused
            points = np.stack([np.asarray(chunk[axis], dtype=np.float64) for axis in "xyz"], axis=1)
        yield _Block(points[~bad & ~hidden], int(bad.sum()), int(hidden.sum()))


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


FORMAT = LasFormat()

if __name__ == "__main__":
    try:
        _send(Path(sys.argv[1]), sys.stdout.buffer)
        sys.stdout.flush()
    except (BrokenPipeError, KeyboardInterrupt):  # who asked has ended
        os._exit(1)
