"""The compiled part of the world: heights, insides of solids, lines of sight, occupied voxels.

All kernels are in this one module: numba's cache watches the file of the outermost function only.

Shapes are rows of numbers, all in metres of the world:

- mound: x, y, cos yaw, sin yaw, sigma along, sigma across, height
- trunk, an upright capped cylinder: x, y, low z, high z, radius
- crown, an ellipsoid: x, y, z, horizontal semi-axis, vertical semi-axis; crown k belongs to trunk k
- slab, an upright box: x, y, cos yaw, sin yaw, half length, half thickness, low z, high z

Solids are open sets: a point that only touches them is neither inside nor hidden.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.compilation import cached, helper

GRAZE_M = 1e-3
"""Allowed depth of a line of sight in the ground, m; steps can overlook another such depth."""

# Voxels and solids that share a plane do not overlap for a rounding error.
_TOUCH_M = 1e-9


# --- the ground ----------------------------------------------------------------------------------------


@helper
def _height(mounds: Float, x: float, y: float) -> float:
    total = 0.0
    for k in range(len(mounds)):
        east, north = x - mounds[k, 0], y - mounds[k, 1]
        along = (mounds[k, 2] * east + mounds[k, 3] * north) / mounds[k, 4]
        across = (mounds[k, 2] * north - mounds[k, 3] * east) / mounds[k, 5]
        total += mounds[k, 6] * math.exp(-0.5 * (along * along + across * across))
    return total


@cached
def heights(mounds: Float, xy: Float, out: Float) -> None:
    """Compute the height of the ground [N] at points [N, 2]."""
    for n in range(len(xy)):
        out[n] = _height(mounds, xy[n, 0], xy[n, 1])


@cached
def gradients(mounds: Float, xy: Float, out: Float) -> None:
    """Compute the ground's slope [N, 2] towards east and north at points [N, 2]; `out` must hold zeros."""
    for n in range(len(xy)):
        for k in range(len(mounds)):
            cos, sin = mounds[k, 2], mounds[k, 3]
            east, north = xy[n, 0] - mounds[k, 0], xy[n, 1] - mounds[k, 1]
            along = (cos * east + sin * north) / mounds[k, 4]
            across = (cos * north - sin * east) / mounds[k, 5]
            value = mounds[k, 6] * math.exp(-0.5 * (along * along + across * across))
            along, across = -value * along / mounds[k, 4], -value * across / mounds[k, 5]
            out[n, 0] += cos * along - sin * across
            out[n, 1] += sin * along + cos * across


# --- inside --------------------------------------------------------------------------------------------


@cached
def inside(points: Float, mounds: Float, trunks: Float, crowns: Float, slabs: Float, out: Bool) -> None:
    """Test if points [N, 3] lie below the ground or within a trunk, crown or slab; False for NaN."""
    for n in range(len(points)):
        x, y, z = points[n]
        out[n] = z < _height(mounds, x, y) or _in_tree(trunks, crowns, x, y, z) or _in_slab(slabs, x, y, z)


@helper
def _in_tree(trunks: Float, crowns: Float, x: float, y: float, z: float) -> bool:
    for k in range(len(trunks)):
        flat = (x - trunks[k, 0]) ** 2 + (y - trunks[k, 1]) ** 2
        if flat < trunks[k, 4] ** 2 and trunks[k, 2] < z < trunks[k, 3]:
            return True
        if flat / crowns[k, 3] ** 2 + ((z - crowns[k, 2]) / crowns[k, 4]) ** 2 < 1:
            return True
    return False


@helper
def _in_slab(slabs: Float, x: float, y: float, z: float) -> bool:
    for k in range(len(slabs)):
        east, north = x - slabs[k, 0], y - slabs[k, 1]
        along = slabs[k, 2] * east + slabs[k, 3] * north
        across = slabs[k, 2] * north - slabs[k, 3] * east
        if abs(along) < slabs[k, 4] and abs(across) < slabs[k, 5] and slabs[k, 6] < z < slabs[k, 7]:
            return True
    return False


# --- hidden --------------------------------------------------------------------------------------------


