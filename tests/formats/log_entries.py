"""Short flight as log entries: odometry, pictures and a topic that is not requested."""

from pathlib import Path

import numpy as np

from pipelines.session.errors import DataError
from pipelines.session.recognition import recognise
from pipelines.session.registries import FORMATS, LogFormat
from tests.synthetic.logs import Entry

START_NS = 1_700_000_000_000_000_000
POSE, PICTURE, OTHER = "/drone1/odometry", "/drone1/camera/image/compressed", "/rosout"


def entries(seconds: float = 1.0, start_ns: int = START_NS) -> list[Entry]:
    """Make odometry at 100 Hz and pictures at 10 Hz, received 3 ms after their header stamps.

    Messages of a topic contain their number: as x of the position, or as the first byte of the picture.
    """
    rng = np.random.default_rng(0)
    rows = []
    for k in range(round(seconds * 100)):
        stamp = start_ns + k * 10_000_000
        header = {"stamp": stamp, "frame_id": "odom"}
        pose = {"pose": {"position": {"x": float(k)}, "orientation": {"w": 1.0}}}
        rows.append(Entry(POSE, "nav_msgs/msg/Odometry", stamp + 3_000_000, {"header": header, "pose": pose}))
        if k % 10 == 0:
            picture = {"header": header, "format": "jpeg", "data": _picture(k // 10, rng)}
            rows.append(Entry(PICTURE, "sensor_msgs/msg/CompressedImage", stamp + 3_000_000, picture))
            rows.append(Entry(OTHER, "std_msgs/msg/String", stamp + 4_000_000, {"data": f"note {k}"}))
    return rows


def _picture(number: int, rng: np.random.Generator) -> bytes:
    """Make bytes that do not compress, as in a JPEG; the number is the first byte."""
    return bytes([number % 256]) + rng.integers(0, 256, 1999, dtype=np.uint8).tobytes()


def log_format(path: Path) -> LogFormat:
    """Find the format of a log, as the program does."""
    return recognise(path, LogFormat, "log")


def positions(path: Path) -> tuple[list[float], dict[str, int]]:
    """Return x of every readable pose, and the losses."""
    with log_format(path).open_log([path]) as log:
        return [m.value.pose.pose.position.x for m in log.messages([POSE])], dict(log.dropped)


def everything(path: Path) -> tuple[list[tuple[str, int]], dict[str, int]]:
    """Return topic and stamp of every readable message, and the losses."""
    with log_format(path).open_log([path]) as log:
        found = [(m.topic.name, m.receive_ns) for m in log.messages([t.name for t in log.topics])]
        return found, dict(log.dropped)


def everything_or_one_line(path: Path) -> tuple[list[tuple[str, int]], dict[str, int]]:
    """Return the same of a log that may be unusable; then no messages and the line count of the error."""
    try:
        log_format(path).describe(path)
        return everything(path)
    except DataError as error:
        return [], {str(error): len(str(error).splitlines())}


def recognised_by(path: Path) -> list[str]:
    """Return the names of the formats that recognise a path."""
    return [f.name for f in FORMATS.all() if f.recognises(path)]
