"""Acclaim's motion (AMC) with its skeleton (ASF), the own format of the CMU motion capture database.

Layout and kinematics: Lander, "Working with Motion Capture File Formats" (Game Developer, 1998), and CMU's
own reader. A bone has a direction and length in the pose of zero angles, an `axis` frame in which its
angles count, and as many angles a frame as its `dof`. With C the rotation of the axis and M that of the
angles, its rotation in the world is that of its parent times C M C^-1. It begins where its parent ends.

Lengths are inches divided by `length` of `:units` (CMU: 0.45). No AMC states its rate; CMU's is 120 Hz.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipelines.formats.common.files import read_head, read_text
from pipelines.formats.skeletons.joint_files import (
    bone_joints,
    describe_motion,
    to_metres_z_up,
)
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.records import JointMotion

_INCH_M = 0.0254
_LARGEST = 1e9  # of an angle or a place: more is damage
_RATE_HZ = 120.0
_AGAIN = "copy it again"


@dataclass
class _Bone:
    parent: str | None = None
    vector: Float = field(default_factory=lambda: np.zeros(3))  # from its start to its end, file's unit
    axis: Float = field(default_factory=lambda: np.eye(3))  # parent_from_axis of zero angles
    dof: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Skeleton:
    bones: dict[str, _Bone]  # parents before children; the first is the root
    metres: float  # in a unit of the file
    radians: bool


class AmcFormat:
    """Reader of the joints at which bones begin; the skeleton is the .asf beside the file.

    That is the file of the same name, of the name before its last underscore (`10.asf` for `10_04.amc`), or
    the only one in the folder. A `unit` stated by the user overrides that of the skeleton.
    """

    name = "amc"
    title = "Acclaim motion (ASF/AMC)"
    suffixes: tuple[str, ...] = (".amc",)

    def recognises(self, path: Path) -> bool:
        """Return True if the first frame begins with the root's numbers."""
        return re.search(r"(?m)^\d+\s*\nroot\s+[-\d.]", read_head(path, self.suffixes)) is not None

    def describe(self, path: Path) -> dict[str, object]:
        """Describe the skeleton's file, joints, times and box."""
        skeleton = skeleton_of(path)
        motion = self.read_joints(path, unit=None, axes=None)
        return {
            "skeleton": skeleton.name,
            "rate": f"not stated: {_RATE_HZ:g} Hz, as CMU's",
            **describe_motion(motion),
        }

    def read_joints(self, path: Path, *, unit: str | None, axes: str | None) -> JointMotion:
        """Read every frame; the last is left out and counted if it is cut off.

        Raises:
            DataError: no skeleton, a bone that it lacks, numbers that are missing, or no frame.
        """
        asf = skeleton_of(path)
        skeleton = _read_skeleton(asf)
        values, cut = _read_frames(path, skeleton)
        starts = _starts(skeleton, values)
        if unit is None:
            starts, unit = starts * skeleton.metres, "m"
        position = to_metres_z_up(path, starts, unit, axes or "y-up")
        t_ns = np.rint(np.arange(len(position)) * (1e9 / _RATE_HZ)).astype(np.int64)
        names = bone_joints(tuple(skeleton.bones))
        return JointMotion(t_ns, names, position[:, None], dropped={"frame cut off": 1} if cut else {})


def skeleton_of(path: Path) -> Path:
    """Return the file of the skeleton of a motion; raise DataError without one."""
    beside = sorted(path.parent.glob("*.[aA][sS][fF]"))
    for stem in (path.stem, path.stem.rpartition("_")[0]):
        for each in beside:
            if each.stem == stem:
                return each
    if len(beside) == 1:
        return beside[0]
    raise DataError(
        path,
        f"has no skeleton beside it ({len(beside)} .asf files, none called {path.stem}.asf)",
        "put the subject's .asf into its folder",
    )


# --- skeleton ------------------------------------------------------------------------------------------


def _read_skeleton(path: Path) -> _Skeleton:
    sections: dict[str, list[list[str]]] = {}
    current: list[list[str]] = []
    for line in read_text(path).split("\n"):
        words = line.split("#", 1)[0].split()
        if words and words[0].startswith(":"):
            current = sections.setdefault(words[0][1:].lower(), [])
        elif words:
            current.append(words)
    missing = [name for name in ("root", "bonedata", "hierarchy") if name not in sections]
    if missing:
        raise DataError(path, f"has no section :{missing[0]}", _AGAIN)
    try:
        return _built(sections)
    except (ValueError, IndexError, KeyError) as error:
        raise DataError(path, f"has a skeleton that cannot be read ({str(error)[:80]})", _AGAIN) from None


