"""Poses as CSV with a header that names the columns; EuRoC's ground truth is one of them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.formats.common.files import read_head, read_text
from pipelines.formats.common.rows import TextTable, cell_name, parse_stamps, parse_table, stamp_column
from pipelines.formats.poses.pose_rows import clean_poses, describe_trajectory
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.records import Trajectory

_POSITION = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_POSITION_PREFIX = r"t|p_|pos_|position_|p_rs_r_|translation_|pose_position_|pose_pose_position_"
_QUATERNION_PREFIX = r"q|q_|quat_|quaternion_|orientation_|q_rs_|pose_orientation_|pose_pose_orientation_"


@dataclass(frozen=True)
class Header:
    """Positions of the columns of a pose file."""

    line: int  # its index in the file
    delimiter: str
    columns: int
    stamp: int
    stamp_unit: int
    poses: dict[str, int]  # x, y, z, qx, qy, qz, qw and, if present, c00..c55


class PoseCsvFormat:
    """Reader of CSV with a header, separated by commas, semicolons or tabs; the order of columns is free.

    Needed: t_ns, or t, time, timestamp, stamp in seconds or with a unit (`time_ms`, `timestamp [ns]`);
    x y z (also tx, p_x, pos_x, position_x); qx qy qz qw (also q_x, orientation_x, q_RS_x).
    Optional: the covariance c00..c55, upper triangle, position in world and rotation vector in body.
    Other columns are ignored.
    """

    name = "csv"
    title = "poses as CSV"
    suffixes: tuple[str, ...] = (".csv", ".txt", ".tsv")

    def recognises(self, path: Path) -> bool:
        """Return True if the header names a time, a position and a quaternion."""
        return find_header(read_head(path, self.suffixes)) is not None

    def describe(self, path: Path) -> dict[str, object]:
        """Describe rows, times, gaps, bounding box and losses."""
        return describe_trajectory(self.read_trajectory(path))

    def read_trajectory(self, path: Path) -> Trajectory:
        """Read every pose; `clean_poses` documents which rows are dropped.

        Raises:
            DataError: not text, no such header, some covariance columns but not all, a line with another
                number of columns, stamps too large for their unit, or no usable row.
        """
        from pipelines.session.tables import COVARIANCE_COLUMNS

        text = read_text(path)
        header = find_header(text)
        if header is None:
            raise DataError(
                path,
                "has no header that names the time, x y z and qx qy qz qw",
                "name the columns t_ns,x,y,z,qx,qy,qz,qw (or t in seconds)",
            )
        missing = [name for name in COVARIANCE_COLUMNS if name not in header.poses]
        if 0 < len(missing) < len(COVARIANCE_COLUMNS):
            raise DataError(
                path, f"lacks the covariance columns {', '.join(missing)}", "give all 21 of them or none"
            )
        body = text.split("\n", header.line + 1)
        table = parse_table(
            path,
            body[header.line + 1] if len(body) > header.line + 1 else "",
            delimiter=header.delimiter,
            columns=header.columns,
            text={"stamp": header.stamp},
            numbers=header.poses,
            first_line=header.line + 2,
        )
        t_ns, readable = parse_stamps(path, table.text["stamp"], header.stamp_unit)
        return clean_poses(
            path,
            t_ns,
            readable,
            table.stack(_POSITION),
            table.stack(_QUATERNION),
            None if missing else _covariance(table),
            table.truncated,
        )


def find_header(text: str) -> Header | None:
    """Find the line above the numbers that names the columns of a pose; None if there is none.

    It is the first line that is no comment. It may also be a comment whose cells are separated by more than
    spaces (`#timestamp [ns],p_RS_R_x [m],...`). Comments of TUM files, with spaces only, do not count.
    """
    for index, line in enumerate(text.split("\n", 100)[:100]):
        stripped = line.strip()
        if not stripped:
            continue
        delimiter = next((mark for mark in ",;\t" if mark in stripped), None)
        header = _parse_header(index, stripped.split(delimiter), delimiter) if delimiter else None
        if header is not None or not stripped.startswith("#"):
            return header
    return None


def _parse_header(line: int, cells: Sequence[str], delimiter: str) -> Header | None:
    stamp = stamp_column(cells)
    poses: dict[str, int] = {}
    for index, cell in enumerate(cells):
        column = pose_column(cell_name(cell)[0])
        if column is not None:
            poses.setdefault(column, index)
    if stamp is None or any(name not in poses for name in (*_POSITION, *_QUATERNION)):
        return None
    return Header(line, delimiter, len(cells), stamp[0], stamp[1], poses)


def pose_column(name: str) -> str | None:
    """Return the table column of a heading; None if it is none of a pose."""
    covariance = re.fullmatch(r"c([0-5])([0-5])", name)
    if name in _POSITION or (covariance and covariance[1] <= covariance[2]):
        return name
    if match := re.fullmatch(rf"(?:{_POSITION_PREFIX})([xyz])", name):
        return match[1]
    if match := re.fullmatch(rf"(?:{_QUATERNION_PREFIX})([xyzw])", name):
        return "q" + match[1]
    return None


def _covariance(table: TextTable) -> Float:
    """Build symmetric matrices [N, 6, 6] from their upper triangles."""
    from pipelines.session.tables import COVARIANCE_COLUMNS

    upper = table.stack(COVARIANCE_COLUMNS)
    rows, columns = np.triu_indices(6)
    covariance = np.zeros((len(upper), 6, 6))
    covariance[:, rows, columns] = upper
    covariance[:, columns, rows] = upper
    return covariance


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write `t_ns,x,y,z,qx,qy,qz,qw` and any covariance, so that reading gives the same numbers."""
    import pandas as pd

    from pipelines.session.tables import COVARIANCE_COLUMNS

    columns: dict[str, object] = {"t_ns": trajectory.t_ns}
    columns |= dict(zip(_POSITION, trajectory.position.T, strict=True))
    columns |= dict(zip(_QUATERNION, trajectory.quaternion_xyzw.T, strict=True))
    if trajectory.covariance is not None:
        upper = trajectory.covariance[:, *np.triu_indices(6)]
        columns |= dict(zip(COVARIANCE_COLUMNS, upper.T, strict=True))
    pd.DataFrame(columns).to_csv(path, index=False, lineterminator="\n")


FORMAT = PoseCsvFormat()
