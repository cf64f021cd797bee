"""The page that compares sessions, as one self-contained file: its tables, figures and verdict.

The colour is the session's in every figure.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from markupsafe import Markup

from pipelines.geometry.arrays import Float
from pipelines.geometry.metrics import LEVEL, RESAMPLES, STRETCH_S
from pipelines.reporting import wording
from pipelines.reporting.chart import (
    MUTED,
    PALETTE,
    Bars,
    Line,
    Panel,
    Plate,
    RowPoints,
    as_csv,
    chart,
    colour_and_style,
    means,
    percentiles,
    stacked,
    table,
    tabled,
    time_bins,
)
from pipelines.reporting.content import SessionContent, section, text
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
from pipelines.reporting.verdict import Verdict, doubts_of_flight
from pipelines.reporting.wording import (
    ABSENT,
    THIN,
    Column,
    Table,
    environment,
    fixed,
    joint_label,
    listing,
    percent,
    plural,
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

GENERATOR = "mocap: sessions side by side"
"""Mark of a page of ours, which may be overwritten."""

_OVER_TIME = ("predicted", "tilt", "share")
_ARROW = {"less": " (less is better)", "more": " (more is better)", "": ""}


def render_comparison(contents: Mapping[str, SessionContent]) -> tuple[str, dict[str, Plate]]:
    """Render the complete HTML of a comparison; return it and its figures by their keys.

    The same contents, of two or more sessions by label, give the same bytes; all text from the sessions'
    files is escaped. The page loads nothing and runs nothing.
    """
    comparison = compare(contents)
    measure = shown_measure(comparison)
    plates = draw_comparison(comparison)
    colours = [PALETTE[colour_of(comparison, one)] for one in comparison.sessions]
    page = (
        environment()
        .get_template("comparison.html.j2")
        .render(
            generator=GENERATOR,
            title=_title(comparison),
            simulated=all(one.summary.description.simulated for one in comparison.sessions),
            verdict=judge(comparison),
            labels=list(zip([one.label for one in comparison.sessions], colours, strict=True)),
            measures=[
                _measures_table(comparison),
                *map(_pair_table, range(len(comparison.pairs)), comparison.pairs),
            ]
            if comparison.measures
            else [],
            joints=None if measure is None else _joints_table(comparison, measure),
            sessions=_sessions_table(comparison),
            settings=_settings_table(comparison),
            plates=plates,
            # Our own drawing, in which every name was escaped when it was written.
            drawings={key: Markup(plate.svg) for key, plate in plates.items()},  # noqa: S704
            csv=_csv(comparison),
        )
    )
    return page, plates


# --- tables ---


def _csv(comparison: Comparison) -> dict[str, str]:
    """Write the tables of measures and of pairs as CSV; empty cells are missing numbers."""

    def columns(estimate: Estimate) -> dict[str, float | None]:
        low, high = estimate.interval or (None, None)
        return {"value": estimate.value, "low": low, "high": high}

    measures = [
        {"measure": measure.key, "unit": measure.unit, "session": one.label, **columns(found)}
        for measure in comparison.measures
        for one in comparison.sessions
        if (found := one.estimates.get(measure.key)) is not None
    ]
    pairs = [
        {
            "measure": measure.key,
            "unit": measure.unit,
            "first": pair.first.label,
            "other": pair.other.label,
            "first_mean": found.first,
            "other_mean": found.other,
            **columns(found.estimate),
            "pairs": found.pairs,
            "joints": found.joints,
            "lower": found.lower,
        }
        for pair in comparison.pairs
        for measure, found in pair.by_measure
    ]
    return {name: as_csv(rows) for name, rows in (("measures", measures), ("pairs", pairs)) if rows}


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
    return Table(
        "measures",
        caption,
        (Column("Measure", text=True), *labels, Column("Meaning", text=True)),
        rows,
        "arms",
    )


def _pair_table(k: int, pair: Pair) -> Table:
    how = (
        "moment by moment: means over what both have"
        if pair.by_time
        else "joint by joint: every joint with the same weight"
    )
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
    caption = f"“{pair.other.label}” less “{pair.first.label}”, paired {how}."
    return Table(f"pair-{k + 1}", caption, columns, rows, "arms")


def _joints_table(comparison: Comparison, measure: Measure) -> Table:
    differences = [pair.differences.get(measure.key) for pair in comparison.pairs]
    per_joint = [{} if found is None else found.per_joint for found in differences]
    paired = any(per_joint)
    columns = [Column("Joint", text=True), *(Column(one.label) for one in comparison.sessions)]
    columns += [Column(pair.other.label, "difference") for pair in comparison.pairs if paired]
    rows = [
        [
            joint_label(name),
            *(_cell(one.per_joint.get(measure.key, {}).get(name), measure) for one in comparison.sessions),
            *(fixed(own.get(name), measure.digits) for own in (per_joint if paired else ())),
        ]
        for name in joints_of(comparison)
    ]
    caption = f"{measure.label} of every joint in {measure.unit}, below it the 95 % interval"
    caption += "; and what it is above that of the first session, over the pairs." if paired else "."
    return Table("joints", caption, columns, rows, "arms")


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
    caption = "The sessions. The key of a stage is the SHA-256 of everything that decides its result."
    columns = [Column(name, numbers.get(name, ""), text=name not in numbers) for name in names]
    return Table("sessions", caption, columns, rows, "arms")


def _settings_table(comparison: Comparison) -> Table:
    """List settings, keys and inputs' hashes of the stages that differ between the sessions."""
    tables = [_settings_of(one) for one in comparison.sessions]
    names = dict.fromkeys(name for own in tables for name in own)
    rows = [[name, *(own.get(name, ABSENT) for own in tables)] for name in names]
    columns = [Column("Setting", text=True), *(Column(one.label, text=True) for one in comparison.sessions)]
    differing = [row for row in rows if len(set(row[1:])) > 1]
    return Table(
        "settings", "Settings and keys of the stages that differ.", columns, differing, "settings differing"
    )


