"""Files of joints: unit and axes, names of markers, a constant rate; joints as CSV, angles as CSV and STO."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from pipelines.formats.common.exporting import (
    file_names_of_people,
    note_no_skeleton,
    safe_file_name,
    tracks_of,
)
from pipelines.formats.common.files import TextFormat
from pipelines.formats.common.rows import (
    METRES,
    SECONDS,
    Heading,
    TextTable,
    bounding_box,
    cell_name,
    describe_times,
    find_heading,
    format_seconds,
    parse_stamps,
    rows_below,
)
from pipelines.formats.poses import write_pose_csv
from pipelines.geometry.arrays import Bool, Float, Int64, nearest_rows
from pipelines.geometry.joint_angles import ANGLES
from pipelines.geometry.poses import interpolate_points
from pipelines.session.errors import DataError
from pipelines.session.people import SKELETONS, joint_called, points_of_caliscope
from pipelines.session.progress import Progress
from pipelines.session.records import POINT_COVARIANCE_COLUMNS, JointMotion, Recording
from pipelines.session.storage import damaged, own_table, read_text

AXES = ("z-up", "y-up")
# A hand at 2 m/s moves by 1 mm in this time, so a sample so near keeps its position.
_KEPT_NS = 500_000
# Between times further apart than this, in frame steps, nothing is interpolated.
_LONGEST_STEP = 1.5
# More frames would exhaust the memory.
_MOST_FRAMES = 10_000_000
# More frames for a sample mean stamps that keep no rate.
_MOST_EMPTY = 100
_UNITS = {"meters": "m", "metres": "m", "centimeters": "cm", "millimeters": "mm"}


def to_metres_z_up(source: Path, position: Float, unit: str, axes: str) -> Float:
    """Convert positions [..., 3], of y-up files to (z, x, y); not finite in part is missing (all NaN)."""
    if unit not in METRES:
        problem = f"the unit {unit!r} is none of {', '.join(METRES)}"
        raise DataError(source, problem, "state `unit: mm` or alike", code="unit-unknown")
    if axes not in AXES:
        problem = f"the axes {axes!r} are none of {', '.join(AXES)}"
        raise DataError(source, problem, "state `axes: y-up` or z-up", code="axes-unknown")
    seen = np.isfinite(position).all(axis=-1, keepdims=True)
    turned = position[..., [2, 0, 1]] if axes == "y-up" else position
    return np.where(seen, turned * METRES[unit], np.nan)


def to_y_up(position: Float) -> Float:
    """Convert world positions [..., 3] to OpenSim's axes, y up: (y, z, x) of the world."""
    return position[..., [1, 2, 0]]


@dataclass(frozen=True)
class EvenMotion:
    """Motion with a constant time step."""

    motion: JointMotion
    rate_hz: float
    empty: int  # frames between the samples without any measurement


def at_even_times(source: str, motion: JointMotion, progress: Progress) -> EvenMotion:
    """Assign a motion to frames at its usual step, from its first time (there must be one) to its last.

    Samples within half a millisecond of their frames stay as they are. If any is further off, all positions
    are interpolated linearly between neighbours (never across a missing one), with the covariances of the
    nearest sample. Both are noted, unless the stamps differ by rounding alone.
    """
    t_ns = motion.t_ns
    if len(t_ns) == 1:
        return EvenMotion(motion, 1.0, 0)
    steps = np.diff(t_ns)
    # Steps are counted, so that neither a long pause nor the rounding of single stamps changes the rate.
    index = np.concatenate([[0], np.cumsum(np.maximum(np.rint(steps / np.median(steps)), 1))]).astype(
        np.int64
    )
    frames = int(index[-1]) + 1
    if frames > min(_MOST_FRAMES, _MOST_EMPTY * len(t_ns)):
        problem = f"{len(t_ns)} times are scattered over {frames} frames"
        raise DataError(source, problem, "reconstruct it at a --rate, or export csv")
    step_ns = int(t_ns[-1] - t_ns[0]) / (frames - 1)
    even_ns = t_ns[0] + np.rint(np.arange(frames) * step_ns).astype(np.int64)
    off_ns = int(np.abs(t_ns - even_ns[index]).max())
    if off_ns <= _KEPT_NS:
        if off_ns > 1000:
            progress.note(f"{source}: times are up to {off_ns / 1e6:.3f} ms off a constant rate; kept")
        row = np.full(len(even_ns), -1)
        row[index] = np.arange(len(index))
        position = _rows(motion.position, row)
    else:
        progress.note(
            f"{source}: times are up to {off_ns / 1e6:.3f} ms off a constant rate; "
            f"positions were interpolated to {1e9 / step_ns:.6g} Hz"
        )
        row, longest_ns = nearest_rows(t_ns, even_ns), round(_LONGEST_STEP * step_ns)
        position = interpolate_points(t_ns, motion.position, even_ns, max_gap_ns=longest_ns)
    even = _taken(motion, row, replace(motion, t_ns=even_ns, position=position))
    return EvenMotion(even, 1e9 / step_ns, frames - len(t_ns))


