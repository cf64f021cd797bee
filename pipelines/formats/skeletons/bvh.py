"""Biovision's BVH: a skeleton of bones, then one line of channels per frame; reader, and export of a rig.

Layout (Meredith & Maddock, "Motion Capture File Formats Explained", 2001): `HIERARCHY`, then `ROOT`, `JOINT`
and `End Site` blocks in braces, each with its `OFFSET` from the parent and its `CHANNELS`; `MOTION`,
`Frames:`, `Frame Time:`, then the channels of all bones. Rotations are degrees in the order in which they
stand: `Zrotation Yrotation Xrotation` is Rz Ry Rx. Position channels replace the bone's offset, except if
they are zero throughout. The file states neither unit nor axes. A y-up file's (x, y, z) becomes the world's
(z, x, y).

The export is the rig of the person's body, at rest upright with hanging arms: its centres of joints were a
third nearer to the true ones than landmarks on the tuning flights, and it shows how limbs twist.

BVH cannot mark missing values. Times before the first and after the last known body are left out; in between
it keeps its last pose. Both are counted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipelines.formats.common.exporting import bodies_of, people_of
from pipelines.formats.common.files import read_head
from pipelines.formats.skeletons.joint_files import BONE_NAMES, at_even_times, bone_joints, describe_motion
from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.poses import conjugate, interpolate_poses, matrix_from_quaternion, multiply, rotate
from pipelines.geometry.rig import BONE, BONES, PARENT
from pipelines.session.errors import DataError
from pipelines.session.records import JointMotion, MovingBody, Recording, SkeletalMotion
from pipelines.session.storage import bad_value, damaged, empty, read_text

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
_CMU_M = 0.0254 / 0.45
"""Unit of the CMU database's skeletons, and of the BVH files made of them."""
_TALLEST_M, _SMALLEST_M = 2.3, 1.2  # rest poses of adults, from the toes to the top of the head
AXES = ("y-up", "z-up")

# No body has so many bones, so more is damage.
_MOST_BONES = 5000
# No angle or place in a file's unit is larger, so more is damage.
_LARGEST = 1e9
# A motion has several frames a minute, so a longer step is damage.
_LONGEST_S = 3600
# Between poses of a body that are further apart nothing is interpolated.
_LONGEST_GAP_NS = 200_000_000
# Frames of slow recordings are further apart, and so are poses by up to so many frames.
_LONGEST_STEP = 1.5
_MOST_STRETCH_M = 0.05
"""Largest movement of a bone against its parent, either way, for which its mean position is used."""

_EXPORT_AGAIN = "export it again"
_IN_WORLD = {"y-up": [2, 0, 1], "z-up": [0, 1, 2]}  # indices of the file's axes that are the world's x, y, z


@dataclass
class _FileBone:
    name: str
    parent: int
    offset: Float  # [3], the file's unit and axes
    channels: list[str] = field(default_factory=list)  # xposition, zrotation, ...
    first_channel: int = 0
    end: Float | None = None


class BvhFormat:
    """Reader of the joints at which bones begin, by our names where known (LeftUpLeg is left_hip)."""

    name = "bvh"
    title = "Biovision motion (BVH)"
    suffixes: tuple[str, ...] = (".bvh",)

    def recognises(self, path: Path) -> bool:
        """Return True if the file begins with HIERARCHY and ROOT."""
        return read_head(path, self.suffixes).split(maxsplit=2)[:2] == ["HIERARCHY", "ROOT"]

    def describe(self, path: Path) -> dict[str, object]:
        """Describe joints, frames and the box as if in metres."""
        return describe_motion(self.read_joints(path, unit="m", axes=None))

    def read_joints(self, path: Path, *, unit: str | None, axes: str | None) -> JointMotion:
        """Read every frame, y up unless stated, in the unit that makes the rest pose an adult."""
        bones, frame_time_s, values = _read(path)
        axes = axes or "y-up"
        metres = {**METRES, "ft": 0.3048}[unit] if unit else _likely_unit(path, bones, axes)
        joints: list[Float] = []
        turned: list[Float] = []
        for bone in bones:
            place, _ = _bone_places(bone, values)
            own = _rotation(bone, values)
            if bone.parent >= 0:
                place = joints[bone.parent] + rotate(turned[bone.parent], place)
                own = multiply(turned[bone.parent], own)
            joints.append(place)
            turned.append(own)
        position = np.stack(joints, axis=1)[..., _IN_WORLD[axes]] * metres
        t_ns = np.rint(np.arange(len(position)) * (frame_time_s * 1e9)).astype(np.int64)
        return JointMotion(t_ns, bone_joints(tuple(bone.name for bone in bones)), position[:, None])


