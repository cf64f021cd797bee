from __future__ import annotations

import numpy as np
import pytest

from pipelines.reporting import chart, figures
from pipelines.reporting.content import motion_from_skeleton

from .conftest import FRAMES, RATE_HZ, make_skeleton


def test_bins_hold_each_time_once() -> None:
    for count in (1, 2, 299, 300, 301, 5000):
        seconds = np.arange(count) / RATE_HZ + 3.0
        bins = chart.time_bins(seconds)
        assert len(bins) - 1 == min(count, chart.MOST_BINS)
        assert np.histogram(seconds, bins)[0].sum() == count


def test_percentiles_are_those_of_each_bin() -> None:
    rng = np.random.default_rng(3)
    seconds = np.arange(1200) / RATE_HZ
    values = rng.random((1200, 2, 17))
    values[rng.random(values.shape) < 0.3] = np.nan
    values[400:420] = np.nan
    bins = chart.time_bins(seconds)
    middle, low, high = chart.percentiles(values, seconds, bins)
    # 300 bins of 4 times each.
    expected = [
        np.nanpercentile(values[4 * k : 4 * k + 4], [50, 10, 90]) for k in range(300) if not 100 <= k < 105
    ]
    np.testing.assert_allclose(
        np.stack([middle, low, high], axis=1)[~np.isnan(middle)], np.array(expected), rtol=1e-12
    )
    assert np.flatnonzero(np.isnan(middle)).tolist() == list(range(100, 105))


def test_snapshots_are_the_fullest_times_of_their_stretches() -> None:
    motion = motion_from_skeleton(make_skeleton())
    chosen = figures._fullest_times(motion)
    count = motion.measured[:, 0].sum(axis=1)
    stretches = np.array_split(np.arange(FRAMES), figures.SNAPSHOTS)
    assert len(chosen) == figures.SNAPSHOTS
    for time, stretch in zip(chosen, stretches, strict=True):
        assert time in stretch
        assert count[time] == count[stretch].max()


def test_a_path_is_thinned_and_broken_at_gaps() -> None:
    t_ns = np.delete(np.arange(3000), slice(1000, 1500)) * 20_000_000
    path = np.column_stack([t_ns / 1e9, np.zeros(len(t_ns))])
    drawn, every = figures._drawn_path(t_ns, path, [int(t_ns[999])])
    assert every == 5  # 2500 points, at most 600
    (breaks,) = np.nonzero(np.isnan(drawn[:, 0]))
    assert len(breaks) == 2  # at the gap and at the end
    # Both ends of the gap are drawn, nothing within it.
    assert drawn[breaks[0] - 1, 0] == pytest.approx(999 * 0.02)
    assert drawn[breaks[0] + 1, 0] == pytest.approx(1500 * 0.02)
    assert len(drawn) <= chart.MOST_POINTS + 4
