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
    """Position and velocity of the actor from the measurements so far, and nothing later.

    x = [p, v] per axis, F = [[1, dt], [0, 1]], Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]] (white noise
    acceleration of spectral density q, m^2/s^3); one 2x2 covariance serves all axes.
    """

    def __init__(self, *, q: float, sigma_m: float) -> None:
        self._q = q
        self._variance = sigma_m**2
        self._t_s: float | None = None
        self._state = np.zeros((2, 3))
        self._covariance = np.diag([self._variance, FIRST_SPEED_SIGMA_MPS**2])

    def measure(self, t_s: float, position: Float) -> None:
        """Update with one measured position [3], metres, world, not earlier than the last one.

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

    def forecast(self, t_s: Float) -> Float:
        """Forecast positions [T, 3] at times [T], none of them before the last measurement."""
        if self._t_s is None:
            raise ValueError("nothing was measured yet")
        ahead = t_s - self._t_s
        if ahead.size and ahead.min() < 0:
            raise ValueError("a forecast looks ahead of the last measurement")
        where: Float = self._state[0] + ahead[:, None] * self._state[1]
        return where

    def each(self, t_s: Float) -> Float:
        """Forecast everybody whom the filter follows, [1, T, 3]; see `PeopleFilter`."""
        return self.forecast(t_s)[None]

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


class PeopleFilter:
    """Estimates of several people, a filter for each; as one actor they are their middle by `weight` [P]."""

    def __init__(self, filters: Sequence[ActorFilter], weight: Float) -> None:
        self._filters, self._weight = tuple(filters), weight / weight.sum()

    def measure(self, t_s: float, position: Float, person: int = 0) -> None:
        """Update with a measured position [3] of a person; see `ActorFilter.measure`."""
        self._filters[person].measure(t_s, position)

    def middle(self, people: Float) -> Float:
        """Return the weighted middle [T, 3] of people [P, T, 3]."""
        middle: Float = self._weight @ people.reshape(len(people), -1)
        return middle.reshape(people.shape[1:])

    def each(self, t_s: Float) -> Float:
        """Forecast every person, [P, T, 3]."""
        return np.array([each.forecast(t_s) for each in self._filters])


def positions_at(t_ns: Int64, people: Float, at_ns: Int64) -> Float:
    """Interpolate measured positions [A, P, 3] of people, NaN where somebody was not measured: [P, T, 3]."""
    found = np.empty((people.shape[1], len(at_ns), 3))
    for p in range(people.shape[1]):
        own = np.isfinite(people[:, p]).all(axis=1)
        for axis in range(3):
            found[p, :, axis] = np.interp(at_ns, t_ns[own], people[own, p, axis])
    return found
