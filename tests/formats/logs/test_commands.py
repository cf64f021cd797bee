"""Setpoints and plans as the on-board planner published them: the valid point at each time."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.formats.logs.trajectories import PATH, read_commands
from pipelines.session.errors import DataError
from pipelines.session.recognition import recognise
from pipelines.session.records import Trajectory
from pipelines.session.registries import LogFormat
from tests.raising import refused
from tests.synthetic.logs import CONTAINERS, Container, Entry, write_log

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
LATE = SECOND // 20  # from stamp to receipt


def plan(k: int, shift_m: float) -> list[tuple[int, float]]:
    """Make two seconds of flight along x from second k, 1 m/s, steps of 0.25 s; shift the later one."""
    return [
        (START + k * SECOND + j * SECOND // 4, k + j / 4 + (shift_m if j >= 4 else 0.0)) for j in range(9)
    ]


def path_entry(points: list[tuple[int, float]]) -> Entry:
    poses = [
        {
            "header": {"stamp": t_ns, "frame_id": "world"},
            "pose": {"position": {"x": x, "y": 2.0, "z": 3.0}, "orientation": {"w": 1.0}},
        }
        for t_ns, x in points
    ]
    stamp = points[0][0]
    return Entry("/sent", PATH, stamp + LATE, {"header": {"stamp": stamp}, "poses": poses})


def read(path: Path, stamps: Any = "header") -> Trajectory:
    with recognise(path, LogFormat, "log").open_log([path]) as log:
        return read_commands(log, str(path), "/sent", stamps)


@pytest.mark.parametrize("container", ["ros1", "ros2-mcap"])
def test_a_plan_holds_until_the_next_one_begins(tmp_path: Path, container: Container) -> None:
    """Give plans wrong points, 7 m aside, after the start of the next plan: they were never flown."""
    assert container in CONTAINERS
    entries = [path_entry(plan(k, 7.0 if k < 3 else 0.0)) for k in range(4)]
    found = read(write_log(tmp_path, "d1", container, entries))
    steps = np.arange(3 * 4 + 9)
    np.testing.assert_array_equal(found.t_ns, START + steps * SECOND // 4)
    np.testing.assert_allclose(found.position[:, 0], steps / 4, atol=1e-12)
    np.testing.assert_allclose(found.position[:, 1:], [[2.0, 3.0]] * len(steps), atol=1e-12)
    assert found.dropped == {}


def test_what_is_no_plan_is_refused(tmp_path: Path) -> None:
    route = path_entry([(START, 0.0), (START, 1.0)])  # route planners give all points one stamp
    path = write_log(tmp_path, "route", "ros2-mcap", [route])
    with refused("data", path, "/sent", "plan", "times"):
        read(path)
    nothing = Entry("/sent", PATH, START, {"header": {"stamp": START}})
    with pytest.raises(DataError):
        read(write_log(tmp_path, "nothing", "ros2-mcap", [nothing]))
