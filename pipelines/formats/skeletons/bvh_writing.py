"""The bvh export: a rig of constant bones that follows the skeleton, for Blender and MotionBuilder.

A bone has the median length over all times at which both its ends were measured. At rest the
body stands in a T: arms to the sides, legs down, facing +x with the left towards +y (in a y-up file +z and
+x). The rotations follow in closed form, bone by bone from the root:

- Hips are at the middle of the two hips. Their left axis is exactly the line between the hips. Their up axis
  is as near to the direction of the neck as that allows.
- Spine, at the same place, points exactly to the neck. Its left axis is as near to the line between
  the shoulders as that allows.
- Every other bone points from its joint to the next by the smallest turn from the direction its parent gives
  it. It has no twist of its own, because joint positions do not show any. A turn of 180 degrees is about the
  bone's own x, or y if the bone lies along x.

So each joint lies in its measured direction from the one before, at the rig's distance. The remaining
difference between rig and measurement is the variation of the measured lengths.

BVH cannot mark missing values. Times before the first and after the last known hips are left out. In between,
unknown hips keep their last position, and a bone with a missing end keeps its last
rotation against its parent (before the first, its first). All of this is counted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.formats.common.exporting import people_of
from pipelines.formats.skeletons.bvh import METRES
from pipelines.formats.skeletons.joint_files import at_even_times
from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.poses import (
    conjugate,
    matrix_from_quaternion,
    multiply,
    quaternion_from_matrix,
    rotate,
)
from pipelines.session.errors import DataError
from pipelines.session.people import take_joints, with_derived
from pipelines.session.records import JointMotion, Recording, SkeletalMotion

_IN_FILE = {"y-up": [1, 2, 0], "z-up": [0, 1, 2]}  # indices of the world's axes that are the file's x, y, z
# Four decimals of a degree and of a centimetre are below any measurement error.
_DECIMALS = 6
# Below this cosine of the middle angle the outer two turn about one axis (gimbal lock).
_LOCKED = 1e-7
_AHEAD_UP = (0.5, 0.0, np.sqrt(0.75))
_AHEAD_DOWN = (np.sqrt(0.75), 0.0, -0.5)
_LEFT, _RIGHT, _DOWN, _UP, _HERE = (0, 1, 0), (0, -1, 0), (0, 0, -1), (0, 0, 1), (0, 0, 0)
_MUST = ("left_hip", "right_hip", "neck")


class BvhExport:
    """Writer of `<name>.bvh`, or `<name>_<person>.bvh` for each of several people; default cm and y up.

    The module documents the fit of the rig and the handling of missing joints.
    """

    name = "bvh"
    title = "a rig of constant bones that follows the skeleton, for Blender"
    choices: Mapping[str, tuple[str, ...]] = {"unit": ("cm", "m", "mm", "inch"), "axes": ("y-up", "z-up")}

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write every person to whom a rig can be fitted; a note gives the reason for each other one."""
        motion, files = people_of(recording, folder, ".bvh")
        even = at_even_times("bvh", motion, recording.progress)
        written, refused = [], None
        for person, path in files.items():
            try:
                rigged = fit_rig(path.name, even.motion, person)
            except DataError as error:
                refused = error
                recording.progress.note(str(error))
                continue
            write_motion(path, rigged.motion, unit=recording.unit or "cm", axes=recording.axes or "y-up")
            recording.progress.note(_made_up(path.name, rigged, len(even.motion.t_ns)))
            written.append(path)
        if refused is not None and not written:
            raise refused
        return sorted(written)


def _made_up(name: str, rigged: Rigged, frames: int) -> str:
    """Report the parts of the file that were not measured."""
    kept = len(rigged.motion.t_s)
    parts = [f"{name}: BVH has no word for missing"]
    if frames > kept:
        parts.append(f"{frames - kept} of {frames} frames before and after the hips are seen were left out")
    parts.append(f"the hips stay where they were in {rigged.without_hips} of {kept} frames")
    parts.append(f"{rigged.turns_held} of {rigged.turns} turns of bones are held")
    return "; ".join(parts)


