"""The true joints of a session, at the times at which others are compared with them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.poses import interpolate_points
from pipelines.session.records import Float, Int64, JointMotion

_MOST_STREAMS = 8  # cameras or trackers whose samples take turns
_LEAST_TURNS = 4  # before it can be said that they repeat
_ALIKE = 0.2  # of a step on the average: what times that are the same may differ by
_MOST = 0.6  # of all times: so many must be alike
_HARDLY_MORE = 0.1  # of all times: more streams must make so many more of them alike
_LONGER = 1.2  # times the usual longest step, at least, may lie between two samples
_OF_NO_ORDER = 1.5  # times the 90th percentile of steps that do not repeat


def true_joints_at(truth: JointMotion, t_ns: Int64) -> Float:
    """Interpolate true positions [T, P, J, 3] at given times, linearly.

    NaN outside the stamps of the truth, beside a sample that misses the joint, and across a hole
    (`longest_step_ns`).
    """
    return interpolate_points(truth.t_ns, truth.position, t_ns, max_gap_ns=longest_step_ns(truth.t_ns))


def longest_step_ns(t_ns: Int64) -> int:
    """Return the longest step between samples that is no hole.

    Truth may be sampled when any of several cameras takes its picture. Cameras of 25 Hz with shutters of
    their own give steps of 8 and 32 ms by turns: neither is a hole, and the usual step is no measure. So the
    number of steps is looked for after which they repeat. A missing sample joins two steps, and the limit
    lies half way between the longest usual step and the shortest such sum above it: 1.5 steps where all are
    alike. Streams of different rates never repeat; of their steps the 90th percentile counts.

    Args:
        t_ns: [N] strictly increasing.

    Returns:
        0 for fewer than two samples.
    """
    steps = np.diff(t_ns).astype(np.float64)
    if not len(steps):
        return 0
    turns = [
        np.lib.stride_tricks.sliding_window_view(steps, streams)
        for streams in range(1, max(1, min(_MOST_STREAMS, len(steps) // _LEAST_TURNS)) + 1)
    ]
    alike = [_alike(each.sum(axis=1), _ALIKE / each.shape[1]) for each in turns]
    shares = [float(which.mean()) for which in alike]
    if max(shares) <= _MOST:
        return int(_OF_NO_ORDER * np.percentile(steps, 90))
    least = next(k for k, share in enumerate(shares) if share >= max(shares) - _HARDLY_MORE)
    usual = turns[least][alike[least]]
    longest = usual.max(axis=1)
    joined = usual + np.roll(usual, -1, axis=1)
    hole = np.where(joined > longest[:, None], joined, np.inf).min(axis=1)
    step = float(np.percentile(longest, 95))
    return int(max((step + float(np.median(hole))) / 2, _LONGER * step))


def _alike(times: Float, share: float) -> NDArray[np.bool_]:
    """Tell which times differ from their median by no more than a share of it."""
    usual = np.median(times)
    return np.asarray(np.abs(times - usual) <= share * usual)
