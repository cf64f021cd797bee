"""3D joints as a long CSV, one row per time, person and joint; and the csv export, also of camera poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.formats.common.exporting import write_tables
from pipelines.formats.common.files import read_head, read_text
from pipelines.formats.common.rows import Heading, find_heading, parse_stamps, rows_below
from pipelines.formats.poses import pose_csv
from pipelines.formats.skeletons.joint_files import describe_motion, joint_columns, to_metres_z_up
from pipelines.geometry.arrays import Float, Int64
from pipelines.session.errors import DataError
from pipelines.session.records import POINT_COVARIANCE_COLUMNS, JointMotion, Recording

if TYPE_CHECKING:
    import pyarrow as pa

_TIMES_AT_ONCE = 1000  # of a table that is written
_MOST_EMPTY = 100  # dense cells per row above which a file is refused as scattered


class JointsCsvFormat:
    """Reader of the header `t_ns,[person,]joint,x,y,z` in any order; the time may be t, time, ... in seconds.

    Metres and z up unless the user states otherwise. Rows may come in any order. People are ranked by
    their number, joints in order of appearance. A position that is blank, infinite or absent is
    missing (NaN).
    """

    name = "joints_csv"
    title = "3D joints as CSV"
    suffixes: tuple[str, ...] = (".csv", ".txt")

    def recognises(self, path: Path) -> bool:
        """Return True if the header names a time, a joint and x y z."""
        return _find_heading(read_head(path, self.suffixes)) is not None

    def describe(self, path: Path) -> dict[str, object]:
        """Describe joints, people, times, missing values, and the box as if in metres with z up."""
        return describe_motion(self.read_joints(path, unit=None, axes=None))

    def read_joints(self, path: Path, *, unit: str | None, axes: str | None) -> JointMotion:
        """Read every joint."""
        text = read_text(path)
        heading = _find_heading(text)
        if heading is None:
            raise DataError(
                path,
                "has no header that names the time, joint and x y z",
                "begin with t_ns,joint,x,y,z",
                code="missing-column",
            )
        names = heading.names
        words = {name: column for name, column in names.items() if name in ("joint", "person")}
        table = rows_below(path, heading, text, words, {axis: names[axis] for axis in "xyz"})
        if table.truncated:
            raise DataError(
                path, "its last line broke off", "copy the file again, or delete that line", code="damaged"
            )
        stamps, readable = parse_stamps(
            path, table.text["stamp"], heading.unit, unit_stated=heading.unit_stated
        )
        if not readable.all():
            raise DataError(path, f"{np.count_nonzero(~readable)} rows have no readable time", "correct them")
        position = to_metres_z_up(path, table.stack(("x", "y", "z")), unit or "m", axes or "z-up")
        people = _people(path, table.text.get("person"), len(stamps))
        return _dense(path, stamps, people, table.text["joint"], position)


def _find_heading(text: str) -> Heading | None:
    """Parse the first line; None if it names no time, joint or position."""
    heading = find_heading(text.split("\n", 1)[0], delimiters=",")
    return heading if heading and heading.names.keys() >= {"joint", "x", "y", "z"} else None


def _people(path: Path, column: pa.ChunkedArray | None, rows: int) -> Int64:
    """Return people [N] as whole numbers; 0 if the file has no such column."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if column is None:
        return np.zeros(rows, dtype=np.int64)
    try:
        numbers = pc.cast(pc.utf8_trim_whitespace(column), pa.int64())
    except pa.ArrowInvalid as error:
        raise DataError(
            path, "holds a person that is no whole number", "number the people 0, 1, ..."
        ) from error
    if numbers.null_count:
        raise DataError(path, f"{numbers.null_count} rows name no person", "number the people 0, 1, ...")
    return np.asarray(numbers.to_numpy(), dtype=np.int64)


def _dense(path: Path, stamps: Int64, people: Int64, names: pa.ChunkedArray, position: Float) -> JointMotion:
    """Convert long rows [N] to dense arrays [T, P, J, 3]."""
    import pandas as pd

    t_ns, row = np.unique(stamps, return_inverse=True)
    persons, person = np.unique(people, return_inverse=True)
    joint, joints = pd.factorize(pd.Series(names.to_pylist(), dtype=object).fillna("").str.strip())
    if not len(t_ns) or "" in joints:
        raise DataError(path, "holds no joints, or rows without a joint's name", "write t_ns,joint,x,y,z")
    shape = (len(t_ns), len(persons), len(joints))
    cells = shape[0] * shape[1] * shape[2]
    if cells > _MOST_EMPTY * len(stamps) + 10**6:
        raise DataError(
            path,
            f"{len(stamps)} rows are scattered over {shape[0]} times, {shape[1]} people, {shape[2]} joints",
            "check the columns of time, person and joint",
        )
    flat = np.ravel_multi_index((row, person, joint), shape)
    twice = np.flatnonzero(np.bincount(flat, minlength=cells) > 1)
    if len(twice):
        t, p, j = np.unravel_index(twice[0], shape)
        raise DataError(
            path,
            f"{len(twice)} joints are stated more than once at one time, first {joints[j]} of person "
            f"{persons[p]} at {t_ns[t]} ns",
            "leave one row for each",
            code="stated-twice",
        )
    dense = np.full((cells, 3), np.nan)
    dense[flat] = position
    return JointMotion(t_ns=t_ns, joints=tuple(map(str, joints)), position=dense.reshape(*shape, 3))


def write_joints(path: Path, motion: JointMotion) -> None:
    """Write `t_ns,person,joint,x,y,z` and all other known values (covariance in m^2); NaN is blank."""
    import pandas as pd

    with path.open("w", encoding="utf-8", newline="") as file:
        for first in range(0, max(len(motion.t_ns), 1), _TIMES_AT_ONCE):
            some = slice(first, first + _TIMES_AT_ONCE)
            columns = joint_columns(replace(motion, t_ns=motion.t_ns[some], position=motion.position[some]))
            if motion.covariance is not None:
                upper = motion.covariance[some].reshape(-1, 6).T
                columns |= dict(zip(POINT_COVARIANCE_COLUMNS, upper, strict=True))
            if motion.views is not None:
                columns["views"] = motion.views[some].ravel()
            if motion.status is not None:
                columns["status"] = motion.status[some].ravel()
            if motion.reprojection_px is not None:
                columns["reprojection_px"] = motion.reprojection_px[some].ravel()
            pd.DataFrame(columns).to_csv(file, index=False, header=not first, lineterminator="\n")


class CsvExport:
    """Writer of `<name>.csv`, the skeleton as a long table, and `<name>_<camera>.csv`, a camera's poses."""

    name = "csv"
    title = "long tables of the skeleton and of each camera's poses, as text"

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write all tables of the recording."""
        return write_tables(recording, folder, ".csv", write_joints, pose_csv.write_trajectory)


FORMAT = JointsCsvFormat()
EXPORT = CsvExport()
