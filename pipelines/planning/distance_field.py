"""Signed distance to the nearest obstacle with its gradient, and lines of sight through the voxels.

The kernels have no threads and no fastmath: the same numbers give the same bytes.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.compilation import cached, helper
from pipelines.session.records import Occupancy

# A point is at most half a diagonal (in voxels) from its voxel's centre. It is at most a whole one from the
# corners of the cell in which it is interpolated, and so are the corners from each other.
DIAGONAL = math.sqrt(3.0)
# Single precision of the distances needs this margin of such bounds, in voxels.
ROUNDING = 1e-4
# Bricks of 4 x 4 x 4 bytes fill a cache line.
BRICK = 4
# The leap is stored in seven bits of a byte.
MAX_LEAP = 127
# OctoMap takes a voxel for an obstacle from this probability on.
OCCUPIED = 0.5
# No drone flies so far: everything in a map without obstacles has this distance.
NOWHERE_M = 1e3


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
    """Set the sampling of a sight line x, y, z (m, camera from actor); return the number of samples.

    The line begins `start_m` from the actor. Samples are at most half a voxel (`side_m`) apart. `rule` [11]
    is filled: the first sample from the actor, the step to the next, one over it by axis, all three in
    voxels; samples per metre; and the length of the line in m.
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
    """Return the range of the samples `low` to `high` inside the grid along an axis."""
    if math.isinf(per):
        return (low, high) if 0.0 <= first < size else (high, high)
    one, other = -first * per, (size - first) * per
    return max(low, min(one, other)), min(high, max(one, other))


