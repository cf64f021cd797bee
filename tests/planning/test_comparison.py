"""Means, differences and their intervals against known properties of the bootstrap."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.geometry.arrays import Float, Int64
from pipelines.planning.comparison import (
    common_frames,
    coverage,
    equal_ranges,
    mean_of_trials,
    mean_over_time,
    mpjpe_mm,
    pck,
)


def test_the_interval_of_a_mean_is_that_of_the_normal_distribution() -> None:
    """400 draws: the standard error of the mean is sd/20; 2000 resamples give its ends to some per cent.

    The 2.5 % quantile of the resampled means is known to 1.96 sd' sqrt(p (1 - p) / 2000) / (p's density),
    0.06 standard errors; 0.25 is four times that.
    """
    values = np.random.default_rng(3).normal(5.0, 2.0, 400)
    estimate = mean_of_trials(values, seed=0)
    assert estimate is not None
    assert estimate["interval"] is not None
    standard_error = values.std() / 20
    assert estimate["mean"] == pytest.approx(values.mean())
    expected = values.mean() + 1.96 * standard_error * np.array([-1, 1])
    assert estimate["interval"] == pytest.approx(tuple(expected), abs=0.25 * standard_error)
    assert mean_of_trials(values, seed=0) == estimate


def test_a_finer_time_makes_a_mean_no_surer() -> None:
    """A value that holds for 5 s is as sure as there are such values, however fine the time.

    Stretches of 5 s that begin anywhere hold parts of two values: (1 - u)^2 over the lags u makes 2/3 of the
    variance. The ends of 2000 draws scatter by 4 % of half a width; the variance of 100 sums by 8 %.
    """
    held = np.random.default_rng(1).normal(size=100)
    for rate_hz in (2, 50):
        t_s = np.arange(0, 500, 1 / rate_hz)
        values = held[(t_s // 5).astype(np.int64)]
        estimate = mean_over_time(values, np.ones(len(t_s), dtype=bool), nanoseconds(t_s), seed=0)
        assert estimate is not None
        assert estimate["interval"] is not None
        width = estimate["interval"][1] - estimate["interval"][0]
        assert width == pytest.approx(2 * 1.96 * held.std() * np.sqrt(2 / 3 / 100), rel=0.15)


def nanoseconds(t_s: Float) -> Int64:
    return np.round(t_s * 1e9).astype(np.int64)


def test_errors_on_common_joint_frames() -> None:
    """Two trials, two times, one joint: the second arm misses one, a third arm everything."""
    nan = np.nan
    one = np.array([[[0.1], [0.3]], [[0.2], [0.2]]], dtype=np.float32)
    two = np.array([[[0.2], [nan]], [[0.4], [0.2]]], dtype=np.float32)
    blind = np.full_like(one, nan)
    shared = common_frames({"one": one, "two": two, "blind": blind})
    assert shared[..., 0].tolist() == [[True, False], [True, True]]
    assert mpjpe_mm(one, shared) == pytest.approx([100, 200])
    assert mpjpe_mm(two, shared) == pytest.approx([200, 300])
    assert mpjpe_mm(blind, np.isfinite(blind)).size == 0
    # Of the right joints, those of all joint-frames count: what is missing is wrong.
    assert pck(one, 2) == pytest.approx([0.5, 0.0])
    assert pck(blind, 2) == pytest.approx([0.0, 0.0])
    assert pck(np.full_like(one, 0.15), 4) == pytest.approx([0.5, 0.5])
    assert coverage(two, 2) == pytest.approx([0.5, 1.0])
    assert coverage(blind, 0) == pytest.approx([0.0, 0.0])


def test_arms_of_equal_range_are_grouped_from_near_to_far() -> None:
    assert equal_ranges({"a": 10.0, "b": 8.0, "c": 9.75, "d": 8.25, "e": 10.25}) == [
        ["b", "d"],
        ["c", "a"],  # e is 0.5 m from c, although it is near a
        ["e"],
    ]
    assert equal_ranges({}) == []
