"""The human body: its data, its shape as twelve numbers, its bones in any pose, and its surface.

Shape. A body of stature s has its vertices and joints at s (mean + sum of shape numbers times modes), in m
from the pelvis's joint. Four modes are the principal ones of MakeHuman's women and men of three builds; a
population has a standard deviation of 1 in each. Seven modes make a part of the body longer at the same
stature; 1 is the standard deviation among people of one stature (`PROPORTIONS`).

Pose. Every bone has a rotation world_from_bone relative to the neutral pose of `geometry.rig`, and the
pelvis's joint a place. A point that is fixed to bone b lies at root + s sum over bones R_b u_b: the steps
from joint to joint, each in the frame of its upper bone, and the point's own offset. This is linear in
rotation matrices and in the shape, which makes all derivatives short.

Skinning. The skinning does not collapse where joints bend far. Blending the transforms
of two bones that differ by an angle a pulls points halfway between them to cos(a/2) of their distance from
the joint: a knee bent by 120 degrees loses half its girth. At every joint a bone is added that turns half as
far as the joint bends. It takes over the weights that the two bones share, so that no two neighbours differ
by more than a/2 (after Mohr and Gleicher, "Building efficient, accurate character skins from examples",
SIGGRAPH 2003, which adds such joints). At 120 degrees a point keeps 0.87 of its distance from the joint. Each
added bone lies after the rig's, in the order of the bones below its joint. The root has none.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Index
from pipelines.geometry.compilation import cached
from pipelines.geometry.poses import conjugate, matrix_from_quaternion, multiply, quaternion_from_matrix
from pipelines.geometry.rig import BONE, BONES, PARENT, SIDES, unit

# Order of the arrays in `data/body.npz` (`python tools/body_asset.py` made it, and describes them).
SEXES = ("female", "male")
BUILDS = ("average", "slim", "heavy")
PARTS = ("skin", "lips", "brow", "white", "iris", "cloth")
# The asset stores places as whole tenths of a millimetre.
UNIT_M = 1e-4

_DATA = Path(__file__).parent / "data"

# Sex and build take four modes; the fifth moves a vertex by 2 mm.
_BUILT_MODES = 4
PROPORTIONS = {
    "thigh": 0.04,
    "shank": 0.04,
    "upper_arm": 0.03,
    "forearm": 0.035,
    "trunk": 0.03,
    "shoulders": 0.04,
    "foot": 0.035,
}
"""Standard deviations of the relative length of a part among people of one stature. Of ANSUR II (Gordon et
al. 2014, 6068 people): standard deviations of single lengths times sqrt(1 - r^2), with r the correlation of
length and stature; the sitting height varies by 1.4 % of the stature, which thigh and shank share."""
SHAPE = ("stature_m", *(f"build_{k + 1}" for k in range(_BUILT_MODES)), *PROPORTIONS)
"""Names of the shape numbers."""
MEAN_SHAPE = np.array([1.70, *np.zeros(len(SHAPE) - 1)])
"""The mean of adults."""
SHAPE_SIGMA = np.array([0.10, *np.ones(len(SHAPE) - 1)])
"""Standard deviations of adults. Of the stature it is that of both sexes at 19 years together in the growth
reference of the World Health Organization (2007): 1.765 +- 0.073 m and 1.632 +- 0.065 m."""

# Arms hang with this angle from the vertical in the neutral pose, as most bodies' do to clear their hips.
_LEAN_RAD = np.radians(8.0)


@cache
def body_asset() -> dict[str, NDArray[Any]]:
    """Load the arrays of the asset, by name."""
    with np.load(_DATA / "body.npz") as stored:
        return {name: stored[name] for name in stored.files}


def height_standing(vertices: Float, joint: Float) -> float:
    """Return the bare body's height with straight legs, m, of vertices [V, 3] and joints [22, 3] at rest."""
    thigh, shank, foot = (joint[BONE[f"left_{name}"]] for name in ("thigh", "shank", "foot"))
    leg = np.linalg.norm(shank - thigh) + np.linalg.norm(foot - shank)
    return float(vertices[:, 2].max() - thigh[2] + leg + foot[2])


