"""The bones of a person, used by motions and by the body's mesh.

Every bone is turned from a neutral pose: standing upright, arms hanging, legs straight, feet pointing
ahead, soles flat on the ground. Body axes are x forward, y left, z up, so that a person whose bones are
all turned by the identity looks east.
"""

from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import (
    conjugate,
    multiply,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotate,
    rotation_vector_from_quaternion,
)

_TRUNK = {
    "pelvis": None,
    "spine": "pelvis",
    "back": "spine",
    "chest": "back",
    "neck": "chest",
    "head": "neck",
}
_LIMBS = {
    "clavicle": "chest",
    "upper_arm": "clavicle",
    "forearm": "upper_arm",
    "hand": "forearm",
    "thigh": "pelvis",
    "shank": "thigh",
    "foot": "shank",
    "toes": "foot",
}
SIDES = ("left", "right")

PARENT: dict[str, str | None] = _TRUNK | {
    f"{side}_{bone}": parent if parent in _TRUNK else f"{side}_{parent}"
    for side in SIDES
    for bone, parent in _LIMBS.items()
}
"""Every bone and the one it hangs on, parents first."""

BONES = tuple(PARENT)
BONE = {name: index for index, name in enumerate(BONES)}
CENTRES = {
    f"{side}_{joint}": BONE[f"{side}_{bone}"]
    for side in SIDES
    for joint, bone in (
        ("hip", "thigh"),
        ("shoulder", "upper_arm"),
        ("elbow", "forearm"),
        ("knee", "shank"),
        ("ankle", "foot"),
    )
}
"""Anatomical joints and the bones that begin there."""


@dataclass(frozen=True)
class Rig:
    """The lengths of one person's bones, in the neutral pose.

    `offset` is the place of each bone's joint (its upper end) relative to its parent's joint. The pelvis's is
    relative to the point of the ground between the feet. `sole` is the place of heel, ball and tip of each
    sole relative to the joint of that foot, left then right; the tip belongs to the toes, the others to the
    foot.
    """

    offset: Float  # [B, 3] m
    sole: Float  # [2, 3, 3] m

    @property
    def height_of_pelvis(self) -> float:
        """Height of the pelvis's joint above the ground in the neutral pose, m."""
        return float(self.offset[0, 2])

    @property
    def length_of_leg(self) -> float:
        """Height of the hips' joints above the ground in the neutral pose, m."""
        return self.height_of_pelvis + float(self.offset[BONE["left_thigh"], 2])


@dataclass(frozen=True)
class BodyMotion:
    """The motion of one person.

    `rotation` is world_from_bone relative to the neutral pose: a bone's point that lies `v` from the
    bone's joint in the neutral pose lies `rotate(rotation, v)` from it now. Knees, elbows and other joints
    bend by the difference between a bone's rotation and its parent's.
    """

    t_s: Float  # [T] seconds since the flight's start, strictly increasing
    root: Float  # [T, 3] m, the pelvis's joint in the world
    rotation: Float  # [T, B, 4] unit quaternions xyzw


def joint_centres(rig: Rig, motion: BodyMotion) -> Float:
    """Compute the joint of every bone: [T, B, 3] m, world, in the order of `BONES`."""
    centres = np.empty((len(motion.t_s), len(BONES), 3))
    for bone, (name, parent) in enumerate(PARENT.items()):
        if parent is None:
            centres[:, BONE[name]] = motion.root
        else:
            above = BONE[parent]
            centres[:, bone] = centres[:, above] + rotate(motion.rotation[:, above], rig.offset[bone])
    return centres


def sole_points(rig: Rig, motion: BodyMotion) -> Float:
    """Compute heel, ball and tip of the soles: [T, 2, 3, 3] m, world, left foot first."""
    centres = joint_centres(rig, motion)
    points = np.empty((len(motion.t_s), 2, 3, 3))
    for index, side in enumerate(SIDES):
        foot, toes = BONE[f"{side}_foot"], BONE[f"{side}_toes"]
        turned = motion.rotation[:, foot, None]
        points[:, index, :2] = centres[:, foot, None] + rotate(turned, rig.sole[index, :2])
        tip = rig.sole[index, 2] - rig.offset[toes]
        points[:, index, 2] = centres[:, toes] + rotate(motion.rotation[:, toes], tip)
    return points


def about(axis: int, angle: Float) -> Float:
    """Return rotations [T, 4] about x, y or z (0, 1, 2) by [T] rad; y turns x down, z to the left."""
    turned = np.zeros((len(angle), 4))
    turned[:, axis] = np.sin(angle / 2)
    turned[:, 3] = np.cos(angle / 2)
    return turned


def partly(start: Float, end: Float, share: Float) -> Float:
    """Return rotations [..., 4] that are `share` [...] of the shortest way from one to another."""
    vector = rotation_vector_from_quaternion(multiply(conjugate(start), end))
    return multiply(start, quaternion_from_rotation_vector(share[..., None] * vector))


def from_axes(forward: Float, left: Float, up: Float) -> Float:
    """Return rotations [T, 4] that take x, y, z to these orthonormal [T, 3] axes."""
    return quaternion_from_matrix(np.stack([forward, left, up], axis=-1))


def unit(vectors: Float) -> Float:
    """Scale vectors [..., 3] to length 1; NaN for zero."""
    length = np.sqrt(np.sum(vectors * vectors, axis=-1, keepdims=True))
    return np.asarray(vectors / np.where(length > 1e-9, length, np.nan), dtype=np.float64)


def between(one: Float, other: Float) -> Float:
    """Return the shortest rotation [4] from one direction [3] to another; about z where they are opposite."""
    one, other = one / np.sqrt(np.sum(one**2)), other / np.sqrt(np.sum(other**2))
    turned = np.array([*np.cross(one, other), 1.0 + float(np.sum(one * other))])
    length = float(np.sqrt(np.sum(turned**2)))
    if length < 1e-9:
        return np.array([0.0, 0.0, 1.0, 0.0])
    return turned / length
