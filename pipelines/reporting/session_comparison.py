"""Comparison of sessions: measures of each, and the differences between them.

Every measure is a mean over values [T, K] at the skeleton's times: K joints (or bones, or one), NaN where
there is none. Where two sessions hold the same motion at the same times, they are compared value by value,
and the interval is that of the mean of those differences. Otherwise they are compared joint by joint: the
mean of a joint in one flight against its mean in the other, every joint with the same weight; the stretches
of the two flights are then resampled independently. In both cases the intervals are those of
`geometry.metrics`, and are valid for these flights only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.metrics import (
    LEVEL,
    RESAMPLES,
    STRETCH_S,
    Series,
    aligned_distances,
    interval_of,
    intervals,
    resampled,
    root_relative_distances,
)
from pipelines.reporting import wording
from pipelines.reporting.chart import (
    TIME_LABEL,
    Bars,
    Figure,
    Line,
    Mark,
    Panel,
    Points,
    colour_and_style,
    means,
    percentiles,
    time_bins,
)
from pipelines.reporting.content import MeasuredMotion, SessionContent, middles, section, text
from pipelines.reporting.page import Block, Bullets, Fold, Page, Section
from pipelines.reporting.summary import Summary, doubts_of_flight, summarise
from pipelines.reporting.wording import (
    ABSENT,
    THIN,
    Column,
    Table,
    fixed,
    joint_label,
    listing,
    percent,
    quantity,
    shortened,
    whole,
    with_interval,
)

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


# Strips over time show no more stretches.
MOST_BINS_OF_STRIP = 150
# Ranges of more sessions would hide each other.
MAX_BANDS = 3
# Focal lengths closer than this factor make pixels of the same size.
SAME_LENS_FACTOR = 1.02

_OVER_TIME = ("predicted", "share")
_WHAT = {"mpjpe": "from the truth", "reprojection": "from the keypoints in the pictures"}


def render_comparison(contents: Mapping[str, SessionContent]) -> str:
    """Render the complete HTML of a comparison of two or more sessions by label."""
    comparison = compare(contents)
    figures: dict[str, Block] = {figure.key: figure for figure in draw_comparison(comparison)}
    sentences = [_sentence(pair) for pair in comparison.pairs]
    doubts = list(dict.fromkeys(_doubts(comparison)))
    tables = [_measures_table(comparison), *map(_pair_table, range(len(comparison.pairs)), comparison.pairs)]
    bars = [figures.pop("compare-joints")] if "compare-joints" in figures else []
    made: list[Block] = [
        _sessions_table(comparison),
        Fold("Settings that differ", [_settings_table(comparison)]),
    ]
    how = (
        "Sessions with the same motion at the same times are compared moment by moment, others by joint."
        f" Intervals come from {fixed(RESAMPLES, 0)} resampled flights, made of stretches of"
        f" {quantity(STRETCH_S, 's', 0)}. They are valid for these flights only: an error that is constant"
        " during a flight, such as a constant pose error, is not part of them."
    )
    flights = dict.fromkeys(one.summary.description.flight or one.content.name for one in comparison.sessions)
    simulated = all(one.summary.description.simulated for one in comparison.sessions)
    return Page(
        generator="mocap: sessions side by side",
        kicker=f"Sessions side by side{': simulated flights' if simulated else ''}",
        title=listing(flights),
        facts=[one.label for one in comparison.sessions],
        sections=[
            Section("verdict", "Verdict", sentences[1:], lead(comparison)),
            Section(
                "doubts",
                "What is doubtful",
                [Bullets([("doubt", each) for each in doubts])] if doubts else [],
            ),
            Section(
                "measures", "Measures", [*(tables if comparison.measures else []), how, *figures.values()]
            ),
            Section("joints", "Joint by joint", bars),
            Section("made", "How they were made", made),
        ],
        footer="What is doubtful about each session, and its pictures, stand on its own page.",
    ).render()


# --- tables ---


def _cell(found: Estimate | None, measure: Measure) -> tuple[str, str]:
    if found is None:
        return with_interval(None, None)
    return with_interval(found.value, found.interval, measure.digits)


def _measures_table(comparison: Comparison) -> Table:
    labels = [Column(one.label) for one in comparison.sessions]
    rows = [
        [
            f"{measure.label}, {measure.unit}",
            *(_cell(one.estimates.get(measure.key), measure) for one in comparison.sessions),
            measure.meaning,
        ]
        for measure in comparison.measures
    ]
    caption = "Means over every session’s own joint-frames, below them the 95 % intervals."
    columns = (Column("Measure", text=True), *labels, Column("Meaning", text=True))
    return Table("measures-table", caption, columns, rows, "arms")


def _pair_table(k: int, pair: Pair) -> Table:
    columns = (
        Column("Measure", text=True),
        Column(pair.first.label),
        Column(pair.other.label),
        Column("Difference", "95 % interval"),
        Column("Pairs"),
        Column("Lower", "of the joints"),
        Column("Verdict", text=True),
    )
    rows = [
        [
            f"{measure.label}, {measure.unit}",
            fixed(found.first, measure.digits),
            fixed(found.other, measure.digits),
            _cell(found.estimate, measure),
            whole(found.pairs),
            f"{found.lower} of {found.joints}" if found.joints > 1 else ABSENT,
            _judgement(measure, found),
        ]
        for measure, found in pair.by_measure
    ]
    how = "moment by moment" if pair.by_time else "joint by joint"
    caption = f"“{pair.other.label}” less “{pair.first.label}”, paired {how}."
    return Table(f"pair-{k + 1}", caption, columns, rows, "arms")


def _sessions_table(comparison: Comparison) -> Table:
    names = ("Session", "Flight", "Kind", "Method", "Start", "Length", "Cameras", "Times", "Truth")
    numbers = {"Length": "s", "Cameras": "", "Times": ""}
    rows = [
        [
            one.label,
            one.summary.description.flight,
            "simulated" if one.summary.description.simulated else "real",
            one.method or ABSENT,
            wording.moment(one.summary.origin_ns),
            fixed(one.summary.duration_s),
            str(len(one.summary.cameras)),
            whole(len(one.t_ns)),
            "no" if one.summary.errors_mm is None else "yes",
        ]
        for one in comparison.sessions
    ]
    columns = [Column(name, numbers.get(name, ""), text=name not in numbers) for name in names]
    return Table("sessions", "The sessions.", columns, rows, "arms")


def _settings_table(comparison: Comparison) -> Table:
    """List settings and keys of the stages that differ between the sessions."""
    tables = [_settings_of(one) for one in comparison.sessions]
    names = dict.fromkeys(name for own in tables for name in own)
    rows = [[name, *(own.get(name, ABSENT) for own in tables)] for name in names]
    columns = [Column("Setting", text=True), *(Column(one.label, text=True) for one in comparison.sessions)]
    differing = [row for row in rows if len(set(row[1:])) > 1]
    caption = "The key of a stage is the SHA-256 of everything that decides its result."
    return Table("settings", caption, columns, differing, "settings")


def _settings_of(session: Judged) -> dict[str, str]:
    found: dict[str, str] = {}
    for stage in ("ingest", "detect", "reconstruct"):
        record = session.content.stages.get(stage, {})
        settings = section(record, "settings")
        settings.pop("flight", None)
        found |= {f"{stage}: {name}": value for name, value in wording.flattened(settings)}
        found[f"{stage}: key"] = text(record, "key")
    return found


def _judgement(measure: Measure, found: Difference) -> str:
    """Judge a difference in two words at most."""
    if found.estimate.interval is None:
        return "too few moments"
    if not found.estimate.is_clear:
        return "within noise"
    lower = found.estimate.value < 0
    if not measure.better:
        return "lower" if lower else "higher"
    return "better" if lower == (measure.better == "less") else "worse"


# --- verdict ---


def named(session: Judged) -> str:
    """Return a session's name for a sentence."""
    return f"“{session.label}”"