def write_motion(path: Path, motion: SkeletalMotion, *, unit: str, axes: str) -> None:
    """Write a motion at the constant rate of its first and last time; `bvh.read_motion` reads it back.

    The root has position and rotation channels, every other bone rotations in the order Z, X, Y (Rz Rx Ry),
    in degrees without jumps of 360. A bone without children ends in a site of length 0.
    """
    order = _IN_FILE[axes]
    scale = 1 / METRES[unit]
    frames = len(motion.t_s)
    step_s = float(motion.t_s[-1] - motion.t_s[0]) / (frames - 1) if frames > 1 else 1.0
    children: dict[int, list[int]] = {k: [] for k in range(-1, len(motion.bones))}
    for bone, parent in enumerate(motion.parent):
        children[parent].append(bone)
    lines, written = ["HIERARCHY"], []

    def write_bone(bone: int, depth: int) -> None:
        pad = "\t" * depth
        is_root = motion.parent[bone] < 0
        offset = np.zeros(3) if is_root else motion.offset[bone]
        position = "Xposition Yposition Zposition " if is_root else ""
        lines.extend(
            [
                f"{pad}{'ROOT' if is_root else 'JOINT'} {motion.bones[bone]}",
                f"{pad}{{",
                f"{pad}\tOFFSET {_numbers(offset[order] * scale)}",
                f"{pad}\tCHANNELS {6 if is_root else 3} {position}Zrotation Xrotation Yrotation",
            ]
        )
        written.append(bone)
        for child in children[bone]:
            write_bone(child, depth + 1)
        if not children[bone]:
            end = motion.end.get(bone, np.zeros(3))
            lines.extend(
                [f"{pad}\tEnd Site", f"{pad}\t{{", f"{pad}\t\tOFFSET {_numbers(end[order] * scale)}"]
            )
            lines.append(f"{pad}\t}}")
        lines.append(f"{pad}}}")

    (root,) = children[-1]
    write_bone(root, 0)
    angles = euler_zxy_deg(motion.rotation[:, written][..., [*order, 3]])
    channels = np.concatenate([motion.root[:, order] * scale, angles.reshape(frames, -1)], axis=1)
    lines.extend(["MOTION", f"Frames: {frames}", f"Frame Time: {step_s:.9f}"])
    lines.extend(_numbers(row) for row in channels)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def euler_zxy_deg(quaternion_xyzw: Float) -> Float:
    """Compute angles (z, x, y) in degrees of the rotation Rz Rx Ry, [T, B, 3]; continuous over time.

    From the product's entries: m21 = sin x, m01 = -sin z cos x, m11 = cos z cos x, m20 = -cos x sin y,
    m22 = cos x cos y. If x is +-90 degrees, z and y turn about the same axis, and y is set to 0.
    """
    m = matrix_from_quaternion(quaternion_xyzw)
    x = np.arctan2(m[..., 2, 1], np.hypot(m[..., 2, 0], m[..., 2, 2]))
    locked = np.hypot(m[..., 2, 0], m[..., 2, 2]) < _LOCKED
    z = np.where(locked, np.arctan2(m[..., 1, 0], m[..., 0, 0]), np.arctan2(-m[..., 0, 1], m[..., 1, 1]))
    y = np.where(locked, 0.0, np.arctan2(-m[..., 2, 0], m[..., 2, 2]))
    return np.degrees(np.unwrap(np.stack([z, x, y], axis=-1), axis=0))


def _numbers(values: Float) -> str:
    # Adding 0 turns -0 into 0.
    return " ".join(f"{value:.{_DECIMALS}f}" for value in (np.round(values, _DECIMALS) + 0.0).tolist())


@dataclass(frozen=True)
class _RigBone:
    """Bone as files name it, with its first joint, and that joint's direction at rest from its parent's."""

    name: str
    parent: str | None
    joint: str
    rest: tuple[float, float, float]


def _arm(side: str, out: tuple[float, float, float]) -> tuple[_RigBone, ...]:
    word = side.capitalize()
    return (
        _RigBone(f"{word}Shoulder", "Spine", "neck", _UP),
        _RigBone(f"{word}Arm", f"{word}Shoulder", f"{side}_shoulder", out),
        _RigBone(f"{word}ForeArm", f"{word}Arm", f"{side}_elbow", out),
        _RigBone(f"{word}Hand", f"{word}ForeArm", f"{side}_wrist", out),
    )


