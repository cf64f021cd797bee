"""Results of studies: means with their intervals, tables, the figure, and their part of a session's page.

Rows are plain: the variables, and the measured figures. A study of a walk has `tilt_deg`, `robots`, `noise`,
`noise_model`, `method` and `trial`; one of a session has `arm`, `range_m`, `tilt_deg`, `robots` and more.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.metrics import intervals
from pipelines.reporting.chart import CAMERAS, LEVELS, Figure, Mark, Note, Panel, Points, write_drawing
from pipelines.reporting.content import StudyContent
from pipelines.reporting.wording import Column, Table, plural

Row = dict[str, Any]

METRICS = {
    "mpjpe_mm": "MPJPE, mm",
    "root_mpjpe_mm": "Root-relative MPJPE, mm",
    "pa_mpjpe_mm": "PA-MPJPE, mm",
    "own_mpjpe_mm": "MPJPE of everything that the method itself reconstructed, mm",
    "pck150": "PCK@150 mm, missing joints counted as wrong, %",
    "reconstructed_share": "Reconstructed, %",
    "fell_back": "Trials in which auto fell back to robust, %",
}
"""Titles of the metrics in the tables; the first three are on the joint-frames that every method has."""

_SHARES = {"pck150", "reconstructed_share", "fell_back"}  # in percent there
_DRAWN = ("mpjpe_mm", "root_mpjpe_mm")
_CONDITION = ("tilt_deg", "robots", "noise", "noise_model", "method")
# Errors below this are rounding, and a ratio to them means nothing.
_NOTHING_MM = 1e-3

_MARKERS = "osD^vPX*"
# Error bars of neighbouring curves lie this share of the axis apart, so that none hides another.
BESIDE_SHARE = 0.012
# Two panels below each other fill a screen.
ROW_IN = 2.0
# Room above the highest marker.
HEADROOM = 1.04

_TITLES = {
    "tilt_deg": "Error against tilt",
    "robots": "Error against the number of drones",
    "noise": "Error against the kind of pose noise",
}
_AXES = {"tilt_deg": "tilt of the formation, deg", "robots": "drones", "noise": "pose noise"}
_COLUMNS = {
    "arm": "arm",
    "range_m": "range m",
    "tilt_deg": "tilt",
    "robots": "drones",
    "capped_mm": "error mm",
    "mpjpe_mm": "MPJPE mm",
    "pck150": "PCK150 %",
    "coverage": "covered %",
    "mean_range_m": "flown range m",
    "hidden_share": "hidden %",
    "blind_s": "blind s",
    "path_m": "path m",
    "energy_kj": "energy kJ",
    "min_separation_m": "separation m",
    "violations": "violations",
}
ENDS = {
    "capped_mm": ("low_mm", "high_mm"),
    **{name: (f"{name}_low", f"{name}_high") for name in ("mpjpe_mm", "pck150", "coverage")},
}
"""The columns of the ends of an interval, by the column of its mean, in a study of a session."""
_ALIKE = {"robots": "{} drones", "tilt_deg": "tilt {:g} deg", "range_m": "{:g} m"}  # said once if all have it
_SHOWN = (METRICS["mpjpe_mm"], METRICS["reconstructed_share"])  # tables on a session's page


def estimates(rows: Sequence[Row], axis: str) -> list[dict[str, Any]]:
    """Compute the means over trials of every condition and method, in the order of the rows.

    Each has `metrics` by name: `mean`, `interval` (None where all trials are alike) and the number of
    `trials`, or None where none had the figure; `ratio` of `mpjpe_mm` to the first value of `axis` (of
    `noise`: to the first method), trials paired, None where that mean is zero.
    """
    by_condition: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        by_condition.setdefault(tuple(row[name] for name in _CONDITION), []).append(row)
    varied = _CONDITION.index("method" if axis == "noise" else axis)
    first = next(iter(by_condition))[varied]
    made = []
    for condition, own in by_condition.items():
        others = by_condition[(*condition[:varied], first, *condition[varied + 1 :])]
        made.append(
            {
                **dict(zip(_CONDITION, condition, strict=True)),
                "metrics": {name: _mean(own, name) for name in own[0] if name not in {*_CONDITION, "trial"}},
                "ratio": _ratio(own, others),
            }
        )
    return made


def _mean(rows: Sequence[Row], name: str) -> dict[str, Any] | None:
    values = np.array([row[name] for row in rows if row[name] is not None], dtype=np.float64)
    return _estimate(values, np.ones(len(values))) if values.size else None


def _ratio(rows: Sequence[Row], others: Sequence[Row]) -> dict[str, Any] | None:
    """Compute the mean error as a multiple of another condition's; trials share random numbers in both."""
    pairs = np.array(
        [
            (row["mpjpe_mm"], other["mpjpe_mm"])
            for row, other in zip(rows, others, strict=True)
            if None not in (row["mpjpe_mm"], other["mpjpe_mm"])
        ],
        dtype=np.float64,
    ).reshape(-1, 2)
    if not len(pairs) or pairs[:, 1].min() < _NOTHING_MM:
        return None
    return _estimate(pairs[:, 0], pairs[:, 1])


