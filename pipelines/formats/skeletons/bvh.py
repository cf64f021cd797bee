"""Reader of Biovision's BVH: a skeleton of bones, then one line of channels per frame.

Layout (Biovision; Meredith & Maddock, "Motion Capture File Formats Explained", 2001): `HIERARCHY`, then
`ROOT`, `JOINT` and `End Site` blocks in braces, each with its `OFFSET` from the parent and its `CHANNELS`;
`MOTION`, `Frames:`, `Frame Time:`, then the channels of all bones in the order of the hierarchy. Rotations
are degrees and apply in the order in which they stand: `Zrotation Yrotation Xrotation` is Rz Ry Rx. Position
channels replace the bone's offset (as in Blender and in the readers of published data sets), except
if they are zero throughout.

The file states neither unit nor axes. A y-up file's (x, y, z) becomes the world's (z, x, y), as in TRC. A
person who faces the file's +z, with the left hand towards +x, faces the world's +x (east) with the left
towards +y.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipelines.formats.common.files import read_head, read_text
from pipelines.formats.skeletons.joint_files import bone_joints
from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import multiply, rotate
from pipelines.session.errors import DataError
from pipelines.session.records import JointMotion, SkeletalMotion

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


@dataclass(frozen=True)
class _BvhFile:
    bones: list[_FileBone]
    frame_time_s: float
    values: Float  # [T, C]


class BvhFormat:
    """Reader of the joints at which bones begin; the description is in the file's own, unstated unit.

    Known bones get our joints' names (LeftUpLeg and lfemur are left_hip), others keep theirs.
    """

    name = "bvh"
    title = "Biovision motion (BVH)"
    suffixes: tuple[str, ...] = (".bvh",)

    def recognises(self, path: Path) -> bool:
        """Return True if the file begins with HIERARCHY and ROOT."""
        return read_head(path, self.suffixes).split(maxsplit=2)[:2] == ["HIERARCHY", "ROOT"]

    def describe(self, path: Path) -> dict[str, object]:
        """Describe bones, frames, rate, seconds, the extent of the rest pose, and the box of its root."""
        contents = _read(path)
        frames, bones = len(contents.values), contents.bones
        places = _rest_places(bones)
        place, _ = _bone_places(bones[0], contents.values)
        return {
            "bones": len(bones),
            "root": bones[0].name,
            "names": [bone.name for bone in bones],
            "frames": frames,
            "rate_hz": round(1 / contents.frame_time_s, 3),
            "seconds": round((frames - 1) * contents.frame_time_s, 6),
            "rest_pose_extent": [round(v, 4) for v in np.ptp(places, axis=0).tolist()],
            "root_box_min": [round(v, 4) for v in place.min(axis=0).tolist()],
            "root_box_max": [round(v, 4) for v in place.max(axis=0).tolist()],
        }

    def read_joints(self, path: Path, *, unit: str | None, axes: str | None) -> JointMotion:
        """Read every frame, the first at 0 s; `axes` is y-up unless stated.

        Without a unit it is that of m, cm, mm, inch and CMU's in which the rest pose is as tall as an adult
        (1.2 to 2.3 m): no two of them can be.
        """
        contents = _read(path)
        axes = axes or "y-up"
        metres = {**METRES, "ft": 0.3048}[unit] if unit else _likely_unit(path, contents.bones, axes)
        joints: list[Float] = []
        turned: list[Float] = []
        for bone in contents.bones:
            place, _ = _bone_places(bone, contents.values)
            own = _rotation(bone, contents.values)
            if bone.parent >= 0:
                place = joints[bone.parent] + rotate(turned[bone.parent], place)
                own = multiply(turned[bone.parent], own)
            joints.append(place)
            turned.append(own)
        position = np.stack(joints, axis=1)[..., _IN_WORLD[axes]] * metres
        t_ns = np.rint(np.arange(len(position)) * (contents.frame_time_s * 1e9)).astype(np.int64)
        return JointMotion(t_ns, bone_joints(tuple(bone.name for bone in contents.bones)), position[:, None])


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

    Some exports have bones above the first moving one, each with a single child (a `Reference` or scene
    root). They are merged into it, and its motion is then the root's. If a bone further down has moving
    position channels, it is put at their mean, if it is never further than 5 cm from it.
    """
    if unit not in METRES:
        problem = f"the unit {unit!r} is none of {', '.join(METRES)}"
        raise DataError(path, problem, "state one of them", code="unit-unknown")
    if axes not in AXES:
        raise DataError(
            path, f"the axes {axes!r} are none of {', '.join(AXES)}", "state one of them", code="axes-unknown"
        )
    contents = _read(path)
    metres, order = METRES[unit], _IN_WORLD[axes]
    turned = [*order, 3]  # a rotation's axis is turned like any other vector
    places, rotations = [], []
    for bone in contents.bones:
        place, moves = _bone_places(bone, contents.values)
        places.append((place[:, order] * metres, moves))
        rotations.append(_rotation(bone, contents.values)[:, turned])
    first = _carriers(contents.bones, [moves for _, moves in places])
    root, root_rotation = places[0][0], rotations[0]
    for k in range(1, first + 1):
        root = root + rotate(root_rotation, places[k][0])
        root_rotation = multiply(root_rotation, rotations[k])
    rotations[first] = root_rotation
    kept = contents.bones[first:]
    offsets = [np.zeros(3)]
    offsets += [
        _fixed_place(path, bone, place)
        for bone, (place, _) in zip(kept[1:], places[first + 1 :], strict=True)
    ]
    ends = {k: bone.end[order] * metres for k, bone in enumerate(kept) if bone.end is not None}
    return SkeletalMotion(
        t_s=np.arange(len(contents.values), dtype=np.float64) * contents.frame_time_s,
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


def _read(path: Path) -> _BvhFile:
    text = read_text(path)
    head, marker, tail = text.partition("\nMOTION")
    if not head.lstrip().startswith("HIERARCHY"):
        raise DataError(path, "is no BVH file", "its first word must be HIERARCHY", code="wrong-kind")
    if not marker:
        raise DataError(path, "ends before its line MOTION", _EXPORT_AGAIN, code="damaged")
    bones = _bones(path, head.replace("{", " { ").replace("}", " } ").split()[1:])
    lines = tail.split("\n", maxsplit=3) + [""] * 3
    frames, frame_time_s = _stated(path, lines[1], "Frames:"), _stated(path, lines[2], "Frame Time:")
    if not 0 < frame_time_s <= _LONGEST_S:
        raise DataError(path, f"states a frame time of {frame_time_s:g} s", "correct it", code="bad-value")
    values = _numbers(path, lines[3], sum(len(bone.channels) for bone in bones), head.count("\n") + 5)
    if len(values) != frames:
        problem = f"states {frames:g} frames but holds {len(values)}"
        remedy = _EXPORT_AGAIN if len(values) < frames else "correct the line `Frames:`"
        raise DataError(path, problem, remedy, code="damaged")
    return _BvhFile(bones, frame_time_s, values)


def _bones(path: Path, words: list[str]) -> list[_FileBone]:
    """Parse the hierarchy, parents first, in the order of the file."""
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
                    raise _damaged(path, f"the bone {name[:40]!r} has no place there")
                if name in {bone.name for bone in bones} or len(bones) == _MOST_BONES:
                    raise _damaged(path, f"a second bone is called {name[:40]!r}, or there are too many")
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
                named = [next(coming, "").lower() for _ in range(int(count) if count.isdecimal() else 0)]
                places = [channel for channel in named if channel.endswith("position")]
                if not named or set(named) - {*_CHANNELS} or len(set(places)) < len(places):
                    raise _damaged(path, f"CHANNELS {count} {' '.join(named)[:60]} make no sense")
                bones[-1].channels = named
            case _:
                raise _damaged(path, f"{word[:60]!r} has no place in its hierarchy")
    if above or not bones or any(bone.parent < 0 for bone in bones[1:]):
        raise _damaged(path, "its hierarchy lacks a brace, a root or all bones")
    return bones


def _damaged(path: Path, problem: str) -> DataError:
    return DataError(path, problem, _EXPORT_AGAIN, code="damaged")


def _offset(path: Path, words: list[str]) -> Float:
    try:
        offset = np.array([float(word) for word in words])
    except ValueError:
        offset = np.full(3, np.nan)
    if not (np.abs(offset) < _LARGEST).all():
        raise _damaged(path, f"OFFSET {' '.join(words)[:60]} is no place")
    return offset


def _stated(path: Path, line: str, key: str) -> float:
    """Return the number after `Frames:` or `Frame Time:`."""
    words = line.lower().split(key.lower())
    try:
        return float(words[1]) if len(words) == 2 and not words[0].strip() else float("none")
    except ValueError:
        problem = f"has {line.strip()[:60]!r} where `{key}` and a number belong"
        raise DataError(path, problem, _EXPORT_AGAIN, code="bad-value") from None


def _numbers(path: Path, body: str, channels: int, first_line: int) -> Float:
    """Parse the frames [T, channels]."""
    if not channels or not body.strip():
        raise DataError(path, "holds no frames or no channels", _EXPORT_AGAIN, code="empty")
    rows: list[Float] = []
    for number, line in enumerate(body.split("\n"), start=first_line):
        if words := line.split():
            try:
                row = np.array(words, dtype=np.float64)
            except ValueError:
                row = np.full(channels, np.nan)
            if len(row) != channels or not (np.abs(row) < _LARGEST).all():
                problem = f"line {number} does not hold {channels} numbers below {_LARGEST:g}"
                raise DataError(path, problem, _EXPORT_AGAIN, code="damaged")
            rows.append(row)
    return np.array(rows)


FORMAT = BvhFormat()