def _leg(side: str, out: tuple[float, float, float]) -> tuple[_RigBone, ...]:
    word = side.capitalize()
    return (
        _RigBone(f"{word}UpLeg", "Hips", f"{side}_hip", out),
        _RigBone(f"{word}Leg", f"{word}UpLeg", f"{side}_knee", _DOWN),
        _RigBone(f"{word}Foot", f"{word}Leg", f"{side}_ankle", _DOWN),
        _RigBone(f"{word}ToeBase", f"{word}Foot", f"{side}_big_toe", _AHEAD_DOWN),
    )


_TRUNK = (
    _RigBone("Hips", None, "hip", _HERE),
    _RigBone("Spine", "Hips", "hip", _HERE),
    _RigBone("Neck", "Spine", "neck", _UP),
)
_HEADS = (_RigBone("Head", "Neck", "head", _UP), _RigBone("Head", "Neck", "nose", _AHEAD_UP))
_LIMBS = (*_arm("left", _LEFT), *_arm("right", _RIGHT), *_leg("left", _LEFT), *_leg("right", _RIGHT))


@dataclass(frozen=True)
class Rigged:
    """Motion on a rig, with counts of the values that were filled in."""

    motion: SkeletalMotion
    joints: tuple[str, ...]  # the joint at which each bone begins
    first: int  # index of the first frame; those before it are left out
    without_hips: int  # frames in which the hips keep their last position
    turns_held: int  # rotations of bones that are kept from a frame before (or after)
    turns: int  # number of all rotations


def fit_rig(source: str, motion: JointMotion, person: int) -> Rigged:
    """Fit a rig to one person's joints at a constant rate; `source` is the name for messages."""
    joints, position = with_derived(motion.joints, motion.position[:, person])
    middle = take_joints(position, joints, ("left_hip", "right_hip")).mean(axis=1)
    place = {joint: position[:, k] for k, joint in enumerate(joints)} | {"hip": middle}
    seen = np.flatnonzero(np.isfinite(middle).all(axis=1))
    lacking = [joint for joint in _MUST if joint not in place]
    whole = not lacking and any(np.isfinite(place["neck"][seen]).all(axis=1))
    if not whole:
        lack = f"lacks {', '.join(lacking)}" if lacking else "never shows hips and neck at one time"
        raise DataError(source, f"{lack}: no rig can be fitted", "use a skeleton with hips and shoulders")
    span = slice(int(seen[0]), int(seen[-1]) + 1)
    place = {joint: points[span] for joint, points in place.items()}
    bones, lengths = _bones(place)
    index = {bone.name: k for k, bone in enumerate(bones)}
    parent = tuple(-1 if bone.parent is None else index[bone.parent] for bone in bones)
    offset = np.array([np.array(bone.rest) * length for bone, length in zip(bones, lengths, strict=True)])
    rotation, held = _turns(bones, parent, place)
    root, without_hips = _held(place["hip"])
    skeletal = SkeletalMotion(
        t_s=(motion.t_ns[span] - motion.t_ns[span][0]) / 1e9,
        bones=tuple(bone.name for bone in bones),
        parent=parent,
        offset=offset,
        end={},
        root=root,
        rotation=rotation,
    )
    return Rigged(skeletal, tuple(bone.joint for bone in bones), int(seen[0]), int(without_hips.sum()), *held)


def _bones(place: dict[str, Float]) -> tuple[list[_RigBone], list[float]]:
    """Choose the bones with known joints, parents first; return median distances from the parents' joints."""
    head = next((bone for bone in _HEADS if bone.joint in place), None)
    candidates = [*_TRUNK, *([head] if head else []), *_LIMBS]  # in the order in which files have them
    kept: dict[str, _RigBone] = {}
    lengths = []
    for bone in candidates:
        parent = kept.get(bone.parent or "")
        if bone.parent is not None and parent is None:
            continue  # its parent's joint is never known
        if bone.joint not in place:
            continue
        start = place[parent.joint] if parent is not None else place[bone.joint]
        length = np.linalg.norm(place[bone.joint] - start, axis=1)
        if np.isfinite(length).any():
            kept[bone.name] = bone
            lengths.append(float(np.median(length[np.isfinite(length)])))
    return list(kept.values()), lengths