def _estimate(sums: Float, weights: Float) -> dict[str, Any]:
    """Compute a ratio over trials; without chance (exact poses, pictures filmed once) it has no interval."""
    ends = intervals({"": (sums, weights)}, None)[""]
    interval = list(ends) if ends is not None and ends[0] < ends[1] else None
    return {"mean": float(sums.sum() / weights.sum()), "interval": interval, "trials": len(sums)}


def rows_csv(rows: Sequence[Row]) -> str:
    """Write one line for every row; empty where nothing could be measured."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


@dataclass(frozen=True)
class StudyTable:
    """One table of a study."""

    title: str
    header: list[str]
    names: int  # columns of names, before those of figures
    rows: list[list[str]]  # a figure as `mean [low, high]`, without an interval where there is none


def tables(metrics: Mapping[str, Any]) -> list[StudyTable]:
    """Make the tables of a study, `-` where nothing was measured; of a walk one for each figure."""
    if metrics["kind"] == "session":
        return [_table_of_session(metrics)]
    axis = metrics["axis"]
    columns = list(dict.fromkeys(_column(cell, axis) for cell in metrics["cells"]))
    lines = _lines(metrics)
    head = [*_names(metrics), "method"]
    first = metrics["settings"]["methods"][0] if axis == "noise" else columns[0]
    made = []
    for name, title in [*METRICS.items(), ("ratio", f"MPJPE relative to {first}, on common joint-frames")]:
        rows = [
            [*label, *(_text(cell, name) for cell in cells)]
            for label, cells in lines
            if name != "fell_back" or label[-1] == "auto"  # no other method can fall back
        ]
        if rows:
            made.append(StudyTable(title, [*head, *columns], len(head), rows))
    return made


def _column(cell: Mapping[str, Any], axis: str) -> str:
    if axis == "noise":
        return str(cell["noise"])
    return f"{cell['tilt_deg']:g} deg" if axis == "tilt_deg" else f"{cell['robots']} drones"


def _names(metrics: Mapping[str, Any]) -> list[str]:
    """List the conditions that tell the lines of a walk's study apart, besides the method."""
    names = [] if metrics["axis"] == "noise" else ["noise"]
    others = [name for name in ("tilt_deg", "robots") if name != metrics["axis"]]
    return names + [name for name in others if len({cell[name] for cell in metrics["cells"]}) > 1]


def _lines(metrics: Mapping[str, Any]) -> list[tuple[tuple[str, ...], list[Mapping[str, Any]]]]:
    """Group the cells by line, in the order along the axis."""
    names = [*_names(metrics), "method"]
    lines: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for cell in metrics["cells"]:
        label = tuple(str(cell[name]) for name in names)
        lines.setdefault(label, []).append(cell)
    return list(lines.items())


