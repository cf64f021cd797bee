"""Yaws that count from the actor's heading: the estimate of the heading, and formations that turn with it."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.planning.arms import ADAPTIVE, FIXED, Arm
from pipelines.planning.config import PlannerConfig, PlannerTuning
from pipelines.planning.distance_field import open_space
from pipelines.planning.forecast import Forecast, YawZero
from pipelines.planning.formation import (
    YAW,
    cost_map,
    costs_of_slots,
    formation_slots,
    slot_of,
    slot_offsets,
    wrapped,
    yaw_set,
)
from pipelines.planning.replay import Start, replay
from tests.planning.worlds import trees

WORLD_FRAME = PlannerConfig()
HEADING_FRAME = replace(WORLD_FRAME, yaw_frame="heading")
WORLD = trees()
SURE = np.diag([0.01, 0.01**2])  # of position and velocity


def towards(deg: float, speed_mps: float = 1.2) -> Float:
    angle = np.radians(deg)
    return speed_mps * np.array([np.cos(angle), np.sin(angle), 0.0])


def zero_deg(zero: YawZero, *t_s: float) -> list[float]:
    return [float(angle) for angle in np.degrees(zero.at(np.array(t_s)))]


def test_the_zero_follows_the_heading_as_fast_as_a_formation_turns_and_no_faster() -> None:
    zero = YawZero(HEADING_FRAME)
    zero.follow(10.0, towards(45.0), SURE)
    assert zero_deg(zero, 10.0, 11.0, 12.0, 20.0) == pytest.approx([0.0, 22.5, 45.0, 45.0])
    zero.follow(11.0, towards(45.0), SURE)  # asked anew on the way: no jump
    assert zero_deg(zero, 11.0, 12.0, 13.0) == pytest.approx([22.5, 45.0, 45.0])


@pytest.mark.parametrize(
    ("speed_mps", "sigma_mps", "taken"),
    [(0.49, 0.01, False), (0.51, 0.01, True), (0.89, 0.3, False), (0.91, 0.3, True), (0.0, 0.0, False)],
)
def test_who_stands_keeps_the_last_heading(speed_mps: float, sigma_mps: float, taken: bool) -> None:
    zero = YawZero(HEADING_FRAME)
    zero.follow(0.0, towards(30.0), SURE)
    zero.follow(2.0, towards(90.0, speed_mps), np.diag([0.01, sigma_mps**2]))
    assert zero_deg(zero, 60.0) == pytest.approx([90.0 if taken else 30.0])
    up = YawZero(HEADING_FRAME, heading_rad=0.5)
    up.follow(0.0, np.array([0.0, 0.0, 3.0]), SURE)  # who climbs a ladder heads nowhere
    assert up.at(np.array([9.0])) == 0.5


def on_a_circle(seconds: float) -> tuple[NDArray[np.int64], Float, Float]:
    """Return stamps, hips and headings (rad, continuous) of an actor who walks round 12 m at 1.2 m/s.

    The first heading is north.
    """
    t_s = np.arange(0, seconds, 0.1)
    angle = 0.1 * t_s
    hips = np.stack([12 * np.cos(angle), 12 * np.sin(angle), 0 * angle + 1], axis=1)
    return (t_s * 1e9).astype(np.int64), hips, angle + np.pi / 2


@pytest.mark.parametrize("arm", [FIXED, ADAPTIVE], ids=lambda arm: arm.name)
def test_a_formation_in_the_heading_frame_turns_with_the_actor(arm: Arm) -> None:
    """The filter's velocity lags behind a turn of w by w/k rad, k = (q / (sigma^2 dt))^(1/4) = 2.2 Hz its
    bandwidth, times sqrt(2) for its damping: 3.6 deg at 0.1 rad/s; as much again is allowed."""
    stamps, hips, heading = on_a_circle(25.0)
    flown = {
        config.yaw_frame: replay(arm, stamps, hips, [open_space()], Start(2, np.pi, np.pi / 2), config=config)
        for config in (WORLD_FRAME, HEADING_FRAME)
    }
    assert np.ptp(flown["world"].formation_yaw_rad) == 0
    turning = flown["heading"]
    settled = turning.t_s > 5
    wanted = np.interp(turning.t_s, stamps / 1e9, heading) + np.pi / 2  # left of the actor, all the way
    behind_deg = np.degrees(wanted - turning.formation_yaw_rad)[settled]
    assert 0 < behind_deg.min() < behind_deg.max() < 7.2
    assert np.ptp(behind_deg) < 1
    # Drones, whose forecast goes straight on, stay behind slots that come round at 1 m/s.
    off_deg = np.degrees(wrapped(wanted - slot_of(turning.position - turning.actor)[0, :, YAW]))[settled]
    assert np.ptp(off_deg) < 1
    assert 0 < off_deg.mean() < 20


def test_no_sequence_of_yaws_from_the_heading_is_cheaper() -> None:
    """All sequences of 8 yaws at 3 knots between trees; the actor turns by 40 deg from knot to knot."""
    config = replace(HEADING_FRAME, horizon_s=6.0, tuning=PlannerTuning(yaws=8, knot_s=2.0))
    form = {"tilt_rad": config.tilt_rad, "range_m": config.radius_m}
    yaws = yaw_set(8, 0.0)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        actor = rng.uniform([0, -6, 0.8], [40, 6, 1.2], (3, 3))
        heading = rng.uniform(-np.pi, np.pi) + np.radians(40) * np.arange(3)
        start = yaws[rng.integers(8)]
        commanded = formation_slots(np.array([start]), 2, **form)[0]
        path = ADAPTIVE.start(config, drones=2, yaw_rad=0.0).plan(
            0.0, commanded, Forecast(actor, heading), WORLD
        )

        offsets = [slot_offsets(formation_slots(yaws + turn, 2, **form)) for turn in heading]
        looks = zip(actor[:, None], offsets, strict=True)
        cost = np.stack([cost_map(costs_of_slots(WORLD, at, of, config), config)[0] for at, of in looks])

        def price(sequence: tuple[int, ...], cost: Float = cost, start: float = start) -> float:
            turns = np.abs(wrapped(np.diff([start, *yaws[list(sequence)]])))
            if (turns > np.radians(45.001)).any():
                return np.inf
            return float(cost[np.arange(3), list(sequence)].sum() + 0.05 * turns.sum() / np.radians(45))

        chosen = np.abs(wrapped(path.slots[1:, 0, YAW, None] - yaws)).argmin(axis=1)
        cheapest = min(price(sequence) for sequence in product(range(8), repeat=3))
        assert price(tuple(chosen)) == pytest.approx(cheapest, abs=1e-12)
        assert np.ptp(cost) > 0
