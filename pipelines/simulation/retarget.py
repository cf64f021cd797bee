"""Recorded motion of a foreign skeleton, put on the actor's bones, matched by name and hierarchy."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import conjugate, multiply, rotate
from pipelines.geometry.rig import (
    BONE,
    BONES,
    SIDES,
    BodyMotion,
    Rig,
    about,
    between,
    joint_centres,
    partly,
    sole_points,
)
from pipelines.session.errors import DataError
from pipelines.session.records import SkeletalMotion
from pipelines.session.storage import own_table
from pipelines.simulation.motion_script import two_bones

_NAMES = own_table(__file__, "bones")
_ESSENTIAL_SIDED = ("thigh", "shank", "foot", "upper_arm", "forearm")
_LIMB_ABOVE = {"shank": "thigh", "foot": "shank", "forearm": "upper_arm"}


def match_bones(source: SkeletalMotion) -> dict[str, int]:
    """Find the bone of the source that moves as each of ours does. DataError: essential ones were not found.

    Names are compared without prefix (`mixamorig:`, `Bip01_`), case and separators; a side is `left`,
    `right`, or a lone `l` or `r` before or after. The trunk is the chain from the pelvis to the bone that
    both arms hang on; spine, back and chest are its first, middle and last bone. A part that the source lacks
    moves with its parent: toes with the foot, hands with the forearm, clavicles with the chest.
    """
    named: dict[tuple[str, str], int] = {}
    for index, name in enumerate(source.bones):
        named.setdefault(_parts_of(name), index)
    found: dict[str, int] = {}
    for ours, variants in _NAMES["in_the_middle"].items():
        _take(found, ours, [named.get(("", variant)) for variant in variants])
    if "pelvis" not in found and source.parent.count(-1) == 1:
        found["pelvis"] = source.parent.index(-1)
    for side in SIDES:
        for ours, variants in _NAMES["of_a_side"].items():
            free = [named.get((side, v)) for v in variants]
            _take(found, f"{side}_{ours}", [index for index in free if index not in found.values()])
    essential = ["pelvis", *(f"{side}_{bone}" for side in SIDES for bone in _ESSENTIAL_SIDED)]
    missing = [name for name in essential if name not in found]
    missing += [
        f"{side}_{below}"
        for side in SIDES
        for below, above in _LIMB_ABOVE.items()
        if not missing and found[f"{side}_{above}"] not in _above(source, found[f"{side}_{below}"])
    ]
    if missing:
        problem = f"found no {', '.join(missing)} among its bones {', '.join(source.bones)}"
        remedy = "name them as usual (LeftUpLeg, LeftLeg, LeftFoot, LeftArm, LeftForeArm, ...)"
        raise DataError("skeleton", problem, remedy)
    _trunk(source, found)
    for side in SIDES:
        found.setdefault(f"{side}_clavicle", found["chest"])
        found.setdefault(f"{side}_hand", found[f"{side}_forearm"])
        found.setdefault(f"{side}_toes", found[f"{side}_foot"])
    return found


def _parts_of(name: str) -> tuple[str, str]:
    """Split a name into its side (left, right or empty) and the rest."""
    bare = re.sub(r"^(bip\d*|character\d*|def)(?=[\W_])", "", name.rsplit(":", 1)[-1], flags=re.IGNORECASE)
    lower = [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", bare)]
    for position in (0, -1):
        for letter, side in (("l", "left"), ("r", "right")):
            if lower and lower[position] in (letter, side):
                del lower[position]
                return side, "".join(lower)
    joined = "".join(lower)
    for side in SIDES:
        if joined.startswith(side):
            return side, joined.removeprefix(side)
    return "", joined


def _take(found: dict[str, int], ours: str, candidates: list[int | None]) -> None:
    for index in candidates:
        if index is not None:
            found[ours] = index
            return


def _above(source: SkeletalMotion, bone: int) -> list[int]:
    """Return the bones that a bone hangs on, nearest first."""
    chain = []
    while (bone := source.parent[bone]) >= 0:
        chain.append(bone)
    return chain


def _trunk(source: SkeletalMotion, found: dict[str, int]) -> None:
    """Add spine, back and chest from the chain that both arms hang on; add neck and head if missing."""
    pelvis = found["pelvis"]
    both = [
        bone
        for bone in _above(source, found["left_upper_arm"])
        if bone in _above(source, found["right_upper_arm"])
    ]
    chain = [bone for bone in reversed(both) if pelvis in _above(source, bone)]
    first, middle, last = (chain[0], chain[len(chain) // 2], chain[-1]) if chain else (pelvis, pelvis, pelvis)
    found |= {"spine": first, "back": middle, "chest": last}
    found.setdefault("neck", last)
    found.setdefault("head", found["neck"])


_END_OF_LIMB = {"thigh": "shank", "shank": "foot", "upper_arm": "forearm", "forearm": "hand", "foot": "toes"}
# Feet that point down by less than this in the rest pose are meant to stand.
_FLAT_FOOT = np.radians(30.0)
# No person turns a joint by more than this in one frame.
_T_POSE_TURN = np.radians(20.0)
# Half a second blends the end of a repeated motion to its beginning without a jerk.
_SEAM_S = 0.5
# A foot that is slower than this stands on the ground.
_AT_REST_MPS = 0.3


def retarget(
    source: SkeletalMotion,
    rig: Rig,
    t_s: Float,
    *,
    ground: Callable[[Float], Float],
    start: Float,
    heading_deg: float,
    repeat: bool,
) -> BodyMotion:
    """Move our bones (`match_bones`) as those of a recording, over the ground's heights at places [N, 2].

    Bones are turned as the source's are from its upright rest pose, after the limbs of our neutral pose were
    laid along those of that rest pose: arms that hang along arms of a T-pose. The way of the pelvis is scaled
    by the length of the legs, begins at `start` [2] m and looks along `heading_deg`, counterclockwise from
    east. Heights are those of the recording over its floor, scaled. A foot below the ground is lifted, its
    knee bending. A single frame at the beginning from which the pose jumps (a T-pose for calibration) is left
    out. Beyond the recording's end the last pose is held, or with `repeat` it begins again there; its last
    half second is bent to the first pose. DataError: no bones of a person, or a leg of no length.
    """
    match = match_bones(source)
    source = _without_first_pose(source)
    rest = _rest_joints(source)
    leg = sum(float(np.linalg.norm(rig.offset[BONE[f"left_{bone}"]])) for bone in ("shank", "foot"))
    scale = leg / _source_leg_length(rest, match)
    laid = _laid_on(rig, rest, match)
    bones = [match[name] for name in BONES]

    def moved(at_s: Float, *, again: bool) -> BodyMotion:
        pose = _sampled(source, bones, laid, at_s, repeat=again)
        about_up = about(2, np.full(len(at_s), np.radians(heading_deg) - pose.heading))
        place = rotate(about_up, (pose.root - pose.first) * scale)
        root = np.concatenate([place[:, :2] + start, pose.root[:, 2:] * scale], axis=1)
        return BodyMotion(at_s, root, multiply(about_up[:, None], pose.rotation))

    floor_m = _floor(rig, moved(source.t_s, again=False))
    return _on_ground(rig, moved(t_s, again=repeat), floor_m, ground)


def _without_first_pose(source: SkeletalMotion) -> SkeletalMotion:
    if len(source.t_s) < 3:
        return source
    turned = [_angle(source.rotation[i], source.rotation[i + 1]).max() for i in (0, 1)]
    if turned[0] < _T_POSE_TURN or turned[0] < 5 * turned[1]:
        return source
    later = {"t_s": source.t_s[1:] - source.t_s[1], "root": source.root[1:], "rotation": source.rotation[1:]}
    return replace(source, **later)


def _angle(one: Float, other: Float) -> Float:
    """Compute the angles [B] rad between rotations."""
    relative = multiply(conjugate(one), other)
    return np.asarray(
        2 * np.arctan2(np.sqrt(np.sum(relative[..., :3] ** 2, axis=-1)), np.abs(relative[..., 3])),
        dtype=np.float64,
    )


def _rest_joints(source: SkeletalMotion) -> Float:
    """Compute the joints [B, 3] m in the rest pose."""
    joints = np.zeros((len(source.bones), 3))
    for bone, parent in enumerate(source.parent):
        if parent >= 0:
            joints[bone] = joints[parent] + source.offset[bone]
    return joints


def _source_leg_length(rest: Float, match: dict[str, int]) -> float:
    legs = [
        float(np.linalg.norm(rest[match[f"{side}_{lower}"]] - rest[match[f"{side}_{upper}"]]))
        for side in SIDES
        for upper, lower in (("thigh", "shank"), ("shank", "foot"))
    ]
    if min(legs) <= 0:
        raise DataError("skeleton", "a thigh or a shank has no length", "give its bones their offsets")
    return sum(legs) / 2


def _laid_on(rig: Rig, rest: Float, match: dict[str, int]) -> Float:
    """Compute the rotations [B, 4] of our bones in the pose of the source's rest pose."""
    across = rest[match["left_thigh"]] - rest[match["right_thigh"]]
    facing = about(2, np.array([np.arctan2(-across[0], across[1])]))[0]
    laid = np.broadcast_to(facing, (len(BONES), 4)).copy()
    for side in SIDES:
        for bone, end in _END_OF_LIMB.items():
            name, below = f"{side}_{bone}", f"{side}_{end}"
            theirs = rest[match[below]] - rest[match[name]]
            if float(np.linalg.norm(theirs)) <= 0:
                continue  # the source ends here: the bone moves with its parent
            ours = rotate(facing, rig.offset[BONE[below]])
            if bone == "foot":
                falls = [np.arctan2(-v[2], np.hypot(v[0], v[1])) for v in (ours, theirs)]
                if abs(falls[1] - falls[0]) < _FLAT_FOOT:
                    theirs = np.array(
                        [theirs[0], theirs[1], ours[2] / np.hypot(*ours[:2]) * np.hypot(*theirs[:2])]
                    )
            laid[BONE[name]] = multiply(between(ours, theirs), facing)
        for bone, above in (("hand", "forearm"), ("toes", "foot")):
            laid[BONE[f"{side}_{bone}"]] = laid[BONE[f"{side}_{above}"]]
    return laid


