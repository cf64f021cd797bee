"""Skeleton definitions: orders against the detectors' own numbering, symmetry, mapping, derived joints."""

import numpy as np
import pytest

from pipelines.session.people import (
    DERIVED,
    SKELETONS,
    get_skeleton,
    mirrored,
    with_derived,
)

# Joints by number as the detectors' own documentation gives them, a few of each group.
NUMBERED = {
    "coco23": "16 right_ankle 17 left_big_toe 18 left_small_toe 19 left_heel 20 right_big_toe 22 right_heel",
    "coco18": "1 neck 2 right_shoulder 5 left_shoulder 8 right_hip 13 left_ankle 14 right_eye 17 left_ear",
    "coco17": "0 nose 1 left_eye 4 right_ear 5 left_shoulder 10 right_wrist 16 right_ankle",
    "halpe26": "16 right_ankle 17 head 18 neck 19 hip 20 left_big_toe 21 right_big_toe 22 left_small_toe "
    "24 left_heel 25 right_heel",
    "body25": "1 neck 2 right_shoulder 5 left_shoulder 8 hip 9 right_hip 14 left_ankle 15 right_eye "
    "18 left_ear 19 left_big_toe 20 left_small_toe 21 left_heel 22 right_big_toe 24 right_heel",
    "body25b": "1 left_eye 6 right_shoulder 12 right_hip 17 neck 18 head 19 left_big_toe 20 left_small_toe "
    "21 left_heel 22 right_big_toe 24 right_heel",
    "blazepose33": "1 left_eye_inner 5 right_eye 6 right_eye_outer 7 left_ear 9 left_mouth 11 left_shoulder "
    "18 right_pinky 19 left_index 22 right_thumb 23 left_hip 29 left_heel 32 right_big_toe",
}


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_joints_have_the_detectors_numbers(name: str) -> None:
    words = NUMBERED[name].split()
    joints = get_skeleton(name).joints
    assert [joints[int(number)] for number in words[::2]] == words[1::2]


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_bones_are_symmetric_and_join_joints_that_are_there(name: str) -> None:
    skeleton = get_skeleton(name)
    bones = {frozenset(bone) for bone in skeleton.bones}
    assert len(bones) == len(skeleton.bones)
    assert bones == {frozenset(mirrored(joint) for joint in bone) for bone in bones}
    assert set().union(*bones) <= set(skeleton.joints)
    assert {frozenset(("left_hip", "left_knee")), frozenset(("right_elbow", "right_wrist"))} <= bones


def test_neck_and_hip_are_the_midpoints_of_their_parents() -> None:
    coco = get_skeleton("coco17").joints
    position = np.arange(2 * 17 * 3, dtype=np.float64).reshape(2, 17, 3)
    position[1, coco.index("left_hip")] = np.nan
    joints, derived = with_derived(coco, position)
    assert joints == (*coco, "neck", "hip")
    np.testing.assert_array_equal(derived[:, :17], position)
    np.testing.assert_array_equal(derived[:, 17], (position[:, 5] + position[:, 6]) / 2)
    np.testing.assert_array_equal(derived[0, 18], (position[0, 11] + position[0, 12]) / 2)
    assert np.isnan(derived[1, 18]).all()
    assert [joint for joint, _ in DERIVED] == ["neck", "hip"]
