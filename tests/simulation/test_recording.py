"""Simulated recorders: their stamps, their exact poses, and errors as large as they say."""

import math

import numpy as np
import pytest

from pipelines.geometry.mounting import body_from_camera, compose_gimbal
from pipelines.geometry.noise import NoiseModel, White
from pipelines.geometry.poses import conjugate, mounted_covariance, multiply, rotation_vector_from_quaternion
from pipelines.simulation.flying import (
    LEVER_ARM,
    DronePaths,
    DronePoses,
    estimate,
    fly,
    frame_times,
    log_times,
    moments,
    poses_at,
    ring_slots,
)
from pipelines.simulation.scenario import FormationSettings, Lens, Limits


def flight(rate_hz: int = 100) -> DronePaths:
    """Fly two drones that circle a walking actor for ten seconds."""
    t_s = moments(-1.0, 10.0)[:: 100 // rate_hz]
    actor = np.stack([1.2 * t_s, 0 * t_s, 1.0 + 0 * t_s], axis=1)
    formation = FormationSettings(yaw_rate_deg_per_s=15.0, variation=1.0)
    return fly(ring_slots(formation, 2, actor, t_s), actor, t_s, Limits())


PATHS = flight()


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


# --- stamps --------------------------------------------------------------------------------------------
def test_frames_are_even_but_for_those_that_were_lost() -> None:
    """10,000 frames: the standard error of a share of 0.2 is 0.4 %."""
    lens = Lens(rate_hz=30, dropped_share=0.2)
    t_ns = frame_times(lens, 10_000 / 30, generator())
    whole = frame_times(lens.model_copy(update={"dropped_share": 0.0}), 10_000 / 30, generator())
    assert len(whole) == 10_000
    assert np.abs(np.diff(whole) - 1e9 / 30).max() <= 1
    assert 0 <= whole[0] < 1e9 / 30
    assert whole[-1] < 10_000 / 30 * 1e9
    assert np.isin(t_ns, whole).all()
    assert 1 - len(t_ns) / len(whole) == pytest.approx(0.2, abs=0.016)


# --- true poses ----------------------------------------------------------------------------------------
def test_between_moments_poses_go_on_smoothly() -> None:
    """From every fifth moment (0.05 s), the others come out: a cubic errs by jerk h^3 / 100, attitudes
    by their angular acceleration h^2 / 8. While circling both are below 4 m/s^3 and 1 rad/s^2.
    """
    every = slice(200, None, 5)
    coarse = DronePaths(
        PATHS.t_s[every],
        PATHS.position[:, every],
        PATHS.velocity[:, every],
        PATHS.body_xyzw[:, every],
        PATHS.camera_xyzw[:, every],
    )
    asked_ns = np.rint(PATHS.t_s[200:-5] * 1e9).astype(np.int64)
    poses, truth = poses_at(coarse, 0, asked_ns), poses_at(PATHS, 0, asked_ns)
    assert np.abs(poses.position - truth.position).max() < 4 * 0.05**3 / 100
    for one, other in (
        (poses.quaternion_xyzw, truth.quaternion_xyzw),
        (poses.camera_quaternion_xyzw, truth.camera_quaternion_xyzw),
    ):
        turned = rotation_vector_from_quaternion(multiply(conjugate(one), other))
        assert np.linalg.norm(turned, axis=1).max() < 1 * 0.05**2 / 8


# --- estimated poses -----------------------------------------------------------------------------------
@pytest.mark.parametrize("models", [[], [White(position_m=0.3, rotation_deg=1.0)]])
def test_body_and_gimbal_make_the_camera(models: list[NoiseModel]) -> None:
    """As ingest composes them: the camera of the log, which is the true one without noise."""
    truth = poses_at(PATHS, 0, log_times(50.0, (0.0, 9.0), generator()))
    log = estimate(truth, models, generator(1))
    body, arm = (log.body.position, log.body.quaternion_xyzw), np.array(LEVER_ARM)
    forward = body_from_camera("forward")
    on_body = multiply(conjugate(body[1]), log.gimbal_xyzw)
    for position, quaternion in (
        compose_gimbal(body, arm, log.gimbal_xyzw, forward, relative_to="world"),
        compose_gimbal(body, arm, on_body, forward, relative_to="body"),
    ):
        assert position == pytest.approx(log.camera.position, abs=1e-9)
        cosine = np.abs(np.sum(quaternion * log.camera.quaternion_xyzw, axis=1))
        assert cosine == pytest.approx(1.0, abs=1e-12)
        if not models:
            assert position == pytest.approx(truth.camera_position, abs=1e-9)
            assert log.body.position == pytest.approx(truth.position, abs=1e-9)
            turned = multiply(conjugate(truth.camera_quaternion_xyzw), quaternion)
            assert rotation_vector_from_quaternion(turned) == pytest.approx(0.0, abs=1e-9)


def many_poses() -> DronePoses:
    t_ns = np.arange(20_000) * 500_000
    return poses_at(PATHS, 0, t_ns)


def test_covariances_of_the_body_are_those_of_its_errors() -> None:
    """The normalised squared error of six numbers: its mean over 20,000 rows is 6 +- sqrt(12 / 20,000).

    To first order; with rotations of 1.5 degrees the second is 0.03 % of it.
    """
    truth = many_poses()
    # As large in the lever arm as in the place itself, so that their correlation matters.
    log = estimate(truth, [White(position_m=0.003, rotation_deg=1.5)], generator(3))
    turned = multiply(conjugate(truth.quaternion_xyzw), log.body.quaternion_xyzw)
    error = np.concatenate(
        [log.body.position - truth.position, rotation_vector_from_quaternion(turned)], axis=1
    )
    assert log.body.covariance is not None
    squared = np.einsum("ti,tij,tj->t", error, np.linalg.inv(log.body.covariance), error)
    assert squared.mean() == pytest.approx(6.0, abs=4 * math.sqrt(12 / 20_000) + 0.02)
    # What ingest makes of it is the camera's again.
    carried = mounted_covariance(
        log.body.covariance, log.body.quaternion_xyzw, np.array(LEVER_ARM), log.camera.quaternion_xyzw
    )
    assert log.camera.covariance is not None
    assert np.abs(carried - log.camera.covariance).max() < 1e-15
