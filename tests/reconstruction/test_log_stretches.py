"""Logs that stand still and jump on, or jump away and back: their wrong stretches lose their weight."""

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import quaternion_from_rotation_vector
from pipelines.reconstruction.log_stretches import MOST_SIGMA, mend
from pipelines.session.records import Trajectory

SECONDS, RATE_HZ = 8.0, 50


def flown(noise_m: float = 0.01, speed_mps: float = 1.0) -> Trajectory:
    """Fly along a slightly bent line and turn meanwhile, with white noise."""
    rng = np.random.default_rng(0)
    t_s = np.arange(0, SECONDS, 1 / RATE_HZ)
    place = np.stack([speed_mps * t_s, 0.05 * speed_mps * t_s**2, 5 + 0 * t_s], axis=1)
    turn = np.stack([0 * t_s, 0 * t_s, 0.2 * speed_mps * t_s], axis=1)
    turn += 0.1 * noise_m * rng.standard_normal(turn.shape)
    stamps = np.round(1e9 * t_s).astype(np.int64)
    return Trajectory(
        stamps,
        place + noise_m * rng.standard_normal(place.shape),
        np.asarray(quaternion_from_rotation_vector(turn)),
    )


def held(log: Trajectory, every: int, rows: slice = slice(None)) -> Trajectory:
    """Repeat every k-th pose until the next, in some rows."""
    source = np.arange(len(log.t_ns))
    source[rows] = source[rows.start or 0] + (source[rows] - (rows.start or 0)) // every * every
    return Trajectory(log.t_ns, log.position[source], log.quaternion_xyzw[source])


def off_m(log: Trajectory, truth: Trajectory) -> Float:
    apart: Float = np.linalg.norm(log.position - truth.position, axis=1)
    return apart


def test_a_frozen_stretch_is_bridged_and_loosened() -> None:
    truth = flown()
    frozen = slice(100, 201)
    log = held(truth, 1000, frozen)
    found = mend(log)
    assert (found.frozen, found.jumps) == (2, 0)  # positions and rotations
    assert found.poses == 100
    assert found.longest_s == pytest.approx(101 / RATE_HZ)
    assert off_m(log, truth).max() > 1.9
    assert off_m(found.trajectory, truth).max() < 0.12  # 0.05 m/s^2 of bending, and noise at both ends
    assert found.loosened is not None
    np.testing.assert_allclose(found.loosened[frozen][1:], [MOST_SIGMA] * 100)
    outside = np.ones(len(log.t_ns), dtype=bool)
    outside[frozen] = False
    assert not found.loosened[outside].any()
    np.testing.assert_array_equal(found.trajectory.position[outside], log.position[outside])


def test_a_stepping_log_becomes_a_line_through_its_steps() -> None:
    truth = flown()
    found = mend(held(truth, RATE_HZ))
    assert found.frozen > 10
    assert off_m(found.trajectory, truth)[: -2 * RATE_HZ].max() < 0.1


def test_a_jump_and_back_is_bridged() -> None:
    truth = flown()
    position = truth.position.copy()
    position[150:220] += [2.0, -1.0, 0.5]
    found = mend(Trajectory(truth.t_ns, position, truth.quaternion_xyzw))
    assert (found.frozen, found.jumps, found.poses) == (0, 1, 70)
    assert off_m(found.trajectory, truth).max() < 0.12


@pytest.mark.parametrize(
    "log",
    [
        flown(),
        flown(noise_m=0.3),
        flown(speed_mps=0.0),
        flown(noise_m=0.0, speed_mps=0.0),
        held(flown(), 10),
        held(flown(noise_m=0.01, speed_mps=0.0), RATE_HZ),
        Trajectory(flown().t_ns[:1], flown().position[:1], flown().quaternion_xyzw[:1]),
    ],
    ids=["flies", "noisy", "hovers", "stands", "at 5 Hz", "hovers at 1 Hz", "one pose"],
)
def test_other_logs_are_left_as_they_are(log: Trajectory) -> None:
    found = mend(log)
    assert found.loosened is None
    assert found.trajectory is log