def _turns(
    bones: list[_RigBone], parent: tuple[int, ...], place: dict[str, Float]
) -> tuple[Float, tuple[int, int]]:
    """Compute parent_from_bone [T, B, 4]; also count the rotations that are held, and all rotations."""
    frames = len(place["hip"])
    local, world = (np.zeros((frames, len(bones), 4)) for _ in range(2))
    held = turns = 0
    for k, bone in enumerate(bones):
        above = world[:, parent[k]] if parent[k] >= 0 else np.tile([0.0, 0.0, 0.0, 1.0], (frames, 1))
        next_ = next((b for b in bones if b.parent == bone.name and b.rest != _HERE), None)
        if bone.name == "Hips":
            known = multiply(
                conjugate(above), _frame(_between(place, "right_hip", "left_hip"), _spine(place))
            )
        elif bone.name == "Spine" and _has_shoulders(place):
            across = _between(place, "right_shoulder", "left_shoulder")
            known = multiply(conjugate(above), _frame(across, _spine(place), up_first=True))
        elif next_ is None:
            known = np.tile([0.0, 0.0, 0.0, 1.0], (frames, 1))
        else:
            aim = rotate(conjugate(above), place[next_.joint] - place[bone.joint])
            known = _swing(np.array(next_.rest, float), aim)
        local[:, k], missing = _held(known)
        world[:, k] = multiply(above, local[:, k])
        if next_ is not None:
            held += int(missing.sum())
            turns += frames
    return local, (held, turns)


def _has_shoulders(place: dict[str, Float]) -> bool:
    return {"left_shoulder", "right_shoulder"} <= place.keys()


def _between(place: dict[str, Float], start: str, end: str) -> Float:
    return place[end] - place[start]


def _spine(place: dict[str, Float]) -> Float:
    return _between(place, "hip", "neck")


def _frame(left: Float, up: Float, *, up_first: bool = False) -> Float:
    """Build world_from_bone [T, 4]: y along `left` and z near `up`, or z along `up` and y near `left`."""
    exact, near = (up, left) if up_first else (left, up)
    first = _unit(exact)
    second = _unit(near - (near * first).sum(axis=1, keepdims=True) * first)
    y, z = (second, first) if up_first else (first, second)
    matrix = np.stack([np.cross(y, z), y, z], axis=-1)
    known = np.isfinite(matrix).all(axis=(1, 2))
    turned = np.full((len(matrix), 4), np.nan)
    turned[known] = quaternion_from_matrix(matrix[known])
    return turned


def _swing(start: Float, towards: Float) -> Float:
    """Compute the smallest turns [T, 4] from the unit vector `start` [3] to the directions [T, 3]."""
    end = _unit(towards)
    turn = np.concatenate([np.cross(start, end), 1 + (end @ start)[:, None]], axis=1)
    size = np.linalg.norm(turn, axis=1, keepdims=True)
    x = np.array([1.0, 0.0, 0.0])
    about = _unit((x if abs(start[0]) < 0.9 else np.roll(x, 1))[None])[0]
    about = about - (about @ start) * start
    half_turn = np.append(about / np.linalg.norm(about), 0.0)
    return np.where(size < 1e-6, half_turn, turn / np.where(size < 1e-6, 1.0, size))


def _unit(vectors: Float) -> Float:
    """Scale vectors to length 1; NaN for the zero vector."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, np.nan)


def _held(rows: Float) -> tuple[Float, Bool]:
    """Replace missing rows [T, N] by the last known one; return the rows and the mask of missing ones."""
    missing = np.asarray(np.isnan(rows).any(axis=1), np.bool_)
    known = np.flatnonzero(~missing)
    if not len(known):  # a bone that is never known at a time together with its parent and child
        return np.tile(np.eye(rows.shape[1])[-1], (len(rows), 1)), missing
    last = np.maximum(np.searchsorted(known, np.arange(len(rows)), side="right") - 1, 0)
    return rows[known[last]], missing


EXPORT = BvhExport()
