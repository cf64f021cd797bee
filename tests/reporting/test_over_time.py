from __future__ import annotations

import numpy as np
import pytest

from pipelines.geometry.triangulation import STATUS
from pipelines.reporting import over_time
from pipelines.reporting.motion import motion_from_skeleton

from .conftest import FRAMES, RATE_HZ, make_skeleton, statuses


def test_bins_hold_each_time_once() -> None:
    for count in (1, 2, 299, 300, 301, 5000):
        seconds = np.arange(count) / RATE_HZ + 3.0
        bins = over_time.time_bins(seconds)
        assert len(bins) - 1 == min(count, over_time.MOST_BINS)
        assert np.histogram(seconds, bins)[0].sum() == count


def test_percentiles_are_those_of_each_bin() -> None:
    rng = np.random.default_rng(3)
    seconds = np.arange(1200) / RATE_HZ
    values = rng.random((1200, 2, 17))
    values[rng.random(values.shape) < 0.3] = np.nan
    values[400:420] = np.nan
    bins = over_time.time_bins(seconds)
    middle, low, high = over_time.percentiles(values, seconds, bins)
    # 300 bins of 4 times each.
    expected = [
        np.nanpercentile(values[4 * k : 4 * k + 4], [50, 10, 90]) for k in range(300) if not 100 <= k < 105
    ]
    np.testing.assert_allclose(
        np.stack([middle, low, high], axis=1)[~np.isnan(middle)], np.array(expected), rtol=1e-12
    )
    assert np.flatnonzero(np.isnan(middle)).tolist() == list(range(100, 105))


def test_status_shares_are_those_of_each_bin() -> None:
    motion = motion_from_skeleton(make_skeleton())
    seconds = np.arange(FRAMES) / RATE_HZ
    _, shares = over_time._status_shares(seconds, motion, over_time.time_bins(seconds))
    np.testing.assert_allclose(shares.sum(axis=0), 1.0)
    # 600 times in 300 bins of two: the share over all times is the mean over the bins.
    for code, word in enumerate(STATUS):
        assert shares[code].mean() == pytest.approx(np.mean(statuses(FRAMES) == word))
