"""Comparison of sessions: measures of each, and the differences between them.

Every measure is a mean over values [T, K] at the skeleton's times: K joints (or bones, or one), NaN where
there is none. Where two sessions hold the same motion at the same times, they are compared value by value,
and the interval is that of the mean of those differences. Otherwise they are compared joint by joint: the
mean of a joint in one flight against its mean in the other, every joint with the same weight; the stretches
of the two flights are then resampled independently. In both cases the intervals are those of
`geometry.metrics`, and are valid for these flights only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.metrics import (
    Series,
    aligned_distances,
    interval_of,
    intervals,
    resampled,
    root_relative_distances,
)
from pipelines.reporting.content import MeasuredMotion, SessionContent, middles, text
from pipelines.reporting.summary import Summary, summarise

# The field counts a joint as right within this distance (PCK at 150 mm).
PCK_M = 0.15
# Sessions that share fewer of the shorter one's times were not recorded at the same times.
MIN_SHARED_TIMES = 0.5
# Truths closer than this (median) are one motion: at a walk, two stamps half a frame apart are 25 mm.
SAME_TRUTH_M = 0.05
# Without truth, people measured closer than this to each other (median) are the same one.
SAME_PLACE_M = 0.5
# Fewer common times leave no interval.
MIN_COMMON_TIMES = 10


@dataclass(frozen=True)
class Measure:
    """A measure by which sessions are compared."""

    key: str
    label: str
    unit: str
    digits: int
    better: Literal["less", "more", ""]  # empty where neither is better in itself
    meaning: str

    @property
    def name(self) -> str:
        """Label inside a sentence."""
        is_word = self.label[1].islower()
        return self.label[0].lower() + self.label[1:] if is_word else self.label


MEASURES = (
    Measure("mpjpe", "MPJPE", "mm", 1, "less", "mean distance of joints from truth, in the world"),
    Measure(
        "root_mpjpe", "Root-relative MPJPE", "mm", 1, "less", "the same with the hips laid on each other"
    ),
    Measure("pa_mpjpe", "PA-MPJPE", "mm", 1, "less", "after the best shift, turn and scale of each frame"),
    Measure(
        "pck150",
        "PCK at 150 mm",
        "%",
        1,
        "more",
        "share of true joints reconstructed within 150 mm; missing ones count as wrong",
    ),
    Measure(
        "reprojection", "Reprojection", "px", 2, "less", "mean distance from the keypoints, of the views used"
    ),
    Measure("share", "Reconstructed", "%", 1, "more", "share of joint-frames measured"),
    Measure(
        "predicted",
        "Predicted error",
        "mm",
        1,
        "less",
        "root of the trace of a joint's stated covariance, mean",
    ),
)
MEASURE_OF = {measure.key: measure for measure in MEASURES}


@dataclass(frozen=True)
class Values:
    """One measure of a session at its T times: [T, K], NaN where there is none, and the names of the K."""

    columns: tuple[str, ...]
    values: Float

    def series(self, columns: Sequence[int] | None = None) -> Series:
        """Return sums and weights [T] for the bootstrap."""
        taken = self.values if columns is None else self.values[:, list(columns)]
        there = np.isfinite(taken)
        return np.where(there, taken, 0.0).sum(axis=1), there.sum(axis=1, dtype=np.float64)

    def by_name(self) -> dict[str, Series]:
        """Return sums and weights of every name; people with that name are summed."""
        return {
            name: self.series([k for k, other in enumerate(self.columns) if other == name])
            for name in dict.fromkeys(self.columns)
        }


@dataclass(frozen=True)
class Estimate:
    """A number, with its interval where there is one."""

    value: float
    interval: tuple[float, float] | None

    @property
    def is_clear(self) -> bool:
        """True if the interval does not contain 0."""
        return self.interval is not None and (self.interval[0] > 0 or self.interval[1] < 0)


@dataclass(frozen=True)
class Judged:
    """One session by every measure that it has."""

    label: str
    content: SessionContent
    summary: Summary
    values: dict[str, Values]
    estimates: dict[str, Estimate]
    per_joint: dict[str, dict[str, Estimate]]  # measure: joint: estimate

    @property
    def t_ns(self) -> Int64:
        """Times of the skeleton; none without a skeleton."""
        motion = self.summary.motion
        return motion.t_ns if motion is not None else np.empty(0, dtype=np.int64)

    @property
    def method(self) -> str:
        """Method of the reconstruction; empty without one."""
        return text(self.summary.metrics, "method")


@dataclass(frozen=True)
class Difference:
    """Difference of a session's measure from that of the first."""

    estimate: Estimate
    pairs: int  # joint-frames (or moments, bones) that both have; joints where they are paired by joint
    first: float  # the two means over those pairs
    other: float
    lower: int  # number of `joints` that are lower than in the first session
    per_joint: dict[str, float]

    @property
    def joints(self) -> int:
        """Number of joints (bones, cameras) with a difference."""
        return len(self.per_joint)


