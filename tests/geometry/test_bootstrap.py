"""Intervals of means over time, against the known variances of the series."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.metrics import RESAMPLES, STRETCH_S, intervals, stretch_samples

RATE = 30
SAMPLES = 60 * RATE
ONE = np.ones(SAMPLES)
NORMAL_95 = 2 * 1.959964


def stamps(count: int = SAMPLES) -> NDArray[np.int64]:
    return 1_700_000_000_000_000_000 + np.arange(count, dtype=np.int64) * (1_000_000_000 // RATE)


def mean_width(series: Float) -> float:
    """Compute the mean width of the intervals of many series [K, T]."""
    widths = []
    for k, values in enumerate(series):
        found = intervals({"x": (values, ONE)}, stamps(), seed=k)["x"]
        assert found is not None
        widths.append(found[1] - found[0])
    return float(np.mean(widths))


def test_independent_errors_give_the_interval_of_the_textbook() -> None:
    series = np.random.default_rng(1).normal(5, 2, (40, SAMPLES))
    # 12 stretches: the variance of so few sums scatters by sqrt(2/12) = 41 % and a width by half of that;
    # the ends of 2000 draws by 4 % of half a width; 40 series: 3.3 %, and the mean width of a chi with 12
    # degrees is 2 % short. Three times the one, and the other.
    expected = NORMAL_95 * 2 / np.sqrt(SAMPLES)
    assert mean_width(series) == pytest.approx(expected, rel=0.12)


def test_errors_that_last_widen_the_interval_by_what_their_memory_asks_for() -> None:
    memory = RATE // 2
    rng = np.random.default_rng(2)
    noise = rng.normal(0, 1, (40, SAMPLES + memory - 1))
    total = np.cumsum(np.pad(noise, ((0, 0), (1, 0))), axis=1)
    series = (total[:, memory:] - total[:, :-memory]) / memory  # moving averages over half a second
    # The variance of a mean is sum (1 - |h| / L) gamma(h) / T in stretches of L samples (Kuensch 1989), with
    # gamma(h) = (1 - |h| / K) / K for the moving average over K.
    length = stretch_samples(stamps())
    lag = np.abs(np.arange(1 - memory, memory))
    variance = float(np.sum((1 - lag / length) * (1 - lag / memory) / memory)) / SAMPLES
    assert length == STRETCH_S * RATE
    assert mean_width(series) == pytest.approx(NORMAL_95 * np.sqrt(variance), rel=0.12)
    # Taken as independent, they would seem four times as sure (sqrt(15)).
    assert mean_width(series) > 3 * NORMAL_95 * float(series.std()) / np.sqrt(SAMPLES)


def test_nothing_to_draw_from_has_no_interval() -> None:
    nothing = np.zeros(SAMPLES)
    assert intervals({"a": (nothing, nothing)}, stamps()) == {"a": None}
    assert intervals({"a": (ONE[:9], ONE[:9])}, stamps(9)) == {"a": None}
    # One sample in a minute: some resampled minutes miss it.
    rare = nothing.copy()
    rare[40] = 1
    assert intervals({"a": (rare, rare)}, stamps()) == {"a": None}


@pytest.mark.parametrize(("trials", "low", "high"), [(3, 0.92, 0.98), (100, 0.93, 0.97)])
def test_the_interval_of_trials_holds_the_mean_as_often_as_it_says(
    trials: int, low: float, high: float
) -> None:
    """Skewed errors, as those of joints: 1,000 draws know a share of 95 % to 0.7 %."""
    values = np.random.default_rng(5).gamma(8.0, 1.0, (1000, trials))
    found = [intervals({"x": (own, np.ones(trials))}, None)["x"] for own in values]
    assert low < np.mean([ends is not None and ends[0] <= 8.0 <= ends[1] for ends in found]) < high


def test_trials_pair_sums_with_weights() -> None:
    values = np.random.default_rng(5).normal(5, 2, 400)
    found = intervals({"x": (values, np.ones(400)), "ratio": (3 * values, values)}, None)
    assert found["x"] is not None
    assert np.diff(found["x"]) == pytest.approx(NORMAL_95 * 2 / np.sqrt(400), rel=0.15)
    assert found["ratio"] == pytest.approx((3.0, 3.0))
    assert intervals({"x": (values[:1], ONE[:1])}, None) == {"x": None}


def test_short_flights_are_cut_into_five_and_seeds_repeat() -> None:
    assert stretch_samples(stamps(60)) == 12
    values = np.random.default_rng(4).normal(size=SAMPLES)
    first, again, other = (intervals({"x": (values, ONE)}, stamps(), seed=seed)["x"] for seed in (0, 0, 1))
    assert first == again != other
    assert RESAMPLES >= 1000
