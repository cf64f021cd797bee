"""How fast logs are read, and in how much memory: the figures of docs/benchmarks-logs.md.

python -m benchmarks.ingest_log [--megabytes 500] [--picture-kb 300]

A log of one drone: odometry at 100 Hz, pictures at 30 Hz; a JPEG of 1920 x 1080 has some 300 kB. "Raw"
iterates over the bytes of every message with the library that others read such logs with; "ours" decodes
every message of both topics through `Log.messages`. Opening, for both, is left out of these times and ours
stated by itself. Each reading has a process of its own, the file is in the page cache, and the best of
three readings counts.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer

from pipelines.formats.ros_messages import build
from pipelines.session.registries import LogFormat, recognise
from tests.synthetic.logs import ROS1, ROS2

POSE, PICTURE = "/drone1/odometry", "/drone1/camera/image/compressed"
TICKS_HZ = 300  # odometry every third tick, a picture every tenth
CONTAINERS = ("ros1", "ros2-sqlite3", "ros2-mcap")


def main() -> None:
    """Write the logs, read each raw and through `Log.messages`, print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--megabytes", type=int, default=500)
    parser.add_argument("--picture-kb", type=int, default=300)
    options = parser.parse_args()
    megabytes = options.megabytes
    print("| container | raw with | raw MB/s | ours MB/s | ratio | opening s | our peak MB |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        for container in CONTAINERS:
            path = in_a_process(write, Path(folder), container, megabytes, options.picture_kb * 1000)
            ours = best(read_decoded, path)
            readers = [("rosbags", read_with_rosbags)]
            if container == "ros2-mcap":
                readers.append(("mcap", read_with_mcap))
            for name, reader in readers:
                raw = best(reader, path)
                assert raw["messages"] == ours["messages"]
                print(
                    f"| {container} | {name} | {megabytes / raw['seconds']:.0f} | "
                    f"{megabytes / ours['seconds']:.0f} | {raw['seconds'] / ours['seconds']:.2f} | "
                    f"{ours['opening_s']:.2f} | {ours['peak_mb']:.0f} |"
                )


def best(reader: Callable[[Path], dict[str, float]], path: Path) -> dict[str, float]:
    """The fastest of three readings."""
    return min((in_a_process(reader, path) for _ in range(3)), key=lambda figures: figures["seconds"])


def in_a_process(function: Callable[..., Any], *arguments: object) -> Any:
    """Call it in a fresh process, whose peak memory is its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


def read_decoded(path: Path) -> dict[str, float]:
    """Every message of both topics, decoded."""
    start = time.perf_counter()
    with recognise(path, LogFormat, "log").open_log([path]) as log:
        for topic in log.topics:  # whose definitions become code at the first message
            next(log.messages([topic.name]))
        opening_s = time.perf_counter() - start
        start = time.perf_counter()
        messages = sum(message.value.header is not None for message in log.messages([POSE, PICTURE]))
        assert not log.dropped
    return figures(start, messages) | {"opening_s": opening_s}


def read_with_rosbags(path: Path) -> dict[str, float]:
    """The bytes of every message."""
    with AnyReader([path]) as reader:
        start = time.perf_counter()
        messages = sum(len(data) > 0 for _, _, data in reader.messages())
    return figures(start, messages)


def read_with_mcap(path: Path) -> dict[str, float]:
    """The bytes of every message."""
    with next(path.glob("*.mcap")).open("rb") as file:
        reader = make_reader(file)
        reader.get_summary()
        start = time.perf_counter()
        messages = sum(len(message.data) > 0 for _, _, message in reader.iter_messages())
    return figures(start, messages)


def figures(start: float, messages: int) -> dict[str, float]:
    """Seconds since `start`, messages, and the peak of this process."""
    return {
        "seconds": time.perf_counter() - start,
        "messages": messages,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def write(folder: Path, container: str, megabytes: int, picture_bytes: int) -> Path:
    """Write the log with rosbags; the pictures do not compress, as JPEGs do not."""
    types = {POSE: "nav_msgs/msg/Odometry", PICTURE: "sensor_msgs/msg/CompressedImage"}
    store = ROS1 if container == "ros1" else ROS2
    serialize = store.serialize_ros1 if container == "ros1" else store.serialize_cdr
    writer: Ros1Writer | Ros2Writer
    if container == "ros1":
        path = folder / "flight.bag"
        writer = Ros1Writer(path)
    else:
        path = folder / container
        plugin = StoragePlugin.SQLITE3 if container == "ros2-sqlite3" else StoragePlugin.MCAP
        writer = Ros2Writer(path, version=9, storage_plugin=plugin)
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, 4 * picture_bytes, dtype=np.uint8)
    with writer:
        connections: dict[str, Any] = {
            topic: writer.add_connection(topic, type_, typestore=store) for topic, type_ in types.items()
        }
        written = tick = 0
        while written < megabytes * 1_000_000:
            stamp = 1_700_000_000_000_000_000 + tick * 1_000_000_000 // TICKS_HZ
            header = {"stamp": stamp, "frame_id": "odom"}
            for topic in due(tick):
                start = int(rng.integers(3 * picture_bytes))
                fields = {"header": header, "format": "jpeg", "data": noise[start : start + picture_bytes]}
                data = serialize(build(store, types[topic], fields), types[topic])
                writer.write(connections[topic], stamp + 2_000_000, data)
                written += len(data)
            tick += 1
    return path


def due(tick: int) -> Sequence[str]:
    """The topics that have a message at this tick."""
    return [topic for topic, every in ((POSE, 3), (PICTURE, 10)) if tick % every == 0]


if __name__ == "__main__":
    main()
