"""Positions and attitudes of separate topics, and plans of the on-board planner."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.formats.logs.positions import axes_of_topic, pairs_of, read_pair, read_positions
from pipelines.formats.logs.trajectories import PATH, read_commands
from pipelines.session.errors import DataError
from pipelines.session.recognition import recognise
from pipelines.session.records import Telemetry, Topic, Trajectory
from pipelines.session.registries import LogFormat
from tests.raising import refused
from tests.real_data import real_data
from tests.synthetic.logs import CONTAINERS, Container, Entry, write_log, write_mcap

START_NS = 1_700_000_000_000_000_000
ROWS = 8


def stamps() -> list[int]:
    return [START_NS + k * 50_000_000 for k in range(ROWS)]


def _pair(path: Path, position: str, attitude: str) -> Telemetry:
    with recognise(path, LogFormat, "log").open_log([path]) as log:
        return read_pair(log, str(path), position, attitude, "enu", "header")


def test_a_real_gps_fix_is_where_the_nav_sat_fix_beside_it_is() -> None:
    path = real_data("second/novatel_bestpos.bag")
    own, other = (_pair(path, topic, "/novatel/oem7/odom").position for topic in ("/gps/gps", "/gps/fix"))
    assert (own.on_earth, own.height, len(own.t_ns)) == (True, "ellipsoid", len(other.t_ns))
    np.testing.assert_array_equal(own.values, other.values)
    assert np.abs(own.t_ns - other.t_ns).max() < 1_000_000  # the driver stamps one after the other


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_fixes_of_foxglove(tmp_path: Path, encoding: Any) -> None:
    entries = []
    for k, t in enumerate(stamps()):
        sec, nsec = divmod(t, 10**9)
        stamp = {"sec": sec, "nsec": nsec} if encoding == "json" else {"seconds": sec, "nanos": nsec}
        place = {"latitude": 47.5 + k, "longitude": 8.5, "altitude": 400.0, "frame_id": "gps"}
        # The receipt is later: the message's own time counts.
        entries.append(Entry("/place", "foxglove.LocationFix", t + 10**8, {"timestamp": stamp, **place}))
    path = write_mcap(tmp_path / "a.mcap", entries, encoding)
    with recognise(path, LogFormat, "log").open_log([path]) as log:
        track = read_positions(log, "a", "/place", "header", {})
    assert (track.on_earth, track.t_ns.tolist()) == (True, stamps())
    np.testing.assert_array_equal(track.values, [[47.5 + k, 8.5, 400.0] for k in range(ROWS)])


def test_attitudes_beside_positions_are_those_that_share_most_of_the_name() -> None:
    names = {
        "/drone1/fix": "sensor_msgs/msg/NavSatFix",
        "/drone2/fix": "sensor_msgs/msg/NavSatFix",
        "/drone1/imu": "sensor_msgs/msg/Imu",
        "/drone2/imu": "sensor_msgs/msg/Imu",
        "/drone2/imu_raw": "sensor_msgs/msg/Imu",
    }
    topics = [Topic(name, type_, "cdr", 9, 0, 9) for name, type_ in names.items()]
    assert pairs_of(topics) == [("/drone1/fix", "/drone1/imu"), ("/drone2/fix", "/drone2/imu")]


@pytest.mark.parametrize(
    ("topic", "parent", "axes"),
    [
        ("/airsim_node/drone_1/odom_local_ned", None, "ned"),
        ("/a/airsim_node/Drone2/odom_local_ned", None, "ned"),
        ("/airsim_node/drone_1/odom_local_enu", None, None),
        ("/drone/odom_local_ned", None, None),
        (None, "world_ned", "ned"),
        (None, "world", None),
    ],
)
def test_axes_by_the_names_of_known_programs(topic: str | None, parent: str | None, axes: str | None) -> None:
    assert axes_of_topic(topic, parent) == axes


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
