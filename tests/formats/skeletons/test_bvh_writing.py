"""Writer of BVH: rigs of motions with known bones, read by bvhtoolbox and by our own reader."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.formats.skeletons import bvh
from pipelines.formats.skeletons.bvh import fit_rig, read_motion
from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import multiply, rotate
from pipelines.session.people import take_joints, with_derived
from pipelines.session.records import JointMotion, SkeletalMotion
from pipelines.session.registries import ExportWithChoices
from tests.formats.exported import Listener, recording, walking, without

WRITER: ExportWithChoices = bvh.EXPORT
WRITTEN_M = 1e-6  # six decimals of a degree over 2 m of bones, and of a centimetre: 0.04 micrometres


def measured(motion: JointMotion, joints: tuple[str, ...]) -> Float:
    """Return the measured positions [T, B, 3] of a rig's joints; the hip is the middle of the hips."""
    return take_joints(*with_derived(motion.joints, motion.position[:, 0])[::-1], joints)


def joint_positions(motion: SkeletalMotion) -> Float:
    """Compute the positions at which the bones of a rig begin, [T, B, 3] m, world."""
    place = np.empty((len(motion.t_s), len(motion.bones), 3))
    turned = np.empty((len(motion.t_s), len(motion.bones), 4))
    for bone, parent in enumerate(motion.parent):
        if parent < 0:
            place[:, bone], turned[:, bone] = motion.root, motion.rotation[:, bone]
        else:
            place[:, bone] = place[:, parent] + rotate(turned[:, parent], motion.offset[bone])
            turned[:, bone] = multiply(turned[:, parent], motion.rotation[:, bone])
    return place


def test_a_body_of_rigid_bones_is_followed_exactly() -> None:
    motion = walking(90)
    rigged = fit_rig("x", motion, 0)
    assert rigged.motion.bones[:4] == ("Hips", "Spine", "Neck", "Head")
    np.testing.assert_allclose(
        joint_positions(rigged.motion), measured(motion, rigged.joints), rtol=0, atol=1e-9
    )
    assert (rigged.first, rigged.without_hips, rigged.turns_held) == (0, 0, 0)


def test_bones_have_their_median_length_and_point_where_they_were_measured() -> None:
    motion = walking(61)
    forearm = [motion.joints.index(f"left_{joint}") for joint in ("elbow", "wrist")]
    elbow, wrist = (motion.position[:, 0, k].copy() for k in forearm)
    length = np.linalg.norm(wrist[0] - elbow[0])
    stretch = np.linspace(0.5, 1.5, 61)  # the median is 1
    motion.position[:, 0, forearm[1]] = elbow + stretch[:, None] * (wrist - elbow)
    rigged = fit_rig("x", motion, 0)
    place = joint_positions(rigged.motion)
    hand, arm = rigged.motion.bones.index("LeftHand"), rigged.motion.bones.index("LeftForeArm")
    bone = place[:, hand] - place[:, arm]
    np.testing.assert_allclose(np.linalg.norm(bone, axis=1), length, rtol=1e-12)
    np.testing.assert_allclose(bone / length, (wrist - elbow) / length, rtol=0, atol=1e-9)


def test_what_is_missing_is_held_left_out_and_counted(tmp_path: Path) -> None:
    motion = without(walking(30), "left_hip", [0, 1, 10, 29])
    without(motion, "right_wrist", [15, 16])
    listener = Listener()
    (path,) = WRITER.write(replace(recording(), motion=motion, progress=listener), tmp_path)
    back = read_motion(path, unit="cm", axes="y-up")
    assert len(back.t_s) == 27
    place = joint_positions(back)
    np.testing.assert_allclose(place[8, 0], place[7, 0], atol=WRITTEN_M)  # frame 10 keeps the place of 9
    forearm = back.bones.index("RightForeArm")
    np.testing.assert_allclose(back.rotation[13, forearm], back.rotation[12, forearm], atol=1e-7)
    np.testing.assert_allclose(back.rotation[14, forearm], back.rotation[12, forearm], atol=1e-7)
    (note,) = listener.notes
    # Frames before and after the hips are seen; frames without hips; held turns of bones.
    # Frame 10: the turns of hips, spine and left thigh; 15 and 16: the forearm. 13 bones have a direction.
    assert re.findall(r"(\d+) of (\d+)", note) == [("3", "30"), ("1", "27"), ("5", "351")]
