"""Comparison of sessions: measures of each, and the differences from the first.

Every measure is a mean over values [T, P, J] at the skeleton's times. Where two sessions hold the same motion
at the same times, the interval is that of the mean difference, value by value. Otherwise means are compared,
and the stretches of the two flights resampled independently. The intervals are those of `geometry.metrics`,
and are valid for these flights only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pipelines.geometry.arrays import Float, Int64, nearest_rows
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
    colour_and_style,
    means,
    percentiles,
    time_bins,
)
from pipelines.reporting.content import SessionContent, middles, section, text
from pipelines.reporting.layout import Block, Bullets, Page, Section
from pipelines.reporting.summary import Summary, doubts_of_flight, summarise
from pipelines.reporting.wording import (
    ABSENT,
    THIN,
    Column,
    Table,
    fixed,
    joint_label,
    listing,
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
# Strips over time show no more stretches.
MOST_BINS_OF_STRIP = 150
# Ranges of more sessions would hide each other.
MAX_BANDS = 3


@dataclass(frozen=True)
class Measure:
    """A measure by which sessions are compared."""

    key: str
    label: str
    unit: str
    digits: int
    meaning: str
    more_is_better: bool = False


MEASURES = (
    Measure("mpjpe", "MPJPE", "mm", 1, "mean distance of joints from truth, in the world"),
    Measure("root_mpjpe", "Root-relative MPJPE", "mm", 1, "the same with the hips laid on each other"),
    Measure("pa_mpjpe", "PA-MPJPE", "mm", 1, "after the best shift, turn and scale of each frame"),
    Measure(
        "pck150",
        "PCK at 150 mm",
        "%",
        1,
        "share of true joints reconstructed within 150 mm; missing ones count as wrong",
        more_is_better=True,
    ),
    Measure("reprojection", "Reprojection", "px", 2, "mean distance from the keypoints, of the views used"),
    Measure("share", "Reconstructed", "%", 1, "share of joint-frames measured", more_is_better=True),
)
MEASURE_OF = {measure.key: measure for measure in MEASURES}
_DECISIVE = {"mpjpe": "from the truth", "reprojection": "from the keypoints in the pictures"}


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
    values: dict[str, Float]  # measure: [T, P, J], NaN where there is none
    estimates: dict[str, Estimate]

    @property
    def t_ns(self) -> Int64:
        """Times of the skeleton; none without a skeleton."""
        motion = self.summary.motion
        return motion.t_ns if motion is not None else np.empty(0, dtype=np.int64)

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints of the skeleton; none without a skeleton."""
        return self.summary.motion.joints if self.summary.motion is not None else ()


@dataclass(frozen=True)
class Difference:
    """Difference of a session's measure from that of the first."""

    estimate: Estimate
    pairs: int  # joint-frames that both have; 0 where the means are compared
    first: float  # the two means, over those pairs
    other: float


@dataclass(frozen=True)
class Pair:
    """A session against the first."""

    first: Judged
    other: Judged
    by_time: bool  # else by their means
    differences: dict[str, Difference]

    @property
    def decisive(self) -> Measure | None:
        """Measure of the verdict: the error where both have truth, else the reprojection."""
        return next((MEASURE_OF[key] for key in _DECISIVE if key in self.differences), None)


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


def _judged(label: str, content: SessionContent) -> Judged:
    summary = summarise(content)
    if summary.motion is None:
        return Judged(label, content, summary, {}, {})
    values = _values(summary)
    series = {key: _series(array) for key, array in values.items()}
    found = intervals(series, summary.motion.t_ns)
    estimates = {key: Estimate(float(np.nanmean(array)), found[key]) for key, array in values.items()}
    return Judged(label, content, summary, values, estimates)


def _series(values: Float) -> Series:
    """Return sums and weights [T] of values [T, P, J] for the bootstrap."""
    there = np.isfinite(values)
    return np.where(there, values, 0.0).sum(axis=(1, 2)), there.sum(axis=(1, 2), dtype=np.float64)


