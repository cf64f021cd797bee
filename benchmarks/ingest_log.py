"""Speed and memory of reading and ingesting logs: the figures of docs/benchmarks-logs.md.

python -m benchmarks.ingest_log [--log recorder|pictures] [--megabytes 500] [--picture-kb 60] [--cold]
    [--container ros1|ros2-sqlite3|ros2-mcap]

A recorder's log of one drone has odometry at 100 Hz, an IMU at 200 Hz, a transform at 100 Hz and pictures at
30 Hz; the other log has odometry and pictures alone. Three things are timed, each in a process of its own,
in turns, and the best of three counts:

- raw: opening the log with the library named and iterating over the bytes of every message;
- reading: opening it with `Log` and decoding every message of odometry and pictures;
- ingest: the whole call of `pipelines.ingest.ingest` with force, from flight.yaml to the published session:
  hashing the log, poses and frame times from it, the tables written and synced.

Each process first does the same with a log of 1 MB. So imports, and the code that rosbags generates from
definitions, are left out; the time of that first ingest is given separately. Logs are in the page cache. With
`--cold` they come from the disk: the system is asked to drop them before each run. The last line tells if
every ratio of an ingest and its memory meet the goals.

"thread" are processor seconds of the thread that reads: hashing has its own threads. On a machine with a free
core their ratio equals that of wall times; on a busy machine it is more reliable.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer

from pipelines.formats.logs.ros2_writing import build
from pipelines.ingest import ingest
from pipelines.session.registries import LogFormat, recognise
from tests.synthetic.logs import ROS1, ROS2

POSE, PICTURE = "/drone1/odometry", "/drone1/camera/image/compressed"
TICKS_HZ = 600
LEAST_RATIO, MOST_MB = 0.7, 400
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
    video: {{{{log: {{log}}, topic: {PICTURE}}}}}
    clock: {{{{sigma_s: 0}}}}
    pose: {{{{log: {{log}}, topic: {POSE}, of: body}}}}
    mount: {{{{looks: forward}}}}
    intrinsics: {{{{width: 1920, height: 1080, fx: 1000, fy: 1000, cx: 960, cy: 540}}}}
"""

Reading = Callable[[Path], int]


def main() -> None:
    """Write the logs, time them raw, read and ingested, print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--log", choices=LOGS, default="recorder")
    parser.add_argument("--megabytes", type=int, default=500)
    parser.add_argument("--picture-kb", type=int, default=60)
    parser.add_argument("--container", choices=CONTAINERS, action="append", help="by default all")
    parser.add_argument("--cold", action="store_true", help="logs come from the disk")
    options = parser.parse_args()
    ratios: list[float] = []
    peaks_mb: list[float] = []
    print(
        "| container | raw with | raw s (thread) | reading s | ratio | ingest s (thread) | ratio (thread) |"
        " first | MB |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for container in options.container or CONTAINERS:
        with tempfile.TemporaryDirectory() as folder:
            arguments = (container, LOGS[options.log], options.picture_kb * 1000)
            small = in_a_process(write, Path(folder) / "small", *arguments, 1)
            large = in_a_process(write, Path(folder) / "large", *arguments, options.megabytes)
            libraries = {"rosbags": with_rosbags}
            if container == "ros2-mcap":
                libraries["mcap"] = with_mcap
            readings = {**libraries, "reading": decoded, "ingest": ingested}
            best = best_of_three(readings, small, large, options.cold)
        reading, whole = best["reading"], best["ingest"]
        peaks_mb.append(whole["peak_mb"])
        for library in libraries:
            raw, raw_s = best[library], best[library]["seconds"]
            ratios.append(raw_s / whole["seconds"])
            print(
                f"| {container} | {library} | {raw_s:.2f} ({raw['cpu_s']:.2f}) | {reading['seconds']:.2f} |"
                f" {raw_s / reading['seconds']:.2f} | {whole['seconds']:.2f} ({whole['cpu_s']:.2f}) |"
                f" {raw_s / whole['seconds']:.2f} ({raw['cpu_s'] / whole['cpu_s']:.2f}) |"
                f" {whole['first_s']:.2f} | {whole['peak_mb']:.0f} |",
                flush=True,
            )
    passed = min(ratios) >= LEAST_RATIO and max(peaks_mb) < MOST_MB
    print(
        f"\n{'PASS' if passed else 'FAIL'}: the smallest ratio of an ingest is {min(ratios):.2f} (aim"
        f" {LEAST_RATIO}), the highest peak {max(peaks_mb):.0f} MB (below {MOST_MB})"
    )


def best_of_three(
    readings: Mapping[str, Reading], small: Path, large: Path, cold: bool
) -> dict[str, dict[str, float]]:
    """Run each reading three times in turns and return the figures of its fastest run."""
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in readings}
    for _ in range(3):
        for name, reading in readings.items():
            runs[name].append(in_a_process(timed, reading, small, large, cold))
    return {name: min(found, key=lambda figures: figures["seconds"]) for name, found in runs.items()}


def in_a_process(function: Callable[..., Any], *arguments: object) -> Any:
    """Call a function in a fresh process with its own peak memory."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


def timed(reading: Reading, small: Path, large: Path, cold: bool = False) -> dict[str, float]:
    """Measure wall and thread seconds for a log, seconds for a small one before it, and peak memory."""
    start = time.perf_counter()
    reading(small)
    first_s = time.perf_counter() - start
    if cold:
        evict(large)
    start, cpu_start = time.perf_counter(), time.thread_time()
    count = reading(large)
    seconds, cpu_s = time.perf_counter() - start, time.thread_time() - cpu_start
    assert count > 0
    return {"seconds": seconds, "cpu_s": cpu_s, "first_s": first_s, "peak_mb": peak_mb()}


def evict(log: Path) -> None:
    """Ask the system to drop a log from the page cache, so that it comes from the disk."""
    for path in log.rglob("*") if log.is_dir() else [log]:
        if path.is_file():
            with path.open("rb") as file:
                os.fsync(file.fileno())  # only pages that are on the disk can be dropped
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def peak_mb() -> float:
    """Return the peak memory (MB) of this program; `getrusage` would include its parent's."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    (peak,) = (line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(peak) / 1024


def with_rosbags(log: Path) -> int:
    """Read the bytes of every message with rosbags; return the count of messages with content."""
    with AnyReader([log]) as reader:
        return sum(len(data) > 0 for _, _, data in reader.messages())


def with_mcap(log: Path) -> int:
    """Read the bytes of every message with mcap; return the count of messages with content."""
    with next(log.glob("*.mcap")).open("rb") as file:
        return sum(len(message.data) > 0 for _, _, message in make_reader(file).iter_messages())


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


if __name__ == "__main__":
    main()
