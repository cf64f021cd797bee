"""Logs of a flight: clocks that step, and camera infos that change."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from pipelines.formats.logs.positions import read_pair
from pipelines.geometry.arrays import Intrinsics
from pipelines.session.errors import DataError
from pipelines.session.manifest import LogSource, Manifest
from pipelines.session.recognition import recognise
from pipelines.session.records import Trajectory
from pipelines.session.registries import LogFormat
from pipelines.sources.logs import FlightLogs
from tests.synthetic.logs import Container, Entry, write_log, write_split_ros2

EPOCH_NS, INTERVAL_NS, DELAY_NS, STEP_AT = 1_700_000_000_000_000_000, 50_000_000, 4_000_000, 60
TIMES_NS = EPOCH_NS + INTERVAL_NS * np.arange(120)
TYPES = {
    "/pose": "geometry_msgs/msg/PoseStamped",
    "/pictures": "sensor_msgs/msg/CompressedImage",
    "/point": "geometry_msgs/msg/PointStamped",
    "/turned": "geometry_msgs/msg/QuaternionStamped",
}


def entries(
    step_ns: int, *, together: bool = False, speed_m: float = 0.1, scatter_ns: float = 0.0
) -> list[Entry]:
    """Make messages of which the header steps, or header and receipt together, behind delays that scatter."""
    logged = []
    scattered_ns = np.random.default_rng(1).exponential(scatter_ns, len(TIMES_NS)).clip(max=INTERVAL_NS - 1)
    delay_ns = DELAY_NS + scattered_ns.astype(np.int64)
    for k, t_ns in enumerate(TIMES_NS.tolist()):
        header = {"stamp": t_ns + (step_ns if k >= STEP_AT else 0), "frame_id": "map"}
        received_ns = t_ns + int(delay_ns[k]) + (step_ns if together and k >= STEP_AT else 0)
        place, turned = {"x": speed_m * k, "y": 0.0, "z": 5.0}, {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
        contents: dict[str, dict[str, Any]] = {
            "/pose": {"pose": {"position": place, "orientation": turned}},
            "/pictures": {"format": "jpeg", "data": np.array([0xFF, 0xD8, 0xFF], np.uint8)},
            "/point": {"point": place},
            "/turned": {"quaternion": turned},
        }
        logged += [
            Entry(topic, TYPES[topic], received_ns, {"header": header, **fields})
            for topic, fields in contents.items()
        ]
    return logged


@pytest.mark.parametrize("step_ns", [-800_000_000, -100_000_000, 100_000_000, 450_000_000])
def test_what_a_stepping_clock_stamped_is_at_the_right_times(tmp_path: Path, step_ns: int) -> None:
    log = write_log(tmp_path, "log", "mcap-cdr", entries(step_ns))
    camera = {"pose": {"file": "a", "topic": "/pose"}, "intrinsics": "x", "keypoints": "y"}
    notes: list[str] = []
    stated = {"schema": 1, "cameras": {"c": camera}, "logs": {"a": LogSource(file=[log.name])}}
    with FlightLogs(Manifest.model_validate(stated), tmp_path, notes.append) as logs:
        poses = logs.trajectory("a", "/pose", None, None, max_gap_ns=10**9)
        pictures = logs.frames("a", "/pictures")
    np.testing.assert_array_equal(poses.t_ns, TIMES_NS)
    np.testing.assert_allclose(poses.position[:, 0], 0.1 * np.arange(120), atol=1e-12)
    assert poses.dropped == {}
    # Pictures are numbered by their own stamps, so those that a step back repeats stay left out.
    repeated = -step_ns // INTERVAL_NS if step_ns < 0 else 0
    expected = np.delete(TIMES_NS, np.arange(STEP_AT, STEP_AT + repeated))
    np.testing.assert_array_equal(pictures.t_ns, expected)
    told = f"steps by {step_ns / 1e9:+.3f} s at 3.00 s (message 60)"
    assert [told in note for note in notes] == [True, True]
    assert "/pose: " in notes[0]
    assert "/pictures: " in notes[1]

    with recognise(log, LogFormat, "log").open_log([log]) as recording:
        pair = read_pair(recording, "log", "/point", "/turned", "enu", "header")
    np.testing.assert_array_equal(pair.position.t_ns, TIMES_NS)
    assert pair.body is not None
    np.testing.assert_array_equal(pair.body.t_ns, TIMES_NS)
    assert [told in note for note in pair.notes] == [True, True]


def trajectory(log: Path) -> tuple[Trajectory, list[str]]:
    """Read the poses of a log, and what is noted of them."""
    camera = {"pose": {"file": "a", "topic": "/pose"}, "intrinsics": "x", "keypoints": "y"}
    stated = {"schema": 1, "cameras": {"c": camera}, "logs": {"a": LogSource(file=[log.name])}}
    notes: list[str] = []
    with FlightLogs(Manifest.model_validate(stated), log.parent, notes.append) as logs:
        return logs.trajectory("a", "/pose", None, None, max_gap_ns=10**9), notes


@pytest.mark.parametrize("container", ["ros1", "ros2-sqlite3", "mcap-cdr", "split"])
@pytest.mark.parametrize("scatter_ns", [0, 15e6])
@pytest.mark.parametrize("step_s", [-1.5, -0.05, 0.05, 0.3])
def test_a_step_of_all_clocks_of_a_log_is_taken_out(
    tmp_path: Path, step_s: float, scatter_ns: float, container: Container | Literal["split"]
) -> None:
    stepping = entries(round(step_s * 1e9), together=True, scatter_ns=scatter_ns)
    if container == "split":  # where the clock steps
        parts = stepping[: 4 * STEP_AT], stepping[4 * STEP_AT :]
        poses, notes = trajectory(write_split_ros2(tmp_path / "log", parts))
    else:
        poses, notes = trajectory(write_log(tmp_path, "log", container, stepping))
    np.testing.assert_array_equal(poses.t_ns, TIMES_NS)
    np.testing.assert_allclose(poses.position[:, 0], 0.1 * np.arange(120), atol=1e-12)
    assert [f"{step_s:+.3f} s at " in note for note in notes] == [True, True]  # of the recorder, the header


def test_a_step_among_nine_lost_messages_of_each_topic_is_taken_out(tmp_path: Path) -> None:
    some = [each for k, each in enumerate(entries(300_000_000, together=True)) if k % 13]
    poses, _ = trajectory(write_log(tmp_path, "log", "mcap-cdr", some))
    np.testing.assert_array_equal(poses.t_ns, np.delete(TIMES_NS, np.arange(0, 120, 13)))


@pytest.mark.parametrize("step_s", [0.2, 1.0])
def test_a_step_of_all_clocks_that_nothing_shows_is_noted(tmp_path: Path, step_s: float) -> None:
    still = entries(round(step_s * 1e9), together=True, speed_m=0.0)
    poses, notes = trajectory(write_log(tmp_path, "log", "mcap-cdr", still))
    np.testing.assert_array_equal(poses.t_ns, TIMES_NS + (np.arange(120) >= STEP_AT) * round(step_s * 1e9))
    assert [f"{step_s:+.3f} s at " in note for note in notes] == [True]


@pytest.mark.parametrize("lost", [2, 10])
def test_lost_messages_are_no_step(tmp_path: Path, lost: int) -> None:
    every = entries(0)
    some = every[: 4 * STEP_AT] + every[4 * (STEP_AT + lost) :]
    poses, notes = trajectory(write_log(tmp_path, "log", "mcap-cdr", some))
    np.testing.assert_array_equal(poses.t_ns, np.delete(TIMES_NS, np.arange(STEP_AT, STEP_AT + lost)))
    assert notes == []


def test_messages_of_another_topic_in_the_gap_show_that_time_passed(tmp_path: Path) -> None:
    still = entries(300_000_000, together=True, speed_m=0.0)
    t_ns = int(TIMES_NS[STEP_AT])
    stamp = {"stamp": t_ns + 150_000_000, "frame_id": ""}
    still.insert(
        4 * STEP_AT, Entry("/fix", "sensor_msgs/msg/NavSatFix", t_ns + 150_000_000, {"header": stamp})
    )
    assert trajectory(write_log(tmp_path, "log", "mcap-cdr", still))[1] == []


@pytest.mark.parametrize(("height_m", "axes"), [(-5.0, "ned"), (5.0, None)])
def test_heights_tell_axes_of_airsims_odometry(tmp_path: Path, height_m: float, axes: str | None) -> None:
    pose = {"pose": {"position": {"z": height_m}, "orientation": {"w": 1.0}}}
    sent = [Entry("/sim/d1/odom_local_ned", TYPES["/pose"], t_ns, pose) for t_ns in TIMES_NS[:9].tolist()]
    log = write_log(tmp_path, "log", "ros1", sent)
    camera = {"pose": {"file": log.name}, "intrinsics": "x", "keypoints": "y"}
    flight = Manifest.model_validate({"schema": 1, "cameras": {"c": camera}})
    with FlightLogs(flight, tmp_path, lambda _: None) as logs:
        assert logs.axes(log.name, None, None) == axes


def read(folder: Path, focal_px: list[float], binning: int = 0) -> tuple[Intrinsics, list[str]]:
    """Write a log of 640 x 480 px with these focal lengths, one a message; 0 is not calibrated."""
    entries = []
    for k, f in enumerate(focal_px):
        matrix = [f, 0.0, 319.5, 0.0, f, 239.5, 0.0, 0.0, 1.0] if f else [0.0] * 9
        fields = {
            "header": {"stamp": k + 1, "frame_id": "c"},
            "width": 640 * max(binning, 1),
            "height": 480 * max(binning, 1),
            "distortion_model": "none",
            "K": matrix,
            "binning_x": binning,
            "binning_y": binning,
        }
        entries.append(Entry("/camera_info", "sensor_msgs/msg/CameraInfo", k + 1, fields))
    log = write_log(folder, "log", "ros1", entries)
    stated = {"schema": 1, "cameras": {"c": {"pose": "x", "intrinsics": log.name, "keypoints": "y"}}}
    notes: list[str] = []
    with FlightLogs(Manifest.model_validate(stated), folder, notes.append) as logs:
        return logs.intrinsics(log.name, "/camera_info"), notes


@pytest.mark.parametrize("zeros", [0, 1, 5])
def test_messages_before_the_calibration_are_left_out(tmp_path: Path, zeros: int) -> None:
    lens, notes = read(tmp_path, [0.0] * zeros + [500.0] * 3)
    assert lens == Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)
    assert notes == []


@pytest.mark.parametrize("focal_px", [[0.0, 0.0], [500.0, 0.0, 510.0]])
def test_no_calibration_and_two_are_refused(tmp_path: Path, focal_px: list[float]) -> None:
    with pytest.raises(DataError) as caught:
        read(tmp_path, focal_px)
    assert caught.value.code == "no-intrinsics"


@pytest.mark.parametrize("binning", [2, 4])
def test_a_binned_calibration_is_noted(tmp_path: Path, binning: int) -> None:
    lens, notes = read(tmp_path, [500.0] * 2, binning)
    assert lens == Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)
    assert ["640 x 480" in note for note in notes] == [True]