@dataclass(frozen=True)
class Pair:
    """A session against the first."""

    first: Judged
    other: Judged
    by_time: bool  # else by joint
    times: int  # that both have; 0 where they are paired by joint
    differences: dict[str, Difference]

    @property
    def decisive(self) -> Measure | None:
        """Measure of the verdict: the error where both have truth, else the reprojection."""
        return next((MEASURE_OF[key] for key in ("mpjpe", "reprojection") if key in self.differences), None)

    @property
    def by_measure(self) -> list[tuple[Measure, Difference]]:
        """Differences with their measures, in the order of `MEASURES`."""
        return [(one, self.differences[one.key]) for one in MEASURES if one.key in self.differences]


@dataclass(frozen=True)
class Comparison:
    """Two or more sessions."""

    sessions: tuple[Judged, ...]
    pairs: tuple[Pair, ...]  # every session after the first, against it

    @property
    def measures(self) -> list[Measure]:
        """Measures that any session has."""
        return [one for one in MEASURES if any(one.key in judged.estimates for judged in self.sessions)]


def compare(contents: Mapping[str, SessionContent]) -> Comparison:
    """Measure sessions, by label, and compare every one with the first."""
    sessions = tuple(_judged(label, content) for label, content in contents.items())
    return Comparison(sessions, tuple(_pair(sessions[0], other) for other in sessions[1:]))


# --- one session ---


def _judged(label: str, content: SessionContent) -> Judged:
    summary = summarise(content)
    values = _values(summary, summary.motion) if summary.motion is not None else {}
    t_ns = summary.motion.t_ns if summary.motion is not None else np.empty(0, dtype=np.int64)
    whole = {key: one.series() for key, one in values.items()}
    joints = {key: one.by_name() for key, one in values.items()}
    return Judged(
        label=label,
        content=content,
        summary=summary,
        values=values,
        estimates=_estimates(whole, t_ns),
        per_joint={key: _estimates(series, t_ns) for key, series in joints.items()},
    )


def _estimates(series: Mapping[str, Series], t_ns: Int64) -> dict[str, Estimate]:
    found = intervals(series, t_ns)
    return {
        key: Estimate(float(sums.sum() / weights.sum()), found[key])
        for key, (sums, weights) in series.items()
        if weights.sum() > 0
    }


def _values(summary: Summary, motion: MeasuredMotion) -> dict[str, Values]:
    """Return every measure that has a value at all."""
    position = motion.measured_position
    listed = motion.status >= 0
    people = position.shape[1]
    variance = motion.covariance[..., [0, 3, 5]].sum(axis=-1)
    found = {
        "reprojection": np.where(motion.measured, motion.reprojection_px, np.nan),
        "share": np.where(listed, 100.0 * motion.measured, np.nan),
        "predicted": np.where(motion.measured, 1e3 * np.sqrt(np.maximum(variance, 0)), np.nan),
    }
    if summary.truth is not None and summary.errors_mm is not None:
        true = np.isfinite(summary.truth).all(axis=-1)
        within = np.nan_to_num(summary.errors_mm, nan=np.inf) <= 1e3 * PCK_M
        found |= {
            "mpjpe": summary.errors_mm,
            "root_mpjpe": 1e3 * root_relative_distances(position, summary.truth, motion.joints),
            "pa_mpjpe": 1e3 * aligned_distances(position, summary.truth),
            "pck150": np.where(true, 100.0 * within, np.nan),
        }
    values = {
        key: Values(motion.joints * people, array.reshape(len(array), -1)) for key, array in found.items()
    }
    return {key: one for key, one in values.items() if np.isfinite(one.values).any()}


# --- two sessions ---


def _pair(first: Judged, other: Judged) -> Pair:
    rows = _same_motion(first, other)
    differences = {}
    for measure in MEASURES:
        if measure.key in first.values and measure.key in other.values:
            ours, theirs = first.values[measure.key], other.values[measure.key]
            found = (
                _paired_by_joint(first, other, ours, theirs)
                if rows is None
                else _paired_by_time(first.t_ns[rows[0]], ours, theirs, rows)
            )
            if found is not None:
                differences[measure.key] = found
    return Pair(first, other, rows is not None, 0 if rows is None else len(rows[0]), differences)


