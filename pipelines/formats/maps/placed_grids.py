"""Conversion of voxel grids and floor plans of one frame to the axes of the world.

A grid that is turned by a multiple of a right angle keeps its voxels: they are only counted along other axes.
For any other turn about the vertical the grid is sampled so densely that every voxel is met. A voxel takes
the largest probability met in it: a wall may grow by a voxel, but never vanishes. A tilted grid is refused.

A turn is rounded to the nearest of these if no voxel moves by more than half its side, because
counting in voxels rounds by as much anyway.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import matrix_from_quaternion
from pipelines.session.errors import DataError
from pipelines.session.maps import check_size
from pipelines.session.records import Occupancy

Pose = tuple[Float, Float]
"""Position [3] and quaternion [4] of one frame in another."""

_UPSIDE_DOWN = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # its own inverse; NED to ENU and back
_SLAB_VALUES = 1 << 22  # values of a turned grid that are sampled at a time


def placed(
    source: str, grid: Occupancy, world_from_grid: Pose, *, resolution_m: float | None = None
) -> Occupancy:
    """Convert a voxel grid to the world's axes.

    Args:
        source: the log and topic, for messages.
        grid: its origin and axes are those of its frame.
        world_from_grid: the pose of that frame.
        resolution_m: another side for the voxels, for a grid of one layer.

    Raises:
        DataError: the grid is tilted, or too large once it is turned.
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
    source: str,
    plan: NDArray[np.float32],
    resolution_m: float,
    world_from_plan: Pose,
    *,
    side_m: float,
    height_m: float,
) -> Occupancy:
    """Convert a floor plan to the world's axes, extruded upwards from its own plane.

    Args:
        source: the log and topic, for messages.
        plan: probabilities [X, Y], the corner of the first at the plan's origin.
        resolution_m: the side of its cells.
        world_from_plan: the pose of its origin.
        side_m: of the voxels.
        height_m: height of the cells, rounded up to whole voxels.

    Raises:
        DataError: the plan is tilted, or the grid too large.
    """
    position, quaternion = world_from_plan
    rotation = matrix_from_quaternion(quaternion)
    if abs(rotation[2, 2]) < 0.5:  # on edge: `placed` would turn it squarely
        raise _tilted(source, rotation)
    layer = Occupancy(plan[:, :, None], np.array([0.0, 0.0, -resolution_m / 2]), resolution_m)
    layers = max(1, math.ceil(height_m / side_m - 1e-6))  # 3.0000001 voxels count as three
    sides = [*(math.ceil(cells * resolution_m / side_m) for cells in plan.shape), layers]
    check_size(source, sides, side_m, f"state resolution_m: {2 * side_m:g} or more")
    flat = placed(source, layer, world_from_plan, resolution_m=side_m)
    check_size(source, [*flat.probability.shape[:2], layers], side_m, "state a larger resolution_m")
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
    """Turn by a rotation [2, 2] about the vertical axis through the origin of its frame.

    Samples form a square lattice of pitch p with the covering radius p / sqrt(2). The disc within a
    voxel has half its side as radius. So every voxel is met if p is at most 1 / sqrt(2) of a voxel.
    """
    columns, rows, layers = grid.probability.shape
    extent = np.array([columns, rows]) * grid.resolution_m
    corners = (grid.origin[:2] + np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * extent) @ world_from_plane.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    x_count, y_count = np.maximum(np.ceil((high - low) / side - 1e-6).astype(int), 1).tolist()
    check_size(source, [x_count, y_count, layers], side, "state a larger resolution_m")
    turned = np.full((x_count, y_count, layers), np.nan, dtype=np.float32)
    dense = math.ceil(math.sqrt(2) * side / grid.resolution_m)
    within = (np.arange(dense) + 0.5) / dense
    step = max(1, _SLAB_VALUES // (y_count * layers))
    y = low[1] + (np.arange(y_count)[:, None] + within) * side  # [Y, dense]
    for first in range(0, x_count, step):
        slab = turned[first : first + step]
        x = low[0] + (np.arange(first, first + len(slab))[:, None] + within) * side
        for at_x in x.T:
            for at_y in y.T:
                met = _looked_up(grid, world_from_plane, at_x[:, None], at_y[None, :])
                np.fmax(slab, met, out=slab)
    return Occupancy(turned, np.array([*low, grid.origin[2]]), side)


def _looked_up(grid: Occupancy, world_from_plane: Float, x: Float, y: Float) -> NDArray[np.float32]:
    """Look up the columns of voxels [X, Y, Z] at x [X, 1] and y [1, Y] in the world's axes; NaN outside."""
    (c, minus_s), _ = world_from_plane
    column = np.floor((c * x - minus_s * y - grid.origin[0]) / grid.resolution_m).astype(np.int64)
    row = np.floor((c * y + minus_s * x - grid.origin[1]) / grid.resolution_m).astype(np.int64)
    columns, rows, _ = grid.probability.shape
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    found = grid.probability[np.where(inside, column, 0), np.where(inside, row, 0)]
    found[~inside] = np.nan
    return found
