"""The occupancy map that a survey of the world would give."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool
from pipelines.session.records import Occupancy
from pipelines.simulation import scenario
from pipelines.simulation.world import kernels
from pipelines.simulation.world.obstacles import Obstacles
from pipelines.simulation.world.terrain import Terrain

_TOUCH_M = 1e-9  # level ground on the border between two voxels fills the lower one alone
_FINE_ENOUGH = 0.05  # of a voxel: allowed rise of the ground between samples
_MOST_SAMPLES = 16  # along a voxel


def map_world(
    ground: scenario.Ground,
    terrain: Terrain,
    obstacles: Obstacles,
    *,
    resolution_m: float,
    height_m: float,
) -> Occupancy:
    """Return voxels over the ground's square: 1 occupied, 0 free.

    They reach from one voxel below z = 0 up to `height_m`.

    A voxel is occupied if the inside of a solid and of the voxel have a point in common. The test is exact
    for trunks, crowns and slabs. Over mounds it errs towards occupied: a voxel counts as soon as the ground
    could reach into it, by the sampled heights and the curvature. This is at most 5 % of a voxel too early,
    unless a mound is narrower than a tenth of a voxel. Voxels lie on multiples of `resolution_m`.
    """
    half = ground.size_m / 2
    middle = np.array(ground.centre)
    first = np.floor((middle - half) / resolution_m + _TOUCH_M).astype(np.int64)
    end = np.ceil((middle + half) / resolution_m - _TOUCH_M).astype(np.int64)
    low = np.array([*first, -1], dtype=np.int64)
    shape = (*(end - first).tolist(), 1 + math.ceil(height_m / resolution_m - _TOUCH_M))
    grid = _filled_ground(terrain, low, shape, resolution_m)
    kernels.mark_trees(grid, low, resolution_m, obstacles.trunks, obstacles.crowns)
    kernels.mark_slabs(grid, low, resolution_m, obstacles.slabs)
    origin = low.astype(np.float64) * resolution_m
    return Occupancy(grid.astype(np.float32), origin, resolution_m)


def _filled_ground(
    terrain: Terrain, low: NDArray[np.int64], shape: tuple[int, int, int], side_m: float
) -> Bool:
    # Between the corners of a square of side s a surface rises above them by at most curvature s^2 / 4:
    # linear interpolation errs by curvature r^2 / 2 within the circle of radius r = s / sqrt(2) around it.
    samples = math.ceil(math.sqrt(terrain.curvature * side_m / 4 / _FINE_ENOUGH))
    samples = min(max(samples, 1), _MOST_SAMPLES)
    margin = terrain.curvature * (side_m / samples) ** 2 / 4
    floor = (low[2] + np.arange(shape[2])) * side_m
    y = low[1] * side_m + np.arange(shape[1] * samples + 1) * (side_m / samples)
    grid = np.empty(shape, dtype=np.bool_)
    for i in range(shape[0]):
        x = (low[0] + i) * side_m + np.arange(samples + 1) * (side_m / samples)
        height = terrain.height(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)).max(axis=0)
        columns = [height[k : k + shape[1] * samples : samples] for k in range(samples + 1)]
        top = np.maximum.reduce(columns) + margin
        grid[i] = floor < top[:, None] - _TOUCH_M
    return grid
