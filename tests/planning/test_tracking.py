"""Plans between their waypoints, and point masses that follow them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.planning.config import PlannerConfig
from pipelines.planning.tracking import Plan, Tracker

CONFIG = PlannerConfig()


def test_a_parabola_is_met_between_waypoints_too() -> None:
    """Central differences and cubic pieces are exact for second degree, up to the last waypoint but one."""
    t = 0.5 * np.arange(21)
    acceleration = np.array([0.3, -0.2, 0.1])
    velocity = np.array([1.0, 2.0, 0.0])
    path = velocity * t[:, None] + acceleration * t[:, None] ** 2 / 2
    plan = Plan(3.0, path, velocity, 0.5)
    s = np.linspace(0, 9.49, 50)
    x, v, a = plan.at(3.0 + s)
    assert x == pytest.approx(velocity * s[:, None] + acceleration * s[:, None] ** 2 / 2, abs=1e-12)
    assert v == pytest.approx(velocity + acceleration * s[:, None], abs=1e-12)
    assert a == pytest.approx(np.tile(acceleration, (50, 1)), abs=1e-10)


def test_derivatives_are_those_of_the_position() -> None:
    rng = np.random.default_rng(1)
    plan = Plan(0.0, rng.normal(size=(6, 3)), rng.normal(size=3), 0.5)
    t, h = np.array([0.1, 0.7, 1.3, 2.2, 3.1]), 1e-5
    x, v, a = plan.at(t)
    later, earlier = plan.at(t + h), plan.at(t - h)
    assert v == pytest.approx((later[0] - earlier[0]) / (2 * h), abs=1e-8)
    assert a == pytest.approx((later[1] - earlier[1]) / (2 * h), abs=1e-7)
    assert plan.at(np.array([0.0]))[0][0] == pytest.approx(plan.path[0])
    end = plan.at(np.array([2.5, 3.5]))
    assert end[0][1] - end[0][0] == pytest.approx(end[1][0])  # straight on
    assert x.shape == (5, 3)


def test_a_step_is_reached_without_staying_off() -> None:
    """The slowest pole is near k_integral/k_position = 0.083/s: after 60 s less than 1 % is left."""
    tracker = Tracker(np.zeros((2, 3)), np.zeros((2, 3)), CONFIG)
    goal = np.array([[2.0, 0, 0], [0, 0, -1.0]])
    still = np.zeros_like(goal)
    for _ in range(60 * 50):
        tracker.step(goal, still, still)
    assert tracker.position == pytest.approx(goal, abs=0.02)
    assert tracker.velocity == pytest.approx(still, abs=0.02)


def test_the_acceleration_keeps_its_limit() -> None:
    """From rest towards a place far away: v = a t exactly, x = a t^2 / 2."""
    tracker = Tracker(np.zeros((1, 3)), np.zeros((1, 3)), replace(CONFIG, k_velocity=1e-9, k_integral=0.0))
    goal = np.array([[300.0, 400.0, 0.0]])
    for _ in range(50):
        tracker.step(goal, goal * 0, goal * 0)
    towards = np.array([[0.6, 0.8, 0.0]])
    assert tracker.velocity == pytest.approx(4.0 * towards)
    assert tracker.position == pytest.approx(2.0 * towards)


def test_a_moving_reference_is_followed_closely() -> None:
    """A circle that needs 2 m/s^2: with the reference's acceleration only the 20 ms steps remain.

    Each step the acceleration held is late by half of one: 0.5 * 0.02 s * |jerk| = 0.02 m/s^2, over
    k_position = 6 that is 3 mm; ten of them are allowed after the transient.
    """
    radius, speed = 8.0, 4.0
    w = speed / radius

    def circle(t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        x = radius * np.array([[np.cos(w * t), np.sin(w * t), 0.0]])
        return x, speed * np.array([[-np.sin(w * t), np.cos(w * t), 0.0]]), -(w**2) * x

    tracker = Tracker(*circle(0.0)[:2], CONFIG)
    for k in range(500):
        tracker.step(*circle(k / 50))
        assert np.linalg.norm(tracker.position - circle((k + 1) / 50)[0]) < 0.03
