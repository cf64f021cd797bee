"""Tracking of a plan: its reference at a time, and a point mass that a PID keeps on it within limits.

The acceleration is a = a_reference + k_p e + k_v e' + k_i integral of e. Each plan starts at the drone's
position, so that errors restart small at 5 Hz: without the reference's acceleration a drone would fly less
than half of every planned turn. Acceleration, jerk and speed keep to their limits by construction:

    |a| <= A        by shortening
    |a - a_before| <= J period      both ends lie in the ball |a| <= A, so every point between them does
    |v + a LOOKAHEAD_S| <= V        by turning the acceleration before the speed is reached
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.compilation import cached, helper
from pipelines.planning.config import PlannerConfig

POSITION, VELOCITY, ACCELERATION, INTEGRAL = range(4)
"""Rows of a drone's state [4, 3]: m, m/s, m/s^2, and the integral of the position error in m s."""

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
        _evaluate(self.path, self.velocity, self.step_s, t_s - self.start_s, position, velocity, acceleration)
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
        config.speed_mps,
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
def _evaluate(
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
    """Follow a plan for some periods and then brake to a stop; return the row of the stop.

    The plan is `path` [N + 1, 3] m, its first velocity and step; `after_s` is the time from its start to the
    drone's state `states[0]`. The others of `states` [K + 1, 4, 3] are written; all after the stop are like
    it.
    """
    x, v, a, wanted, scratch = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    braking = min(BRAKING_PER_S, 0.5 * flying.jerk_mps3 / flying.acceleration_mps2)
    last = states.shape[0] - 1
    for k in range(last):
        state, following = states[k], states[k + 1]
        following[:] = state
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
                following[INTEGRAL] = state[INTEGRAL]
            continue
        square = 0.0
        for axis in range(3):
            wanted[axis] = -braking * state[VELOCITY, axis]
        _fly(wanted, flying, state, following, scratch)
        for axis in range(3):
            following[INTEGRAL, axis] = 0.0
            square += following[VELOCITY, axis] ** 2
        if square < STOPPED_MPS**2:
            following[VELOCITY] = 0.0
            following[ACCELERATION] = 0.0
            for rest in range(k + 2, last + 1):
                states[rest] = following
            return k + 1
    return int(last)


def stopping_ticks(flying: Flying) -> int:
    """Return the largest number of periods that any stop takes."""
    slow_s = flying.speed_mps / flying.acceleration_mps2 + flying.acceleration_mps2 / flying.jerk_mps3
    return math.ceil((slow_s + STOP_MARGIN_S) / flying.period_s)
