"""Plans between their waypoints, and point masses that follow them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.arrays import Float
from pipelines.planning.config import PlannerConfig
from pipelines.planning.local import (
    ACCELERATION,
    INTEGRAL,
    POSITION,
    VELOCITY,
    DronePlan,
    Flying,
    flying_of,
    roll_out,
    stopping_ticks,
)

CONFIG = PlannerConfig()


def test_a_parabola_is_met_between_waypoints_too() -> None:
    """Central differences and cubic pieces are exact for second degree, up to the last waypoint but one."""
    t = 0.5 * np.arange(21)
    acceleration = np.array([0.3, -0.2, 0.1])
    velocity = np.array([1.0, 2.0, 0.0])
    path = velocity * t[:, None] + acceleration * t[:, None] ** 2 / 2
    plan = DronePlan(3.0, path, velocity, 0.5)
    s = np.linspace(0, 9.49, 50)
    x, v, a = plan.at(3.0 + s)
    assert x == pytest.approx(velocity * s[:, None] + acceleration * s[:, None] ** 2 / 2, abs=1e-12)
    assert v == pytest.approx(velocity + acceleration * s[:, None], abs=1e-12)
    assert a == pytest.approx(np.tile(acceleration, (50, 1)), abs=1e-10)


def track(plan: DronePlan, start: Float, flying: Flying, seconds: float) -> Float:
    """Return states [K + 1, 4, 3] of a drone that follows a plan from its start."""
    ticks = round(seconds / flying.period_s)
    states = np.zeros((ticks + 1, 4, 3))
    states[0] = start
    roll_out(plan.path, plan.velocity, plan.step_s, 0.0, ticks, flying, states)
    return states


def at_rest() -> Float:
    return np.zeros((4, 3))


def test_a_moving_reference_is_followed_closely() -> None:
    """A circle that needs 2 m/s^2: with the reference's acceleration only the 20 ms steps remain.

    Each step the acceleration held is late by half of one: 0.5 * 0.02 s * |jerk| = 0.02 m/s^2, over
    k_position = 6 that is 3 mm. Cubic pieces over 0.1 s differ from the circle by less than 0.1 mm. Ten times
    3 mm are allowed after the transient.
    """
    radius, speed = 8.0, 4.0
    w = speed / radius
    t = 0.1 * np.arange(110)
    circle = radius * np.stack([np.cos(w * t), np.sin(w * t), 0 * t], axis=1)
    start = at_rest()
    start[POSITION], start[VELOCITY] = circle[0], [0.0, speed, 0.0]
    start[ACCELERATION] = -(w**2) * circle[0]
    states = track(DronePlan(0.0, circle, start[VELOCITY], 0.1), start, flying_of(CONFIG), 10.0)
    t = np.arange(len(states)) / CONFIG.tuning.tracking_hz
    truth = radius * np.stack([np.cos(w * t), np.sin(w * t), 0 * t], axis=1)
    assert np.linalg.norm(states[:, POSITION] - truth, axis=1).max() < 0.03


vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), direction=vectors, push=vectors, spread_m=st.floats(0.1, 60.0))
def test_limits_are_kept_whatever_a_plan_asks_for_and_every_motion_ends_at_rest(
    seed: int, direction: Float, push: Float, spread_m: float
) -> None:
    """From any state within the limits, after a plan of random waypoints."""
    flying = flying_of(CONFIG)
    ticks = 10
    states = np.zeros((ticks + stopping_ticks(flying) + 1, 4, 3))
    states[0, VELOCITY] = direction * 0.95 * flying.speed_mps / np.sqrt(3)
    states[0, ACCELERATION] = push * flying.acceleration_mps2 / np.sqrt(3)
    path = np.random.default_rng(seed).normal(0, spread_m, (21, 3))
    last = roll_out(path, states[0, VELOCITY].copy(), 0.5, 0.0, ticks, flying, states)
    speed, acceleration = (np.linalg.norm(states[:, row], axis=1) for row in (VELOCITY, ACCELERATION))
    jerk = np.linalg.norm(np.diff(states[:, ACCELERATION], axis=0), axis=1) / flying.period_s
    within = 1 + 1e-9
    assert speed.max() <= flying.speed_mps * within
    assert acceleration.max() <= flying.acceleration_mps2 * within
    assert jerk.max() <= flying.jerk_mps3 * within
    assert last < len(states) - 1
    assert (states[last:, [VELOCITY, ACCELERATION]] == 0).all()
    assert (states[last:, POSITION] == states[last, POSITION]).all()
    assert (states[ticks + 1 :, INTEGRAL] == 0).all()