@helper
def look(sight: Sight, x: float, y: float, z: float) -> tuple[int, int]:
    """Test if the voxel at a place (voxels) is occupied, 0 or 1; all points within the leap are alike."""
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
    """Count the occupied samples, `first` to `end`, of a line of sight from an actor at x, y, z (voxels).

    Samples are at most half a voxel apart, so that the next ones within a voxel's leap need no look. They
    are taken from both ends at once, because the processor can run two independent leaps in parallel.
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
                leap = min(max(int(2.0 * free_voxels - ROUNDING), 0), MAX_LEAP)
                within = (i % BRICK * BRICK + j % BRICK) * BRICK + k % BRICK
                bricks[i // BRICK, j // BRICK, k // BRICK, within] = 2 * leap + (d[i, j, k] < 0.0)


Unknown = Literal["free", "occupied", "avoided"]
"""Meaning of unknown voxels: free, an obstacle that hides, or an obstacle that cameras see through."""


@dataclass(frozen=True)
class DistanceField:
    """Signed distances to the surface of occupied space: positive outside, negative inside.

    Values belong to voxel centres and are trilinear between them. Beyond the outermost centres they are
    those of the nearest point of the grid: space outside the map is as free as its border.
    """

    grid: Grid
    from_ns: int = 0  # the time from which the map holds
    hiding: Grid | None = None  # of what hides, if cameras see through some of what drones avoid; else `grid`

    @cached_property
    def sight(self) -> Sight:
        """Field for the sight lines of the cost map; made at first use, one byte per voxel."""
        wide, deep, high = self.grid.distance_m.shape
        bricks = np.zeros((-(-wide // BRICK), -(-deep // BRICK), -(-high // BRICK), BRICK**3), np.uint8)
        fill_bricks(self.hiding or self.grid, bricks)
        return Sight(bricks, (wide, deep, high))

    @property
    def has_obstacles(self) -> bool:
        """True if anything is occupied."""
        return bool((self.grid.distance_m < 0.0).any())

    def sample(self, points: Float) -> tuple[Float, Float]:
        """Compute distances [...] to obstacles, and their gradients [..., 3].

        Points are [..., 3], metres, world. The gradient is the exact derivative of the trilinear value, zero
        along axes on which the point is outside the grid. Points must be finite.
        """
        flat = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        distance, gradient = np.empty(len(flat)), np.empty_like(flat)
        sample(self.grid, flat, distance, gradient)
        return distance.reshape(points.shape[:-1]), gradient.reshape(points.shape)


def distance_field(occupancy: Occupancy, *, unknown: Unknown = "free") -> DistanceField:
    """Compute the distance field of a voxel map: from 0.5 on occupied, NaN unknown.

    M = d_free - res/2 outside and -(d_occ - res/2) inside, with the exact Euclidean distances between voxel
    centres: the surface lies on the faces between voxels. Without obstacles it is 1 km everywhere.
    """
    with np.errstate(invalid="ignore"):
        occupied = occupancy.probability >= OCCUPIED
    is_unknown = np.isnan(occupancy.probability)
    hiding = None
    if unknown == "avoided" and is_unknown.any():
        hiding = _grid(occupied, occupancy)
    if unknown != "free":
        occupied |= is_unknown
    return DistanceField(_grid(occupied, occupancy), occupancy.from_ns, hiding)


def _grid(occupied: NDArray[np.bool_], occupancy: Occupancy) -> Grid:
    if not occupied.any():
        distance = np.full(occupied.shape, NOWHERE_M, dtype=np.float32)
    elif occupied.all():
        distance = np.full(occupied.shape, -NOWHERE_M, dtype=np.float32)
    else:
        box = _box_around(occupied)
        distance = _depths(~occupied, occupancy.resolution_m)
        distance[box] -= _depths(np.ascontiguousarray(occupied[box]), occupancy.resolution_m)
    # Interpolation needs two centres along each axis; beyond the border the field is constant anyway.
    for axis in range(3):
        if distance.shape[axis] == 1:
            distance = np.repeat(distance, 2, axis=axis)
    distance = np.ascontiguousarray(distance)
    origin = np.array(occupancy.origin, dtype=np.float64)
    return Grid(distance, origin, float(occupancy.resolution_m))


def _box_around(occupied: NDArray[np.bool_]) -> tuple[slice, ...]:
    """Bound the occupied voxels and one free voxel on each side: none beyond is nearest to any of them."""
    found = []
    for axis in range(occupied.ndim):
        others = tuple(other for other in range(occupied.ndim) if other != axis)
        (along,) = np.nonzero(occupied.any(axis=others))
        found.append(slice(max(int(along[0]) - 1, 0), int(along[-1]) + 2))
    return tuple(found)


@helper
def _lower_envelope(squares: Int64, places: Int64, crossing: Float) -> None:
    """Replace squares [n] at k by the least squares[q] + (k - q)^2 (Felzenszwalb and Huttenlocher 2012).

    `places` [2, n] and `crossing` [n] are work space.
    """
    count, (lowest, height) = 0, places
    for q in range(squares.size):
        height[q] = squares[q]
        while count:
            p = lowest[count - 1]
            meets = (squares[q] + q * q - squares[p] - p * p) / (2.0 * (q - p))
            if count > 1 and meets <= crossing[count - 1]:
                count -= 1
                continue
            crossing[count] = meets
            break
        lowest[count] = q
        count += 1
    now = 0
    for k in range(squares.size):
        while now + 1 < count and crossing[now + 1] < k:
            now += 1
        squares[k] = height[lowest[now]] + (k - lowest[now]) ** 2


@cached
def _depths(inside: NDArray[np.bool_], resolution_m: float) -> NDArray[np.float32]:
    """Compute the distances [X, Y, Z] (m) of voxels inside to the face of the nearest one outside, else 0.

    Those between the voxels' centres are exact: they are half a voxel larger.
    """
    size = inside.shape
    far, longest = size[0] + size[1] + size[2], max(size)
    squares, depth_m = np.empty(size, dtype=np.int32), np.zeros(size, dtype=np.float32)
    line, places, crossing = np.empty(longest, np.int64), np.empty((2, longest), np.int64), np.empty(longest)
    for i in range(size[0]):
        for j in range(size[1]):
            steps = far
            for k in range(size[2]):
                steps = min(steps + 1, far) if inside[i, j, k] else 0
                squares[i, j, k] = steps
            steps = far
            for k in range(size[2] - 1, -1, -1):
                steps = min(steps + 1, far) if inside[i, j, k] else 0
                squares[i, j, k] = min(steps, squares[i, j, k]) ** 2
        for k in range(size[2]):
            for j in range(size[1]):
                line[j] = squares[i, j, k]
            _lower_envelope(line[: size[1]], places, crossing)
            for j in range(size[1]):
                squares[i, j, k] = line[j]
    for j in range(size[1]):
        for k in range(size[2]):
            for i in range(size[0]):
                line[i] = squares[i, j, k]
            _lower_envelope(line[: size[0]], places, crossing)
            for i in range(size[0]):
                if inside[i, j, k]:
                    depth_m[i, j, k] = resolution_m * (math.sqrt(line[i]) - 0.5)
    return depth_m


def open_space() -> DistanceField:
    """Return the field of a world without known obstacles."""
    return DistanceField(Grid(np.full((2, 2, 2), NOWHERE_M, dtype=np.float32), np.zeros(3), 1.0))


MapsInTurn = Sequence[tuple[slice, DistanceField]]
"""Maps over the T times of a flight: the times of each, which follow each other without a gap."""


def in_turn(fields: Sequence[DistanceField], t_ns: Int64) -> MapsInTurn:
    """Return the map that holds at each time [T], of fields in order; space is open before the first one."""
    starts = np.searchsorted(t_ns, [field.from_ns for field in fields]).tolist()
    ends = [*starts, len(t_ns)][1:]
    parts = [(slice(0, starts[0] if starts else len(t_ns)), open_space())]
    parts += [(slice(*rows), field) for *rows, field in zip(starts, ends, fields, strict=True)]
    return [(rows, field) for rows, field in parts if rows.start < rows.stop]


def looked(
    maps: DistanceField | MapsInTurn, look: Callable[[DistanceField, slice], NDArray[Any]], *, axis: int
) -> NDArray[Any]:
    """Join what `look` returns for each map and its times along `axis`; a single map holds all the time."""
    if isinstance(maps, DistanceField):
        return look(maps, slice(None))
    return np.concatenate([look(field, rows) for rows, field in maps], axis=axis)


def visible(field: DistanceField, camera: Float, actor: Float, *, start_m: float) -> Bool:
    """Test that no occupied voxel lies on lines of sight (Amanatides & Woo 1987), but by the actor."""
    camera, actor = np.broadcast_arrays(camera, actor)
    seen = np.empty(camera.shape[:-1], dtype=np.bool_)
    _traverse(field.hiding or field.grid, _flat(camera), _flat(actor), start_m, seen.reshape(-1))
    return seen


def _flat(points: Float) -> Float:
    return np.array(points, dtype=np.float64, order="C").reshape(-1, 3)  # broadcast arrays are no memory


@cached
def _traverse(grid: Grid, camera: Float, actor: Float, start_m: float, seen: Bool) -> None:
    occupied = grid.distance_m
    index, side, ahead = np.zeros(3, np.int64), np.zeros(3, np.int64), np.zeros(3, np.int64)
    direction, crossing, spacing = np.zeros(3), np.zeros(3), np.zeros(3)
    for axis in range(3):
        side[axis] = occupied.shape[axis]
    for p in range(camera.shape[0]):
        seen[p] = True
        length = 0.0
        for axis in range(3):
            direction[axis] = actor[p, axis] - camera[p, axis]
            length += direction[axis] ** 2
        length = math.sqrt(length)
        reach = length - start_m
        if not reach > 0.0:
            continue
        for axis in range(3):
            direction[axis] /= length
            place = (camera[p, axis] - grid.origin[axis]) / grid.resolution_m
            index[axis] = math.floor(place)
            ahead[axis] = 1 if direction[axis] > 0.0 else -1
            border = index[axis] + (1 if direction[axis] > 0.0 else 0)
            if direction[axis] == 0.0:
                crossing[axis] = spacing[axis] = math.inf
            else:
                spacing[axis] = grid.resolution_m / abs(direction[axis])
                crossing[axis] = (border - place) * grid.resolution_m / direction[axis]
        while True:
            inside = True
            for axis in range(3):
                inside = inside and 0 <= index[axis] < side[axis]
            if inside and occupied[index[0], index[1], index[2]] < 0.0:
                seen[p] = False
                break
            nearest = 0
            for axis in range(1, 3):
                if crossing[axis] < crossing[nearest]:
                    nearest = axis
            if crossing[nearest] >= reach:
                break
            index[nearest] += ahead[nearest]
            crossing[nearest] += spacing[nearest]
