"""Reader of PX4's .ulg logs, by pyulog (extra `drones`): estimates, GPS, gimbal and camera triggers.

The world is NED, stamps are us since boot. Definitions are checked before pyulog expands them: damaged or
malicious ones mean billions of fields.
"""

from __future__ import annotations

import contextlib
import io
import re
import struct
from collections.abc import Collection, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.formats.common.files import first_bytes
from pipelines.formats.drone_logs.telemetry_rows import (
    DroneLog,
    attitude_track,
    fit_gps_time,
    fixes_track,
    on_gps_time,
    on_one_clock,
    pictures_on_gps_time,
    position_track,
    require_position,
    same_angles_for_every_reference,
    world_from_heading,
)
from pipelines.geometry.arrays import Bool, ClockFit, Float, Int64, Place
from pipelines.geometry.geodesy import enu_from_enu
from pipelines.geometry.mounting import attitude_in_enu
from pipelines.session.errors import DataError
from pipelines.session.records import AttitudeTrack, PositionTrack, Telemetry
from pipelines.session.registries import TelemetryChoice, need
from pipelines.session.storage import damaged, on_disk

_3D_FIX = 3
_GPS = ("vehicle_gps_position", "sensor_gps")
_YAW_LOCK, _YAW_IN_VEHICLE, _YAW_IN_EARTH = 16, 32, 64  # GIMBAL_DEVICE_FLAGS of MAVLink
_POSITIONS = {
    "local": ("vehicle_local_position", "estimator_local_position"),
    "global": ("vehicle_global_position", "estimator_global_position"),
    "gps": _GPS,
}
_ATTITUDES = {"vehicle_attitude", "estimator_attitude", "gimbal_device_attitude_status"}
_WANTED = _ATTITUDES.union(*_POSITIONS.values())
MAGIC = b"ULog\x01\x12\x35"
# PX4's largest message has some hundreds of fields, with its nested types.
_MOST_FIELDS = 20_000
Columns = Mapping[str, Any]  # by field name, arrays [N] in the log's own number types


class UlogFormat(DroneLog):
    """Reader of the logs of PX4 autopilots."""

    name = "ulog"
    title = "PX4 log"
    suffixes: tuple[str, ...] = (".ulg", ".ulog")
    choices: tuple[str, ...] = ("position", "instance", "time")

    def recognises(self, path: Path) -> bool:
        """Return True if the file begins with ULog's magic bytes."""
        return first_bytes(path, len(MAGIC)) == MAGIC

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:
        """Read position (local if ever valid, else global, else GPS's), attitude and gimbal."""
        notes: list[str] = []
        topics = read_topics(path, _WANTED, notes)
        fit = on_gps_time(path, _gps_time(topics), choice.time, notes)
        return telemetry_of(path, topics, choice, fit, notes)

    def picture_times(self, path: Path, choice: TelemetryChoice) -> Int64:
        """Read the times of pictures: by the camera's feedback, else by the trigger."""
        topics = read_topics(path, {"camera_capture", "camera_trigger", *_GPS})
        for name in ("camera_capture", "camera_trigger"):
            if found := [topic for topic in topics if topic.name == name and len(topic)]:
                return pictures_on_gps_time(path, found[0].t_ns(), _gps_time(topics), choice)
        problem = "holds no camera_capture or camera_trigger"
        raise DataError(path, problem, "take the times of frames otherwise")


def telemetry_of(
    path: Path | str,
    topics: Sequence[UlogTopic],
    choice: TelemetryChoice,
    fit: ClockFit | None,
    notes: list[str],
) -> Telemetry:
    """Make the telemetry of PX4's topics, of a .ulg or of px4_msgs; stamps are converted by `fit`."""
    dropped: dict[str, int] = {}
    body = _body(topics, choice.instance, dropped, notes)
    position = _position(path, topics, choice, dropped, notes)
    gimbal = _gimbal(topics, body, dropped, notes)
    return on_one_clock(path, position, body, gimbal, fit=fit, notes=notes, dropped=dropped)


