"""The local planner: exact gradients, and obstacles it leaves."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.planning.config import PlannerConfig, PlannerTuning
from pipelines.planning.distance_field import DistanceField, distance_field, open_space
from pipelines.planning.local import LocalPlanner
from pipelines.session.records import Occupancy
from tests.planning.worlds import mound

TUNING = PlannerTuning(eps_obs_m=1.5, soft_separation_margin_m=0.5)
CONFIG = PlannerConfig(tuning=TUNING)
NOBODY = np.empty((0, 20, 3))


def boulders() -> DistanceField:
    occupied = np.random.default_rng(4).random((30, 30, 16)) < 0.006
    return distance_field(Occupancy(occupied.astype(np.float32), np.array([-7.5, -7.5, -2.0]), 0.5))


@pytest.mark.slow  # compiles much
@pytest.mark.parametrize("speed_floor", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(2))
def test_the_gradient_is_the_derivative_of_the_cost(seed: int, speed_floor: float) -> None:
    """Central differences of every waypoint; points lie in, near, far from and outside of the boulders.

    With h = 1e-6 m they are off by rounding, 1e-16 J/h, and by h^2: far below 1e-4 of the largest entry.
    A random point lies within h of a cell's face, where the field has a kink, once in 1e5.
    """
    rng = np.random.default_rng(seed)
    planner = LocalPlanner(replace(CONFIG, tuning=replace(TUNING, speed_floor_mps=speed_floor)))
    field = boulders()
    position, velocity = rng.normal(size=(2, 3))
    waypoints = position + np.cumsum(rng.normal(size=(20, 3)), axis=0)
    actor = waypoints + rng.normal(size=(20, 3)) * [5, 5, 1]  # some nearer than sight lines begin
    slots, others = waypoints + rng.normal(size=(20, 3)), np.full((2, 20, 4), 3.5)
    others[..., :3] = waypoints + 2.5 * rng.normal(size=(2, 20, 3))

    def cost(moved: Float) -> tuple[float, dict[str, float], Float]:
        return planner.cost(position, velocity, moved, slots=slots, actor=actor, others=others, field=field)

    _, terms, gradient = cost(waypoints)
    assert min(terms.values()) > 0
    distance, _ = field.sample(waypoints)
    assert (distance > CONFIG.tuning.eps_obs_m).any()
    assert ((distance > 0) & (distance < CONFIG.tuning.eps_obs_m)).any()
    numeric = np.zeros_like(gradient)
    h = 1e-6
    for place in np.ndindex(gradient.shape):
        step = np.zeros_like(waypoints)
        step[place] = h
        numeric[place] = (cost(waypoints + step)[0] - cost(waypoints - step)[0]) / (2 * h)
    assert np.abs(numeric - gradient).max() < 1e-4 * np.abs(gradient).max()


@pytest.mark.parametrize(("speed_floor", "gets_out"), [(1.0, True), (0.0, False)])
def test_who_stands_inside_the_mound_gets_out_if_speed_has_a_floor(
    speed_floor: float, gets_out: bool
) -> None:
    """The literal form multiplies all obstacles by a speed of zero, and then has nothing to push with."""
    planner = LocalPlanner(PlannerConfig(tuning=PlannerTuning(speed_floor_mps=speed_floor)))
    field, inside = mound(), np.array([30.0, 8.6, 3.5])
    assert field.sample(inside)[0] < -0.5
    slots = np.tile(inside, (20, 1))
    actor, nobody = slots - [0, 9, 2], np.empty((0, 21, 3))
    made = planner.plan(
        *(0.0, inside, np.zeros(3)),
        slots=slots,
        actor=actor,
        others=[],
        people=nobody,
        field=field,
        previous=None,
    )
    assert (field.sample(made.path[-1])[0] > 0) == gets_out


def test_a_plan_goes_round_somebody_who_stands_in_its_way() -> None:
    """Straight on it would pass them at 0.5 m, and the guard would refuse it for good."""
    slots = np.linspace([0.5, -8.0, 1.0], [0.5, 8.0, 1.0], 21)[1:]
    people = np.tile([0.0, 0.0, 1.0], (1, 21, 1))
    ahead = LocalPlanner(CONFIG).plan(
        *(0.0, np.array([0.5, -8.0, 1.0]), np.zeros(3)),
        slots=slots,
        actor=people[0, 1:],
        others=[],
        people=people,
        field=open_space(),
        previous=None,
    )
    assert np.linalg.norm(ahead.path - people[0], axis=1).min() > CONFIG.actor_distance_m
    assert ahead.path[-1, 1] > 5.0
