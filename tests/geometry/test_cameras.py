"""Cameras against OpenCV's own projection, and back again."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from pipelines.geometry.arrays import Float, Intrinsics
from pipelines.geometry.cameras import camera_matrix, fit_to_size, project, rescaled, row_delay_s, undistort
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

PINHOLE = Intrinsics(width=1280, height=720, fx=900.0, fy=910.0, cx=640.5, cy=355.25)
BARREL = replace(PINHOLE, model="radtan", distortion=(-0.28, 0.07, 0.0008, -0.0005))
FIVE = replace(PINHOLE, model="radtan", distortion=(-0.28, 0.07, 0.0008, -0.0005, 0.011))
RATIONAL = replace(
    PINHOLE, model="radtan", distortion=(0.31, -0.12, 0.0006, -0.0004, 0.004, 0.65, 0.02, -0.006)
)
FISHEYE = replace(PINHOLE, fx=400.0, fy=402.0, model="fisheye", distortion=(0.02, -0.011, 0.003, -0.0006))
EVERY = pytest.mark.parametrize(
    "camera",
    [PINHOLE, BARREL, FIVE, RATIONAL, FISHEYE],
    ids=["none", "radtan4", "radtan5", "radtan8", "fisheye"],
)


def points_in_view(camera: Intrinsics, count: int = 200) -> Float:
    """Draw points whose undistorted image lies in the picture, 1 to 40 m away."""
    rng = np.random.default_rng(3)
    pixels = rng.uniform([0, 0], [camera.width, camera.height], (count, 2))
    normalised = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    depth = rng.uniform(1, 40, (count, 1))
    return np.concatenate([normalised * depth, depth], axis=1)


def opencv_pixels(points: Float, camera: Intrinsics) -> Float:
    zero = np.zeros(3)
    coefficients = np.array(camera.distortion or [0.0] * 4)
    if camera.model == "fisheye":
        pixels, _ = cv2.fisheye.projectPoints(
            points.reshape(1, -1, 3), zero, zero, camera_matrix(camera), coefficients
        )
    else:
        pixels, _ = cv2.projectPoints(points, zero, zero, camera_matrix(camera), coefficients)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


@EVERY
def test_projection_is_opencv_s(camera: Intrinsics) -> None:
    points = points_in_view(camera)
    # Both compute in double: a few units in the last place of pixels up to 1300 (2e-13 each).
    np.testing.assert_allclose(project(points, camera), opencv_pixels(points, camera), rtol=0, atol=1e-10)


@EVERY
def test_undistorting_what_opencv_projected_gives_the_rays(camera: Intrinsics) -> None:
    points = points_in_view(camera)
    rays = undistort(opencv_pixels(points, camera), camera)
    np.testing.assert_allclose(rays, points[:, :2] / points[:, 2:], rtol=0, atol=1e-10)


@EVERY
@given(data=st.data())
def test_every_pixel_with_a_ray_is_where_that_ray_projects(camera: Intrinsics, data: st.DataObject) -> None:
    pixel = np.array(data.draw(st.tuples(st.floats(-3000, 4000), st.floats(-3000, 4000))))
    ray = undistort(pixel, camera)
    if np.isnan(ray).any():
        assert camera.model != "none"
        return
    back = project(np.array([*ray, 1.0]), camera)
    # Rays are good to 1e-10 relative above 1; a pixel moves by at most f times that times the slope of
    # the distortion, which is below 1.6 wherever these cameras see.
    scale = max(1.0, float(np.abs(ray).max()))
    np.testing.assert_allclose(back, pixel, rtol=0, atol=camera.fx * 1e-10 * scale * 1.6)


@given(
    k=st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=3),
    p=st.lists(st.floats(-0.005, 0.005), min_size=2, max_size=2),
    ray=st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5)),
)
def test_a_projected_ray_comes_back_or_is_nan(
    k: list[float], p: list[float], ray: tuple[float, float]
) -> None:
    camera = replace(PINHOLE, model="radtan", distortion=(k[0], k[1], p[0], p[1], k[2]))
    pixel = project(np.array([*ray, 1.0]), camera)
    back = undistort(pixel, camera)
    # Right at the fold the inverse has no finite slope: NaN is allowed there, another ray never is. An
    # accepted Newton step of 1e-10 on a residual of 1e-16 leaves a slope of 1e-6; 1e-16 / 1e-6 is far below.
    if not np.isnan(back).any():
        np.testing.assert_allclose(back, ray, rtol=0, atol=1e-6)


def test_beyond_the_fold_there_is_no_ray_and_no_pixel() -> None:
    # r (1 + k r^2) with k = -0.3 turns at r = sqrt(1 / 0.9) = 1.0541, where the distorted radius is 0.7027.
    camera = replace(PINHOLE, fx=100.0, fy=100.0, model="radtan", distortion=(-0.3, 0.0, 0.0, 0.0))
    radii = np.array([1.05, 1.06, 1.5])
    pixels = project(np.stack([radii, 0 * radii, 0 * radii + 1], axis=1), camera)
    assert np.isfinite(pixels).all(axis=1).tolist() == [True, False, False]
    seen = np.array([0.70, 0.705, 3.0])
    rays = undistort(np.stack([camera.cx + 100 * seen, 0 * seen + camera.cy], axis=1), camera)
    assert np.isfinite(rays).all(axis=1).tolist() == [True, False, False]
    assert rays[0, 0] < np.sqrt(1 / 0.9)
    assert rays[0, 0] * (1 - 0.3 * rays[0, 0] ** 2) == pytest.approx(0.70, abs=1e-10)


def test_a_pole_of_the_rational_model_bounds_its_rays() -> None:
    # 1 / (1 - r^2 / 4) grows without end towards r = 2: every pixel has its ray on this side of the pole.
    camera = replace(PINHOLE, model="radtan", distortion=(0, 0, 0, 0, 0, -0.25, 0, 0))
    rays = undistort(np.array([[camera.cx + 900.0 * radius, camera.cy] for radius in (1.0, 50.0)]), camera)
    # r = t (1 - r^2 / 4)  =>  r = 2 (sqrt(1 + t^2) - 1) / t
    np.testing.assert_allclose(
        rays[:, 0], [2 * (np.sqrt(1 + t * t) - 1) / t for t in (1.0, 50.0)], atol=1e-10
    )
    assert np.isnan(project(np.array([2.1, 0.0, 1.0]), camera)).all()


def test_resized_pictures_are_opencvs() -> None:
    picture = np.zeros((60, 80), dtype=np.float32)
    picture[21:27, 40:52] = 1.0  # its centre is (45.5, 23.5)
    small = cv2.resize(picture, (40, 30), interpolation=cv2.INTER_AREA)
    rows, columns = np.mgrid[:30, :40]
    centre = np.array([(columns * small).sum(), (rows * small).sum()]) / small.sum()
    lens = Intrinsics(80, 60, 100.0, 100.0, 45.5, 23.5, "none", ())
    half = rescaled(lens, 40, 30)
    np.testing.assert_allclose([half.cx, half.cy], centre, atol=1e-6)


def test_the_same_shape_at_another_size_is_rescaled() -> None:
    fitted, note = fit_to_size(PINHOLE, 1920, 1080)
    assert (fitted.width, fitted.height) == (1920, 1080)
    assert (fitted.fx, fitted.cy) == (1350.0, 533.125)  # (355.25 + 0.5) * 1.5 - 0.5
    assert note is not None
    assert "1920 x 1080" in note
    assert "rescaled" in note


def test_a_slightly_other_shape_is_kept_with_a_note() -> None:
    # The real recording: pictures 1080 wide, calibrated at 1088 (0.7 % off).
    calibrated = replace(PINHOLE, width=1088, height=1920)
    fitted, note = fit_to_size(calibrated, 1080, 1920)
    assert fitted == replace(calibrated, width=1080)
    assert note is not None
    assert "1088 x 1920" in note


@pytest.mark.parametrize(
    ("size", "bars"),
    [((640, 480), (0, 60, 0, 60)), ((800, 360), (80, 0, 80, 0)), ((1280, 730), (0, 0, 0, 10))],
    ids=["above and below", "at the sides", "below"],
)
def test_a_letterboxed_picture_shows_the_same_rays_between_its_bars(
    size: tuple[int, int], bars: tuple[int, int, int, int]
) -> None:
    fitted, note = fit_to_size(BARREL, *size, bars)
    points = points_in_view(BARREL)
    factor = (size[0] - bars[0] - bars[2]) / BARREL.width
    expected = (project(points, BARREL) + 0.5) * factor - 0.5 + bars[:2]
    np.testing.assert_allclose(project(points, fitted), expected, rtol=0, atol=1e-10)
    assert (fitted.width, fitted.height) == size
    assert note is not None


def test_bars_count_only_around_a_picture_of_the_calibrated_shape() -> None:
    # The real recording: 1080 / 1088 of 1920 rows are 1905.9. 7 rows of bars at both ends leave 1906.
    calibrated = replace(PINHOLE, width=1088, height=1920)
    for rows, is_letterboxed in ((5, False), (7, True), (9, False)):
        fitted, _ = fit_to_size(calibrated, 1080, 1920, (0, rows, 0, rows))
        assert (fitted.fx < calibrated.fx) == is_letterboxed
    with pytest.raises(ValueError, match="1280 x 720"):
        fit_to_size(PINHOLE, 960, 720, (0, 0, 0, 60))


@pytest.mark.parametrize("size", [(960, 720), (1280, 700), (720, 1280), (0, 0)])
def test_another_shape_is_refused_with_both_sizes(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=rf"{size[0]} x {size[1]}.*1280 x 720"):
        fit_to_size(PINHOLE, *size)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "picture size 0 x 720"),
        ({"height": 720.5}, "picture size"),
        ({"fx": -900.0}, "focal lengths"),
        ({"fy": np.nan}, "focal lengths"),
        ({"cx": np.inf}, "principal point"),
        ({"readout_s": -0.01}, "readout"),
        ({"model": "kb4"}, "none of none, radtan, fisheye"),
        ({"model": "radtan", "distortion": (0.1,) * 12}, "12 coefficients instead of 4 or 5 or 8"),
        ({"model": "fisheye", "distortion": ()}, "0 coefficients instead of 4"),
        ({"distortion": (0.1,)}, "1 coefficients instead of 0"),
        ({"model": "fisheye", "distortion": (0.1, np.nan, 0, 0)}, "not all finite"),
    ],
)
def test_impossible_intrinsics_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(PINHOLE, **change)  # type: ignore[arg-type]  # wrong on purpose


def test_rows_are_read_from_the_top_about_the_middle() -> None:
    camera = Intrinsics(64, 49, 50.0, 50.0, 31.5, 24.0, readout_s=0.03)
    delays = row_delay_s(np.array([0.0, 24.0, 48.0, np.nan]), camera)
    np.testing.assert_allclose(delays, [-0.015, 0.0, 0.015, np.nan])
    assert row_delay_s(np.array(7.0), replace(camera, readout_s=0.0)) == 0.0


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