@cached
def hidden(
    eye: Float,
    target: Float,
    mounds: Float,
    slope: float,
    curvature: float,
    trunks: Float,
    crowns: Float,
    slabs: Float,
    out: Bool,
) -> None:
    """Test if a solid stands between eyes and targets, [N, 3] each; False for NaN in either.

    The test is exact for trunks, crowns and slabs. The ground hides a line that runs deeper in it than twice
    `GRAZE_M`, and never one that stays less than `GRAZE_M` deep. `slope` and `curvature` are upper bounds of
    the ground's.
    """
    for n in range(len(eye)):
        # From the target: drones look down, so the way to them soon climbs faster than any mound.
        start = (target[n, 0], target[n, 1], target[n, 2])
        way = (eye[n, 0] - start[0], eye[n, 1] - start[1], eye[n, 2] - start[2])
        known = math.isfinite(way[0] + way[1] + way[2])
        out[n] = known and (
            _meets_tree(trunks, crowns, start, way)
            or _meets_slab(slabs, start, way)
            or _meets_ground(mounds, slope, curvature, start, way)
        )


@helper
def _meets_ground(
    mounds: Float,
    slope: float,
    curvature: float,
    start: tuple[float, float, float],
    way: tuple[float, float, float],
) -> bool:
    """March along the line in steps that the slope bounds, but no shorter than the curvature allows."""
    length = math.hypot(way[0], way[1])
    fall = slope * length - way[2]
    least = math.sqrt(8 * GRAZE_M / curvature) / length  # inf over flat ground and for upright lines
    end = start[2] + way[2] - _height(mounds, start[0] + way[0], start[1] + way[1])
    if end < -GRAZE_M:
        return True
    t = 0.0
    while t < 1:
        clearance = start[2] + t * way[2] - _height(mounds, start[0] + t * way[0], start[1] + t * way[1])
        if clearance < -GRAZE_M:
            return True
        if not fall > 0:
            return False
        t += max((clearance + GRAZE_M) / fall, least)
    return False


@helper
def _meets_tree(
    trunks: Float, crowns: Float, start: tuple[float, float, float], way: tuple[float, float, float]
) -> bool:
    flat = way[0] * way[0] + way[1] * way[1]
    for k in range(len(trunks)):
        x, y = start[0] - trunks[k, 0], start[1] - trunks[k, 1]
        toward = x * way[0] + y * way[1]
        # Most trees are passed by: the nearest point of the line to the axis, seen from above.
        nearest = min(max(-toward / flat, 0.0), 1.0) if flat > 0 else 0.0
        reach = max(trunks[k, 4], crowns[k, 3])
        if (x + nearest * way[0]) ** 2 + (y + nearest * way[1]) ** 2 >= reach * reach:
            continue
        radius, upright = crowns[k, 3], crowns[k, 4]
        z = (start[2] - crowns[k, 2]) / upright
        climb = way[2] / upright
        if _dips_below_zero(
            flat / radius**2 + climb * climb,
            toward / radius**2 + z * climb,
            (x * x + y * y) / radius**2 + z * z - 1,
            0.0,
            1.0,
        ):
            return True
        first, last = _between(start[2], way[2], trunks[k, 2], trunks[k, 3], 0.0, 1.0)
        if first < last and _dips_below_zero(flat, toward, x * x + y * y - trunks[k, 4] ** 2, first, last):
            return True
    return False


@helper
def _meets_slab(slabs: Float, start: tuple[float, float, float], way: tuple[float, float, float]) -> bool:
    for k in range(len(slabs)):
        x, y, cos, sin = start[0] - slabs[k, 0], start[1] - slabs[k, 1], slabs[k, 2], slabs[k, 3]
        first, last = _between(
            cos * x + sin * y, cos * way[0] + sin * way[1], -slabs[k, 4], slabs[k, 4], 0.0, 1.0
        )
        first, last = _between(
            cos * y - sin * x, cos * way[1] - sin * way[0], -slabs[k, 5], slabs[k, 5], first, last
        )
        first, last = _between(start[2], way[2], slabs[k, 6], slabs[k, 7], first, last)
        if first < last:
            return True
    return False


