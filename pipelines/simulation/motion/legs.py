"""Limbs of two bones that reach a point, and the height of a pelvis whose legs reach the ground."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import conjugate, multiply, rotate
from pipelines.simulation.motion.feet import Foot
from pipelines.simulation.motion.turns import about, from_axes, unit
from pipelines.simulation.rig import BONE, SIDES, Rig

_HANGS_FREE_M = 0.02  # allowed height of the pelvis above the reach of a leg that does not carry
_STRETCHED_M = 0.002  # near a straight limb, its reach is softened over about this length


def two_bones(upper: Float, lower: Float, towards: Float, hinge: Float) -> tuple[Float, Float]:
    """Turn two bones so that the end of the second reaches a point; in closed form (law of cosines).

    The limb bends about `hinge`: a knee with the hinge to the left goes ahead, an elbow whose hinge points
    right goes back. The limb points at points out of reach.

    Args:
        upper: [3] m, the neutral vector from the first joint to the second.
        lower: [3] m, from the second joint to the end.
        towards: [T, 3] m, from the first joint to the wanted place of the end.
        hinge: [T, 3] any vector not along the limb; only its part across the limb counts.

    Returns:
        [T, 4] world rotations of the two bones, from neutral.
    """
    first, second = (float(np.sqrt(np.sum(bone**2))) for bone in (upper, lower))
    wanted = np.sqrt(np.sum(towards**2, axis=1))
    # Softly up to straight, so that the knee's speed stays bounded.
    spare = (first + second - wanted) / _STRETCHED_M
    reached = first + second - _STRETCHED_M * np.logaddexp(0.0, spare)
    reached = np.maximum(reached, abs(first - second) + 0.02)
    cosine = (first**2 + reached**2 - second**2) / (2 * first * reached)
    bent_up = np.arccos(np.clip(cosine, -1.0, 1.0))
    cosine = (first**2 + second**2 - reached**2) / (2 * first * second)
    bent = np.pi - np.arccos(np.clip(cosine, -1.0, 1.0))

    down = unit(towards)
    axis = unit(hinge - np.sum(hinge * down, axis=1, keepdims=True) * down)
    whole = from_axes(np.cross(axis, -down), axis, -down)
    one, other = (_from_neutral(bone) for bone in (upper, lower))
    above = multiply(whole, about(1, -bent_up))
    below = multiply(above, about(1, bent))
    return multiply(above, one), multiply(below, other)


def _from_neutral(bone: Float) -> Float:
    """Return the rotation [1, 4] of a bone's neutral direction straight down.

    The axis of the rotation is square to the bone and to y.
    """
    down = bone / np.sqrt(np.sum(bone**2))
    left = np.array([0.0, 1.0, 0.0]) - down[1] * down
    left /= np.sqrt(np.sum(left**2))
    neutral = from_axes(np.cross(left, -down)[None], left[None], -down[None])
    return conjugate(neutral)


def pelvis_height(
    rig: Rig,
    place: Float,
    pelvis: Float,
    feet: Sequence[Foot],
    wanted_m: Float,
    softness_m: Float,
) -> Float:
    """Return the wanted height, or as much of it as the carrying legs allow with their least knee flexion.

    Args:
        rig: the person's bones.
        place: [T, 2] m of the pelvis's joint.
        pelvis: [T, 4] its rotation.
        feet: left, right.
        wanted_m: [T] height in the world.
        softness_m: [T] distance of two of these bounds within which one blends into the other.

    Returns:
        [T] m, world.
    """
    height = wanted_m
    for foot, side in zip(feet, SIDES, strict=True):
        first, second = (_length(rig, f"{side}_{bone}") for bone in ("shank", "foot"))
        hip = rotate(pelvis, rig.offset[BONE[f"{side}_thigh"]])
        aside = np.sum((foot.ankle[:, :2] - place - hip[:, :2]) ** 2, axis=1)
        reach = first**2 + second**2 + 2 * first * second * np.cos(foot.least_knee)
        above = np.sqrt(np.maximum(reach - aside, 0.09 * reach))
        bound = (
            foot.ankle[:, 2] + above - hip[:, 2] + _HANGS_FREE_M * (1 - foot.carries) + 2 * foot.kicks * first
        )
        height = _lower(height, bound, softness_m)
    return height


def leg_rotations(rig: Rig, root: Float, pelvis: Float, feet: Sequence[Foot]) -> dict[str, Float]:
    """Compute rotations of thighs and shanks that end at the ankles; knees point as pelvis and foot do."""
    bones: dict[str, Float] = {}
    left = np.array([0.0, 1.0, 0.0])
    for foot, side in zip(feet, SIDES, strict=True):
        hip = root + rotate(pelvis, rig.offset[BONE[f"{side}_thigh"]])
        hinge = (1 - foot.kicks[:, None]) * rotate(pelvis, left) + rotate(foot.rotation, left)
        bones[f"{side}_thigh"], bones[f"{side}_shank"] = two_bones(
            rig.offset[BONE[f"{side}_shank"]], rig.offset[BONE[f"{side}_foot"]], foot.ankle - hip, hinge
        )
    return bones


def _length(rig: Rig, bone: str) -> float:
    return float(np.sqrt(np.sum(rig.offset[BONE[bone]] ** 2)))


def _lower(one: Float, other: Float, softness_m: Float) -> Float:
    """Return the smaller one, a parabola where they are within `softness_m`: never above either."""
    near = np.maximum(softness_m - np.abs(one - other), 0.0) / softness_m
    return np.asarray(np.minimum(one, other) - near**2 * softness_m / 4, dtype=np.float64)