def skin_weights() -> Float:
    """Return the weights [V, 22] of the asset's vertices on the bones; rows sum to 1."""
    asset = body_asset()
    weights = np.zeros((len(asset["bone"]), len(BONES)))
    np.put_along_axis(weights, asset["bone"].astype(np.int64), asset["weight"] / 65535.0, axis=1)
    return weights


@dataclass(frozen=True)
class BodyModel:
    """A body of any shape, relative to its stature, from the pelvis's joint; K = 11 modes."""

    vertex: Float  # [1 + K, V, 3] at rest: the mean and the modes
    joint: Float  # [1 + K, 22, 3] at rest
    quads: Index  # [Q, 4] counterclockwise seen from outside
    weights: Float  # [V, 22]
    neutral_from_rest: Float  # [22, 4] quaternions xyzw

    @cached_property
    def steps(self) -> Float:
        """Each joint's place relative to its parent's, neutral pose: [1 + K, 22, 3], zero for the root."""
        turn = matrix_from_quaternion(self.neutral_from_rest)
        steps = np.zeros_like(self.joint)
        for name, parent in PARENT.items():
            if parent is not None:
                along = self.joint[:, BONE[name]] - self.joint[:, BONE[parent]]
                steps[:, BONE[name]] = along @ turn[BONE[parent]].T
        return steps

    @cached_property
    def _bones_of_vertices(self) -> Skin:
        return make_skin(np.zeros((len(self.weights), 3)), self.weights)

    @property
    def moving_names(self) -> tuple[str, ...]:
        """Names of the moving bones: the rig's, then those that bend half as far."""
        return (*BONES, *(f"{BONES[bone]}_half" for bone in BELOW.tolist()))

    def skin(self, shape: Float) -> Skin:
        """Return the vertices at rest of a shape [12], with their weights on moving bones."""
        rest = shape[0] * np.tensordot(np.array([1.0, *shape[1:]]), self.vertex, 1)
        return Skin(rest, self._bones_of_vertices.bone, self._bones_of_vertices.weight)

    def hinges(self, shape: Float) -> Float:
        """Return the joint of each moving bone at rest: [M, 3] m."""
        joint: Float = shape[0] * np.tensordot(np.array([1.0, *shape[1:]]), self.joint, 1)
        return np.asarray(joint[HINGE], np.float64)

    def moving_bones(self, centre: Float, rotation: Float) -> tuple[Float, Float]:
        """Return world_from_rest quaternions [..., M, 4] and joints [..., M, 3] m of the moving bones."""
        return with_bones_between(multiply(rotation, self.neutral_from_rest)), centre[..., HINGE, :]

    def surface(self, shape: Float, root: Float, rotation: Float) -> Float:
        """Compute the vertices [V, 3] m of a shape [12] in one pose: root [3] m, rotation [22, 4]."""
        steps = shape[0] * np.tensordot(np.array([1.0, *shape[1:]]), self.steps, 1)
        joint = shape[0] * np.tensordot(np.array([1.0, *shape[1:]]), self.joint, 1)
        skinning = Skinning(joint, self.neutral_from_rest, steps)
        return self.skin(shape).moved(*skinning.transforms(root, rotation))

    def simplified(self, cell: float) -> tuple[Index, Index]:
        """Choose vertices [V'], one for each cell and bone (Rossignac 1993), and their triangles [F, 3]."""
        key = np.column_stack([np.floor(self.vertex[0] / cell), self.weights.argmax(axis=1)])
        _, first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)
        corners = group.ravel()[np.concatenate([self.quads[:, [0, 1, 2]], self.quads[:, [0, 2, 3]]])]
        ordered = np.sort(corners, axis=1)
        _, once = np.unique(ordered, axis=0, return_index=True)
        whole = np.asarray((np.diff(ordered, axis=1) > 0).all(axis=1))
        return first, corners[np.sort(once[whole[once]])]

    def reach(self, bones: Index, offset: Float) -> Float:
        """Express points fixed to bones [K], at `offset` [K, 3] statures from their joints, by every bone.

        Return [1 + K modes, K, 22, 3]: with the shape's shares, the vectors u of the module's formula.
        """
        found = np.zeros((len(self.joint), len(bones), len(BONES), 3))
        for k, bone in enumerate(np.asarray(bones).tolist()):
            found[0, k, bone] = offset[k]
            name = BONES[bone]
            while (parent := PARENT[name]) is not None:
                found[:, k, BONE[parent]] = self.steps[:, BONE[name]]
                name = parent
        return found

    @property
    def centres(self) -> Float:
        """Joints of the bones [22, 3] in the neutral pose from the pelvis, relative to the stature."""
        return np.asarray(self.reach(np.arange(len(BONES)), np.zeros((len(BONES), 3)))[0].sum(axis=1))

    def rotations(self, world_from_rest: Float) -> Float:
        """Return rotations [..., 22, 4] relative to this neutral pose, of bones turned so from rest."""
        return multiply(world_from_rest, conjugate(self.neutral_from_rest))


