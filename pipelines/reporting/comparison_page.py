"""The page that compares sessions, as one self-contained file, and its verdict in plain sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from pipelines.geometry.bootstrap import LEVEL, RESAMPLES, STRETCH_S
from pipelines.reporting import wording
from pipelines.reporting.comparison import (
    MEASURES,
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
from pipelines.reporting.plates import PALETTE, Plate
from pipelines.reporting.verdict import Verdict
from pipelines.reporting.wording import THIN, environment, fixed, listing, percent, plural, quantity

GENERATOR = "mocap: sessions side by side"
"""Mark of a page of ours, which may be overwritten."""


@dataclass(frozen=True)
class SessionRow:
    """One session in the tables."""

    label: str
    judged: Judged
    colour: str  # the page's variable
    flight: str
    kind: str
    method: str
    started: str


@dataclass(frozen=True)
class DifferenceRow:
    """One measure of a pair."""

    measure: Measure
    found: Difference
    lower: str
    verdict: str


@dataclass(frozen=True)
class PairTable:
    """A session against the first."""

    first: str
    other: str
    by_time: bool
    rows: list[DifferenceRow]
    per_joint: dict[str, float]  # of the measure that is shown joint by joint


def render_comparison(contents: Mapping[str, SessionContent]) -> tuple[str, dict[str, Plate]]:
    """Render the complete HTML of a comparison; return it and its figures by their keys.

    The same contents give the same bytes; all text from the sessions' files is escaped. The page loads
    nothing and runs nothing.

    Args:
        contents: the contents of the sessions, by label; two at least.
    """
    comparison = compare(contents)
    measure = shown_measure(comparison)
    plates = draw_comparison(comparison)
    sessions = [_row(comparison, one) for one in comparison.sessions]
    pairs = [_table(pair, measure) for pair in comparison.pairs]
    page = (
        environment()
        .get_template("comparison.html.j2")
        .render(
            generator=GENERATOR,
            title=_title(comparison),
            simulated=all(one.summary.description.simulated for one in comparison.sessions),
            verdict=judge(comparison),
            sessions=sessions,
            measures=comparison.measures,
            pairs=pairs,
            measure=measure,
            decided=any(pair.per_joint for pair in pairs),
            joints=joints_of(comparison),
            plates=plates,
            # Our own drawing, in which every name was escaped when it was written.
            drawings={key: Markup(plate.svg) for key, plate in plates.items()},  # noqa: S704
            settings=_differing_settings(comparison),
        )
    )
    return page, plates


def _title(comparison: Comparison) -> str:
    flights = dict.fromkeys(one.summary.description.flight or one.content.name for one in comparison.sessions)
    if len(flights) == 1:
        return f"{next(iter(flights))}: {wording.plural(len(comparison.sessions), 'session')}"
    return wording.listing(flights)


def _row(comparison: Comparison, session: Judged) -> SessionRow:
    summary = session.summary
    return SessionRow(
        label=session.label,
        judged=session,
        colour=PALETTE[colour_of(comparison, session)],
        flight=summary.description.flight,
        kind="simulated" if summary.description.simulated else "real",
        method=text(summary.metrics, "method"),
        started=wording.moment(summary.origin_ns),
    )


def _table(pair: Pair, measure: Measure | None) -> PairTable:
    shown = pair.differences.get(measure.key) if measure is not None else None
    return PairTable(
        first=pair.first.label,
        other=pair.other.label,
        by_time=pair.by_time,
        rows=[
            DifferenceRow(one, found, _lower(found), _word(one, found))
            for one in MEASURES
            if (found := pair.differences.get(one.key)) is not None
        ],
        per_joint=shown.per_joint if shown is not None else {},
    )


def _lower(found: Difference) -> str:
    return f"{found.lower} of {found.joints}" if found.joints > 1 else wording.ABSENT


def _word(measure: Measure, found: Difference) -> str:
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
        lead,
        quality=tuple(sentences if len(sentences) > 1 else ())
        + tuple(told for pair in comparison.pairs for told in _also(pair)),
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
            f"Which of {names} is better cannot be told: there are too few moments. Their joints lie "
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
    told = [
        f"{measure.name} {amount(measure, found.other)} against {fixed(found.first, measure.digits)}"
        for measure, found in _clear(pair)
        if decisive is None or measure.key != decisive.key
    ]
    if not told:
        return []
    return [f"Beside that, {named(pair.other)} differs from {named(pair.first)} in {listing(told)}."]


def _clear(pair: Pair) -> list[tuple[Measure, Difference]]:
    return [
        (measure, pair.differences[measure.key])
        for measure in MEASURES
        if measure.key in pair.differences and pair.differences[measure.key].estimate.is_clear
    ]


def _how(comparison: Comparison) -> list[str]:
    told = []
    for pair in comparison.pairs:
        measure = pair.decisive
        if measure is None:
            continue
        found = pair.differences[measure.key]
        names = f"{named(pair.first)} and {named(pair.other)}"
        if pair.by_time:
            told.append(
                f"{names} hold the same motion at {plural(pair.times, 'common time')}: they are compared "
                f"moment by moment, on the {plural(found.pairs, 'joint-frame')} that both measured."
            )
        else:
            told.append(
                f"{names} do not hold the same motion at the same times: they are compared joint by joint, "
                f"each joint’s mean in one with its mean in the other; {named(pair.other)} has the smaller "
                f"one for {found.lower} of {plural(found.joints, 'joint')}."
            )
    told.append(
        f"Intervals come from {fixed(RESAMPLES, 0)} resampled flights, made of stretches of "
        f"{quantity(STRETCH_S, 's', 0)}. They speak of these flights, not of the next ones: what is the same "
        "all through a flight, such as a constant pose error, does not show in them."
    )
    return told


def _doubts(comparison: Comparison) -> list[str]:
    doubts = []
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
        f"What {stage} of {named(session)} was made of has changed since: run it again."
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
    told = []
    for what, values in (
        (
            "were reconstructed by different methods",
            [text(one.summary.metrics, "method") for one in sessions],
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
            told.append(f"The sessions {what}: {pairs}.")
    return told
