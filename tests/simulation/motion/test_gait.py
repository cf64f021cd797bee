"""Walking and jogging against published kinematics and the ground."""

from collections.abc import Sequence

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.geometry.rig import BodyMotion, Rig
from tests.simulation.motion.performing import (
    RIG,
    bent_deg,
    clearance_m,
    flat,
    leg_angles_deg,
    mound,
    performed,
    slid_m,
    slope,
)
from tests.simulation.motion.published_gait import AT_TOE_OFF, EVENTS, Event, stance_share

PENETRATION_M = 0.003
ON_GROUND_M = 0.002  # a heel that comes down or a tip that lifts passes it within 1 % of a stride
CONTACT_M = 0.004  # lower than that a point is said to touch: the toes clear the ground by 15 mm and more


@pytest.mark.parametrize(
    ("step", "seconds"),
    [
        ({"walk": {"distance_m": 10}}, 9.5),
        ({"walk": {"distance_m": 5, "speed_mps": 0.5}}, 12.0),
        ({"walk": {"distance_m": 12, "speed_mps": 2.0}}, 8.0),
        ({"walk": {"distance_m": 8, "turn_deg": 300}}, 8.0),
        ({"jog": {"distance_m": 15}}, 8.0),
        ({"turn": {"deg": -150}}, 5.0),
    ],
)
def test_feet_do_not_slide(step: dict[str, dict[str, float]], seconds: float) -> None:
    slid = slid_m(performed(step, seconds=seconds), CONTACT_M)
    assert len(slid) > 6
    assert max(slid) < 0.02


@pytest.mark.parametrize("ground", [flat, slope, mound])
def test_feet_stay_on_top_of_the_ground_and_one_is_on_it(ground) -> None:  # type: ignore[no-untyped-def]
    motion = performed({"walk": {"distance_m": 11}}, {"turn": {"deg": 90}}, seconds=14.0, ground=ground)
    lowest = clearance_m(motion, ground).min(axis=2)
    # The mound's curvature is at most 1.2 m / (2 m)^2 = 0.3 per m: over the 0.27 m of a sole that lies on
    # heel and tip it departs from a line by 0.3 x 0.27^2 / 8 = 2.7 mm.
    assert lowest.min() > -PENETRATION_M
    assert lowest.min(axis=1).max() < 0.005


def stride_of(motion: BodyMotion, side: int, rig: Rig = RIG) -> tuple[slice, float]:
    """Find a stride at steady speed, from strike to strike, and its share with the foot on the ground."""
    low = clearance_m(motion, rig=rig)[:, side]
    (strikes,) = np.nonzero(np.diff((low[:, 0] < ON_GROUND_M).astype(int)) == 1)
    first, last = (strikes + 1)[motion.t_s[strikes] > 3.0][:2]
    lifted = low[first:last].min(axis=1) > ON_GROUND_M
    return slice(first, last), float(lifted.argmax() / len(lifted))


def published(angles: dict[str, Float], toe_off: float, events: Sequence[Event]) -> dict[str, bool]:
    """Test which extremes have the angle and the time in the stride of measured people."""
    share = np.linspace(0.0, 1.0, len(angles["knee"]), endpoint=False)
    within = {}
    for event in events:
        low, high = (toe_off, toe_off) if event.searched == AT_TOE_OFF else event.searched
        searched = np.nonzero((share >= low - 0.5 / len(share)) & (share <= high + 0.5 / len(share)))[0]
        values = angles[event.joint][searched]
        at = searched[values.argmax() if event.extreme == "max" else values.argmin()]
        value = angles[event.joint][at]
        within[f"{event.joint} {event.name}: {value:.1f} deg at {share[at]:.3f}"] = bool(
            event.deg[0] <= value <= event.deg[1] and event.share[0] <= share[at] <= event.share[1]
        )
    return within


def assert_stance_is_as_long_as_published(toe_off: float, speed_mps: float) -> None:
    low, high = stance_share(speed_mps / np.sqrt(9.81 * RIG.length_of_leg))
    assert low <= toe_off <= high


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("speed", [1.2, 1.3, 1.4])
def test_walking_angles_lie_in_the_published_bands(speed: float, side: int) -> None:
    """At people's usual speed, from the places of joints, heels and balls."""
    motion = performed({"walk": {"distance_m": 9 * speed, "speed_mps": speed}}, seconds=7.0, step_s=0.002)
    stride, toe_off = stride_of(motion, side)
    angles = {joint: curve[stride] for joint, curve in leg_angles_deg(motion, side).items()}
    assert all((within := published(angles, toe_off, EVENTS)).values()), within
    assert_stance_is_as_long_as_published(toe_off, speed)
    # Winter 2009: the pelvis rises and falls by 4 cm or so, twice a stride.
    assert 0.02 < np.ptp(motion.root[stride, 2]) < 0.06
    # A stride of 2 x 0.384 v m: the walk ratio of Sekiya & Nagasaki 1998; a frame is 0.2 % of it.
    stride_m = (stride.stop - stride.start) * 0.002 * speed
    assert stride_m == pytest.approx(2 * np.sqrt(0.384 * speed), rel=0.005)


def test_a_jog_flies_and_bends_its_knees_as_published() -> None:
    """Novacheck 1998: stance below half of the stride, knee 40 to 45 deg in stance, 90 to 110 in swing."""
    motion = performed({"jog": {"distance_m": 25, "speed_mps": 3.0}}, seconds=9.0, step_s=0.005)
    steady = (motion.t_s > 3) & (motion.t_s < 7)
    on = (clearance_m(motion).min(axis=2) < CONTACT_M)[steady]
    assert 0.30 < on[:, 0].mean() < 0.47
    assert 0.1 < (~on.any(axis=1)).mean() < 0.4
    knee = bent_deg(motion, "left_thigh", "left_shank")[steady]
    assert 35 < knee[on[:, 0]].max() < 60
    assert 85 < knee.max() < 120
    height = motion.root[steady, 2]
    assert 0.04 < np.ptp(height) < 0.12