def _position(
    path: Path | str,
    topics: Sequence[UlogTopic],
    choice: TelemetryChoice,
    dropped: MutableMapping[str, int],
    notes: list[str],
) -> PositionTrack:
    there = {kind: _there(topics, names) for kind, names in _POSITIONS.items()}
    found = {kind: each[0] for kind, each in there.items() if each}
    if choice.instance is not None:
        chosen = {kind: [t for t in each if t.instance == choice.instance] for kind, each in there.items()}
        listed = ", ".join(f"{topic.name} {topic.instance}" for each in there.values() for topic in each)
        found = {kind: each[-1] for kind, each in chosen.items() if each}
        if listed and (choice.position not in found if choice.position else not found):
            problem = f"has no instance {choice.instance} of {choice.position or 'a'} position"
            raise DataError(path, problem, f"there are {listed}", code="no-such-name")
    require_position(
        path,
        found,
        choice.position,
        "has no vehicle_local_position, vehicle_global_position or GPS",
        "log them (SDLOG_PROFILE), or give the poses from elsewhere",
    )
    ever = {"local": _local_is_valid, "gps": lambda t: _fixes(t)[1], "global": UlogTopic.t_ns}
    likely = (kind for kind, topic in found.items() if ever[kind](topic).any())
    kind: str = choice.position or next(likely, next(iter(found)))
    topic = found[kind]
    notes.append(f"took the {kind} position from {topic}")
    if kind == "local":
        return _local(path, topic, dropped, notes)
    if kind == "global":
        values, usable = topic.numbers("lat", "lon", "alt"), np.ones(len(topic), dtype=np.bool_)
    else:
        values, usable = _fixes(topic)
    track = fixes_track(path, topic.title, topic.t_ns(), values, usable, dropped)
    return replace(track, accuracy_m=_accuracy(topic, usable))


def _local(
    path: Path | str, topic: UlogTopic, dropped: MutableMapping[str, int], notes: list[str]
) -> PositionTrack:
    """Read the estimator's metres and their origin on Earth, which the estimator may move in flight."""
    enu = topic.numbers("y", "x", "z") * [1, 1, -1]
    valid = _local_is_valid(topic)
    if not valid.any():
        notes.append(
            f"{topic.title} never calls its horizontal position valid: its poses are of no use, unless the"
            " drone was held in place"
        )
        valid = np.ones(len(topic), dtype=np.bool_)
    resets = np.count_nonzero(np.diff(topic.numbers("xy_reset_counter")[valid]) > 0)
    if resets:
        notes.append(f"the estimator moved its position {resets} times at once (xy_reset_counter)")
    references, stated = topic.numbers("ref_lat", "ref_lon", "ref_alt"), topic.flags("xy_global")
    stated &= np.isfinite(references).all(axis=1) & (references[:, :2] != 0).any(axis=1)
    origin: Place | None = None
    unusable = {"not valid to its estimator": ~valid}
    if (valid & stated).any():
        unusable["before its place on Earth was known"] = ~stated
        places = np.unique(references[valid & stated], axis=0)
        first = references[np.flatnonzero(valid & stated)[0]]
        origin = Place(*first.tolist())
        for place in places:
            moved = stated & (references == place).all(axis=1)
            rotation, position = enu_from_enu(Place(*place.tolist()), origin)
            enu[moved] = enu[moved] @ rotation.T + position
        if len(places) > 1:
            notes.append(f"the estimator moved its origin {len(places) - 1} times; followed")
    track = position_track(
        path, topic.title, topic.t_ns(), enu, dropped, on_earth=False, origin=origin, unusable=unusable
    )
    return replace(track, accuracy_m=_accuracy(topic, valid))


def _local_is_valid(topic: UlogTopic) -> Bool:
    return topic.flags("xy_valid") & topic.flags("z_valid")