@dataclass(frozen=True)
class _Pose:
    root: Float  # [T, 3] m, of the source
    rotation: Float  # [T, B, 4] of our bones
    first: Float  # [3] m, first place of the root
    heading: float  # rad, heading of the first pose


def _sampled(source: SkeletalMotion, bones: list[int], laid: Float, t_s: Float, *, repeat: bool) -> _Pose:
    """Interpolate poses at the given times; each round of a repeated motion begins at the end of the last."""
    world = np.empty_like(source.rotation)
    for bone, parent in enumerate(source.parent):
        own = source.rotation[:, bone]
        world[:, bone] = own if parent < 0 else multiply(world[:, parent], own)
    rotation = multiply(world[:, bones], laid)
    heading = [_heading(rotation[i, BONE["pelvis"]]) for i in (0, -1)]
    root, first = source.root, source.root[0]
    duration_s = float(source.t_s[-1])
    since = np.clip(t_s, 0.0, duration_s)
    rounds = np.zeros(len(t_s), dtype=np.int64)
    if repeat and duration_s > 0:
        seam_s = min(_SEAM_S, duration_s / 2)
        seam = np.clip((source.t_s - (duration_s - seam_s)) / seam_s, 0.0, 1.0)
        share = seam * seam * (3 - 2 * seam)
        again = multiply(about(2, np.array([heading[1] - heading[0]])), rotation[0])
        rotation = partly(rotation, np.broadcast_to(again, rotation.shape), share[:, None])
        root = root.copy()
        root[:, 2] += share * (root[0, 2] - root[-1, 2])
        rounds = np.floor(np.maximum(t_s, 0.0) / duration_s).astype(np.int64)
        since = np.maximum(t_s, 0.0) - rounds * duration_s
    after = np.clip(np.searchsorted(source.t_s, since, side="right"), 1, max(len(source.t_s) - 1, 1))
    after = np.minimum(after, len(source.t_s) - 1)
    before = np.maximum(after - 1, 0)
    step = np.where(after > before, source.t_s[after] - source.t_s[before], 1.0)
    share = np.clip((since - source.t_s[before]) / step, 0.0, 1.0)
    at = root[before] + share[:, None] * (root[after] - root[before])
    turned = partly(rotation[before], rotation[after], share[:, None])
    if rounds.any():
        at, turned = _rounds(at, turned, rounds, root[-1] - first, first, heading[1] - heading[0])
    return _Pose(at, turned, first, heading[0])


