"""Cheapest sequence of states through a cost map: dynamic programming over neighbours (Ho et al., Alg. 1).

As printed, the algorithm adds the index of the best neighbour instead of its value, and leaves out the time
of the costs. Here V[T] = C[T] and V[t, i] = C[t, i] + min over neighbours j of (V[t + 1, j] + move).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.planning.formation import YAW, wrapped
from pipelines.planning.search_kernels import REACHED_S, Lattice, cheapest_sequence

Int64 = NDArray[np.int64]


def lattice(states: Float, *, rates: Float, knot_s: float, w_turn: float) -> Lattice:
    """Connect states that are within reach of each other.

    Args:
        states: [S, 3] yaw (rad), tilt (rad), range (m).
        rates: [3] largest change of each per second, above 0: reach does not depend on the lattice's spacing.
        knot_s: the time between knots.
        w_turn: cost of 2 s of change at the full rate (45 deg at the default 22.5 deg/s).
    """
    time_s = _time_between(states[:, None], states, rates)
    reach, cost = time_s.max(axis=-1), w_turn / 2.0 * time_s.sum(axis=-1)
    within = reach <= knot_s + REACHED_S
    order = np.argsort(np.where(within, time_s.sum(axis=-1), np.inf), axis=1, kind="stable")
    width = int(within.sum(axis=1).max())
    neighbours = order[:, :width].astype(np.int64)
    inside = np.take_along_axis(within, neighbours, axis=1)
    move = np.take_along_axis(cost, neighbours, axis=1)
    return Lattice(states, rates, knot_s, w_turn, np.where(inside, neighbours, -1), move)


def _time_between(start: Float, goal: Float, rates: Float) -> Float:
    """Compute the seconds that each coordinate needs, [..., 3], broadcast."""
    way = goal - start
    way[..., YAW] = wrapped(way[..., YAW])
    return np.abs(way) / rates


def best_sequence(cost: Float, grid: Lattice, start: Float) -> tuple[Int64, float]:
    """Find the cheapest way through a cost map, and its cost.

    Args:
        cost: [T, S], finite.
        grid: the states.
        start: [3] commanded now, anywhere between the states. The first step reaches the states that the
            rates allow, or else the nearest state.

    Returns:
        [T] indices of states, and the sum of costs and moves. Ties are broken in favour of the same state, or
        else the nearest one.
    """
    return cheapest_sequence(np.ascontiguousarray(cost), grid, start)
