from __future__ import annotations

import numpy as np
import pytest

from pipelines.geometry.triangulation import STATUS
from pipelines.reporting import figures
from pipelines.reporting.motion import motion_from_skeleton
from pipelines.reporting.plates import MOST_POINTS

from .conftest import FRAMES, JOINTS, RATE_HZ, make_skeleton, statuses, true_positions


def test_bins_hold_each_time_once() -> None:
    for count in (1, 2, 299, 300, 301, 5000):
        seconds = np.arange(count) / RATE_HZ + 3.0
        bins = figures.time_bins(seconds)
        assert len(bins) - 1 == min(count, figures.MOST_BINS)
        assert np.histogram(seconds, bins)[0].sum() == count


def test_percentiles_are_those_of_each_bin() -> None:
    rng = np.random.default_rng(3)
    seconds = np.arange(1200) / RATE_HZ
    values = rng.random((1200, 2, 17))
    values[rng.random(values.shape) < 0.3] = np.nan
    values[400:420] = np.nan
    bins = figures.time_bins(seconds)
    middle, low, high = figures.percentiles(values, seconds, bins)
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
    _, shares = figures._status_shares(seconds, motion, figures.time_bins(seconds))
    np.testing.assert_allclose(shares.sum(axis=0), 1.0)
    # 600 times in 300 bins of two: the share over all times is the mean over the bins.
    for code, word in enumerate(STATUS):
        assert shares[code].mean() == pytest.approx(np.mean(statuses(FRAMES) == word))


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
    assert len(drawn) <= MOST_POINTS + 4


def test_middle_of_the_body_ignores_a_stray_joint() -> None:
    table = make_skeleton(10).assign(status="ok")
    positions = true_positions(np.arange(10) / RATE_HZ)
    table[["x", "y", "z"]] = positions.reshape(-1, 3)
    table.loc[table["joint"] == "left_wrist", "x"] = 1e6
    (middle,) = figures._middles(motion_from_skeleton(table))
    # The median of a body stays within the body: no wider than 0.4 m around its mean.
    assert np.abs(middle - positions.mean(axis=1)[:, :2]).max() < 0.4


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
