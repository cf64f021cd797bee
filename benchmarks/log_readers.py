"""Readers of logs beside rosbags and mcap: what they save of damaged files, and what a second decoder gains.

python -m benchmarks.log_readers          # the tables of docs/decisions/0009-log-readers.md

Logs are generated (a recorder's, as in `benchmarks.ingest_log`) and real (MOCAP_REAL_DATA). Each is read
whole; cut off at 60 % of its bytes; with 4 kB of zeros in its middle; and, a folder, without metadata.yaml.
Of a folder the largest file is damaged. Counted are the messages whose bytes a reader gives before it ends
or fails.

Then poses and the stamps of pictures are read one by one by the decoder of all messages, and many at a time.
The last line is the time of a picture's pixels, which are decoded wherever single pictures are read.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from benchmarks.ingest_log import CONTAINERS, PICTURE, POSE, RECORDER, write
from pipelines.formats.logs.messages import all_samples
from pipelines.formats.logs.pictures import picture_stamps
from pipelines.formats.logs.trajectories import poses_at_once, poses_one_by_one
from pipelines.session.errors import DataError
from pipelines.session.registries import LogFormat, recognise
from tests.real_data import real_data

T = TypeVar("T")
REAL = (
    "logs/ros1/husky_gps_imu_odom.bag",
    "logs/ros1/foxglove_example-bz2.bag",
    "logs/ros2/rosbag2_wbag_sqlite3",
    "logs/ros2/rosbag2_wbag_mcap",
    "logs/mcap/json_camera_calibration_images.mcap",
)
SHARE, ZEROS = 0.6, 4096
DAMAGES = ("whole", "cut", "zeros", "no metadata")


def main() -> None:
    """Print both tables."""
    with tempfile.TemporaryDirectory() as folder:
        logs = {f"generated {c}": generated(Path(folder) / c, c) for c in CONTAINERS}
        for relative in REAL:
            try:
                logs[f"real {Path(relative).name}"] = real_data(relative)
            except pytest.skip.Exception as absent:
                print(absent)
        print("| log | damage | ours: read | counted as lost | rosbags | mcap |")
        print("| --- | --- | --- | --- | --- | --- |")
        for name, log in logs.items():
            for damage in DAMAGES:
                if damage != "no metadata" or (log / "metadata.yaml").is_file():
                    hurt = damaged(log, Path(folder) / "hurt", damage)
                    cells = (ours(hurt), counted(with_rosbags, hurt), counted(with_mcap, hurt))
                    print(f"| {name} | {damage} | {' | '.join(cells)} |", flush=True)
        print(
            "\n| log | what | one by one, us | many at a time, us | ratio |\n| --- | --- | --- | --- | --- |"
        )
        for container in CONTAINERS:
            log = logs[f"generated {container}"]
            for what, readings in (
                ("poses", (poses_singly, poses_together)),
                ("pictures", (singly, together)),
            ):
                slow, fast = (1e6 * fastest(reading, log) for reading in readings)
                print(f"| {container} | {what} | {slow:.1f} | {fast:.1f} | {slow / fast:.0f} |", flush=True)
        jpeg = picture()
        pixels_us = 1e6 * fastest(pixels, jpeg)
        print(
            f"\nthe pixels of a picture, 1280 x 720 in a JPEG of {len(jpeg) / 1e3:.0f} kB: {pixels_us:.0f} us"
        )


def generated(folder: Path, container: str) -> Path:
    """Write a recorder's log of 60 MB."""
    write(folder, container, RECORDER, 20_000, 60)
    return folder / ("log.bag" if container == "ros1" else container)


def damaged(log: Path, folder: Path, damage: str) -> Path:
    """Return a damaged copy of a log."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    copy = folder / log.name
    if log.is_dir():
        shutil.copytree(log, copy)
    else:
        shutil.copy(log, copy)
    files = [path for path in copy.iterdir() if path.suffix != ".yaml"] if log.is_dir() else [copy]
    largest = max(files, key=lambda path: path.stat().st_size)
    content = bytearray(largest.read_bytes())
    if damage == "cut":
        del content[int(SHARE * len(content)) :]
    elif damage == "zeros":
        middle = len(content) // 2
        content[middle : middle + ZEROS] = bytes(ZEROS)
    elif damage == "no metadata":
        (copy / "metadata.yaml").unlink()
    largest.write_bytes(content)
    return copy


def ours(log: Path) -> str:
    """Count the messages that our reader gives, and those that it counts as lost."""
    try:
        with recognise(log, LogFormat, "log").open_log([log]) as recording:
            count = 0
            for part in recording.parts:  # type: ignore[attr-defined]  # of our own formats
                count += sum(1 for _ in part.read(part.rows_of(part.channels)))
            lost = ", ".join(f"{cause}: {number}" for cause, number in recording.dropped.items())
    except DataError as error:
        return f"refused: {error.problem} | "
    return f"{count} | {lost or '-'}"


def with_rosbags(log: Path) -> Iterable[object]:
    """Yield the messages that rosbags gives."""
    with AnyReader([log]) as reader:
        yield from reader.messages()


def with_mcap(log: Path) -> Iterable[object]:
    """Yield the messages that mcap gives, file by file."""
    for path in sorted(log.glob("*.mcap")) if log.is_dir() else [log]:
        with path.open("rb") as file:
            yield from make_reader(file).iter_messages()


def counted(read: Callable[[Path], Iterable[object]], log: Path) -> str:
    """Count messages up to the end or to the first error."""
    if read is with_mcap and ".mcap" not in {path.suffix for path in [log, *log.glob("*")]}:
        return "-"
    count = 0
    try:
        for _ in read(log):
            count += 1
    except Exception as error:  # whatever a library raises
        return f"{count}, then {type(error).__name__}"
    return str(count)


def fastest(reading: Callable[[T], int], log: T) -> float:
    """Return the processor seconds of a message, in the fastest of seven readings."""
    times = []
    for _ in range(7):
        begin = time.process_time()
        count = reading(log)
        times.append((time.process_time() - begin) / count)
    return min(times)


def poses_singly(log: Path) -> int:
    """Decode every pose."""
    with recognise(log, LogFormat, "log").open_log([log]) as recording:
        return len(poses_one_by_one(all_samples(recording.messages([POSE]), log), log).header_ns)


def poses_together(log: Path) -> int:
    """Read all poses at once."""
    with recognise(log, LogFormat, "log").open_log([log]) as recording:
        rows = poses_at_once(recording, POSE)
    assert rows is not None
    return len(rows.header_ns)


def singly(log: Path) -> int:
    """Decode every picture's message, for its stamps."""
    with recognise(log, LogFormat, "log").open_log([log]) as recording:
        return sum(sample.stamp_ns > 0 for sample in all_samples(recording.messages([PICTURE]), log))


def together(log: Path) -> int:
    """Read the stamps of all pictures at once."""
    with recognise(log, LogFormat, "log").open_log([log]) as recording:
        return len(picture_stamps(recording, PICTURE, log)[0])


def picture() -> bytes:
    """Make a JPEG of smooth noise."""
    noise = np.random.default_rng(0).integers(0, 256, (36, 64, 3), dtype=np.uint8)
    smooth = cv2.resize(noise, (1280, 720), interpolation=cv2.INTER_CUBIC)
    return cv2.imencode(".jpg", smooth, [cv2.IMWRITE_JPEG_QUALITY, 50])[1].tobytes()


def pixels(jpeg: bytes) -> int:
    """Decode a picture ten times."""
    return sum(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR) is not None for _ in range(10))


if __name__ == "__main__":
    main()