def _title(comparison: Comparison) -> str:
    flights = dict.fromkeys(one.summary.description.flight or one.content.name for one in comparison.sessions)
    if len(flights) == 1:
        return f"{next(iter(flights))}: {wording.plural(len(comparison.sessions), 'session')}"
    return wording.listing(flights)


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


def _settings_of(session: Judged) -> dict[str, str]:
    found: dict[str, str] = {}
    for stage, record in session.content.stages.items():
        if stage not in {"ingest", "detect", "reconstruct"}:
            continue
        settings = section(record, "settings")
        settings.pop("flight", None)
        found |= {f"{stage}: {name}": value for name, value in wording.flattened(settings)}
        found[f"{stage}: key"] = text(record, "key")
    return found


# --- verdict ---


_WHAT = {"mpjpe": "from the truth", "reprojection": "from the keypoints in the pictures"}


def judge(comparison: Comparison) -> Verdict:
    """Write the first words of the page."""
    sentences = [_sentence(pair) for pair in comparison.pairs]
    lead = sentences[0]
    if len(sentences) > 1:
        lead = _best(comparison) or f"{len(comparison.sessions)} sessions, each against the first."
    return Verdict(
        " ".join([*_doubted(comparison.sessions)[:1], lead]),
        quality=tuple(sentences if len(sentences) > 1 else ())
        + tuple(sentence for pair in comparison.pairs for sentence in _also(pair)),
        certainty=tuple(_how(comparison)),
        doubts=tuple(dict.fromkeys(_doubts(comparison))),
    )


def named(session: Judged) -> str:
    """Return a session's name for a sentence."""
    return f"“{session.label}”"


def amount(measure: Measure, value: float) -> str:
    """Format a value of a measure with its unit."""
    return quantity(value, measure.unit, measure.digits)


def between(measure: Measure, estimate: Estimate, *, sign: float = 1.0) -> str:
    """Format `95 % interval 1.2 to 3.4 mm`; of the negative with `sign` -1."""
    if estimate.interval is None:
        return "no interval: too few moments"
    low, high = sorted(sign * end for end in estimate.interval)
    return f"{fixed(100 * LEVEL, 0)}{THIN}% interval {fixed(low, measure.digits)} to {amount(measure, high)}"


def _best(comparison: Comparison) -> str | None:
    """Name the session with the smallest error of three or more; None if they have no common measure."""
    decisive = {pair.decisive for pair in comparison.pairs}
    measure = next(iter(decisive)) if len(decisive) == 1 else None
    if measure is None:
        return None
    of = {one.label: one.estimates[measure.key] for one in comparison.sessions}
    best = min(comparison.sessions, key=lambda one: of[one.label].value)
    return (
        f"Of {len(comparison.sessions)} sessions, {named(best)} has the smallest mean distance of its joints "
        f"{_WHAT[measure.key]}: {amount(measure, of[best.label].value)} "
        f"({between(measure, of[best.label])})."
    )