@cache
def body_model() -> BodyModel:
    """Return the body that is fitted: the skin of head and hands, and a suit over the rest of the skin."""
    asset = body_asset()
    weights = skin_weights()
    vertices, joints = _of_stature_one()
    built, modes = _principal(vertices, joints)
    count = len(weights)
    modes += [
        sigma * _longer(part, built[:count], built[count:], weights) for part, sigma in PROPORTIONS.items()
    ]
    whole = np.stack([built, *modes])
    bare = weights[:, [BONE["head"], BONE["neck"], *(BONE[f"{side}_hand"] for side in SIDES)]].sum(axis=1)
    shown = (asset["part"] == PARTS.index("cloth")) | (bare > 0.5)
    quads = asset["quads"][shown[asset["quads"]].all(axis=1)].astype(np.intp)
    used, corners = np.unique(quads, return_inverse=True)
    joint = whole[:, count:]
    turns = neutral_turns(joint[0], _LEAN_RAD)
    return BodyModel(whole[:, used], joint, corners.reshape(quads.shape), weights[used], turns)


def _of_stature_one() -> tuple[Float, Float]:
    """Return vertices [6, V, 3] and joints [6, 22, 3] of the asset's bodies, stature 1, from the pelvis."""
    asset = body_asset()
    vertices = UNIT_M * asset["vertices"].astype(np.float64)
    vertices[:, 1:] += vertices[:, :1]
    joints = UNIT_M * asset["joints"].astype(np.float64)
    vertices, joints = vertices.reshape(-1, *vertices.shape[2:]), joints.reshape(-1, *joints.shape[2:])
    height = np.array([height_standing(*body) for body in zip(vertices, joints, strict=True)])[:, None, None]
    pelvis = joints[:, :1]
    return (vertices - pelvis) / height, (joints - pelvis) / height


def _principal(vertices: Float, joints: Float) -> tuple[Float, list[Float]]:
    """Return mean and first modes [V + 22, 3] of bodies; a body of the sample has rms 1 in each mode."""
    bodies = np.concatenate([vertices, joints], axis=1)
    mean = bodies.mean(axis=0)
    _, size, modes = np.linalg.svd((bodies - mean).reshape(len(bodies), -1), full_matrices=False)
    scaled = modes * (size / np.sqrt(len(bodies)))[:, None]
    return mean, [mode.reshape(mean.shape) for mode in scaled[:_BUILT_MODES]]