def _taken(motion: JointMotion, row: Int64, even: JointMotion) -> JointMotion:
    """Return the new positions with the covariances of these rows, where there is a position."""
    if motion.covariance is None:
        return replace(even, status=None, reprojection_px=None, views=None)
    missing = np.isnan(even.position).any(axis=-1, keepdims=True)
    covariance = np.where(missing, np.nan, _rows(motion.covariance, row))
    return replace(even, covariance=covariance, status=None, reprojection_px=None, views=None)


def _rows(values: Float, row: Int64) -> Float:
    taken = values[np.maximum(row, 0)]
    taken[row < 0] = np.nan
    return taken


def describe_motion(motion: JointMotion) -> dict[str, object]:
    """Return joints, people, times, share of missing joints, bounding box of the positions."""
    return {
        "rows": len(motion.t_ns),
        "people": motion.position.shape[1],
        "joints": list(motion.joints),
        **(describe_times(motion.t_ns) if motion.timed else {"times": "none: its frames are counted"}),
        "missing_share": round(float(np.isnan(motion.position).any(axis=-1).mean()), 4),
        **bounding_box(motion.position.reshape(-1, 3)),
    }


def metric_unit(stated: str) -> str:
    """Return m, cm or mm for a unit's name in files; any other name as it is."""
    unit = _UNITS.get(stated.lower(), stated.lower())
    return unit if unit in METRES else stated


def marker_name(joint: str) -> str:
    """Return Pose2Sim's and OpenSim's name of our joint, RBigToe for right_big_toe; else the name itself."""
    return _MARKERS.get(joint, joint)


def _camel_case(joint: str) -> str:
    words = joint.split("_")
    if words[0] in {"left", "right"}:
        words[0] = words[0][0]
    return "".join(word[0].upper() + word[1:] for word in words)


_MARKERS = {joint: _camel_case(joint) for skeleton in SKELETONS.values() for joint in skeleton.joints}


def joint_names(markers: tuple[str, ...]) -> tuple[str, ...]:
    """Return our names of known markers; if two markers mean one joint, only the first gets its name."""
    names: dict[str, None] = {}
    given = []
    for marker in markers:
        joint = joint_called(marker) or joint_called(marker.removeprefix("body_")) or marker  # FreeMoCap's
        given.append(marker if joint in names else joint)
        names[given[-1]] = None
    return tuple(given)


# Bones that begin at a joint, without side and separators: Biovision's, Acclaim's, Mixamo's, Blender's names.
BONE_NAMES = own_table(__file__, "bones")
"""Names of bones in files of motion."""


def bone_joints(bones: tuple[str, ...]) -> tuple[str, ...]:
    """Name the joints at which bones begin: ours where the bone is known, else the bone's own name.

    Acclaim's bone `head` begins at the base of the skull: it must not pass for our joint `head`, its top.
    """
    plain = {bone: re.sub(r"[^a-z]", "", bone.rsplit(":", 1)[-1].lower()) for bone in bones}
    named: dict[str, str] = {}
    for side in ("left", "right"):
        for joint, variants in BONE_NAMES["of_a_side"].items():
            for variant in variants:
                ways = {f"{side}{variant}", f"{side[0]}{variant}", f"{variant}{side[0]}", f"{variant}{side}"}
                found = next((bone for bone in bones if plain[bone] in ways and bone not in named), None)
                if found:
                    named[found] = f"{side}_{joint}"
                    break
    for joint, variants in BONE_NAMES["in_the_middle"].items():
        found = next((bone for variant in variants for bone in bones if plain[bone] == variant), None)
        if found:
            named[found] = joint
    if any(name.endswith("femur") for name in plain.values()):
        named |= {bone: "head_base" for bone in bones if bone == "head"}
    return tuple(named.get(bone, bone) for bone in bones)


