"""C3D, the format of biomechanics laboratories: 3D points at a constant rate; ezc3d writes it.

A missing point has the residual -1; any other residual is here the standard deviation per axis in whole
millimetres up to 255. Header and POINT:FRAMES count to 65535; larger numbers are in TRIAL:ACTUAL_END_FIELD
(C3D.org's user guide, 2021). A C3D has no time of day: our own files give the times of their first and last
frame in MOCAP:FIRST_T_NS and LAST_T_NS, as text because C3D's numbers are too short.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pipelines.formats.common.exporting import people_of
from pipelines.formats.common.files import first_bytes
from pipelines.formats.common.rows import METRES
from pipelines.formats.skeletons.joint_files import (
    EvenMotion,
    at_even_times,
    describe_motion,
    joint_names,
    marker_name,
    metric_unit,
    to_metres_z_up,
    to_y_up,
)
from pipelines.geometry.arrays import Float, Int64
from pipelines.session.records import JointMotion, Recording
from pipelines.session.registries import need
from pipelines.session.storage import damaged, on_disk

# A C3D is divided into blocks of this many bytes.
_BLOCK = 512
# This is the second byte of every C3D.
_MAGIC = 0x50
_DEC, _MIPS = 85, 86  # processor types, which determine the storage of numbers
# Laboratory programs show so many characters.
_LONGEST_LABEL = 30
# A text's length takes one byte in a C3D.
_LONGEST_TEXT = 255
# Residuals are stored in one byte of the scale.
_MOST_RESIDUAL = 255
# Header and POINT:FRAMES count no further.
_MOST_COUNTED = 65_535
# Frames farther apart than a quarter of an hour are no motion.
_LEAST_RATE_HZ = 0.001
# C3D has no parameters of more dimensions.
_MOST_DIMENSIONS = 7
# Dimensions of a parameter are stored in one byte.
_MOST_EVENTS = 255
# Names in gait laboratories' programs.
_EVENTS = {"heel_strike": "Foot Strike", "toe_off": "Foot Off"}
_SCREEN_UP = {"+Z": "z-up", "+Y": "y-up"}


class C3dFormat:
    """Reader of one person, by POINT:UNITS unless a unit is stated, and POINT:Y_SCREEN, else z up."""

    name = "c3d"
    title = "Biomechanics points (C3D)"
    suffixes: tuple[str, ...] = (".c3d",)

    def recognises(self, path: Path) -> bool:
        """Return True if the second byte is that of every C3D."""
        return first_bytes(path, 2, suffixes=self.suffixes)[1:] == bytes([_MAGIC])

    def describe(self, path: Path) -> dict[str, object]:
        """Describe stated unit, axes and rate, points, times, missing values, and the world box (z up)."""
        contents = _open(path)
        stated: dict[str, object] = {
            "POINT:UNITS": contents.text("POINT", "UNITS"),
            "POINT:Y_SCREEN": contents.text("POINT", "Y_SCREEN"),
            "POINT:RATE": contents.number("POINT", "RATE"),
        }
        known = {key: value for key, value in stated.items() if value is not None}
        return {**known, **describe_motion(_motion(path, contents, unit=None, axes=None))}

    def read_joints(self, path: Path, *, unit: str | None, axes: str | None) -> JointMotion:
        """Read every frame; a point with a negative residual is NaN."""
        return _motion(path, _open(path), unit=unit, axes=axes)


@dataclass(frozen=True)
class _Contents:
    """Parameters by group and name, and the points [T, N, 3] in the file's unit, NaN where missing."""

    parameters: Mapping[tuple[str, str], Sequence[float | str]]
    points: Float
    first_frame: int

    def values(self, group: str, name: str) -> Sequence[float | str]:
        return self.parameters.get((group, name), ())

    def text(self, group: str, name: str) -> str | None:
        return next((str(value).strip() for value in self.values(group, name)), None)

    def number(self, group: str, name: str) -> float | None:
        return _number(self.parameters, group, name)


