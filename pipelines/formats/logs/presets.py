"""Topics of known drivers that hold position, attitude and gimbal, with their units and axes.

From the drivers' sources (docs/formats.md):

`dji_osdk` (dji_sdk, dji_osdk_ros since 3.3): attitude is FLU in ENU; gps_position is NavSatFix;
local_position is metres east, north, up of a reference set in flight; gimbal_angle is degrees in NED,
counted from north whatever its frame_id says, as pitch, roll, yaw (M210, M300: subscription) or, where
frame_id is ground_ENU, as roll, pitch, yaw (M100, M600 and others: broadcast).

`mavros`: local_position and imu/data are ENU and FLU; global_position/global is NavSatFix above the
ellipsoid; mount_control/orientation is a quaternion without a stamp, of FRD angles that count yaw from
the nose.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import takewhile
from typing import Any, Literal, NamedTuple

import numpy as np

from pipelines.formats.drone_logs.telemetry_rows import (
    attitude_track,
    of_angles,
    placed_by,
    position_track,
    turned_as_stated,
    whatever_from,
    world_from_heading,
)
from pipelines.formats.logs.messages import FAULTS, Stamps, nanoseconds, unreadable
from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.clocks import find_steps, without_steps
from pipelines.geometry.mounting import attitude_in_enu
from pipelines.session.errors import DataError
from pipelines.session.manifest import Axes
from pipelines.session.records import AttitudeTrack, Height, Message, PositionTrack, Telemetry, Topic
from pipelines.session.registries import Log, TelemetryChoice

Preset = Literal["dji_osdk", "mavros"]
Position = Literal["local", "global", "gps"]

FIXES = (
    "sensor_msgs/msg/NavSatFix",
    "gps_common/msg/GPSFix",
    "gps_msgs/msg/GPSFix",
    "foxglove.LocationFix",
    "foxglove_msgs/msg/LocationFix",
)
"""Types of positions on Earth."""

_AIRSIM = re.compile(r"(^|/)airsim_node/[^/]+/odom_local_ned$")
# A message that names more topics is not read.
_MOST_NAMED = 8
# NavSatFix and GPSFix say by this status that there is no fix.
_NO_FIX = -1
_TURNED = ("sensor_msgs/msg/Imu", "geometry_msgs/msg/QuaternionStamped")

_POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
)
_POSITIONS = (*FIXES, "geometry_msgs/msg/PointStamped", *_POSES)
_ATTITUDES = (*_TURNED, *_POSES)
_VECTORS = ("geometry_msgs/msg/Vector3Stamped",)


@dataclass(frozen=True)
class _Driver:
    """Topics of a driver below its own name; the first one in the log is taken."""

    names: tuple[str, ...]
    positions: dict[Position, tuple[str, ...]]
    attitude: tuple[str, ...]
    gimbal: tuple[str, ...]
    height: Height


DRIVERS: dict[Preset, _Driver] = {
    "dji_osdk": _Driver(
        names=("dji_sdk", "dji_osdk_ros"),
        positions={"gps": ("gps_position",), "local": ("local_position",), "global": ("rtk_position",)},
        attitude=("attitude",),
        gimbal=("gimbal_angle",),
        height="unknown",
    ),
    "mavros": _Driver(
        names=("mavros",),
        positions={
            "local": ("local_position/pose", "local_position/odom"),
            "global": ("global_position/global",),
            "gps": ("global_position/raw/fix",),
        },
        attitude=("imu/data", "local_position/pose", "local_position/odom"),
        gimbal=("mount_control/orientation",),
        height="ellipsoid",
    ),
}


@dataclass
class _TopicRows:
    """Numbers of one topic, with both of their stamps."""

    header_ns: array[int] = field(default_factory=lambda: array("q"))
    receive_ns: array[int] = field(default_factory=lambda: array("q"))
    numbers: array[float] = field(default_factory=lambda: array("d"))
    frames: set[str] = field(default_factory=set)

    def times(self, stamps: Stamps) -> Int64:
        header, receive = self._stamps()
        if stamps == "receive":
            return receive
        header = without_steps(header, find_steps(header, receive))
        return np.where(header == 0, receive, header)

    def notes(self, source: str, topic: str, stamps: Stamps) -> list[str]:
        """Describe the steps of the header's clock."""
        return [f"{source} {topic}: {step}" for step in find_steps(*self._stamps()) if stamps == "header"]

    def _stamps(self) -> tuple[Int64, Int64]:
        return np.frombuffer(self.header_ns, np.int64), np.frombuffer(self.receive_ns, np.int64)

    def values(self) -> Float:
        return np.frombuffer(self.numbers, dtype=np.float64).reshape(len(self.header_ns), -1)


