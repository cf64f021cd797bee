"""Estimate and forecast of the actor: a Kalman filter with a constant-velocity model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float

_FIRST_SPEED_MPS = 3.0  # standard deviation per axis before a second measurement: people run


class Forecast(NamedTuple):
    """The actor at the T knots of a plan."""

    position: Float  # [T, 3] metres, world
    heading_rad: Float  # [T] zero of yaws, counterclockwise from east: 0 in the world frame

    def each(self, every: int) -> Forecast:
        """Return every so many knots, at least the last one."""
        rows = slice(every - 1, None, every) if len(self.position) >= every else slice(-1, None)
        return Forecast(self.position[rows], self.heading_rad[rows])


class ActorFilter:
    """Position and velocity of the actor from the measurements so far, and nothing later.

    x = [p, v] per axis, F = [[1, dt], [0, 1]], Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]] (white noise
    acceleration), measurements of the position with standard deviation `sigma_m` per axis. All three axes
    have the same model and noise, so that one 2x2 covariance serves them all.

    Args:
        q: m^2/s^3, spectral density of the acceleration's noise.
        sigma_m: of the measured position, per axis.
    """

    def __init__(self, *, q: float, sigma_m: float) -> None:
        self._q = q
        self._variance = sigma_m**2
        self._t_s: float | None = None
        self._state = np.zeros((2, 3))
        self._covariance = np.diag([self._variance, _FIRST_SPEED_MPS**2])

    def measure(self, t_s: float, position: Float) -> None:
        """Update with one measured position [3], metres, world, not earlier than the last one.

        Raises:
            ValueError: the time goes backwards, or the position is not finite.
        """
        if not np.isfinite(position).all():
            raise ValueError("a measured position must be finite: leave out what was not measured")
        if self._t_s is None:
            self._state[0] = position
            self._t_s = t_s
            return
        state, P = self._predicted(t_s)
        gain = P[:, 0] / (P[0, 0] + self._variance)
        self._state = state + gain[:, None] * (position - state[0])
        # Joseph's form: stays positive definite whatever the rounding.
        keep = np.array([[1.0 - gain[0], 0.0], [-gain[1], 1.0]])
        kept = np.einsum("ij,jk,lk->il", keep, P, keep)
        self._covariance = kept + self._variance * gain[:, None] * gain
        self._t_s = t_s

    def at(self, t_s: float) -> tuple[Float, Float, Float]:
        """Predict the state (position m, velocity m/s, [3] each) and covariance [2, 2] per axis.

        The time must be at or after the last measurement.

        Raises:
            ValueError: nothing was measured yet, or the time is before the last measurement.
        """
        state, covariance = self._predicted(t_s)
        return state[0], state[1], covariance

    def forecast(self, t_s: Float) -> Float:
        """Forecast positions [T, 3] at times [T], none of them before the last measurement."""
        if self._t_s is None:
            raise ValueError("nothing was measured yet")
        ahead = t_s - self._t_s
        if ahead.size and ahead.min() < 0:
            raise ValueError("a forecast looks ahead of the last measurement")
        where: Float = self._state[0] + ahead[:, None] * self._state[1]
        return where

    def _predicted(self, t_s: float) -> tuple[Float, Float]:
        if self._t_s is None:
            raise ValueError("nothing was measured yet")
        dt = t_s - self._t_s
        if dt < 0:
            raise ValueError(f"time goes back by {-dt:g} s")
        F = np.array([[1.0, dt], [0.0, 1.0]])
        Q = self._q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        state = np.stack([self._state[0] + dt * self._state[1], self._state[1]])
        return state, np.einsum("ij,jk,lk->il", F, self._covariance, F) + Q