def _open(path: Path) -> _Contents:
    with on_disk(path):
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(_BLOCK)
            file.seek(max(head[0] - 1, 0) * _BLOCK if head else 0)
            section = file.read(_BLOCK)
            # Some writers do not count the blocks. Then the section ends where the data begin.
            until_data = max(head[16 if section[3] != _MIPS else 17] - head[0], 0) if len(section) > 3 else 0
            section += file.read(max(*section[2:3], until_data, 1) * _BLOCK - _BLOCK)
    if len(head) < _BLOCK or head[1] != _MAGIC or len(section) < 4:
        raise damaged(path, "is no readable C3D (it ends in its header)")
    processor = section[3]
    order = ">" if processor == _MIPS else "<"
    try:
        parameters = _parameters(section, processor, order)
    except (IndexError, struct.error, ValueError) as error:
        raise damaged(path, "is no readable C3D (its parameters are damaged)") from error
    points, analogs, first, last = struct.unpack_from(f"{order}4H", head, 2)
    start = (struct.unpack_from(f"{order}H", head, 16)[0] - 1) * _BLOCK
    points = int(_number(parameters, "POINT", "USED") or points) & 0xFFFF
    scale = _number(parameters, "POINT", "SCALE") or float(_floats(head[12:16], processor, order)[0])
    kind = np.dtype(f"{order}{'f4' if scale < 0 else 'i2'}")
    words = 4 * points + analogs
    # Optotrak's headers count wrong; readers go by POINT:FRAMES.
    counts = [int(_number(parameters, "POINT", name) or 0) for name in ("LONG_FRAMES", "FRAMES")]
    counts = [*(count % (_MOST_COUNTED + 1) if count < 0 else count for count in counts), last - first + 1]
    ends = [_words(parameters.get(("TRIAL", f"ACTUAL_{end}_FIELD"), ())) for end in ("START", "END")]
    if ends[0] is not None and ends[1] is not None and ends[1] - ends[0] >= _MOST_COUNTED:
        counts = [ends[1] - ends[0] + 1]
    held = max(size - start, 0) // max(words * kind.itemsize, 1)
    frames = next((count for count in counts if 0 < count <= held), 0)
    if not points or not frames or start < _BLOCK:
        problem = f"holds {held} of {max(counts)} frames" if points and max(counts) else "holds no points"
        raise damaged(path, problem)
    stored = np.fromfile(path, "u1", frames * words * kind.itemsize, offset=start)
    with np.errstate(invalid="ignore", over="ignore"):  # of damaged numbers
        values = _floats(stored, processor, order) if scale < 0 else stored.view(kind) * scale
    rows = values.reshape(frames, words)[:, : 4 * points].reshape(frames, points, 4)
    return _Contents(parameters, np.where(rows[..., 3:] < 0, np.nan, rows[..., :3]), first)


def _floats(content: Any, processor: int, order: str) -> Float:
    """Convert bytes to numbers; DEC stores the half with the sign first, and four times the value."""
    if processor == _DEC:
        halves = np.frombuffer(content, "<u2").reshape(-1, 2)[:, ::-1]
        return np.ascontiguousarray(halves).view("<f4").ravel().astype(np.float64) / 4
    return np.frombuffer(content, f"{order}f4").astype(np.float64)


def _parameters(section: bytes, processor: int, order: str) -> dict[tuple[str, str], Sequence[float | str]]:
    """Parse the parameters; ValueError, IndexError or struct.error: they do not follow each other."""
    at, groups = 4, dict[int, str]()
    found: list[tuple[int, str, Sequence[float | str]]] = []
    while at < len(section) and section[at]:
        length, group = struct.unpack_from("2b", section, at)
        step = at + 2 + abs(length)
        name = section[at + 2 : step].decode("latin-1").upper()
        (further,) = struct.unpack_from(f"{order}H", section, step)
        if group < 0:
            groups[-group] = name
            end = step + 3 + section[step + 2]
        else:
            kind, dimensions = struct.unpack_from("bB", section, step + 2)
            sides = list(section[step + 4 : step + 4 + dimensions])
            begin = step + 4 + dimensions
            end = begin + abs(kind) * math.prod(sides)
            if kind not in {-1, 1, 2, 4} or dimensions > _MOST_DIMENSIONS or end >= len(section):
                raise ValueError(f"{name} is of no kind")
            found.append((group, name, _value(section[begin:end], kind, sides, processor, order)))
            end += 1 + section[end]
        if end > len(section) or (further and not end <= step + further <= len(section)):
            raise ValueError(f"{name} leaves its section")
        if not further:
            break
        at = step + further
    if not {group for group, *_ in found} <= groups.keys():
        raise ValueError("a parameter is of no group")
    return {(groups[group], name): value for group, name, value in found}


