"""LAS and LAZ point clouds (ASPRS, 1.0 to 1.4) by laspy, read in chunks.

Points that the file marks as noise (classes 7 and 18) or as withheld are left out and counted. Coordinates
are those of the file's reference system: usually a map projection, which the file may name.

LAZ is decompressed into a temporary LAS by a process of its own, which this module runs as its main program:
the decompressor, which is compiled, aborts its process on some damaged files.
"""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pipelines.formats.common.files import first_bytes
from pipelines.formats.maps.voxel_grids import VoxelSet
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.records import Occupancy
from pipelines.session.registries import install_command, need

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


FORMAT = LasFormat()

if __name__ == "__main__":
    _decompress(Path(sys.argv[1]), Path(sys.argv[2]))
