"""The compiled arithmetic that reads the distance field: interpolation, sight lines, the local planner.

All of it stands in this one module: numba's cache watches the file of the outermost function only, so a
helper in another file could change without the cached code noticing. No threads and no fastmath: the same
numbers give the same bytes. `distance_field`, `costs` and `local` are the users and explain the methods.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.compilation import cached, helper

Float = NDArray[np.float64]
Vector = tuple[float, float, float]

# From a point to the centre of its voxel it is at most half a diagonal; to a corner of the cell in which it
# is interpolated, and from the one to the other, at most a whole one. In voxels:
_DIAGONAL = math.sqrt(3.0)
_SLOWEST_STEP, _FASTEST_STEP = (
    1e4,
    0.2,
)  # eta: beyond the first nothing moves, the second is five Newton steps


class Grid(NamedTuple):
    """A signed distance field as the kernels take it."""

    distance_m: NDArray[np.float32]  # [X, Y, Z], at least two voxels along each axis
    origin: Float  # [3] m, the corner of voxel (0, 0, 0)
    resolution_m: float


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
            samples per metre, and how many the way from a point to the centres of its voxel and of another
            one takes at most, less half a voxel.
    """
    length = math.sqrt(x * x + y * y + z * z)
    if length <= start_m:
        return 0
    count = math.ceil((length - start_m) / (0.5 * side_m) - 1e-9)
    step_m = (length - start_m) / count
    for axis, way in enumerate((x, y, z)):
        per_m = way / (length * side_m)
        rule[axis], rule[3 + axis] = per_m * (start_m + step_m / 2.0), per_m * step_m
        rule[6 + axis] = 1.0 / rule[3 + axis]
    rule[9], rule[10] = 1.0 / step_m, (_DIAGONAL - 0.5) * side_m / step_m
    return count


@helper
def _samples_inside(first: float, per: float, size: int, low: float, high: float) -> tuple[float, float]:
    """Which of the samples `low` to `high` lie in the grid along an axis; `per` is one over the step."""
    if math.isinf(per):
        return (low, high) if 0.0 <= first < size else (high, high)
    one, other = -first * per, (size - first) * per
    return max(low, min(one, other)), min(high, max(one, other))


@helper
def _look(d: NDArray[np.float32], x: float, y: float, z: float, rule: Float) -> tuple[bool, int]:
    """Whether a voxel is occupied, and how many samples to either side are as it is, without a look."""
    i = min(max(int(x), 0), d.shape[0] - 1)
    j = min(max(int(y), 0), d.shape[1] - 1)
    k = min(max(int(z), 0), d.shape[2] - 1)
    distance = float(d[np.uintp(i), np.uintp(j), np.uintp(k)])
    return distance < 0.0, max(int(abs(distance) * rule[9] - rule[10]), 0)


@helper
def _occupied_samples(grid: Grid, actor: Float, rule: Float, count: int) -> int:
    """How many samples of a sight line from an actor [3] lie in occupied voxels.

    A voxel's distance says how far all is alike; that many samples need no look. Taken from both ends at
    once, because the processor can follow two leaps that do not depend on each other.
    """
    d = grid.distance_m
    x = (actor[0] - grid.origin[0]) / grid.resolution_m + rule[0]
    y = (actor[1] - grid.origin[1]) / grid.resolution_m + rule[1]
    z = (actor[2] - grid.origin[2]) / grid.resolution_m + rule[2]
    first, end = _samples_inside(x, rule[6], d.shape[0], 0.0, float(count))
    first, end = _samples_inside(y, rule[7], d.shape[1], first, end)
    first, end = _samples_inside(z, rule[8], d.shape[2], first, end)
    if not first < end:
        return 0
    low, high = math.ceil(first), math.ceil(end)
    occupied = 0
    while low < high:
        top = high - 1
        near_is, near = _look(d, x + low * rule[3], y + low * rule[4], z + low * rule[5], rule)
        far_is, far = _look(d, x + top * rule[3], y + top * rule[4], z + top * rule[5], rule)
        after, before = low + 1 + near, top - far
        occupied += near_is * (min(after, high) - low) + far_is * max(high - max(before, after), 0)
        low, high = after, before
    return occupied


@cached
def sample(grid: Grid, points: Float, distance: Float, gradient: Float) -> None:
    """Distances [P] and gradients [P, 3] at points [P, 3], written into the last two."""
    for p in range(points.shape[0]):
        value, gx, gy, gz = _interpolate(grid, points[p, 0], points[p, 1], points[p, 2])
        distance[p] = value
        gradient[p, 0], gradient[p, 1], gradient[p, 2] = gx, gy, gz


@cached
def line_shares(grid: Grid, actor: Float, camera: Float, start_m: float, share: Float) -> None:
    """Occupied shares [P] of the sight lines between points [P, 3] and [P, 3], written into `share`."""
    rule = np.zeros(11)
    for p in range(actor.shape[0]):
        x, y, z = camera[p, 0] - actor[p, 0], camera[p, 1] - actor[p, 1], camera[p, 2] - actor[p, 2]
        count = _sampling(x, y, z, start_m, grid.resolution_m, rule)
        share[p] = _occupied_samples(grid, actor[p], rule, count) / count if count else 0.0


@cached
def slot_costs(
    grid: Grid, actor: Float, offsets: Float, eps_obs_m: float, start_m: float
) -> tuple[Float, Float]:
    """Obstacle cost and occupied share of the sight line, both [T, S, n].

    Args:
        grid: the distance field.
        actor: [T, 3] forecast.
        offsets: [S, n, 3] slots of every state, from the actor.
        eps_obs_m: the distance from which obstacles count.
        start_m: how far off the actor sight lines begin.
    """
    times, states, cameras = actor.shape[0], offsets.shape[0], offsets.shape[1]
    obstacle, share = np.zeros((times, states, cameras)), np.zeros((times, states, cameras))
    # Neighbouring sight lines follow each other, and find what they look up near at hand.
    rules, counts = np.zeros((cameras, states, 11)), np.zeros((cameras, states), np.int64)
    for i in range(cameras):
        for s in range(states):
            x, y, z = offsets[s, i]
            counts[i, s] = _sampling(x, y, z, start_m, grid.resolution_m, rules[i, s])
    for t in range(times):
        for i in range(cameras):
            for s in range(states):
                x, y = actor[t, 0] + offsets[s, i, 0], actor[t, 1] + offsets[s, i, 1]
                z = actor[t, 2] + offsets[s, i, 2]
                spare = _nearest(grid, x, y, z) - eps_obs_m
                if spare < _DIAGONAL * grid.resolution_m:
                    distance = _interpolate(grid, x, y, z)[0]
                    obstacle[t, s, i] = min(max(1.0 - distance / eps_obs_m, 0.0), 1.0)
                count = counts[i, s]
                if count:
                    share[t, s, i] = _occupied_samples(grid, actor[t], rules[i, s], count) / count
    return obstacle, share


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
