"""Cleaning of logged poses into a trajectory: one set of rules for every text format."""

from __future__ import annotations

from bisect import bisect_left
from pathlib import Path

import numpy as np

from pipelines.formats.common.rows import bounding_box, describe_times
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
    keep = np.ones(len(t_ns), dtype=np.bool_)
    for cause, bad in causes.items():
        _drop(keep, bad, cause, dropped)
    late = np.flatnonzero(keep)
    if len(late) > 1:
        stamps = t_ns[late]
        duplicate = np.zeros(len(stamps), dtype=np.bool_)
        duplicate[1:] = stamps[1:] == stamps[:-1]
        rising = longest_rising(stamps)
        for cause, bad in (("duplicate stamp", duplicate), ("stamp out of order", ~rising)):
            _drop(keep, np.isin(np.arange(len(keep)), late[bad]), cause, dropped)
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


def longest_rising(stamps: Int64) -> Bool:
    """Mark the longest strictly rising chain of stamps, so that one wrong stamp costs one row only.

    Patience sorting (Fredman 1975). Of equally long chains, the one with the smallest last stamp is taken.
    """
    if (np.diff(stamps) > 0).all():
        return np.ones(len(stamps), dtype=np.bool_)
    tails: list[int] = []  # smallest last stamp of a chain of each length
    places: list[int] = []  # and the row of that stamp
    before = np.full(len(stamps), -1, dtype=np.int64)
    for place, stamp in enumerate(stamps.tolist()):
        length = bisect_left(tails, stamp)
        if length < len(tails) and tails[length] == stamp:
            continue  # of equal stamps the first stays
        before[place] = places[length - 1] if length else -1
        tails[length : length + 1] = [stamp]
        places[length : length + 1] = [place]
    chain = np.zeros(len(stamps), dtype=np.bool_)
    place = places[-1]
    while place >= 0:
        chain[place] = True
        place = int(before[place])
    return chain


def _drop(keep: Bool, bad: Bool, cause: str, dropped: dict[str, int]) -> None:
    """Remove the rows from `keep`, in place, and count those that were still in it."""
    count = int(np.count_nonzero(keep & bad))
    if count:
        dropped[cause] = count
        keep &= ~bad


def describe_trajectory(trajectory: Trajectory) -> dict[str, object]:
    """Return rows, times, bounding box of the positions, and the rows dropped, by cause."""
    return {
        "rows": len(trajectory.t_ns),
        **describe_times(trajectory.t_ns),
        **bounding_box(trajectory.position),
        "covariance": "yes" if trajectory.covariance is not None else "no",
        **{f"dropped: {cause}": count for cause, count in trajectory.dropped.items()},
    }
