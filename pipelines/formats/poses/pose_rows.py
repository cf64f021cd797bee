"""Poses in text: names of columns, and cleaning into a trajectory by one set of rules for every format."""

import re
from pathlib import Path

import numpy as np

from pipelines.formats.common.rows import (
    NORM_TOLERANCE,
    Heading,
    bounding_box,
    describe_times,
    find_heading,
    kept_rows,
)
from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.session.errors import DataError
from pipelines.session.records import Trajectory

POSITION, QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
_POSITION_PREFIX = (
    r"t|p_|pos_|position_|p_rs_r_|(?:transform_)?translation_|pose_position_|pose_pose_position_"
)
_QUATERNION_PREFIX = (
    r"q|q_|quat_|quaternion_|orientation_|q_rs_|transform_rotation_|pose_orientation_|pose_pose_orientation_"
)

FARTHEST_M = 1e9
"""Largest coordinate: beyond the Moon, so no pose of a flight; squares of much larger ones overflow."""


def find_poses(text: str) -> tuple[Heading, dict[str, int]] | None:
    """Find the heading of a table of poses, and the columns x, y, z, qx, qy, qz, qw and any of c00..c55.

    It is the first line that is no comment. It may also be a comment whose cells are separated by more than
    spaces (`#timestamp [ns],p_RS_R_x [m],...`). Comments of TUM files, with spaces only, do not count.
    """
    for index, line in enumerate(text.split("\n", 100)[:100]):
        stripped = line.strip()
        if not stripped:
            continue
        heading = find_heading(stripped, index)
        columns: dict[str, int] = {}
        for name, place in heading.names.items() if heading else ():
            if (column := pose_column(name)) is not None:
                columns.setdefault(column, place)
        if heading is not None and all(name in columns for name in (*POSITION, *QUATERNION)):
            return heading, columns
        if not stripped.startswith("#"):
            return None
    return None


def pose_column(name: str) -> str | None:
    """Return the table column of a heading; None if it is none of a pose."""
    covariance = re.fullmatch(r"c([0-5])([0-5])", name)
    if name in POSITION or (covariance and covariance[1] <= covariance[2]):
        return name
    if match := re.fullmatch(rf"(?:{_POSITION_PREFIX})([xyz])", name):
        return match[1]
    if match := re.fullmatch(rf"(?:{_QUATERNION_PREFIX})([xyzw])", name):
        return "q" + match[1]
    return None


def clean_poses(
    source: Path | str,
    t_ns: Int64,
    readable: Bool,
    position: Float,
    quaternion_xyzw: Float,
    covariance: Float | None = None,
    truncated: int = 0,
) -> Trajectory:
    """Drop the rows that cannot be used, each counted under the first cause that applies.

    - "truncated last line": rows that the reader already left out at the end (`truncated`);
    - "not finite": a stamp or a number that is missing, NaN or infinite. A covariance that is blank
      as a whole is unknown (all zero) and keeps its row;
    - "zero quaternion", "quaternion not unit" (off by more than NORM_TOLERANCE; others are normalised);
    - "absurd position": further from the origin than FARTHEST_M;
    - "duplicate stamp", "stamp out of order" as in `kept_rows`.

    Args:
        t_ns: [N] stamps.
        readable: [N] True if the stamp could be read.
        position: [N, 3] m.
        quaternion_xyzw: [N, 4].
        covariance: [N, 6, 6], if there is one.
        truncated: number of rows left out before.
    """
    if covariance is not None:
        blank: Bool = np.asarray(np.isnan(covariance).all(axis=(1, 2)))
        if blank.any():
            covariance = np.where(blank[:, None, None], 0.0, covariance)
    with np.errstate(over="ignore"):  # an overflow gives infinity, which is dropped
        norm = np.linalg.norm(quaternion_xyzw, axis=1)
    causes = {
        "not finite": ~(readable & np.isfinite(position).all(axis=1) & np.isfinite(norm)),
        "zero quaternion": norm < 1e-9,
        "quaternion not unit": np.abs(norm - 1) > NORM_TOLERANCE,
    }
    with np.errstate(invalid="ignore"):
        causes["absurd position"] = np.abs(position).max(axis=1, initial=0.0) > FARTHEST_M
    if covariance is not None:
        causes["not finite"] |= ~np.isfinite(covariance).all(axis=(1, 2))

    dropped = {"truncated last line": truncated} if truncated else {}
    keep = kept_rows(t_ns, causes, dropped)
    if not keep.any():
        counts = ", ".join(f"{count} {cause}" for cause, count in dropped.items()) or "it has no rows"
        raise DataError(
            source, f"holds no usable pose ({counts})", "check how it was written", code="no-poses"
        )
    return Trajectory(
        t_ns=t_ns[keep],
        position=position[keep],
        quaternion_xyzw=quaternion_xyzw[keep] / norm[keep, None],
        # The largest part of a long log, so it is not copied if all rows are kept.
        covariance=covariance if covariance is None or keep.all() else covariance[keep],
        dropped=dropped,
    )


def describe_trajectory(trajectory: Trajectory) -> dict[str, object]:
    """Return rows, times, bounding box of the positions, and the rows dropped, by cause."""
    return {
        "rows": len(trajectory.t_ns),
        **describe_times(trajectory.t_ns),
        **bounding_box(trajectory.position),
        "covariance": "yes" if trajectory.covariance is not None else "no",
        **{f"dropped: {cause}": count for cause, count in trajectory.dropped.items()},
    }
