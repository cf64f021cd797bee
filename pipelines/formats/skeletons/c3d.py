"""C3D, the format of biomechanics laboratories: 3D points at a constant rate, in 32-bit floats. Needs ezc3d.

A missing point has the residual -1; any other residual is here the standard deviation per axis in whole
millimetres up to 255. Header and POINT:FRAMES count to 65535; larger numbers are in TRIAL:ACTUAL_END_FIELD
(C3D.org's user guide, 2021). A C3D has no time of day: our own files give the times of their first and last
frame in MOCAP:FIRST_T_NS and LAST_T_NS, as text because C3D's numbers are too short.
"""

import math
import re
import struct
from collections.abc import Mapping, Sequence
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
from pipelines.session.errors import DataError
from pipelines.session.records import JointMotion, Recording
from pipelines.session.registries import need
from pipelines.session.storage import as_data_error, damaged

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
# A larger number of the first frame is damage of the header.
_MOST_FIRST_FRAME = 1_000_000_000
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
            "POINT:UNITS": _text(contents, "POINT", "UNITS"),
            "POINT:Y_SCREEN": _text(contents, "POINT", "Y_SCREEN"),
            "POINT:RATE": _number(contents, "POINT", "RATE"),
        }
        known = {key: value for key, value in stated.items() if value is not None}
        return {**known, **describe_motion(_motion(path, contents, unit=None, axes=None))}

    def read_joints(self, path: Path, *, unit: str | None, axes: str | None) -> JointMotion:
        """Read every frame; a point with a negative residual is NaN."""
        return _motion(path, _open(path), unit=unit, axes=axes)


def _open(path: Path) -> Any:
    ezc3d = need("ezc3d", "c3d")
    _check_layout(path)
    try:
        return ezc3d.c3d(str(path))
    except (OSError, ValueError, RuntimeError, IndexError, KeyError, MemoryError) as error:
        raise damaged(path, f"is no readable C3D ({str(error)[:120]})") from error


def _check_layout(path: Path) -> None:
    """Refuse a file that is shorter than its header states, or whose parameters overlap."""
    try:
        with path.open("rb") as file:
            head = file.read(_BLOCK)
            file.seek(max(head[0] - 1, 0) * _BLOCK if head else 0)
            section = file.read(_BLOCK)
            # Some writers do not count the blocks. Then the section ends where the data begin.
            until_data = max(head[16 if section[3] != _MIPS else 17] - head[0], 0) if len(section) > 3 else 0
            section += file.read(max(*section[2:3], until_data, 1) * _BLOCK - _BLOCK)
            size = file.seek(0, 2)
    except OSError as error:
        raise as_data_error(error, path) from error
    if len(head) < _BLOCK or head[1] != _MAGIC or len(section) < 4:
        raise damaged(path, "is no readable C3D (it ends in its header)")
    processor = section[3]
    order = ">" if processor == _MIPS else "<"
    points, analogs, first, last = struct.unpack_from(f"{order}4H", head, 2)
    scale, start = struct.unpack_from(f"{order}fH", head, 12)
    # DEC stores the half with the sign first.
    is_float = head[13] & 0x80 if processor == _DEC else scale < 0
    frames = max(last - first + 1, 0)
    if stated := re.search(rb"[\x06\xfa].FRAMES..\x02(?:\x00|\x01\x01)(..)", section, re.DOTALL):
        # Optotrak's headers count wrong; readers go by POINT:FRAMES.
        frames = min(frames, struct.unpack(f"{order}H", stated[1])[0])
    needed = (start - 1) * _BLOCK + frames * (4 * points + analogs) * (4 if is_float else 2)
    if size < needed:
        raise damaged(path, f"is no readable C3D (it holds {size} of the {needed} bytes of its header)")
    if not _is_chain(section, order):
        raise damaged(path, "is no readable C3D (its parameters are damaged)")


def _is_chain(section: bytes, order: str) -> bool:
    """Return True if the parameters follow each other within their section, with consistent lengths."""
    at, groups = 4, set()
    wanted: set[int] = set()
    try:
        while at < len(section) and section[at]:
            name, group = struct.unpack_from("2b", section, at)
            step = at + 2 + abs(name)
            (further,) = struct.unpack_from(f"{order}H", section, step)
            if group < 0:
                groups.add(-group)
                end = step + 3 + section[step + 2]
            else:
                wanted.add(group)
                kind, dimensions = struct.unpack_from("bB", section, step + 2)
                sides = section[step + 4 : step + 4 + dimensions]
                end = step + 4 + dimensions + abs(kind) * math.prod(sides)
                end += 1 + section[end]
                if kind not in {-1, 1, 2, 4} or dimensions > 7 or len(sides) < dimensions:
                    return False
            if end > len(section) or (further and step + further < end):
                return False
            if not further:
                break
            at = step + further
            if at > len(section):
                return False
    except (IndexError, struct.error):
        return False
    return wanted <= groups


