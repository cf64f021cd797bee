"""Pose covariances carried from one frame to another, to first order.

A pose covariance [..., 6, 6] is that of a position (m) and of a small rotation (rad). Which axes the
rotation is about is what differs: logs of ROS use the fixed axes of the world, a session the moving
thing's own: R_true = R exp(rotation). NaN in gives NaN out; all zero (unknown) stays all zero.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.poses import matrix_from_quaternion, rotate

Float = NDArray[np.float64]

_BLOCK = 4096  # poses at a time: what lies between stays small, however long the log


def pose_covariance_in_body(covariance: Float, world_from_body_xyzw: Float) -> Float:
    """A covariance as ROS states it, with its rotation part about the body's axes.

    geometry_msgs/PoseWithCovariance turns about fixed axes: R_true = exp(w) R. As exp(w) R = R exp(R' w),
    the rotation vector in the body is R' w; the position stays in the world.

    Args:
        covariance: [..., 6, 6] x, y, z, then rotation about the fixed x, y, z axes of the pose's frame.
        world_from_body_xyzw: [..., 4] unit, broadcast.

    Returns:
        [..., 6, 6] position in the world, then rotation vector in the body.
    """

    def turned(covariance: Float, world_from_body_xyzw: Float) -> Float:
        jacobian = _block_diagonal(np.swapaxes(matrix_from_quaternion(world_from_body_xyzw), -1, -2))
        return _propagated(jacobian, covariance)

    return _by_blocks(turned, covariance, world_from_body_xyzw)


def mounted_covariance(
    covariance: Float, world_from_body_xyzw: Float, lever_arm: Float, world_from_camera_xyzw: Float
) -> Float:
    """The covariance of a camera's pose, given that of the body that carries it.

    A rotation error w of the body (about world axes) moves the camera by w x (R lever_arm) and turns it
    by the same w. So it does with a gimbal that holds its attitude in the world: that attitude comes from
    the body's own estimate of where north and down are, and logs say nothing better of its error.

    Args:
        covariance: [..., 6, 6] position in world, rotation vector in the body.
        world_from_body_xyzw: [..., 4] unit.
        lever_arm: [3] or [..., 3] m, the camera's position in the body.
        world_from_camera_xyzw: [..., 4] unit.

    Returns:
        [..., 6, 6] the camera's position in world, rotation vector in the camera.
    """

    def mounted(
        covariance: Float, world_from_body_xyzw: Float, lever_arm: Float, world_from_camera_xyzw: Float
    ) -> Float:
        world_from_body = matrix_from_quaternion(world_from_body_xyzw)
        camera_from_world = np.swapaxes(matrix_from_quaternion(world_from_camera_xyzw), -1, -2)
        jacobian = _block_diagonal(camera_from_world @ world_from_body)
        jacobian[..., :3, 3:] = -_cross_matrix(rotate(world_from_body_xyzw, lever_arm)) @ world_from_body
        return _propagated(jacobian, covariance)

    return _by_blocks(mounted, covariance, world_from_body_xyzw, lever_arm, world_from_camera_xyzw)


def carried_covariance(jacobian: Float, covariance: Float) -> Float:
    """Covariances [..., 6, 6] under one linear map [6, 6] for all of them."""
    return _by_blocks(lambda block: _propagated(jacobian, block), covariance)


def _by_blocks(carry: Callable[..., Float], covariance: Float, *vectors: Float) -> Float:
    """`carry` of covariances and vectors, each one for all poses or one for each, of so many at a time."""
    if covariance.ndim != 3 or len(covariance) <= _BLOCK:
        return carry(covariance, *vectors)
    of_each = [np.broadcast_to(vector, (len(covariance), np.shape(vector)[-1])) for vector in vectors]
    carried = np.zeros(covariance.shape)
    for start in range(0, len(covariance), _BLOCK):
        block = slice(start, start + _BLOCK)
        carried[block] = carry(covariance[block], *(vector[block] for vector in of_each))
    return carried


def _block_diagonal(rotation: Float) -> Float:
    """The identity for the position, `rotation` [..., 3, 3] for the rotation vector."""
    jacobian = np.zeros((*rotation.shape[:-2], 6, 6))
    jacobian[..., :3, :3] = np.eye(3)
    jacobian[..., 3:, 3:] = rotation
    return jacobian


def _cross_matrix(vector: Float) -> Float:
    """[..., 3, 3] with which a product is the cross product: (v x) u."""
    x, y, z = np.moveaxis(vector, -1, 0)
    o = np.zeros_like(x)
    rows = [[o, -z, y], [z, o, -x], [-y, x, o]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _propagated(jacobian: Float, covariance: Float) -> Float:
    carried: Float = jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)
    return carried