# So many times of a table are text at once, which bounds the memory.
_TIMES_AT_ONCE = 1000
# More dense cells for a row mean scattered times or names and exhaust the memory.
_MOST_CELLS_PER_ROW = 100


# Tables of devices have one or two points of such columns.
LEAST_JOINTS_OF_WIDE = 4
# The column of frame numbers of caliscope, and of other programs.
_FRAME_NAMES = ("sync_index", "frame")
# Tables of all points of FreeMoCap and of caliscope have these columns.
_FREEMOCAP = {"frame", "model", "keypoint", "x", "y", "z"}
_CALISCOPE = {"sync_index", "point_id", "x_coord", "y_coord", "z_coord"}


@dataclass(frozen=True)
class JointFile(TextFormat):
    """Reader of joints in text: `is_known` recognises its beginning, `read` takes path, unit and axes."""

    read: Callable[[Path, str | None, str | None], JointMotion]

    def describe(self, path: Path) -> dict[str, object]:
        """Describe joints, people, times, missing values, and the box in the world (z up)."""
        return describe_motion(self.read(path, None, None))

    def read_joints(self, path: Path, *, unit: str | None, axes: str | None) -> JointMotion:
        """Read every joint."""
        return self.read(path, unit, axes)


def _read_csv(path: Path, unit: str | None, axes: str | None) -> JointMotion:
    """Read the header `t_ns,[person,]joint,x,y,z` in any order; the time may be t, time, ... in seconds.

    Tables with a row for each time are read, too: time, nose_x, nose_y, nose_z, ... (FreeMoCap, caliscope),
    and theirs with a row for each frame and point (FreeMoCap's in mm). Frames without times are counted.
    Metres and z up unless the user states otherwise. Rows of single joints may come in any order; people are
    ranked by their number. A position that is blank, infinite or absent is missing (NaN).
    """
    text = read_text(path)
    if _is_long(text):
        return _read_long(path, text, unit, axes or "z-up")
    heading = _find_heading(text)
    if heading is None and (columns := _joints_of_wide(text)):
        return _read_wide(path, text, columns, unit or "m", axes or "z-up")
    if heading is None:
        problem = "has no header that names the time, joint and x y z"
        raise DataError(path, problem, "begin with t_ns,joint,x,y,z", code="missing-column")
    names = heading.names
    words = {name: column for name, column in names.items() if name in ("joint", "person")}
    table = rows_below(path, heading, text, words, {axis: names[axis] for axis in "xyz"})
    stamps = _stamps(path, heading, table)
    position = to_metres_z_up(path, table.stack(("x", "y", "z")), unit or "m", axes or "z-up")
    people = _people(path, table.text.get("person"), len(stamps))
    return _dense(path, stamps, people, table.text["joint"], position)


def _stamps(path: Path, heading: Heading, table: TextTable) -> Int64:
    """Return the times of a table that is whole and has one in every row."""
    if table.truncated:
        remedy = "copy the file again, or delete that line"
        raise DataError(path, "its last line broke off", remedy, code="damaged")
    column = table.text["stamp"]
    stamps, readable = parse_stamps(path, column, heading.unit, unit_stated=heading.unit_stated)
    if not readable.all():
        raise damaged(path, f"{np.count_nonzero(~readable)} rows have no readable time")
    return stamps


def _joints_of_wide(text: str) -> dict[str, int]:
    """Return the column of x of every point that has columns `NAME_x`, `NAME_y`, `NAME_z`, side by side."""
    names = [cell_name(cell)[0] for cell in text.split("\n", 1)[0].split(",")]
    threes = zip(names, names[1:], names[2:], strict=False)
    return {
        x[:-2]: column
        for column, (x, y, z) in enumerate(threes)
        if x[-2:] == "_x" and (y, z) == (f"{x[:-2]}_y", f"{x[:-2]}_z")
    }