def _value(content: bytes, kind: int, sides: list[int], processor: int, order: str) -> Sequence[float | str]:
    if kind == -1:
        width = sides[0] if sides else 1
        return [content[k : k + width].decode("utf-8", "replace") for k in range(0, len(content), width or 1)]
    if kind == 4:
        return list(_floats(content, processor, order).tolist())
    return list(np.frombuffer(content, f"{order}i{kind}").tolist())


def _number(
    parameters: Mapping[tuple[str, str], Sequence[float | str]], group: str, name: str
) -> float | None:
    value = next(iter(parameters.get((group, name), ())), None)
    return value if isinstance(value, int | float) and math.isfinite(value) else None


def _words(values: Sequence[Any]) -> int | None:
    if not values or not all(isinstance(v, int | float) and math.isfinite(v) for v in values[:2]):
        return None
    low, high = (int(v) & 0xFFFF for v in [*values, 0][:2])
    return low | high << 16


def _motion(path: Path, contents: _Contents, *, unit: str | None, axes: str | None) -> JointMotion:
    labels = _labels(contents, contents.points.shape[1])
    unit = unit or metric_unit(contents.text("POINT", "UNITS") or "")
    axes = axes or _SCREEN_UP.get(contents.text("POINT", "Y_SCREEN") or "", "z-up")
    position = to_metres_z_up(path, contents.points, unit, axes)
    return JointMotion(_times(path, contents, len(position)), joint_names(labels), position[:, None])


def _labels(contents: _Contents, count: int) -> tuple[str, ...]:
    """Return the points' names; for our own files the full ones, where labels were shortened."""
    labels = [*_texts(contents, "LABELS"), *(f"point{k + 1}" for k in range(count))][:count]
    if contents.text("MOCAP", "FIRST_T_NS") is not None:
        labels = [
            full or label for full, label in zip(_texts(contents, "DESCRIPTIONS"), labels, strict=False)
        ]
    return tuple(_unique(labels))


def _texts(contents: _Contents, name: str) -> list[str]:
    """Return a list of POINT, which continues in LABELS2, LABELS3 after 255 entries."""
    more = [f"{name}{k}" if k > 1 else name for k in range(1, 100)]
    return [str(text).strip(" \0") for part in more for text in contents.values("POINT", part)]


def _times(path: Path, contents: _Contents, frames: int) -> Int64:
    first, last = (contents.text("MOCAP", f"{end}_T_NS") for end in ("FIRST", "LAST"))
    rate = contents.number("POINT", "RATE")
    if first is not None and last is not None:
        try:
            start, span = int(first), int(last) - int(first)
        except ValueError as error:
            raise damaged(path, "its MOCAP:FIRST_T_NS is no number") from error
        step_ns = span / max(frames - 1, 1)
        since: Int64 = np.rint(np.arange(frames) * step_ns).astype(np.int64)
        return np.asarray(start + since, np.int64)
    if not rate or not _LEAST_RATE_HZ < rate < 1e6:
        raise damaged(path, f"states a rate of {rate} Hz")
    number = max(contents.first_frame - 1, 0)
    times: Int64 = np.rint((number + np.arange(frames)) * (1e9 / rate)).astype(np.int64)
    return times


