"""Measurements of replayed cameras, where the result is known."""

from dataclasses import replace

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Intrinsics
from pipelines.geometry.noise import White
from pipelines.geometry.poses import look_at
from pipelines.planning.distance_field import open_space
from pipelines.planning.replay import CameraPaths, measure

LENS = Intrinsics(1280, 720, 760.0, 760.0, 639.5, 359.5)
TIMES, JOINTS = 40, 5


def exact(
    pixels: Float, free: Bool, camera: Float, target: Float, focal_px: float, rng: np.random.Generator
) -> tuple[Float, Float]:
    """Detect without errors every joint that is not hidden."""
    found = np.where(free[..., None], pixels, np.nan)
    return found, np.isfinite(found[..., 0]).astype(np.float64)


def two_pixels_off(
    pixels: Float, free: Bool, camera: Float, target: Float, focal_px: float, rng: np.random.Generator
) -> tuple[Float, Float]:
    found, confidence = exact(pixels, free, camera, target, focal_px, rng)
    return found + rng.normal(0, 2.0, found.shape), confidence


def watching(*cameras: tuple[float, float, float]) -> CameraPaths:
    """Make cameras at rest that look at a person who stands at x = 12, y = 0."""
    middle = np.tile([12.0, 0.0, 1.0], (TIMES, 1))
    joints = middle[:, None] + np.random.default_rng(0).uniform(-0.5, 0.5, (TIMES, JOINTS, 3))
    position = np.repeat(np.array(cameras)[:, None], TIMES, axis=1)
    count = len(cameras)
    return CameraPaths(
        t_ns=np.arange(TIMES) * 40_000_000,
        position=position,
        quaternion_xyzw=look_at(position, middle),
        known=np.ones((count, TIMES), dtype=np.bool_),
        intrinsics=[LENS] * count,
        noise=[[]] * count,
        joints=joints,
        middle=middle,
    )


SOUTH, EAST, BEHIND_THE_WALL = (12.0, -10.0, 3.0), (22.0, 0.0, 3.0), (12.0, 14.0, 3.0)


def test_without_errors_the_joints_come_back() -> None:
    measured = measure(watching(SOUTH, EAST), open_space(), exact, start_m=1.5, trials=2, seed=0)
    assert measured.error_m.shape == (2, TIMES, JOINTS)
    assert measured.error_m.max() < 1e-6
    assert measured.joint_frames == TIMES * JOINTS


def test_pose_noise_costs_what_it_says() -> None:
    """White noise of 0.1 m on two cameras 90 deg apart, level: across both axes of the plane one camera
    decides (0.1 m each), upwards the mean of both (0.1/sqrt 2). The mean length of such an error lies
    between the Rayleigh mean of two axes, 0.125 m, and the Maxwell mean of three, 0.160 m.
    """
    shot = watching((12.0, -10.0, 1.0), (22.0, 0.0, 1.0))
    noisy = replace(shot, noise=[[White(position_m=0.1)]] * 2)
    measured = measure(noisy, open_space(), exact, start_m=1.5, trials=20, seed=0)
    # 800 independent poses: the mean is known to 0.06 m / sqrt(800) = 2 mm.
    assert 0.125 - 0.008 < measured.error_m.mean() < 0.160 + 0.008


def test_the_same_seed_draws_the_same_noise_for_any_path() -> None:
    def errors(place: tuple[float, float, float], seed: int) -> Float:
        shot = watching(place, EAST)
        measured = measure(shot, open_space(), two_pixels_off, start_m=1.5, trials=3, seed=seed)
        return measured.error_m.astype(np.float64)

    one, again, other = errors(SOUTH, 4), errors(SOUTH, 4), errors(SOUTH, 5)
    nearby = errors((12.0, -10.1, 3.0), 4)
    assert one.tobytes() == again.tobytes()
    assert not np.array_equal(one, other)
    # 1 % farther away, that camera's part of the error is 1 % larger; fresh noise would differ by all of it.
    assert np.abs(one - nearby).mean() < 0.05 * one.mean()