def _amount(measure: Measure, value: float) -> str:
    return quantity(value, measure.unit, measure.digits)


def _between(measure: Measure, estimate: Estimate) -> str:
    if estimate.interval is None:
        return "no interval: too few moments"
    low, high = estimate.interval
    return f"{fixed(100 * LEVEL, 0)}{THIN}% interval {fixed(low, measure.digits)} to {_amount(measure, high)}"


def lead(comparison: Comparison) -> str:
    """Name a doubted session, and then the better one of two, or the one of several with the least error."""
    doubted = _doubted(comparison.sessions)[:1]
    first = _sentence(comparison.pairs[0])
    measure = comparison.pairs[0].decisive
    if (
        len(comparison.pairs) > 1
        and measure is not None
        and {pair.decisive for pair in comparison.pairs} == {measure}
    ):
        best = min(comparison.sessions, key=lambda one: one.estimates[measure.key].value)
        found = best.estimates[measure.key]
        smallest = (
            f"Of {len(comparison.sessions)} sessions, {named(best)} has the smallest mean distance of its"
            f" joints {_WHAT[measure.key]}: {_amount(measure, found.value)} ({_between(measure, found)})."
        )
        return " ".join([*doubted, smallest, first])
    return " ".join([*doubted, first])


def _sentence(pair: Pair) -> str:
    measure, names = pair.decisive, f"{named(pair.first)} and {named(pair.other)}"
    if measure is None:
        bare = [named(one) for one in (pair.first, pair.other) if not one.values]
        why = f"{listing(bare)} holds no reconstructed joint" if bare else "they have no joint in common"
        return f"{names} cannot be compared: {why}."
    found = pair.differences[measure.key]
    values = listing(_amount(measure, value) for value in (found.first, found.other))
    between = _between(measure, found.estimate)
    apart = f"their joints lie {values} {_WHAT[measure.key]} on average, apart by {between}"
    if found.estimate.interval is None:
        return f"Which of {names} is better is not known: there are too few moments; {apart}."
    if not found.estimate.is_clear:
        return f"The difference between {names} is within noise: {apart}."
    return f"{named(pair.other if found.estimate.value < 0 else pair.first)} is better of {names}: {apart}."


