"""Trajectory of each drone: covariant gradient descent about the slots (Bonatti et al. 2020; CHOMP).

J = J_smooth + l_obs J_obs + l_occ J_occ + l_form J_form + l_sep J_sep over N waypoints, start fixed by
position and velocity, end free (t_f = N step_s):

    J_smooth  1/(2 t_f) sum_d a_d int |x^(d)|^2, d = 1..3, finite differences
    J_form    1/(2 t_f) int |x - slot|^2
    J_obs     int c(x; eps_obs) s dt, s = sqrt(|v|^2 + v0^2)
    J_occ     int int c(p; eps_occ) |dp| s dt along the sight line, up to `sight_start_m` from the actor
    J_sep     1/t_f int sum max(0, soft - distance)^2 / 2 over the other drones' latest plans

c is CHOMP's hinge of the signed distance. With s = |v| (v0 = 0, as published) obstacles have no effect on a
drone at rest. Gradients are exact derivatives of the discretised sums, so that a small step along them lowers
the cost that is compared. In the limit they are the functional gradients of the papers. The kernels have no
threads and no fastmath: the same numbers give the same bytes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.compilation import cached, helper
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import DIAGONAL, DistanceField, Grid, interpolate, nearest

# --- tracking of a plan ---

# The acceleration is a = a_reference + k_p e + k_v e' + k_i integral of e. Each plan starts at the drone's
# position, so that errors restart small at 5 Hz: without the reference's acceleration a drone would fly less
# than half of every planned turn. Acceleration, jerk and speed keep to their limits by construction:
# |a| <= A by shortening; |a - a_before| <= J period, as both ends lie in the ball |a| <= A;
# |v + a LOOKAHEAD_S| <= V by turning the acceleration before the speed is reached.

POSITION, VELOCITY, ACCELERATION, INTEGRAL = range(4)
"""Rows of a drone's state [4, 3]: m, m/s, m/s^2, and the integral of the position error in m s."""

# Forecasts of a person who may turn are not trusted beyond two seconds.
ACTOR_AHEAD_S = 2.0
# Acceleration changes from limit to limit in 0.16 s by default, which has to end before the speed's limit.
LOOKAHEAD_S = 0.25
# The deceleration falls with the speed in the end of a stop, which so ends without a jerk.
BRAKING_PER_S = 3.0
# A drone that moves by less than a millimetre a second stands.
STOPPED_MPS = 1e-3
# The exponential end of a stop from 1.3 m/s to 1 mm/s takes 2.4 s.
STOP_MARGIN_S = 3.5


@dataclass(frozen=True)
class DronePlan:
    """Waypoints of one drone, evenly spaced in time."""

    start_s: float
    path: Float  # [N + 1, 3] metres, world, from the position at the start
    velocity: Float  # [3] m/s at the start
    step_s: float

    def at(self, t_s: Float) -> tuple[Float, Float, Float]:
        """Evaluate position, velocity and acceleration, each [T, 3], at times [T] not before the start.

        Cubic Hermite pieces whose slopes are central differences; after the last waypoint straight on.
        """
        position, velocity, acceleration = (np.empty((len(t_s), 3)) for _ in range(3))
        _evaluate_plan(
            self.path, self.velocity, self.step_s, t_s - self.start_s, position, velocity, acceleration
        )
        return position, velocity, acceleration


class Flying(NamedTuple):
    """Flight parameters of a drone: the gains of its PID, its limits, and its period."""

    k_position: float
    k_velocity: float
    k_integral: float
    acceleration_mps2: float
    jerk_mps3: float
    speed_mps: float
    period_s: float


def flying_of(config: PlannerConfig) -> Flying:
    """Return gains, limits and period of the drones."""
    return Flying(
        config.tuning.k_position,
        config.tuning.k_velocity,
        config.tuning.k_integral,
        config.acceleration_mps2,
        config.jerk_mps3,
        config.ground_speed_mps,
        1.0 / config.tuning.tracking_hz,
    )