def _values(summary: Summary) -> dict[str, Float]:
    motion = summary.motion
    if motion is None:
        return {}
    position = motion.measured_position
    found = {
        "reprojection": np.where(motion.measured, motion.reprojection_px, np.nan),
        "share": np.where(motion.status >= 0, 100.0 * motion.measured, np.nan),
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
    return {key: values for key, values in found.items() if np.isfinite(values).any()}


# --- two sessions ---


def _pair(first: Judged, other: Judged) -> Pair:
    rows = _same_motion(first, other)
    found = {
        measure.key: _unpaired(first, other, measure.key)
        if rows is None
        else _paired(first, other, measure.key, rows)
        for measure in MEASURES
        if measure.key in first.values and measure.key in other.values
    }
    return Pair(first, other, rows is not None, {key: one for key, one in found.items() if one is not None})


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
        place = _shared_joints(first, other)
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
    nearest = nearest_rows(b, a)
    step = min((float(np.median(np.diff(t))) for t in (a, b) if len(t) > 1), default=0.0)
    rows = np.flatnonzero(np.abs(b[nearest] - a) <= step / 2)
    chosen, at = np.unique(nearest[rows], return_index=True)
    return rows[at].astype(np.int64), chosen.astype(np.int64)


def _shared_joints(first: Judged, other: Judged) -> tuple[list[int], list[int]]:
    shared = [name for name in first.joints if name in other.joints]
    return [first.joints.index(name) for name in shared], [other.joints.index(name) for name in shared]


def _paired(first: Judged, other: Judged, key: str, rows: tuple[Int64, Int64]) -> Difference | None:
    ours, theirs = first.values[key], other.values[key]
    people = min(ours.shape[1], theirs.shape[1])
    mine, others = _shared_joints(first, other)
    a, b = ours[rows[0], :people][..., mine], theirs[rows[1], :people][..., others]
    both = np.isfinite(a) & np.isfinite(b)
    if not both.any():
        return None
    series = _series(np.where(both, b - a, np.nan))
    interval = intervals({"": series}, first.t_ns[rows[0]])[""]
    value = float(series[0].sum() / series[1].sum())
    return Difference(
        Estimate(value, interval), int(both.sum()), float(a[both].mean()), float(b[both].mean())
    )


def _unpaired(first: Judged, other: Judged, key: str) -> Difference:
    ours, theirs = (judged.estimates[key].value for judged in (first, other))
    # The two flights are independent, and so are the stretches drawn from them.
    drawn = [
        resampled({"": _series(judged.values[key])}, judged.t_ns, seed=seed)[""]
        for seed, judged in enumerate((first, other))
    ]
    return Difference(Estimate(theirs - ours, interval_of(drawn[1] - drawn[0])), 0, ours, theirs)


def labels_of(names: Sequence[tuple[str, ...]]) -> list[str]:
    """Return a label for every session: the last of its names, after as many parents as make it unique."""
    for depth in range(1, 1 + max(len(name) for name in names)):
        labels = ["/".join(name[-depth:]) for name in names]
        if all(one != next_ for one, next_ in pairwise(sorted(labels))):
            break
    return labels


# --- the page ---


def render_comparison(contents: Mapping[str, SessionContent]) -> str:
    """Render the complete HTML of a comparison of two or more sessions by label."""
    comparison = compare(contents)
    doubts = list(dict.fromkeys(_doubts(comparison)))
    tables = [_measures_table(comparison), *map(_pair_table, range(len(comparison.pairs)), comparison.pairs)]
    how = (
        "Sessions with the same motion at the same times are compared moment by moment, others by their"
        f" means. Intervals come from {fixed(RESAMPLES, 0)} resampled flights, made of stretches of"
        f" {quantity(STRETCH_S, 's', 0)}. They are valid for these flights only: an error that is constant"
        " during a flight, such as a constant pose error, is not part of them."
    )
    flights = dict.fromkeys(one.summary.description.flight or one.content.name for one in comparison.sessions)
    simulated = all(one.summary.description.simulated for one in comparison.sessions)
    shown: list[Block] = [*(tables if comparison.measures else []), how, *draw_comparison(comparison)]
    return Page(
        generator="mocap: sessions side by side",
        kicker=f"Sessions side by side{': simulated flights' if simulated else ''}",
        title=listing(flights),
        facts=[one.label for one in comparison.sessions],
        sections=[
            Section(
                "verdict", "Verdict", [_sentence(pair) for pair in comparison.pairs[1:]], lead(comparison)
            ),
            Section(
                "doubts",
                "What is doubtful",
                [Bullets([("doubt", each) for each in doubts])] if doubts else [],
            ),
            Section("measures", "Measures", shown),
            Section("made", "How they were made", [_settings_table(comparison)]),
        ],
        footer="What is doubtful about each session, and its pictures, stand on its own page.",
    ).render()


def _cell(found: Estimate | None, measure: Measure) -> tuple[str, str]:
    value, interval = (None, None) if found is None else (found.value, found.interval)
    return with_interval(value, interval, measure.digits)


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
    columns = [Column("Measure", text=True), Column(pair.first.label), Column(pair.other.label)]
    columns += [Column("Difference", "95 % interval"), Column("Pairs"), Column("Verdict", text=True)]
    rows = [
        [
            f"{measure.label}, {measure.unit}",
            fixed(found.first, measure.digits),
            fixed(found.other, measure.digits),
            _cell(found.estimate, measure),
            whole(found.pairs) if pair.by_time else ABSENT,
            _judgement(measure, found.estimate),
        ]
        for measure, found in ((MEASURE_OF[key], one) for key, one in pair.differences.items())
    ]
    how = "moment by moment" if pair.by_time else "by their means"
    caption = f"“{pair.other.label}” less “{pair.first.label}”, compared {how}."
    return Table(f"pair-{k + 1}", caption, columns, rows, "arms")


def _judgement(measure: Measure, found: Estimate) -> str:
    """Judge a difference in two words at most."""
    if found.interval is None:
        return "too few moments"
    if not found.is_clear:
        return "within noise"
    return "better" if (found.value > 0) == measure.more_is_better else "worse"


def _settings_table(comparison: Comparison) -> Table:
    """List facts about the flights, settings and keys of the stages that differ between the sessions."""
    tables = [_settings_of(one) for one in comparison.sessions]
    names = dict.fromkeys(name for own in tables for name in own)
    rows = [[name, *(own.get(name, ABSENT) for own in tables)] for name in names]
    columns = [Column("Setting", text=True), *(Column(one.label, text=True) for one in comparison.sessions)]
    differing = [row for row in rows if len(set(row[1:])) > 1]
    caption = "What differs. The key of a stage is the SHA-256 of everything that decides its result."
    return Table("settings", caption, columns, differing, "settings")


def _settings_of(session: Judged) -> dict[str, str]:
    summary = session.summary
    found = {
        "flight": summary.description.flight,
        "kind": "simulated" if summary.description.simulated else "real",
        "method": text(summary.metrics, "method") or ABSENT,
        "start": wording.moment(summary.origin_ns),
        "length": quantity(summary.duration_s, "s"),
        "cameras": str(len(summary.cameras)),
        "times": whole(len(session.t_ns)),
        "truth": "no" if summary.errors_mm is None else "yes",
    }
    for stage in ("ingest", "detect", "reconstruct"):
        record = session.content.stages.get(stage, {})
        settings = section(record, "settings")
        settings.pop("flight", None)
        found |= {f"{stage}: {name}": value for name, value in wording.flattened(settings)}
        found[f"{stage}: key"] = text(record, "key")
    return found


# --- the verdict ---


def lead(comparison: Comparison) -> str:
    """Name a doubted session, and then the better one of the first two."""
    return " ".join([*_doubted(comparison.sessions)[:1], _sentence(comparison.pairs[0])])


def _sentence(pair: Pair) -> str:
    measure, names = pair.decisive, f"“{pair.first.label}” and “{pair.other.label}”"
    if measure is None:
        bare = [f"“{one.label}”" for one in (pair.first, pair.other) if not one.values]
        why = f"{listing(bare)} holds no reconstructed joint" if bare else "they have no joint in common"
        return f"{names} cannot be compared: {why}."
    found = pair.differences[measure.key]
    values = listing(quantity(value, measure.unit, measure.digits) for value in (found.first, found.other))
    apart = f"their joints lie {values} {_DECISIVE[measure.key]} on average"
    if found.estimate.interval is None:
        return f"Which of {names} is better is not known: there are too few moments; {apart}."
    low, high = found.estimate.interval
    apart += (
        f", apart by {fixed(100 * LEVEL, 0)}{THIN}% interval {fixed(low, measure.digits)} to"
        f" {quantity(high, measure.unit, measure.digits)}"
    )
    if not found.estimate.is_clear:
        return f"The difference between {names} is within noise: {apart}."
    better = pair.other if found.estimate.value < 0 else pair.first
    return f"“{better.label}” is better of {names}: {apart}."


def _doubted(sessions: Sequence[Judged]) -> list[str]:
    """State what explains the most of each session whose flight is doubted."""
    first = [(one, next(iter(doubts_of_flight(one.summary)), None)) for one in sessions]
    return [
        f"“{one.label}” is doubted: {text(doubt, 'what')} ({text(doubt, 'code')})."
        for one, doubt in first
        if doubt is not None
    ]


def _doubts(comparison: Comparison) -> list[str]:
    doubts = _doubted(comparison.sessions)
    doubts += [
        f"Not both of “{pair.first.label}” and “{pair.other.label}” have truth: the verdict is about"
        " distances in the pictures, which stay small where the views agree on a wrong place."
        for pair in comparison.pairs
        if pair.decisive is not None and pair.decisive.key == "reprojection"
    ]
    return doubts + [
        f"The inputs of {stage} of “{session.label}” have changed since: run it again."
        for session in comparison.sessions
        for stage in session.content.outdated
    ]


# --- figures ---


def draw_comparison(comparison: Comparison) -> list[Figure]:
    """Draw the error from truth if every session with a skeleton has it, else the reprojection."""
    there = [one for one in comparison.sessions if one.values]
    for key in _DECISIVE:
        if there and all(key in one.estimates for one in there):
            return [_over_time(comparison, MEASURE_OF[key]), _joint_bars(there, MEASURE_OF[key])]
    return []


def _over_time(comparison: Comparison, measure: Measure) -> Figure:
    together = [comparison.sessions[0], *(pair.other for pair in comparison.pairs if pair.by_time)]
    start_ns = min(one.summary.origin_ns for one in together)
    there = [one for one in comparison.sessions if one.values]
    panels = []
    for of in (measure, MEASURE_OF["share"]):
        lines = []
        for k, one in enumerate(there):
            origin_ns = start_ns if any(one is other for other in together) else one.summary.origin_ns
            seconds, values = (one.t_ns - origin_ns) / 1e9, one.values[of.key]
            bins = time_bins(seconds, MOST_BINS_OF_STRIP)
            centres = (bins[:-1] + bins[1:]) / 2
            colour, style = colour_and_style(k)
            middle, low, high = percentiles(values, seconds, bins)
            if of is not measure:
                middle = means(values, seconds, bins)
            banded = of is measure and len(there) <= MAX_BANDS
            ends = (low, high) if banded else (None, None)
            lines.append(Line(centres, middle, colour, one.label, ends[0], ends[1], style))
        last = of is not measure
        span = (0, 104) if last else (0, None)
        panels.append([Panel(lines, TIME_LABEL if last else "", f"{of.label}\n({of.unit})", y_span=span)])
    caption = (
        "Errors are medians over joints, with the range from the 10th to the 90th percentile of up to three"
        " sessions; shares are means. Times of flights without the same motion count from the first of each."
    )
    title = f"{measure.label} over time, and how much was measured"
    return Figure("compare-time", title, caption, panels, 3.3, heights=[1.5, 1.1])


def _joint_bars(there: Sequence[Judged], measure: Measure) -> Figure:
    joints = list(dict.fromkeys(name for one in there for name in one.joints))
    thick = 0.8 / len(there)
    panels = []
    for of in (measure, MEASURE_OF["share"]):
        marks: list[Mark] = []
        for k, one in enumerate(there):
            found = [(joints.index(name), one.values[of.key][..., j]) for j, name in enumerate(one.joints)]
            known = [(row, float(np.nanmean(own))) for row, own in found if np.isfinite(own).any()]
            rows = [row + (k - (len(there) - 1) / 2) * thick for row, _ in known]
            values = [value for _, value in known]
            marks.append(
                Bars(rows, [0.0] * len(rows), values, colour_and_style(k)[0], one.label, 0.92 * thick)
            )
        labels = {float(j): shortened(joint_label(name)) for j, name in enumerate(joints)}
        span = (0, None) if of is measure else (0, 100)
        panels.append(Panel(marks, f"{of.label} ({of.unit})", rows=labels, x_span=span, grid="x"))
    height = 0.8 + max(0.075 * len(there), 0.15) * 1.25 * max(len(joints), 6)
    title = f"{measure.label} of every joint, and how often it was measured"
    widths = [1.5, 1]
    return Figure(
        "compare-joints", title, "Means.", [panels], height, widths=widths, share_x=False, share_y=True
    )
