"""Conversion of point clouds to voxel maps: a voxel with a point in it is occupied, all others are unknown.

A cloud gives the points that rays hit, not the space they passed through, so no voxel is free.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bytes, Float
from pipelines.session.errors import DataError
from pipelines.session.maps import MOST_VOXELS, check_resolution, check_size, describe_grid
from pipelines.session.records import Occupancy

DEFAULT_RESOLUTION_M = 0.2

_BITS = 20  # of a voxel's index along each axis, so that three fit an int64
_REACH = 1 << (_BITS - 1)  # voxels from the world's origin


def occupancy_of(source: Path | str, points: Float, resolution_m: float | None) -> Occupancy:
    """Make the voxels of a point cloud; their corners are whole multiples of the resolution.

    Args:
        source: the file or topic, for messages.
        points: [N, 3] metres; points that are not finite are left out and counted.
        resolution_m: the side of a voxel; None for 0.2 m.

    Raises:
        DataError: no finite point, an impossible resolution, or a box that is too large.
    """
    side = check_resolution(source, DEFAULT_RESOLUTION_M if resolution_m is None else resolution_m)
    finite, dropped = _finite(source, points)
    low, shape = _box(finite, side)
    remedy = f"crop stray points (its box is {_span(finite)} m), or state a larger resolution_m"
    check_size(source, shape.tolist(), side, remedy)
    grid = np.full(shape.astype(np.int64).tolist(), np.nan, dtype=np.float32)
    grid[*_indices(finite, low, side).T] = 1.0
    return Occupancy(grid, low * side, side, dropped=dropped)


class VoxelSet:
    """Voxels of many clouds, each with the earliest time of a point in it.

    Memory grows with the voxels, not with the points.

    Args:
        source: the log and topic, for messages.
        resolution_m: the side of a voxel; None for 0.2 m.

    Raises:
        DataError: an impossible resolution.
    """

    def __init__(self, source: str, resolution_m: float | None) -> None:
        self._source = source
        self._side = check_resolution(source, DEFAULT_RESOLUTION_M if resolution_m is None else resolution_m)
        self._keys: NDArray[np.int64] = np.zeros(0, np.int64)  # sorted
        self._since_ns: NDArray[np.int64] = np.zeros(0, np.int64)
        self._low, self._high = np.full(3, _REACH, np.int64), np.full(3, -_REACH, np.int64)
        self.dropped: Counter[str] = Counter()

    def add(self, points: Float, t_ns: int) -> None:
        """Add the points [N, 3] of one time; points that are not finite or too far are dropped and counted.

        Raises:
            DataError: the box of all voxels is too large.
        """
        usable = np.isfinite(points).all(axis=1)
        with np.errstate(over="ignore", invalid="ignore"):
            place = np.floor(points / self._side)
            near = usable & (np.abs(place) < _REACH).all(axis=1)
        self.dropped["points that are not finite"] += int((~usable).sum())
        self.dropped[f"points beyond {_REACH * self._side:g} m"] += int((usable & ~near).sum())
        index = place[near].astype(np.int64)
        if not len(index):
            return
        self._low = np.minimum(self._low, index.min(axis=0))
        self._high = np.maximum(self._high, index.max(axis=0))
        remedy = "state a larger resolution_m, or give a topic without stray points"
        check_size(self._source, self.shape, self._side, remedy)
        shifted = index + _REACH
        keys = np.unique((shifted[:, 0] << 2 * _BITS) | (shifted[:, 1] << _BITS) | shifted[:, 2])
        at = np.searchsorted(self._keys, keys)
        known = np.zeros(len(keys), dtype=np.bool_)
        if len(self._keys):
            known = self._keys[np.minimum(at, len(self._keys) - 1)] == keys
        self._since_ns[at[known]] = np.minimum(self._since_ns[at[known]], t_ns)
        self._keys = np.insert(self._keys, at[~known], keys[~known])
        self._since_ns = np.insert(self._since_ns, at[~known], t_ns)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Size in voxels of the box of all points along x, y, z."""
        x, y, z = np.maximum(self._high - self._low + 1, 0).tolist()
        return x, y, z

    @property
    def grew_ns(self) -> NDArray[np.int64]:
        """Times at which new voxels appeared, ascending; empty while there is no voxel."""
        return np.unique(self._since_ns)

    def occupancy(self, at_ns: int) -> Occupancy:
        """Return the map of all points up to a time, in the box of all voxels; it is valid from that time."""
        keys = self._keys[self._since_ns <= at_ns]
        mask = (1 << _BITS) - 1
        index = np.stack([keys >> 2 * _BITS, (keys >> _BITS) & mask, keys & mask], axis=1) - _REACH
        grid = np.full(self.shape, np.nan, dtype=np.float32)
        grid[*(index - self._low).T] = 1.0
        return Occupancy(grid, self._low.astype(np.float64) * self._side, self._side, at_ns)


