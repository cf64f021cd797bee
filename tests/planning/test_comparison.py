"""Means, differences and their intervals against known properties of the bootstrap."""

from typing import Any

import numpy as np
import pytest

from pipelines.geometry.arrays import Float, Int64
from pipelines.planning.comparison import (
    common_frames,
    coverage,
    equal_ranges,
    mean_over_time,
    mpjpe_mm,
    pck,
    verdict,
    worth_flying,
)


def test_a_finer_time_makes_a_mean_no_surer() -> None:
    """A value that holds for 5 s is as sure as there are such values, however fine the time.

    Stretches of 5 s that begin anywhere hold parts of two values: (1 - u)^2 over the lags u makes 2/3 of the
    variance. The ends of 2000 draws scatter by 4 % of half a width; the variance of 100 sums by 8 %.
    """
    held = np.random.default_rng(1).normal(size=100)
    for rate_hz in (2, 50):
        t_s = np.arange(0, 500, 1 / rate_hz)
        values = held[(t_s // 5).astype(np.int64)]
        estimate = mean_over_time(values, nanoseconds(t_s), seed=0)
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


def change(points: float, mm: float, *, half: float = 0.1) -> dict[str, Any]:
    """Return a difference in points of joints within 150 mm and in mm, with narrow intervals."""
    return {
        "pck150": {"mean": points / 100, "interval": [(points - half) / 100, (points + half) / 100]},
        "mpjpe_mm": {"mean": mm, "interval": [mm - half, mm + half]},
    }


@pytest.mark.parametrize(
    ("difference", "judged"),
    [
        (change(3.0, -8.0), [1, 1]),
        (change(0.2, -8.0), [0, 1]),  # 0.2 points decide nothing
        (change(3.0, 4.0), [1, 0]),  # nor do 4 mm
        (change(3.0, 8.0), [1, -1]),
        (change(3.0, -8.0, half=9.0), [0, 0]),  # noise
        (change(0.0, 0.0), [0, 0]),  # the same arm twice
    ],
)
def test_a_difference_counts_by_its_practical_size(difference: dict[str, Any], judged: list[int]) -> None:
    assert worth_flying(difference) == judged


@pytest.mark.parametrize(
    ("arms", "disagree", "words"),
    [
        (["a"], False, "a is better than b"),
        (["a", "b"], False, "no difference"),
        (["a", "b"], True, "disagree"),
    ],
)
def test_the_verdict_names_both_figures(arms: list[str], disagree: bool, words: str) -> None:
    difference = {"arm": "a", "against": "b", **change(6.5, -9.3)}
    said = verdict({"arms": arms, "disagree": disagree, "left_out": [], "difference": difference}, ["a", "b"])
    assert words in said
    assert "+6.5 [+6.4, +6.6]" in said
    assert "-9.3 [-9.4, -9.2]" in said
