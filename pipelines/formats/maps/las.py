"""LAS and LAZ point clouds (ASPRS, 1.0 to 1.4) by laspy, read in chunks.

Points that the file marks as noise (classes 7 and 18) or as withheld are left out and counted. Coordinates
are those of the file's reference system: usually a map projection, which the file may name.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.formats.common.files import first_bytes
from pipelines.formats.maps.voxel_grids import DEFAULT_RESOLUTION_M
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.maps import check_resolution, check_size
from pipelines.session.records import Occupancy
from pipelines.session.registries import need

_CHUNK = 1_000_000  # points
_NOISE = (7, 18)  # low and high noise of ASPRS
_GEO_KEYS = (3072, 2048)  # GeoTIFF: the projected, or else the geographic system's EPSG number
_RECORD = 54  # bytes of the shortest variable length record
_USER_DEFINED = 32767
_COPY = "copy it again, or export it again"


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
        with _opened(path) as cloud:
            header = cloud.header
            facts: dict[str, object] = {
                "version": f"{header.version.major}.{header.version.minor}",
                "point_format": int(header.point_format.id),
                "compressed": bool(header.are_points_compressed),
                "points": int(header.point_count),
                "crs": crs_of(header) or "not stated",
            }
            box = _Box()
            dropped = _through(path, cloud, box.add)
        facts["finite_points"] = box.count
        facts |= {f"dropped: {cause}": count for cause, count in dropped.items()}
        if box.count:
            facts["points_box_min_m"] = [round(v, 4) for v in box.low.tolist()]
            facts["points_box_max_m"] = [round(v, 4) for v in box.high.tolist()]
        return facts

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read points as voxels: occupied (1.0) with a point in it, else unknown; 0.2 m unless stated.

        The file is read twice, first for the box of the points, so that memory grows with the voxels only.

        Raises:
            DataError: laspy is missing or cannot read it, no point is left, or the box is too large.
        """
        side = check_resolution(path, DEFAULT_RESOLUTION_M if resolution_m is None else resolution_m)
        box = _Box()
        with _opened(path) as cloud:
            dropped = _through(path, cloud, box.add)
        if not box.count:
            raise DataError(path, "holds no point that can be used", _COPY)
        low = np.floor(box.low / side)
        cells = np.nan_to_num(np.floor(box.high / side) - low + 1, nan=np.inf)
        shape = np.clip(cells, 1, 2**40).astype(np.int64)  # more is refused
        span = " x ".join(f"{v:.0f}" for v in box.high - box.low)
        check_size(
            path, shape.tolist(), side, f"crop it (its box is {span} m), or state a larger resolution_m"
        )
        grid = np.full(shape.tolist(), np.nan, dtype=np.float32)

        def fill(points: Float) -> None:
            grid[*(np.floor(points / side) - low).astype(np.int64).T] = 1.0

        with _opened(path) as cloud:
            _through(path, cloud, fill)
            crs = crs_of(cloud.header)
        return Occupancy(grid, low * side, side, dropped=dropped, crs=crs)


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


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    laspy = need("laspy", "las")
    _refuse_impossible_records(path)
    try:
        with laspy.open(path) as cloud:
            yield cloud
    except DataError:
        raise
    except Exception as error:  # laspy and its decompressor raise whatever they meet in a damaged header
        raise DataError(path, f"laspy cannot read it ({str(error)[:100]})", _COPY) from error


def _refuse_impossible_records(path: Path) -> None:
    """Refuse a header with more records than the file has room for: laspy would look for each of them."""
    head = first_bytes(path, 375)
    counts = [int.from_bytes(head[place : place + 4], "little") for place in (100, 243)]
    counts = counts if head[25:26] >= b"\x04" and len(head) >= 375 else counts[:1]
    if len(head) < 227 or sum(counts) * _RECORD > path.stat().st_size:
        raise DataError(path, f"has a header that is cut off or states {sum(counts)} records", _COPY)


def _through(path: Path, cloud: Any, take: Any) -> dict[str, int]:
    """Hand over the usable points [N, 3] of each chunk; return counts of the others by cause."""
    header = cloud.header
    stated = there = int(header.point_count)
    if not header.are_points_compressed:
        room = path.stat().st_size - header.offset_to_point_data
        there = max(0, min(stated, room // header.point_format.size))
    read = noise = withheld = 0
    while read < there:
        try:
            chunk = cloud.read_points(min(_CHUNK, there - read))
        except Exception:  # compressed points end where the file was cut, with any error
            break
        if not len(chunk):
            break
        read += len(chunk)
        bad = np.isin(np.asarray(chunk.classification), _NOISE)
        hidden = np.asarray(chunk.withheld).astype(bool) & ~bad
        noise, withheld = noise + int(bad.sum()), withheld + int(hidden.sum())
        points = np.stack([np.asarray(chunk[axis], dtype=np.float64) for axis in "xyz"], axis=1)
        take(points[~bad & ~hidden])
    lost = {
        "points marked as noise": noise,
        "points marked as withheld": withheld,
        "points cut off": stated - read,
    }
    return {cause: count for cause, count in lost.items() if count}


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
