"""Turns and offsets from the pose a body was modelled in, limbs spread, to the neutral pose of `rig`."""

from __future__ import annotations

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import matrix_from_quaternion, quaternion_from_matrix
from pipelines.simulation.rig import BONE, BONES, PARENT, SIDES


def neutral_turns(rest_joint: Float, lean_rad: float) -> Float:
    """Compute the turn of each bone from rest to neutral: [22, 4] quaternions xyzw.

    Trunk and head stay. Legs come down straight, arms straight with the hands forward of the elbows'
    bend, so that a knee or elbow bends about the axis from side to side; feet point ahead, soles level.

    Args:
        rest_joint: [22, 3] m, x forward, y left, z up.
        lean_rad: angle of the arms from the vertical, outward, to clear the hips.
    """
    turns = np.tile(np.eye(3), (len(BONES), 1, 1))
    for sign, side in zip((1.0, -1.0), SIDES, strict=True):

        def bone(name: str, side: str = side) -> int:
            return BONE[f"{side}_{name}"]

        def along(upper: str, lower: str, side: str = side) -> Float:
            way: Float = rest_joint[BONE[f"{side}_{lower}"]] - rest_joint[BONE[f"{side}_{upper}"]]
            return way

        down = np.array([0.0, sign * np.sin(lean_rad), -np.cos(lean_rad)])
        axis = np.array([0.0, -np.cos(lean_rad), -sign * np.sin(lean_rad)])
        upper, lower = along("upper_arm", "forearm"), along("forearm", "hand")
        rest_axis = np.cross(upper, lower)
        turns[bone("upper_arm")] = _turn((upper, rest_axis), (down, axis))
        turns[bone("forearm")] = turns[bone("hand")] = _turn((lower, rest_axis), (down, axis))

        left, straight = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0])
        turns[bone("thigh")] = _turn((along("thigh", "shank"), left), (straight, left))
        turns[bone("shank")] = _turn((along("shank", "foot"), left), (straight, left))
        ahead = along("foot", "toes") * [1.0, 1.0, 0.0]
        up = np.array([0.0, 0.0, 1.0])
        turns[bone("foot")] = turns[bone("toes")] = _turn((ahead, up), (np.array([1.0, 0.0, 0.0]), up))
    return quaternion_from_matrix(turns)


def neutral_offsets(rest_joint: Float, turns: Float) -> Float:
    """Compute each joint's place relative to its parent's, neutral pose: [22, 3] m, the root's row zero.

    Parts that must be zero, sideways in the trunk and in a hanging leg, are exactly zero.
    """
    matrix = matrix_from_quaternion(turns)
    offset = np.zeros((len(BONES), 3))
    for name, parent in PARENT.items():
        if parent is not None:
            along = rest_joint[BONE[name]] - rest_joint[BONE[parent]]
            offset[BONE[name]] = np.einsum("ij,j->i", matrix[BONE[parent]], along)
    offset[np.abs(offset) < 1e-12] = 0.0
    return offset


def _turn(source: tuple[Float, Float], target: tuple[Float, Float]) -> Float:
    """Return the rotation that takes the first source direction to the first target direction.

    It takes the plane of both source directions to the plane of both target directions.
    """
    turn: Float = np.einsum("ik,jk->ij", _frame(*target), _frame(*source))
    return turn


def _frame(first: Float, second: Float) -> Float:
    """Return axes in columns: along the first, across both, and the third."""
    x = first / np.linalg.norm(first)
    z = np.cross(x, second)
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)