def _built(sections: dict[str, list[list[str]]]) -> _Skeleton:
    units = {words[0].lower(): words[1] for words in sections.get("units", []) if len(words) > 1}
    radians = units.get("angle", "deg").lower().startswith("rad")
    root = {words[0].lower(): words[1:] for words in sections["root"]}
    order = root.get("order", ["TX", "TY", "TZ", "RX", "RY", "RZ"])
    turned = _turn(root.get("axis", ["XYZ"])[0], root.get("orientation", ["0", "0", "0"]), radians)
    if any(not re.fullmatch("[tr][xyz]", word.lower()) for word in order):
        raise ValueError(f"root has {' '.join(order)}")
    bones = {"root": _Bone(axis=turned, dof=tuple(word.lower() for word in order))}
    known: dict[str, _Bone] = {}
    for block in _blocks(sections["bonedata"]):
        stated = {row[0].lower(): row[1:] for row in block}
        bone = _Bone(dof=tuple(word.lower() for word in stated.get("dof", [])))
        direction = np.array([_number(word) for word in stated["direction"][:3]])
        bone.vector = direction * _number(stated["length"][0])
        bone.axis = _turn(stated["axis"][3] if len(stated["axis"]) > 3 else "XYZ", stated["axis"], radians)
        if bone.vector.shape != (3,) or any(not re.fullmatch("r[xyz]", dof) for dof in bone.dof):
            raise ValueError(f"bone {stated['name'][0]} has {' '.join(bone.dof)}")
        known[stated["name"][0]] = bone
    for words in sections["hierarchy"]:
        for child in words[1:] if len(words) > 1 else []:
            if words[0] not in bones:
                raise ValueError(f"{words[0]} comes before its parent")
            if child in bones:
                raise ValueError(f"{child} has two parents")
            known[child].parent = words[0]
            bones[child] = known[child]
    length = _number(units.get("length", "1"))
    if length <= 0:
        raise ValueError(f"length {length:g}")
    return _Skeleton(bones, _INCH_M / length, radians)


def _blocks(rows: list[list[str]]) -> Iterator[list[list[str]]]:
    block: list[list[str]] = []
    for row in rows:
        if row[0].lower() == "begin":
            block = []
        elif row[0].lower() == "end":
            yield block
        else:
            block.append(row)


def _number(word: str) -> float:
    """Return a number; raise ValueError if it is none, or absurd."""
    value = float(word)
    if not abs(value) < _LARGEST:
        raise ValueError(f"number {word[:20]}")
    return value


def _turn(order: str, words: list[str], radians: bool) -> Float:
    """Return the rotation of three angles; the first axis of the order is applied first."""
    angles = np.array([_number(word) for word in words[:3]])
    angles = angles if radians else np.radians(angles)
    if sorted(order.upper()) != ["X", "Y", "Z"] or len(angles) != 3:
        raise ValueError(f"axis {order}")
    total: Float = np.eye(3)
    for axis, angle in zip(order.lower(), angles, strict=True):
        total = _about(axis, np.array([angle]))[0] @ total
    return total


def _about(axis: str, angle: Float) -> Float:
    """Return rotations [T, 3, 3] about x, y or z by angles [T], rad."""
    k = "xyz".index(axis)
    i, j = (k + 1) % 3, (k + 2) % 3
    turned = np.tile(np.eye(3), (len(angle), 1, 1))
    turned[:, i, i] = turned[:, j, j] = np.cos(angle)
    turned[:, j, i], turned[:, i, j] = np.sin(angle), -np.sin(angle)
    return turned


# --- motion --------------------------------------------------------------------------------------------


def _read_frames(path: Path, skeleton: _Skeleton) -> tuple[dict[str, Float], bool]:
    """Return the numbers of each bone [T, dof], and True if the last frame was cut off."""
    moving = {name: len(bone.dof) for name, bone in skeleton.bones.items() if bone.dof}
    frames: list[dict[str, list[float]]] = []
    for number, line in enumerate(read_text(path).split("\n"), 1):
        words = line.split()
        if not words or words[0][0] in "#:":
            continue
        if len(words) == 1 and words[0].isdecimal():
            frames.append({})
            continue
        if not frames or words[0] not in moving:
            raise DataError(path, f"line {number}: its skeleton has no bone {words[0][:40]!r}", _AGAIN)
        try:
            frames[-1][words[0]] = [float(word) for word in words[1:]]
        except ValueError as error:
            raise DataError(path, f"line {number}: {str(error)[:80]}", _AGAIN) from None
        if not all(abs(value) < _LARGEST for value in frames[-1][words[0]]):
            raise DataError(path, f"line {number}: holds an absurd number", _AGAIN)
    whole = [all(len(frame.get(name, ())) == count for name, count in moving.items()) for frame in frames]
    cut = bool(whole) and not whole[-1]
    frames, whole = (frames[:-1], whole[:-1]) if cut else (frames, whole)
    if not frames or not all(whole):
        problem = f"lacks numbers in frame {whole.index(False) + 1}" if frames else "holds no whole frame"
        raise DataError(path, problem, _AGAIN)
    return {name: np.array([frame[name] for frame in frames]) for name in moving}, cut


def _starts(skeleton: _Skeleton, values: dict[str, Float]) -> Float:
    """Return where each bone begins [T, B, 3], in the file's unit and axes."""
    count = len(values["root"])
    ends: dict[str, Float] = {}
    turned: dict[str, Float] = {}
    starts = []
    for name, bone in skeleton.bones.items():
        motion = np.tile(np.eye(3), (count, 1, 1))
        place = np.zeros((count, 3))
        for column, dof in enumerate(bone.dof):
            if dof[0] == "t":
                place[:, "xyz".index(dof[1])] = values[name][:, column]
            else:
                angle = values[name][:, column]
                motion = _about(dof[1], angle if skeleton.radians else np.radians(angle)) @ motion
        own = bone.axis @ motion @ bone.axis.T
        if bone.parent is None:
            turned[name], start = own, place
        else:
            turned[name], start = turned[bone.parent] @ own, ends[bone.parent]
        starts.append(start)
        ends[name] = start + turned[name] @ bone.vector
    return np.stack(starts, axis=1)


FORMAT = AmcFormat()
