from __future__ import annotations

import numpy as np
import pytest

from pipelines.reporting import snapshots
from pipelines.reporting.motion import motion_from_skeleton

from .conftest import FRAMES, JOINTS, make_skeleton, true_positions


def test_snapshots_are_the_fullest_times_of_their_stretches() -> None:
    motion = motion_from_skeleton(make_skeleton())
    chosen = snapshots._fullest_times(motion)
    count = motion.measured[:, 0].sum(axis=1)
    stretches = np.array_split(np.arange(FRAMES), snapshots.SNAPSHOTS)
    assert len(chosen) == snapshots.SNAPSHOTS
    for time, stretch in zip(chosen, stretches, strict=True):
        assert time in stretch
        assert count[time] == count[stretch].max()


def test_the_body_faces_right_whatever_its_heading() -> None:
    for start_s in (0.0, 7.0, 20.0):
        (body,) = true_positions(np.array([start_s]))
        aside, up = snapshots._three_quarter_view(body, JOINTS)
        nose, ear = JOINTS.index("nose"), [JOINTS.index("left_ear"), JOINTS.index("right_ear")]
        # The nose is 0.1 m before the middle of the ears, seen under 35 degrees.
        assert aside[nose] - aside[ear].mean() == pytest.approx(0.1 * np.cos(np.radians(35)), abs=1e-9)
        assert np.array_equal(up, body[:, 2])
        # Seen from its right, half from the front: its left shoulder (0.38 m away) is further right.
        left, right = JOINTS.index("left_shoulder"), JOINTS.index("right_shoulder")
        assert aside[left] - aside[right] == pytest.approx(0.38 * np.sin(np.radians(35)), abs=1e-9)