def _fixes(topic: UlogTopic) -> tuple[Float, Bool]:
    """Return latitude, longitude and height [N, 3], and True where there was a 3D fix [N]."""
    if "latitude_deg" in topic:
        values = topic.numbers("latitude_deg", "longitude_deg", "altitude_msl_m")
    else:
        values = topic.numbers("lat", "lon", "alt") * [1e-7, 1e-7, 1e-3]
    return values, np.asarray(topic.numbers("fix_type") >= _3D_FIX)


def _accuracy(topic: UlogTopic, usable: Bool) -> tuple[float, float] | None:
    stated = topic.numbers("eph", "epv")[usable]
    stated = stated[np.isfinite(stated).all(axis=1) & (stated > 0).all(axis=1)]
    if not len(stated):
        return None
    across, up = np.median(stated, axis=0).tolist()
    return across / float(np.sqrt(2)), up  # eph is the root of both variances' sum


def _body(
    topics: Sequence[UlogTopic], instance: int | None, dropped: MutableMapping[str, int], notes: list[str]
) -> AttitudeTrack | None:
    found = [topic for topic in topics if topic.name == "vehicle_attitude"]
    estimated = [topic for topic in topics if topic.name == "estimator_attitude" and len(topic)]
    if instance and estimated:
        found = [topic for topic in estimated if topic.instance == instance] or found
        if found and found[0].name != "estimator_attitude":
            notes.append(
                f"has no estimator_attitude {instance}: took the attitude that the autopilot flew by"
            )
    if not found:
        return None
    topic = found[0]
    ned_from_frd = topic.numbers("q[1]", "q[2]", "q[3]", "q[0]")
    turned = attitude_in_enu(ned_from_frd, relative_to="world", axes="ned")
    return attitude_track(topic.title, topic.t_ns(), turned, dropped)


def _gimbal(
    topics: Sequence[UlogTopic],
    body: AttitudeTrack | None,
    dropped: MutableMapping[str, int],
    notes: list[str],
) -> AttitudeTrack | None:
    """Read GIMBAL_DEVICE_ATTITUDE_STATUS: pitch and roll against the horizon, yaw by its flags (MAVLink)."""
    devices = _there(topics, ["gimbal_device_attitude_status"])
    if not devices:
        return None
    topic = devices[0]
    if len(devices) > 1:
        notes.append(f"has {len(devices)} gimbals: took the angles of the first, {topic.instance}")
    stated = topic.numbers("q[1]", "q[2]", "q[3]", "q[0]")
    flags = np.asarray(topic.columns.get("device_flags", np.zeros(len(topic)))).astype(np.int64)
    framed = (flags & (_YAW_IN_VEHICLE | _YAW_IN_EARTH)) != 0
    from_north = np.where(framed, (flags & _YAW_IN_EARTH) != 0, (flags & _YAW_LOCK) != 0)
    turned = attitude_in_enu(stated, relative_to="world", axes="ned")
    if not from_north.all():
        if body is None:
            turned[~from_north] = np.nan
        else:
            turned[~from_north] = world_from_heading(body, topic.t_ns()[~from_north], stated[~from_north])
    return attitude_track(
        topic.title, topic.t_ns(), turned, dropped, stated=same_angles_for_every_reference(stated)
    )


def _gps_time(topics: Sequence[UlogTopic]) -> ClockFit | None:
    """Fit UTC to the time since boot, by the receiver's time; None if it gives no time."""
    for topic in sorted(topics, key=lambda topic: (topic.name not in _GPS[:1], topic.instance)):
        if topic.name in _GPS and "time_utc_usec" in topic:
            utc_ns = np.asarray(topic.columns["time_utc_usec"]).astype(np.int64) * 1000
            known = utc_ns > 0
            published = np.asarray(topic.columns["timestamp"]).astype(np.int64) * 1000
            return fit_gps_time(published[known], utc_ns[known])
    return None


def _there(topics: Sequence[UlogTopic], names: Sequence[str]) -> list[UlogTopic]:
    return [topic for name in names for topic in topics if topic.name == name and len(topic)]