def _sentence(pair: Pair) -> str:
    measure = pair.decisive
    names = f"{named(pair.first)} and {named(pair.other)}"
    if measure is None:
        return f"{names} cannot be compared: {_why_not(pair)}."
    found = pair.differences[measure.key]
    what, values = _WHAT[measure.key], (amount(measure, found.first), amount(measure, found.other))
    change = found.estimate
    if change.interval is None:
        return (
            f"Which of {names} is better is not known: there are too few moments. Their joints lie "
            f"{listing(values)} {what}."
        )
    if not change.is_clear:
        return (
            f"The difference between {names} is within noise: their joints lie {listing(values)} {what} on "
            f"average, {'alike' if change.value == 0 else _apart(measure, change)}."
        )
    ends = [(pair.first, found.first), (pair.other, found.other)]
    (good, small), (bad, large) = sorted(ends, key=lambda end: end[1])
    sign = 1.0 if change.value > 0 else -1.0
    return (
        f"{named(good)} has the better skeleton: its joints lie {amount(measure, small)} {what} on average, "
        f"those of {named(bad)} {amount(measure, large)}. That is {amount(measure, large - small)} or "
        f"{percent((large - small) / large)} less ({between(measure, change, sign=sign)})."
    )


def _apart(measure: Measure, change: Estimate) -> str:
    return f"{amount(measure, change.value)} more in the second ({between(measure, change)})"


def _why_not(pair: Pair) -> str:
    bare = [one for one in (pair.first, pair.other) if not one.values]
    if bare:
        return f"{listing(named(one) for one in bare)} holds no reconstructed joint"
    return "they have no joint in common"


def _also(pair: Pair) -> list[str]:
    """Describe the other differences that are larger than chance."""
    decisive = pair.decisive
    sentences = [
        f"{measure.name} {amount(measure, found.other)} against {fixed(found.first, measure.digits)}"
        for measure, found in pair.by_measure
        if found.estimate.is_clear and (decisive is None or measure.key != decisive.key)
    ]
    if not sentences:
        return []
    return [f"{named(pair.other)} also differs from {named(pair.first)} in {listing(sentences)}."]


def _how(comparison: Comparison) -> list[str]:
    sentences = []
    for pair in comparison.pairs:
        measure = pair.decisive
        if measure is None:
            continue
        found = pair.differences[measure.key]
        names = f"{named(pair.first)} and {named(pair.other)}"
        if pair.by_time:
            sentences.append(
                f"{names} hold the same motion at {plural(pair.times, 'common time')}: they are compared "
                f"moment by moment, on the {plural(found.pairs, 'joint-frame')} that both measured."
            )
        else:
            sentences.append(
                f"{names} do not hold the same motion at the same times: they are compared joint by joint, "
                f"each joint’s mean in one with its mean in the other; {named(pair.other)} has the smaller "
                f"one for {found.lower} of {plural(found.joints, 'joint')}."
            )
    sentences.append(
        f"Intervals come from {fixed(RESAMPLES, 0)} resampled flights, made of stretches of "
        f"{quantity(STRETCH_S, 's', 0)}. They are valid for these flights only: an error that is constant "
        "during a flight, such as a constant pose error, is not part of them."
    )
    return sentences


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
        measure = pair.decisive
        if measure is None:
            continue
        names = f"{named(pair.first)} and {named(pair.other)}"
        if measure.key == "reprojection":
            doubts.append(
                f"Not both of {names} have truth: the verdict is about distances in the pictures, which stay "
                "small where the views agree on a wrong place."
            )
            if _other_lenses(pair):
                doubts.append(f"The lenses of {names} differ, so a pixel is not the same angle in both.")
        share = pair.differences.get("share")
        if share is not None and share.estimate.is_clear:
            ends = [(pair.first, share.first), (pair.other, share.other)]
            (less, low), (_, high) = sorted(ends, key=lambda end: end[1])
            left = (
                "the errors are those of the joint-frames that both have"
                if pair.by_time
                else "those it lacks, perhaps the hard ones, are not among its errors"
            )
            doubts.append(
                f"{named(less)} measured fewer joint-frames "
                f"({percent(low / 100)}, not {percent(high / 100)}): {left}."
            )
    doubts += _unlike(comparison.sessions)
    doubts += [
        f"The inputs of {stage} of {named(session)} have changed since: run it again."
        for session in comparison.sessions
        for stage in session.content.outdated
    ]
    return doubts


def _other_lenses(pair: Pair) -> bool:
    first, other = (
        float(np.median([camera.entry.intrinsics.fx for camera in one.summary.cameras]))
        for one in (pair.first, pair.other)
    )
    return max(first, other) > SAME_LENS_FACTOR * min(first, other)


