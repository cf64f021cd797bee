"""Studies on a session's page: their result in a sentence, a table of their errors, and their figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipelines.reporting.ablation import METRICS, Table, drawing, setting, tables
from pipelines.reporting.ablation_figure import draw_study
from pipelines.reporting.content import StudyContent
from pipelines.reporting.plates import Plate, tabled
from pipelines.reporting.svg import WIDTH_IN
from pipelines.reporting.wording import fixed, quantity

_TITLES = {
    "tilt": "Error against tilt",
    "robots": "Error against the number of drones",
    "noise": "Error against the kind of pose noise",
}
_SHOWN = {METRICS["mpjpe_mm"]: True, METRICS["reconstructed_share"]: False}  # True: on common joint-frames
_BEST = ("refined", "robust", "midpoint", "dlt")  # the sentence is about the first one available


@dataclass(frozen=True)
class StudyTable:
    """One figure of a study by condition."""

    title: str
    in_common: bool  # on the joint-frames that every method has
    header: list[str]
    names: int  # columns of names, before those of figures
    rows: list[list[tuple[str, str]]]  # the mean, and its interval where there is one


@dataclass(frozen=True)
class Study:
    """One study, for the page."""

    key: str  # of its figure
    title: str
    sentence: str
    setting: str
    command: str
    digest: str  # of its summary.json
    tables: tuple[StudyTable, ...]


def summarise_studies(contents: Sequence[StudyContent]) -> tuple[Study, ...]:
    """Collect everything that the page says of studies.

    Raises:
        KeyError, TypeError, ValueError, IndexError, AttributeError: a summary that is not that of a study.
    """
    return tuple(
        Study(
            key=_key(k),
            title=_TITLES[each.summary["study"]],
            sentence=what_it_shows(each.summary),
            setting=setting(each.summary),
            command=each.command,
            digest=each.digest,
            tables=tuple(
                _table(table, 1 if each.summary["study"] == "noise" else 2)
                for table in tables(each.summary)
                if table.title in _SHOWN
            ),
        )
        for k, each in enumerate(contents)
    )


def draw_studies(contents: Sequence[StudyContent]) -> dict[str, Plate]:
    """Draw the studies' figures, by key."""
    return {_key(k): _plate(_key(k), each.summary) for k, each in enumerate(contents)}


def _key(k: int) -> str:
    return f"study-{k + 1}"


def _table(table: Table, names: int) -> StudyTable:
    rows = []
    for row in table.rows:
        figures = [text.rstrip("]").partition(" [") for text in row[names:]]
        found = [(mean, interval.replace(", ", " to ")) for mean, _, interval in figures]
        rows.append([*((name, "") for name in row[:names]), *found])
    return StudyTable(table.title, _SHOWN[table.title], table.header, names, rows)


def _plate(key: str, summary: Mapping[str, Any]) -> Plate:
    names = ("tilt_deg", "drones", "noise", "method")
    measured = ("mpjpe_mm", "root_mpjpe_mm")
    columns = [*names, *(f"{name}{end}" for name in measured for end in ("", "_low", "_high"))]
    rows = []
    for cell in summary["cells"]:
        found = [cell["metrics"][name] or {"mean": None, "interval": None} for name in measured]
        figures = [value for each in found for value in (each["mean"], *(each["interval"] or (None, None)))]
        rows.append([*(cell[name] for name in names), *figures])
    return Plate(
        key=key,
        title=_TITLES[summary["study"]],
        caption=f"Simulated: {setting(summary)}.",
        description=what_it_shows(summary),
        figure=draw_study(drawing(summary), WIDTH_IN),
        numbers={"": tabled(columns, rows)},
    )


def what_it_shows(summary: Mapping[str, Any]) -> str:
    """Describe the error at the ends of the varied condition, for one method under the strongest noise."""
    measured = [cell for cell in summary["cells"] if cell["metrics"]["mpjpe_mm"]]
    method = min((cell["method"] for cell in measured), key=_BEST.index)
    own = [cell for cell in measured if cell["method"] == method]
    if summary["study"] == "noise":
        return _least_and_most(method, own)
    noise = own[-1]["noise"]
    first, *_, last = [cell for cell in own if cell["noise"] == noise] * 2  # a single one is both
    under = "without pose noise" if noise == "none" else f"under {noise} pose noise"
    said = f"{under}, {method} errs {_mm(first)} {_where(summary, first)}"
    if first is last:
        return f"{said[0].upper()}{said[1:]}."
    times = ""
    if last["ratio"] is not None and first["ratio"]["mean"] == 1:
        times = f", {last['ratio']['mean']:.2f} times as much{_interval(last['ratio'])}"
    return f"{said[0].upper()}{said[1:]} and {_mm(last)} {_where(summary, last)}{times}."


def _least_and_most(method: str, cells: Sequence[Mapping[str, Any]]) -> str:
    least, *_, most = sorted(cells, key=lambda cell: float(cell["metrics"]["mpjpe_mm"]["mean"])) * 2
    said = f"{method[0].upper()}{method[1:]} errs "
    if least is most:
        return f"{said}{_mm(least)} under {least['noise']}."
    ends = [f"under {cell['noise']}, {_mm(cell)}{_interval_mm(cell)}" for cell in (least, most)]
    return f"{said}least {ends[0]}, and most {ends[1]}."


def _where(summary: Mapping[str, Any], cell: Mapping[str, Any]) -> str:
    return f"at {cell['tilt_deg']:g} deg" if summary["study"] == "tilt" else f"with {cell['drones']} drones"


def _mm(cell: Mapping[str, Any]) -> str:
    found = cell["metrics"]["mpjpe_mm"]
    return quantity(found["mean"], "mm", 0 if found["mean"] >= 100 else 1)


def _interval_mm(cell: Mapping[str, Any]) -> str:
    interval = cell["metrics"]["mpjpe_mm"]["interval"]
    return "" if interval is None else f" ({fixed(interval[0], 0)} to {fixed(interval[1], 0)})"


def _interval(estimate: Mapping[str, Any]) -> str:
    if estimate["interval"] is None:
        return ""
    low, high = estimate["interval"]
    return f" ({low:.2f} to {high:.2f})"