def _likely_unit(path: Path, bones: list[_FileBone], axes: str) -> float:
    """Return the length in m of the unit in which the rest pose is as tall as an adult."""
    up = _IN_WORLD[axes][2]
    places = _rest_places(bones)
    tall = float(np.ptp(places, axis=0).max() if not np.ptp(places, axis=0)[up] else np.ptp(places[:, up]))
    for metres in (*METRES.values(), _CMU_M):
        if _SMALLEST_M <= tall * metres <= _TALLEST_M:
            return metres
    problem = f"states no unit, and its rest pose of {tall:.3g} is an adult's in none"
    raise DataError(path, problem, "say truth: {file: FILE, unit: cm}", code="unit-unknown")


def read_motion(path: Path, *, unit: str, axes: str) -> SkeletalMotion:
    """Read a BVH file as metres with z up; `unit` is m, cm, mm or inch, `axes` y-up or z-up.

    Bones above the first moving one, each with a single child (a scene root), are merged into it. A bone
    further down with moving position channels is put at their mean, if it is never further than 5 cm from it.
    """
    bones, frame_time_s, values = _read(path)
    metres, order = METRES[unit], _IN_WORLD[axes]
    turned = [*order, 3]  # a rotation's axis is turned like any other vector
    places, rotations = [], []
    for bone in bones:
        place, moves = _bone_places(bone, values)
        places.append((place[:, order] * metres, moves))
        rotations.append(_rotation(bone, values)[:, turned])
    first = _carriers(bones, [moves for _, moves in places])
    root, root_rotation = places[0][0], rotations[0]
    for k in range(1, first + 1):
        root = root + rotate(root_rotation, places[k][0])
        root_rotation = multiply(root_rotation, rotations[k])
    rotations[first] = root_rotation
    kept = bones[first:]
    offsets = [np.zeros(3)]
    offsets += [
        _fixed_place(path, bone, place)
        for bone, (place, _) in zip(kept[1:], places[first + 1 :], strict=True)
    ]
    ends = {k: bone.end[order] * metres for k, bone in enumerate(kept) if bone.end is not None}
    return SkeletalMotion(
        t_s=np.arange(len(values), dtype=np.float64) * frame_time_s,
        bones=tuple(bone.name for bone in kept),
        parent=tuple(max(bone.parent - first, -1) for bone in kept),
        offset=np.array(offsets),
        end=ends,
        root=root,
        rotation=np.stack(rotations[first:], axis=1),
    )


# --- from channels to motion ---------------------------------------------------------------------------


def _bone_places(bone: _FileBone, values: Float) -> tuple[Float, bool]:
    """Return a bone's joint in its parent's frame [T, 3] in the file's unit, and True if it moves there."""
    place = np.tile(bone.offset, (len(values), 1))
    columns = {
        "xyz".index(channel[0]): bone.first_channel + k
        for k, channel in enumerate(bone.channels)
        if channel.endswith("position")
    }
    stated = values[:, list(columns.values())]
    if not stated.any():
        return place, False
    place[:, list(columns)] = stated
    return place, bool(np.ptp(place, axis=0).any())


def _rotation(bone: _FileBone, values: Float) -> Float:
    """Compute parent_from_bone [T, 4] in the file's axes: the product of the channels' turns."""
    total = np.tile([0.0, 0.0, 0.0, 1.0], (len(values), 1))
    for k, channel in enumerate(bone.channels):
        if channel.endswith("rotation"):
            half = np.radians(values[:, bone.first_channel + k]) / 2
            turn = np.zeros((len(values), 4))
            turn[:, "xyz".index(channel[0])] = np.sin(half)
            turn[:, 3] = np.cos(half)
            total = multiply(total, turn)
    return total