def axes_of_topic(topic: str | None, parent: str | None) -> Axes | None:
    """Return the axes that a known program gives its poses, by the name of the topic or of their frame.

    AirSim's node for ROS publishes /airsim_node/VEHICLE/odom_local_ned and frames below world_ned: NED and
    FRD (microsoft.github.io/AirSim/airsim_ros_pkgs).
    """
    return "ned" if _AIRSIM.search(topic or "") or (parent or "").strip("/") == "world_ned" else None


def namespaces(names: Sequence[str]) -> list[tuple[Preset, str]]:
    """Find drivers whose positions are among some topics; return each with the prefix of its name.

    `/uav1/mavros/imu/data` is mavros of `/uav1`.
    """
    found = []
    for preset, driver in DRIVERS.items():
        for base in driver.names:
            for name in names:
                before, mark, rest = name.rpartition(f"/{base}/")
                if mark and any(rest in topics for topics in driver.positions.values()):
                    found.append((preset, before))
    return sorted(set(found))


class Parts(NamedTuple):
    """The topics of one drone that a preset reads."""

    position: list[str]
    attitude: list[str]
    gimbal: list[str]


def parts_of(preset: Preset, namespace: str, names: Collection[str]) -> Parts:
    """Return the topics among `names` that a preset reads in a namespace."""
    driver = DRIVERS[preset]
    positions = [part for parts in driver.positions.values() for part in parts]
    return Parts(*(_among(names, namespace, driver, p) for p in (positions, driver.attitude, driver.gimbal)))


def _among(names: Collection[str], prefix: str, driver: _Driver, parts: Iterable[str]) -> list[str]:
    topics = [f"{prefix}/{base}/{part}" for part in parts for base in driver.names]
    return [topic for topic in topics if topic in names]


def pairs_of(topics: Sequence[Topic]) -> list[tuple[str, str]]:
    """Find topics of positions on Earth, each with the topic of attitudes that shares most of its name.

    Topics of a driver that has a preset are left out, and so are raw attitudes.
    """
    of_drivers = [
        f"{prefix}/{base}/"
        for preset, prefix in namespaces([t.name for t in topics])
        for base in DRIVERS[preset].names
    ]
    free = [t for t in topics if t.count and not t.name.startswith(tuple(of_drivers))]
    turned = [t.name for t in free if t.type in _TURNED and "raw" not in t.name]
    return [
        (t.name, max(sorted(turned), key=lambda name: _shared(name, t.name)))
        for t in free
        if t.type in FIXES and turned
    ]


def _shared(one: str, other: str) -> int:
    """Count the leading parts that the names of two topics share."""
    return sum(
        1
        for _ in takewhile(
            lambda parts: parts[0] == parts[1], zip(one.split("/"), other.split("/"), strict=False)
        )
    )