@helper
def _dips_below_zero(a: float, b: float, c: float, first: float, last: float) -> bool:
    """Test if a t^2 + 2 b t + c, a >= 0, is negative somewhere in the open interval (first, last)."""
    if a > 0:
        lowest = min(max(-b / a, first), last)
        return (a * lowest + 2 * b) * lowest + c < 0
    return c < 0  # then b is 0 too: the line is a point to this shape


@helper
def _between(
    start: float, way: float, low: float, high: float, first: float, last: float
) -> tuple[float, float]:
    """Return the part of (first, last) in which low < start + t way < high; empty when first >= last."""
    if way == 0:
        return (first, last) if low < start < high else (1.0, 0.0)
    enter, leave = (low - start) / way, (high - start) / way
    return max(first, min(enter, leave)), min(last, max(enter, leave))


# --- voxels --------------------------------------------------------------------------------------------


@cached
def mark_trees(grid: Bool, low: NDArray[np.int64], side: float, trunks: Float, crowns: Float) -> None:
    """Set the voxels [X, Y, Z] that trunks and crowns reach into; voxel 0 begins at `low` sides."""
    for k in range(len(trunks)):
        x, y, radius, upright = trunks[k, 0], trunks[k, 1], crowns[k, 3], crowns[k, 4]
        reach = max(trunks[k, 4], radius)
        x0, x1 = _range(x - reach, x + reach, side, low[0], grid.shape[0])
        y0, y1 = _range(y - reach, y + reach, side, low[1], grid.shape[1])
        bottom, top = min(trunks[k, 2], crowns[k, 2] - upright), max(trunks[k, 3], crowns[k, 2] + upright)
        z0, z1 = _range(bottom, top, side, low[2], grid.shape[2])
        for i in range(x0, x1):
            east = _distance(x, (low[0] + i) * side, side)
            for j in range(y0, y1):
                north = _distance(y, (low[1] + j) * side, side)
                flat = east * east + north * north
                in_trunk = flat < trunks[k, 4] ** 2
                in_crown = flat / radius**2
                for n in range(z0, z1):
                    z = (low[2] + n) * side
                    # Scaling the axes keeps a box a box: its point nearest to the centre decides.
                    up = _distance(crowns[k, 2], z, side) / upright
                    if in_crown + up * up < 1 or (
                        in_trunk and z + _TOUCH_M < trunks[k, 3] and z + side - _TOUCH_M > trunks[k, 2]
                    ):
                        grid[i, j, n] = True


@cached
def mark_slabs(grid: Bool, low: NDArray[np.int64], side: float, slabs: Float) -> None:
    """Set the voxels that slabs reach into: seen from above, no axis of either separates the rectangles."""
    half = side / 2
    for k in range(len(slabs)):
        x, y, cos, sin, length, thickness = slabs[k, :6]
        wide = abs(cos) * length + abs(sin) * thickness
        deep = abs(sin) * length + abs(cos) * thickness
        x0, x1 = _range(x - wide, x + wide, side, low[0], grid.shape[0])
        y0, y1 = _range(y - deep, y + deep, side, low[1], grid.shape[1])
        z0, z1 = _range(slabs[k, 6], slabs[k, 7], side, low[2], grid.shape[2])
        spread = half * (abs(cos) + abs(sin))  # of a voxel along the slab's axes
        for i in range(x0, x1):
            east = (low[0] + i) * side + half - x
            for j in range(y0, y1):
                north = (low[1] + j) * side + half - y
                if (
                    abs(cos * east + sin * north) + _TOUCH_M < length + spread
                    and abs(cos * north - sin * east) + _TOUCH_M < thickness + spread
                ):
                    grid[i, j, z0:z1] = True


@helper
def _range(low_m: float, high_m: float, side: float, first: int, count: int) -> tuple[int, int]:
    """Return the range of the voxels that an interval reaches into, cut to the grid."""
    begin = math.floor((low_m + _TOUCH_M) / side) - first
    end = math.ceil((high_m - _TOUCH_M) / side) - first
    return max(begin, 0), min(end, count)


@helper
def _distance(point: float, low: float, side: float) -> float:
    """Compute the distance from a point to the interval [low, low + side]."""
    return max(low - point, 0.0, point - low - side)
