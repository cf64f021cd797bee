"""Cleaning of logged poses into a trajectory: one set of rules for every text format."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.formats.common.rows import bounding_box, describe_times, kept_rows
from pipelines.geometry.arrays import Bool, Float
from pipelines.session.errors import DataError
from pipelines.session.records import Int64, Trajectory

FARTHEST_M = 1e9
"""Largest coordinate: beyond the Moon, so no pose of a flight; squares of much larger ones overflow."""

NORM_TOLERANCE = 0.1
"""Largest deviation of a quaternion from unit length: up to this rounding explains it, beyond not."""


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

    - "truncated last line": rows that the reader already left out;
    - "not finite": a stamp or a number that is missing, NaN or infinite. A covariance that is blank
      as a whole is unknown (all zero) and keeps its row;
    - "zero quaternion", "quaternion not unit" (off by more than NORM_TOLERANCE; others are normalised);
    - "absurd position": further from the origin than FARTHEST_M;
    - "duplicate stamp", "stamp out of order": of the other rows, the longest chain of rising stamps is
      kept, so that one wrong stamp costs one row. Of equal stamps the first stays.

    Args:
        source: the file, for messages.
        t_ns: [N] stamps.
        readable: [N] True if the stamp could be read.
        position: [N, 3] m.
        quaternion_xyzw: [N, 4].
        covariance: [N, 6, 6], if there is one.
        truncated: number of rows that the reader left out at the end.

    Raises:
        DataError: no row is left.
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
        raise DataError(source, f"holds no usable pose ({counts})", "check how it was written")
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
