"""Files of the simulator, read by our own readers and by those of other projects."""

from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from pipelines.formats.calibrations import calibration_files
from pipelines.formats.calibrations.camera_matrices import write_camera_info
from pipelines.formats.logs import mcap_log
from pipelines.formats.scenes.mcap_writing import Ros2Recording
from pipelines.formats.videos import video
from pipelines.formats.videos.video_writing import TICK_S, join_videos, write_h264
from pipelines.geometry.arrays import Intrinsics
from tests.synthetic.videos import SIZE, bar_code, read_bar_code

HALF_TICK_NS = float(TICK_S) / 2 * 1e9
START_NS = 1_700_000_000_000_000_000


def record(path: Path) -> Path:
    with Ros2Recording(path) as log:
        for k in range(200):
            stamp_ns = START_NS + k * 20_000_000
            pose = {"position": {"x": 0.1 * k, "z": 3.0}, "orientation": {"w": 1.0}}
            header = {"stamp": stamp_ns, "frame_id": "world"}
            fields = {
                "header": header,
                "child_frame_id": "body",
                "pose": {"pose": pose, "covariance": np.eye(6)},
            }
            log.write("/odometry", "nav_msgs/msg/Odometry", stamp_ns + 1_000_000, fields)
            if k % 10 == 0:
                angles = {"header": header, "quaternion": {"x": 1.0}}
                log.write("/gimbal", "geometry_msgs/msg/QuaternionStamped", stamp_ns + 1_000_000, angles)
    return path


def test_a_recording_is_read_by_us_by_the_mcap_library_and_by_rosbags(tmp_path: Path) -> None:
    path = record(tmp_path / "drone.mcap")
    with mcap_log.FORMAT.open_log([path]) as log:
        assert {topic.name: topic.count for topic in log.topics} == {"/odometry": 200, "/gimbal": 20}
        ours = [m.value.pose.pose.position.x for m in log.messages(["/odometry"])]
        assert not log.dropped
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 220
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    with AnyReader([path]) as reader:
        theirs = [
            reader.deserialize(data, connection.msgtype).pose.pose.position.x  # type: ignore[attr-defined]
            for connection, _, data in reader.messages()
            if connection.topic == "/odometry"
        ]
    assert ours == theirs == [0.1 * k for k in range(200)]


@pytest.mark.parametrize("parts", [[40], [1, 20, 19]])
def test_stamps_and_pictures_of_a_video_in_parts(tmp_path: Path, parts: list[int]) -> None:
    rng = np.random.default_rng(3)
    pts_ns = np.cumsum(rng.integers(15_000_000, 70_000_000, 40)).astype(np.int64)
    pts_ns -= pts_ns[0]
    ends = np.cumsum(parts).tolist()
    files = []
    for number, (first, last) in enumerate(zip([0, *ends[:-1]], ends, strict=True)):
        files.append(tmp_path / f"{number}.mp4")
        pictures = (bar_code(k) for k in range(first, last))
        write_h264(files[-1], pictures, pts_ns[first:last], width=SIZE[0], height=SIZE[1])
    whole = tmp_path / "whole.mp4"
    join_videos(whole, files)

    index = video.FORMAT.index(whole)
    assert (index.count, index.start_ns, index.width, index.height) == (40, 0, *SIZE)
    assert np.abs(index.pts_ns - pts_ns).max() <= HALF_TICK_NS + 1  # with a nanosecond of rounding
    with av.open(str(whole)) as container:
        shown = [
            read_bar_code(np.asarray(frame.to_ndarray(format="bgr24"), np.uint8))
            for frame in container.decode(video=0)
        ]
    assert shown == list(range(40))


focal = st.floats(100, 5000)
coefficients = st.sampled_from([4, 5, 8]).flatmap(
    lambda n: st.lists(st.floats(-0.1, 0.1), min_size=n, max_size=n)
)


@given(fx=focal, fy=focal, cx=st.floats(0, 640), cy=st.floats(0, 480), distortion=coefficients)
def test_intrinsics_come_back_exactly(
    tmp_path_factory: pytest.TempPathFactory,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    distortion: list[float],
) -> None:
    path = tmp_path_factory.mktemp("camera") / "camera.yaml"
    write_camera_info(path, "drone1", Intrinsics(640, 480, fx, fy, cx, cy, "radtan", tuple(distortion)))
    (read,) = calibration_files.CAMERA_INFO.read_calibration(path).values()
    assert read.intrinsics is not None
    full = read.intrinsics
    assert (full.width, full.height, full.fx, full.fy, full.cx, full.cy) == (640, 480, fx, fy, cx, cy)
    expected = (*distortion, *[0.0] * (5 - len(distortion))) if any(distortion) else ()
    assert full.distortion == expected
