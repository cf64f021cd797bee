from __future__ import annotations

import numpy as np
import pytest

from pipelines.geometry.triangulation import STATUS
from pipelines.reporting import figures, plates
from pipelines.reporting.motion import motion_from_skeleton

from .conftest import FRAMES, JOINTS, RATE_HZ, make_skeleton, statuses, true_positions


def test_bins_hold_each_time_once() -> None:
    for count in (1, 2, 299, 300, 301, 5000):
        seconds = np.arange(count) / RATE_HZ + 3.0
        bins = plates.time_bins(seconds)
        assert len(bins) - 1 == min(count, plates.MOST_BINS)
        assert np.histogram(seconds, bins)[0].sum() == count


def test_percentiles_are_those_of_each_bin() -> None:
    rng = np.random.default_rng(3)
    seconds = np.arange(1200) / RATE_HZ
    values = rng.random((1200, 2, 17))
    values[rng.random(values.shape) < 0.3] = np.nan
    values[400:420] = np.nan
    bins = plates.time_bins(seconds)
    middle, low, high = plates.percentiles(values, seconds, bins)
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
    _, shares = figures._status_shares(seconds, motion, plates.time_bins(seconds))
    np.testing.assert_allclose(shares.sum(axis=0), 1.0)
    # 600 times in 300 bins of two: the share over all times is the mean over the bins.
    for code, word in enumerate(STATUS):
        assert shares[code].mean() == pytest.approx(np.mean(statuses(FRAMES) == word))


def test_snapshots_are_the_fullest_times_of_their_stretches() -> None:
    motion = motion_from_skeleton(make_skeleton())
    chosen = figures._fullest_times(motion)
    count = motion.measured[:, 0].sum(axis=1)
    stretches = np.array_split(np.arange(FRAMES), figures.SNAPSHOTS)
    assert len(chosen) == figures.SNAPSHOTS
    for time, stretch in zip(chosen, stretches, strict=True):
        assert time in stretch
        assert count[time] == count[stretch].max()


def test_the_body_faces_right_whatever_its_heading() -> None:
    for start_s in (0.0, 7.0, 20.0):
        (body,) = true_positions(np.array([start_s]))
        aside, up = figures._three_quarter_view(body, JOINTS)
        nose, ear = JOINTS.index("nose"), [JOINTS.index("left_ear"), JOINTS.index("right_ear")]
        # The nose is 0.1 m before the middle of the ears, seen under 35 degrees.
        assert aside[nose] - aside[ear].mean() == pytest.approx(0.1 * np.cos(np.radians(35)), abs=1e-9)
        assert np.array_equal(up, body[:, 2])
        # Seen from its right, half from the front: its left shoulder (0.38 m away) is further right.
        left, right = JOINTS.index("left_shoulder"), JOINTS.index("right_shoulder")
        assert aside[left] - aside[right] == pytest.approx(0.38 * np.sin(np.radians(35)), abs=1e-9)
