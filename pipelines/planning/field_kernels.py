"""Compiled readers of the distance field: interpolation, and sight lines through it.

No threads and no fastmath: the same numbers give the same bytes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.compilation import cached, helper

# A point is at most half a diagonal from its voxel's centre. It is at most a whole one from the corners
# of the cell in which it is interpolated, and so are the corners from each other. In voxels:
DIAGONAL = math.sqrt(3.0)
ROUNDING = 1e-4  # margin of such bounds for single precision
BRICK = 4  # voxels along the side of one of `Sight.bricks`
_LONGEST_LEAP = 127  # seven bits


class Grid(NamedTuple):
    """A signed distance field, as the kernels take it."""

    distance_m: NDArray[np.float32]  # [X, Y, Z], at least two voxels along each axis
    origin: Float  # [3] m, the corner of voxel (0, 0, 0)
    resolution_m: float


class Sight(NamedTuple):
    """The field for sight lines: occupied voxels, and the distance within which all points are alike."""

    bricks: NDArray[np.uint8]
    """Bytes [X/4, Y/4, Z/4, 64] of bricks of 4 x 4 x 4 voxels, one cache line each: twice the leap, plus
    1 if occupied. All points within `leap` half voxels of any point of the voxel have its state."""
    size: tuple[int, int, int]  # of the grid


@helper
def _cell(coordinate: float, size: int, resolution: float) -> tuple[int, float, float]:
    """Return lower index, fraction and its derivative along one axis, clamped to the voxel centres."""
    index = coordinate / resolution - 0.5
    if not index > 0.0:
        return 0, 0.0, 0.0
    if index >= size - 1:
        return size - 2, 1.0, 0.0
    lower = int(index)
    return lower, index - lower, 1.0 / resolution


@helper
def interpolate(grid: Grid, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Interpolate the trilinear distance and its exact gradient; along a clamped axis it is zero."""
    d = grid.distance_m
    i, u, du = _cell(x - grid.origin[0], d.shape[0], grid.resolution_m)
    j, v, dv = _cell(y - grid.origin[1], d.shape[1], grid.resolution_m)
    k, w, dw = _cell(z - grid.origin[2], d.shape[2], grid.resolution_m)
    a00 = d[i, j, k] * (1.0 - w) + d[i, j, k + 1] * w
    a01 = d[i, j + 1, k] * (1.0 - w) + d[i, j + 1, k + 1] * w
    a10 = d[i + 1, j, k] * (1.0 - w) + d[i + 1, j, k + 1] * w
    a11 = d[i + 1, j + 1, k] * (1.0 - w) + d[i + 1, j + 1, k + 1] * w
    b00 = float(d[i, j, k + 1]) - d[i, j, k]
    b01 = float(d[i, j + 1, k + 1]) - d[i, j + 1, k]
    b10 = float(d[i + 1, j, k + 1]) - d[i + 1, j, k]
    b11 = float(d[i + 1, j + 1, k + 1]) - d[i + 1, j + 1, k]
    low, high = a00 * (1.0 - v) + a01 * v, a10 * (1.0 - v) + a11 * v
    value = low * (1.0 - u) + high * u
    gx = (high - low) * du
    gy = ((a01 - a00) * (1.0 - u) + (a11 - a10) * u) * dv
    gz = ((b00 * (1.0 - v) + b01 * v) * (1.0 - u) + (b10 * (1.0 - v) + b11 * v) * u) * dw
    return value, gx, gy, gz


@helper
def nearest(grid: Grid, x: float, y: float, z: float) -> float:
    """Return the distance stored for the voxel whose centre is nearest to a point."""
    d = grid.distance_m
    i = min(max(int((x - grid.origin[0]) / grid.resolution_m), 0), d.shape[0] - 1)
    j = min(max(int((y - grid.origin[1]) / grid.resolution_m), 0), d.shape[1] - 1)
    k = min(max(int((z - grid.origin[2]) / grid.resolution_m), 0), d.shape[2] - 1)
    return float(d[i, j, k])


@helper
def sampling(x: float, y: float, z: float, start_m: float, side_m: float, rule: Float) -> int:
    """Set the sampling of a sight line, in voxels of that side; return the number of samples.

    Samples are at most half a voxel apart.

    Args:
        x: m, the camera from the actor, as the next two.
        y: see there.
        z: see there.
        start_m: distance from the actor at which the line begins.
        side_m: of a voxel.
        rule: [11] is filled: the first sample from the actor, the step to the next, one over it by axis,
            all three in voxels; samples per metre; and the length of the line in m.
    """
    length = math.sqrt(x * x + y * y + z * z)
    rule[10] = length
    if length <= start_m:
        return 0
    count = math.ceil((length - start_m) / (0.5 * side_m) - 1e-9)
    step_m = (length - start_m) / count
    for axis, way in enumerate((x, y, z)):
        per_m = way / (length * side_m)
        rule[axis], rule[3 + axis] = per_m * (start_m + step_m / 2.0), per_m * step_m
        rule[6 + axis] = 1.0 / rule[3 + axis]
    rule[9] = 1.0 / step_m
    return count


