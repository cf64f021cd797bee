"""Voxel grids: of point clouds, and of grids and floor plans that lie turned in the world."""

import math
import zipfile
from abc import ABC, abstractmethod
from collections import Counter
from pathlib import Path

import numpy as np

from pipelines.geometry.arrays import Float, Float32, Int64
from pipelines.geometry.poses import matrix_from_quaternion
from pipelines.session.errors import DataError
from pipelines.session.maps import MapSizeError, check_resolution, check_size, describe_map, read_grid
from pipelines.session.records import Occupancy
from pipelines.session.storage import empty

# Drones keep a greater distance, and a site of 200 m fits the memory.
DEFAULT_RESOLUTION_M = 0.2

# Three indices of so many bits fit an int64.
_BITS = 20
# A voxel's index fits its bits up to this many voxels from the first point.
_REACH = 1 << (_BITS - 1)
# A damaged number must not be the first point; coordinates of maps on Earth have fewer voxels.
_FARTHEST = 1 << 40
Pose = tuple[Float, Float]
"""Position [3] and quaternion [4] of one frame in another."""
_UPSIDE_DOWN = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # its own inverse; NED to ENU and back
# So many values of a turned grid are sampled at a time, which bounds the memory.
_SLAB_VALUES = 1 << 22


class MapFile(ABC):
    """Base of the readers of maps: they are described alike."""

    @abstractmethod
    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read the map, as `registries.MapFormat` says."""

    def describe(self, path: Path) -> dict[str, object]:
        """Describe box and voxels at the resolution that is read by default, and losses."""
        try:
            grid = self.read_map(path)
        except MapSizeError as error:
            return {"voxels": f"{error.problem}; {error.remedy}"}
        named = {} if grid.crs is None else {"crs": grid.crs}
        return describe_map(grid) | named | {f"dropped: {cause}": n for cause, n in grid.dropped.items()}


class VoxelSet:
    """Voxels of clouds, each with the earliest time of a point in it; corners are multiples of the side."""

    def __init__(self, source: Path | str, resolution_m: float | None) -> None:
        self._source = source
        self._side = check_resolution(source, DEFAULT_RESOLUTION_M if resolution_m is None else resolution_m)
        self._first: Int64 | None = None  # the voxel from which the others are counted
        self._keys: Int64 = np.zeros(0, np.int64)  # sorted
        self._since_ns: Int64 = np.zeros(0, np.int64)
        self._low, self._high = np.full(3, _REACH, np.int64), np.full(3, -_REACH, np.int64)
        self.dropped: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._keys)

    def add(self, points: Float, t_ns: int = 0) -> None:
        """Add the points [N, 3] of one time, count bad ones; MapSizeError if there are too many voxels."""
        usable = np.isfinite(points).all(axis=1)
        with np.errstate(over="ignore", invalid="ignore"):
            place = np.floor(points / self._side)
            usable_here = place[usable & (np.abs(place) < _FARTHEST).all(axis=1)]
            if self._first is None and len(usable_here):
                self._first = usable_here[0].astype(np.int64)
            place = place - (0 if self._first is None else self._first)
            near = usable & (np.abs(place) < _REACH).all(axis=1)
        self.dropped["points that are not finite"] += int((~usable).sum())
        self.dropped[f"points beyond {_REACH * self._side:g} m of the first"] += int((usable & ~near).sum())
        index = place[near].astype(np.int64)
        if not len(index):
            return
        self._low = np.minimum(self._low, index.min(axis=0))
        self._high = np.maximum(self._high, index.max(axis=0))
        check_size(self._source, self.shape, self._side, "crop stray points")
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
    def grew_ns(self) -> Int64:
        """Times at which new voxels appeared, ascending; empty while there is no voxel."""
        return np.unique(self._since_ns)

    def occupancy(self, at_ns: int = 0) -> Occupancy:
        """Return the map of all points up to a time, valid from then; DataError if there is none."""
        if self._first is None:
            raise empty(self._source, "holds no point that is finite")
        keys = self._keys[self._since_ns <= at_ns]
        mask = (1 << _BITS) - 1
        index = np.stack([keys >> 2 * _BITS, (keys >> _BITS) & mask, keys & mask], axis=1) - _REACH
        grid = np.full(self.shape, np.nan, dtype=np.float32)
        grid[*(index - self._low).T] = 1.0
        origin = (self._low + self._first).astype(np.float64) * self._side
        return Occupancy(grid, origin, self._side, at_ns, dropped=dict(+self.dropped))


def placed(
    source: str, grid: Occupancy, world_from_grid: Pose, *, resolution_m: float | None = None
) -> Occupancy:
    """Convert a voxel grid in its own frame to the world's axes.

    Turned by a multiple of a right angle it keeps its voxels; any turn is rounded to one if no voxel moves by
    more than half its side. For any other turn about the vertical it is sampled so densely that every voxel
    is met, and a voxel takes the largest probability met in it. `resolution_m` is another side, for a grid of
    one layer.
    """
    position, quaternion = world_from_grid
    rotation = matrix_from_quaternion(quaternion)
    side = grid.resolution_m if resolution_m is None else resolution_m
    nearest = np.rint(rotation)
    is_square = (np.abs(nearest).sum(axis=0) == 1).all() and (np.abs(nearest).sum(axis=1) == 1).all()
    if is_square and side == grid.resolution_m and _moves_little(grid, rotation - nearest):
        return _moved(_squarely_turned(grid, nearest), position + (rotation - nearest) @ _centre(grid))
    if rotation[2, 2] < 0:
        grid, rotation = _squarely_turned(grid, _UPSIDE_DOWN), rotation @ _UPSIDE_DOWN
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    c, s = math.cos(yaw), math.sin(yaw)
    level = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    if not _moves_little(grid, rotation - level):
        raise _tilted(source, rotation)
    return _moved(_turned(source, grid, level[:2, :2], side), position + (rotation - level) @ _centre(grid))


def extruded(
    source: str, plan: Float32, resolution_m: float, world_from_plan: Pose, *, side_m: float, height_m: float
) -> Occupancy:
    """Extrude a floor plan [X, Y] of probabilities upwards by `height_m`, rounded up to whole voxels."""
    position, quaternion = world_from_plan
    rotation = matrix_from_quaternion(quaternion)
    if abs(rotation[2, 2]) < 0.5:  # on edge: `placed` would turn it squarely
        raise _tilted(source, rotation)
    layer = Occupancy(plan[:, :, None], np.array([0.0, 0.0, -resolution_m / 2]), resolution_m)
    layers = max(1, math.ceil(height_m / side_m - 1e-6))  # 3.0000001 voxels count as three
    sides = [*(math.ceil(cells * resolution_m / side_m) for cells in plan.shape), layers]
    check_size(source, sides, side_m)
    flat = placed(source, layer, world_from_plan, resolution_m=side_m)
    check_size(source, [*flat.probability.shape[:2], layers], side_m)
    floor_m = (rotation @ _centre(layer) + position)[2]
    return Occupancy(
        np.repeat(flat.probability, layers, axis=2), np.array([*flat.origin[:2], floor_m]), side_m
    )


def _tilted(source: str, rotation: Float) -> DataError:
    tilt_deg = math.degrees(math.acos(min(abs(rotation[2, 2]), 1.0)))
    return DataError(
        source,
        f"its map is tilted by {tilt_deg:.3g} deg, a grid is only turned about the vertical",
        "give it in a level frame",
    )


def _centre(grid: Occupancy) -> Float:
    return grid.origin + np.array(grid.probability.shape) * grid.resolution_m / 2


def _moved(grid: Occupancy, translation: Float) -> Occupancy:
    return Occupancy(grid.probability, grid.origin + translation, grid.resolution_m)


def _moves_little(grid: Occupancy, difference: Float) -> bool:
    """Return True if no voxel moves by over half a side between two rotations of this difference."""
    half = np.array(grid.probability.shape) * grid.resolution_m / 2
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8)
    apart = np.linalg.norm(difference @ (signs * half[:, None]), axis=0)
    return bool(apart.max() <= grid.resolution_m / 2)


def _squarely_turned(grid: Occupancy, rotation: Float) -> Occupancy:
    """Turn by a rotation whose rows and columns each have one entry, 1 or -1."""
    axes = np.abs(rotation).argmax(axis=1)
    backward = rotation.sum(axis=1) < 0
    probability = grid.probability.transpose(axes)
    probability = probability[tuple(slice(None, None, -1 if back else 1) for back in backward)]
    end = grid.origin + np.array(grid.probability.shape) * grid.resolution_m
    origin = np.where(backward, -end[axes], grid.origin[axes])
    return Occupancy(np.ascontiguousarray(probability), origin, grid.resolution_m)


def _turned(source: str, grid: Occupancy, world_from_plane: Float, side: float) -> Occupancy:
    """Turn by a rotation [2, 2] about the vertical axis through the origin of its frame."""
    columns, rows, layers = grid.probability.shape
    extent = np.array([columns, rows]) * grid.resolution_m
    corners = (grid.origin[:2] + np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * extent) @ world_from_plane.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    x_count, y_count = np.maximum(np.ceil((high - low) / side - 1e-6).astype(int), 1).tolist()
    check_size(source, [x_count, y_count, layers], side)
    turned = sampled(grid, world_from_plane, low, (x_count, y_count), side)
    return Occupancy(turned, np.array([*low, grid.origin[2]]), side)


def sampled(
    grid: Occupancy, world_from_plane: Float, low: Float, shape: tuple[int, int], side: float
) -> Float32:
    """Sample a grid that is turned about the vertical so densely that every voxel is met; [X, Y, Z].

    Samples form a square lattice of pitch p with the covering radius p / sqrt(2), so p is at most 1 / sqrt(2)
    of a voxel. `world_from_plane` [2, 2] turns about the origin of that frame, `low` [2] is the lowest corner
    of the result from there in the world's axes, `shape` and `side` are its voxels along x and y. NaN where
    nothing is met.
    """
    turned = np.full((*shape, grid.probability.shape[2]), np.nan, dtype=np.float32)
    dense = math.ceil(math.sqrt(2) * side / grid.resolution_m)
    within = (np.arange(dense) + 0.5) / dense
    step = max(1, _SLAB_VALUES // turned[0].size)
    y = low[1] + (np.arange(shape[1])[:, None] + within) * side  # [Y, dense]
    for first in range(0, shape[0], step):
        slab = turned[first : first + step]
        x = low[0] + (np.arange(first, first + len(slab))[:, None] + within) * side
        for at_x in x.T:
            for at_y in y.T:
                met = _looked_up(grid, world_from_plane, at_x[:, None], at_y[None, :])
                np.fmax(slab, met, out=slab)
    return turned


def _looked_up(grid: Occupancy, world_from_plane: Float, x: Float, y: Float) -> Float32:
    """Look up the columns of voxels [X, Y, Z] at x [X, 1] and y [1, Y] in the world's axes; NaN outside."""
    (c, minus_s), _ = world_from_plane
    column = np.floor((c * x - minus_s * y - grid.origin[0]) / grid.resolution_m).astype(np.int64)
    row = np.floor((c * y + minus_s * x - grid.origin[1]) / grid.resolution_m).astype(np.int64)
    columns, rows, _ = grid.probability.shape
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    found = grid.probability[np.where(inside, column, 0), np.where(inside, row, 0)]
    found[~inside] = np.nan
    return found


class GridNpz(MapFile):
    """Reader of a dense grid in its own voxels."""

    name = "npz"
    title = "voxel map (npz)"
    suffixes: tuple[str, ...] = (".npz",)

    def recognises(self, path: Path) -> bool:
        """Return True for an npz that holds a grid and its place."""
        if path.suffix.lower() not in self.suffixes or not path.is_file():
            return False
        try:
            with zipfile.ZipFile(path) as archive:
                names = set(archive.namelist())
        except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
            return False
        return "origin.npy" in names and bool(names & {"probability.npy", "occupancy.npy"})

    def read_map(self, path: Path, *, resolution_m: float | None = None) -> Occupancy:
        """Read the grid as it is."""
        occupancy = read_grid(path)
        if resolution_m is not None and not math.isclose(resolution_m, occupancy.resolution_m, rel_tol=1e-6):
            problem = f"its voxels are {occupancy.resolution_m:g} m, not {resolution_m:g} m"
            raise DataError(path, problem, "leave resolution_m out, or store the grid at that resolution")
        return occupancy


NPZ = GridNpz()