def _motion(path: Path, contents: Any, *, unit: str | None, axes: str | None) -> JointMotion:
    points = np.asarray(contents["data"]["points"], np.float64)  # [4, N, T]
    residual = np.asarray(contents["data"]["meta_points"]["residuals"], np.float64)[0]
    frames = _frames(contents)
    if not points.shape[1] or not frames:
        raise damaged(path, "holds no points")
    xyz = np.where(residual < 0, np.nan, points[:3]).transpose(2, 1, 0)
    if frames > len(xyz):
        xyz = np.concatenate([xyz, _beyond(path, contents, len(xyz), frames)])
    labels = _labels(contents, xyz.shape[1])
    unit = unit or metric_unit(_text(contents, "POINT", "UNITS") or "")
    axes = axes or _SCREEN_UP.get(_text(contents, "POINT", "Y_SCREEN") or "", "z-up")
    position = to_metres_z_up(path, xyz, unit, axes)
    return JointMotion(_times(path, contents, frames), joint_names(labels), position[:, None])


def _frames(contents: Any) -> int:
    read = int(np.shape(contents["data"]["points"])[2])
    first, last = (_words(contents, f"ACTUAL_{end}_FIELD") for end in ("START", "END"))
    return max(read, last - first + 1) if first is not None and last is not None else read


def _words(contents: Any, name: str) -> int | None:
    values = _values(contents, "TRIAL", name)
    if len(values) == 0:
        return None
    # Theia3D writes them as a table of 2 x 1.
    low, high = (int(v) & 0xFFFF for v in [*np.ravel(values).tolist(), 0][:2])
    return low | high << 16


def _beyond(path: Path, contents: Any, read: int, frames: int) -> Float:
    """Read the frames [T, N, 3] that ezc3d leaves out because the header cannot count them."""
    points = int(np.shape(contents["data"]["points"])[1])
    first = _number(contents, "POINT", "DATA_START")
    scale = _number(contents, "POINT", "SCALE") or 0.0
    if np.size(contents["data"]["analogs"]) or scale >= 0 or first is None:
        problem = f"holds {frames} frames beside analog channels or in integers"
        raise DataError(path, problem, "export it in parts")
    start = (int(first) - 1) * _BLOCK + read * points * 16
    values = np.fromfile(path, "<f4", count=(frames - read) * points * 4, offset=start)
    if len(values) < (frames - read) * points * 4:
        raise damaged(path, f"breaks off before the last of its {frames} frames")
    rows = values.reshape(frames - read, points, 4).astype(np.float64)
    return np.where(rows[..., 3:] < 0, np.nan, rows[..., :3])


def _labels(contents: Any, count: int) -> tuple[str, ...]:
    """Return the points' names; for our own files the full ones, where labels were shortened."""
    labels = [*_texts(contents, "LABELS"), *(f"point{k + 1}" for k in range(count))][:count]
    if _text(contents, "MOCAP", "FIRST_T_NS") is not None:
        labels = [
            full or label for full, label in zip(_texts(contents, "DESCRIPTIONS"), labels, strict=False)
        ]
    return tuple(_unique(labels))


def _texts(contents: Any, name: str) -> list[str]:
    """Return a list of POINT, which continues in LABELS2, LABELS3 after 255 entries."""
    more = [f"{name}{k}" if k > 1 else name for k in range(1, 100)]
    return [str(text) for part in more for text in _values(contents, "POINT", part)]


def _times(path: Path, contents: Any, frames: int) -> Int64:
    first, last = (_text(contents, "MOCAP", f"{end}_T_NS") for end in ("FIRST", "LAST"))
    rate = _number(contents, "POINT", "RATE")
    if first is not None and last is not None:
        try:
            start, span = int(first), int(last) - int(first)
        except ValueError as error:
            raise damaged(path, "its MOCAP:FIRST_T_NS is no number") from error
        step_ns = span / max(frames - 1, 1)
        since: Int64 = np.rint(np.arange(frames) * step_ns).astype(np.int64)
        return np.asarray(start + since, np.int64)
    if not rate or not 0 < rate < 1e6:
        raise damaged(path, f"states a rate of {rate} Hz")
    number = contents["header"]["points"]["first_frame"]
    start = number if 0 <= number < _MOST_FIRST_FRAME else 0
    times: Int64 = np.rint((start + np.arange(frames)) * (1e9 / rate)).astype(np.int64)
    return times


def _values(contents: Any, group: str, name: str) -> Sequence[Any]:
    try:
        return list(contents["parameters"][group][name]["value"])
    except (KeyError, TypeError):
        return []


def _text(contents: Any, group: str, name: str) -> str | None:
    values = _values(contents, group, name)
    return str(values[0]).strip() if len(values) else None


def _number(contents: Any, group: str, name: str) -> float | None:
    values = _values(contents, group, name)
    return float(values[0]) if len(values) else None


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
