"""Positions of people that are known without a reconstruction: the logged actor, and true joints."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.poses import interpolate_points
from pipelines.session.description import Description
from pipelines.session.records import JointMotion
from pipelines.session.tables import ACTOR, Span, read_table

_GAP_NS = 2_000_000_000  # no interpolation between two stamps that are further apart


@dataclass(frozen=True)
class LoggedActor:
    """The actor's hips over time; from a logged head or feet, those of a standing person of 1.75 m."""

    t_ns: Int64  # [A] ascending
    hips: Float  # [A, 3] m, world

    def hips_at(self, t_ns: Int64) -> Float:
        """Interpolate the hips [T, 3] at given times; NaN where no logged position is near enough."""
        return interpolate_points(self.t_ns, self.hips, t_ns, max_gap_ns=_GAP_NS)


def logged_actor(folder: Path, description: Description, span_ns: Span | None = None) -> LoggedActor | None:
    """Load the actor of a session, the first of several; None where none was logged.

    Args:
        folder: the session.
        description: its session.json.
        span_ns: only what is known of these times.

    Raises:
        DataError: the table is damaged.
    """
    return next(iter(logged_people(folder, description, span_ns)), None)


def logged_people(folder: Path, description: Description, span_ns: Span | None = None) -> list[LoggedActor]:
    """Load all people of a session who were logged: person 0, 1, ... in this order.

    Args:
        folder: the session.
        description: its session.json.
        span_ns: only what is known of these times.

    Raises:
        DataError: the table is damaged.
    """
    entries = description.logged_people
    if not entries:
        return []
    about = None if span_ns is None else (span_ns[0] - _GAP_NS, span_ns[1] + _GAP_NS)
    table = read_table(folder / "actor.parquet", ACTOR, about)
    person, t_ns = table["person"].to_numpy(np.int64), table["t_ns"].to_numpy(np.int64)
    place = table[["x", "y", "z"]].to_numpy(np.float64)
    return [
        LoggedActor(t_ns[person == k], place[person == k] + [0.0, 0.0, entry.hip_above_m])
        for k, entry in enumerate(entries)
    ]


_MOST_STREAMS = 8  # most cameras or trackers with interleaved samples
_LEAST_TURNS = 4  # fewest repetitions to call a pattern periodic
_ALIKE = 0.2  # of the mean step: largest difference between times that count as equal
_MOST = 0.6  # smallest share of times that must be equal
_HARDLY_MORE = 0.1  # a larger number of streams must raise the share of equal times by more than this
_LONGER = 1.2  # smallest limit, as a multiple of the usual longest step
_OF_NO_ORDER = 1.5  # limit for steps that do not repeat, as a multiple of their 90th percentile


def true_joints_at(truth: JointMotion, t_ns: Int64) -> Float:
    """Interpolate true positions [T, P, J, 3] at given times, linearly.

    The result is NaN outside the stamps of the truth, next to a sample without the joint, and across a gap
    longer than `longest_step_ns`.
    """
    return interpolate_points(truth.t_ns, truth.position, t_ns, max_gap_ns=longest_step_ns(truth.t_ns))


def longest_step_ns(t_ns: Int64) -> int:
    """Return the longest step between samples that is not a gap.

    Truth may be sampled whenever one of several cameras takes a picture. Two cameras of 25 Hz that are not
    synchronised give alternating steps of 8 and 32 ms. Neither is a gap, and the median step is no measure.
    So the function finds the number of steps after which they repeat. A missing sample joins two steps. The
    limit lies half way between the longest usual step and the shortest such sum above it, which is 1.5 steps
    if all are equal. Streams of different rates never repeat; for them the limit is 1.5 times the 90th
    percentile of the steps.

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
    """Mark the times that differ from their median by no more than a share of it."""
    usual = np.median(times)
    return np.asarray(np.abs(times - usual) <= share * usual)
