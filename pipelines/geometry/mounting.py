"""Pose of a camera on the drone: fixed mounts, gimbals and lever arms (docs/flight.md has an example).

The body is FLU (x forward, y left, z up), the camera OpenCV (x right, y down, z forward), the world ENU. A
gimbal's frame is FLU, x along the view. Quaternions are xyzw and unit; NaN in gives NaN out.
"""

from typing import Literal

import numpy as np

from pipelines.geometry.arrays import Float, RelativeTo
from pipelines.geometry.poses import ENU_FROM_NED, multiply, quaternion_from_rotation_vector, rotate

Pose = tuple[Float, Float]
Looks = Literal["forward", "backward", "left", "right", "down", "up"]

# The optical axis along x, the picture's right along -y, its bottom along -z.
_FLU_FROM_OPTICAL = np.array([-0.5, 0.5, -0.5, 0.5])
FLU_FROM_FRD = np.array([1.0, 0.0, 0.0, 0.0])
"""A half turn about x: forward stays, left becomes right, up becomes down. It is its own inverse."""

_AZIMUTH_DEG = {"forward": 0.0, "left": 90.0, "backward": 180.0, "right": -90.0, "down": 0.0, "up": 0.0}
_STRAIGHT_DEG = {"down": 90.0, "up": -90.0}


def body_from_camera(looks: Looks, down_deg: float = 0.0) -> Float:
    """Compute the rotation [4] of a camera that looks in a direction, tilted down; ValueError: beyond 90."""
    if looks in _STRAIGHT_DEG and down_deg != 0:
        raise ValueError(
            f"looks {looks} and is tilted by {down_deg:g} deg: say where it looks before the tilt"
        )
    if not abs(down_deg) <= 90:
        raise ValueError(f"down_deg {down_deg:g} is not within -90 to 90")
    azimuth = _turn("z", np.radians(_AZIMUTH_DEG[looks]))
    # About the left axis a positive angle turns forward to down.
    tilt = _turn("y", np.radians(_STRAIGHT_DEG.get(looks, down_deg)))
    return multiply(multiply(azimuth, tilt), _FLU_FROM_OPTICAL)


def attitude_from_angles(
    angles: Float, *, order: Literal["ypr", "rpy", "pry"], units: Literal["deg", "rad"]
) -> Float:
    """Compute attitudes from yaw about z, then pitch about the turned y, then roll about the twice turned x.

    `order` is that in which the log lists the angles [..., 3], which are right-handed. Return
    reference_from_gimbal [..., 4] in the axes of the angles, which determine if a positive pitch looks down
    (FLU) or up (FRD).
    """
    in_rad = np.radians(angles) if units == "deg" else angles
    yaw, pitch, roll = np.moveaxis(in_rad[..., [order.index(letter) for letter in "ypr"]], -1, 0)
    return multiply(multiply(_turn("z", yaw), _turn("y", pitch)), _turn("x", roll))


def attitude_in_enu(quaternion_xyzw: Float, *, relative_to: RelativeTo, axes: Literal["enu", "ned"]) -> Float:
    """Convert a gimbal's attitude from the axes of its log to FLU and ENU.

    With `enu` yaw counts from east to north, or from forward to left, and a positive pitch looks down. With
    `ned` (FRD) yaw counts from north to east, or from forward to right, and a positive pitch looks up, as DJI
    states angles. A positive roll lowers the right side. The quaternion [..., 4] and the result are relative
    to an ENU world, an FLU body, or a level frame with the heading of the body.
    """
    if axes == "enu":
        return quaternion_xyzw
    of_flu_gimbal = multiply(quaternion_xyzw, FLU_FROM_FRD)
    if relative_to == "world":
        return multiply(ENU_FROM_NED, of_flu_gimbal)
    return multiply(FLU_FROM_FRD, of_flu_gimbal)


def level_heading(quaternion_xyzw: Float) -> Float:
    """Keep only the yaw of attitudes in ENU: level attitudes [..., 4] with the heading of the x axis."""
    ahead = rotate(quaternion_xyzw, np.array([1.0, 0.0, 0.0]))
    return _turn("z", np.arctan2(ahead[..., 1], ahead[..., 0]))


def compose_gimbal(
    world_from_body: Pose,
    lever_arm: Float,
    attitude_xyzw: Float,
    gimbal_from_camera_xyzw: Float,
    *,
    relative_to: RelativeTo,
) -> Pose:
    """Compute the poses world_from_camera of a camera on a gimbal: position [N, 3] and quaternion [N, 4].

    An attitude [N, 4] in the world replaces the body's rotation, one relative to the body is composed with
    it, one relative to the heading with its yaw only. The lever arm [3] m goes from the body's origin to the
    camera and always turns with the body: the arm of the gimbal's own joints is assumed to be part of it.
    """
    position, world_from_body_xyzw = world_from_body
    if relative_to == "world":
        attitude = attitude_xyzw
    elif relative_to == "body":
        attitude = multiply(world_from_body_xyzw, attitude_xyzw)
    else:
        attitude = multiply(level_heading(world_from_body_xyzw), attitude_xyzw)
    return position + rotate(world_from_body_xyzw, lever_arm), multiply(attitude, gimbal_from_camera_xyzw)


def _turn(axis: Literal["x", "y", "z"], angle: Float | np.float64) -> Float:
    """Make quaternions [..., 4] of rotations about one axis by angles [...] in rad."""
    direction = np.eye(3)["xyz".index(axis)]
    return quaternion_from_rotation_vector(np.asarray(angle)[..., None] * direction)
