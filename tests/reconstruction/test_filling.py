"""Filling of gaps: the choice of gaps, the filled values, and the calibration of their covariance."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.triangulation import STATUS
from pipelines.reconstruction.finishing import fill_gaps

Int64 = NDArray[np.int64]

OK, FILLED, REJECTED, FEW = (STATUS.index(name) for name in ("ok", "filled", "rejected", "few_views"))
RATE = 30
STEP_NS = 1_000_000_000 // RATE


def stamps(count: int) -> Int64:
    return 1_700_000_000_000_000_000 + np.arange(count, dtype=np.int64) * STEP_NS


def skeleton(position: Float, missing: list[range]) -> tuple[Float, Float, NDArray[np.int8]]:
    """Build a skeleton of one joint [T, 3], rejected in these ranges; covariance 1 cm^2 times 1, 2, 3."""
    status = np.full((len(position), 1, 1), OK, dtype=np.int8)
    for gap in missing:
        status[gap] = REJECTED
    lost = status == REJECTED
    covariance = np.tile(np.diag([1e-4, 2e-4, 3e-4]), (len(position), 1, 1, 1, 1))
    covariance[lost] = np.nan
    return np.where(lost[..., None], np.nan, position[:, None, None]), covariance, status


def line(count: int) -> Float:
    steps = np.arange(count, dtype=np.float64)[:, None]
    way: Float = steps * np.array([0.04, -0.02, 0.01]) + np.array([1000.0, 2000.0, 1.0])
    return way


def test_a_straight_way_is_filled_exactly_and_its_covariance_is_that_of_the_line() -> None:
    position, covariance, status = skeleton(line(60), [range(20, 23)])
    before = position.copy(), covariance.copy(), status.copy()
    filled = fill_gaps(stamps(60), position, covariance, status, max_gap_s=0.14)
    np.testing.assert_allclose(filled.position[:, 0, 0], line(60), atol=1e-9)  # rounding of 2000 m
    assert (filled.status[20:23] == FILLED).all()
    assert filled.counts == {"gaps": 1, "joint_frames": 3, "gaps_without_example": 0}
    # A quarter of each end in the middle, 10/16 at a quarter of the way; a line misses nothing.
    expected = np.diag([1e-4, 2e-4, 3e-4])
    np.testing.assert_allclose(filled.covariance[21, 0, 0], expected / 2, atol=1e-15)
    np.testing.assert_allclose(filled.covariance[20, 0, 0], expected * 10 / 16, atol=1e-15)
    for given, kept in zip((position, covariance, status), before, strict=True):
        np.testing.assert_array_equal(given, kept)


@pytest.mark.parametrize(
    ("missing", "limit_s", "closed"),
    [
        ([range(20, 23)], 4 / RATE, True),  # from sample 19 to 23: the limit itself
        ([range(20, 23)], 4 / RATE - 0.001, False),
        ([range(3)], 10, False),  # nothing before
        ([range(57, 60)], 10, False),  # nothing after
        ([range(1, 3)], 10, False),  # a single sample before
        ([range(20, 22), range(23, 25)], 10, False),  # a single sample between two gaps
        ([range(20, 22), range(24, 26)], 10, True),
    ],
)
def test_only_gaps_with_measured_sides_and_of_that_length(
    missing: list[range], limit_s: float, closed: bool
) -> None:
    position, covariance, status = skeleton(line(60), missing)
    filled = fill_gaps(stamps(60), position, covariance, status, max_gap_s=limit_s)
    lost = status == REJECTED
    if closed:
        assert (filled.status[lost] == FILLED).all()
    else:
        np.testing.assert_array_equal(filled.status, status)
        assert np.isnan(filled.position[lost]).all()
        assert filled.counts["joint_frames"] == 0


def test_a_gap_that_nothing_like_it_judges_stays_open() -> None:
    position, covariance, status = skeleton(line(30), [range(10, 18)])
    filled = fill_gaps(stamps(30), position, covariance, status, max_gap_s=1)
    # 12 samples of which the middle 8 are taken out: 30 with a hole have one such place, not four.
    assert filled.counts == {"gaps": 0, "joint_frames": 0, "gaps_without_example": 1}


def test_the_covariance_tells_how_far_the_middle_of_a_gap_is_off() -> None:
    """Compare the squared error with the covariance for a swinging wrist, measured with 1 cm per axis.

    In the middle the covariance is half of a sample's plus the mean outer product M of 24 interpolation
    errors, which include the noise of five samples. With M known, the mean would be below 3, because M
    includes noise of the middle sample that an error against the truth has not. With 24 errors it is up to
    24 / 20 as large (Hotelling).
    """
    rng = np.random.default_rng(5)
    squared = []
    for _ in range(30):
        t_s = np.arange(240) / RATE
        phase = rng.uniform(0, 2 * np.pi, (3, 2))
        swing = np.array([[0.25, 0.05], [0.15, 0.04], [0.1, 0.03]])
        truth = np.stack(
            [a * np.sin(2 * np.pi * t_s + p) + b * np.sin(4 * np.pi * t_s + q)
             for (a, b), (p, q) in zip(swing, phase, strict=True)], axis=-1
        )  # fmt: skip
        gaps = [range(first, first + 7) for first in (50, 120, 190)]
        position, covariance, status = skeleton(truth + rng.normal(0, 0.01, truth.shape), gaps)
        covariance[status == OK] = np.eye(3) * 1e-4
        filled = fill_gaps(stamps(240), position, covariance, status, max_gap_s=0.3)
        for gap in gaps:
            middle = gap.start + 3
            error = filled.position[middle, 0, 0] - truth[middle]
            squared.append(error @ np.linalg.solve(filled.covariance[middle, 0, 0], error))
    # 90 errors scatter by sqrt(6 / 90) = 0.26 in their mean.
    assert 1.5 < float(np.mean(squared)) < 3.6 + 0.6