def read_preset(
    recording: Log,
    source: str,
    preset: Preset,
    namespace: str | None,
    choice: TelemetryChoice,
    stamps: Stamps,
) -> Telemetry:
    """Read position, attitude and gimbal of a drone, from the usual topics of its driver.

    A namespace is needed if the log holds several drones.
    """
    driver = DRIVERS[preset]
    prefix = _prefix(source, preset, namespace, [topic.name for topic in recording.topics])
    with_messages = {topic.name for topic in recording.topics if topic.count}

    def first(parts: Sequence[str]) -> str | None:
        return next(iter(_among(with_messages, prefix, driver, parts)), None)

    wanted = [choice.position] if choice.position else list(driver.positions)
    places = {kind: topic for kind in wanted if (topic := first(driver.positions[kind]))}
    if not places:
        others = [kind for kind, parts in driver.positions.items() if first(parts)]
        raise DataError(
            source,
            f"has no {' or '.join(wanted)} position of {prefix}/{driver.names[0]}",
            f"there is {', '.join(others)}" if others else "record its topics",
            code="no-positions",
        )
    kind, place = next(iter(places.items()))
    dropped: dict[str, int] = {}
    notes = [f"{source}: took the {kind} position from {place}"]
    position = read_positions(recording, source, place, stamps, dropped, driver.height, notes)
    fixes = first([part for kind in ("global", "gps") for part in driver.positions[kind]])
    if not position.on_earth and fixes:
        on_earth = read_positions(recording, source, fixes, stamps, {}, driver.height)
        position, placed = placed_by(position, on_earth)
        notes.append(f"{source}: {placed}")

    body: AttitudeTrack | None = None
    if attitude := first(driver.attitude):
        rows = _read(recording, source, attitude, _quaternion_of)
        notes += rows.notes(source, attitude, stamps)
        body = attitude_track(attitude, rows.times(stamps), rows.values(), dropped)
    gimbal: AttitudeTrack | None = None
    if angles := first(driver.gimbal):
        gimbal = _gimbal(recording, source, angles, preset, body, stamps, dropped)
    return Telemetry(
        position=position,
        body=body,
        gimbal=gimbal,
        clock=f"{stamps} stamps",
        notes=tuple(notes),
        dropped=dropped,
    )


def read_pair(
    recording: Log, source: str, position: str, attitude: str, axes: Axes, stamps: Stamps
) -> Telemetry:
    """Read a topic of positions (`FIXES`, PointStamped) and one of attitudes (Imu, QuaternionStamped).

    Axes are those of attitudes, and of positions in metres.
    """
    counts = {topic.name: topic.count for topic in recording.topics}
    for name in (position, attitude):
        if not counts.get(name):
            raise DataError(source, f"has no topic {name}, or nothing in it", "name another")
    dropped: dict[str, int] = {}
    notes: list[str] = []
    track = read_positions(recording, source, position, stamps, dropped, notes=notes)
    rows = _read(recording, source, attitude, _quaternion_of)
    notes += rows.notes(source, attitude, stamps)
    turned = rows.values()
    if axes == "ned":
        turned = attitude_in_enu(turned, relative_to="world", axes="ned")
        if not track.on_earth:
            track = replace(track, values=track.values[:, [1, 0, 2]] * [1, 1, -1])
    return Telemetry(
        position=track,
        body=attitude_track(attitude, rows.times(stamps), turned, dropped),
        gimbal=None,
        clock=f"{stamps} stamps",
        notes=tuple(notes),
        dropped=dropped,
    )


def read_positions(
    recording: Log,
    source: str,
    topic: str,
    stamps: Stamps,
    dropped: dict[str, int],
    height: Height = "ellipsoid",
    notes: list[str] | None = None,
) -> PositionTrack:
    """Read a topic of positions alone; unusable rows are counted in `dropped`, steps told in `notes`."""
    is_fix = _type_of(recording, topic) in FIXES
    rows = _read(recording, source, topic, _fix_of if is_fix else _point_of)
    if notes is not None:
        notes += rows.notes(source, topic, stamps)
    if not is_fix:
        return position_track(source, topic, rows.times(stamps), rows.values(), dropped, on_earth=False)
    values = rows.values()
    track = position_track(
        source,
        topic,
        rows.times(stamps),
        values[:, :3],
        dropped,
        on_earth=True,
        height=height,
        unusable={"no fix": values[:, 3] <= _NO_FIX},
    )
    variance = values[(values[:, 4] > 0) & (values[:, 5] > 0)][:, 4:]
    if not len(variance):
        return track
    sigma = np.sqrt(np.median(variance, axis=0))
    return replace(track, accuracy_m=(float(sigma[0]), float(sigma[1])))


