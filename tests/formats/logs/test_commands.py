"""Setpoints and plans as the on-board planner published them: the valid point at each time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipelines.formats.logs.trajectories import PATH, TARGET, TRAJECTORY, read_commands
from pipelines.session.errors import DataError
from pipelines.session.records import Message, Topic, Trajectory
from pipelines.session.registries import LogFormat, recognise
from tests.formats.refusals import refuses
from tests.synthetic.logs import CONTAINERS, Container, Entry, write_log

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
LATE = SECOND // 20  # from stamp to receipt


@dataclass
class StatedLog:
    """Log of one topic."""

    type: str
    values: Sequence[tuple[int, Any]]
    dropped: dict[str, int] = field(default_factory=dict)

    def messages(self, _: object) -> Iterator[Message]:
        topic = Topic("/sent", self.type, "cdr", len(self.values), None, None)
        for receive_ns, value in self.values:
            yield Message(topic, receive_ns, value)


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


def trajectory_entry(points: list[tuple[int, float]]) -> Entry:
    stamp = points[0][0]
    stated = [
        {
            "transforms": [{"translation": {"x": x, "y": 2.0, "z": 3.0}, "rotation": {"w": 1.0}}],
            "time_from_start": t_ns - stamp,
        }
        for t_ns, x in points
    ]
    fields = {"header": {"stamp": stamp}, "joint_names": ["drone1"], "points": stated}
    return Entry("/sent", TRAJECTORY, stamp + LATE, fields)


def read(path: Path, stamps: Any = "header") -> Trajectory:
    with recognise(path, LogFormat, "log").open_log([path]) as log:
        return read_commands(log, str(path), "/sent", stamps)


@pytest.mark.parametrize("container", ["ros1", "ros2-mcap"])
@pytest.mark.parametrize("entry", [path_entry, trajectory_entry])
def test_a_plan_holds_until_the_next_one_begins(tmp_path: Path, container: Container, entry: Any) -> None:
    """Give plans wrong points, 7 m aside, after the start of the next plan: they were never flown."""
    assert container in CONTAINERS
    entries = [entry(plan(k, 7.0 if k < 3 else 0.0)) for k in range(4)]
    found = read(write_log(tmp_path, "d1", container, entries))
    steps = np.arange(3 * 4 + 9)
    np.testing.assert_array_equal(found.t_ns, START + steps * SECOND // 4)
    np.testing.assert_allclose(found.position[:, 0], steps / 4, atol=1e-12)
    np.testing.assert_allclose(found.position[:, 1:], [[2.0, 3.0]] * len(steps), atol=1e-12)
    assert found.dropped == {}


def target(k: int, mask: int = 0b111111111000, frame: int = 1) -> tuple[int, Any]:
    stamp = SimpleNamespace(sec=START // SECOND + k, nanosec=0)
    value = SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id="map"),
        coordinate_frame=frame,
        type_mask=mask,
        position=SimpleNamespace(x=float(k), y=5.0, z=6.0),
    )
    return START + k * SECOND + LATE, value


def test_position_targets_say_where_to_unless_they_do_not() -> None:
    log = StatedLog(TARGET, [target(0), target(1, mask=0b000111000111), target(2, frame=8), target(3)])
    found = read_commands(log, "d1.bag", "/sent", "header")  # type: ignore[arg-type]
    np.testing.assert_array_equal(found.t_ns, [START, START + 3 * SECOND])
    np.testing.assert_array_equal(found.position, [[0, 5, 6], [3, 5, 6]])
    assert [(cause.split()[-1], count) for cause, count in found.dropped.items()] == [
        ("position", 1),
        ("body", 1),
    ]


def test_what_is_no_plan_is_refused(tmp_path: Path) -> None:
    route = path_entry([(START, 0.0), (START, 1.0)])  # route planners give all points one stamp
    path = write_log(tmp_path, "route", "ros2-mcap", [route])
    with refuses(path, "/sent", "plan", "times"):
        read(path)
    entry = trajectory_entry(plan(0, 0.0))
    point = dict(entry.fields["points"][0], transforms=[{}, {}])
    both = Entry(entry.topic, entry.type, entry.stamp_ns, dict(entry.fields) | {"points": [point]})
    path = write_log(tmp_path, "both", "ros2-mcap", [both])
    with refuses(path, "/sent", TRAJECTORY, "moves 2"):
        read(path)
    nothing = Entry("/sent", PATH, START, {"header": {"stamp": START}})
    with pytest.raises(DataError):
        read(write_log(tmp_path, "nothing", "ros2-mcap", [nothing]))