def _doubted(sessions: Sequence[Judged]) -> list[str]:
    """State what explains the most of each session whose flight is doubted."""
    first = [(one, next(iter(doubts_of_flight(one.summary)), None)) for one in sessions]
    return [
        f"{named(one)} is doubted: {text(doubt, 'what')} ({text(doubt, 'code')})."
        for one, doubt in first
        if doubt is not None
    ]


def _doubts(comparison: Comparison) -> list[str]:
    doubts = _doubted(comparison.sessions)
    for pair in comparison.pairs:
        measure, names = pair.decisive, f"{named(pair.first)} and {named(pair.other)}"
        if measure is not None and measure.key == "reprojection":
            doubts.append(
                f"Not both of {names} have truth: the verdict is about distances in the pictures, which stay "
                "small where the views agree on a wrong place."
            )
            if _other_lenses(pair):
                doubts.append(f"The lenses of {names} differ, so a pixel is not the same angle in both.")
        share = pair.differences.get("share")
        if share is not None and share.estimate.is_clear:
            low, high = sorted((share.first, share.other))
            less = pair.first if share.first < share.other else pair.other
            doubts.append(
                f"{named(less)} measured {percent(low / 100)} of its joint-frames, not {percent(high / 100)}."
            )
    for what, values in (
        ("were reconstructed by different methods", [one.method for one in comparison.sessions]),
        ("have different numbers of cameras", [str(len(one.summary.cameras)) for one in comparison.sessions]),
    ):
        if len(set(values)) > 1:
            each = zip(comparison.sessions, values, strict=True)
            doubts.append(f"The sessions {what}: {listing(f'{named(one)} {value}' for one, value in each)}.")
    return doubts + [
        f"The inputs of {stage} of {named(session)} have changed since: run it again."
        for session in comparison.sessions
        for stage in session.content.outdated
    ]


def _other_lenses(pair: Pair) -> bool:
    first, other = (
        float(np.median([camera.entry.intrinsics.fx for camera in one.summary.cameras]))
        for one in (pair.first, pair.other)
    )
    return max(first, other) > SAME_LENS_FACTOR * min(first, other)


# --- figures ---


def draw_comparison(comparison: Comparison) -> list[Figure]:
    """Draw every figure that has data."""
    measure = shown_measure(comparison)
    return [] if measure is None else [_over_time(comparison, measure), _joint_bars(comparison, measure)]


def shown_measure(comparison: Comparison) -> Measure | None:
    """Return the error from truth if every session with a skeleton has it, else the reprojection."""
    having = [one for one in comparison.sessions if one.values]
    for key in ("mpjpe", "reprojection"):
        if having and all(key in one.estimates for one in having):
            return MEASURE_OF[key]
    return None