def _longer(part: str, vertices: Float, joint: Float, weights: Float) -> Float:
    """Return the change [V + 22, 3] of a body whose part becomes longer by its own length, at one stature."""
    stretch = np.zeros((len(BONES), 3, 3))
    bones = {"trunk": ("spine", "back", "chest"), "shoulders": ("clavicle",), "foot": ("foot", "toes")}
    ends = {"thigh": "shank", "shank": "foot", "upper_arm": "forearm", "forearm": "hand"}
    for name in bones.get(part, (part,)):
        for side in ("",) if part == "trunk" else SIDES:
            bone = BONE[f"{side}_{name}" if side else name]
            axis = {"trunk": np.eye(3)[2], "shoulders": np.eye(3)[1], "foot": np.eye(3)[0]}.get(part)
            if axis is None:
                axis = joint[BONE[f"{side}_{ends[name]}"]] - joint[bone]
            axis = axis / np.linalg.norm(axis)
            stretch[bone] = np.outer(axis, axis)
    moved = np.zeros_like(joint)
    for name, parent in PARENT.items():
        if parent is not None:
            above = BONE[parent]
            moved[BONE[name]] = moved[above] + stretch[above] @ (joint[BONE[name]] - joint[above])
    # Of each bone moved + stretch (v - joint), weighted.
    fixed = weights @ (moved - (stretch @ joint[..., None])[..., 0])
    change = fixed + ((weights @ stretch.reshape(-1, 9)).reshape(-1, 3, 3) @ vertices[..., None])[..., 0]
    step = 1e-3
    grown = height_standing(vertices + step * change, joint + step * moved)
    # Heights are from the pelvis here, and the foot's own height stays.
    growth = (grown - height_standing(vertices, joint)) / step - moved[BONE["left_foot"], 2]
    return np.concatenate([change - growth * vertices, moved - growth * joint])


def shape_of(sex: str, build: str, stature_m: float) -> Float:
    """Return the shape numbers [12] of a simulated body: its nearest place in the principal modes."""
    vertices, joints = _of_stature_one()
    number = SEXES.index(sex) * len(BUILDS) + BUILDS.index(build)
    bodies = np.concatenate([vertices, joints], axis=1)
    mean, modes = _principal(vertices, joints)
    flat = np.stack(modes).reshape(_BUILT_MODES, -1)
    found = np.linalg.lstsq(flat.T, (bodies[number] - mean).ravel(), rcond=None)[0]
    return np.array([stature_m, *found, *np.zeros(len(PROPORTIONS))])


# --- skinning ------------------------------------------------------------------------------------------

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
        """Compute world from rest of moving bones (turns [..., M, 3, 3], shifts m) for a pelvis at `root`."""
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
    """Compute the turn [22, 4] xyzw of each bone from rest joints [22, 3] m, x forward, to neutral.

    Trunk and head stay, legs come down straight, arms with the hands forward of the elbows' bend and
    `lean_rad` from the vertical to clear the hips; so a knee or elbow bends about the axis from side to side.
    Feet point ahead, soles level.
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
        turns[bone("upper_arm")] = turned((upper, rest_axis), (down, axis))
        turns[bone("forearm")] = turns[bone("hand")] = turned((lower, rest_axis), (down, axis))

        left, straight = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0])
        turns[bone("thigh")] = turned((along("thigh", "shank"), left), (straight, left))
        turns[bone("shank")] = turned((along("shank", "foot"), left), (straight, left))
        ahead = along("foot", "toes") * [1.0, 1.0, 0.0]
        up = np.array([0.0, 0.0, 1.0])
        turns[bone("foot")] = turns[bone("toes")] = turned((ahead, up), (np.array([1.0, 0.0, 0.0]), up))
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


def turned(source: tuple[Float, Float], target: tuple[Float, Float]) -> Float:
    """Return rotations [..., 3, 3] that take the first source directions [..., 3] to the first targets."""
    turn: Float = np.einsum("...ik,...jk->...ij", _frame(*target), _frame(*source))
    return turn


def _frame(first: Float, second: Float) -> Float:
    """Return axes in columns: along the first, across both, and the third."""
    x = unit(first)
    z = unit(np.cross(x, second))
    return np.stack([x, np.cross(z, x), z], axis=-1)
