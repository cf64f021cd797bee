"""The actor's filter: closed forms, causality, and errors as large as it says."""

import numpy as np
import pytest

from pipelines.planning.forecast import ActorFilter


def test_a_steady_walk_is_forecast_exactly() -> None:
    """Linear motion without noise is the model itself: once the velocity is certain, nothing is left."""
    actor = ActorFilter(q=1e-9, sigma_m=1e-6)
    for t in np.arange(0, 2, 0.1):
        actor.measure(t, np.array([1.2 * t, 3.0 - 0.5 * t, 1.0]))
    ahead = actor.forecast(np.array([2.0, 12.0]))
    assert ahead == pytest.approx(np.array([[2.4, 2.0, 1.0], [14.4, -3.0, 1.0]]), abs=1e-3)


def test_errors_are_as_large_as_stated() -> None:
    """Normalised squared errors of 400 simulated walks: mean 2 per axis for position and velocity.

    400 walks x 3 axes are independent chi-squares with 2 degrees of freedom: the mean's standard deviation
    is 2/sqrt(1200) = 0.058; five of them are allowed.
    """
    rng = np.random.default_rng(3)
    q, sigma, dt, steps = 0.4, 0.25, 0.2, 30
    Q = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    total = 0.0
    for _ in range(400):
        actor = ActorFilter(q=q, sigma_m=sigma)
        truth = np.stack([rng.normal(size=3), 3.0 * rng.normal(size=3)])
        for k in range(steps):
            if k:
                truth[0] += dt * truth[1]
                truth += np.linalg.cholesky(Q) @ rng.normal(size=(2, 3))
            actor.measure(k * dt, truth[0] + sigma * rng.normal(size=3))
        position, velocity, covariance = actor.at((steps - 1) * dt)
        error = truth - np.stack([position, velocity])
        total += float((error * np.linalg.solve(covariance, error)).sum())
    assert total / 1200 == pytest.approx(2.0, abs=5 * 0.058)