def tracking_times(actor_t_ns: Int64, config: PlannerConfig) -> Int64:
    """Return the times [T] of a replay: every tracking step from the first measurement to the last."""
    first_ns, last_ns = int(actor_t_ns[0]), int(actor_t_ns[-1])
    period_ns = round(1e9 / config.tuning.tracking_hz)
    return first_ns + period_ns * np.arange((last_ns - first_ns) // period_ns + 1, dtype=np.int64)


@helper
def _reference(
    path: Float, start_velocity: Float, h: float, after_s: float, x: Float, v: Float, a: Float
) -> None:
    """Evaluate the position, velocity and acceleration [3] of a plan at one time."""
    last = path.shape[0] - 1
    k = min(max(int(after_s / h), 0), last - 1)
    u = after_s / h - k
    for axis in range(3):
        p0, p1 = path[k, axis], path[k + 1, axis]
        m0 = start_velocity[axis] * h if k == 0 else (p1 - path[k - 1, axis]) / 2.0
        m1 = p1 - p0 if k + 1 == last else (path[k + 2, axis] - p0) / 2.0
        if u > 1.0:
            x[axis], v[axis], a[axis] = p1 + (u - 1.0) * m1, m1 / h, 0.0
            continue
        c3, c2 = 2.0 * (p0 - p1) + m0 + m1, 3.0 * (p1 - p0) - 2.0 * m0 - m1
        x[axis] = ((c3 * u + c2) * u + m0) * u + p0
        v[axis] = ((3.0 * c3 * u + 2.0 * c2) * u + m0) / h
        a[axis] = (6.0 * c3 * u + 2.0 * c2) / (h * h)


@cached
def _evaluate_plan(
    path: Float, start_velocity: Float, h: float, after_s: Float, x: Float, v: Float, a: Float
) -> None:
    for p in range(after_s.size):
        _reference(path, start_velocity, h, after_s[p], x[p], v[p], a[p])


@helper
def _shorten(vector: Float, longest: float) -> bool:
    """Limit the length of [3] to `longest`, in place; keep the direction. Return True if it was longer."""
    length = math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    if length <= longest:
        return False
    share = longest / length
    for axis in range(3):
        vector[axis] *= share
    return True


@helper
def _fly(wanted: Float, flying: Flying, state: Float, following: Float, scratch: Float) -> bool:
    """Fly one period at `wanted` [3], shortened to the limits."""
    shortened = _shorten(wanted, flying.acceleration_mps2)
    for axis in range(3):
        scratch[axis] = state[VELOCITY, axis] + wanted[axis] * LOOKAHEAD_S
    if _shorten(scratch, flying.speed_mps):
        shortened = True
        for axis in range(3):
            wanted[axis] = (scratch[axis] - state[VELOCITY, axis]) / LOOKAHEAD_S
        _shorten(wanted, flying.acceleration_mps2)
    for axis in range(3):
        scratch[axis] = wanted[axis] - state[ACCELERATION, axis]
    _shorten(scratch, flying.jerk_mps3 * flying.period_s)
    dt = flying.period_s
    for axis in range(3):
        a, v = state[ACCELERATION, axis] + scratch[axis], state[VELOCITY, axis]
        following[POSITION, axis] = state[POSITION, axis] + v * dt + a * (dt * dt / 2.0)
        following[VELOCITY, axis] = v + a * dt
        following[ACCELERATION, axis] = a
    return shortened


@helper
def _copy_state(source: Float, into: Float) -> None:
    """Copy a state; assignments to slices would take seconds to compile."""
    for row in range(source.shape[0]):
        for axis in range(3):
            into[row, axis] = source[row, axis]


@cached
def roll_out(
    path: Float,
    start_velocity: Float,
    step_s: float,
    after_s: float,
    ticks: int,
    flying: Flying,
    states: Float,
) -> int:
    """Follow a plan `path` [N + 1, 3], then brake: fill `states` after the first; return the stop's row."""
    x, v, a, wanted, scratch = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    braking = min(BRAKING_PER_S, 0.5 * flying.jerk_mps3 / flying.acceleration_mps2)
    last = states.shape[0] - 1
    for k in range(last):
        state, following = states[k], states[k + 1]
        _copy_state(state, following)
        if k < ticks:
            _reference(path, start_velocity, step_s, after_s + k * flying.period_s, x, v, a)
            for axis in range(3):
                error = x[axis] - state[POSITION, axis]
                following[INTEGRAL, axis] += error * flying.period_s
                wanted[axis] = (
                    a[axis]
                    + flying.k_position * error
                    + flying.k_velocity * (v[axis] - state[VELOCITY, axis])
                    + flying.k_integral * following[INTEGRAL, axis]
                )
            # Anti-windup: the integral stops while a limit holds.
            if _fly(wanted, flying, state, following, scratch):
                for axis in range(3):
                    following[INTEGRAL, axis] = state[INTEGRAL, axis]
            continue
        square = 0.0
        for axis in range(3):
            wanted[axis] = -braking * state[VELOCITY, axis]
        _fly(wanted, flying, state, following, scratch)
        for axis in range(3):
            following[INTEGRAL, axis] = 0.0
            square += following[VELOCITY, axis] ** 2
        if square < STOPPED_MPS**2:
            for axis in range(3):
                following[VELOCITY, axis] = following[ACCELERATION, axis] = 0.0
            for rest in range(k + 2, last + 1):
                _copy_state(following, states[rest])
            return k + 1
    return int(last)


def stopping_ticks(flying: Flying) -> int:
    """Return the largest number of periods that any stop takes."""
    slow_s = flying.speed_mps / flying.acceleration_mps2 + flying.acceleration_mps2 / flying.jerk_mps3
    return math.ceil((slow_s + STOP_MARGIN_S) / flying.period_s)


TERMS = ("smooth", "form", "obs", "occ", "sep")
# Beyond this divisor of a Newton step nothing moves.
MAX_ETA = 1e4
# Steps of more than five Newton steps are not tried.
MIN_ETA = 0.2
# A plan that ends farther off the slot may be in a local minimum.
ASTRAY_M = 3.0


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
    sight_start_m: float
    speed_floor_mps: float
    step_s: float  # between waypoints
    samples: int  # along a sight line


def weights_of(config: PlannerConfig, resolution_m: float) -> Weights:
    """Return the weights; sight lines from `radius_m` are sampled every half voxel."""
    reach_m = max(config.radius_m - config.tuning.sight_start_m, resolution_m)
    return Weights(
        l_obs=config.l_obs,
        l_occ=config.l_occ,
        l_form=config.l_form,
        l_sep=config.tuning.l_sep,
        a_velocity=config.tuning.a_velocity,
        a_acceleration=config.tuning.a_acceleration,
        a_jerk=config.tuning.a_jerk,
        eps_obs_m=config.tuning.eps_obs_m,
        eps_occ_m=config.tuning.eps_occ_m,
        sight_start_m=config.tuning.sight_start_m,
        speed_floor_mps=config.tuning.speed_floor_mps,
        step_s=config.tuning.waypoint_s,
        samples=max(math.ceil(2 * reach_m / resolution_m), 4),
    )


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
    """Compute the squared velocity, acceleration and jerk, and add to the gradient."""
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
    """Compute the hinge cost along the sight line, times its length, and its gradient by the position q."""
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
    """Compute the cost of a path [N + 3, 3]; fill `terms`, in the order of `TERMS`, and `gradient`.

    `others` [M, N, 4] are places of others, and the distance below which the path avoids them.
    """
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
            if apart < others[o, i, 3]:
                short = others[o, i, 3] - apart
                terms[4] += short * short / (2.0 * n)
                push = w.l_sep * short / (apart * n)
                gradient[i, 0] -= push * ox
                gradient[i, 1] -= push * oy
                gradient[i, 2] -= push * oz
    return float(
        terms[0] + w.l_form * terms[1] + w.l_obs * terms[2] + w.l_occ * terms[3] + w.l_sep * terms[4]
    )


@cached
def _evaluate(
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
def _factorise(n: int, w: Weights) -> Float:
    """Compute the Cholesky factor of (A_smooth + l_form I)/N, banded: [N, 4]."""
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
def _descend(
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
) -> tuple[Float, float]:
    """Improve a path [N + 3, 3]; return the new path and its cost."""
    n = slots.shape[0]
    path, tried = path.copy(), path.copy()
    gradient, tried_gradient, step = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    terms = np.zeros(5)
    cost = _total(path, slots, actor, others, grid, w, terms, gradient)
    eta = 1.0
    fresh = True
    for _ in range(1, iterations):
        if fresh:
            _apply_inverse(factor, gradient, step)
            expected = largest = 0.0
            for i in range(n):
                for axis in range(3):
                    expected += gradient[i, axis] * step[i, axis] / 2.0
                    largest = max(largest, abs(step[i, axis]))
            if expected < tolerance:
                return path, cost
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
            eta = max(eta / 1.5, MIN_ETA)
        else:
            eta *= 3.0
            if eta > MAX_ETA:
                return path, cost
    return path, cost


class LocalPlanner:
    """The optimiser of one configuration; it factorises its metric once and keeps no other state."""

    def __init__(self, config: PlannerConfig) -> None:
        self._config = config
        self._factor = _factorise(config.tuning.waypoints, weights_of(config, 1.0))
        self._weights: dict[float, Weights] = {}

    def plan(
        self,
        t_s: float,
        position: Float,
        velocity: Float,
        *,
        slots: Float,
        actor: Float,
        others: Sequence[DronePlan],
        people: Float,
        field: DistanceField,
        previous: DronePlan | None,
    ) -> DronePlan:
        """Plan from the drone's place and velocity [3].

        `slots` and `actor` [N, 3] are the wanted places and the forecast at each waypoint's time, `others`
        the latest plans of other drones, `people` [P, N + 1, 3] the forecast of everybody from now on,
        `previous` the initial guess: without one it is the slots.
        """
        config = self._config
        times = t_s + config.tuning.waypoint_s * np.arange(1, config.tuning.waypoints + 1, dtype=np.float64)
        avoided = np.empty((len(others) + 2 * len(people), len(times), 4))
        for row, plan in zip(avoided, others, strict=False):
            row[:, :3], row[:, 3] = plan.at(times)[0], config.soft_separation_m
        walking, standing = np.split(avoided[len(others) :], 2)
        walking[..., :3], walking[..., 3] = people[:, 1:], config.soft_actor_distance_m
        standing[..., :3] = people[:, :1]
        standing[..., 3] = np.where(times - t_s <= ACTOR_AHEAD_S, config.soft_actor_distance_m, 0.0)
        guess = slots if previous is None else previous.at(times)[0]
        path, cost = self._descended(position, velocity, guess, slots, actor, avoided, field)
        if previous is not None and np.linalg.norm(path[-1] - slots[-1]) > ASTRAY_M:
            # Caught behind something: descend once more from the slots, and take the better result.
            other = self._descended(position, velocity, slots, slots, actor, avoided, field)
            if other[1] < cost:
                path = other[0]
        return DronePlan(t_s, path[2:].copy(), velocity.copy(), config.tuning.waypoint_s)

    def _descended(
        self,
        position: Float,
        velocity: Float,
        guess: Float,
        slots: Float,
        actor: Float,
        others: Float,
        field: DistanceField,
    ) -> tuple[Float, float]:
        """Descend from a guess [N, 3]: path [N + 3, 3] and cost. `others` is [M, N, 4]."""
        config = self._config
        return _descend(
            _with_start(position, velocity, guess, config.tuning.waypoint_s),
            np.ascontiguousarray(slots),
            np.ascontiguousarray(actor),
            others,
            field.grid,
            self._weights_for(field),
            self._factor,
            config.tuning.iterations,
            config.tuning.tolerance,
            config.tuning.step_cap_m,
        )

    def cost(
        self,
        position: Float,
        velocity: Float,
        waypoints: Float,
        *,
        slots: Float,
        actor: Float,
        others: Float,
        field: DistanceField,
    ) -> tuple[float, dict[str, float], Float]:
        """Compute the cost of waypoints [N, 3]: total, unweighted terms, gradient [N, 3]; as in `plan`."""
        terms, gradient = np.zeros(len(TERMS)), np.zeros_like(waypoints)
        path = _with_start(position, velocity, waypoints, self._config.tuning.waypoint_s)
        total = _evaluate(path, slots, actor, others, field.grid, self._weights_for(field), terms, gradient)
        return total, dict(zip(TERMS, terms.tolist(), strict=True)), gradient

    def _weights_for(self, field: DistanceField) -> Weights:
        side = field.grid.resolution_m
        if side not in self._weights:
            self._weights[side] = weights_of(self._config, side)
        return self._weights[side]


def _with_start(position: Float, velocity: Float, waypoints: Float, step_s: float) -> Float:
    """Return [N + 3, 3]: past and present positions at the drone's velocity, and the waypoints."""
    back = np.array([-2.0, -1.0, 0.0])[:, None] * step_s
    return np.concatenate([position + back * velocity, waypoints])