def _colour_of(comparison: Comparison, session: Judged) -> str:
    return colour_and_style(comparison.sessions.index(session))[0]


def joints_of(comparison: Comparison) -> list[str]:
    """List every joint of every session, in the order in which the first names them."""
    motions = [one.summary.motion for one in comparison.sessions]
    return list(dict.fromkeys(name for motion in motions if motion is not None for name in motion.joints))


def _seconds_of(comparison: Comparison, session: Judged) -> Float:
    """Return the times [T] of a session, in s.

    They count from the first frame of all where the motion is the same, else from its own first frame.
    """
    together = {id(comparison.sessions[0])} | {id(pair.other) for pair in comparison.pairs if pair.by_time}
    same = [one for one in comparison.sessions if id(one) in together]
    among = same if id(session) in together else [session]
    return (session.t_ns - min(one.summary.origin_ns for one in among)) / 1e9


def _over_time(comparison: Comparison, measure: Measure) -> Figure:
    there = [one for one in comparison.sessions if one.values]
    shown = [measure] + [MEASURE_OF[key] for key in _OVER_TIME if any(key in one.values for one in there)]
    seconds = {one.label: _seconds_of(comparison, one) for one in there}
    panels = []
    for of in shown:
        lines = []
        for one in there:
            if of.key not in one.values:
                continue
            bins = time_bins(seconds[one.label], MOST_BINS_OF_STRIP)
            centres, values = (bins[:-1] + bins[1:]) / 2, one.values[of.key].values
            colour, style = colour_and_style(comparison.sessions.index(one))
            middle, low, high = percentiles(values, seconds[one.label], bins)
            if of.key == "share":
                middle = means(values, seconds[one.label], bins)
            banded = of is measure and len(there) <= MAX_BANDS
            ends = (low, high) if banded else (None, None)
            lines.append(Line(centres, middle, colour, one.label, ends[0], ends[1], style))
        span = (0, 104) if of.unit == "%" else (0, None)
        label = f"{of.name.replace(' ', chr(10))}\n({of.unit})"
        panels.append([Panel(lines, TIME_LABEL if of is shown[-1] else "", label, y_span=span)])
    first, last = min(s[0] for s in seconds.values()), max(s[-1] for s in seconds.values())
    panels[-1] = [replace(panels[-1][0], x_span=(float(first), float(last)))]
    heights = [1.5, *[1.1] * (len(shown) - 1)]
    caption = (
        "Errors are medians over joints, with the range from the 10th to the 90th percentile of up to three"
        " sessions; shares are means. Times of flights without the same motion count from the"
        " first frame of each."
    )
    title = f"{measure.label} over time, and what goes with it"
    return Figure("compare-time", title, caption, panels, 0.7 + sum(heights), heights=heights)


def _joint_bars(comparison: Comparison, measure: Measure) -> Figure:
    there = [one for one in comparison.sessions if one.values]
    joints = [
        name
        for name in joints_of(comparison)
        if any(name in one.per_joint.get(measure.key, {}) for one in comparison.sessions)
    ]
    thick = 0.8 / len(there)
    panels = []
    for of in (measure, MEASURE_OF["share"]):
        marks: list[Mark] = []
        for k, one in enumerate(there):
            found = one.per_joint.get(of.key, {})
            known = [(j, found[name]) for j, name in enumerate(joints) if name in found]
            rows = [j + (k - (len(there) - 1) / 2) * thick for j, _ in known]
            values, ends = [each.value for _, each in known], [each.interval for _, each in known]
            colour = _colour_of(comparison, one)
            marks.append(Bars(rows, [0.0] * len(rows), values, colour, one.label, 0.92 * thick))
            marks.append(Points(values, rows, ends=ends, marker=""))
        labels = {float(j): shortened(joint_label(name)) for j, name in enumerate(joints)}
        span = (0, None) if of is measure else (0, 100)
        panels.append(Panel(marks, f"{of.name} ({of.unit})", rows=labels, x_span=span, grid="x"))
    height = 0.8 + max(0.075 * len(there), 0.15) * 1.25 * max(len(joints), 6)
    title = f"{measure.label} of every joint, and how often it was measured"
    caption = "Thin lines: the 95 % intervals of the means."
    widths = [1.5, 1]
    return Figure(
        "compare-joints", title, caption, [panels], height, widths=widths, share_x=False, share_y=True
    )