def _read_wide(path: Path, text: str, columns: dict[str, int], unit: str, axes: str) -> JointMotion:
    first = text.split("\n", 1)[0]
    numbers = {f"{joint} {k}": column + k for joint, column in columns.items() for k in range(3)}
    timed = find_heading(first, delimiters=",")
    cells = [cell_name(cell)[0] for cell in first.split(",")]
    numbered = next((cells.index(name) for name in _FRAME_NAMES if name in cells), None)
    heading = timed or Heading(0, ",", len(cells), numbered or 0, SECONDS, {})
    table = rows_below(path, heading, text, {}, numbers)
    has_stamps = timed is not None or numbered is not None
    if has_stamps and pc.all(pc.equal(pc.utf8_trim_whitespace(table.text["stamp"]), "")).as_py():
        timed, has_stamps = None, False  # FreeMoCap's column of times may be empty
    counted = np.arange(len(table.text["stamp"])) * 10**9
    stamps = _stamps(path, heading, table) if has_stamps else counted
    if (np.diff(stamps) <= 0).any():
        raise DataError(path, "its times do not increase", "sort its rows", code="bad-value")
    position = to_metres_z_up(path, table.stack([*numbers]).reshape(len(stamps), len(columns), 3), unit, axes)
    return JointMotion(stamps, joint_names(tuple(columns)), position[:, None], timed=timed is not None)


def _columns(text: str) -> set[str]:
    return {cell_name(cell)[0] for cell in text.split("\n", 1)[0].split(",")}


def _is_long(text: str) -> bool:
    return any(_columns(text) >= known for known in (_FREEMOCAP, _CALISCOPE))


def _read_long(path: Path, text: str, unit: str | None, axes: str) -> JointMotion:
    """Read a row for each frame and point; hands, face, centres of mass and rigid bodies are left out."""
    try:
        table = pd.read_csv(StringIO(text), dtype=str, keep_default_na=False)
    except ValueError as error:
        raise damaged(path, error) from error
    headings = [cell_name(cell) for cell in table.columns]
    table.columns = pd.Index([name for name, _ in headings])
    if not table.columns.is_unique:
        raise DataError(path, "names a column more than once", "rename one", code="stated-twice")
    units = dict(headings)
    unit = unit or metric_unit(units.get("x_coord") or units.get("x") or "")
    if _columns(text) >= _CALISCOPE:
        table["keypoint"] = table["point_id"].map(points_of_caliscope(path))
        table = table[table["keypoint"].notna()]
        columns, unit = ["sync_index", "x_coord", "y_coord", "z_coord"], unit or "m"
    else:
        is_body = table["model"].str.contains("body")
        if "trajectory" in table:
            is_body &= table["trajectory"] == "3d_xyz"
        table, columns, unit = table[is_body], ["frame", *"xyz"], unit or "mm"
    numbers = table[columns].apply(pd.to_numeric, errors="coerce").to_numpy(np.float64)
    if not len(table) or not (np.abs(numbers[:, 0]) < _MOST_FRAMES).all():
        raise damaged(path, "has no keypoint of a body, or rows without a frame")
    position = to_metres_z_up(path, numbers[:, 1:], unit, axes)
    t_ns = np.rint(numbers[:, 0] * 1e9).astype(np.int64)
    names = pa.chunked_array([table["keypoint"].tolist()])
    motion = _dense(path, t_ns, np.zeros(len(t_ns), np.int64), names, position)
    return replace(motion, joints=joint_names(motion.joints), timed=False)


def _find_heading(text: str) -> Heading | None:
    heading = find_heading(text.split("\n", 1)[0], delimiters=",")
    return heading if heading and heading.names.keys() >= {"joint", "x", "y", "z"} else None


