"""Poses as CSV with a header that names the columns; EuRoC's ground truth is one of them."""

from pathlib import Path

import numpy as np

from pipelines.formats.common.files import read_head, read_text
from pipelines.formats.common.rows import TextTable, parse_stamps, rows_below
from pipelines.formats.poses.pose_rows import (
    POSITION,
    QUATERNION,
    clean_poses,
    describe_trajectory,
    find_poses,
)
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.records import Trajectory


class PoseCsvFormat:
    """Reader of CSV with a header, separated by commas, semicolons or tabs; the order of columns is free.

    Needed: t_ns, or t, time, timestamp, stamp in seconds or with a unit (`time_ms`, `timestamp [ns]`), or sec
    and nanosec;
    x y z (also tx, p_x, pos_x, position_x); qx qy qz qw (also q_x, orientation_x, q_RS_x).
    Optional: the covariance c00..c55, upper triangle, position in world and rotation vector in body.
    Other columns are ignored. `rostopic echo -p` writes such a table; the stamps of its headers are taken.
    """

    name = "csv"
    title = "poses as CSV"
    suffixes: tuple[str, ...] = (".csv", ".txt", ".tsv")

    def recognises(self, path: Path) -> bool:
        """Return True if the header names a time, a position and a quaternion."""
        return find_poses(read_head(path, self.suffixes)) is not None

    def describe(self, path: Path) -> dict[str, object]:
        """Describe rows, times, gaps, bounding box and losses."""
        return describe_trajectory(self.read_trajectory(path))

    def read_trajectory(self, path: Path) -> Trajectory:
        """Read every pose; `clean_poses` documents which rows are dropped."""
        from pipelines.session.tables import COVARIANCE_COLUMNS

        text = read_text(path)
        found = find_poses(text)
        if found is None:
            raise DataError(
                path,
                "has no header that names the time, x y z and qx qy qz qw",
                "name the columns t_ns,x,y,z,qx,qy,qz,qw (or t in seconds)",
                code="missing-column",
            )
        heading, columns = found
        missing = [name for name in COVARIANCE_COLUMNS if name not in columns]
        if 0 < len(missing) < len(COVARIANCE_COLUMNS):
            raise DataError(
                path,
                f"lacks the covariance columns {', '.join(missing)}",
                "give all 21 of them or none",
                code="missing-column",
            )
        table = rows_below(path, heading, text, {}, columns)
        t_ns, readable = parse_stamps(
            path, table.text["stamp"], heading.unit, unit_stated=heading.unit_stated
        )
        return clean_poses(
            path,
            t_ns,
            readable,
            table.stack(POSITION),
            table.stack(QUATERNION),
            None if missing else _covariance(table),
            table.truncated,
        )


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
    columns |= dict(zip(POSITION, trajectory.position.T, strict=True))
    columns |= dict(zip(QUATERNION, trajectory.quaternion_xyzw.T, strict=True))
    if trajectory.covariance is not None:
        upper = trajectory.covariance[:, *np.triu_indices(6)]
        columns |= dict(zip(COVARIANCE_COLUMNS, upper.T, strict=True))
    pd.DataFrame(columns).to_csv(path, index=False, lineterminator="\n")


FORMAT = PoseCsvFormat()
