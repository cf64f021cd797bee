"""Conversion of logged poses to the world: to its axes (east-north-up) and its origin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.geodesy import Place
from pipelines.geometry.mounting import flu_body_from_frd
from pipelines.geometry.poses import (
    carried_covariance,
    compose,
    enu_from_ned,
    invert,
    matrix_from_quaternion,
    quaternion_from_rotation_vector,
)
from pipelines.session.errors import DataError
from pipelines.session.manifest import Axes, PoseSource, WorldFromLog
from pipelines.session.records import Trajectory

_FARTHEST_M = 100_000.0  # from the origin: no drone flies so far, and UTM eastings begin at 166 km


_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}


def as_stated(trajectory: Trajectory, pose: PoseSource) -> Trajectory:
    """Return poses world_from_camera (or body) in metres, of a file that has them as the manifest states.

    Covariances of inverted poses are left out: they are those of another pose.
    """
    position, quaternion, covariance = trajectory.position, trajectory.quaternion_xyzw, trajectory.covariance
    if pose.quaternion == "wxyz":
        quaternion = np.roll(quaternion, -1, axis=-1)
    if pose.inverse:
        position, quaternion = invert(position, quaternion)
        covariance = None
    if (metres := _METRES[pose.unit]) != 1.0:
        position = position * metres
        scale = np.diag([metres] * 3 + [1.0] * 3)
        covariance = None if covariance is None else carried_covariance(scale, covariance)
    return replace(trajectory, position=position, quaternion_xyzw=quaternion, covariance=covariance)


def in_enu(trajectory: Trajectory, axes: Axes) -> Trajectory:
    """Convert poses to an ENU world; the axes of the body itself stay."""
    if axes == "enu":
        return trajectory
    position, quaternion = enu_from_ned(trajectory.position, trajectory.quaternion_xyzw)
    covariance = trajectory.covariance
    if covariance is not None:
        swap = np.eye(6)
        swap[:3, :3] = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]
        covariance = carried_covariance(swap, covariance)
    return replace(trajectory, position=position, quaternion_xyzw=quaternion, covariance=covariance)


def body_in_enu(trajectory: Trajectory, axes: Axes) -> Trajectory:
    """Convert the poses of a body: a log in NED has its body in FRD."""
    turned = in_enu(trajectory, axes)
    if axes == "enu":
        return turned
    quaternion, covariance = flu_body_from_frd(turned.quaternion_xyzw, turned.covariance)
    return replace(turned, quaternion_xyzw=quaternion, covariance=covariance)


def in_world(trajectory: Trajectory, place: WorldFromLog) -> Trajectory:
    """Move a trajectory in the ENU axes of its source to where the source has its origin in the world."""
    if place == WorldFromLog():
        return trajectory
    turn = quaternion_from_rotation_vector(np.array([0.0, 0.0, np.radians(place.yaw_deg)]))
    position, quaternion = compose(
        (np.array(place.translation), turn), (trajectory.position, trajectory.quaternion_xyzw)
    )
    covariance = trajectory.covariance
    if covariance is not None and place.yaw_deg:
        rotated = np.eye(6)
        rotated[:3, :3] = matrix_from_quaternion(turn)  # the rotation part stays in the body
        covariance = carried_covariance(rotated, covariance)
    return replace(trajectory, position=position, quaternion_xyzw=quaternion, covariance=covariance)


def refuse_projected(source: Path | str, position: Float, origin: Place) -> None:
    """Refuse coordinates of a map projection, such as UTM, in a world whose origin on Earth is known.

    Args:
        source: the file or log, for the message.
        position: [N, 3] m in the world; rows of NaN are ignored.
        origin: the world's origin on Earth.

    Raises:
        DataError: the median position is more than 100 km from the origin.
    """
    across = position[np.isfinite(position[:, :2]).all(axis=1), :2]
    if not len(across):
        return
    x_m, y_m = np.median(across, axis=0).tolist()
    away_m = float(np.hypot(x_m, y_m))
    if away_m > _FARTHEST_M:
        raise DataError(
            source,
            f"lies about x {x_m:.0f} m, y {y_m:.0f} m (UTM or another map projection), {away_m / 1000:.0f} km"
            f" from the world's origin (latitude {origin.latitude_deg:.6f}, longitude"
            f" {origin.longitude_deg:.6f})",
            "give metres east, north and up of that origin: subtract its projected coordinates",
        )
