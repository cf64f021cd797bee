"""Transformation of pose covariances from one frame to another, to first order.

A pose covariance [..., 6, 6] is that of a position (m) and of a small rotation (rad). The axes of the
rotation differ: logs of ROS use the fixed axes of the world. A session uses the axes of the moving
object: R_true = R exp(rotation). NaN in gives NaN out; all zero (unknown) stays all zero.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import matrix_from_quaternion, rotate

_BLOCK = 4096  # poses at a time, so that intermediate arrays stay small for any length of log


def pose_covariance_in_body(covariance: Float, world_from_body_xyzw: Float) -> Float:
    """Convert a covariance in ROS's convention to one with its rotation part about the body's axes.

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
    """Compute the covariance of a camera's pose from that of the body that carries it.

    A rotation error w of the body (about world axes) moves the camera by w x (R lever_arm) and turns it
    by the same w. The same is assumed for a gimbal that holds its attitude in the world: that attitude comes
    from the body's own estimate of north and down, and logs have no better value for its error.

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
    """Transform covariances [..., 6, 6] by one linear map [6, 6]."""
    return _by_blocks(lambda block: _propagated(jacobian, block), covariance)


def _by_blocks(carry: Callable[..., Float], covariance: Float, *vectors: Float) -> Float:
    """Apply `carry` to covariances and vectors block by block; a vector may be one for all poses."""
    if covariance.ndim != 3 or len(covariance) <= _BLOCK:
        return carry(covariance, *vectors)
    of_each = [np.broadcast_to(vector, (len(covariance), np.shape(vector)[-1])) for vector in vectors]
    carried = np.zeros(covariance.shape)
    for start in range(0, len(covariance), _BLOCK):
        block = slice(start, start + _BLOCK)
        carried[block] = carry(covariance[block], *(vector[block] for vector in of_each))
    return carried


def _block_diagonal(rotation: Float) -> Float:
    """Build a map with the identity for the position and `rotation` [..., 3, 3] for the rotation vector."""
    jacobian = np.zeros((*rotation.shape[:-2], 6, 6))
    jacobian[..., :3, :3] = np.eye(3)
    jacobian[..., 3:, 3:] = rotation
    return jacobian


def _cross_matrix(vector: Float) -> Float:
    """Build the matrix [..., 3, 3] whose product with a vector u is the cross product v x u."""
    x, y, z = np.moveaxis(vector, -1, 0)
    o = np.zeros_like(x)
    rows = [[o, -z, y], [z, o, -x], [-y, x, o]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _propagated(jacobian: Float, covariance: Float) -> Float:
    carried: Float = jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)
    return carried
