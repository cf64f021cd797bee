"""The page that compares sessions: its verdict, tables and figures. The colour is the session's in each."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.metrics import LEVEL, RESAMPLES, STRETCH_S
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
from pipelines.reporting.content import SessionContent, section, text
from pipelines.reporting.page import Block, Bullets, Fold, Page, Section
from pipelines.reporting.session_comparison import (
    MEASURE_OF,
    MEASURES,
    Comparison,
    Difference,
    Estimate,
    Judged,
    Measure,
    Pair,
    compare,
)
from pipelines.reporting.verdict import doubts_of_flight
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

# Strips over time show no more stretches.
MOST_BINS_OF_STRIP = 150
# Ranges of more sessions would hide each other.
MAX_BANDS = 3
# Focal lengths closer than this factor make pixels of the same size.
SAME_LENS_FACTOR = 1.02

_OVER_TIME = ("predicted", "share")
_ARROW = {"less": " (less is better)", "more": " (more is better)", "": ""}
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
    figures = [_differences(comparison)] if any(pair.differences for pair in comparison.pairs) else []
    if measure is not None:
        figures += [_over_time(comparison, measure), _joint_bars(comparison, measure)]
    return figures


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


def _differences(comparison: Comparison) -> Figure:
    pairs = comparison.pairs
    measures = [
        one
        for one in MEASURES
        if any(one.key in pair.differences and pair.differences[one.key].first > 0 for pair in pairs)
    ]
    marks = []
    for p, pair in enumerate(pairs):
        shift = (p - (len(pairs) - 1) / 2) * 0.7 / len(pairs)
        rows, values, ends = [], [], []
        for k, measure in enumerate(measures):
            found = pair.differences.get(measure.key)
            if found is None or found.first <= 0:
                continue
            scale, interval = 100 / found.first, found.estimate.interval
            rows.append(k + shift)
            values.append(scale * found.estimate.value)
            ends.append(None if interval is None else (scale * interval[0], scale * interval[1]))
        marks.append(Points(values, rows, _colour_of(comparison, pair.other), pair.other.label, ends))
    panel = Panel(
        marks,
        f"difference from {shortened(comparison.sessions[0].label)} (% of its value)",
        rows={float(k): f"{one.label}{_ARROW[one.better]}" for k, one in enumerate(measures)},
        grid="x",
        zero=True,
    )
    caption = (
        "A point is the paired difference from the first session, relative to that one, its line the 95 % "
        "interval; a line across zero is within noise."
    )
    height = 0.9 + len(measures) * max(0.2, 0.1 * len(pairs))
    return Figure("compare-differences", "All differences at a glance", caption, [[panel]], height)
