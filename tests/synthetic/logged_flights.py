"""Flight of two drones as their recorders store it: odometry, camera info and pictures in a log."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.mounting import body_from_camera
from pipelines.geometry.poses import compose, invert
from tests.synthetic.flights import LENS, START_NS, SyntheticFlight, write_flight
from tests.synthetic.logs import Container, Entry, write_log

LEVER_ARM = (0.10, 0.0, -0.05)
LATE_NS = 4_000_000  # a message is received this long after its header stamp


def write_logged_flight(
    folder: Path,
    container: Container,
    *,
    cameras: int = 2,
    seconds: float = 0.5,
    jump_s: float = 0.0,
    picture_size: tuple[int, int] = (LENS.width, LENS.height),
) -> SyntheticFlight:
    """Write a clean flight whose poses, intrinsics and frame times are in one log for each drone.

    The odometry is that of a body with its camera 30 degrees down on a lever arm; drone1's clock
    jumps by `jump_s` after three quarters of the flight. Pictures are plain, of the lens's size by default.
    """
    flight = write_flight(folder, cameras=cameras, seconds=seconds, clean=True, keypoint_format="alphapose")
    for k, name in enumerate(flight.cameras):
        entries = sorted(
            [
                *_odometry(flight, k, name, jump_s if k == 0 else 0.0),
                *_camera_info(flight, name),
                *_pictures(flight, name, picture_size),
            ],
            key=lambda entry: (entry.stamp_ns, entry.topic),
        )
        log = write_log(folder / "logs", name, container, entries)
        camera = flight.settings["cameras"][name]
        where = {"file": str(log.relative_to(folder))}
        del camera["frame_times"]
        camera["video"] = {**where, "topic": f"/{name}/image/compressed"}
        camera["pose"] = {**where, "topic": f"/{name}/odometry", "of": "body"}
        camera["mount"] = {"looks": "forward", "down_deg": 30, "translation": list(LEVER_ARM)}
        camera["intrinsics"] = where
    flight.save()
    return flight


def header(stamp_ns: int, frame: str) -> dict[str, Any]:
    """Build the header of a stamped message."""
    return {"stamp": stamp_ns, "frame_id": frame}


def pose_fields(position: Sequence[float], quaternion: Sequence[float] = (0, 0, 0, 1)) -> dict[str, Any]:
    """Build a geometry_msgs/Pose of a position and a quaternion, x y z w."""
    return {"position": dict(zip("xyz", position, strict=True)), "orientation": turned(quaternion)}


def turned(quaternion: Sequence[float]) -> dict[str, float]:
    """Build a geometry_msgs/Quaternion."""
    return dict(zip("xyzw", map(float, quaternion), strict=True))


def pose_entry(
    topic: str, stamp_ns: int, position: Sequence[float], quaternion: Sequence[float] = (0, 0, 0, 1)
) -> Entry:
    """Build a pose in the frame `map`."""
    fields = {"header": header(int(stamp_ns), "map"), "pose": pose_fields(position, quaternion)}
    return Entry(topic, "geometry_msgs/msg/PoseStamped", int(stamp_ns), fields)


def attitude_entry(topic: str, stamp_ns: int, quaternion: Sequence[float]) -> Entry:
    """Build an attitude without a frame."""
    fields = {"header": header(int(stamp_ns), ""), "quaternion": turned(quaternion)}
    return Entry(topic, "geometry_msgs/msg/QuaternionStamped", int(stamp_ns), fields)


def fix_entry(topic: str, stamp_ns: int, place: Sequence[float], status: int = 0) -> Entry:
    """Build a fix of a receiver at latitude, longitude and altitude."""
    fields = dict(zip(("latitude", "longitude", "altitude"), place, strict=True))
    about = {"header": header(int(stamp_ns), "gps"), "status": {"status": status}}
    return Entry(topic, "sensor_msgs/msg/NavSatFix", int(stamp_ns), about | fields)


def _odometry(flight: SyntheticFlight, k: int, name: str, jump_s: float) -> list[Entry]:
    camera_from_body = invert(np.array(LEVER_ARM), body_from_camera("forward", 30.0))
    position, quaternion = compose((flight.camera_position[k], flight.camera_quaternion[k]), camera_from_body)
    entries = []
    jump_at = 3 * len(flight.t_ns) // 4
    for row, (stamp_ns, at, rotation) in enumerate(zip(flight.t_ns, position, quaternion, strict=True)):
        stated_ns = int(stamp_ns) + (round(jump_s * 1e9) if row >= jump_at else 0)
        fields = {
            "header": header(stated_ns, "map"),
            "child_frame_id": f"{name}/base_link",
            "pose": {"pose": pose_fields(at, rotation), "covariance": _covariance()},
        }
        received = int(stamp_ns) + LATE_NS
        entries.append(Entry(f"/{name}/odometry", "nav_msgs/msg/Odometry", received, fields))
    return entries


def _covariance() -> NDArray[np.float64]:
    return np.diag([0.04, 0.04, 0.09, 1e-4, 1e-4, 1e-4]).ravel()


def _camera_info(flight: SyntheticFlight, name: str) -> list[Entry]:
    fields = {
        "header": header(START_NS, name),
        "width": LENS.width,
        "height": LENS.height,
        "distortion_model": "plumb_bob",
        "d": np.array([*LENS.distortion, 0.0]),
        "k": np.array([LENS.fx, 0, LENS.cx, 0, LENS.fy, LENS.cy, 0, 0, 1.0]),
    }
    return [
        Entry(f"/{name}/camera_info", "sensor_msgs/msg/CameraInfo", int(stamp_ns) + LATE_NS, fields)
        for stamp_ns in flight.t_ns[:3]
    ]


def _pictures(flight: SyntheticFlight, name: str, size: tuple[int, int]) -> list[Entry]:
    _, png = cv2.imencode(".png", np.full(size[::-1], 90, np.uint8))
    return [
        Entry(
            f"/{name}/image/compressed",
            "sensor_msgs/msg/CompressedImage",
            int(stamp_ns) + LATE_NS,
            {"header": header(int(stamp_ns), name), "format": "png", "data": png.ravel()},
        )
        for stamp_ns in flight.t_ns
    ]