def _carriers(bones: list[_FileBone], moves: list[bool]) -> int:
    """Count the bones above the body that only carry it: each has one child, which moves against it."""
    count = 0
    while sum(bone.parent == count for bone in bones) == 1 and bones[count].end is None and moves[count + 1]:
        count += 1
    return count


def _fixed_place(path: Path, bone: _FileBone, place: Float) -> Float:
    middle: Float = place.mean(axis=0)
    stretch_m = float(np.abs(place - middle).max())
    if stretch_m > _MOST_STRETCH_M:
        problem = f"the bone {bone.name} moves by up to {stretch_m:.3g} m against its parent"
        remedy = "state the unit that the file is in, or export it with bones of fixed lengths"
        raise DataError(path, problem, remedy)
    return place[0] if stretch_m == 0 else middle


def _rest_places(bones: list[_FileBone]) -> Float:
    """Return joints and end sites of the rest pose [N, 3]."""
    places: list[Float] = []
    ends = []
    for bone in bones:
        places.append(bone.offset + (places[bone.parent] if bone.parent >= 0 else 0))
        if bone.end is not None:
            ends.append(places[-1] + bone.end)
    return np.array(places + ends)


# --- from text to channels -----------------------------------------------------------------------------

_CHANNELS = tuple(f"{axis}{kind}" for kind in ("position", "rotation") for axis in "xyz")


def _read(path: Path) -> tuple[list[_FileBone], float, Float]:
    """Return the bones, the time of a frame (s), and the values [T, C] of all channels."""
    text = read_text(path)
    head, marker, tail = text.partition("\nMOTION")
    if not head.lstrip().startswith("HIERARCHY"):
        raise DataError(path, "is no BVH file", "its first word must be HIERARCHY", code="wrong-kind")
    if not marker:
        raise damaged(path, "ends before its line MOTION")
    bones = _bones(path, head.replace("{", " { ").replace("}", " } ").split()[1:])
    lines = tail.split("\n", maxsplit=3) + [""] * 3
    frames, frame_time_s = _stated(path, lines[1], "Frames:"), _stated(path, lines[2], "Frame Time:")
    if not 0 < frame_time_s <= _LONGEST_S:
        raise bad_value(path, f"states a frame time of {frame_time_s:g} s")
    values = _numbers(path, lines[3], sum(len(bone.channels) for bone in bones), head.count("\n") + 5)
    if len(values) != frames:
        problem = f"states {frames:g} frames but holds {len(values)}"
        remedy = _EXPORT_AGAIN if len(values) < frames else "correct the line `Frames:`"
        raise DataError(path, problem, remedy, code="damaged")
    return bones, frame_time_s, values


def _bones(path: Path, words: list[str]) -> list[_FileBone]:
    bones: list[_FileBone] = []
    above: list[int | None] = []  # the open blocks: bones, and None for an end site
    coming = iter(words)
    for word in coming:
        match word.upper():
            case "ROOT" | "JOINT" | "END" as kind:
                name = " ".join(iter(lambda: next(coming, "{"), "{"))
                if kind == "END":
                    above.append(None)
                    continue
                if not name or bool(above) != (kind == "JOINT") or (above and above[-1] is None):
                    raise damaged(path, f"the bone {name[:40]!r} has no place there")
                if name in {bone.name for bone in bones} or len(bones) == _MOST_BONES:
                    raise damaged(path, f"a second bone is called {name[:40]!r}, or there are too many")
                first = bones[-1].first_channel + len(bones[-1].channels) if bones else 0
                parent = above[-1] if above else None
                bones.append(_FileBone(name, -1 if parent is None else parent, np.zeros(3), [], first))
                above.append(len(bones) - 1)
            case "}" if above:
                above.pop()
            case "OFFSET" if above and bones:
                offset = _offset(path, [next(coming, "") for _ in range(3)])
                if (inner := above[-1]) is not None:
                    bones[inner].offset = offset
                else:
                    bones[-1].end = offset
            case "CHANNELS" if above and above[-1] == len(bones) - 1 and not bones[-1].channels:
                count = next(coming, "")
                several = int(count) if count.isdecimal() and len(count) < 3 else 0
                named = [next(coming, "").lower() for _ in range(several)]
                places = [channel for channel in named if channel.endswith("position")]
                if not named or set(named) - {*_CHANNELS} or len(set(places)) < len(places):
                    raise damaged(path, f"CHANNELS {count} {' '.join(named)[:60]} make no sense")
                bones[-1].channels = named
            case _:
                raise damaged(path, f"{word[:60]!r} has no place in its hierarchy")
    if above or not bones or any(bone.parent < 0 for bone in bones[1:]):
        raise damaged(path, "its hierarchy lacks a brace, a root or all bones")
    return bones


