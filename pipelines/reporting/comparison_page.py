"""The page that compares sessions, as one self-contained file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from markupsafe import Markup

from pipelines.reporting import wording
from pipelines.reporting.comparison import MEASURES, Comparison, Difference, Judged, Measure, Pair, compare
from pipelines.reporting.comparison_figures import colour_of, draw_comparison, joints_of, shown_measure
from pipelines.reporting.comparison_verdict import judge
from pipelines.reporting.content import SessionContent, section, text
from pipelines.reporting.plates import Plate
from pipelines.reporting.svg import PALETTE
from pipelines.reporting.templating import environment

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
            DifferenceRow(one, found, _lower(found), _verdict(one, found))
            for one in MEASURES
            if (found := pair.differences.get(one.key)) is not None
        ],
        per_joint=shown.per_joint if shown is not None else {},
    )


def _lower(found: Difference) -> str:
    return f"{found.lower} of {found.joints}" if found.joints > 1 else wording.ABSENT


def _verdict(measure: Measure, found: Difference) -> str:
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