def _rounds(
    at: Float, turned: Float, rounds: NDArray[np.int64], moved: Float, first: Float, turn: float
) -> tuple[Float, Float]:
    """Turn and move the poses of later rounds on from the last."""
    at, turned = at.copy(), turned.copy()
    start = first.copy()
    for number in range(int(rounds.max()) + 1):
        now = rounds == number
        by = about(2, np.array([number * turn]))[0]
        at[now, :2] = (rotate(by, (at[now] - first) * [1.0, 1.0, 0.0]) + start)[:, :2]
        turned[now] = multiply(by, turned[now])
        start = start + rotate(by, moved * [1.0, 1.0, 0.0])
    return at, turned


def _heading(rotation: Float) -> float:
    ahead = rotate(rotation, np.array([1.0, 0.0, 0.0]))
    return float(np.arctan2(ahead[1], ahead[0]))


def _floor(rig: Rig, motion: BodyMotion) -> float:
    """Estimate the height of the recording's own floor, m: that of its lower foot while it is at rest."""
    points = sole_points(rig, motion).reshape(len(motion.t_s), -1, 3)
    which = points[..., 2].argmin(axis=1)
    lowest = points[np.arange(len(points)), which]
    if len(points) < 2:
        return float(lowest[0, 2])
    speed = np.sqrt(np.sum(np.asarray(np.gradient(points, motion.t_s, axis=0)) ** 2, axis=2))
    at_rest = speed[np.arange(len(points)), which] < _AT_REST_MPS
    return float(np.median(lowest[at_rest, 2]) if at_rest.any() else lowest[:, 2].min())


