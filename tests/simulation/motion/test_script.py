"""Scripts of actions: their ends, their effects, and no jumps."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import rotate
from pipelines.geometry.rig import BONE, BONES, joint_centres
from tests.simulation.motion.performing import RIG, bent_deg, clearance_m, mound, performed

SWAY_M = 0.012  # of somebody standing, both axes together


def heading_deg(rotation: Float) -> float:
    ahead = rotate(rotation, np.array([1.0, 0.0, 0.0]))
    return float(np.degrees(np.arctan2(ahead[1], ahead[0])))


def turned_by(one_deg: float, other_deg: float) -> float:
    return (one_deg - other_deg + 180.0) % 360.0 - 180.0


EVERYTHING: list[dict[str, Any]] = [
    {"walk": {"distance_m": 4}},
    {"jog": {"distance_m": 8, "turn_deg": 90}},
    {"walk": {"distance_m": 3}},
    {"turn": {"deg": -100}},
    {"crouch": {"depth": 1.0, "seconds": 1}},
    {"reach": {"side": "both", "height_m": 0.4, "seconds": 1}},
    {"reach": {"seconds": 1}},
    {"kick": {}},
    {"kick": {"foot": "left", "run_up_m": 1}},
    {"stand": {"seconds": 1}},
]


def test_nothing_jumps() -> None:
    """Velocity is continuous: its change in a step shrinks with the step.

    A jump of the velocity would change it by as much within 1 ms as within 4 ms; accelerations that are
    bounded make it a quarter. Half lies between the two.
    """
    coarse, fine = (
        performed(*EVERYTHING, seconds=36.0, step_s=step_s, ground=mound) for step_s in (0.004, 0.001)
    )
    changes = [
        np.sqrt(np.sum(np.diff(joint_centres(RIG, motion), 2, axis=0) ** 2, axis=2)).max(axis=0) / step_s
        for motion, step_s in ((coarse, 0.004), (fine, 0.001))
    ]
    assert dict(zip(BONES, changes[1] / changes[0] < 0.5, strict=True)) == dict.fromkeys(BONES, True)
    # Nothing of the body is faster than a kicking foot.
    speed = np.sqrt(np.sum(np.diff(joint_centres(RIG, fine), axis=0) ** 2, axis=2)) / 0.001
    assert speed.max() < 20.0


@settings(max_examples=12, deadline=None)
@given(
    distance=st.floats(3.0, 15.0),
    curvature=st.floats(-0.8, 0.8),
    heading=st.floats(-180.0, 180.0),
    jogs=st.booleans(),
)
def test_arcs_end_where_they_should(distance: float, curvature: float, heading: float, jogs: bool) -> None:
    turn = curvature * distance
    motion = performed(
        {"jog" if jogs else "walk": {"distance_m": distance, "turn_deg": float(np.degrees(turn))}},
        seconds=24.0,
        step_s=0.5,
        heading_deg=heading,
        start=(3.0, -2.0),
    )
    middle = np.radians(heading) + turn / 2  # of a circle: the chord
    chord = distance * np.sinc(turn / 2 / np.pi)
    end = np.array([3.0, -2.0]) + chord * np.array([np.cos(middle), np.sin(middle)])
    assert np.hypot(*(motion.root[-1, :2] - end)) < SWAY_M
    assert turned_by(heading_deg(motion.rotation[-1, 0]), heading + np.degrees(turn)) == pytest.approx(
        0, abs=1.0
    )


def test_ways_lead_to_places_round_corners_and_back() -> None:
    places = [[5.0, 0.0], [8.0, 2.0], [8.0, 6.0], [0.0, 0.0]]
    motion = performed(*({"walk": {"to": place}} for place in places), seconds=40.0, step_s=0.05)
    way = motion.root[:, :2]
    for place, cut in zip(places, (0.15, 0.15, SWAY_M, SWAY_M), strict=True):
        assert np.hypot(*(way - place).T).min() < cut + 0.03  # between two samples it goes 3 cm
    assert np.hypot(*(way[-1] - places[-1])) < SWAY_M


def test_a_crouch_lowers_the_pelvis_with_its_depth() -> None:
    lowest = []
    for depth in (0.25, 0.5, 1.0):
        motion = performed({"crouch": {"depth": depth}}, seconds=6.0)
        lowest.append(motion.root[:, 2].min())
        # By 0.6 of the leg at depth 1, from 15 mm above the height of the neutral pose.
        wanted = (1 - 0.6 * depth) * RIG.height_of_pelvis + 0.015
        assert lowest[-1] == pytest.approx(wanted, abs=0.003)
        assert clearance_m(motion).min() > -0.003
        assert motion.root[-1, 2] == pytest.approx(motion.root[0, 2], abs=0.003)
    knee = bent_deg(performed({"crouch": {"depth": 1.0}}, seconds=6.0), "left_thigh", "left_shank")
    assert 120 < knee.max() < 155  # a deep squat


@pytest.mark.parametrize("side", ["left", "right", "both"])
@pytest.mark.parametrize("height", [0.5, 1.0, 1.5, 1.9])
def test_a_reach_brings_the_hand_to_its_height(side: str, height: float) -> None:
    motion = performed({"reach": {"side": side, "height_m": height}}, seconds=4.0)
    hands = joint_centres(RIG, motion)[(motion.t_s > 0.75) & (motion.t_s < 2.65)]
    for one in ("left", "right") if side == "both" else (side,):
        assert hands[:, BONE[f"{one}_hand"], 2] == pytest.approx(height, abs=0.02)
        ahead = hands[:, BONE[f"{one}_hand"], 0] - hands[:, BONE[f"{one}_upper_arm"], 0]
        assert ahead.min() > 0.0


@pytest.mark.parametrize("foot", ["left", "right"])
@pytest.mark.parametrize("run_up", [1.0, 3.0, 8.0])
def test_a_kick_is_as_fast_as_published(foot: str, run_up: float) -> None:
    """Nunome et al. 2002, Lees et al. 2010: feet of skilled players 15 to 20 m/s, of others from 10."""
    motion = performed({"kick": {"foot": foot, "run_up_m": run_up}}, seconds=9.0, step_s=0.002)
    support = "right" if foot == "left" else "left"
    centres = joint_centres(RIG, motion)
    velocity = np.diff(centres, axis=0) / 0.002
    # Where the ball is met: in the middle between ankle and toes.
    speed = (
        np.sqrt(np.sum((velocity[:, BONE[f"{foot}_foot"]] + velocity[:, BONE[f"{foot}_toes"]]) ** 2, axis=1))
        / 2
    )
    impact = int(speed.argmax())
    assert 12.0 < speed[impact] < 18.0
    # Ahead and hardly above the ground.
    assert velocity[impact, BONE[f"{foot}_toes"], 0] > 0.9 * speed[impact]
    assert centres[impact, BONE[f"{foot}_toes"], 2] < 0.25
    knee = bent_deg(motion, f"{foot}_thigh", f"{foot}_shank")
    before, after = (slice(impact - 100, impact), slice(impact, impact + 125))
    assert 95 < knee[before].max() < 120  # backswing
    assert knee[after].min() < 15  # extended
    assert np.diff(knee[impact - 20 : impact]).min() / 0.002 < -800
    hip = -bent_deg(motion, "pelvis", f"{foot}_thigh")
    assert hip[before].min() < -25
    assert hip[after].max() > 55  # follow-through
    # The support foot stays where it was planted, the kicking foot clears the ground.
    low = clearance_m(motion)
    feet = {"left": 0, "right": 1}
    assert np.ptp(centres[impact - 25 : impact + 50, BONE[f"{support}_foot"], :2], axis=0).max() < 0.02
    assert low[impact - 25 : impact + 50, feet[support]].min() == pytest.approx(0.0, abs=0.002)
    assert low.min() > -0.003
    # And it ends in a stand.
    ankles = centres[-1, [BONE["left_foot"], BONE["right_foot"]]]
    assert np.ptp(ankles[:, 0]) < 0.02
    standing = performed({"stand": {"seconds": 1}}, seconds=0.5)
    assert motion.root[-1, 2] == pytest.approx(standing.root[0, 2], abs=0.003)