def _unlike(sessions: Sequence[Judged]) -> list[str]:
    """List differences in how the sessions were made."""
    sentences = []
    for what, values in (
        (
            "were reconstructed by different methods",
            [one.method for one in sessions],
        ),
        ("have different numbers of cameras", [str(len(one.summary.cameras)) for one in sessions]),
        (
            "are not all simulated",
            ["simulated" if one.summary.description.simulated else "real" for one in sessions],
        ),
    ):
        if len(set(values)) > 1:
            pairs = listing(
                f"{named(one)} {value or 'none'}" for one, value in zip(sessions, values, strict=True)
            )
            sentences.append(f"The sessions {what}: {pairs}.")
    return sentences


# --- figures ---


def draw_comparison(comparison: Comparison) -> dict[str, Plate]:
    """Draw every figure that has data, by its key."""
    measure = shown_measure(comparison)
    plates = []
    if any(pair.differences for pair in comparison.pairs):
        plates.append(_differences(comparison))
    if measure is not None:
        plates += [_over_time(comparison, measure), _joint_bars(comparison, measure)]
    return {plate.key: plate for plate in plates}


def shown_measure(comparison: Comparison) -> Measure | None:
    """Return the error from truth if every session with a skeleton has it, else the reprojection."""
    having = [one for one in comparison.sessions if one.values]
    for key in ("mpjpe", "reprojection"):
        if having and all(key in one.estimates for one in having):
            return MEASURE_OF[key]
    return None


def colour_of(comparison: Comparison, session: Judged) -> str:
    """Return the colour of a session in all figures."""
    return colour_and_style(comparison.sessions.index(session))[0]


def joints_of(comparison: Comparison) -> list[str]:
    """List every joint of every session, in the order in which the first names them."""
    motions = [one.summary.motion for one in comparison.sessions]
    return list(dict.fromkeys(name for motion in motions if motion is not None for name in motion.joints))


def seconds_of(comparison: Comparison, session: Judged) -> Float:
    """Return the times [T] of a session, in s.

    They count from the first frame of all where the motion is the same, else from its own first frame.
    """
    together = {id(comparison.sessions[0])} | {id(pair.other) for pair in comparison.pairs if pair.by_time}
    same = [one for one in comparison.sessions if id(one) in together]
    among = same if id(session) in together else [session]
    return (session.t_ns - min(one.summary.origin_ns for one in among)) / 1e9


def _over_time(comparison: Comparison, measure: Measure) -> Plate:
    there = [one for one in comparison.sessions if one.values]
    shown = [measure] + [MEASURE_OF[key] for key in _OVER_TIME if any(key in one.values for one in there)]
    seconds = {one.label: seconds_of(comparison, one) for one in there}
    bands = len(comparison.sessions) <= MAX_BANDS
    panels, drawn = [], []
    for of in shown:
        lines = []
        for one in there:
            if of.key not in one.values:
                continue
            bins = time_bins(seconds[one.label], MOST_BINS_OF_STRIP)
            centres = (bins[:-1] + bins[1:]) / 2
            colour, style = colour_and_style(comparison.sessions.index(one))
            values = one.values[of.key].values
            low = high = np.full(len(centres), np.nan)
            if of.key in {"share", "tilt"}:
                middle = means(values, seconds[one.label], bins)
            else:
                middle, low, high = percentiles(values, seconds[one.label], bins)
            band: dict[str, Any] = {"low": low, "high": high} if of is measure and bands else {}
            name = shortened(one.label) if of is measure else ""
            lines.append(Line(centres, middle, colour, name, style=style, shade=0.14, **band))
            what = f"{of.name} ({of.unit})"
            drawn.append(table(session=one.label, measure=what, t_s=centres, value=middle, p10=low, p90=high))
        span = (0, 104) if of.unit == "%" else None if of.key == "tilt" else (0, None)
        label = f"{of.name.replace(' ', chr(10))}\n({of.unit})"
        panels.append([Panel(lines, "time (s)" if of is shown[-1] else "", label, y_span=span)])
    first, last = min(s[0] for s in seconds.values()), max(s[-1] for s in seconds.values())
    panels[-1] = [replace(panels[-1][0], x_span=(float(first), float(last)))]
    heights = [1.5, *[1.1] * (len(shown) - 1)]
    caption = f"From above: {listing(of.name for of in shown)}. Errors are medians over joints"
    if len(there) <= MAX_BANDS:
        caption += ", the range in the uppermost drawing from the 10th to the 90th percentile"
    caption += "; tilt and share are means. " + (
        "Times count from the first frame of all."
        if all(pair.by_time for pair in comparison.pairs)
        else "Times of flights that do not hold the same motion count from the first frame of each."
    )
    listed = listing(
        f"{one.label} {quantity(one.estimates[measure.key].value, measure.unit, measure.digits)}"
        for one in there
    )
    return Plate(
        "compare-time",
        f"{measure.label} over time, and what goes with it",
        caption,
        f"Means over the flights: {listed}.",
        chart(panels, 0.7 + sum(heights), heights=heights),
        {"": stacked(drawn)},
    )