def _table_of_session(metrics: Mapping[str, Any]) -> StudyTable:
    cells = metrics["cells"]
    stated = dict.fromkeys([*list(_COLUMNS)[:4], *metrics["varied"]])
    names = [name for name in stated if name == "arm" or len({str(cell[name]) for cell in cells}) > 1]
    columns = {
        name: _COLUMNS.get(name, name.removeprefix("imperfections."))
        for name in [*names, *list(_COLUMNS)[4:]]
    }
    percent, mark = {"pck150", "coverage", "hidden_share"}, len(names)
    rows = []
    for cell in cells:
        row: list[str] = []
        for name in columns:
            value = cell[name]
            if isinstance(value, float):
                shown = f"{100 * value if name in percent else value:.1f}"
                value = f"{value:g}" if name in names else shown
            low, high = (cell.get(end) for end in ENDS.get(name, ("", "")))
            if low is not None:
                value += f" ±{(100 if name in percent else 1) * (high - low) / 2:.1f}"
            row.append("-" if value is None else str(value))
        row.insert(mark, "best" if cell["best"] else "trade-off" if cell["tradeoff"] else "")
        rows.append(row)
    header = list(columns.values())
    return StudyTable("Combinations", [*header[:mark], "", *header[mark:]], mark + 1, rows)


def _text(cell: Mapping[str, Any], name: str) -> str:
    estimate = cell["ratio"] if name == "ratio" else cell["metrics"][name]
    if estimate is None:
        return "-"
    scale, digits = 100 if name in _SHARES else 1, 2 if name == "ratio" else 1
    text = f"{scale * estimate['mean']:.{digits}f}"
    if estimate["interval"] is None:
        return text
    low, high = (scale * end for end in estimate["interval"])
    return f"{text} [{low:.{digits}f}, {high:.{digits}f}]"


def draw(folder: Path, metrics: Mapping[str, Any]) -> None:
    """Write the study's figure as `figure.svg`, `.png` and `.pdf`; equal studies give equal bytes."""
    write_drawing(folder, "figure", draw_study("study", metrics))


def setting(metrics: Mapping[str, Any]) -> str:
    """Describe what was filmed or flown, and the number of trials."""
    cells = metrics["cells"]
    alike = [
        text.format(cells[0][name])
        for name, text in _ALIKE.items()
        if len({cell.get(name) for cell in cells}) == 1 and name in cells[0]
    ]
    if metrics["kind"] == "session":
        walks = f" over {plural(metrics['walks'], 'walk')}" if metrics["walks"] > 1 else ""
        made = f"replays of the flight{walks}, keypoints: {metrics['keypoints']}; trials: {metrics['trials']}"
        return ", ".join([*alike, made])
    settings = metrics["settings"]
    way = "of walking" if metrics["scenario"] is None else f"of {metrics['scenario']}"
    return (
        ", ".join([*alike, f"{settings['seconds']:g} s {way}, keypoints: {metrics['keypoints']}"])
        + f"; mean and 95 % interval, trials: {settings['trials']}"
    )


def study_blocks(study: StudyContent, figure: Figure) -> list[str | Table | Figure]:
    """Return the parts of a study's section of a page."""
    metrics = study.metrics
    made = f"Simulated: {setting(metrics)}. {study.command}; metrics.json {study.digest}"
    shown = [each for each in tables(metrics) if metrics["kind"] == "session" or each.title in _SHOWN]
    verdict = metrics.get("verdict", "")
    return [
        *([f"{verdict[0].upper()}{verdict[1:]}."] if verdict else []),
        made,
        figure,
        *(_as_table(f"{figure.key}-{k}", of) for k, of in enumerate(shown)),
    ]


def _as_table(key: str, study: StudyTable) -> Table:
    columns = [Column(title, text=k < study.names) for k, title in enumerate(study.header)]
    cells = [[cell.rstrip("]").partition(" [") for cell in row] for row in study.rows]
    rows = [[(mean, interval.replace(", ", " to ")) for mean, _, interval in row] for row in cells]
    return Table(key, f"{study.title}, simulated; below a value its interval.", columns, rows, "arms")


def draw_study(key: str, metrics: Mapping[str, Any]) -> Figure:
    """Draw a study: the error along its axis, or of combinations against their way."""
    return _draw_session(key, metrics) if metrics["kind"] == "session" else _draw_walk(key, metrics)


