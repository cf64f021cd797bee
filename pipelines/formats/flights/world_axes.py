"""Poses of logs in the axes of the world: east-north-up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipelines.geometry.mounting import flu_body_from_frd
from pipelines.geometry.pose_covariance import carried_covariance
from pipelines.geometry.poses import enu_from_ned
from pipelines.session.manifest import Axes
from pipelines.session.records import Trajectory


def in_enu(trajectory: Trajectory, axes: Axes) -> Trajectory:
    """The same poses in an ENU world; the axes of the thing itself stay."""
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
    """The poses of a body: a log in NED has its body in FRD."""
    turned = in_enu(trajectory, axes)
    if axes == "enu":
        return turned
    quaternion, covariance = flu_body_from_frd(turned.quaternion_xyzw, turned.covariance)
    return replace(turned, quaternion_xyzw=quaternion, covariance=covariance)