def _joint_bars(comparison: Comparison, measure: Measure) -> Plate:
    there = [one for one in comparison.sessions if one.values]
    joints = [
        name
        for name in joints_of(comparison)
        if any(name in one.per_joint.get(measure.key, {}) for one in comparison.sessions)
    ]
    thick = 0.8 / len(there)
    panels = []
    for of in (measure, MEASURE_OF["share"]):
        marks: list[Bars | RowPoints] = []
        for k, one in enumerate(there):
            found = one.per_joint.get(of.key, {})
            known = [(j, found[name]) for j, name in enumerate(joints) if name in found]
            rows = [j + (k - (len(there) - 1) / 2) * thick for j, _ in known]
            values, ends = [each.value for _, each in known], [each.interval for _, each in known]
            name = shortened(one.label) if of is measure else ""
            bars = Bars(rows, 0.0, values, colour_of(comparison, one), name, 0.92 * thick)
            marks += [bars, RowPoints(rows, values, ends, MUTED, width=0.8, marked=False)]
        labels = {float(j): shortened(joint_label(name)) for j, name in enumerate(joints)}
        span = (0, None) if of is measure else (0, 100)
        panels.append(Panel(marks, f"{of.name} ({of.unit})", rows=labels, x_span=span, grid="x"))
    height = 0.8 + max(0.075 * len(there), 0.15) * 1.25 * max(len(joints), 6)
    words = [
        f"{one.label}: "
        + listing(
            f"{joint_label(name)} {fixed(found.value, measure.digits)}"
            for name, found in one.per_joint[measure.key].items()
        )
        + f" {measure.unit}."
        for one in there
    ]
    rows_of_csv = [
        (one.label, f"{of.name} ({of.unit})", name, estimate.value, *(estimate.interval or (np.nan, np.nan)))
        for of in (measure, MEASURE_OF["share"])
        for one in there
        for name, estimate in one.per_joint.get(of.key, {}).items()
    ]
    numbers = tabled(("session", "measure", "joint", "value", "low", "high"), rows_of_csv)
    title = f"{measure.label} of every joint, and how often it was measured"
    figure = chart([panels], height, widths=[1.5, 1], share_x=False, share_y=True)
    caption = "Thin lines: the 95 % intervals of the means."
    return Plate("compare-joints", title, caption, " ".join(words), figure, {"": numbers})


def _differences(comparison: Comparison) -> Plate:
    pairs = comparison.pairs
    measures = [
        one
        for one in MEASURES
        if any(one.key in pair.differences and pair.differences[one.key].first > 0 for pair in pairs)
    ]
    marks, drawn = [], []
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
            drawn.append((pair.other.label, measure.label, values[-1], *(ends[-1] or (np.nan, np.nan))))
        name = shortened(pair.other.label) if len(pairs) > 1 else ""
        marks.append(RowPoints(rows, values, ends, colour_of(comparison, pair.other), name))
    panel = Panel(
        marks,
        f"difference from {shortened(comparison.sessions[0].label)} (% of its value)",
        rows={float(k): f"{one.label}{_ARROW[one.better]}" for k, one in enumerate(measures)},
        grid="x",
        zero=True,
    )
    caption = (
        "A point is the paired difference from the first session, relative to that one, its line the 95 % "
        "interval; a line across zero is within noise. Beside each measure stands which way is better."
    )
    columns = ("session", "measure", "difference_percent", "low_percent", "high_percent")
    listed = listing(f"{session} {measure} {fixed(value)} %" for session, measure, value, _, _ in drawn)
    figure = chart([[panel]], 0.9 + len(measures) * max(0.2, 0.1 * len(pairs)))
    title = "All differences at a glance"
    numbers = {"": tabled(columns, drawn)}
    return Plate("compare-differences", title, caption, f"{listed}.", figure, numbers)
