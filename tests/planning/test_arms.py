"""The search in one compiled call against its parts, one after the other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.planning.arms import ADAPTIVE
from pipelines.planning.config import PlannerConfig
from pipelines.planning.forecast import Forecast
from pipelines.planning.formation import formation_slots, slot_offsets, wrapped, yaw_set
from pipelines.planning.search import best_sequence, cost_map, costs_of_slots, lattice
from tests.planning.worlds import trees

WORLD = trees()


@settings(max_examples=20)
@given(st.integers(0, 10_000), st.sampled_from([2, 3, 5]))
def test_a_plan_is_the_cheapest_sequence_through_the_cost_map(seed: int, drones: int) -> None:
    rng = np.random.default_rng(seed)
    config = PlannerConfig()
    start = float(rng.uniform(-3, 3))
    actor = rng.uniform([-5, -10, 0.5], [40, 10, 1.5], (config.horizon_knots, 3))
    form = {"tilt_rad": config.tilt_rad, "range_m": config.radius_m}
    commanded = formation_slots(np.array([start + rng.uniform(-20, 20)]), drones, **form)[0]

    path = ADAPTIVE.start(config, drones=drones, yaw_rad=start).plan(
        7.0, commanded, Forecast(actor, np.zeros(len(actor))), WORLD
    )

    yaws = yaw_set(config.yaws, start)
    states = np.stack([yaws, 0 * yaws + config.tilt_rad, 0 * yaws + config.radius_m], axis=1)
    grid = lattice(states, rates=np.array(config.slot_rates), knot_s=config.knot_s, w_turn=config.w_turn)
    slots = formation_slots(yaws, drones, **form)
    costs = costs_of_slots(WORLD, actor, slot_offsets(slots), config)
    assert cost_map(costs, config).max() > 0
    sequence, _ = best_sequence(cost_map(costs, config), grid, commanded[0])
    assert path.knot_s == pytest.approx(7.0 + config.knot_s * np.arange(config.horizon_knots + 1))
    assert np.array_equal(path.slots[0], commanded)
    assert path.slots[1:, :, 1:] == pytest.approx(slots[sequence][..., 1:])
    assert wrapped(path.slots[1:, :, 0] - slots[sequence][..., 0]) == pytest.approx(0.0, abs=1e-12)
    assert (np.abs(np.diff(path.slots[..., 0], axis=0)) <= np.pi).all()
