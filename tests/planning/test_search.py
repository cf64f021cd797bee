"""Dynamic programming against every possible sequence."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.arrays import Float, Int64
from pipelines.planning.config import ErrorModel
from pipelines.planning.formation import (
    TOO_NEAR,
    Lattice,
    TeamViews,
    TeamWeights,
    best_sequence,
    best_teams,
    lattice,
    slot_offsets,
    wrapped,
    yaw_set,
)
from pipelines.planning.scores import predicted_error, ray_information

RATES = np.array([np.radians(22.5), np.radians(5.0), 1.0])


def yaw_ring(yaws: int, *, w_turn: float = 0.05, knot_s: float = 2.0) -> Lattice:
    states = np.column_stack([yaw_set(yaws, 0.0), np.full(yaws, 0.26), np.full(yaws, 10.0)])
    return lattice(states, rates=RATES, knot_s=knot_s, w_turn=w_turn)


@given(st.integers(0, 10_000))
def test_no_sequence_of_yaw_tilt_and_range_is_cheaper(seed: int) -> None:
    rng = np.random.default_rng(seed)
    states = np.array(list(product(yaw_set(4, 0.1), [0.1, 0.25], [8.0, 10.0, 13.0])))
    grid = lattice(states, rates=RATES * [2, 1, 1], knot_s=2.0, w_turn=0.05)
    cost = rng.random((3, len(states)))
    start = states[rng.integers(len(states))]
    found, value = best_sequence(cost, grid, start)
    rates = RATES * [2, 1, 1]

    def walk(t: int, at: Float) -> float:
        if t == len(cost):
            return 0.0
        best = np.inf
        for s, state in enumerate(states):
            way = state - at
            way[0] = wrapped(way[0])
            if (np.abs(way) <= 2.0 * rates + 1e-9).all():
                move = 0.05 / 2.0 * float((np.abs(way) / rates).sum())
                best = min(best, cost[t, s] + move + walk(t + 1, state))
        return best

    assert value == pytest.approx(walk(0, start), abs=1e-12)
    assert len(found) == 3


@settings(max_examples=5)
@given(st.integers(0, 10_000), st.sampled_from([2, 3]))
def test_no_drone_of_a_team_has_a_cheaper_sequence(seed: int, drones: int) -> None:
    """Every other sequence of one drone costs more, and so do the plan before and all equal spacings."""
    rng = np.random.default_rng(seed)
    yaws, times, w_turn = 6, 3, 0.05
    grid = yaw_ring(yaws, knot_s=3.0, w_turn=w_turn)  # 60 deg and 22.5 deg/s: the neighbours are in reach
    offsets = slot_offsets(grid.states)
    information = ray_information(offsets, ErrorModel())
    formations = (np.arange(yaws)[:, None] + np.arange(drones) * (yaws // drones)) % yaws
    triangle = np.ascontiguousarray(information[:, *np.triu_indices(3)])
    views = TeamViews(
        grid, offsets, triangle, np.ascontiguousarray(formations), np.ones(yaws, dtype=np.bool_)
    )
    weights = TeamWeights(w_error=1.0, prior=0.25, apart_m=4.5)
    price, free = rng.random((times, yaws)), rng.integers(0, 3, (times, yaws)) / 2.0
    commanded = grid.states[formations[rng.integers(yaws)]]
    before = np.repeat(formations[rng.integers(yaws)][:, None], times, axis=1)

    def costs(teams: Int64) -> Float:
        """Compute the cost of teams [P, n, T] by definition; inf where a rate is exceeded."""
        yaw = np.concatenate([np.tile(commanded[:, :1], (len(teams), 1, 1)), grid.states[teams, 0]], axis=-1)
        ways = np.abs(wrapped(np.diff(yaw, axis=-1)))
        at = np.arange(times)
        known = 0.25 * np.eye(3) + np.einsum("pnt,pntij->ptij", free[at, teams], information[teams])
        same = sum((teams[:, i] == teams[:, j]).sum(axis=-1) for i in range(drones) for j in range(i))
        total = price[at, teams].sum(axis=(1, 2)) + w_turn / 2.0 * (ways / RATES[0]).sum(axis=(1, 2))
        total = total + np.log(predicted_error(known)).sum(axis=-1) + TOO_NEAR * same  # others are 10 m apart
        return np.where((ways <= RATES[0] * 3.0 + 1e-9).all(axis=(1, 2)), total, np.inf)

    teams = best_teams(price, free, views, weights, commanded, before)
    assert (np.diff(costs(teams)) >= -1e-9).all()  # rounding
    found = teams[0]
    every = np.array(list(product(range(yaws), repeat=times)))
    (least,) = costs(found[None])
    assert np.isfinite(least)
    for i in range(drones):
        others = np.repeat(found[None], len(every), axis=0)
        others[:, i] = every
        assert costs(others).min() >= least - 1e-9
    assert least <= min(costs(before[None])[0], costs(formations[every].swapaxes(1, 2)).min()) + 1e-9
