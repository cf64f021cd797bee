"""Resampling of motion to a constant rate, for formats that number their frames and store no times."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import interpolate_points
from pipelines.session.errors import DataError
from pipelines.session.progress import Progress
from pipelines.session.records import Int64, JointMotion

_KEPT_NS = 500_000  # a sample this near to its frame keeps its position: 1 mm of a hand at 2 m/s
_LONGEST_STEP = 1.5  # in frame steps: nothing is interpolated between times further apart
_MOST_FRAMES = 10_000_000
_MOST_EMPTY = 100  # frames per sample


@dataclass(frozen=True)
class EvenMotion:
    """Motion with a constant time step."""

    motion: JointMotion
    rate_hz: float
    empty: int  # frames between the samples without any measurement


def at_even_times(source: str, motion: JointMotion, progress: Progress) -> EvenMotion:
    """Assign a motion to frames at its usual step, from its first time to its last.

    Every sample gets a frame, and a pause becomes empty frames. Samples within half a
    millisecond of their frames stay as they are. If any is further off, all positions are interpolated
    linearly between neighbours (never across a missing one), and the covariances are those of the nearest
    sample. Both are noted, unless the stamps differ by rounding alone.

    Args:
        source: name of the motion for messages.
        motion: at least one time.
        progress: receives the notes.

    Raises:
        DataError: the times are too scattered for a rate.
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
        raise DataError(
            source,
            f"{len(t_ns)} times are scattered over {frames} frames",
            "reconstruct it at a --rate, or export csv",
        )
    step_ns = int(t_ns[-1] - t_ns[0]) / (frames - 1)
    even_ns = t_ns[0] + np.rint(np.arange(frames) * step_ns).astype(np.int64)
    off_ns = int(np.abs(t_ns - even_ns[index]).max())
    if off_ns <= _KEPT_NS:
        if off_ns > 1000:
            progress.note(f"{source}: times are up to {off_ns / 1e6:.3f} ms off a constant rate; kept")
        even = _spread(motion, even_ns, index)
    else:
        progress.note(
            f"{source}: times are up to {off_ns / 1e6:.3f} ms off a constant rate; "
            f"positions were interpolated to {1e9 / step_ns:.6g} Hz"
        )
        even = _interpolated(motion, even_ns, round(_LONGEST_STEP * step_ns))
    return EvenMotion(even, 1e9 / step_ns, frames - len(t_ns))


def _spread(motion: JointMotion, even_ns: Int64, index: Int64) -> JointMotion:
    """Put the samples as they are at their frames; NaN in between."""
    row = np.full(len(even_ns), -1)
    row[index] = np.arange(len(index))
    return _taken(motion, row, replace(motion, t_ns=even_ns, position=_rows(motion.position, row)))


def _interpolated(motion: JointMotion, even_ns: Int64, longest_ns: int) -> JointMotion:
    position = interpolate_points(motion.t_ns, motion.position, even_ns, max_gap_ns=longest_ns)
    after = np.clip(np.searchsorted(motion.t_ns, even_ns), 1, len(motion.t_ns) - 1)
    is_before = even_ns - motion.t_ns[after - 1] <= motion.t_ns[after] - even_ns
    return _taken(motion, after - is_before, replace(motion, t_ns=even_ns, position=position))


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


def thinned(t_ns: Int64, rate_hz: float) -> Int64:
    """Choose rows of sorted times: the first of every 1 / rate_hz seconds; none for a rate of 0."""
    if not rate_hz or not len(t_ns):
        return np.zeros(0, np.int64)
    period = np.floor((t_ns - t_ns[0]) * (rate_hz / 1e9) + 1e-6)
    return np.flatnonzero(np.diff(period, prepend=-1.0)).astype(np.int64)