def _prefix(source: str, preset: Preset, namespace: str | None, names: Sequence[str]) -> str:
    there = [before for known, before in namespaces(names) if known == preset]
    if namespace is not None:
        wanted = namespace.rstrip("/")
        wanted = wanted if wanted.startswith("/") or not wanted else f"/{wanted}"
        if wanted not in there:
            listed = ", ".join(before or "/" for before in there) or "none"
            raise DataError(
                source, f"has no {preset} topics in {namespace}", f"namespaces with them: {listed}"
            )
        return wanted
    if not there:
        driver = DRIVERS[preset]
        others = [name for name in names if any(f"/{base}/" in name for base in driver.names)]
        bases = "/".join(driver.names)
        if not others:
            problem = f"has no topics of {preset} ({bases}/...)"
            listed = ", ".join(names[:_MOST_NAMED]) + (", ..." if len(names) > _MOST_NAMED else "")
            raise DataError(
                source, problem, f"name the topic of the poses instead; there is {listed or 'none'}"
            )
        positions = ", ".join(part for parts in driver.positions.values() for part in parts)
        raise DataError(
            source,
            f"has topics of {preset} ({', '.join(others[:3])}{', ...' if len(others) > 3 else ''}), but none"
            f" with positions ({positions})",
            "record one of these below it, or name the topic of the poses instead",
        )
    if len(there) > 1:
        raise DataError(
            source,
            f"holds {preset} topics of {len(there)} drones ({', '.join(before or '/' for before in there)})",
            "say which with `namespace:`",
        )
    return there[0]


# --- topics --------------------------------------------------------------------------------------------


def _gimbal(
    recording: Log,
    source: str,
    topic: str,
    preset: Preset,
    body: AttitudeTrack | None,
    stamps: Stamps,
    dropped: dict[str, int],
) -> AttitudeTrack | None:
    if preset == "mavros":
        if body is None:
            return None
        rows = _read(recording, source, topic, _quaternion_of)
        t_ns = rows.times(stamps)
        turned = world_from_heading(body, t_ns, rows.values())
        return attitude_track(topic, t_ns, turned, dropped, stated=whatever_from(rows.values()))
    rows = _read(recording, source, topic, _vector_of)
    order = "rpy" if "ground_ENU" in rows.frames else "pry"
    angles = rows.values()[:, [order.index(letter) for letter in "ypr"]]
    stated = whatever_from(of_angles(angles))
    return attitude_track(topic, rows.times(stamps), turned_as_stated(angles), dropped, stated=stated)


def _type_of(recording: Log, topic: str) -> str:
    return next(known.type for known in recording.topics if known.name == topic)


def _read(recording: Log, source: str, topic: str, numbers: Callable[[Any], Sequence[float]]) -> _TopicRows:
    """Read the numbers of every message of a topic."""
    rows = _TopicRows()
    for message in recording.messages([topic]):
        value = message.value
        try:
            header = getattr(value, "header", None)
            stamp = getattr(value, "timestamp", None) if header is None else header.stamp
            row = [float(number) for number in numbers(value)]
            rows.header_ns.append(0 if stamp is None else nanoseconds(stamp))
            rows.receive_ns.append(message.receive_ns)
            rows.numbers.extend(row)
            if header is not None:
                rows.frames.add(str(header.frame_id))
        except FAULTS as error:
            raise _no_such(recording, source, message, error, *_READ[numbers]) from error
    if not len(rows.header_ns):
        raise DataError(source, f"topic {topic} holds no message", "name another")
    return rows


def _no_such(
    recording: Log, source: str, message: Message, error: Exception, noun: str, types: Sequence[str]
) -> DataError:
    """Return the error for a message: its type has no such data, or else its own fault."""
    topic = message.topic
    if isinstance(error, AttributeError) and topic.type not in types:
        there = [known.name for known in recording.topics if known.type in types]
        named = ", ".join(type_.rpartition("/")[2] for type_ in types)
        return DataError(
            source,
            f"topic {topic.name} holds {topic.type}, no {noun} that can be read",
            f"name a topic of {named}: {', '.join(sorted(there)) or 'this log has none'}",
        )
    return unreadable(message, source, error)


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


def _vector_of(value: Any) -> Sequence[float]:
    return value.vector.x, value.vector.y, value.vector.z


_READ: dict[Callable[[Any], Sequence[float]], tuple[str, tuple[str, ...]]] = {
    _point_of: ("position", _POSITIONS),
    _fix_of: ("position", _POSITIONS),
    _quaternion_of: ("attitude", _ATTITUDES),
    _vector_of: ("gimbal angles", _VECTORS),
}
"""Kind of data that each of these functions reads, and the message types that hold it."""
