"""White pose errors with a logged covariance for each pose."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.geometry.arrays import Float
from pipelines.geometry.noise import PoseErrors
from pipelines.reconstruction.refinement.refine import Refined, refine
from tests.reconstruction.formations import BONES, Formation, formation, mean_mm, triangulated

CAMERAS, TIMES = 3, 60
GOOD = np.repeat([0.03, np.radians(0.1)], 3)  # of position (m), rotation (rad)
POOR = np.repeat([0.6, np.radians(2.0)], 3)


def disturbed(root: Float, seed: int) -> Formation:
    """Simulate a flight whose pose errors have the logged covariances root root' [C, T, 6, 6]."""
    flight = formation(TIMES, CAMERAS, (), seed)
    drawn = np.random.default_rng(seed).normal(size=root.shape[:3])
    error = np.einsum("ctij,ctj->cti", root, drawn)
    sightings = [
        replace(
            sighting,
            position=sighting.position + off[:, :3],
            rotation=sighting.rotation @ Rotation.from_rotvec(off[:, 3:]).as_matrix(),
            pose_covariance=own @ np.swapaxes(own, 1, 2),
        )
        for sighting, off, own in zip(flight.sightings, error, root, strict=True)
    ]
    return replace(flight, sightings=sightings, start=triangulated(sightings))


def refined(flight: Formation, *, logged: bool) -> Refined:
    """Refine with the covariances (`logged`), or with their level alone."""
    stated = [sighting.pose_covariance for sighting in flight.sightings]
    covariance = np.stack([own for own in stated if own is not None])
    variance = np.diagonal(covariance, axis1=2, axis2=3).mean(axis=(0, 1))
    level = PoseErrors((float(variance[:3].mean() ** 0.5), float(variance[3:].mean() ** 0.5)), (), logged)
    return refine(flight.t_s, flight.sightings, flight.start, BONES, [level] * CAMERAS, np.zeros(CAMERAS))


def test_the_same_covariance_for_all_poses_is_a_level() -> None:
    """Compare up to the constant that keeps inverses finite, (1e-5)^2 against (1e-3)^2 and more."""
    flight = disturbed(np.tile(np.diag(GOOD), (CAMERAS, TIMES, 1, 1)), seed=1)
    own, level = refined(flight, logged=True), refined(flight, logged=False)
    assert own.fallback is None
    np.testing.assert_allclose(own.position, level.position, atol=1e-5)
    np.testing.assert_allclose(own.covariance, level.covariance, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("seed", [1, 2])
def test_good_poses_hold_up_the_poor_ones(seed: int) -> None:
    """Expect a better skeleton if the log states that every other group of poses is twenty times better.

    With equal weights, the mean of N poses errs by 1 / sqrt(2 N) of the poor level. With right weights, it
    errs by 1 / sqrt(N / 2) of the good level, a tenth of that. Motion is estimated too and adds error, so
    the test requires a factor of two.
    """
    poor = (np.arange(TIMES) // 10 + np.arange(CAMERAS)[:, None]) % 2 == 1
    root = np.where(poor[..., None], POOR, GOOD)[..., None] * np.eye(6)
    flight = disturbed(root, seed)
    own, level = refined(flight, logged=True), refined(flight, logged=False)
    assert own.fallback is None
    assert not own.warnings
    assert mean_mm(own.position, flight.truth) < 0.5 * mean_mm(level.position, flight.truth)


def test_correlations_count() -> None:
    """Use correlated errors of position and rotation (a lever arm): one unknown is left of six."""
    arm = np.zeros((6, 6))
    arm[:, 0] = [0.3, 0.2, 0.1, 0.01, 0.02, -0.01]
    arm += np.diag(GOOD / 10)
    flight = disturbed(np.tile(arm, (CAMERAS, TIMES, 1, 1)), seed=3)
    own, level = refined(flight, logged=True), refined(flight, logged=False)
    assert own.fallback is None
    assert mean_mm(own.position, flight.truth) < 0.5 * mean_mm(level.position, flight.truth)