def _on_ground(rig: Rig, motion: BodyMotion, floor_m: float, ground: Callable[[Float], Float]) -> BodyMotion:
    """Stand the motion on the ground: the pelvis follows it, and each leg brings its foot over it."""
    root = motion.root.copy()
    root[:, 2] += ground(root[:, :2]) - floor_m
    motion = BodyMotion(motion.t_s, root, motion.rotation)

    below = sole_points(rig, motion)
    centres = joint_centres(rig, motion)
    rotation = motion.rotation.copy()
    left = np.array([0.0, 1.0, 0.0])
    for index, side in enumerate(SIDES):
        thigh, shank, foot = (BONE[f"{side}_{bone}"] for bone in ("thigh", "shank", "foot"))
        heights = np.stack([ground(below[:, index, point, :2]) for point in range(3)], axis=1)
        # As high over the ground under the foot as it was over that under the pelvis, and not below it.
        ankle = centres[:, foot].copy()
        under = ground(ankle[:, :2])
        ankle[:, 2] += under - ground(root[:, :2])
        clear = (below[:, index, :, 2] + (under - ground(root[:, :2]))[:, None] - heights).min(axis=1)
        ankle[:, 2] += np.maximum(-clear, 0.0)
        hinge = rotate(rotation[:, thigh], left) + rotate(rotation[:, shank], left)
        rotation[:, thigh], rotation[:, shank] = two_bones(
            rig.offset[shank], rig.offset[foot], ankle - centres[:, thigh], hinge
        )
    return BodyMotion(motion.t_s, root, rotation)
