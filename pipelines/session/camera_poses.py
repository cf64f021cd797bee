"""Poses of a session's cameras at given times, interpolated as far as the manifest trusts the logs."""

from __future__ import annotations

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import interpolate_poses
from pipelines.session.description import Interpolation
from pipelines.session.records import Int64, Trajectory


def poses_at(
    track: Trajectory, t_ns: Int64, between: Interpolation, *, static: bool = False
) -> tuple[Float, Float]:
    """Interpolate world_from_camera at given times.

    Args:
        track: the logged or refined poses.
        t_ns: [T].
        between: the longest gap to bridge and the longest extrapolation.
        static: True for a camera that stands still; its first pose holds all the time.

    Returns:
        Positions [T, 3] m and quaternions [T, 4] xyzw; NaN where there is no pose.
    """
    if static:
        still = np.zeros(len(t_ns), dtype=np.intp)
        return track.position[still], track.quaternion_xyzw[still]
    return interpolate_poses(
        track.t_ns,
        track.position,
        track.quaternion_xyzw,
        t_ns,
        max_gap_ns=between.max_gap_ns,
        max_extrapolation_ns=between.max_extrapolation_ns,
    )