def describe_points(source: Path | str, points: Float) -> dict[str, object]:
    """Describe points, their box and centre, and their map at 0.2 m (without building it).

    Raises:
        DataError: no finite point.
    """
    finite, dropped = _finite(source, points)
    side = DEFAULT_RESOLUTION_M
    low, shape = _box(finite, side)
    summary: dict[str, object] = {
        "points": len(points),
        "finite_points": len(finite),
        **{f"dropped: {cause}": count for cause, count in dropped.items()},
        "points_box_min_m": _rounded(finite.min(axis=0)),
        "points_box_max_m": _rounded(finite.max(axis=0)),
        "centroid_m": _rounded(finite.mean(axis=0)),
    }
    if not math.prod(shape.tolist()) <= MOST_VOXELS:
        return {**summary, "voxels": f"too many at {side:g} m: crop stray points or state resolution_m"}
    sides = shape.astype(np.int64)
    flat = np.ravel_multi_index(tuple(_indices(finite, low, side).T), tuple(sides.tolist()))
    occupied = len(np.unique(flat))
    return {**summary, **describe_grid(side, low * side, sides.tolist(), occupied=occupied, free=0)}


def packed_points(
    path: Path, body: Bytes, count: int, columns: dict[str, tuple[str, int]], stride: int
) -> Float:
    """Extract points [N, 3] from binary records.

    Args:
        path: the file, for messages.
        body: the bytes from the first record on; more may follow the last.
        count: number of records in the header.
        columns: numpy type and offset within a record, for each of x, y and z.
        stride: bytes of a record.

    Raises:
        DataError: the file ends before the last record.
    """
    check_count(path, count, len(body) // stride)
    names = ("x", "y", "z")
    record = np.dtype(
        {
            "names": names,
            "formats": [columns[name][0] for name in names],
            "offsets": [columns[name][1] for name in names],
            "itemsize": stride,
        }
    )
    rows = body[: count * stride].view(record)
    return joined([rows[name] for name in names])


def joined(columns: Sequence[NDArray[Any]]) -> Float:
    """Stack columns of any numeric type, [N, len(columns)]."""
    with np.errstate(invalid="ignore"):  # signalling NaNs of damaged floats warn; they are counted later
        return np.stack([column.astype(np.float64) for column in columns], axis=1)


def written_points(path: Path, body: Bytes, skipped: int, count: int, columns: tuple[int, int, int]) -> Float:
    """Parse points [N, 3] from rows of text.

    Args:
        path: the file, for messages.
        body: the text below the header.
        skipped: rows of other elements before the points.
        count: number of rows of points in the header.
        columns: indices of x, y and z in a row.

    Raises:
        DataError: fewer rows, or a cell that is missing or no number.
    """
    lines = (line.strip() for line in body.tobytes().decode("latin-1").split("\n"))
    rows = [line for line in lines if line][skipped:]
    check_count(path, count, len(rows))
    try:
        points = np.loadtxt(rows[:count], dtype=np.float64, comments=None, usecols=columns, ndmin=2)
    except ValueError as error:
        raise DataError(
            path, f"a row of points is damaged ({str(error)[:100]})", "export it again"
        ) from error
    return points


def check_count(path: Path, stated: int, there: int) -> None:
    """Refuse a cloud with fewer points than its header states.

    Raises:
        DataError: there are fewer.
    """
    if stated > there:
        raise DataError(
            path, f"breaks off: {there} of {stated} points are there", "copy it again or export it again"
        )


def _finite(source: Path | str, points: Float) -> tuple[Float, dict[str, int]]:
    usable = np.isfinite(points).all(axis=1)
    if not usable.any():
        raise DataError(source, f"none of its {len(points)} points is finite", "export it again")
    lost = int((~usable).sum())
    return (points[usable], {"not finite": lost}) if lost else (points, {})


def _box(points: Float, side: float) -> tuple[Float, Float]:
    """Return the lowest voxel, counted from the world's origin, and the number of voxels along each axis."""
    with np.errstate(over="ignore", invalid="ignore"):  # huge coordinates: `check_size` refuses them
        low, high = np.floor(points.min(axis=0) / side), np.floor(points.max(axis=0) / side)
        return low, high - low + 1


def _indices(points: Float, low: Float, side: float) -> NDArray[np.int64]:
    return (np.floor(points / side) - low).astype(np.int64)


def _span(points: Float) -> str:
    with np.errstate(over="ignore"):
        return " x ".join(f"{side:.4g}" for side in points.max(axis=0) - points.min(axis=0))


def _rounded(values: Float) -> list[float]:
    return [round(v, 4) for v in values.tolist()]
