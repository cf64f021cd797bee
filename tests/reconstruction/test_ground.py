"""Position errors between cameras, from pictures of a textured plane that are known in closed form."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Intrinsics
from pipelines.geometry.cameras import camera_matrix
from pipelines.geometry.noise import ROTATION, SHIFT_IN_WORLD, UNKNOWN_SIGMA, PoseErrors, Process
from pipelines.geometry.poses import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from pipelines.reconstruction.background_tracks import Followed, Stills, Tracks
from pipelines.reconstruction.ground import bind_positions
from pipelines.reconstruction.loading import load_pose_errors
from pipelines.reconstruction.observations import Camera, ErrorModes
from pipelines.session.description import Description, Interpolation
from pipelines.session.records import Detections, Trajectory

LENS = Intrinsics(640, 360, 400.0, 400.0, 319.5, 179.5)
BETWEEN = Interpolation(max_gap_s=1.0, max_extrapolation_s=0.0)
CONSTANT_M = 0.05
PICTURES, STILLS = 40, 5
TEXEL_M, SIDE_M = 0.02, 24.0


def texture(contrast: float) -> NDArray[np.uint8]:
    """Draw the ground: noise at several scales, 128 grey in the mean."""
    rng = np.random.default_rng(3)
    size = round(SIDE_M / TEXEL_M)
    grey = np.zeros((size, size))
    for blur_m in (0.04, 0.1, 0.3):
        layer = cv2.GaussianBlur(rng.standard_normal((size, size)), (0, 0), blur_m / TEXEL_M)
        grey += layer / layer.std()
    return np.clip(128 + contrast * grey, 0, 255).astype(np.uint8)


def flown(azimuth_deg: float, way_m: float) -> tuple[Float, Float]:
    """Fly past the origin, 7 m away and 4 m high, looking at it: position [T, 3], rotation [T, 3, 3]."""
    azimuth = np.radians(azimuth_deg)
    away, along = (
        np.array([np.cos(azimuth), np.sin(azimuth), 0]),
        np.array([-np.sin(azimuth), np.cos(azimuth), 0]),
    )
    position = 7 * away + np.linspace(-0.5, 0.5, PICTURES)[:, None] * way_m * along + [0, 0, 4]
    forward = -position / np.linalg.norm(position, axis=1, keepdims=True)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return position, np.stack([right, np.cross(forward, right), forward], axis=2)


def filmed(position: Float, rotation: Float, ground: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Render the plane z = 0 by the homography from its texels to the picture."""
    to_world = np.array([[TEXEL_M, 0, -SIDE_M / 2], [0, TEXEL_M, -SIDE_M / 2], [0, 0, 0], [0, 0, 1.0]])
    pose = np.concatenate([rotation.T, -(rotation.T @ position)[:, None]], axis=1)
    size = (LENS.width, LENS.height)
    return np.asarray(cv2.warpPerspective(ground, camera_matrix(LENS) @ pose @ to_world, size), np.uint8)


def camera(
    name: str, azimuth_deg: float, error_m: Float, ground: NDArray[np.uint8], way_m: float = 4.0
) -> tuple[Camera, Followed, Stills]:
    """Film the ground; the log's positions have a constant error."""
    t_ns = np.arange(PICTURES) * 50_000_000
    position, rotation = flown(azimuth_deg, way_m)
    points = np.stack(np.meshgrid(np.arange(-4, 4.1, 0.4), np.arange(-4, 4.1, 0.4), [0.0]), axis=-1).reshape(
        -1, 3
    )
    own = np.einsum("tji,tnj->tni", rotation, points - position[:, None])
    xy = LENS.fx * own[..., :2] / own[..., 2:] + [LENS.cx, LENS.cy]
    picture, point = np.nonzero(((xy > 0) & (xy < [LENS.width - 1, LENS.height - 1])).all(axis=2))
    rows = np.linspace(0, PICTURES - 1, STILLS).astype(np.int64)
    made = Camera(
        name,
        LENS,
        np.arange(PICTURES),
        t_ns,
        np.ones(PICTURES, dtype=np.bool_),
        Trajectory(t_ns, position + error_m, quaternion_from_matrix(rotation)),
        static=False,
        sigma=None,
        detections=Detections(
            ("nose",),
            np.empty(0, np.int64),
            np.empty(0, np.int64),
            np.empty((0, 1, 2)),
            np.empty((0, 1)),
            np.empty(0, np.int64),
        ),
        errors=PoseErrors((1e-3, 1e-4), (Process(SHIFT_IN_WORLD, CONSTANT_M), Process(ROTATION, 1e-3))),
    )
    return (
        made,
        Followed(
            np.arange(PICTURES), np.zeros(1, np.int64), [lambda: Tracks(picture, point, xy[picture, point])]
        ),
        Stills(rows, [filmed(position[r], rotation[r], ground) for r in rows].__getitem__),
    )


