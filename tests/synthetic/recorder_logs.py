"""Logs as a recorder on one drone writes them, of any size, and ways to read them in a process of their own.

Odometry comes at 100 Hz, an IMU at 200 Hz, a transform at 100 Hz and pictures at 30 Hz.
"""

import multiprocessing
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer

from pipelines.formats.scenes.mcap_writing import build
from pipelines.ingest import ingest
from pipelines.session.recognition import recognise
from pipelines.session.registries import LogFormat
from tests.synthetic.logs import ROS1, ROS2

POSE, PICTURE = "/drone1/odometry", "/drone1/camera/image/compressed"
TICKS_HZ = 600
Topics = Mapping[str, tuple[str, int]]
"""Type, and number of ticks between two messages, by topic."""

PICTURES: Topics = {POSE: ("nav_msgs/msg/Odometry", 6), PICTURE: ("sensor_msgs/msg/CompressedImage", 20)}
RECORDER: Topics = {
    **PICTURES,
    "/drone1/imu": ("sensor_msgs/msg/Imu", 3),
    "/drone1/pose": ("geometry_msgs/msg/TransformStamped", 6),
}
LOGS = {"recorder": RECORDER, "pictures": PICTURES}
CONTAINERS = ("ros1", "ros2-sqlite3", "ros2-mcap")
MANIFEST = f"""\
schema: 1
cameras:
  drone1:
    video: {{{{file: {{log}}, topic: {PICTURE}}}}}
    clock: {{{{sigma_s: 0}}}}
    pose: {{{{file: {{log}}, topic: {POSE}, of: body}}}}
    mount: {{{{looks: forward}}}}
    intrinsics: {{{{width: 1920, height: 1080, fx: 1000, fy: 1000, cx: 960, cy: 540}}}}
"""

Reading = Callable[[Path], int]


def in_a_process(function: Callable[..., Any], *arguments: object) -> Any:
    """Call a function in a fresh process with its own peak memory."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


def timed(reading: Reading, small: Path, large: Path) -> dict[str, float]:
    """Measure wall and thread seconds for a log, seconds for a small one before it, and peak memory."""
    start = time.perf_counter()
    reading(small)
    first_s = time.perf_counter() - start
    start, cpu_start = time.perf_counter(), time.thread_time()
    count = reading(large)
    seconds, cpu_s = time.perf_counter() - start, time.thread_time() - cpu_start
    assert count > 0
    return {"seconds": seconds, "cpu_s": cpu_s, "first_s": first_s, "peak_mb": peak_mb()}


def peak_mb() -> float:
    """Return the peak memory (MB) of this program; `getrusage` would include its parent's."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    (peak,) = (line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(peak) / 1024


def decoded(log: Path) -> int:
    """Decode every message of odometry and pictures; return their count."""
    with recognise(log, LogFormat, "log").open_log([log]) as recording:
        count = sum(message.value.header is not None for message in recording.messages([POSE, PICTURE]))
        assert not recording.dropped
    return count


def ingested(log: Path) -> int:
    """Ingest the log as one camera of a session; return its number of frames."""
    manifest = log.parent / "flight.yaml"
    manifest.write_text(MANIFEST.format(log=log.name))
    found = ingest(manifest, force=True)
    return found.description.cameras["drone1"].frames.count


def write(folder: Path, container: str, topics: Topics, picture_bytes: int, megabytes: int) -> Path:
    """Write the log with rosbags; the pictures do not compress: a small JPEG, and noise behind its end."""
    folder.mkdir()
    store = ROS1 if container == "ros1" else ROS2
    serialize = store.serialize_ros1 if container == "ros1" else store.serialize_cdr
    writer: Ros1Writer | Ros2Writer
    if container == "ros1":
        path = folder / "log.bag"
        writer = Ros1Writer(path)
    else:
        path = folder / container
        plugin = StoragePlugin.SQLITE3 if container == "ros2-sqlite3" else StoragePlugin.MCAP
        writer = Ros2Writer(path, version=9, storage_plugin=plugin)
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, 4 * picture_bytes, dtype=np.uint8)
    jpeg = cv2.imencode(".jpg", np.zeros((9, 16, 3), np.uint8))[1].ravel()
    turn = {"w": 1.0}
    with writer:
        connections: dict[str, Any] = {
            topic: writer.add_connection(topic, type_, typestore=store)
            for topic, (type_, _) in topics.items()
        }
        written = tick = 0
        while written < megabytes * 1_000_000:
            stamp_ns = 1_700_000_000_000_000_000 + tick * 1_000_000_000 // TICKS_HZ
            place = {"x": 1.5 * tick / TICKS_HZ, "z": 5.0}
            start = int(rng.integers(3 * picture_bytes))
            picture = noise[start : start + picture_bytes].copy()
            picture[: len(jpeg)] = jpeg
            fields = {
                "header": {"stamp": stamp_ns, "frame_id": "odom"},
                "child_frame_id": "base_link",
                "pose": {"pose": {"position": place, "orientation": turn}, "covariance": np.eye(6).ravel()},
                "transform": {"translation": place, "rotation": turn},
                "orientation": turn,
                "format": "jpeg",
                "data": picture,
            }
            for topic, (type_, every) in topics.items():
                if tick % every == 0:
                    data = serialize(build(store, type_, fields), type_)
                    writer.write(connections[topic], stamp_ns + 2_000_000, data)
                    written += len(data)
            tick += 1
    return path
