"""The search in one compiled call against its parts, one after the other."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.arrays import Float
from pipelines.planning.arms import ADAPTIVE, JOINT, RollingOut
from pipelines.planning.config import PlannerConfig
from pipelines.planning.forecast import Forecast
from pipelines.planning.formation import (
    FormationPath,
    best_sequence,
    cost_map,
    costs_of_slots,
    formation_slots,
    lattice,
    slot_offsets,
    wrapped,
    yaw_set,
)
from tests.planning.worlds import trees, wall

WORLD = trees()
WALL = wall(1.0)


@settings(max_examples=20)
@given(st.integers(0, 10_000), st.sampled_from([2, 3, 5]))
def test_a_plan_is_the_cheapest_sequence_through_the_cost_map(seed: int, drones: int) -> None:
    rng = np.random.default_rng(seed)
    config = PlannerConfig()
    start = float(rng.uniform(-3, 3))
    actor = rng.uniform([-5, -10, 0.5], [40, 10, 1.5], (config.horizon_knots, 3))
    form = {"tilt_rad": config.tilt_rad, "range_m": config.radius_m}
    commanded = formation_slots(np.array([start + rng.uniform(-20, 20)]), drones, **form)[0]

    path = ADAPTIVE.start(config, drones=drones, yaw_rad=start).plan(7.0, commanded, Forecast(actor), WORLD)

    yaws = yaw_set(config.tuning.yaws, start)
    states = np.stack([yaws, 0 * yaws + config.tilt_rad, 0 * yaws + config.radius_m], axis=1)
    grid = lattice(
        states, rates=np.array(config.slot_rates), knot_s=config.tuning.knot_s, w_turn=config.tuning.w_turn
    )
    slots = formation_slots(yaws, drones, **form)
    costs = costs_of_slots(WORLD, actor, slot_offsets(slots), config)
    assert cost_map(costs, config).max() > 0
    sequence, _ = best_sequence(cost_map(costs, config), grid, commanded[0])
    assert path.knot_s == pytest.approx(7.0 + config.tuning.knot_s * np.arange(config.horizon_knots + 1))
    assert np.array_equal(path.slots[0], commanded)
    assert path.slots[1:, :, 1:] == pytest.approx(slots[sequence][..., 1:])
    assert wrapped(path.slots[1:, :, 0] - slots[sequence][..., 0]) == pytest.approx(0.0, abs=1e-12)
    assert (np.abs(np.diff(path.slots[..., 0], axis=0)) <= np.pi).all()


@pytest.mark.parametrize("drones", [2, 5])
def test_nobody_of_a_joint_plan_stays_behind_a_wall(drones: int) -> None:
    """Each formation of five drones has somebody behind the wall; free spacing leaves nobody there."""
    config, field = PlannerConfig(), WALL
    actor = np.tile([12.0, 0.0, 1.0], (config.horizon_knots, 1))
    form = {"tilt_rad": config.tilt_rad, "range_m": config.radius_m}
    commanded = formation_slots(np.array([0.4]), drones, **form)[0]
    yaws = np.linspace(-np.pi, np.pi, 180)
    equal = costs_of_slots(field, actor[:1], slot_offsets(formation_slots(yaws, drones, **form)), config)
    fewest = (equal.occluded[0] > 0).sum(axis=-1).min()
    assert (fewest > 0) == (drones == 5)

    path = JOINT.start(config, drones=drones, yaw_rad=0.4).plan(0.0, commanded, Forecast(actor), field)

    offsets = slot_offsets(path.slots[-1])
    costs = costs_of_slots(field, actor[:1], offsets[None], config)
    assert costs.occluded.max() == 0
    assert costs.obstacle.max() < 1
    apart = np.linalg.norm(offsets[:, None] - offsets, axis=-1)[~np.eye(drones, dtype=bool)]
    assert apart.min() >= config.soft_separation_m
    most = np.array(config.slot_rates) * config.tuning.knot_s
    assert (np.abs(np.diff(path.slots, axis=0)) <= most + 1e-9).all()
    assert config.ranges_m[0] <= path.slots[..., 2].min() <= path.slots[..., 2].max() <= config.ranges_m[-1]


@pytest.mark.parametrize("nearest", [2, 5])
def test_a_joint_plan_is_the_one_that_measures_best_as_it_would_be_flown(nearest: int) -> None:
    """Require the path that brings the drones nearest: errors fall with the range. The last is adaptive's."""
    config = PlannerConfig()
    planner = JOINT.start(config, drones=2, yaw_rad=0.0)
    commanded = formation_slots(np.zeros(1), 2, tilt_rad=config.tilt_rad, range_m=config.radius_m)[0]
    actor = Forecast(np.tile([12.0, 0.0, 1.0], (config.horizon_knots, 1)))
    walked = np.tile([100.0, 0.0, 1.0], (config.tuning.waypoints, 1))  # nothing is there
    asked: list[FormationPath] = []

    def roll_out(path: FormationPath) -> tuple[Float, Float]:
        asked.append(path)
        range_m = 7.0 if len(asked) - 1 == nearest else 9.0 + len(asked)
        places = slot_offsets(
            formation_slots(np.zeros(config.tuning.waypoints), 2, tilt_rad=0.3, range_m=range_m)
        )
        return np.swapaxes(places, 0, 1) + walked[0], walked

    assert isinstance(planner, RollingOut)
    planner.roll_out = roll_out
    assert planner.plan(0.0, commanded, actor, WALL) is asked[nearest]
    assert len(asked) == 6
    adaptive = ADAPTIVE.start(config, drones=2, yaw_rad=0.0).plan(0.0, commanded, actor, WALL)
    np.testing.assert_array_equal(asked[5].slots, adaptive.slots)
    later = planner.plan(0.1, commanded, actor, WALL)
    assert later.knot_s[0] == (0.1 if nearest == 5 else 0.0)  # adaptive plans as often as alone