ERRORS_M = {"north": np.array([0.06, -0.04, 0.05]), "east": np.array([-0.05, 0.03, -0.06])}


def scene(
    contrast: float = 25.0, way_m: float = 4.0
) -> tuple[list[Camera], dict[str, Followed | str], dict[str, Stills]]:
    """Film the same ground by two cameras 60 degrees apart."""
    ground = texture(contrast)
    made = [
        camera(name, turn, error, ground, way_m)
        for (name, error), turn in zip(ERRORS_M.items(), (90, 30), strict=True)
    ]
    return (
        [each for each, _, _ in made],
        {each.name: followed for each, followed, _ in made},
        {each.name: stills for each, _, stills in made},
    )


def shift_sigma(camera: Camera) -> float:
    """Return the standard deviation that is stated of the constant position error."""
    assert camera.errors is not None
    return next(process.sigma0 for process in camera.errors.processes if process.number == SHIFT_IN_WORLD)


def test_offset_between_two_cameras_is_found() -> None:
    cameras, followed, stills = scene()
    binding = bind_positions(cameras, followed, stills, between=BETWEEN)
    assert binding.bound == ("north", "east")
    assert not binding.reasons
    left = [
        (moved.trajectory.position - flown(turn, 4.0)[0]).mean(axis=0)
        for moved, turn in zip(binding.cameras, (90, 30), strict=True)
    ]
    sigma = [shift_sigma(moved) for moved in binding.cameras]
    assert max(sigma) < CONSTANT_M / 3
    # Three axes of the difference of two cameras: four standard deviations.
    assert np.linalg.norm(left[0] - left[1]) < 4 * np.linalg.norm(sigma)
    assert np.linalg.norm(left[0] - left[1]) < 0.25 * np.linalg.norm(ERRORS_M["north"] - ERRORS_M["east"])
    # With equal priors the mean of both stays as logged, and as uncertain as a mean of two.
    assert sum(left) == pytest.approx(sum(ERRORS_M.values()), abs=2e-3)
    assert binding.common == pytest.approx(CONSTANT_M**2 / 2 * np.eye(3), rel=1e-6, abs=1e-9)


def test_offsets_are_found_where_nobody_stated_the_noise() -> None:
    cameras, followed, stills = scene()
    unknown = PoseErrors(
        (1e-3, 1e-4), (Process(SHIFT_IN_WORLD, UNKNOWN_SIGMA[0]), Process(ROTATION, 1e-3)), assumed=True
    )
    errors = {name: 3 * error for name, error in ERRORS_M.items()}
    logged = [
        replace(camera.trajectory, position=flown(turn, 4.0)[0] + errors[camera.name])
        for camera, turn in zip(cameras, (90, 30), strict=True)
    ]
    far = [replace(c, errors=unknown, trajectory=log) for c, log in zip(cameras, logged, strict=True)]
    binding = bind_positions(far, followed, stills, between=BETWEEN)
    assert binding.bound == ("north", "east")
    left = [
        (moved.trajectory.position - flown(turn, 4.0)[0]).mean(axis=0)
        for moved, turn in zip(binding.cameras, (90, 30), strict=True)
    ]
    sigma = [shift_sigma(moved) for moved in binding.cameras]
    assert max(sigma) < UNKNOWN_SIGMA[0] / 10
    assert np.linalg.norm(left[0] - left[1]) < 4 * np.linalg.norm(sigma)


