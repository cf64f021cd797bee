"""The compiled arithmetic: interpolation of the distance field, sight lines, formation search, local planner.

All of it stands in this one module: numba's cache watches the file of the outermost function only, so a
helper in another file could change without the cached code noticing. No threads and no fastmath: the same
numbers give the same bytes. `distance_field`, `costs`, `search`, `arms` and `local` are the users and explain
the methods.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.compilation import cached, helper

Float = NDArray[np.float64]
Int64 = NDArray[np.int64]
Vector = tuple[float, float, float]

# From a point to the centre of its voxel it is at most half a diagonal; to a corner of the cell in which it
# is interpolated, and from the one to the other, at most a whole one. In voxels:
_DIAGONAL = math.sqrt(3.0)
_ROUNDING = 1e-4  # of single precision, by which such bounds are drawn in
BRICK = 4  # voxels along the side of one of `Sight.bricks`
_LONGEST_LEAP = 127  # seven bits
REACHED_S = 1e-9  # a cell exactly as far as the rates allow is a neighbour
_YAW = 0  # of a slot: formation.YAW
_SLOWEST_STEP, _FASTEST_STEP = (
    1e4,
    0.2,
)  # eta: beyond the first nothing moves, the second is five Newton steps


class Grid(NamedTuple):
    """A signed distance field as the kernels take it."""

    distance_m: NDArray[np.float32]  # [X, Y, Z], at least two voxels along each axis
    origin: Float  # [3] m, the corner of voxel (0, 0, 0)
    resolution_m: float


class Sight(NamedTuple):
    """The field as sight lines are led through it: which voxels are occupied, and how far all is alike."""

    bricks: NDArray[np.uint8]
    """[X/4, Y/4, Z/4, 64] of 4 x 4 x 4 voxels, a line of the processor's memory each: twice the leap, and
    one more where occupied. All points within as many half voxels of any of the voxel's are as it is."""
    size: tuple[int, int, int]  # of the grid


class Weights(NamedTuple):
    """What the local planner weighs, by name; see `PlannerConfig`."""

    l_obs: float
    l_occ: float
    l_form: float
    l_sep: float
    a_velocity: float
    a_acceleration: float
    a_jerk: float
    eps_obs_m: float
    eps_occ_m: float
    soft_separation_m: float
    sight_start_m: float
    speed_floor_mps: float
    step_s: float  # between waypoints
    samples: int  # along a sight line


class Lattice(NamedTuple):
    """States of a formation (or of one drone), and which of them follow which."""

    states: Float  # [S, 3] yaw, tilt, range
    rates: Float  # [3] per second
    knot_s: float
    w_turn: float
    neighbours: Int64  # [S, K] nearest first, itself at the front; -1 fills up
    move: Float  # [S, K] what going there costs


class Formations(NamedTuple):
    """The formations to choose from."""

    lattice: Lattice
    slots: Float  # [S, n, 3] of each state
    offsets: Float  # [S, n, 3] m, the same from the actor


class SlotWeights(NamedTuple):
    """What the search weighs, by name; see `PlannerConfig`."""

    w_obs: float
    w_occ: float
    eps_obs_m: float
    sight_start_m: float


# --- reading the field ---------------------------------------------------------------------------------


@helper
def _cell(coordinate: float, size: int, resolution: float) -> tuple[int, float, float]:
    """Lower index, fraction and derivative of the fraction along one axis, clamped to the voxel centres."""
    index = coordinate / resolution - 0.5
    if not index > 0.0:
        return 0, 0.0, 0.0
    if index >= size - 1:
        return size - 2, 1.0, 0.0
    lower = int(index)
    return lower, index - lower, 1.0 / resolution


