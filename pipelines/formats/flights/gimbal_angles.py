"""Gimbal attitudes as a manifest states them: angles of a topic, or fixed angles."""

from __future__ import annotations

import numpy as np

from pipelines.formats.drone_logs.telemetry_rows import turned_as_stated
from pipelines.formats.flights.flight_logs import FlightLogs
from pipelines.geometry.arrays import Float
from pipelines.geometry.mounting import attitude_in_enu
from pipelines.geometry.poses import interpolate_poses
from pipelines.session.manifest import Axes, Gimbal
from pipelines.session.records import Int64
from pipelines.session.telemetry import AttitudeTrack

_FIXED = "fixed angles"


def stated_angles(gimbal: Gimbal, logs: FlightLogs, frame: Axes) -> AttitudeTrack:
    """Return the attitude of a gimbal with a topic or fixed angles, in our axes at world times.

    Args:
        gimbal: its part of the manifest.
        logs: the flight's logs.
        frame: the axes if neither gimbal nor log state any; fixed angles are always NED.

    Raises:
        DataError: the topic cannot be read.
    """
    relative_to = gimbal.relative_to or "world"
    if gimbal.fixed is not None:
        angles = np.array([[gimbal.fixed.yaw_deg, gimbal.fixed.pitch_deg, gimbal.fixed.roll_deg]])
        turned = turned_as_stated(angles, relative_to=relative_to)
        return AttitudeTrack(_FIXED, np.zeros(1, dtype=np.int64), turned, relative_to)
    log, topic = gimbal.log or "", gimbal.topic or ""
    logged = logs.attitudes(log, topic, order=gimbal.order, units=gimbal.units)
    turned = attitude_in_enu(
        logged.quaternion_xyzw,
        relative_to=relative_to,
        axes=gimbal.axes or logs.settings(log).axes or frame,
    )
    lost = {f"gimbal angles: {cause}": count for cause, count in logged.dropped.items()}
    return AttitudeTrack(topic, logged.t_ns, turned, relative_to, dropped=lost)


def attitudes_at(track: AttitudeTrack, t_ns: Int64, *, max_gap_ns: int) -> Float:
    """Interpolate attitudes [N, 4] at given times, NaN outside the track; fixed angles always hold."""
    if track.name == _FIXED:
        return np.repeat(track.quaternion_xyzw, len(t_ns), axis=0)
    return interpolate_poses(
        track.t_ns,
        np.zeros((len(track.t_ns), 3)),
        track.quaternion_xyzw,
        t_ns,
        max_gap_ns=max_gap_ns,
        max_extrapolation_ns=0,
    )[1]
