"""Camera poses of a formation as formulas of time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import look_at

# How far a camera strays from its slot at `variation` 1. METHODS of the noise studies use the same
# amounts: they make a constant error of each drone's poses observable.
_YAW_RAD, _RANGE_M, _TILT_RAD = np.radians(10.0), 1.0, np.radians(3.0)


def orbit(
    t_s: Float,
    target: Float,
    *,
    cameras: int,
    range_m: float = 10.0,
    tilt_deg: float = 15.0,
    yaw_deg: float = 0.0,
    yaw_rate_deg_per_s: float = 4.0,
    variation: float = 0.0,
) -> tuple[Float, Float]:
    """Compute the poses of a formation on a ring around a moving target; every camera looks at it.

    The slots of Ho et al., "3D Human Reconstruction in the Wild with Collaborative Aerial Cameras":
    yaw_i = yaw + i 2 pi/n (pi/2 for two cameras, which must not face each other), position =
    target + range (cos yaw cos tilt, sin yaw cos tilt, sin tilt).

    Args:
        t_s: [T] seconds.
        target: [T, 3] metres, world: a smooth point of the actor at those times.
        cameras: number of cameras, at least 1.
        range_m: distance from the target.
        tilt_deg: elevation of the cameras above the target, below 90.
        yaw_deg: yaw of the first camera at time 0, counterclockwise from east.
        yaw_rate_deg_per_s: angular speed of the ring.
        variation: deviation of each camera from its slot, by sines of its own periods: 10 degrees of
            yaw, 1 m of range and 3 degrees of tilt at 1.

    Returns:
        Positions [N, T, 3] and unit quaternions [N, T, 4] (xyzw), world_from_camera, upright pictures.
    """
    spacing = np.pi / 2 if cameras == 2 else 2 * np.pi / cameras
    camera = np.arange(cameras)[:, None]
    yaw = np.radians(yaw_deg + yaw_rate_deg_per_s * t_s) + spacing * camera
    yaw = yaw + variation * _YAW_RAD * _sway(t_s, 7.0, camera)
    distance = range_m + variation * _RANGE_M * _sway(t_s, 9.0, camera)
    tilt = np.radians(tilt_deg) + variation * _TILT_RAD * _sway(t_s, 5.0, camera)
    direction = np.stack([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), np.sin(tilt)], axis=-1)
    position = target + distance[..., None] * direction
    return position, look_at(position, target)


def _sway(t_s: Float, period_s: float, camera: NDArray[np.int64]) -> Float:
    """Compute a sine [N, T] for each camera, with a period and phase of its own."""
    sway: Float = np.sin(2 * np.pi * t_s / (period_s + 1.3 * camera) + 2.0 * camera)
    return sway
