"""PX4's own messages in ROS 2 (px4_msgs): the columns of its .ulg, from the messages of a log.

The uXRCE-DDS agent publishes them as /fmu/out/vehicle_attitude and the like. World NED, body FRD, quaternions
w first. `timestamp` is in microseconds: the agent's time (UXRCE_DDS_SYNCT, the default), else since boot.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipelines.formats.drone_logs.ulog import UlogTopic, telemetry_of
from pipelines.formats.logs.messages import FAULTS, Stamps, unreadable
from pipelines.geometry.arrays import Int64
from pipelines.geometry.clocks import ClockFit, fit_clock
from pipelines.session.errors import DataError
from pipelines.session.records import Telemetry
from pipelines.session.registries import Log, TelemetryChoice

_STAMPS = ("timestamp", "timestamp_sample")
_FIELDS: dict[str, tuple[str, ...]] = {
    "vehicle_local_position": (
        *("x", "y", "z", "xy_valid", "z_valid", "xy_reset_counter", "eph", "epv"),
        *("xy_global", "ref_lat", "ref_lon", "ref_alt"),
    ),
    "vehicle_global_position": ("lat", "lon", "alt", "eph", "epv"),
    "vehicle_gps_position": (
        *("latitude_deg", "longitude_deg", "altitude_msl_m", "lat", "lon", "alt", "fix_type", "eph", "epv"),
    ),
    "vehicle_attitude": ("q",),
    "gimbal_device_attitude_status": ("q", "device_flags"),
    "vehicle_odometry": ("position", "x", "y", "z", "q", "pose_frame", "local_frame"),
}
_FIELDS["sensor_gps"] = _FIELDS["vehicle_gps_position"]
"""Fields of each message that are read; versions of px4_msgs differ, so each may be absent."""

# Stamps further from receipt than this, beyond the log's length, count from boot.
_SAME_CLOCK_NS = 60_000_000_000


def read_px4(
    recording: Log, source: str, names: Mapping[str, str], choice: TelemetryChoice, stamps: Stamps
) -> Telemetry:
    """Read position, attitude and gimbal as from a .ulg.

    Stamps that count from boot are converted to those of receipt by a line through both, so that pictures in
    the same log have the same clock.

    Args:
        recording: the log.
        source: its name, for messages.
        names: the topics of one drone, by PX4's name of each (vehicle_attitude).
        choice: what the user asks for.
        stamps: which stamps are the times.
    """
    topics: list[UlogTopic] = []
    sent: list[Int64] = []
    received: list[Int64] = []
    for name, topic in sorted(names.items()):
        columns, receive_ns = _columns(recording, source, topic, _FIELDS[name])
        if not len(receive_ns):
            continue
        if stamps == "receive":
            columns = {k: v for k, v in columns.items() if k not in _STAMPS}
            columns["timestamp"] = receive_ns // 1000
        sent.append(np.asarray(columns["timestamp"], np.int64) * 1000)
        received.append(receive_ns)
        topics.append(UlogTopic(name, 0, columns))
    if not topics:
        raise DataError(
            source,
            "holds messages of px4_msgs that cannot be decoded" if recording.dropped else "holds no message",
            "record as MCAP, which holds the definitions of the messages",
            code="damaged",
        )
    notes: list[str] = []
    fit = _fit(np.concatenate(sent), np.concatenate(received), notes)
    found = telemetry_of(source, _with_odometry(topics, notes), choice, fit, notes)
    return replace(found, clock=f"{stamps} stamps", fit=None)


def _columns(recording: Log, source: str, topic: str, fields: Sequence[str]) -> tuple[dict[str, Any], Int64]:
    """Read fields as columns [N], arrays as `q[0]`, `q[1]`, ...; also the times of receipt [N]."""
    receive_ns = array("q")
    numbers: dict[str, array[float]] = {}
    stamped: dict[str, array[int]] = {}
    for message in recording.messages([topic]):
        value = message.value
        try:
            for name in _STAMPS:
                if name == "timestamp" or hasattr(value, name):
                    stamped.setdefault(name, array("q")).append(int(getattr(value, name)))
            for name in fields:
                if not hasattr(value, name):
                    continue
                stated = np.atleast_1d(np.asarray(getattr(value, name), dtype=np.float64))
                for k, number in enumerate(stated.tolist()):
                    key = f"{name}[{k}]" if name in {"q", "position"} else name
                    numbers.setdefault(key, array("d")).append(number)
        except FAULTS as error:
            raise unreadable(message, source, error) from error
        receive_ns.append(message.receive_ns)
    columns: dict[str, Any] = {name: np.frombuffer(c, np.int64) for name, c in stamped.items()}
    columns |= {name: np.frombuffer(c, np.float64) for name, c in numbers.items()}
    return columns, np.frombuffer(receive_ns, np.int64)


def _fit(sent_ns: Int64, received_ns: Int64, notes: list[str]) -> ClockFit | None:
    """Fit the time of receipt to stamps that count from boot; None for stamps of the agent's time."""
    apart_ns = abs(int(np.median(received_ns - sent_ns)))
    if apart_ns <= _SAME_CLOCK_NS + int(np.ptp(received_ns)):
        return None
    fit = fit_clock(sent_ns, received_ns)
    if fit is not None:
        notes.append(
            "its stamps count from boot (UXRCE_DDS_SYNCT was off): turned to the time of receipt,"
            f" {fit.offset_ns / 1e9:.3f} s ahead, scatter {fit.residual_s * 1e3:.1f} ms"
        )
    return fit


def _with_odometry(topics: Sequence[UlogTopic], notes: list[str]) -> list[UlogTopic]:
    """Use the odometry's position and attitude where there is no message with that alone."""
    found = {topic.name: topic for topic in topics}
    odometry = found.pop("vehicle_odometry", None)
    if odometry is None:
        return list(found.values())
    columns = odometry.columns
    stamped = {name: columns[name] for name in _STAMPS if name in columns}
    if "vehicle_local_position" not in found:
        place = {axis: columns.get(f"position[{k}]", columns.get(axis)) for k, axis in enumerate("xyz")}
        found["vehicle_local_position"] = UlogTopic("vehicle_local_position", 0, stamped | place)
        notes.append("took the local position from vehicle_odometry")
    if "vehicle_attitude" not in found:
        turned = {f"q[{k}]": columns[f"q[{k}]"] for k in range(4) if f"q[{k}]" in columns}
        found["vehicle_attitude"] = UlogTopic("vehicle_attitude", 0, stamped | turned)
        notes.append("took the attitude from vehicle_odometry")
    # pose_frame: 1 is NED, 2 FRD of any heading; the older local_frame has these as 0 and 1.
    frame, is_ned = columns.get("pose_frame"), 1
    if frame is None:
        frame, is_ned = columns.get("local_frame"), 0
    if frame is not None and (np.asarray(frame) != is_ned).any():
        notes.append(
            "its odometry counts the heading from anywhere (FRD): say pose.world_from_source.yaw_deg"
        )
    return list(found.values())
