"""Rows of poses as logs have them to a clean trajectory: one set of rules for every text format."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.formats.stamps import Bool
from pipelines.session.errors import DataError
from pipelines.session.records import Float, Int64, Trajectory

NORM_TOLERANCE = 0.1
"""Quaternions this far from unit length are rounding or few decimals; further off they are no rotations."""


def clean_poses(
    source: Path | str,
    t_ns: Int64,
    readable: Bool,
    position: Float,
    quaternion_xyzw: Float,
    covariance: Float | None = None,
    truncated: int = 0,
) -> Trajectory:
    """Leave out the rows that cannot be used, each counted under the first cause that applies.

    - "truncated last line": what the reader already left out;
    - "not finite": a stamp or a number that is missing, NaN or infinite. A covariance that is blank
      as a whole is unknown (all zero) and keeps its row;
    - "zero quaternion", "quaternion not unit" (off by more than NORM_TOLERANCE; closer ones are normalised);
    - "duplicate stamp", "backward stamp": of the rows left, one is kept when its stamp is above the
      largest before it, so what was logged first stays. A stamp far in the future hides what follows
      it until time catches up; the count shows it.

    Args:
        source: the file, for messages.
        t_ns: [N] stamps.
        readable: [N] whether the stamp was one.
        position: [N, 3] m.
        quaternion_xyzw: [N, 4].
        covariance: [N, 6, 6], if there is one.
        truncated: rows the reader left out at the end.

    Raises:
        DataError: no row is left.
    """
    if covariance is not None:
        blank: Bool = np.asarray(np.isnan(covariance).all(axis=(1, 2)))
        covariance = np.where(blank[:, None, None], 0.0, covariance)
    with np.errstate(over="ignore"):  # what overflows becomes infinite and is dropped as such
        norm = np.linalg.norm(quaternion_xyzw, axis=1)
    causes = {
        "not finite": ~(readable & np.isfinite(position).all(axis=1) & np.isfinite(norm)),
        "zero quaternion": norm < 1e-9,
        "quaternion not unit": np.abs(norm - 1) > NORM_TOLERANCE,
    }
    if covariance is not None:
        causes["not finite"] |= ~np.isfinite(covariance).all(axis=(1, 2))

    dropped = {"truncated last line": truncated} if truncated else {}
    keep = np.ones(len(t_ns), dtype=np.bool_)
    for cause, bad in causes.items():
        _drop(keep, bad, cause, dropped)
    late = np.flatnonzero(keep)
    if len(late) > 1:
        before = np.maximum.accumulate(t_ns[late])[:-1]
        for cause, bad in (
            ("duplicate stamp", t_ns[late][1:] == before),
            ("backward stamp", t_ns[late][1:] < before),
        ):
            _drop(keep, np.isin(np.arange(len(keep)), late[1:][bad]), cause, dropped)
    if not keep.any():
        counts = ", ".join(f"{count} {cause}" for cause, count in dropped.items()) or "it has no rows"
        raise DataError(source, f"holds no usable pose ({counts})", "check how it was written")
    return Trajectory(
        t_ns=t_ns[keep],
        position=position[keep],
        quaternion_xyzw=quaternion_xyzw[keep] / norm[keep, None],
        covariance=None if covariance is None else covariance[keep],
        dropped=dropped,
    )


def _drop(keep: Bool, bad: Bool, cause: str, dropped: dict[str, int]) -> None:
    """Take the rows out of `keep`, in place, and count those that were still in."""
    count = int(np.count_nonzero(keep & bad))
    if count:
        dropped[cause] = count
        keep &= ~bad
