"""The page that compares sessions, as one self-contained file, and its verdict in plain sentences."""

from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup

from pipelines.geometry.bootstrap import LEVEL, RESAMPLES, STRETCH_S
from pipelines.reporting import wording
from pipelines.reporting.comparison import (
    Comparison,
    Difference,
    Estimate,
    Judged,
    Measure,
    Pair,
    compare,
)
from pipelines.reporting.comparison_figures import colour_of, draw_comparison, joints_of, shown_measure
from pipelines.reporting.content import SessionContent, section, text
from pipelines.reporting.plates import PALETTE, Plate, as_csv
from pipelines.reporting.verdict import Verdict, doubts_of_flight
from pipelines.reporting.wording import THIN, environment, fixed, listing, percent, plural, quantity

GENERATOR = "mocap: sessions side by side"
"""Mark of a page of ours, which may be overwritten."""


def render_comparison(contents: Mapping[str, SessionContent]) -> tuple[str, dict[str, Plate]]:
    """Render the complete HTML of a comparison; return it and its figures by their keys.

    The same contents, of two or more sessions by label, give the same bytes; all text from the sessions'
    files is escaped. The page loads nothing and runs nothing.
    """
    comparison = compare(contents)
    measure = shown_measure(comparison)
    plates = draw_comparison(comparison)
    shown = [pair.differences.get(measure.key) if measure is not None else None for pair in comparison.pairs]
    per_joint = [found.per_joint if found is not None else {} for found in shown]
    page = (
        environment()
        .get_template("comparison.html.j2")
        .render(
            generator=GENERATOR,
            title=_title(comparison),
            simulated=all(one.summary.description.simulated for one in comparison.sessions),
            verdict=judge(comparison),
            comparison=comparison,
            measure=measure,
            per_joint=per_joint if any(per_joint) else [],
            joints=joints_of(comparison),
            plates=plates,
            # Our own drawing, in which every name was escaped when it was written.
            drawings={key: Markup(plate.svg) for key, plate in plates.items()},  # noqa: S704
            colour_of=lambda session: PALETTE[colour_of(comparison, session)],
            judgement=_judgement,
            moment=wording.moment,
            tables=_tables(comparison),
            settings=_differing_settings(comparison),
        )
    )
    return page, plates


def _tables(comparison: Comparison) -> dict[str, str]:
    """Write the tables of measures and of pairs as CSV; empty cells are missing numbers."""
    measures = [
        {"measure": measure.key, "unit": measure.unit, "session": one.label, **_columns(found)}
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
            **_columns(found.estimate),
            "pairs": found.pairs,
            "joints": found.joints,
            "lower": found.lower,
        }
        for pair in comparison.pairs
        for measure, found in pair.by_measure
    ]
    return {name: as_csv(rows) for name, rows in (("measures", measures), ("pairs", pairs)) if rows}


def _columns(estimate: Estimate) -> dict[str, float | None]:
    low, high = estimate.interval or (None, None)
    return {"value": estimate.value, "low": low, "high": high}


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


def _differing_settings(comparison: Comparison) -> list[tuple[str, list[str]]]:
    """List settings, keys and inputs' hashes of the stages that differ between the sessions."""
    tables = [_settings_of(one) for one in comparison.sessions]
    names = dict.fromkeys(name for table in tables for name in table)
    rows = [(name, [table.get(name, wording.ABSENT) for table in tables]) for name in names]
    return [(name, values) for name, values in rows if len(set(values)) > 1]


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


# --- verdict -------------------------------------------------------------------------------------------


_WHAT = {"mpjpe": "from the truth", "reprojection": "from the keypoints in the pictures"}
_SAME_LENS = 1.02
"""Focal lengths closer than this factor make pixels of the same size."""


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
    return max(first, other) > _SAME_LENS * min(first, other)


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