def _offset(path: Path, words: list[str]) -> Float:
    try:
        offset = np.array([float(word) for word in words])
    except ValueError:
        offset = np.full(3, np.nan)
    if not (np.abs(offset) < _LARGEST).all():
        raise damaged(path, f"OFFSET {' '.join(words)[:60]} is no place")
    return offset


def _stated(path: Path, line: str, key: str) -> float:
    """Return the number after `Frames:` or `Frame Time:`."""
    words = line.lower().split(key.lower())
    try:
        return float(words[1]) if len(words) == 2 and not words[0].strip() else float("none")
    except ValueError:
        raise bad_value(path, f"has {line.strip()[:60]!r} where `{key}` and a number belong") from None


def _numbers(path: Path, body: str, channels: int, first_line: int) -> Float:
    if not channels or not body.strip():
        raise empty(path, "holds no frames or no channels")
    rows: list[Float] = []
    for number, line in enumerate(body.split("\n"), start=first_line):
        if words := line.split():
            try:
                row = np.array(words, dtype=np.float64)
            except ValueError:
                row = np.full(channels, np.nan)
            if len(row) != channels or not (np.abs(row) < _LARGEST).all():
                raise damaged(path, f"line {number} does not hold {channels} numbers below {_LARGEST:g}")
            rows.append(row)
    return np.array(rows)


FORMAT = BvhFormat()


# --- writing -------------------------------------------------------------------------------------------

_IN_FILE = {"y-up": [1, 2, 0], "z-up": [0, 1, 2]}  # indices of the world's axes that are the file's x, y, z
# Four decimals of a degree and of a centimetre are below any measurement error.
_DECIMALS = 6
# Below this cosine of the middle angle the outer two turn about one axis (gimbal lock).
_LOCKED = 1e-7


