"""Covariances against samples: errors are drawn in the log's convention and measured in the session's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import carried_covariance, mounted_covariance, pose_covariance_in_body

SAMPLES = 40_000
# A sampled covariance has a standard error of at most sqrt(2 / N) sqrt(S_ii S_jj) = 0.7 %: five of them. What
# is left out to first order is of the size of the angles, 0.01 rad, squared.
TOLERANCE = 5 * np.sqrt(2 / SAMPLES)
BODY = Rotation.from_euler("ZYX", [130, 20, -35], degrees=True)
CAMERA = Rotation.from_euler("ZYX", [-60, 45, 10], degrees=True)
LEVER_ARM = np.array([0.5, -0.2, 0.3])


def logged_covariance() -> Float:
    """Make a covariance with correlations, 1 to 10 cm and about 0.01 rad."""
    generator = np.random.default_rng(3)
    factor = np.diag([0.1, 0.05, 0.01, 0.01, 0.005, 0.02]) @ (np.eye(6) + 0.5 * generator.normal(size=(6, 6)))
    return np.asarray(factor @ factor.T)


def drawn_errors() -> tuple[Float, Rotation]:
    """Draw position errors in the world, and rotation errors about the world's fixed axes."""
    drawn = np.random.default_rng(4).multivariate_normal(np.zeros(6), logged_covariance(), SAMPLES)
    return drawn[:, :3], Rotation.from_rotvec(drawn[:, 3:])


def assert_sampled(position: Float, rotation_vector: Float, stated: Float) -> None:
    sampled = np.cov(np.hstack([position, rotation_vector]).T)
    scale = np.sqrt(np.diagonal(stated))
    np.testing.assert_allclose(
        sampled / np.outer(scale, scale), stated / np.outer(scale, scale), rtol=0, atol=TOLERANCE
    )


def test_the_rotation_of_a_log_turns_about_the_world_and_ours_about_the_body() -> None:
    position, rotation = drawn_errors()
    in_body = (BODY.inv() * (rotation * BODY)).as_rotvec()  # R_true = R exp(in_body)
    stated = pose_covariance_in_body(logged_covariance(), BODY.as_quat())
    assert_sampled(position, in_body, stated)
    assert not np.allclose(stated, logged_covariance(), rtol=0.2)  # the attitude matters


@pytest.mark.parametrize("on_gimbal", [False, True])
def test_a_lever_arm_turns_the_errors_of_attitude_into_errors_of_position(on_gimbal: bool) -> None:
    """Use a camera fixed to the body, or one held in the world with the error of the body's attitude."""
    position, rotation = drawn_errors()
    world_from_camera = CAMERA if on_gimbal else BODY * CAMERA
    moved = position + (rotation * BODY).apply(LEVER_ARM) - BODY.apply(LEVER_ARM)
    in_camera = (world_from_camera.inv() * (rotation * world_from_camera)).as_rotvec()
    body = pose_covariance_in_body(logged_covariance(), BODY.as_quat())
    stated = mounted_covariance(body, BODY.as_quat(), LEVER_ARM, world_from_camera.as_quat())
    assert_sampled(moved, in_camera, stated)


def test_many_at_once_and_unknown_stays_zero() -> None:
    covariance = np.stack([logged_covariance(), np.zeros((6, 6))])
    quaternions = np.stack([BODY.as_quat(), CAMERA.as_quat()])
    body = pose_covariance_in_body(covariance, quaternions)
    np.testing.assert_allclose(body[0], pose_covariance_in_body(covariance[0], quaternions[0]), atol=1e-18)
    assert not mounted_covariance(body, quaternions, LEVER_ARM, quaternions)[1].any()


def test_a_long_log_gives_the_same_as_its_parts() -> None:
    """Transform 9000 poses, a few thousand at a time; each equals that of a single pose to the last bit."""
    generator = np.random.default_rng(5)
    covariance = generator.normal(size=(9000, 6, 6))
    body, camera = (Rotation.random(9000, rng=generator).as_quat() for _ in range(2))
    some = [0, 4095, 4096, 8191, 8192, 8999]
    in_body = pose_covariance_in_body(covariance, body)
    mounted = mounted_covariance(covariance, body, LEVER_ARM, camera)
    moved = carried_covariance(covariance, position_xyzw=body, scale=2.0)
    np.testing.assert_array_equal(in_body[some], pose_covariance_in_body(covariance[some], body[some]))
    alone = mounted_covariance(covariance[some], body[some], LEVER_ARM, camera[some])
    np.testing.assert_array_equal(mounted[some], alone)
    np.testing.assert_array_equal(
        moved[some], carried_covariance(covariance[some], position_xyzw=body[some], scale=2.0)
    )
