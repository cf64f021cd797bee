"""Full logged pose covariances: the same result if equal to a level, a better one if they contain more."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.geometry.noise import ROTATION, errors_of_level
from pipelines.geometry.triangulation import STATUS, Views, estimate_noise, triangulate
from pipelines.reconstruction.solving import (
    triangulate_weighted,
    triangulate_widened,
)
from tests.geometry.rings import ring, turned, with_pixel_noise

OK = STATUS.index("ok")


def level(covariance: Float) -> Float:
    """Compute the standard deviation per axis [..., 2] of position and rotation."""
    variances = np.diagonal(covariance, axis1=-2, axis2=-1)
    mean: Float = np.stack([variances[..., :3].mean(axis=-1), variances[..., 3:].mean(axis=-1)], axis=-1)
    return np.asarray(np.sqrt(mean), dtype=np.float64)


def disturbed(views: Views, covariance: Float, rng: np.random.Generator) -> Views:
    """Add pose errors [F, C] drawn from these covariances, with their level as `pose_sigma`."""
    root = np.linalg.cholesky(covariance)
    error = np.einsum("fcij,fcj->fci", root, rng.standard_normal((*covariance.shape[:2], 6)))
    return replace(
        views,
        position=views.position + error[..., :3],
        rotation=turned(views.rotation, error[..., 3:]),
        pose_sigma=level(covariance),
    )


def test_alike_axes_give_what_triangulation_gives() -> None:
    _, exact = ring(60, 4)
    covariance = np.tile(np.diag([0.01] * 3 + [1e-4] * 3), (60, 4, 1, 1))
    views = with_pixel_noise(disturbed(exact, covariance, np.random.default_rng(0)), np.random.default_rng(1))
    usual = triangulate(views, method="robust")
    weighted = triangulate_weighted(
        views, solve=partial(triangulate, method="robust"), pose_covariance=covariance
    )
    np.testing.assert_array_equal(weighted.status, usual.status)
    ok = usual.status == OK
    # Image covariances are taken at the point instead of where it was seen, and more steps are made:
    # together under a tenth of a standard deviation (triangulation stops within 0.1 at such noise).
    apart = np.linalg.norm(weighted.points - usual.points, axis=1)[ok]
    sigma = np.sqrt(np.trace(usual.covariance, axis1=1, axis2=2))[ok]
    assert (apart / sigma).max() < 0.1
    np.testing.assert_allclose(weighted.covariance[ok], usual.covariance[ok], atol=0.05 * sigma.min() ** 2)
    assert np.isnan(weighted.points[~ok]).all()


def test_what_a_log_knows_of_its_axes_makes_points_better_and_covariances_true() -> None:
    """Use heights that err by 0.3 m, the rest by 0.03 m; headings by 2 deg, levels by 0.2 deg; correlated.

    e' S^-1 e has the mean 3 and the variance 6; only joints of different frames are independent.
    """
    frames = 700
    truth, exact = ring(frames, 3)
    turn = np.diag(np.radians([0.2, 2.0, 0.2]) ** 2)  # about the camera's y, which is nearly down
    covariance = np.zeros((frames, 3, 6, 6))
    covariance[..., :3, :3] = np.diag([0.03, 0.03, 0.3]) ** 2
    covariance[..., 3:, 3:] = turn
    tie = np.zeros((3, 3))
    tie[2, 1] = 0.5 * 0.3 * np.radians(2.0)
    covariance[..., :3, 3:], covariance[..., 3:, :3] = tie, tie.T
    views = with_pixel_noise(disturbed(exact, covariance, np.random.default_rng(2)), np.random.default_rng(3))
    usual = triangulate(views, method="robust")
    weighted = triangulate_weighted(
        views, solve=partial(triangulate, method="robust"), pose_covariance=covariance
    )
    first = np.arange(0, len(truth), 17)[usual.status[::17] == OK]  # a joint of every frame
    assert len(first) > 0.97 * frames
    error, error_before = weighted.points[first] - truth[first], usual.points[first] - truth[first]
    whitened = np.linalg.solve(weighted.covariance[first], error[..., None])[..., 0]
    squared = np.einsum("ni,ni->n", error, whitened)
    assert squared.mean() == pytest.approx(3, abs=4 * np.sqrt(6 / len(first)))
    rms, rms_before = np.sqrt(np.mean(error**2)), np.sqrt(np.mean(error_before**2))
    predicted = np.sqrt(np.trace(weighted.covariance[first], axis1=1, axis2=2).mean() / 3)
    assert rms == pytest.approx(predicted, rel=4 / np.sqrt(2 * 2 * len(first)))
    assert rms < 0.9 * rms_before


def test_covariances_hold_where_nobody_stated_constant_errors() -> None:
    """Draw flights with constant errors of 0.05 m and 0.3 deg, and white ones of 0.02 m and 0.2 deg.

    The mean NEES is 3. By residuals alone it is 3.7.
    """
    frames, flights = 10, 300
    constant, white = (np.array([m] * 3 + [np.radians(deg)] * 3) for m, deg in ((0.05, 0.3), (0.02, 0.2)))
    truth, exact = ring(frames, 3)
    mean, inside = np.empty(flights), np.empty(flights)
    for flight in range(flights):
        rng = np.random.default_rng(flight)
        error = constant * rng.standard_normal((1, 3, 6)) + white * rng.standard_normal((frames, 3, 6))
        position, rotation = exact.position + error[..., :3], turned(exact.rotation, error[..., 3:])
        views = with_pixel_noise(replace(exact, position=position, rotation=rotation), rng)
        views = replace(views, pixel_sigma=estimate_noise(views))
        found = triangulate_widened(views, solve=partial(triangulate, method="robust"))
        off = (found.points - truth)[found.status == OK]
        information = np.linalg.inv(found.covariance[found.status == OK])
        squared = np.einsum("ni,nij,nj->n", off, information, off)
        mean[flight], inside[flight] = squared.mean(), (squared < 7.815).mean()  # 95 % of chi-square
    assert mean.mean() == pytest.approx(3, abs=3 * mean.std() / np.sqrt(flights))
    assert inside.mean() > 0.9


def test_a_level_alone_becomes_half_new_and_half_lasting_errors() -> None:
    errors = errors_of_level(np.array([0.3, 0.02]))
    found = np.square(errors.white)
    for process in errors.processes:
        assert process.constant
        found[1 if process.number == ROTATION else 0] += process.sigma0**2
    np.testing.assert_allclose(np.sqrt(found), [0.3, 0.02])
