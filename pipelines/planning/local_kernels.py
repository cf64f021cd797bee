"""The local planner, compiled: its cost with its gradient, and covariant descent.

No threads and no fastmath: the same numbers give the same bytes.
`local` is the user and explains the method.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.compilation import cached, helper
from pipelines.planning.field_kernels import DIAGONAL, Grid, interpolate, nearest

_SLOWEST_STEP, _FASTEST_STEP = (
    1e4,
    0.2,
)  # eta: beyond the first nothing moves, the second is five Newton steps


class Weights(NamedTuple):
    """Weights of the local planner, by name; see `PlannerConfig`."""

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


@helper
def _hinge(distance: float, eps: float) -> tuple[float, float]:
    """Compute CHOMP's obstacle cost of a signed distance, and its derivative."""
    if distance < 0.0:
        return eps / 2.0 - distance, -1.0
    if distance <= eps:
        return (distance - eps) ** 2 / (2.0 * eps), (distance - eps) / eps
    return 0.0, 0.0


@helper
def _add_smoothness(path: Float, w: Weights, gradient: Float) -> float:
    """Compute the squared velocity, acceleration and jerk, and add to the gradient.

    `path` [N + 3, 3] begins with three fixed points.
    """
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
    """Compute the hinge cost along the sight line, times its length, and its gradient by the position q.

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
        # Far from obstacles the nearest voxel is enough: the cost is zero there and within that distance.
        spare = nearest(grid, x, y, z) - w.eps_occ_m - DIAGONAL * grid.resolution_m
        if spare > 0.0:
            k += 1 + max(0, int((spare - 0.5 * DIAGONAL * grid.resolution_m) / step))
            continue
        k += 1
        d, dx, dy, dz = interpolate(grid, x, y, z)
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
    """Compute the cost of a path [N + 3, 3]; fill `terms`, in the order of `local.TERMS`, and `gradient`."""
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
        d, dx, dy, dz = interpolate(grid, q[0], q[1], q[2])
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
    """Compute `_total`, for inspection: cost of path [N + 3, 3]; fill terms [5] and gradient [N, 3]."""
    return _total(path, slots, actor, others, grid, w, terms, gradient)


@cached
def factorise(n: int, w: Weights) -> Float:
    """Compute the Cholesky factor of (A_smooth + l_form I)/N, banded: [N, 4].

    Column b holds L[i, i - b].
    """
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
    """Improve a path [N + 3, 3]; return the new path, its cost, and the number of evaluations."""
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
