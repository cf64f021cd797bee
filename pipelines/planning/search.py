"""The best sequence of states through a cost map: dynamic programming over neighbours (Ho et al., Alg. 1).

As printed, the algorithm adds the index of the best neighbour where its value is meant, and leaves out the
time of the costs. Here V[T] = C[T] and V[t, i] = C[t, i] + min over neighbours j of (V[t + 1, j] + move).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.compilation import cached
from pipelines.planning.formation import YAW, wrapped

Float = NDArray[np.float64]
Int64 = NDArray[np.int64]

_REACHED = 1e-9  # seconds: a cell exactly as far as the rates allow is a neighbour


@dataclass(frozen=True)
class Lattice:
    """States of a formation (or of one drone), and which of them follow which."""

    states: Float  # [S, 3] yaw, tilt, range
    rates: Float  # [3] per second
    knot_s: float
    w_turn: float
    neighbours: Int64  # [S, K] nearest first, itself at the front; -1 fills up
    move: Float  # [S, K] what going there costs


def lattice(states: Float, *, rates: Float, knot_s: float, w_turn: float) -> Lattice:
    """Connect states that are within reach of each other.

    Args:
        states: [S, 3] yaw (rad), tilt (rad), range (m).
        rates: [3] how fast each may change, per second, above 0: reach does not depend on how fine the
            lattice is.
        knot_s: the time between knots.
        w_turn: what 2 s of change at the full rate cost (45 deg at the default 22.5 deg/s).
    """
    time_s = _time_between(states[:, None], states, rates)
    reach, cost = time_s.max(axis=-1), w_turn / 2.0 * time_s.sum(axis=-1)
    within = reach <= knot_s + _REACHED
    order = np.argsort(np.where(within, time_s.sum(axis=-1), np.inf), axis=1, kind="stable")
    width = int(within.sum(axis=1).max())
    neighbours = order[:, :width].astype(np.int64)
    inside = np.take_along_axis(within, neighbours, axis=1)
    move = np.take_along_axis(cost, neighbours, axis=1)
    return Lattice(states, rates, knot_s, w_turn, np.where(inside, neighbours, -1), move)


def _time_between(start: Float, goal: Float, rates: Float) -> Float:
    """Seconds that each coordinate needs, [..., 3], broadcast."""
    way = goal - start
    way[..., YAW] = wrapped(way[..., YAW])
    return np.abs(way) / rates


def best_sequence(cost: Float, grid: Lattice, start: Float) -> tuple[Int64, float]:
    """The cheapest way through a cost map, and its cost.

    Args:
        cost: [T, S], finite.
        grid: the states.
        start: [3] commanded now, anywhere between the states. The first step reaches what its rates allow,
            or else the nearest state.

    Returns:
        [T] indices of states, and the sum of costs and moves. Ties stay where they are, or go to the
        nearest.
    """
    return _search(
        np.ascontiguousarray(cost),
        grid.neighbours,
        grid.move,
        start,
        grid.states,
        grid.rates,
        grid.knot_s,
        grid.w_turn,
    )


@cached
def _search(
    cost: Float,
    neighbours: Int64,
    move: Float,
    start: Float,
    places: Float,
    rates: Float,
    knot_s: float,
    w_turn: float,
) -> tuple[Int64, float]:
    times, states = cost.shape
    value = cost.copy()
    following = np.zeros((times, states), np.int64)
    for t in range(times - 2, -1, -1):
        for s in range(states):
            best = math.inf
            for k in range(neighbours.shape[1]):
                j = neighbours[s, k]
                if j >= 0 and value[t + 1, j] + move[s, k] < best:
                    best = value[t + 1, j] + move[s, k]
                    following[t, s] = j
            value[t, s] = cost[t, s] + best

    # The first step starts anywhere between the states.
    reach_s, way_s = np.zeros(states), np.zeros(states)
    for s in range(states):
        for axis in range(3):
            way = abs(places[s, axis] - start[axis])
            if axis == YAW:
                way = abs((way + math.pi) % (2.0 * math.pi) - math.pi)
            reach_s[s] = max(reach_s[s], way / rates[axis])
            way_s[s] += way / rates[axis]
    within_s = max(knot_s, reach_s.min()) + _REACHED
    sequence = np.zeros(times, np.int64)
    total = nearest = math.inf
    for s in range(states):
        through = value[0, s] + w_turn / 2.0 * way_s[s]
        if reach_s[s] <= within_s and (through < total or (through == total and way_s[s] < nearest)):
            total, nearest = through, way_s[s]
            sequence[0] = s
    for t in range(times - 1):
        sequence[t + 1] = following[t, sequence[t]]
    return sequence, total
