"""Linear blend skinning that does not collapse where joints bend far.

Blending the transforms of two bones that differ by an angle a pulls points halfway between them to cos(a/2)
of their distance from the joint: a knee bent by 120 degrees loses half its girth. At every joint a bone is
added that turns half as far as the joint bends. It takes over the weights that the two bones share, so that
no two neighbours differ by more than a/2 (after Mohr and Gleicher, "Building efficient, accurate character
skins from examples", SIGGRAPH 2003, which adds such joints). At 120 degrees a point keeps 0.87 of its
distance from the joint.

Each added bone lies after the rig's, in the order of the bones below its joint. The root has none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.compilation import cached
from pipelines.geometry.poses import matrix_from_quaternion, multiply
from pipelines.simulation.rig import BONE, BONES, PARENT

_BELOW = np.array([BONE[name] for name, parent in PARENT.items() if parent is not None])
_ABOVE = np.array([BONE[parent] for parent in PARENT.values() if parent is not None])
HINGE = np.concatenate([np.arange(len(BONES)), _BELOW])
"""[M] the bone at whose joint each moving bone, of the rig or added, turns."""


def moving_weights(weights: Float) -> Float:
    """Distribute weights [..., 22] on the rig's bones to the M moving bones: [..., M], the same sum.

    Two neighbours with equal weights give all to the bone between them, and one alone keeps its own. A bone
    that shares with several is scaled down, so that it gives no more than it has.
    """
    shared = np.minimum(weights[..., _ABOVE], weights[..., _BELOW])
    asked = np.zeros_like(weights)
    for joint, (above, below) in enumerate(zip(_ABOVE, _BELOW, strict=True)):
        asked[..., above] += shared[..., joint]
        asked[..., below] += shared[..., joint]
    granted = np.where(asked > weights, weights / np.where(asked > 0, asked, 1.0), 1.0)
    given = shared * np.minimum(granted[..., _ABOVE], granted[..., _BELOW])
    left = weights.copy()
    for joint, (above, below) in enumerate(zip(_ABOVE, _BELOW, strict=True)):
        left[..., above] -= given[..., joint]
        left[..., below] -= given[..., joint]
    return np.concatenate([left, 2 * given], axis=-1)


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
        above, below = turned[..., _ABOVE, :], turned[..., _BELOW, :]
        same_side = np.sum(above * below, axis=-1, keepdims=True) >= 0
        between = above + np.where(same_side, below, -below)
        between /= np.linalg.norm(between, axis=-1, keepdims=True)
        matrix = matrix_from_quaternion(np.concatenate([turned, between], axis=-2))

        steps = np.einsum(
            "...bij,bj->...bi", matrix_from_quaternion(rotation[..., _ABOVE, :]), self.offset[_BELOW]
        )
        centre = np.empty((*rotation.shape[:-1], 3))
        centre[..., BONE["pelvis"], :] = root
        for step, (above_bone, bone) in enumerate(zip(_ABOVE, _BELOW, strict=True)):
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
