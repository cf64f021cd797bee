"""Flying a plan: what it asks for at a time, and a point mass that a PID keeps on it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.compilation import cached
from pipelines.planning.config import PlannerConfig

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Plan:
    """Waypoints of one drone, evenly spaced in time."""

    start_s: float
    path: Float  # [N + 1, 3] metres, world, from the position at the start
    velocity: Float  # [3] m/s at the start
    step_s: float

    def at(self, t_s: Float) -> tuple[Float, Float, Float]:
        """Position, velocity and acceleration, each [T, 3], at times [T] not before the start.

        Cubic Hermite pieces whose slopes are central differences; after the last waypoint straight on.
        """
        position, velocity, acceleration = (np.empty((len(t_s), 3)) for _ in range(3))
        _evaluate(self.path, self.velocity, self.step_s, t_s - self.start_s, position, velocity, acceleration)
        return position, velocity, acceleration


class Tracker:
    """Point masses that follow references: PID on the position and velocity, the acceleration limited.

    a = a_reference + k_p e + k_v e' + k_i integral of e, at most `acceleration_mps2` long. Each plan starts
    from where the drone is, so that errors restart small at 5 Hz: without the reference's acceleration a
    drone would fly less than half of every planned turn.

    Args:
        position: [N, 3] metres at the start.
        velocity: [N, 3] m/s at the start.
        config: gains, limit and rate.
    """

    def __init__(self, position: Float, velocity: Float, config: PlannerConfig) -> None:
        self.position, self.velocity = position.copy(), velocity.copy()
        self._integral = np.zeros_like(position)
        self._config = config

    def step(self, position: Float, velocity: Float, acceleration: Float) -> None:
        """Fly one period towards references [N, 3]."""
        c = self._config
        _advance(
            self.position,
            self.velocity,
            self._integral,
            position,
            velocity,
            acceleration,
            (c.k_position, c.k_velocity, c.k_integral),
            c.acceleration_mps2,
            1.0 / c.tracking_hz,
        )


@cached
def _evaluate(
    path: Float, start_velocity: Float, h: float, after_s: Float, x: Float, v: Float, a: Float
) -> None:
    last = path.shape[0] - 1
    for p in range(after_s.size):
        k = min(max(int(after_s[p] / h), 0), last - 1)
        u = after_s[p] / h - k
        for axis in range(3):
            p0, p1 = path[k, axis], path[k + 1, axis]
            m0 = start_velocity[axis] * h if k == 0 else (p1 - path[k - 1, axis]) / 2.0
            m1 = p1 - p0 if k + 1 == last else (path[k + 2, axis] - p0) / 2.0
            if u > 1.0:
                x[p, axis], v[p, axis], a[p, axis] = p1 + (u - 1.0) * m1, m1 / h, 0.0
                continue
            c3, c2 = 2.0 * (p0 - p1) + m0 + m1, 3.0 * (p1 - p0) - 2.0 * m0 - m1
            x[p, axis] = ((c3 * u + c2) * u + m0) * u + p0
            v[p, axis] = ((3.0 * c3 * u + 2.0 * c2) * u + m0) / h
            a[p, axis] = (6.0 * c3 * u + 2.0 * c2) / (h * h)


@cached
def _advance(
    x: Float,
    v: Float,
    integral: Float,
    wanted_x: Float,
    wanted_v: Float,
    wanted_a: Float,
    gains: tuple[float, float, float],
    limit: float,
    dt: float,
) -> None:
    a = np.zeros(3)
    for i in range(x.shape[0]):
        length = 0.0
        for axis in range(3):
            error = wanted_x[i, axis] - x[i, axis]
            integral[i, axis] += error * dt
            a[axis] = (
                wanted_a[i, axis]
                + gains[0] * error
                + gains[1] * (wanted_v[i, axis] - v[i, axis])
                + gains[2] * integral[i, axis]
            )
            length += a[axis] ** 2
        length = math.sqrt(length)
        scale = 1.0 if length <= limit else limit / length
        for axis in range(3):
            if scale < 1.0:  # what cannot be flown must not pile up
                integral[i, axis] -= (wanted_x[i, axis] - x[i, axis]) * dt
            x[i, axis] += v[i, axis] * dt + scale * a[axis] * dt * dt / 2.0
            v[i, axis] += scale * a[axis] * dt