class BvhExport:
    """Writer of `<name>.bvh`, or `<name>_<person>.bvh` for each of several; by default cm and y up."""

    name = "bvh"
    title = "the rig of each person's body, bones of constant length, for Blender"
    choices: Mapping[str, tuple[str, ...]] = {"unit": ("cm", "m", "mm", "inch"), "axes": ("y-up", "z-up")}

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write every person who has a body; a note says what was left out or held."""
        motion, files = people_of(recording, folder, ".bvh")
        bodies = [body for body in bodies_of(recording, self.name)[1] if body.person in files]
        t_ns = at_even_times("bvh", motion, recording.progress).motion.t_ns
        for body in bodies:
            path = files[body.person]
            rig, held = rig_of_body(body, t_ns)
            write_motion(path, rig, unit=recording.unit or "cm", axes=recording.axes or "y-up")
            frames = len(rig.t_s)
            recording.progress.note(
                f"{path.name}: {len(t_ns) - frames} of {len(t_ns)} frames before and after the body is known"
                f" were left out; it keeps its last pose in {held} of {frames} frames"
            )
        return sorted(files[body.person] for body in bodies)


def write_motion(path: Path, motion: SkeletalMotion, *, unit: str, axes: str) -> None:
    """Write a motion at the constant rate of its first and last time; `read_motion` reads it back."""
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
                f"{pad}\tOFFSET {_as_text(offset[order] * scale)}",
                f"{pad}\tCHANNELS {6 if is_root else 3} {position}Zrotation Xrotation Yrotation",
            ]
        )
        written.append(bone)
        for child in children[bone]:
            write_bone(child, depth + 1)
        if not children[bone]:
            end = motion.end.get(bone, np.zeros(3))
            lines.extend(
                [f"{pad}\tEnd Site", f"{pad}\t{{", f"{pad}\t\tOFFSET {_as_text(end[order] * scale)}"]
            )
            lines.append(f"{pad}\t}}")
        lines.append(f"{pad}}}")

    (root,) = children[-1]
    write_bone(root, 0)
    angles = euler_zxy_deg(motion.rotation[:, written][..., [*order, 3]])
    channels = np.concatenate([motion.root[:, order] * scale, angles.reshape(frames, -1)], axis=1)
    lines.extend(["MOTION", f"Frames: {frames}", f"Frame Time: {step_s:.9f}"])
    lines.extend(_as_text(row) for row in channels)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def euler_zxy_deg(quaternion_xyzw: Float) -> Float:
    """Compute continuous angles (z, x, y), deg, of Rz Rx Ry, [T, B, 3]; y is 0 where x is +-90 degrees."""
    m = matrix_from_quaternion(quaternion_xyzw)
    x = np.arctan2(m[..., 2, 1], np.hypot(m[..., 2, 0], m[..., 2, 2]))
    locked = np.hypot(m[..., 2, 0], m[..., 2, 2]) < _LOCKED
    z = np.where(locked, np.arctan2(m[..., 1, 0], m[..., 0, 0]), np.arctan2(-m[..., 0, 1], m[..., 1, 1]))
    y = np.where(locked, 0.0, np.arctan2(-m[..., 2, 0], m[..., 2, 2]))
    return np.degrees(np.unwrap(np.stack([z, x, y], axis=-1), axis=0))


def _as_text(values: Float) -> str:
    # Adding 0 turns -0 into 0.
    return " ".join(f"{value:.{_DECIMALS}f}" for value in (np.round(values, _DECIMALS) + 0.0).tolist())


def rig_of_body(body: MovingBody, t_ns: Int64) -> tuple[SkeletalMotion, int]:
    """Take a body, known at one of the times [T], as a rig from its first to its last; count held frames."""
    step_ns = int(np.diff(t_ns).max(initial=0))
    limits = {
        "max_gap_ns": max(_LONGEST_GAP_NS, round(_LONGEST_STEP * step_ns)),
        "max_extrapolation_ns": step_ns // 2 + 1,  # some frame is so near to any pose
    }
    moved = [
        interpolate_poses(body.t_ns, body.centre[:, bone], body.rotation[:, bone], t_ns, **limits)
        for bone in range(len(BONES))
    ]
    (seen,) = np.nonzero(np.isfinite(moved[0][0][:, 0]))
    span = slice(int(seen[0]), int(seen[-1]) + 1)
    centre, missing = _held(np.hstack([place[span] for place, _ in moved]))
    world, _ = _held(np.hstack([turn[span] for _, turn in moved]))
    centre, world = (values.reshape(len(values), len(BONES), -1) for values in (centre, world))
    parent = tuple(-1 if above is None else BONE[above] for above in PARENT.values())
    above = conjugate(world[:, parent])
    above[:, 0] = [0.0, 0.0, 0.0, 1.0]
    kinds = [name.removeprefix("left_").removeprefix("right_") for name in BONES]
    skeletal = SkeletalMotion(
        t_s=(t_ns[span] - t_ns[span][0]) / 1e9,
        bones=tuple(
            name.removesuffix(kind).rstrip("_").capitalize() + BONE_NAMES["of_body"][kind]
            for name, kind in zip(BONES, kinds, strict=True)
        ),
        parent=parent,
        offset=np.median(rotate(above, centre - centre[:, parent]), axis=0),
        end={},
        root=centre[:, 0],
        rotation=multiply(above, world),
    )
    return skeletal, int(missing.sum())


def _held(rows: Float) -> tuple[Float, Bool]:
    """Replace missing rows [T, N] by the last known one; return the rows and the mask of missing ones."""
    missing = np.asarray(np.isnan(rows).any(axis=1), np.bool_)
    known = np.flatnonzero(~missing)
    last = np.maximum(np.searchsorted(known, np.arange(len(rows)), side="right") - 1, 0)
    return rows[known[last]], missing


EXPORT = BvhExport()