class C3dExport:
    """Writer of `<name>.c3d`, or `<name>_<person>.c3d` for each of several people, at a constant rate."""

    name = "c3d"
    title = "C3D points with their uncertainty as residual; float32 (extra c3d)"
    choices: Mapping[str, tuple[str, ...]] = {"unit": ("mm", "cm", "m"), "axes": ("z-up", "y-up")}

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write every person with at least one known joint."""
        motion, files = people_of(recording, folder, ".c3d")
        need("ezc3d", "c3d")
        even = at_even_times("c3d", motion, recording.progress)
        if even.empty:
            recording.progress.note(
                f"c3d: {even.empty} frames lie in pauses of the skeleton and hold no points"
            )
        gait = recording.gait()
        for person, path in files.items():
            events = None if gait is None else gait[gait["person"] == person]
            if events is not None and len(events) > _MOST_EVENTS:
                left_out = len(events) - _MOST_EVENTS
                recording.progress.note(
                    f"c3d: {left_out} gait events of {path.stem} do not fit, the last ones"
                )
            choice = {"unit": recording.unit or "mm", "axes": recording.axes or "z-up"}
            write_joints(path, even, person, events=events, **choice)
        return sorted(files.values())


def write_joints(
    path: Path, even: EvenMotion, person: int, *, unit: str, axes: str, events: pd.DataFrame | None = None
) -> None:
    """Write one person's joints, and rows of `tables.GAIT` as events; the module explains the residuals."""
    ezc3d = need("ezc3d", "c3d")
    motion = even.motion
    position = motion.position[:, person]
    missing = ~np.isfinite(position).all(axis=-1).T  # [N, T]
    turned = to_y_up(position) if axes == "y-up" else position
    points = np.ones((4, *missing.shape))
    points[:3] = np.where(missing, np.nan, turned.transpose(2, 1, 0) / METRES[unit])
    step = METRES["mm"] / METRES[unit]  # a residual's unit is POINT:SCALE
    file = ezc3d.c3d()
    file["data"]["points"] = points
    steps = np.zeros(missing.shape)
    if motion.covariance is not None:
        trace = motion.covariance[:, person][..., [0, 3, 5]].sum(axis=-1).T
        sigma_mm = 1000 * np.sqrt(np.where(np.isfinite(trace), np.maximum(trace, 0.0), 0.0) / 3)
        steps = np.minimum(np.rint(sigma_mm), _MOST_RESIDUAL)
    # ezc3d truncates the decimals: a quarter more keeps 7 from becoming 6.9999.
    file["data"]["meta_points"] = {
        "residuals": np.where(missing, -1.0, (steps + 0.25) * step)[None],
        "camera_masks": np.zeros((7, *missing.shape), bool),
    }
    names = [" ".join(marker_name(joint).split()) or "_" for joint in motion.joints]
    stated = file["parameters"]["POINT"]
    stated["RATE"]["value"] = [even.rate_hz]
    stated["SCALE"]["value"] = [-step]
    stated["UNITS"]["value"] = [unit]
    stated["LABELS"]["value"] = _unique([_cut(name, _LONGEST_LABEL) for name in names], _LONGEST_LABEL)
    stated["DESCRIPTIONS"]["value"] = [_cut(name, _LONGEST_TEXT) for name in names]
    file.add_parameter("POINT", "X_SCREEN", ["+X"])
    file.add_parameter("POINT", "Y_SCREEN", ["+Y" if axes == "y-up" else "+Z"])
    count = len(motion.t_ns)
    file.add_parameter("TRIAL", "ACTUAL_START_FIELD", [1, 0])
    file.add_parameter("TRIAL", "ACTUAL_END_FIELD", [count & 0xFFFF, count >> 16])
    file.add_parameter("MANUFACTURER", "SOFTWARE", ["mocap"])
    file.add_parameter("MOCAP", "FIRST_T_NS", [str(int(motion.t_ns[0]))])
    file.add_parameter("MOCAP", "LAST_T_NS", [str(int(motion.t_ns[-1]))])
    if events is not None and len(events):
        _add_events(file, events[:_MOST_EVENTS], int(motion.t_ns[0]))
    file.write(str(path))


def _add_events(file: Any, events: pd.DataFrame, first_ns: int) -> None:
    """Add the group EVENT (The C3D File Format, 2021): minutes and seconds since the first frame."""
    since_s = (events["t_ns"].to_numpy(np.int64) - first_ns) / 1e9
    file.add_parameter("EVENT", "USED", [len(events)])
    file.add_parameter("EVENT", "CONTEXTS", events["side"].str.capitalize().tolist())
    file.add_parameter("EVENT", "LABELS", [_EVENTS[event] for event in events["event"]])
    file.add_parameter("EVENT", "TIMES", np.array(np.divmod(since_s, 60.0)))


def _unique(names: Sequence[str], longest: int = _LONGEST_TEXT) -> list[str]:
    taken: list[str] = []
    for name in names:
        number, free = 2, name
        while free in taken:
            free = f"{_cut(name, longest - len(str(number)) - 1)}_{number}"
            number += 1
        taken.append(free)
    return taken


def _cut(text: str, most: int) -> str:
    return text.encode()[:most].decode(errors="ignore")


FORMAT = C3dFormat()
EXPORT = C3dExport()
