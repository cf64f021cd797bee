"""Skeleton definitions: orders against the detectors' own numbering, symmetry, mapping, derived joints."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.session.errors import DataError
from pipelines.session.people import (
    DERIVED,
    SKELETONS,
    bones_of,
    get_skeleton,
    mirrored,
    skeleton_with,
    take_joints,
    with_derived,
)

NAMES = st.sampled_from(sorted(SKELETONS))


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("coco17", 17),
        ("halpe26", 26),
        ("body25", 25),
        ("body25b", 25),
        ("blazepose33", 33),
        ("coco23", 23),
        ("coco18", 18),
    ],
)
def test_every_skeleton_has_its_detectors_number_of_distinct_joints(name: str, count: int) -> None:
    joints = get_skeleton(name).joints
    assert len(joints) == len(set(joints)) == count


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


def test_an_unknown_skeleton_is_refused_with_those_there_are() -> None:
    with pytest.raises(DataError) as caught:
        get_skeleton("coco19")
    assert caught.value.source == "coco19"
    assert caught.value.remedy.endswith(", ".join(SKELETONS))


def test_skeletons_by_count() -> None:
    assert [s.name for s in skeleton_with(25)] == ["body25", "body25b"]
    assert [s.name for s in skeleton_with(33)] == ["blazepose33"]
    assert skeleton_with(19) == ()


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_bones_are_symmetric_and_join_joints_that_are_there(name: str) -> None:
    skeleton = get_skeleton(name)
    bones = {frozenset(bone) for bone in skeleton.bones}
    assert len(bones) == len(skeleton.bones)
    assert bones == {frozenset(mirrored(joint) for joint in bone) for bone in bones}
    assert set().union(*bones) <= set(skeleton.joints)
    assert {frozenset(("left_hip", "left_knee")), frozenset(("right_elbow", "right_wrist"))} <= bones


@given(NAMES)
def test_mirroring_twice_changes_nothing_and_stays_in_the_skeleton(name: str) -> None:
    joints = get_skeleton(name).joints
    assert [mirrored(mirrored(joint)) for joint in joints] == list(joints)
    assert {mirrored(joint) for joint in joints} == set(joints)
    assert mirrored("nose") == "nose"


def test_bones_of_some_joints() -> None:
    joints = ("left_hip", "left_knee", "right_ankle", "left_ankle")
    assert bones_of(joints) == (("left_hip", "left_knee"), ("left_knee", "left_ankle"))


@given(NAMES, NAMES, st.integers(0, 2**32 - 1))
def test_taking_joints_there_and_back_keeps_the_shared_ones(one: str, other: str, seed: int) -> None:
    a, b = get_skeleton(one).joints, get_skeleton(other).joints
    values = np.random.default_rng(seed).normal(size=(3, len(a), 2))
    back = take_joints(take_joints(values, a, b), b, a)
    shared = np.isin(a, b)
    np.testing.assert_array_equal(back[:, shared], values[:, shared])
    assert np.isnan(back[:, ~shared]).all()


def test_taking_joints_along_another_axis() -> None:
    confidence = np.array([[0.1, 0.2], [0.3, 0.4]])
    taken = take_joints(confidence, ("nose", "neck"), ("neck", "hip", "nose"), axis=-1)
    np.testing.assert_array_equal(taken, [[0.2, np.nan, 0.1], [0.4, np.nan, 0.3]])


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


def test_joints_that_are_there_or_lack_a_parent_are_not_derived() -> None:
    body25 = get_skeleton("body25").joints
    measured = np.ones((1, 25, 3))
    joints, position = with_derived(body25, measured)
    assert joints == body25
    assert position is measured
    assert with_derived(("nose", "left_hip"), np.zeros((2, 3)))[0] == ("nose", "left_hip")
