"""Pose errors: draws have the stated scatter in the stated frame, and covariances of logs are theirs."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.noise import (
    Bias,
    Drift,
    GaussMarkov,
    Latency,
    NoiseModel,
    White,
    build,
    disturb,
    parse,
)
from pipelines.geometry.poses import (
    carried_covariance,
    conjugate,
    mounted_covariance,
    multiply,
    pose_covariance_in_body,
    quaternion_from_rotation_vector,
    rotate,
    rotation_vector_from_quaternion,
)

CLASSES: dict[str, type[NoiseModel]] = {
    "white": White,
    "bias": Bias,
    "drift": Drift,
    "gauss-markov": GaussMarkov,
    "latency": Latency,
}
EPOCH = 1_700_000_000_000_000_000
DRAWS = 800


def circling(t_s: Float) -> tuple[Int64, Float, Float]:
    """Move a camera on a 10 m circle at 0.3 rad/s, turning with it."""
    angle = 0.3 * t_s
    position = 10 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    quaternion = quaternion_from_rotation_vector(angle[:, None] * np.array([0.0, 0, 1]))
    return EPOCH + np.round(t_s * 1e9).astype(np.int64), position, quaternion


def difference(log: tuple[Int64, Float, Float], noisy: tuple[Float, Float]) -> Float:
    """Compute errors [T, 6]: translation in the world, rotation vector in the camera."""
    _, position, quaternion = log
    turned = rotation_vector_from_quaternion(multiply(conjugate(quaternion), noisy[1]))
    return np.concatenate([noisy[0] - position, turned], axis=1)


def draws(models: list[NoiseModel], t_s: Float, count: int = DRAWS) -> Float:
    """Compute the errors [count, T, 6] of independent draws."""
    rng = np.random.default_rng(11)
    log = circling(t_s)
    return np.stack([difference(log, disturb(models, *log, rng)) for _ in range(count)])


SCATTERED = [
    White(position_m=0.3, rotation_deg=1.0),
    Bias(position_m=0.3, rotation_deg=1.0, frame="body"),
    Drift(position_m_per_sqrt_s=0.05, rotation_deg_per_sqrt_s=0.2),
    Drift(position_m_per_sqrt_s=0.05, rotation_deg_per_sqrt_s=0.2, frame="body"),
    GaussMarkov(position_m=0.5, rotation_deg=0.1, correlation_s=20),
]


@pytest.mark.parametrize("model", SCATTERED, ids=lambda model: f"{type(model).__name__}-{model.frame}")
def test_draws_scatter_as_the_marginal_sigma_says(model: NoiseModel) -> None:
    t_s = np.array([0.0, 0.5, 4.0, 30.0])
    found = draws([model], t_s)
    still = np.zeros_like(t_s)
    expected = model.marginal_sigma(t_s, still, still)
    measured = np.stack([found[..., :3], found[..., 3:]], axis=2).std(axis=(0, 3))
    # A standard deviation from n values scatters by 1/sqrt(2 n); the 3 axes are independent: n = 3 DRAWS.
    # Five of those sigmas: one failure in a million.
    np.testing.assert_allclose(measured, expected, rtol=5 / math.sqrt(2 * 3 * DRAWS), atol=1e-15)
    # The mean scatters by sigma / sqrt(DRAWS) on each of 24 axes and times.
    assert (np.abs(found.mean(axis=0)) <= 5 * np.repeat(expected, 3, axis=1) / math.sqrt(DRAWS)).all()


def correlation(found: Float) -> float:
    """Compute the correlation of the first and the last time, over draws and axes of the position."""
    first, last = found[:, 0, :3].ravel(), found[:, -1, :3].ravel()
    return float(np.mean(first * last) / np.sqrt(np.mean(first**2) * np.mean(last**2)))


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        (White(position_m=1.0), 0.0),
        (Bias(position_m=1.0), 1.0),
        (GaussMarkov(position_m=1.0, correlation_s=10.0), math.exp(-0.6)),
        (Drift(position_m_per_sqrt_s=1.0), math.sqrt(2.0 / 8.0)),  # min(s, t) / sqrt(s t)
    ],
    ids=lambda value: type(value).__name__,
)
def test_errors_remember_as_their_process_does(model: NoiseModel, expected: float) -> None:
    # From 2 s to 8 s with uneven steps between; the first pose at 0 s is where drift starts.
    found = draws([model], np.array([0.0, 2.0, 2.5, 6.0, 8.0]))[:, 1:]
    # A correlation from n pairs scatters by (1 - r^2)/sqrt(n).
    tolerance = 5 * (1 - expected**2) / math.sqrt(3 * DRAWS)
    assert correlation(found) == pytest.approx(expected, abs=tolerance + 1e-9)


def test_a_bias_is_constant_in_its_frame() -> None:
    log = circling(np.linspace(0, 10, 30))
    rng = np.random.default_rng(0)
    in_world = difference(log, disturb([Bias(position_m=0.3, rotation_deg=2.0)], *log, rng))
    np.testing.assert_allclose(in_world, np.tile(in_world[0], (30, 1)), atol=1e-12)
    in_body = difference(log, disturb([Bias(position_m=0.3, frame="body")], *log, rng))
    np.testing.assert_allclose(
        rotate(conjugate(log[2]), in_body[:, :3]), np.tile(in_body[0, :3], (30, 1)), atol=1e-12
    )
    assert np.ptp(in_body[:, 0]) > 0.01


def test_a_body_drift_accumulates_along_the_camera_s_axes() -> None:
    log = circling(np.linspace(0, 10, 30))
    model = Drift(position_m_per_sqrt_s=0.1)
    body_model = Drift(position_m_per_sqrt_s=0.1, frame="body")
    in_world = difference(log, disturb([model], *log, np.random.default_rng(4)))
    in_body = difference(log, disturb([body_model], *log, np.random.default_rng(4)))
    np.testing.assert_allclose(rotate(conjugate(log[2]), in_body[:, :3]), in_world[:, :3], atol=1e-12)


def test_latency_shows_where_the_camera_was() -> None:
    # Straight flight at 5 m/s turning at 0.4 rad/s, 100 ms late.
    t_s = np.arange(0, 2, 0.05)
    quaternion = quaternion_from_rotation_vector(t_s[:, None] * np.array([0.0, 0.4, 0]))
    log = (EPOCH + np.arange(40, dtype=np.int64) * 50_000_000, t_s[:, None] * [5.0, 0, 0], quaternion)
    model = Latency(latency_ms=100)
    error = difference(log, disturb([model], *log, np.random.default_rng(0)))
    late = np.array([-0.5, 0, 0, 0, -0.04, 0])
    np.testing.assert_allclose(error[2:], np.tile(late, (38, 1)), atol=1e-12)
    np.testing.assert_allclose(error[0], 0, atol=1e-15)  # nothing is known from before the log
    sigma = model.marginal_sigma(t_s, np.full(40, 5.0), np.full(40, 0.4))
    np.testing.assert_allclose(sigma, np.tile([0.5, 0.04], (40, 1)))


# --- from what users write -----------------------------------------------------------------------------
def test_a_flight_s_pose_noise_becomes_models() -> None:
    pose_noise: dict[str, dict[str, object]] = {
        "white": {"position_m": 0.1, "rotation_deg": 0.5},
        "bias": {"frame": "body", "position_m": 1},
    }
    assert build(pose_noise.items(), CLASSES) == [
        White(position_m=0.1, rotation_deg=0.5),
        Bias(position_m=1.0, frame="body"),
    ]


def test_the_text_form_becomes_the_same_models() -> None:
    text = "white:position_m=0.3, rotation_deg=1e+0 +drift: position_m_per_sqrt_s=5e-2,frame=body"
    text += "+latency:latency_ms=40"
    assert build(parse(text), CLASSES) == [
        White(position_m=0.3, rotation_deg=1.0),
        Drift(position_m_per_sqrt_s=0.05, frame="body"),
        Latency(latency_ms=40.0),
    ]


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("pink", {}, "pink is none of bias, drift, gauss-markov, latency, white"),
        ("white", {"sigma": 1.0}, "white has no sigma; its parameters are frame, position_m, rotation_deg"),
        ("bias", {"position_m": -0.1}, "bias: position_m is -0.1"),
        ("bias", {"rotation_deg": math.nan}, "bias: rotation_deg is nan"),
        ("drift", {"position_m_per_sqrt_s": math.inf}, "drift: position_m_per_sqrt_s is inf"),
        ("white", {"position_m": "0.3 m"}, "'0.3 m' instead of a number"),
        ("white", {"position_m": True}, "True instead of a number"),
        ("bias", {"frame": "camera"}, "'camera' instead of world or body"),
        ("gauss-markov", {"position_m": 0.5}, "gauss-markov needs correlation_s"),
        ("gauss-markov", {"correlation_s": 0}, "correlation_s is 0"),
        ("latency", {}, "latency needs latency_ms"),
    ],
)
def test_nonsense_is_refused_by_name(name: str, parameters: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build([(name, parameters)], CLASSES)


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