@dataclass(frozen=True)
class UlogTopic:
    """One instance of a topic."""

    name: str
    instance: int
    columns: Columns
    label: str = ""  # its name in the log, where that is another

    @property
    def title(self) -> str:
        """Name for users."""
        return self.label or self.name

    def __str__(self) -> str:
        return self.label or f"{self.name} (instance {self.instance})"

    def __len__(self) -> int:
        return len(self.columns["timestamp"])

    def __contains__(self, field: str) -> bool:
        return field in self.columns

    def numbers(self, *fields: str) -> Float:
        """Return one field [N], or several [N, F]; NaN throughout if the log has no such field."""
        missing = np.full(len(self), np.nan)
        columns = [np.asarray(self.columns.get(field, missing), dtype=np.float64) for field in fields]
        return columns[0] if len(columns) == 1 else np.stack(columns, axis=1)

    def flags(self, field: str) -> Bool:
        """Return True where a field is set [N]; True throughout if the log has no such field."""
        return np.asarray(self.columns.get(field, np.ones(len(self))) != 0, dtype=np.bool_)

    def t_ns(self) -> Int64:
        """Return stamps [N] since boot: the time of sampling if the log has it, else of publishing."""
        published = np.asarray(self.columns["timestamp"]).astype(np.int64)
        sampled = np.asarray(self.columns.get("timestamp_sample", published)).astype(np.int64)
        return np.where(sampled > 0, sampled, published) * 1000


def read_topics(path: Path, wanted: Collection[str], notes: list[str] | None = None) -> list[UlogTopic]:
    """Read the topics of some names that have a stamp, sorted by name and instance; note what is missing."""
    core = need("pyulog", "drones")
    _refuse_bombs(path)
    try:
        with path.open("rb") as file, contextlib.redirect_stdout(io.StringIO()):  # pyulog prints warnings
            log = core.ULog(file, sorted(wanted))
    except Exception as error:  # damaged files raise many kinds of errors in this parser
        raise damaged(path, error) from error
    if notes is not None and log.file_corruption:
        notes.append("is damaged: messages are missing, at most all after the first damage")
    if notes is not None and log.dropouts:
        missing_s = sum(dropout.duration for dropout in log.dropouts) / 1e3
        notes.append(
            f"its recorder lost messages {len(log.dropouts)} times, over {missing_s:.2f} s (dropouts)"
        )
    found = [UlogTopic(str(d.name), int(d.multi_id), d.data) for d in log.data_list if "timestamp" in d.data]
    return sorted(found, key=lambda topic: (topic.name, topic.instance))


def _refuse_bombs(path: Path) -> None:
    """Refuse definitions that expand without end: nested arrays may mean billions of fields."""
    formats: dict[str, list[tuple[str, str]]] = {}  # type and count of each field, by the name of the message
    with on_disk(path), path.open("rb") as file:
        if file.read(16)[: len(MAGIC)] != MAGIC:
            wanted = "give the .ulg that the autopilot wrote"
            raise DataError(path, "is no PX4 log", wanted, code="wrong-kind")
        while len(head := file.read(3)) == 3:
            size, kind = struct.unpack("<HB", head)
            body = file.read(size)
            if kind in b"ADL" or len(body) < size:
                break
            if kind == ord("F"):
                name, _, fields = body.decode("utf-8", errors="replace").partition(":")
                formats[name] = re.findall(r"([^\s;\[]+)(?:\[(\d{1,9})\])?\s+[^;]+;?", fields)
    sizes: dict[str, int] = {}

    def size_of(name: str, depth: int) -> int:
        if name not in formats:
            return 1  # a plain type
        if depth <= 20 and name not in sizes:
            sizes[name] = sum(int(n or 1) * size_of(inner, depth + 1) for inner, n in formats[name])
        if depth > 20 or sizes[name] > _MOST_FIELDS:
            raise damaged(path, f"defines {name} with more than {_MOST_FIELDS} fields, or by itself")
        return sizes[name]

    for name in formats:
        size_of(name, 0)


FORMAT = UlogFormat()
