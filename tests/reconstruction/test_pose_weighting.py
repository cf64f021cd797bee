"""Covariances where nobody stated the poses' errors, and errors of which only a level is known."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from pipelines.geometry.noise import ROTATION, errors_of_level
from pipelines.geometry.triangulation import STATUS, estimate_noise, triangulate
from pipelines.reconstruction.solving import triangulate_widened
from tests.geometry.rings import ring, turned, with_pixel_noise

OK = STATUS.index("ok")


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
