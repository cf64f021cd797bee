"""Linear blend skinning of points on the bones of `geometry.rig`.

The skinning does not collapse where joints bend far. Blending the transforms
of two bones that differ by an angle a pulls points halfway between them to cos(a/2) of their distance from
the joint: a knee bent by 120 degrees loses half its girth. At every joint a bone is added that turns half as
far as the joint bends. It takes over the weights that the two bones share, so that no two neighbours differ
by more than a/2 (after Mohr and Gleicher, "Building efficient, accurate character skins from examples",
SIGGRAPH 2003, which adds such joints). At 120 degrees a point keeps 0.87 of its distance from the joint. Each
added bone lies after the rig's, in the order of the bones below its joint. The root has none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.compilation import cached
from pipelines.geometry.poses import matrix_from_quaternion, multiply, quaternion_from_matrix
from pipelines.geometry.rig import BONE, BONES, PARENT, SIDES

BELOW = np.array([BONE[name] for name, parent in PARENT.items() if parent is not None])
ABOVE = np.array([BONE[parent] for parent in PARENT.values() if parent is not None])
HINGE = np.concatenate([np.arange(len(BONES)), BELOW])
"""[M] the bone at whose joint each moving bone, of the rig or added, turns."""


def moving_weights(weights: Float) -> Float:
    """Distribute weights [..., 22] on the rig's bones to the M moving bones: [..., M], the same sum.

    Two neighbours with equal weights give all to the bone between them, and one alone keeps its own. A bone
    that shares with several is scaled down, so that it gives no more than it has.
    """
    shared = np.minimum(weights[..., ABOVE], weights[..., BELOW])
    asked = np.zeros_like(weights)
    for joint, (above, below) in enumerate(zip(ABOVE, BELOW, strict=True)):
        asked[..., above] += shared[..., joint]
        asked[..., below] += shared[..., joint]
    granted = np.where(asked > weights, weights / np.where(asked > 0, asked, 1.0), 1.0)
    given = shared * np.minimum(granted[..., ABOVE], granted[..., BELOW])
    left = weights.copy()
    for joint, (above, below) in enumerate(zip(ABOVE, BELOW, strict=True)):
        left[..., above] -= given[..., joint]
        left[..., below] -= given[..., joint]
    return np.concatenate([left, 2 * given], axis=-1)


def with_bones_between(turned: Float) -> Float:
    """Append to quaternions [..., 22, 4] of the rig's bones those of the added ones: [..., M, 4]."""
    above, below = turned[..., ABOVE, :], turned[..., BELOW, :]
    same_side = np.sum(above * below, axis=-1, keepdims=True) >= 0
    between = above + np.where(same_side, below, -below)
    between /= np.linalg.norm(between, axis=-1, keepdims=True)
    return np.concatenate([turned, between], axis=-2)


@dataclass(frozen=True)
class Skinning:
    """Bones at rest, their turns to the neutral pose, and the rig's offsets.

    Motions are relative to the neutral pose; the mesh rests in the pose it was modelled in, limbs spread.
    """

    rest_joint: Float  # [22, 3] m
    neutral_from_rest: Float  # [22, 4] quaternions xyzw
    offset: Float  # [22, 3] m, of the rig

    def transforms(self, root: Float, rotation: Float) -> tuple[Float, Float]:
        """Compute world from rest of all moving bones: rotations [..., M, 3, 3], translations [..., M, 3] m.

        Args:
            root: [..., 3] m, the pelvis's joint in the world.
            rotation: [..., 22, 4] world_from_bone relative to the neutral pose, unit quaternions xyzw.
        """
        turned = multiply(rotation, self.neutral_from_rest)
        matrix = matrix_from_quaternion(with_bones_between(turned))

        steps = np.einsum(
            "...bij,bj->...bi", matrix_from_quaternion(rotation[..., ABOVE, :]), self.offset[BELOW]
        )
        centre = np.empty((*rotation.shape[:-1], 3))
        centre[..., BONE["pelvis"], :] = root
        for step, (above_bone, bone) in enumerate(zip(ABOVE, BELOW, strict=True)):
            centre[..., bone, :] = centre[..., above_bone, :] + steps[..., step, :]
        to_hinge = np.einsum("...bij,bj->...bi", matrix, self.rest_joint[HINGE])
        return matrix, centre[..., HINGE, :] - to_hinge


@dataclass(frozen=True)
class Skin:
    """Points that bones move, each by a few weighted bones."""

    rest: Float  # [V, 3] m
    bone: NDArray[np.int64]  # [V, K] moving bones, the strongest first
    weight: Float  # [V, K], rows sum to 1; where it is 0 the bone does not matter

    def moved(self, matrix: Float, translation: Float) -> Float:
        """Return the points [V, 3] under transforms [M, 3, 3], [M, 3] of the moving bones."""
        return blend(self.rest, self.bone, self.weight, matrix, translation)


def make_skin(rest: Float, weights: Float) -> Skin:
    """Make a skin of points [V, 3] and weights [V, 22] on the rig's bones, whose rows sum to 1."""
    moving = moving_weights(weights)
    most = int(np.max(np.sum(moving > 0, axis=1)))
    bone = np.argsort(-moving, axis=1, kind="stable")[:, :most]
    return Skin(np.ascontiguousarray(rest), bone, np.take_along_axis(moving, bone, axis=1))


@cached
def blend(rest: Float, bone: NDArray[np.int64], weight: Float, matrix: Float, translation: Float) -> Float:
    """Move points [V, 3] by the weighted mean of their bones' transforms; see `Skin`."""
    moved = np.empty_like(rest)
    for v in range(rest.shape[0]):
        x, y, z = rest[v, 0], rest[v, 1], rest[v, 2]
        a = b = c = 0.0
        for k in range(bone.shape[1]):
            w = weight[v, k]
            if w <= 0.0:
                break
            m, t = matrix[bone[v, k]], translation[bone[v, k]]
            a += w * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + t[0])
            b += w * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + t[1])
            c += w * (m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + t[2])
        moved[v, 0], moved[v, 1], moved[v, 2] = a, b, c
    return moved


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
    """Return the rotation that takes the first source direction to the first target direction."""
    turn: Float = np.einsum("ik,jk->ij", _frame(*target), _frame(*source))
    return turn


def _frame(first: Float, second: Float) -> Float:
    """Return axes in columns: along the first, across both, and the third."""
    x = first / np.linalg.norm(first)
    z = np.cross(x, second)
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)