def _people(path: Path, column: pa.ChunkedArray | None, rows: int) -> Int64:
    """Return people [N] as whole numbers; 0 if the file has no such column."""
    if column is None:
        return np.zeros(rows, dtype=np.int64)
    try:
        numbers = pc.cast(pc.utf8_trim_whitespace(column), pa.int64())
    except pa.ArrowInvalid as error:
        problem = "holds a person that is no whole number"
        raise DataError(path, problem, "number the people 0, 1, ...") from error
    if numbers.null_count:
        raise DataError(path, f"{numbers.null_count} rows name no person", "number the people 0, 1, ...")
    return np.asarray(numbers.to_numpy(), dtype=np.int64)


def _dense(path: Path, stamps: Int64, people: Int64, names: pa.ChunkedArray, position: Float) -> JointMotion:
    t_ns, row = np.unique(stamps, return_inverse=True)
    persons, person = np.unique(people, return_inverse=True)
    joint, joints = pd.factorize(pd.Series(names.to_pylist(), dtype=object).fillna("").str.strip())
    if not len(t_ns) or "" in joints:
        raise DataError(path, "holds no joints, or rows without a joint's name", "write t_ns,joint,x,y,z")
    shape = (len(t_ns), len(persons), len(joints))
    cells = shape[0] * shape[1] * shape[2]
    if cells > _MOST_CELLS_PER_ROW * len(stamps) + 10**6:
        raise DataError(
            path,
            f"{len(stamps)} rows are scattered over {shape[0]} times, {shape[1]} people, {shape[2]} joints",
            "check the columns of time, person and joint",
        )
    flat = np.ravel_multi_index((row, person, joint), shape)
    twice = np.flatnonzero(np.bincount(flat, minlength=cells) > 1)
    if len(twice):
        t, p, j = np.unravel_index(twice[0], shape)
        problem = (
            f"{len(twice)} joints are stated more than once at one time, first {joints[j]} of person "
            f"{persons[p]} at {t_ns[t]} ns"
        )
        raise DataError(path, problem, "leave one row for each", code="stated-twice")
    dense = np.full((cells, 3), np.nan)
    dense[flat] = position
    return JointMotion(t_ns=t_ns, joints=tuple(map(str, joints)), position=dense.reshape(*shape, 3))


def write_joints(path: Path, motion: JointMotion) -> None:
    """Write `t_ns,person,joint,x,y,z` and all other known values (covariance in m^2); NaN is blank."""
    people, joints = motion.position.shape[1:3]
    with path.open("w", encoding="utf-8", newline="") as file:
        for first in range(0, max(len(motion.t_ns), 1), _TIMES_AT_ONCE):
            some = slice(first, first + _TIMES_AT_ONCE)
            times = len(motion.t_ns[some])
            columns: dict[str, object] = {
                "t_ns": np.repeat(motion.t_ns[some], people * joints),
                "person": np.tile(np.repeat(np.arange(people), joints), times),
                "joint": np.tile(np.array(motion.joints, dtype=object), times * people),
                **dict(zip("xyz", motion.position[some].reshape(-1, 3).T, strict=True)),
            }
            if motion.covariance is not None:
                upper = motion.covariance[some].reshape(-1, 6).T
                columns |= dict(zip(POINT_COVARIANCE_COLUMNS, upper, strict=True))
            for name in ("views", "status", "reprojection_px"):
                if (values := getattr(motion, name)) is not None:
                    columns[name] = values[some].ravel()
            pd.DataFrame(columns).to_csv(file, index=False, header=not first, lineterminator="\n")