def test_path_that_is_turned_as_a_whole_is_turned_back() -> None:
    """A background keeps a path and its attitudes together, and may leave both turned about the vertical."""
    cameras, followed, stills = scene()
    turn, up = np.radians(1.0), np.array([0.0, 0.0, 1.0])
    position, rotation = flown(90, 4.0)
    away = position - position.mean(axis=0)
    turned = matrix_from_quaternion(quaternion_from_rotation_vector(turn * up))
    log = Trajectory(
        cameras[0].trajectory.t_ns,
        position.mean(axis=0) + away @ turned.T + ERRORS_M["north"],
        quaternion_from_matrix(turned @ rotation),
    )
    response = np.concatenate([np.cross(turn * up, away), turn * rotation[:, 2]], axis=1)[..., None]
    modes = ErrorModes(log.t_ns, response, CONSTANT_M)
    first = replace(cameras[0], trajectory=log, modes=modes)
    binding = bind_positions([first, cameras[1]], followed, stills, between=BETWEEN)
    assert binding.bound == ("north", "east")
    found = matrix_from_quaternion(binding.cameras[0].trajectory.quaternion_xyzw)
    left = rotation_vector_from_quaternion(quaternion_from_matrix(found @ np.swapaxes(rotation, 1, 2)))
    # Patches of 1 cm on ground 16 m wide show a turn to some hundredths of a degree.
    assert np.abs(left).max() < turn / 4


def test_exact_camera_leaves_no_common_offset() -> None:
    cameras, followed, stills = scene()
    log = replace(cameras[1].trajectory, position=flown(30, 4.0)[0])
    exact = replace(cameras[1], trajectory=log, errors=PoseErrors((0.0, 0.0), ()))
    binding = bind_positions([cameras[0], exact], followed, stills, between=BETWEEN)
    assert binding.bound == ("north", "east")
    assert np.trace(binding.common) < 1e-9
    moved = binding.cameras[0]
    error = (moved.trajectory.position - flown(90, 4.0)[0]).mean(axis=0)
    assert np.linalg.norm(error) < 4 * shift_sigma(moved)
    assert binding.cameras[1].trajectory.position == pytest.approx(exact.trajectory.position, abs=1e-6)


@pytest.mark.parametrize(("contrast", "way_m"), [(0.0, 4.0), (25.0, 0.0)])
def test_flat_ground_and_hovering_cameras_bind_nothing(contrast: float, way_m: float) -> None:
    cameras, followed, stills = scene(contrast, way_m)
    binding = bind_positions(cameras, followed, stills, between=BETWEEN)
    assert binding.bound == ()
    assert set(binding.reasons) == {"north", "east"}
    assert binding.cameras == cameras
    assert not binding.common.any()


def test_camera_with_other_ground_is_not_bound() -> None:
    """Two cameras film the same ground, the third other ground: the two are bound, the third is not."""
    cameras, followed, stills = scene()
    elsewhere, its_followed, its_stills = camera("west", 150, np.zeros(3), texture(25.0)[::-1, ::-1].copy())
    binding = bind_positions(
        [*cameras, elsewhere],
        {**followed, "west": its_followed},
        {**stills, "west": its_stills},
        between=BETWEEN,
    )
    assert binding.bound == ("north", "east")
    assert set(binding.reasons) == {"west"}
    # Against the common error of the two it is as uncertain as both together.
    assert shift_sigma(binding.cameras[2]) == pytest.approx(CONSTANT_M * np.sqrt(1.5), rel=1e-6)


@pytest.mark.parametrize("missing", ["stills", "followed", "camera"])
def test_one_camera_alone_is_not_bound(missing: str) -> None:
    cameras, followed, stills = scene()
    if missing == "stills":
        del stills["east"]
    elif missing == "followed":
        followed.clear()
    else:
        del cameras[1]
    binding = bind_positions(cameras, followed, stills, between=BETWEEN)
    assert binding.bound == ()
    assert set(binding.reasons) == {each.name for each in cameras}
    assert binding.cameras == cameras


def test_a_drift_has_a_size_in_the_first_picture() -> None:
    """The log begins 4 s before the video: the walk has gone on for 4 s by then."""
    (made, _), *_ = scene()
    log = made.trajectory
    early = replace(made, errors=None, trajectory=replace(log, t_ns=log.t_ns - 4_000_000_000))
    description = cast(Description, SimpleNamespace(cameras={made.name: None}))
    noise = "drift:position_m_per_sqrt_s=0.06,rotation_deg_per_sqrt_s=0.3"
    (found,) = load_pose_errors(description, [early], noise) or []
    sigma = {process.number: process.sigma0 for process in found.processes}
    assert sigma == pytest.approx({SHIFT_IN_WORLD: 0.12, ROTATION: np.radians(0.6)}, rel=1e-6)
