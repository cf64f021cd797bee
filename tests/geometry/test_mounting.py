"""Mounts and gimbals against the worked example of docs/flight.md, axis by axis, and by their algebra."""

from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from pipelines.geometry.arrays import Float, Intrinsics
from pipelines.geometry.cameras import project
from pipelines.geometry.mounting import (
    Looks,
    Pose,
    attitude_from_angles,
    attitude_in_enu,
    body_from_camera,
    compose_gimbal,
)
from pipelines.geometry.poses import (
    compose,
    invert,
    matrix_from_quaternion,
    multiply,
    quaternion_from_rotation_vector,
    rotate,
    transform,
)

FORWARD, LEFT, UP = np.eye(3)
EAST, NORTH, _ = np.eye(3)
RIGHT_OF_PICTURE, BOTTOM_OF_PICTURE, AXIS = np.eye(3)
angles_deg = hnp.arrays(np.float64, (3,), elements=st.floats(-180, 180))

PAPER = (Path(__file__).resolve().parents[2] / "docs" / "flight.md").read_text(encoding="utf-8")
LEVER_ARM = np.array([0.10, 0.0, -0.05])
HEADING_NORTH = quaternion_from_rotation_vector(np.radians([0, 0, 90]))
LEVEL: Pose = (np.array([[10.0, 20.0, 30.0]]), HEADING_NORTH[None])
NOSE_DOWN: Pose = (
    LEVEL[0],
    multiply(HEADING_NORTH, quaternion_from_rotation_vector(np.radians([0, 10, 0])))[None],
)


def on_paper(vector: Float, decimals: int = 4) -> str:
    """Write a vector in the form of the worked example."""
    rounded = np.round(np.ravel(vector), decimals) + 0.0  # no negative zero
    return "(" + ", ".join(f"{value:.{decimals}f}" for value in rounded) + ")"


def gimbal_on_paper(
    world_from_body: Pose,
    angles: tuple[float, float, float],
    relative_to: Literal["world", "body"],
    axes: Literal["enu", "ned"],
) -> Pose:
    attitude = attitude_from_angles(np.array([angles]), order="ypr", units="deg")
    attitude = attitude_in_enu(attitude, relative_to=relative_to, axes=axes)
    return compose_gimbal(
        world_from_body, LEVER_ARM, attitude, body_from_camera("forward"), relative_to=relative_to
    )


def same_rotation(a: Float, b: Float) -> None:
    np.testing.assert_allclose(matrix_from_quaternion(a), matrix_from_quaternion(b), rtol=0, atol=1e-12)


# --- the worked example --------------------------------------------------------------------------------


def test_paper_case_1_fixed_mount() -> None:
    camera = compose(LEVEL, (LEVER_ARM, body_from_camera("forward", 30)))
    assert f"= {on_paper(camera[0])}\n\nThe optical axis" in PAPER
    for name, direction in (("axis ", AXIS), ("right", RIGHT_OF_PICTURE), ("bottom", BOTTOM_OF_PICTURE)):
        line = next(line for line in PAPER.splitlines() if line.strip().startswith(name) and "= (" in line)
        assert line.endswith(f"= {on_paper(rotate(camera[1], direction))}")
    hip = transform(invert(*camera), np.array([12.0, 40.1, 18.0]))
    assert f"bottom -10 + 11.95 cos 30 = {hip[0, 1]:.4f}; axis 20 cos 30 + 5.975 = {hip[0, 2]:.4f}" in PAPER
    assert hip[0, 0] == pytest.approx(2, abs=1e-12)
    pixel = project(hip, Intrinsics(1280, 720, 1000, 1000, 640, 360))
    assert f"= {on_paper(pixel, 2)}" in PAPER


def test_paper_case_2_gimbal_in_the_world() -> None:
    position, quaternion = gimbal_on_paper(NOSE_DOWN, (45, -20, 0), "world", "ned")
    case = PAPER.split("**2.")[1].split("**3.")[0]
    for vector in (position, rotate(quaternion, AXIS), rotate(quaternion, RIGHT_OF_PICTURE)):
        assert f"= {on_paper(vector)}\n" in case


def test_paper_case_3_gimbal_on_the_body() -> None:
    _, quaternion = gimbal_on_paper(LEVEL, (90, 20, 0), "body", "enu")
    case = PAPER.split("**3.")[1].split("**4.")[0]
    for direction in (AXIS, RIGHT_OF_PICTURE):
        assert f"= {on_paper(rotate(quaternion, direction))}\n" in case


# --- axis by axis --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("looks", "axis", "top"),
    [
        ("forward", FORWARD, UP),
        ("backward", -FORWARD, UP),
        ("left", LEFT, UP),
        ("right", -LEFT, UP),
        ("down", -UP, FORWARD),
        ("up", UP, -FORWARD),
    ],
)
def test_where_a_mount_looks_and_where_the_top_of_its_picture_is(
    looks: Looks, axis: Float, top: Float
) -> None:
    mount = body_from_camera(looks)
    np.testing.assert_allclose(rotate(mount, AXIS), axis, atol=1e-15)
    np.testing.assert_allclose(rotate(mount, -BOTTOM_OF_PICTURE), top, atol=1e-15)
    assert np.linalg.det(matrix_from_quaternion(mount)) == pytest.approx(1)


