"""The walking person against anatomy and arithmetic."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.arrays import Float
from pipelines.session.people import mirrored
from tests.synthetic.walk import COCO17, route, stride_m, walk

LIMBS = {  # fractions of the body's height, Drillis & Contini
    ("hip", "knee"): 0.530 - 0.285,
    ("knee", "ankle"): 0.285 - 0.039,
    ("shoulder", "elbow"): 0.186,
    ("elbow", "wrist"): 0.146,
}
WIDTHS = {"hip": 0.191, "shoulder": 0.259}
ANKLE_HEIGHT_M = 0.039 * 1.75


def joint(joints: Float, name: str) -> Float:
    return joints[:, COCO17.index(name)]


def length(joints: Float, one: str, other: str) -> Float:
    result: Float = np.sqrt(np.sum((joint(joints, one) - joint(joints, other)) ** 2, axis=1))
    return result


def flexion_deg(joints: Float, upper: str, middle: str, lower: str) -> Float:
    """Compute the angle by which a limb is bent at its middle joint, 0 when straight."""
    first = joint(joints, middle) - joint(joints, upper)
    second = joint(joints, lower) - joint(joints, middle)
    cosine = np.sum(first * second, axis=1) / np.sqrt(np.sum(first**2, axis=1) * np.sum(second**2, axis=1))
    angle: Float = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return angle


def strides(count: int = 3, speed_mps: float = 1.2, per_stride: int = 400) -> Float:
    """Return times over whole strides."""
    return np.linspace(0.0, count * stride_m() / speed_mps, count * per_stride + 1)


@settings(max_examples=25, deadline=None)
@given(
    speed=st.floats(0.0, 2.5),
    heading=st.floats(-180, 180),
    radius=st.none() | st.floats(2.0, 50.0),
    height=st.floats(1.0, 2.1),
    t=st.lists(st.floats(-100, 100), min_size=1, max_size=5),
)
def test_limbs_keep_their_length(
    speed: float, heading: float, radius: float | None, height: float, t: list[float]
) -> None:
    joints = walk(
        np.array(t),
        speed_mps=speed,
        start=(3.0, -7.0),
        heading_deg=heading,
        radius_m=radius,
        height_m=height,
    )
    assert joints.shape == (len(t), 17, 3)
    for side in ("left", "right"):
        for (upper, lower), share in LIMBS.items():
            assert length(joints, f"{side}_{upper}", f"{side}_{lower}") == pytest.approx(
                share * height, abs=1e-9
            )
    for part, share in WIDTHS.items():
        assert length(joints, f"left_{part}", f"right_{part}") == pytest.approx(share * height, abs=1e-9)
    assert length(joints, "nose", "left_ear") == pytest.approx(length(joints, "nose", "right_ear"), abs=1e-9)


def test_one_foot_is_always_on_the_ground_and_none_below() -> None:
    ankles = np.stack([joint(walk(strides()), f"{side}_ankle") for side in ("left", "right")])
    above = ankles[..., 2] - ANKLE_HEIGHT_M
    assert above.min() >= 0
    # The heel may rise by 2.5 cm before the other foot takes over.
    assert above.min(axis=0).max() < 0.025
    assert 0.1 < above.max() < 0.25  # the swinging foot clears the ground


def test_the_stance_foot_hardly_slides() -> None:
    """While a foot carries, its ankle may move by the 5.5 cm that the sole rolls; the body moves 66 cm."""
    joints = walk(strides(4))
    left, right = (joint(joints, f"{side}_ankle") for side in ("left", "right"))
    carries = left[:, 2] < right[:, 2]
    edges = np.flatnonzero(np.diff(carries.astype(int)))
    phases = [slice(a + 1, b + 1) for a, b in pairwise(edges) if carries[a + 1]]
    assert len(phases) >= 3
    for phase in phases:
        assert np.ptp(left[phase, 0]) < 0.056
        assert np.ptp(left[phase, 1]) < 0.015


def test_joint_angles_stay_in_the_published_bands() -> None:
    joints = walk(strides(1))
    for side in ("left", "right"):
        knee = flexion_deg(joints, f"{side}_hip", f"{side}_knee", f"{side}_ankle")
        # Winter 2009: nearly straight at heel strike, about 60 degrees in swing, one SD is about 5.
        assert 0 <= knee.min() < 10
        assert 55 < knee.max() < 70
        thigh = joint(joints, f"{side}_knee") - joint(joints, f"{side}_hip")
        swung = np.degrees(np.arctan2(thigh[:, 0], -thigh[:, 2]))
        # Perry & Burnfield 2010: 20 degrees trailing to 25 degrees in front of the vertical.
        assert -25 < swung.min() < -15
        assert 20 < swung.max() < 30
        elbow = flexion_deg(joints, f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist")
        assert 15 < elbow.min() < elbow.max() < 50


@pytest.mark.parametrize("speed", [0.6, 1.2, 1.8])
def test_mean_speed_is_the_one_asked_for(speed: float) -> None:
    joints = walk(strides(5, speed), speed_mps=speed, heading_deg=30.0)
    way = joint(joints, "nose")[-1] - joint(joints, "nose")[0]
    expected = speed * strides(5, speed)[-1] * np.array([np.cos(np.pi / 6), 0.5, 0.0])
    assert way == pytest.approx(expected, abs=1e-9)


def test_stride_and_cadence_are_those_of_a_person() -> None:
    # Normal adults at 1.2 m/s take 100 to 120 steps a minute.
    assert 100 < 2 * 60 * 1.2 / stride_m() < 120


def test_pelvis_does_not_jerk() -> None:
    t_s = strides(2)
    joints = walk(t_s)
    pelvis = (joint(joints, "left_hip") + joint(joints, "right_hip")) / 2
    assert np.abs(np.diff(pelvis[:, 0]) / np.diff(t_s) / 1.2 - 1).max() < 0.15
    assert np.ptp(pelvis[:, 2]) < 0.05


def test_left_and_right_are_mirror_images_half_a_stride_apart() -> None:
    t_s = strides(1)
    half_way = stride_m() / 2
    now, later = walk(t_s), walk(t_s + half_way / 1.2)
    swapped = later[:, [COCO17.index(mirrored(name)) for name in COCO17]]
    assert swapped * [1, -1, 1] - [half_way, 0, 0] == pytest.approx(now, abs=1e-9)


def test_a_circle_is_walked_along_its_tangent() -> None:
    t_s = np.linspace(0, 60, 500)
    joints = walk(t_s, start=(5.0, 0.0), heading_deg=90.0, radius_m=5.0)
    pelvis = (joint(joints, "left_hip") + joint(joints, "right_hip"))[:, :2] / 2
    assert np.linalg.norm(pelvis, axis=1) == pytest.approx(5.0, abs=1e-9)
    # The face is ahead of the ears, and ahead is to the left of outwards.
    ahead = (joint(joints, "nose") - (joint(joints, "left_ear") + joint(joints, "right_ear")) / 2)[:, :2]
    tangent = np.stack([-pelvis[:, 1], pelvis[:, 0]], axis=1) / 5.0
    assert (ahead * tangent).sum(1) == pytest.approx(np.linalg.norm(ahead, axis=1), rel=1e-9)
    assert (joint(joints, "left_hip") - joint(joints, "right_hip"))[0, 0] < 0


def test_route_of_a_circle_closes() -> None:
    ground, heading = route(np.array([0.0, 6 * np.pi]), start=(1.0, 2.0), heading_deg=45.0, radius_m=3.0)
    assert ground == pytest.approx(np.array([[1.0, 2.0], [1.0, 2.0]]))
    assert np.degrees(heading) == pytest.approx([45.0, 405.0])
