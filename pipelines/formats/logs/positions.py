"""Positions and attitudes in separate topics of a log, and axes that known programs give their poses."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from os.path import commonpath
from typing import Any

import numpy as np

from pipelines.formats.drone_logs.telemetry_rows import attitude_track, position_track
from pipelines.formats.logs.messages import FAULTS, LoggedRows, Samples, Stamps, nanoseconds, unreadable
from pipelines.geometry.mounting import attitude_in_enu
from pipelines.session.errors import DataError
from pipelines.session.manifest import Axes
from pipelines.session.records import PositionTrack, Telemetry, Topic
from pipelines.session.registries import Log

FIXES = (
    *("sensor_msgs/msg/NavSatFix", "gps_common/msg/GPSFix", "gps_msgs/msg/GPSFix"),
    *("foxglove.LocationFix", "foxglove_msgs/msg/LocationFix"),
)
"""Types of positions on Earth."""

# NavSatFix and GPSFix say by this status that there is no fix.
_NO_FIX = -1
_AIRSIM = re.compile(r"(^|/)airsim_node/[^/]+/odom_local_ned$")
_TURNED = ("sensor_msgs/msg/Imu", "geometry_msgs/msg/QuaternionStamped")


def axes_of_topic(topic: str | None, parent: str | None) -> Axes | None:
    """Return the axes that a known program gives its poses, by the name of the topic or of their frame.

    AirSim's node: /airsim_node/VEHICLE/odom_local_ned and frames below world_ned are NED and FRD.
    """
    return "ned" if _AIRSIM.search(topic or "") or (parent or "").strip("/") == "world_ned" else None


def pairs_of(topics: Sequence[Topic]) -> list[tuple[str, str]]:
    """Find topics of positions on Earth, each with attitudes (not raw ones) that share most of its name."""
    turned = sorted(t.name for t in topics if t.count and t.type in _TURNED and "raw" not in t.name)
    return [
        (t.name, max(turned, key=lambda name: len(commonpath([f"/{name}", f"/{t.name}"]))))
        for t in topics
        if t.count and t.type in FIXES and turned
    ]


def read_pair(
    recording: Log, source: str, position: str, attitude: str | None, axes: Axes, stamps: Stamps
) -> Telemetry:
    """Read topics of positions (`FIXES`, PointStamped) and attitudes (Imu, QuaternionStamped) as a pair."""
    counts = {topic.name: topic.count for topic in recording.topics}
    for name in filter(None, (position, attitude)):
        if not counts.get(name):
            raise DataError(source, f"has no topic {name}, or nothing in it", "name another")
    dropped: dict[str, int] = {}
    notes: list[str] = []
    track = read_positions(recording, source, position, stamps, dropped, notes)
    if axes == "ned" and not track.on_earth:
        track = replace(track, values=track.values[:, [1, 0, 2]] * [1, 1, -1])
    if attitude is None:
        return Telemetry(track, None, None, f"{stamps} stamps", notes=tuple(notes), dropped=dropped)
    rows = _read(recording, source, attitude, _quaternion_of)
    notes += rows.notes(f"{source} {attitude}", stamps)
    turned = rows.values
    if axes == "ned":
        turned = attitude_in_enu(turned, relative_to="world", axes="ned")
    body = attitude_track(attitude, rows.times(stamps), turned, dropped)
    return Telemetry(track, body, None, f"{stamps} stamps", notes=tuple(notes), dropped=dropped)


def read_positions(
    recording: Log,
    source: str,
    topic: str,
    stamps: Stamps,
    dropped: dict[str, int],
    notes: list[str] | None = None,
) -> PositionTrack:
    """Read a topic of positions alone; unusable rows are counted in `dropped`, steps told in `notes`."""
    is_fix = next(known.type for known in recording.topics if known.name == topic) in FIXES
    rows = _read(recording, source, topic, _fix_of if is_fix else _point_of)
    if notes is not None:
        notes += rows.notes(f"{source} {topic}", stamps)
    values = rows.values
    unusable = {"no fix": values[:, 3] <= _NO_FIX} if is_fix else {}
    track = position_track(
        source,
        topic,
        rows.times(stamps),
        values[:, :3],
        dropped,
        on_earth=is_fix,
        height="ellipsoid" if is_fix else "unknown",
        unusable=unusable,
    )
    variance = values[(values[:, 4:] > 0).all(axis=1), 4:] if is_fix else values[:0]
    if not len(variance):
        return track
    sigma = np.sqrt(np.median(variance, axis=0))
    return replace(track, accuracy_m=(float(sigma[0]), float(sigma[1])))


def _read(recording: Log, source: str, topic: str, numbers: Callable[[Any], Sequence[float]]) -> LoggedRows:
    gathered, row = Samples(), list[float]()
    for message in recording.messages([topic]):
        value = message.value
        try:
            header = getattr(value, "header", None)
            stamp = getattr(value, "timestamp", None) if header is None else header.stamp
            row = [float(number) for number in numbers(value)]
            gathered.add(0 if stamp is None else nanoseconds(stamp), message.receive_ns, row)
        except FAULTS as error:
            raise unreadable(message, source, error) from error
    if not row:
        raise DataError(source, f"topic {topic} holds no message", "name another")
    return gathered.rows(len(row))


def _point_of(value: Any) -> Sequence[float]:
    """Return the position of a PointStamped, PoseStamped or Odometry."""
    if hasattr(value, "point"):
        point = value.point
    else:
        pose = value.pose
        point = (pose.pose if hasattr(pose, "pose") else pose).position
    return point.x, point.y, point.z


def _fix_of(value: Any) -> Sequence[float]:
    """Return latitude, longitude, altitude, status, and horizontal and vertical variance (0 if unknown)."""
    status = value.status.status if hasattr(value, "status") else 0
    stated = np.asarray(getattr(value, "position_covariance", ()), dtype=np.float64)
    covariance = stated.reshape(3, 3) if stated.size else np.zeros((3, 3))
    known = bool(getattr(value, "position_covariance_type", 0))
    across = (covariance[0, 0] + covariance[1, 1]) / 2
    variances = (float(across), float(covariance[2, 2])) if known else (0.0, 0.0)
    return value.latitude, value.longitude, value.altitude, status, *variances


def _quaternion_of(value: Any) -> Sequence[float]:
    """Return the rotation of a Quaternion, QuaternionStamped, Imu, PoseStamped or Odometry."""
    turned = value
    for part in ("quaternion", "orientation"):
        turned = getattr(turned, part, turned)
    if hasattr(value, "pose"):
        pose = value.pose
        turned = (pose.pose if hasattr(pose, "pose") else pose).orientation
    return turned.x, turned.y, turned.z, turned.w
