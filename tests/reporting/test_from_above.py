from __future__ import annotations

import numpy as np
import pytest

from pipelines.reporting import from_above
from pipelines.reporting.motion import middles, motion_from_skeleton
from pipelines.reporting.plates import MOST_POINTS

from .conftest import RATE_HZ, make_skeleton, true_positions


def test_a_path_is_thinned_and_broken_at_gaps() -> None:
    t_ns = np.delete(np.arange(3000), slice(1000, 1500)) * 20_000_000
    path = np.column_stack([t_ns / 1e9, np.zeros(len(t_ns))])
    drawn, every = from_above._drawn_path(t_ns, path, [int(t_ns[999])])
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
    (middle,) = np.moveaxis(middles(motion_from_skeleton(table).measured_position)[..., :2], 1, 0)
    # The median of a body stays within the body: no wider than 0.4 m around its mean.
    assert np.abs(middle - positions.mean(axis=1)[:, :2]).max() < 0.4