@pytest.mark.parametrize("looks", ["forward", "backward", "left", "right"])
@pytest.mark.parametrize("down_deg", [-90, -15, 0, 30, 90])
def test_a_tilt_lowers_the_axis_and_keeps_the_picture_level(looks: Looks, down_deg: float) -> None:
    mount, level = body_from_camera(looks, down_deg), body_from_camera(looks)
    axis = rotate(mount, AXIS)
    assert axis[2] == pytest.approx(-np.sin(np.radians(down_deg)), abs=1e-15)
    assert axis @ rotate(level, AXIS) == pytest.approx(np.cos(np.radians(down_deg)), abs=1e-15)
    np.testing.assert_allclose(
        rotate(mount, RIGHT_OF_PICTURE), rotate(level, RIGHT_OF_PICTURE), rtol=0, atol=1e-15
    )


@pytest.mark.parametrize(("looks", "down_deg"), [("down", 10), ("up", -1), ("forward", 91), ("left", np.nan)])
def test_tilts_without_meaning_are_refused(looks: Looks, down_deg: float) -> None:
    with pytest.raises(ValueError, match="deg"):
        body_from_camera(looks, down_deg)


@pytest.mark.parametrize(
    ("angles", "axis", "right"),
    [
        ((0, 0, 0), NORTH, EAST),
        ((90, 0, 0), EAST, -NORTH),
        ((-90, 0, 0), -EAST, NORTH),
        ((0, -90, 0), -UP, EAST),  # DJI: pitch -90 is straight down
        ((0, 90, 0), UP, EAST),
        ((0, 0, 90), NORTH, -UP),  # rolled: its right side lowered
    ],
)
def test_dji_angles_in_the_world(angles: tuple[float, float, float], axis: Float, right: Float) -> None:
    """Check yaw clockwise from north, pitch up, roll right side down, for any attitude of the body."""
    _, quaternion = gimbal_on_paper(NOSE_DOWN, angles, "world", "ned")
    np.testing.assert_allclose(rotate(quaternion[0], AXIS), axis, atol=1e-15)
    np.testing.assert_allclose(rotate(quaternion[0], RIGHT_OF_PICTURE), right, atol=1e-15)


# --- algebra -------------------------------------------------------------------------------------------


@given(angles_deg)
def test_angles_agree_with_scipy_whatever_their_order_and_unit(angles: Float) -> None:
    expected = Rotation.from_euler("ZYX", angles, degrees=True).as_quat()
    same_rotation(attitude_from_angles(angles, order="ypr", units="deg"), expected)
    same_rotation(attitude_from_angles(np.radians(angles[::-1]), order="rpy", units="rad"), expected)


@given(angles_deg)
def test_axes_of_a_log_change_names_and_not_the_view(angles: Float) -> None:
    """State the same attitude in NED (heading 90 - yaw, pitch and yaw mirrored) and in ENU."""
    yaw, pitch, roll = angles
    enu = attitude_from_angles(np.array([yaw, pitch, roll]), order="ypr", units="deg")
    ned = attitude_from_angles(np.array([90 - yaw, -pitch, roll]), order="ypr", units="deg")
    same_rotation(
        attitude_in_enu(enu, relative_to="world", axes="enu"),
        attitude_in_enu(ned, relative_to="world", axes="ned"),
    )
    frd = attitude_from_angles(np.array([-yaw, -pitch, roll]), order="ypr", units="deg")
    same_rotation(
        attitude_in_enu(enu, relative_to="body", axes="enu"),
        attitude_in_enu(frd, relative_to="body", axes="ned"),
    )


def test_yaw_from_the_nose_with_pitch_and_roll_from_the_horizon() -> None:
    """Use a body that heads 30 deg left of east and leans; FRD angles of 20 deg right and 40 deg down."""
    body = quaternion_from_rotation_vector(np.array([[0.0, 0.0, np.radians(30)]]))
    leaning = multiply(body, quaternion_from_rotation_vector(np.array([[0.2, 0.15, 0.0]])))
    stated = attitude_from_angles(np.array([[20.0, -40.0, 0.0]]), order="ypr", units="deg")
    attitude = attitude_in_enu(stated, relative_to="heading", axes="ned")
    nose = rotate(leaning, np.array([1.0, 0, 0]))[0]
    east_to_nose = np.arctan2(nose[1], nose[0])
    _, camera = compose_gimbal(
        (np.zeros((1, 3)), leaning), np.zeros(3), attitude, body_from_camera("forward"), relative_to="heading"
    )
    yaw, pitch = east_to_nose - np.radians(20), np.radians(-40)
    ahead = [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)]
    np.testing.assert_allclose(rotate(camera, np.array([0, 0, 1.0]))[0], ahead, atol=1e-12)
    right = rotate(camera, np.array([1.0, 0, 0]))[0]
    assert abs(right[2]) < 1e-12  # level, however the body leans