class CsvExport:
    """Writer of `<name>.csv`, the skeleton as a long table, and `<name>_<camera>.csv`, a camera's poses."""

    name = "csv"
    title = "long tables of the skeleton and of each camera's poses"

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write the joints, if there are any, and the poses of every camera."""
        name, motion, paths = safe_file_name(recording.name), recording.motion, []
        if motion is not None and motion.position.size:
            paths.append(folder / f"{name}.csv")
            write_joints(paths[-1], motion)
        else:
            note_no_skeleton(recording, "csv")
        for camera, trajectory in tracks_of(recording).items():
            paths.append(folder / f"{name}_{safe_file_name(camera)}.csv")
            write_pose_csv(paths[-1], trajectory)
        if not paths:
            raise DataError(recording.name, "holds neither joints nor camera poses", "reconstruct it first")
        return sorted(paths)


# Six decimals of a degree are below any measurement error.
_DECIMALS = 6


class AnglesExport:
    """Writer of `<name>_angles.csv` (the session's table) and `<name>_angles.sto` (`_<person>` of several).

    A STO has the angles in degrees, then their standard deviations (`<angle>_sigma`), and seconds since
    `recording.zero_ns`. OpenSim stops reading at a NaN: times at which an angle is not known are left out,
    and before that angles that are rarely known.
    """

    name = "angles"
    title = "joint angles with standard deviations, as CSV and for OpenSim (STO)"
    choices: Mapping[str, tuple[str, ...]] = {"unit": ("deg",), "axes": ("none",), "time": ("zero", "epoch")}

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write both files; a person without any angle gets no STO."""
        table = recording.angles()
        if table is None or not len(table) or table["value_deg"].isna().all():
            problem, remedy = "holds no joint angles to export", "run `mocap reconstruct` first"
            raise DataError(recording.name, problem, remedy, code="nothing-reconstructed")
        name = safe_file_name(recording.name)
        paths = [folder / f"{name}_angles.csv"]
        table.to_csv(paths[0], index=False, lineterminator="\n")
        people = int(table["person"].max()) + 1
        shape = (-1, people, len(ANGLES))
        t_ns = table["t_ns"].to_numpy(np.int64).reshape(shape)[:, 0, 0]
        value, sigma = (
            table[name].to_numpy(np.float64).reshape(shape) for name in ("value_deg", "sigma_deg")
        )
        known = np.flatnonzero(np.isfinite(value).any(axis=(0, 2))).tolist()
        named = file_names_of_people(recording, value.shape[1])
        for person in known:
            which = f"_{named[person]}" if value.shape[1] > 1 else ""
            paths.append(folder / f"{name}_angles{which}.sto")
            left_out = write_sto(paths[-1], t_ns - recording.zero_ns, value[:, person], sigma[:, person])
            if left_out:
                recording.progress.note(f"angles: {paths[-1].name} leaves out {left_out}, not known")
        return sorted(paths)


def write_sto(path: Path, t_ns: Int64, value_deg: Float, sigma_deg: Float) -> str:
    """Write angles and standard deviations [T, A] deg in the order of `ANGLES`; say what is left out."""
    # OpenSim stops at a gap: of the angles, from the least known on, as many go as leave most numbers.
    there = np.isfinite(value_deg)
    ranked = np.argsort(there.sum(axis=0), kind="stable")[np.count_nonzero(~there.any(axis=0)) :]
    choices = [np.sort(ranked[first:]) for first in range(len(ranked))]
    kept = max(
        choices, key=lambda own: len(own) * np.count_nonzero(there[:, own].all(axis=1)), default=ranked
    )
    whole: Bool = np.asarray(there[:, kept].all(axis=1))
    value, sigma = value_deg[np.ix_(whole, kept)], sigma_deg[np.ix_(whole, kept)]
    known = np.flatnonzero(np.isfinite(sigma).all(axis=0))
    names = [list(ANGLES)[k] for k in kept]
    columns = ["time", *names, *(f"{names[k]}_sigma" for k in known)]
    lines = [path.stem, "version=1", f"nRows={len(value)}", f"nColumns={len(columns)}", "inDegrees=yes"]
    lines += ["endheader", "\t".join(columns)]
    for stamp, row in zip(format_seconds(t_ns[whole]), np.hstack([value, sigma[:, known]]), strict=True):
        lines.append("\t".join([stamp, *(f"{number:.{_DECIMALS}f}" for number in row.tolist())]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
    lost = {"times": int(np.count_nonzero(~whole)), "angles": len(ANGLES) - len(kept)}
    return ", ".join(f"{count} {what}" for what, count in lost.items() if count)


JOINTS_CSV = JointFile(
    "joints_csv",
    "3D joints as CSV",
    (".csv", ".txt"),
    lambda head: (
        _find_heading(head) is not None
        or _is_long(head)
        or len(_joints_of_wide(head)) >= LEAST_JOINTS_OF_WIDE
    ),
    _read_csv,
)
CSV_EXPORT = CsvExport()
ANGLES_EXPORT = AnglesExport()