def _draw_walk(key: str, metrics: Mapping[str, Any]) -> Figure:
    axis = metrics["axis"]
    at = list(dict.fromkeys(cell[axis] for cell in metrics["cells"]))
    places = [k if axis == "noise" else float(value) for k, value in enumerate(at)]
    ticks = {
        place: str(value) if axis == "noise" else f"{value:g}"
        for place, value in zip(places, at, strict=True)
    }
    lines = _lines(metrics)
    methods = [""] if axis == "noise" and not _names(metrics) else metrics["settings"]["methods"]
    rows = []
    for name in _DRAWN:
        panels = []
        for method in methods:
            curves = [(label, cells) for label, cells in lines if not method or label[-1] == method]
            marks = [
                _curve(k, len(curves), ", ".join(label[:-1] if method else label), cells, name, places, axis)
                for k, (label, cells) in enumerate(curves)
            ]
            top = max((float(np.max(mark.y)) for mark in marks if len(mark.y)), default=0.0)
            label = METRICS[name] if method == methods[0] else ""
            x_label = _AXES[axis] if name == _DRAWN[-1] else ""
            span = (0, 1.2 * HEADROOM * max(top, 1.0))
            panels.append(Panel(marks, x_label, label, y_span=span, x_ticks=ticks, title=method))
        rows.append(panels)
    caption = f"Simulated: {setting(metrics)}."
    return Figure(key, _TITLES[axis], caption, rows, 0.9 + ROW_IN * len(rows), share_y=False)


def _curve(
    k: int,
    count: int,
    name: str,
    cells: Sequence[Mapping[str, Any]],
    metric: str,
    places: Sequence[float],
    axis: str,
) -> Points:
    """Draw the means of a metric with their intervals; words along the axis are put side by side."""
    shift = (k - (count - 1) / 2) * BESIDE_SHARE * (len(places) - 1 or 1) if axis == "noise" else 0.0
    known = [(x + shift, cell["metrics"][metric]) for x, cell in zip(places, cells, strict=True)]
    known = [(x, found) for x, found in known if found is not None]
    ordered = axis != "noise" and count <= len(LEVELS)  # levels of noise have an order
    return Points(
        [x for x, _ in known],
        [found["mean"] for _, found in known],
        LEVELS[k + len(LEVELS) - count] if ordered else CAMERAS[k % len(CAMERAS)],
        name,
        [found["interval"] for _, found in known],
        "y",
        _MARKERS[k % len(_MARKERS)],
        joined=axis != "noise",
    )


def _draw_session(key: str, metrics: Mapping[str, Any]) -> Figure:
    cells = metrics["cells"]
    ranges, counts = (sorted({cell[name] for cell in cells}) for name in ("range_m", "robots"))
    others = [name for name in metrics["varied"] if name not in ("range_m", "robots")]
    marks: list[Mark] = []
    for cell in cells:
        error = cell["capped_mm"]
        ends = None if cell["low_mm"] is None else (cell["low_mm"], cell["high_mm"])
        colour = CAMERAS[ranges.index(cell["range_m"]) % len(CAMERAS)]
        marker = _MARKERS[counts.index(cell["robots"]) % len(_MARKERS)]
        name, filled = f"{cell['range_m']:g} m, {plural(cell['robots'], 'drone')}", bool(cell["tradeoff"])
        marks.append(Points([cell["path_m"]], [error], colour, name, [ends], "y", marker, filled))
        words = " ".join(
            f"{cell[name]:g}" if isinstance(cell[name], float) else str(cell[name]) for name in others
        )
        marks.append(Note(cell["path_m"], error, f"\n\n{words}"))
    panel = Panel(marks, "way of all drones (m)", "error, at most 150 mm each (mm)", grid="both")
    caption = (
        f"Simulated: {plural(len(cells), 'combination')}. A joint that was not measured counts as 150 mm off."
        " Filled: no other combination is better or equal in error, way and range together."
    )
    return Figure(key, f"Error against way, by {', '.join(metrics['varied'])}", caption, [[panel]], 4.2)