def _same_motion(first: Judged, other: Judged) -> tuple[Int64, Int64] | None:
    """Find rows of the two that are the same moments of the same motion; None if they are not."""
    a, b = first.summary.motion, other.summary.motion
    if a is None or b is None:
        return None
    rows = _same_times(a.t_ns, b.t_ns)
    if len(rows[0]) < max(MIN_COMMON_TIMES, MIN_SHARED_TIMES * min(len(a.t_ns), len(b.t_ns))):
        return None
    ours, theirs = first.summary.truth, other.summary.truth
    if ours is not None and theirs is not None:
        shared = [name for name in a.joints if name in b.joints]
        place = [[motion.joints.index(name) for name in shared] for motion in (a, b)]
        apart = ours[rows[0]][:, 0, place[0]] - theirs[rows[1]][:, 0, place[1]]
        limit_m = SAME_TRUTH_M
    else:
        first_m, other_m = (middles(motion.measured_position)[:, 0] for motion in (a, b))
        apart, limit_m = first_m[rows[0]] - other_m[rows[1]], SAME_PLACE_M
    distance = np.linalg.norm(apart, axis=-1)
    known = distance[np.isfinite(distance)]
    return rows if known.size and float(np.median(known)) < limit_m else None


def _same_times(a: Int64, b: Int64) -> tuple[Int64, Int64]:
    """Match rows of [A] and [B] stamps within half a step of the denser one, each taken once."""
    if len(a) > len(b):
        theirs, ours = _same_times(b, a)
        return ours, theirs
    after = np.clip(np.searchsorted(b, a), 0, len(b) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(b[after] - a) < np.abs(b[before] - a), after, before)
    step = min((float(np.median(np.diff(t))) for t in (a, b) if len(t) > 1), default=0.0)
    near = np.abs(b[nearest] - a) <= step / 2
    rows = np.flatnonzero(near)
    chosen, at = np.unique(nearest[rows], return_index=True)
    return rows[at].astype(np.int64), chosen.astype(np.int64)


def _paired_by_time(
    t_ns: Int64, ours: Values, theirs: Values, rows: tuple[Int64, Int64]
) -> Difference | None:
    place = _places(theirs.columns)
    shared = [(k, place[at]) for at, k in _places(ours.columns).items() if at in place]
    mine, others = ([pair[end] for pair in shared] for end in (0, 1))
    a, b = ours.values[rows[0]][:, mine], theirs.values[rows[1]][:, others]
    both = np.isfinite(a) & np.isfinite(b)
    if not both.any():
        return None
    difference = Values(tuple(ours.columns[k] for k in mine), np.where(both, b - a, np.nan))
    series = difference.series()
    per_joint = {
        name: float(sums.sum() / weights.sum())
        for name, (sums, weights) in difference.by_name().items()
        if weights.sum() > 0
    }
    return Difference(
        Estimate(float(series[0].sum() / series[1].sum()), intervals({"": series}, t_ns)[""]),
        pairs=int(both.sum()),
        first=float(a[both].mean()),
        other=float(b[both].mean()),
        lower=sum(value < 0 for value in per_joint.values()),
        per_joint=per_joint,
    )


def _places(columns: Sequence[str]) -> dict[tuple[str, int], int]:
    """Return columns by name and person. The person is the number of earlier columns with that name."""
    seen: dict[str, int] = {}
    places = {}
    for k, name in enumerate(columns):
        places[name, seen.get(name, 0)] = k
        seen[name] = seen.get(name, 0) + 1
    return places


def _paired_by_joint(first: Judged, other: Judged, ours: Values, theirs: Values) -> Difference | None:
    a, b = ours.by_name(), theirs.by_name()
    names = [name for name in a if name in b and a[name][1].sum() > 0 and b[name][1].sum() > 0]
    if not names:
        return None
    means = np.array([[float(one[name][0].sum() / one[name][1].sum()) for one in (a, b)] for name in names])
    # The two flights are independent, and so are the stretches drawn from them.
    drawn = [
        resampled({name: series[name] for name in names}, judged.t_ns, seed=seed)
        for seed, (judged, series) in enumerate(((first, a), (other, b)))
    ]
    change = np.mean([drawn[1][name] - drawn[0][name] for name in names], axis=0)
    per_joint = dict(zip(names, (means[:, 1] - means[:, 0]).tolist(), strict=True))
    return Difference(
        Estimate(float(np.mean(means[:, 1] - means[:, 0])), interval_of(change)),
        pairs=len(names),
        first=float(means[:, 0].mean()),
        other=float(means[:, 1].mean()),
        lower=sum(value < 0 for value in per_joint.values()),
        per_joint=per_joint,
    )


def labels_of(names: Sequence[tuple[str, ...]]) -> list[str]:
    """Return a label for every session: the last of its names, after as many parents as make it unique."""
    for depth in range(1, 1 + max(len(name) for name in names)):
        labels = ["/".join(name[-depth:]) for name in names]
        if all(one != next_ for one, next_ in pairwise(sorted(labels))):
            break
    return labels
