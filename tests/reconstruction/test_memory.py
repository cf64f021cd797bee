"""Memory of image points: the variance of their mean if part of the error is correlated over time."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.reconstruction.refinement.estimate import memory_of_whole_error

FRAMES, FLIGHTS = 1000, 2000


@pytest.mark.parametrize(("kept", "scale"), [(0.8, 0.25), (0.9, 0.5)])
def test_the_mean_of_errors_that_hardly_show_is_as_uncertain(kept: float, scale: float) -> None:
    """Add first-order errors of tau = (1 + kept) / (1 - kept) to white ones; the stated variance is 1.

    The variance of 2000 means is known to sqrt(2 / 2000) = 3 %. The tolerance is four times that, plus
    tau / 1000 for the ends.
    """
    rng = np.random.default_rng(0)
    tau = (1 + kept) / (1 - kept)
    error = np.empty((FRAMES, FLIGHTS))
    error[0] = rng.normal(size=FLIGHTS)
    for k in range(1, FRAMES):
        error[k] = kept * error[k - 1] + np.sqrt(1 - kept**2) * rng.normal(size=FLIGHTS)
    seen = scale * rng.normal(size=error.shape) + np.sqrt(1 - scale**2) * error
    of_one = scale**2 / FRAMES  # variance of the mean if the visible errors were independent
    assert memory_of_whole_error(tau, scale) == pytest.approx(
        seen.mean(axis=0).var() / of_one, rel=0.13 + tau / FRAMES
    )


def test_points_better_than_stated_are_no_reason_to_count_them_less_than_their_memory_says() -> None:
    assert memory_of_whole_error(3.0, 1.0) == 3.0
    assert memory_of_whole_error(3.0, 2.0) == 3.0
