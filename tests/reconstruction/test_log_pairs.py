"""Logs of two cameras, compared by themselves: the same path twice, and two that start at one place."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pipelines.reconstruction.doubts.logs import doubts_of_logs
from pipelines.session.records import Trajectory


def logged(start_ns: int, east_mps: float) -> tuple[Any, Trajectory]:
    """Return the entry and the log of a camera that flies east for 6 s, at 10 poses a second."""
    t_ns = start_ns + 100_000_000 * np.arange(61, dtype=np.int64)
    position = np.zeros((61, 3))
    position[:, 0] = east_mps * (t_ns - start_ns) / 1e9
    attitude = np.tile([0.0, 0.0, 0.0, 1.0], (61, 1))
    poses = SimpleNamespace(static=False, source=f"{east_mps}.tum", topic=None)
    return cast("Any", SimpleNamespace(poses=poses)), Trajectory(t_ns, position, attitude)


# Stamps of today have 19 digits, which no float holds.
@pytest.mark.parametrize("start_ns", [0, 1_764_403_200_000_000_129, 1_764_403_200_000_000_127])
def test_pairs_of_logs_are_compared_over_all_the_time_they_share(start_ns: int) -> None:
    """Logs of any stamps that are alike are found, and those that start at one place."""
    same = doubts_of_logs({"a": logged(start_ns, 2.0), "b": logged(start_ns, 2.0)})
    assert [doubt.code for doubt in same] == ["pose"]
    own = doubts_of_logs({"a": logged(start_ns, 2.0), "b": logged(start_ns, -2.0)})
    assert [doubt.code for doubt in own] == ["origin"]
    assert own[0].evidence["apart_m"] == pytest.approx(12.0, abs=0.5)