@helper
def _samples_inside(first: float, per: float, size: int, low: float, high: float) -> tuple[float, float]:
    """Return the range of the samples `low` to `high` inside the grid along an axis.

    `per` is one over the step.
    """
    if math.isinf(per):
        return (low, high) if 0.0 <= first < size else (high, high)
    one, other = -first * per, (size - first) * per
    return max(low, min(one, other)), min(high, max(one, other))


@helper
def look(sight: Sight, x: float, y: float, z: float) -> tuple[int, int]:
    """Test if the voxel at a place (voxels) is occupied; return 0 or 1, and the leap in half voxels.

    Within the leap all points have the same state.
    """
    size = sight.size
    i = np.uintp(min(max(int(x), 0), size[0] - 1))
    j = np.uintp(min(max(int(y), 0), size[1] - 1))
    k = np.uintp(min(max(int(z), 0), size[2] - 1))
    within = (i % BRICK * BRICK + j % BRICK) * BRICK + k % BRICK
    byte = np.int64(sight.bricks[i // BRICK, j // BRICK, k // BRICK, within])  # signed, or sums become floats
    return int(byte & 1), int(byte >> 1)


@helper
def occupied_samples(
    sight: Sight, x: float, y: float, z: float, rule: Float, first: float, end: float
) -> int:
    """Count the samples `first` to `end` of a sight line that lie in occupied voxels.

    The line begins at an actor, x, y, z in voxels from the grid's corner. Samples are at most half a voxel
    apart, so that the next samples within a voxel's leap need no look. Samples are taken from both ends at
    once, because the processor can run two independent leaps in parallel.
    """
    x, y, z = x + rule[0], y + rule[1], z + rule[2]
    first, end = _samples_inside(x, rule[6], sight.size[0], first, end)
    first, end = _samples_inside(y, rule[7], sight.size[1], first, end)
    first, end = _samples_inside(z, rule[8], sight.size[2], first, end)
    if not first < end:
        return 0
    k, stop = math.ceil(first), math.ceil(end)
    occupied = 0
    while k < stop:
        near_is, near = look(sight, x + k * rule[3], y + k * rule[4], z + k * rule[5])
        top = stop - 1
        far_is, far = look(sight, x + top * rule[3], y + top * rule[4], z + top * rule[5])
        if near == 0:  # branch prediction: the processor need not wait for this look to take the next
            occupied += near_is
            k += 1
        else:
            after = min(k + 1 + near, stop)
            occupied += near_is * (after - k)
            k = after
        if far == 0:
            if k < stop:
                occupied += far_is
            stop -= 1
        else:
            before = max(top - far, k)
            occupied += far_is * max(stop - before, 0)
            stop = before
    return occupied


@cached
def sample(grid: Grid, points: Float, distance: Float, gradient: Float) -> None:
    """Compute distances [P] and gradients [P, 3] at points [P, 3], written into the last two."""
    for p in range(points.shape[0]):
        value, gx, gy, gz = interpolate(grid, points[p, 0], points[p, 1], points[p, 2])
        distance[p] = value
        gradient[p, 0], gradient[p, 1], gradient[p, 2] = gx, gy, gz


@cached
def fill_bricks(grid: Grid, bricks: NDArray[np.uint8]) -> None:
    """Fill `bricks`, which must be zeros, as `Sight.bricks` explains.

    A voxel's distance is M = D - h/2, D from its centre to the nearest centre of the other state. A point of
    a voxel is at most half a diagonal from its centre. So all points within M + h/2 - sqrt(3) h of any of the
    voxel's points have its state.
    """
    d = grid.distance_m
    wide, deep, high = d.shape
    for i in range(wide):
        for j in range(deep):
            for k in range(high):
                free_voxels = abs(d[i, j, k]) / grid.resolution_m - (DIAGONAL - 0.5)
                leap = min(max(int(2.0 * free_voxels - ROUNDING), 0), _LONGEST_LEAP)
                within = (i % BRICK * BRICK + j % BRICK) * BRICK + k % BRICK
                bricks[i // BRICK, j // BRICK, k // BRICK, within] = 2 * leap + (d[i, j, k] < 0.0)


@cached
def line_shares(grid: Grid, sight: Sight, actor: Float, camera: Float, start_m: float, share: Float) -> None:
    """Compute occupied shares [P] of the sight lines between points [P, 3] and [P, 3], into `share`."""
    rule = np.zeros(11)
    for p in range(actor.shape[0]):
        x, y, z = camera[p, 0] - actor[p, 0], camera[p, 1] - actor[p, 1], camera[p, 2] - actor[p, 2]
        count = sampling(x, y, z, start_m, grid.resolution_m, rule)
        share[p] = 0.0
        if count:
            x, y, z = (actor[p] - grid.origin) / grid.resolution_m
            share[p] = occupied_samples(sight, x, y, z, rule, 0.0, float(count)) / count
