"""Covariances of accelerations: correlations shrink with few samples, limbs stay free with few views."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.arrays import Float
from pipelines.reconstruction.refinement.estimate import limber


def covariance(seed: int, joints: int) -> Float:
    root = np.random.default_rng(seed).normal(size=(joints, joints))
    found: Float = root @ root.T + 0.1 * np.eye(joints)
    return found


@given(st.integers(0, 2**32 - 1), st.integers(2, 17), st.floats(1.0, 3.0))
@settings(max_examples=40, deadline=None)
def test_limbs_move_more_and_the_body_as_before(seed: int, joints: int, spread: float) -> None:
    before = covariance(seed, joints)
    after = limber(before, spread)
    one = np.ones(joints)
    # Both have condition numbers below 1e5: of the inverse ten digits are right.
    assert one @ np.linalg.solve(after, one) == pytest.approx(one @ np.linalg.solve(before, one), rel=1e-8)
    # The difference of two joints contains no motion of the body.
    beside = np.eye(joints)[1:] - np.eye(joints)[0]
    np.testing.assert_allclose(
        beside @ after @ beside.T, spread**2 * beside @ before @ beside.T, rtol=1e-9, atol=1e-9
    )


def test_many_views_leave_accelerations_as_they_are() -> None:
    np.testing.assert_allclose(limber(covariance(0, 5), 0.9), covariance(0, 5), rtol=1e-12)
