"""Joint angles of limbs that are built from known angles; standard deviations against drawn errors."""

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.geometry.joint_angles import (
    ABSENT,
    ANGLE_STATUS,
    ANGLES,
    UNDETERMINED,
    JointAngles,
    joint_angles,
)
from pipelines.geometry.triangulation import STATUS

SIDES = {"left": -1.0, "right": 1.0}
JOINTS = tuple(
    f"{side}_{joint}"
    for joint in ("hip", "knee", "ankle", "heel", "big_toe", "shoulder", "elbow", "wrist")
    for side in SIDES
)
WORLD_FROM_BODY = np.array(
    [[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]
)  # forward, up, right of somebody who looks east


def turned(axis: int, deg: float) -> Float:
    """Return a rotation about x, y or z."""
    c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def posed(angles: dict[str, float], heading_deg: float = 40.0) -> Float:
    """Build the joints [16, 3] of a body with these angles, others 0; the trunk stands on level hips."""
    get = {name: angles.get(name, 0.0) for name in ANGLES}
    trunk = (
        turned(2, -get["trunk_flexion"]) @ turned(0, get["trunk_bending"]) @ turned(1, get["trunk_rotation"])
    )
    up = trunk @ [0, 1.0, 0]
    points: dict[str, Float] = {}
    right = np.array([0, 0, 1.0])
    pelvis_up = up - (up @ right) * right
    pelvis_up /= np.linalg.norm(pelvis_up)
    pelvis = np.stack([np.cross(pelvis_up, right), pelvis_up, right], axis=1)
    for side, sign in SIDES.items():
        mirror = np.diag([1.0, 1.0, sign])
        hip = np.array([0, 1.0, sign * 0.12])
        thigh = (
            turned(2, get[f"{side}_hip_flexion"])
            @ turned(0, get[f"{side}_hip_adduction"])
            @ turned(1, get[f"{side}_hip_rotation"])
        )
        shank = thigh @ turned(2, -get[f"{side}_knee_flexion"])
        foot = shank @ turned(2, get[f"{side}_ankle_dorsiflexion"])
        knee = hip + pelvis @ mirror @ thigh @ [0, -0.45, 0]
        ankle = knee + pelvis @ mirror @ shank @ [0, -0.42, 0]
        heel = ankle + pelvis @ mirror @ foot @ [-0.05, -0.06, 0]
        toe = heel + pelvis @ mirror @ foot @ [0.25, 0, 0]
        shoulder = np.array([0, 1.0, 0]) + 0.5 * up + trunk @ [0, 0, sign * 0.2]
        plane, elevation = get[f"{side}_shoulder_plane"], get[f"{side}_shoulder_elevation"]
        arm = turned(1, plane) @ turned(0, -elevation) @ turned(1, get[f"{side}_shoulder_rotation"])
        forearm = arm @ turned(2, get[f"{side}_elbow_flexion"])
        elbow = shoulder + trunk @ mirror @ arm @ [0, -0.3, 0]
        wrist = elbow + trunk @ mirror @ forearm @ [0, -0.25, 0]
        of_side = {"hip": hip, "knee": knee, "ankle": ankle, "heel": heel, "big_toe": toe}
        of_side |= {"shoulder": shoulder, "elbow": elbow, "wrist": wrist}
        points |= {f"{side}_{joint}": place for joint, place in of_side.items()}
    body = np.stack([points[joint] for joint in JOINTS])
    world: Float = body @ (turned(2, heading_deg) @ WORLD_FROM_BODY).T
    return world


def angles_of(position: Float) -> dict[str, float]:
    found = joint_angles(JOINTS, position[None, None])
    return dict(zip(ANGLES, found.value_deg[0, 0].tolist(), strict=True))


BENT = {
    "left_hip_flexion": 35.0,
    "left_hip_adduction": -12.0,
    "left_knee_flexion": 60.0,
    "left_ankle_dorsiflexion": -20.0,
    "right_hip_flexion": -15.0,
    "right_hip_adduction": 8.0,
    "right_knee_flexion": 45.0,
    "right_ankle_dorsiflexion": 15.0,
    "left_shoulder_plane": 80.0,
    "left_shoulder_elevation": 70.0,
    "left_shoulder_rotation": -25.0,
    "left_elbow_flexion": 90.0,
    "right_shoulder_plane": -30.0,
    "right_shoulder_elevation": 110.0,
    "right_shoulder_rotation": 40.0,
    "right_elbow_flexion": 35.0,
    "trunk_flexion": 20.0,
    "trunk_bending": 0.0,
    "trunk_rotation": 25.0,
}


@pytest.mark.parametrize("heading_deg", [0.0, 40.0, 170.0])
def test_angles_of_a_body_built_from_angles_come_back(heading_deg: float) -> None:
    found = angles_of(posed(BENT, heading_deg))
    for name, value in BENT.items():
        assert found[name] == pytest.approx(value, abs=1e-6), name


def test_rotations_about_the_thigh_come_back_and_bend_no_knee() -> None:
    # The knee's axis is drawn towards the hips' line by at most sin(15)^2 / sin(60)^2 = 5.1 degrees, which
    # takes (1 - cos 5.1) sin 60 cos 60 = 0.1 degrees from its flexion.
    wanted = BENT | {"left_hip_rotation": 30.0, "right_hip_rotation": -20.0, "right_knee_flexion": 60.0}
    found = angles_of(posed(wanted))
    for side in SIDES:
        for name in ("hip_rotation", "hip_flexion", "hip_adduction"):
            assert found[f"{side}_{name}"] == pytest.approx(wanted[f"{side}_{name}"], abs=1e-6)
        assert found[f"{side}_knee_flexion"] == pytest.approx(60.0, abs=0.11)


def test_the_trunk_bends_to_the_right_and_hyperextended_knees_are_negative() -> None:
    found = angles_of(posed({"trunk_bending": 15.0, "left_knee_flexion": -8.0}))
    assert found["trunk_bending"] == pytest.approx(15.0, abs=1e-6)
    assert found["left_knee_flexion"] == pytest.approx(-8.0, abs=1e-6)


def test_what_a_pose_does_not_show_is_undetermined() -> None:
    found = joint_angles(JOINTS, posed({})[None, None])
    status = status_of(found)
    for side in SIDES:
        for name in ("hip_rotation", "shoulder_plane", "shoulder_rotation", "forearm_pronation"):
            assert status[f"{side}_{name}"] == UNDETERMINED
        assert status[f"{side}_elbow_flexion"] == "ok"
    assert np.isnan(found.value_deg[0, 0][[word == UNDETERMINED for word in status.values()]]).all()
    lying = posed({}) @ turned(1, 90.0).T @ turned(0, 90.0).T
    upside = status_of(joint_angles(JOINTS, (lying @ turned(2, 30.0).T)[None, None]))
    assert upside["left_knee_flexion"] == "ok"


def status_of(found: JointAngles) -> dict[str, str]:
    words = np.array(ANGLE_STATUS)[found.status[0, 0]]
    return dict(zip(ANGLES, words.tolist(), strict=True))


def test_an_angle_has_the_status_of_its_worst_joint() -> None:
    position = posed(BENT)[None, None]
    given = np.zeros((1, 1, len(JOINTS)), np.int8)
    given[..., JOINTS.index("left_knee")] = STATUS.index("rejected")
    given[..., JOINTS.index("right_elbow")] = STATUS.index("filled")
    position[..., JOINTS.index("left_knee"), :] = np.nan
    status = status_of(joint_angles(JOINTS, position, status=given))
    assert {name for name, word in status.items() if word == "rejected"} == {
        *("left_hip_flexion", "left_hip_adduction", "left_hip_rotation", "left_knee_flexion"),
        "left_ankle_dorsiflexion",
    }
    assert status["right_elbow_flexion"] == status["right_shoulder_elevation"] == "filled"
    without = [k for k, joint in enumerate(JOINTS) if "toe" not in joint]
    bare = joint_angles(tuple(JOINTS[k] for k in without), position[:, :, without])
    assert status_of(bare)["right_ankle_dorsiflexion"] == ABSENT


def test_standard_deviations_are_those_of_drawn_errors() -> None:
    draws, rng = 4000, np.random.default_rng(1)
    root = rng.normal(0, 0.003, (len(JOINTS), 3, 3))
    covariance = root @ root.transpose(0, 2, 1)
    upper = covariance[:, *np.triu_indices(3)]
    exact = posed(BENT | {"left_hip_rotation": 10.0})
    drawn = exact + np.einsum("jab,tjb->tja", root, rng.normal(size=(draws, len(JOINTS), 3)))
    found = joint_angles(JOINTS, drawn[:, None])
    stated = joint_angles(JOINTS, exact[None, None], upper[None, None]).sigma_deg[0, 0]
    known = np.isfinite(stated)
    assert known.sum() == len(ANGLES) - 2  # pronation
    spread = found.value_deg[:, 0, known].std(axis=0)
    # A standard deviation of 4000 draws is uncertain by 1 / sqrt(8000) = 1.1 %; four times that.
    np.testing.assert_allclose(spread, stated[known], rtol=0.045)
    again = joint_angles(JOINTS, np.repeat(exact[None, None], 3, axis=0), np.tile(upper, (3, 1, 1, 1)))
    np.testing.assert_array_equal(again.sigma_deg[2, 0], stated)
