"""Estimate and forecast of the actor: a Kalman filter with constant velocity."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float, Int64

# People run: the standard deviation per axis of the speed before a second measurement.
FIRST_SPEED_SIGMA_MPS = 3.0


class Forecast(NamedTuple):
    """The actor at the T knots of a plan; of several people their weighted middle, and each of the P."""

    position: Float  # [T, 3] metres, world
    people: Float | None = None  # [P, T, 3] metres, world; None: the actor alone
    weight: Float | None = None  # [P]; None: all alike


class ActorFilter:
    """Position and velocity of people from the measurements so far; as one actor they are their middle.

    x = [p, v] per axis, F = [[1, dt], [0, 1]], Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]] (white noise
    acceleration of spectral density q, m^2/s^3); one 2x2 covariance serves all axes of a person.
    """

    def __init__(self, *, q: float, sigma_m: float, weight: Sequence[float] | Float = (1.0,)) -> None:
        self._q, self._variance = q, sigma_m**2
        self._weight: Float = np.asarray(weight, np.float64) / np.sum(weight)
        people = len(self._weight)
        self._t_s = np.full(people, np.nan)  # of the last measurement
        self._state = np.zeros((people, 2, 3))
        self._covariance = np.tile(np.diag([self._variance, FIRST_SPEED_SIGMA_MPS**2]), (people, 1, 1))

    def measure(self, t_s: float, position: Float, person: int = 0) -> None:
        """Update with a measured position [3] of a person, m, world, not earlier than the last one."""
        state, dt = self._state[person], t_s - self._t_s[person]
        self._t_s[person] = t_s
        if np.isnan(dt):
            state[0] = position
            return
        F = np.array([[1.0, dt], [0.0, 1.0]])
        Q = self._q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        P = np.einsum("ij,jk,lk->il", F, self._covariance[person], F) + Q
        gain = P[:, 0] / (P[0, 0] + self._variance)
        state[0] += dt * state[1]
        state += gain[:, None] * (position - state[0])
        # Joseph's form: stays positive definite whatever the rounding.
        keep = np.array([[1.0 - gain[0], 0.0], [-gain[1], 1.0]])
        kept = np.einsum("ij,jk,lk->il", keep, P, keep)
        self._covariance[person] = kept + self._variance * gain[:, None] * gain

    def each(self, t_s: Float) -> Float:
        """Forecast everybody, [P, T, 3], at times [T] after the last measurements."""
        ahead = t_s - self._t_s[:, None]
        where: Float = self._state[:, None, 0] + ahead[..., None] * self._state[:, None, 1]
        return where

    def middle(self, people: Float) -> Float:
        """Return the weighted middle [T, 3] of people [P, T, 3]."""
        middle: Float = self._weight @ people.reshape(len(people), -1)
        return middle.reshape(people.shape[1:])


def positions_at(t_ns: Int64, people: Float, at_ns: Int64) -> Float:
    """Interpolate measured positions [A, P, 3] of people, NaN where somebody was not measured: [P, T, 3]."""
    found = np.empty((people.shape[1], len(at_ns), 3))
    for p in range(people.shape[1]):
        own = np.isfinite(people[:, p]).all(axis=1)
        for axis in range(3):
            found[p, :, axis] = np.interp(at_ns, t_ns[own], people[own, p, axis])
    return found