@helper
def _interpolate(grid: Grid, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Trilinear distance and its exact gradient; along a clamped axis the gradient is zero."""
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
def _nearest(grid: Grid, x: float, y: float, z: float) -> float:
    """Distance stored for the voxel whose centre is nearest to a point."""
    d = grid.distance_m
    i = min(max(int((x - grid.origin[0]) / grid.resolution_m), 0), d.shape[0] - 1)
    j = min(max(int((y - grid.origin[1]) / grid.resolution_m), 0), d.shape[1] - 1)
    k = min(max(int((z - grid.origin[2]) / grid.resolution_m), 0), d.shape[2] - 1)
    return float(d[i, j, k])


@helper
def _sampling(x: float, y: float, z: float, start_m: float, side_m: float, rule: Float) -> int:
    """How a sight line is sampled, in voxels of that side: the number of samples, every half voxel at most.

    Args:
        x: m, the camera from the actor, as the next two.
        y: see there.
        z: see there.
        start_m: where the line begins.
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
    """Which of the samples `low` to `high` lie in the grid along an axis; `per` is one over the step."""
    if math.isinf(per):
        return (low, high) if 0.0 <= first < size else (high, high)
    one, other = -first * per, (size - first) * per
    return max(low, min(one, other)), min(high, max(one, other))


@helper
def _look(sight: Sight, x: float, y: float, z: float) -> tuple[int, int]:
    """Whether the voxel at a place (voxels) is occupied, and how far, in half voxels, all is as it is."""
    size = sight.size
    i = np.uintp(min(max(int(x), 0), size[0] - 1))
    j = np.uintp(min(max(int(y), 0), size[1] - 1))
    k = np.uintp(min(max(int(z), 0), size[2] - 1))
    within = (i % BRICK * BRICK + j % BRICK) * BRICK + k % BRICK
    byte = np.int64(sight.bricks[i // BRICK, j // BRICK, k // BRICK, within])  # signed, or sums become floats
    return int(byte & 1), int(byte >> 1)


@helper
def _occupied_samples(
    sight: Sight, x: float, y: float, z: float, rule: Float, first: float, end: float
) -> int:
    """How many of the samples `first` to `end` of a sight line lie in occupied voxels.

    The line begins at an actor, x, y, z in voxels from the grid's corner. Samples are at most half a voxel
    apart, so that as many as a voxel's leap need no look. Taken from both ends at once, because the processor
    can follow two leaps that do not depend on each other.
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
        near_is, near = _look(sight, x + k * rule[3], y + k * rule[4], z + k * rule[5])
        top = stop - 1
        far_is, far = _look(sight, x + top * rule[3], y + top * rule[4], z + top * rule[5])
        if near == 0:  # foreseen by the processor, which need not wait for this look to take the next
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
    """Distances [P] and gradients [P, 3] at points [P, 3], written into the last two."""
    for p in range(points.shape[0]):
        value, gx, gy, gz = _interpolate(grid, points[p, 0], points[p, 1], points[p, 2])
        distance[p] = value
        gradient[p, 0], gradient[p, 1], gradient[p, 2] = gx, gy, gz


@cached
def fill_bricks(grid: Grid, bricks: NDArray[np.uint8]) -> None:
    """Fill zeros with what `Sight.bricks` holds.

    A voxel's distance is M = D - h/2, D from its centre to the nearest one that is not as it is. From a
    point of a voxel to its centre it is half a diagonal at most: within M + h/2 - sqrt(3) h of any of the
    voxel's points all is alike.
    """
    d = grid.distance_m
    wide, deep, high = d.shape
    for i in range(wide):
        for j in range(deep):
            for k in range(high):
                free_voxels = abs(d[i, j, k]) / grid.resolution_m - (_DIAGONAL - 0.5)
                leap = min(max(int(2.0 * free_voxels - _ROUNDING), 0), _LONGEST_LEAP)
                within = (i % BRICK * BRICK + j % BRICK) * BRICK + k % BRICK
                bricks[i // BRICK, j // BRICK, k // BRICK, within] = 2 * leap + (d[i, j, k] < 0.0)


@cached
def line_shares(grid: Grid, sight: Sight, actor: Float, camera: Float, start_m: float, share: Float) -> None:
    """Occupied shares [P] of the sight lines between points [P, 3] and [P, 3], written into `share`."""
    rule = np.zeros(11)
    for p in range(actor.shape[0]):
        x, y, z = camera[p, 0] - actor[p, 0], camera[p, 1] - actor[p, 1], camera[p, 2] - actor[p, 2]
        count = _sampling(x, y, z, start_m, grid.resolution_m, rule)
        share[p] = 0.0
        if count:
            x, y, z = (actor[p] - grid.origin) / grid.resolution_m
            share[p] = _occupied_samples(sight, x, y, z, rule, 0.0, float(count)) / count


@helper
def _look_at_slots(
    grid: Grid,
    sight: Sight,
    actor: Float,
    offsets: Float,
    eps_obs_m: float,
    start_m: float,
    obstacle: Float,
    share: Float,
) -> None:
    """What `slot_costs` returns, written into arrays of zeros.

    Most sight lines are known to be free from the distances of their two ends: the actor's, of which one
    look tells for all of them, and the camera's, which the obstacle cost asks for anyway.
    """
    times, (states, cameras, _) = actor.shape[0], offsets.shape
    side_m = grid.resolution_m
    rules, counts = np.zeros((states, cameras, 11)), np.zeros((states, cameras), np.int64)
    longest_m = 0.0
    for s in range(states):
        for i in range(cameras):
            x, y, z = offsets[s, i]
            counts[s, i] = _sampling(x, y, z, start_m, side_m, rules[s, i])
            longest_m = max(longest_m, rules[s, i, 10])
    clear = math.ceil(2.0 * eps_obs_m / side_m + 1.0)  # from this leap on the nearest obstacle costs nothing
    per_m = 1.0 / side_m
    for t in range(times):
        spare_m = _nearest(grid, actor[t, 0], actor[t, 1], actor[t, 2]) - _DIAGONAL * side_m
        if spare_m > longest_m + eps_obs_m + (_DIAGONAL + _ROUNDING) * side_m:
            continue
        free_m = spare_m + (0.5 - _ROUNDING) * side_m  # about the actor
        ax = (actor[t, 0] - grid.origin[0]) / side_m
        ay = (actor[t, 1] - grid.origin[1]) / side_m
        az = (actor[t, 2] - grid.origin[2]) / side_m
        # Neighbouring sight lines follow each other, and find what they look up near at hand.
        for i in range(cameras):
            for s in range(states):
                rule, count = rules[s, i], counts[s, i]
                x, y, z = offsets[s, i]
                is_occupied, leap = _look(sight, ax + x * per_m, ay + y * per_m, az + z * per_m)
                if is_occupied or leap < clear:
                    distance = _interpolate(grid, actor[t, 0] + x, actor[t, 1] + y, actor[t, 2] + z)[0]
                    obstacle[t, s, i] = min(max(1.0 - distance / eps_obs_m, 0.0), 1.0)
                first = max(int((free_m - start_m) * rule[9] - 0.5), 0)
                end = count if is_occupied else count - leap
                if first < end:
                    share[t, s, i] = (
                        _occupied_samples(sight, ax, ay, az, rule, float(first), float(end)) / count
                    )


@cached
def slot_costs(
    grid: Grid, sight: Sight, actor: Float, offsets: Float, eps_obs_m: float, start_m: float
) -> tuple[Float, Float]:
    """Obstacle cost and occupied share of the sight line, both [T, S, n].

    Args:
        grid: the distance field.
        sight: the same for sight lines.
        actor: [T, 3] forecast.
        offsets: [S, n, 3] slots of every state, from the actor.
        eps_obs_m: the distance from which obstacles count.
        start_m: how far off the actor sight lines begin.
    """
    shape = (actor.shape[0], offsets.shape[0], offsets.shape[1])
    obstacle, share = np.zeros(shape), np.zeros(shape)
    _look_at_slots(grid, sight, actor, offsets, eps_obs_m, start_m, obstacle, share)
    return obstacle, share


# --- the formation search -------------------------------------------------------------------------------


@helper
def _weigh(obstacle: Float, share: Float, w_obs: float, w_occ: float) -> Float:
    """The cost map [T, S] of what `slot_costs` returns: summed over the drones, the first one first."""
    times, states, cameras = obstacle.shape
    cost = np.zeros((times, states))
    for t in range(times):
        for s in range(states):
            for i in range(cameras):
                cost[t, s] += w_obs * obstacle[t, s, i] + w_occ * share[t, s, i]
    return cost


@helper
def _search(cost: Float, lattice: Lattice, start: Float) -> tuple[Int64, float]:
    """See `search.best_sequence`."""
    times, states = cost.shape
    value = cost.copy()
    following = np.zeros((times, states), np.int64)
    for t in range(times - 2, -1, -1):
        for s in range(states):
            best = math.inf
            for k in range(lattice.neighbours.shape[1]):
                j = lattice.neighbours[s, k]
                if j >= 0 and value[t + 1, j] + lattice.move[s, k] < best:
                    best = value[t + 1, j] + lattice.move[s, k]
                    following[t, s] = j
            value[t, s] = cost[t, s] + best

    # The first step starts anywhere between the states.
    reach_s, way_s = np.zeros(states), np.zeros(states)
    for s in range(states):
        for axis in range(3):
            way = abs(lattice.states[s, axis] - start[axis])
            if axis == _YAW:
                way = abs(_wrapped(way))
            reach_s[s] = max(reach_s[s], way / lattice.rates[axis])
            way_s[s] += way / lattice.rates[axis]
    within_s = max(lattice.knot_s, reach_s.min()) + REACHED_S
    sequence = np.zeros(times, np.int64)
    total = nearest = math.inf
    for s in range(states):
        through = value[0, s] + lattice.w_turn / 2.0 * way_s[s]
        if reach_s[s] <= within_s and (through < total or (through == total and way_s[s] < nearest)):
            total, nearest = through, way_s[s]
            sequence[0] = s
    for t in range(times - 1):
        sequence[t + 1] = following[t, sequence[t]]
    return sequence, total


@helper
def _wrapped(angle_rad: float) -> float:
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


@helper
def _turn_the_shorter_way(slots: Float) -> None:
    """Make the yaws of slots [T, n, 3] continuous, from knot to knot."""
    for i in range(slots.shape[1]):
        first, before, turned = slots[0, i, _YAW], slots[0, i, _YAW], 0.0
        for t in range(1, slots.shape[0]):
            yaw = slots[t, i, _YAW]
            turned += _wrapped(yaw - before)
            slots[t, i, _YAW] = first + turned
            before = yaw


@cached
def weighed(obstacle: Float, share: Float, w_obs: float, w_occ: float) -> Float:
    """C [T, S] of costs [T, S, n]; see `costs.cost_map`."""
    return _weigh(obstacle, share, w_obs, w_occ)


@cached
def cheapest_sequence(cost: Float, lattice: Lattice, start: Float) -> tuple[Int64, float]:
    """See `search.best_sequence`."""
    return _search(cost, lattice, start)


@cached
def turn_the_shorter_way(slots: Float) -> None:
    """Make the yaws of slots [T, n, 3] continuous, from knot to knot, in place."""
    _turn_the_shorter_way(slots)


@cached
def cheapest_slots(
    grid: Grid, sight: Sight, actor: Float, formations: Formations, w: SlotWeights, commanded: Float
) -> Float:
    """All of a formation's planning: look at the slots, weigh, search.

    Args:
        grid: the distance field.
        sight: the same for sight lines.
        actor: [T, 3] forecast.
        formations: which there are.
        w: what is weighed.
        commanded: [n, 3] the slots that are commanded now.

    Returns:
        [T + 1, n, 3] slots at the knots, the first as commanded; yaw is continuous.
    """
    shape = (actor.shape[0], formations.slots.shape[0], formations.slots.shape[1])
    obstacle, share = np.zeros(shape), np.zeros(shape)
    _look_at_slots(grid, sight, actor, formations.offsets, w.eps_obs_m, w.sight_start_m, obstacle, share)
    sequence, _ = _search(_weigh(obstacle, share, w.w_obs, w.w_occ), formations.lattice, commanded[0])
    through = np.empty((shape[0] + 1, shape[2], 3))
    for i in range(shape[2]):
        for axis in range(3):
            through[0, i, axis] = commanded[i, axis]
            for t in range(shape[0]):
                through[t + 1, i, axis] = formations.slots[sequence[t], i, axis]
    _turn_the_shorter_way(through)
    return through


# --- the local planner's cost --------------------------------------------------------------------------


@helper
def _hinge(distance: float, eps: float) -> tuple[float, float]:
    """CHOMP's obstacle cost of a signed distance, and its derivative."""
    if distance < 0.0:
        return eps / 2.0 - distance, -1.0
    if distance <= eps:
        return (distance - eps) ** 2 / (2.0 * eps), (distance - eps) / eps
    return 0.0, 0.0


@helper
def _add_smoothness(path: Float, w: Weights, gradient: Float) -> float:
    """Squared velocity, acceleration and jerk; `path` [N + 3, 3] begins with three fixed points."""
    n = gradient.shape[0]
    h1 = 1.0 / w.step_s
    h2, h3 = h1 * h1, h1 * h1 * h1
    total: float = 0.0
    for i in range(n):
        for axis in range(3):
            x0, x1, x2, x3 = path[i, axis], path[i + 1, axis], path[i + 2, axis], path[i + 3, axis]
            velocity, acceleration = (x3 - x2) * h1, (x3 - 2.0 * x2 + x1) * h2
            jerk = (x3 - 3.0 * x2 + 3.0 * x1 - x0) * h3
            av, aa, aj = w.a_velocity * velocity, w.a_acceleration * acceleration, w.a_jerk * jerk
            total += av * velocity + aa * acceleration + aj * jerk
            gradient[i, axis] += (av * h1 + aa * h2 + aj * h3) / n
            if i >= 1:
                gradient[i - 1, axis] -= (av * h1 + 2.0 * aa * h2 + 3.0 * aj * h3) / n
            if i >= 2:
                gradient[i - 2, axis] += (aa * h2 + 3.0 * aj * h3) / n
            if i >= 3:
                gradient[i - 3, axis] -= aj * h3 / n
    return float(total / (2.0 * n))


@helper
def _sight_cost(grid: Grid, q: Float, actor: Float, w: Weights) -> tuple[float, float, float, float]:
    """Hinge cost along the sight line, times its length, and the gradient by the drone's position q.

    Points p = q + sigma (L - r L/|L|), L = actor - q, sigma in 0..1: the line ends r off the actor, and
    moves with q by (1 - sigma) I + sigma r/|L| (I - LL'/|L|^2), so that the cost has no steps.
    """
    lx, ly, lz = actor[0] - q[0], actor[1] - q[1], actor[2] - q[2]
    length = math.sqrt(lx * lx + ly * ly + lz * lz)
    reach = length - w.sight_start_m
    if reach <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    lx, ly, lz = lx / length, ly / length, lz / length
    step = reach / w.samples
    total = gx = gy = gz = 0.0
    k = 0
    while k < w.samples:
        sigma = (k + 0.5) / w.samples
        along = sigma * reach
        x, y, z = q[0] + along * lx, q[1] + along * ly, q[2] + along * lz
        # Far from everything the nearest voxel says enough: there, and as far on, nothing costs.
        spare = _nearest(grid, x, y, z) - w.eps_occ_m - _DIAGONAL * grid.resolution_m
        if spare > 0.0:
            k += 1 + max(0, int((spare - 0.5 * _DIAGONAL * grid.resolution_m) / step))
            continue
        k += 1
        d, dx, dy, dz = _interpolate(grid, x, y, z)
        c, slope = _hinge(d, w.eps_occ_m)
        if slope != 0.0:
            total += c
            across = sigma * w.sight_start_m / length
            same = 1.0 - sigma + across
            towards = across * (dx * lx + dy * ly + dz * lz)
            gx += slope * (same * dx - towards * lx)
            gy += slope * (same * dy - towards * ly)
            gz += slope * (same * dz - towards * lz)
    mean = total / w.samples
    scale = reach / w.samples
    return mean * reach, scale * gx - mean * lx, scale * gy - mean * ly, scale * gz - mean * lz


@helper
def _total(
    path: Float,
    slots: Float,
    actor: Float,
    others: Float,
    grid: Grid,
    w: Weights,
    terms: Float,
    gradient: Float,
) -> float:
    """Cost of a path [N + 3, 3]; fills `terms`, in the order of `local.TERMS`, and `gradient`."""
    n = slots.shape[0]
    gradient[:] = 0.0
    terms[:] = 0.0
    terms[0] = _add_smoothness(path, w, gradient)
    for i in range(n):
        q = path[i + 3]
        for axis in range(3):
            off = q[axis] - slots[i, axis]
            terms[1] += off * off / (2.0 * n)
            gradient[i, axis] += w.l_form * off / n

        # Costs per time become costs per way: everything below is multiplied by the (regularised) speed,
        # whose own gradient reaches the two waypoints that the velocity is made of.
        last = i == n - 1
        after, width = (i + 3, w.step_s) if last else (i + 4, 2.0 * w.step_s)
        vx = (path[after, 0] - path[i + 2, 0]) / width
        vy = (path[after, 1] - path[i + 2, 1]) / width
        vz = (path[after, 2] - path[i + 2, 2]) / width
        speed = math.sqrt(vx * vx + vy * vy + vz * vz + w.speed_floor_mps * w.speed_floor_mps)
        d, dx, dy, dz = _interpolate(grid, q[0], q[1], q[2])
        c, slope = _hinge(d, w.eps_obs_m)
        sight, sx, sy, sz = _sight_cost(grid, q, actor[i], w)
        terms[2] += c * speed * w.step_s
        terms[3] += sight * speed * w.step_s
        obs, occ = w.l_obs * slope * speed * w.step_s, w.l_occ * speed * w.step_s
        gradient[i, 0] += obs * dx + occ * sx
        gradient[i, 1] += obs * dy + occ * sy
        gradient[i, 2] += obs * dz + occ * sz
        by_speed = (w.l_obs * c + w.l_occ * sight) * w.step_s / (max(speed, 1e-9) * width)
        gradient[after - 3, 0] += by_speed * vx
        gradient[after - 3, 1] += by_speed * vy
        gradient[after - 3, 2] += by_speed * vz
        if i >= 1:
            gradient[i - 1, 0] -= by_speed * vx
            gradient[i - 1, 1] -= by_speed * vy
            gradient[i - 1, 2] -= by_speed * vz

        for o in range(others.shape[0]):
            ox, oy, oz = q[0] - others[o, i, 0], q[1] - others[o, i, 1], q[2] - others[o, i, 2]
            apart = max(math.sqrt(ox * ox + oy * oy + oz * oz), 1e-9)
            if apart < w.soft_separation_m:
                short = w.soft_separation_m - apart
                terms[4] += short * short / (2.0 * n)
                push = w.l_sep * short / (apart * n)
                gradient[i, 0] -= push * ox
                gradient[i, 1] -= push * oy
                gradient[i, 2] -= push * oz
    return float(
        terms[0] + w.l_form * terms[1] + w.l_obs * terms[2] + w.l_occ * terms[3] + w.l_sep * terms[4]
    )


@cached
def evaluate(
    path: Float,
    slots: Float,
    actor: Float,
    others: Float,
    grid: Grid,
    w: Weights,
    terms: Float,
    gradient: Float,
) -> float:
    """`_total`, for who wants to look: cost of path [N + 3, 3], terms [5] and gradient [N, 3] filled."""
    return _total(path, slots, actor, others, grid, w, terms, gradient)


# --- covariant gradient descent ------------------------------------------------------------------------


@cached
def factorise(n: int, w: Weights) -> Float:
    """Cholesky factor of (A_smooth + l_form I)/N, banded: [N, 4], column b holds L[i, i - b]."""
    h = 1.0 / w.step_s
    stencil = np.array([[1.0, -1.0, 0.0, 0.0], [1.0, -2.0, 1.0, 0.0], [1.0, -3.0, 3.0, -1.0]])
    weight = np.array([w.a_velocity * h**2, w.a_acceleration * h**4, w.a_jerk * h**6])
    band = np.zeros((n, 4))
    for i in range(n):
        band[i, 0] += w.l_form / n
        for order in range(3):
            for a in range(min(3, i) + 1):
                for b in range(a, min(3, i) + 1):
                    band[i - a, b - a] += weight[order] * stencil[order, a] * stencil[order, b] / n
    for i in range(n):
        for b in range(min(3, i), -1, -1):
            j = i - b
            value = band[i, b]
            for m in range(max(0, i - 3), j):
                value -= band[i, i - m] * band[j, j - m]
            band[i, b] = math.sqrt(value) if b == 0 else value / band[j, 0]
    return band


@helper
def _apply_inverse(factor: Float, gradient: Float, step: Float) -> None:
    """Set `step` to M^-1 gradient, [N, 3]."""
    n = factor.shape[0]
    for axis in range(3):
        for i in range(n):
            value = gradient[i, axis]
            for b in range(1, min(3, i) + 1):
                value -= factor[i, b] * step[i - b, axis]
            step[i, axis] = value / factor[i, 0]
        for i in range(n - 1, -1, -1):
            value = step[i, axis]
            for b in range(1, min(3, n - 1 - i) + 1):
                value -= factor[i + b, b] * step[i + b, axis]
            step[i, axis] = value / factor[i, 0]


@cached
def descend(
    path: Float,
    slots: Float,
    actor: Float,
    others: Float,
    grid: Grid,
    w: Weights,
    factor: Float,
    iterations: int,
    tolerance: float,
    step_cap_m: float,
) -> tuple[Float, float, int]:
    """Improve a path [N + 3, 3]: the new path, its cost, and how many evaluations it took."""
    n = slots.shape[0]
    path, tried = path.copy(), path.copy()
    gradient, tried_gradient, step = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    terms = np.zeros(5)
    cost = _total(path, slots, actor, others, grid, w, terms, gradient)
    eta = 1.0
    fresh = True
    for used in range(1, iterations):
        if fresh:
            _apply_inverse(factor, gradient, step)
            expected = largest = 0.0
            for i in range(n):
                for axis in range(3):
                    expected += gradient[i, axis] * step[i, axis] / 2.0
                    largest = max(largest, abs(step[i, axis]))
            if expected < tolerance:
                return path, cost, used
        scale = min(1.0 / eta, step_cap_m / largest)
        for i in range(n):
            for axis in range(3):
                tried[i + 3, axis] = path[i + 3, axis] - scale * step[i, axis]
        tried_cost = _total(tried, slots, actor, others, grid, w, terms, tried_gradient)
        fresh = tried_cost < cost
        if fresh:
            path, tried = tried, path
            gradient, tried_gradient = tried_gradient, gradient
            cost = tried_cost
            eta = max(eta / 1.5, _FASTEST_STEP)
        else:
            eta *= 3.0
            if eta > _SLOWEST_STEP:
                return path, cost, used + 1
    return path, cost, iterations
