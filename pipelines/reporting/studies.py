"""Results of studies: means with their intervals, tables, the figure, and their part of a session's page.

Rows are plain: the variables, and the measured figures. A study of a walk has `tilt_deg`, `robots`, `noise`,
`noise_model`, `method` and `trial`; one of a session has `arm`, `range_m`, `tilt_deg`, `robots` and more.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.metrics import interval_of, resampled
from pipelines.reporting.chart import (
    CAMERAS,
    GRID,
    INK,
    LEVELS,
    MUTED,
    PAPER,
    WIDTH_IN,
    Plate,
    new_figure,
    page_style,
    quiet,
    settled,
    tabled,
)
from pipelines.reporting.content import StudyContent
from pipelines.reporting.wording import fixed, plural, quantity

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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

_PANEL_IN, _ROW_IN, _SMALLEST_IN = 2.7, 2.0, 5.4
_MARKERS = "osD^vPX*"
# Error bars of neighbouring curves lie this share of the axis apart, so that none hides another.
_BESIDE = 0.012
# About so many letters of the title fit into an inch.
_LETTERS_PER_IN = 16
_HEADROOM, _LEAST_TOP = 1.04, 1.0  # above the highest marker; least top of the axis
# Figures as PNG have so many pixels to the inch.
_DPI = 160

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
_MARKERS_OF_COUNTS = "os^Dv*P"
_SHOWN = (METRICS["mpjpe_mm"], METRICS["reconstructed_share"])  # tables on a session's page
_BEST = ("auto", "robust", "midpoint", "dlt")  # the sentence is about the first one available


def estimates(rows: Sequence[Row], axis: str, *, seed: int) -> list[dict[str, Any]]:
    """Compute the means over trials of every condition and method.

    Intervals are those of `geometry.metrics` over trials.

    Args:
        axis: tilt_deg, robots or noise: the condition that the ratio compares.

    Returns:
        In the order of the rows, each with the condition and method, and with
        - `metrics`: by name `mean`, `interval` (None where all trials are alike) and the number of `trials`
          that had the figure; None where none had it;
        - `ratio`: of `mpjpe_mm` to the first tilt or number of drones, or for `noise` to the first method,
          trials paired; None where that mean is zero;
        - `per_joint`: means.
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
                "metrics": {name: _mean(own, name, seed) for name in own[0] if _is_measured(name)},
                "ratio": _ratio(own, others, seed),
                "per_joint": _per_joint(own),
            }
        )
    return made


def _is_measured(name: str) -> bool:
    return name not in {*_CONDITION, "trial", "per_joint"}


def _mean(rows: Sequence[Row], name: str, seed: int) -> dict[str, Any] | None:
    values = np.array([row[name] for row in rows if row[name] is not None], dtype=np.float64)
    if not values.size:
        return None
    drawn = resampled({name: (values, np.ones(len(values)))}, None, seed=seed)[name]
    return _estimate(float(values.mean()), drawn, len(values))


def _ratio(rows: Sequence[Row], others: Sequence[Row], seed: int) -> dict[str, Any] | None:
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
    own, other = pairs.mean(axis=0)
    drawn = resampled({"": (pairs[:, 0], pairs[:, 1])}, None, seed=seed)[""]
    return _estimate(float(own / other), drawn, len(pairs))


def _estimate(mean: float, drawn: Float, trials: int) -> dict[str, Any]:
    # Trials without chance (exact poses, pictures filmed once) have no interval.
    ends = interval_of(drawn) if drawn.min() < drawn.max() else None
    return {"mean": mean, "interval": None if ends is None else list(ends), "trials": trials}


def _per_joint(rows: Sequence[Row]) -> dict[str, dict[str, float | None]]:
    means: dict[str, dict[str, float | None]] = {}
    for joint, errors in rows[0]["per_joint"].items():
        means[joint] = {}
        for name in errors:
            values = [row["per_joint"][joint][name] for row in rows]
            there = [value for value in values if value is not None]
            means[joint][name] = float(np.mean(there)) if there else None
    return means


def rows_csv(rows: Sequence[Row]) -> str:
    """Write one line for every row; empty where nothing could be measured."""
    text = io.StringIO()
    columns = [name for name in rows[0] if name != "per_joint"]
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


# --- tables --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StudyTable:
    """One table of a study."""

    title: str
    header: list[str]
    names: int  # columns of names, before those of figures
    rows: list[list[str]]  # a figure as `mean [low, high]`, without an interval where there is none


def tables(metrics: Mapping[str, Any]) -> list[StudyTable]:
    """Make the tables for readers, as text; `-` where nothing could be measured.

    A study of a walk has a table for each figure, with the axis in columns. That of a session is one table.
    """
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
    others = [name for name in metrics["varied"] if name not in _COLUMNS]
    columns = {**dict(list(_COLUMNS.items())[:4]), **dict(zip(others, others, strict=True)), **_COLUMNS}
    percent = {"pck150", "coverage", "hidden_share"}
    rows = []
    for cell in cells:
        row = []
        for name in columns:
            value = cell[name]
            if isinstance(value, float):
                value = f"{100 * value if name in percent else value:.1f}"
            row.append("-" if value is None else str(value))
        rows.append([*row, "best" if cell["best"] else "trade-off" if cell["tradeoff"] else ""])
    return StudyTable("Combinations", [*columns.values(), ""], 4 + len(others), rows)


def _text(cell: Mapping[str, Any], name: str) -> str:
    estimate = cell["ratio"] if name == "ratio" else cell["metrics"][name]
    if estimate is None:
        return "-"
    if name in _SHARES:
        return f"{100 * estimate['mean']:.1f}"
    digits = 2 if name == "ratio" else 1
    text = f"{estimate['mean']:.{digits}f}"
    if estimate["interval"] is None:
        return text
    low, high = estimate["interval"]
    return f"{text} [{low:.{digits}f}, {high:.{digits}f}]"


# --- the figure ----------------------------------------------------------------------------------------


def draw(folder: Path, metrics: Mapping[str, Any]) -> None:
    """Write the study's figure as `figure.svg`, `.png` and `.pdf`; equal studies give equal bytes."""
    if metrics["kind"] == "session":
        figure = _draw_session(metrics)
    else:
        width_in = max(0.6 + _PANEL_IN * len(_panels(metrics)), _SMALLEST_IN)
        figure = _draw_walk(metrics, width_in, f"Simulated: {setting(metrics)}")
    with page_style(), settled(figure):
        # Neither dates nor versions: the same study gives the same files.
        figure.savefig(folder / "figure.svg", metadata={"Date": None, "Creator": None})
        figure.savefig(folder / "figure.png", dpi=_DPI, metadata={"Software": None})
        figure.savefig(
            folder / "figure.pdf", metadata={"CreationDate": None, "Creator": None, "Producer": None}
        )


def setting(metrics: Mapping[str, Any]) -> str:
    """Describe what was filmed or flown, and the number of trials."""
    if metrics["kind"] == "session":
        return f"replays of the flight, keypoints: {metrics['keypoints']}; trials: {metrics['trials']}"
    settings, cells = metrics["settings"], metrics["cells"]
    alike = [f"{cells[0]['robots']} drones"] if len({cell["robots"] for cell in cells}) == 1 else []
    alike += [f"tilt {cells[0]['tilt_deg']:g} deg"] if len({cell["tilt_deg"] for cell in cells}) == 1 else []
    if metrics["axis"] != "noise":  # one of them is on the axis
        alike = [text for text in alike if ("drones" in text) == (metrics["axis"] == "tilt_deg")]
    way = "of walking" if metrics["scenario"] is None else f"of {metrics['scenario']}"
    return (
        ", ".join([*alike, f"{settings['seconds']:g} s {way}, keypoints: {metrics['keypoints']}"])
        + f"; mean and 95 % interval, trials: {settings['trials']}"
    )


def _panels(metrics: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, list[Mapping[str, Any]]]]]]:
    """Return the title of each panel of a row, and its curves: their names, and the cells along the axis."""
    lines = _lines(metrics)
    if metrics["axis"] == "noise" and not _names(metrics):
        return [("", [(label[0], cells) for label, cells in lines])]
    return [
        (method, [(", ".join(names), cells) for (*names, of), cells in lines if of == method])
        for method in metrics["settings"]["methods"]
    ]


def _draw_walk(metrics: Mapping[str, Any], width_in: float, title: str = "") -> Figure:
    """Draw a row of panels for each of two metrics, with a title above everything if there is one."""
    axis = metrics["axis"]
    at = list(dict.fromkeys(cell[axis] for cell in metrics["cells"]))
    panels = _panels(metrics)
    with page_style():
        figure = new_figure(0.9 + _ROW_IN * len(_DRAWN), width_in)
        grid = figure.subplots(len(_DRAWN), len(panels), sharex=True, sharey="row", squeeze=False)
        for name, row in zip(_DRAWN, grid, strict=True):
            for (_, curves), axes in zip(panels, row, strict=True):
                _draw_curves(axes, name, curves, at)
            row[0].set_ylabel(METRICS[name])
            row[0].set_ylim(0, _HEADROOM * max(row[0].get_ylim()[1], _LEAST_TOP))
        for (method, _), axes in zip(panels, grid[0], strict=True):
            axes.set_title(method, color=INK, fontsize=8.4)
        for axes in grid[-1]:
            axes.set_xlabel(_AXES[axis])
        handles, labels = grid[0][0].get_legend_handles_labels()
        below = min(len(labels), 3 * len(panels))
        legend = "method" if axis == "noise" else "pose noise"
        figure.legend(handles, labels, title=legend, loc="outside lower center", ncols=below)
        if title:
            lines = wrap(title, int(_LETTERS_PER_IN * width_in))
            figure.suptitle("\n".join(lines), color=MUTED, fontsize=8.0)
    return figure


def _draw_session(metrics: Mapping[str, Any]) -> Figure:
    """Draw error against way for each combination."""
    rows = metrics["cells"]
    ranges, counts = (sorted({row[name] for row in rows}) for name in ("range_m", "robots"))
    others = [name for name in metrics["varied"] if name not in ("range_m", "robots")]
    with page_style():
        figure = new_figure(4.2)
        axes = figure.subplots()
        for row in rows:
            colour = CAMERAS[ranges.index(row["range_m"]) % len(CAMERAS)]
            error = row["capped_mm"]
            low, high = (row[end] if row[end] is not None else error for end in ("low_mm", "high_mm"))
            marker = _MARKERS_OF_COUNTS[counts.index(row["robots"]) % len(_MARKERS_OF_COUNTS)]
            axes.plot([row["path_m"]] * 2, [low, high], "-", color=colour, linewidth=0.8)
            filled = colour if row["tradeoff"] else PAPER
            axes.plot(row["path_m"], error, marker, color=colour, markersize=5.0, markerfacecolor=filled)
            axes.annotate(
                " ".join(_word(name, row[name]) for name in others if len({each[name] for each in rows}) > 1),
                (row["path_m"], error),
                xytext=(4, 2),
                textcoords="offset points",
                color=MUTED,
                fontsize=6.4,
            )
        axes.set_xlabel("way of all drones, m")
        axes.set_ylabel("error over all joints, at most 150 mm each, mm")
        for k, range_m in enumerate(ranges):
            axes.plot([], [], "s", color=CAMERAS[k % len(CAMERAS)], label=f"{range_m:g} m")
        for k, count in enumerate(counts):
            marker = _MARKERS_OF_COUNTS[k % len(_MARKERS_OF_COUNTS)]
            axes.plot([], [], marker, color=MUTED, markerfacecolor=PAPER, label=plural(count, "drone"))
        axes.plot([], [], "o", color=MUTED, label="trade-off")
        figure.legend(loc="outside upper left", ncols=min(len(ranges) + len(counts) + 1, 7))
        quiet(axes, "both")
    return figure


def _word(name: str, value: object) -> str:
    return {"arm": str(value), "tilt_deg": f"{value:g}°" if isinstance(value, int | float) else ""}.get(
        name, f"{name} {value}"
    )


def _draw_curves(
    axes: Axes,
    name: str,
    curves: Sequence[tuple[str, Sequence[Mapping[str, Any]]]],
    at: Sequence[float] | Sequence[str],
) -> None:
    """Draw the means of a metric with their intervals; words along the axis are put side by side."""
    numbers = [float(value) if isinstance(value, int | float) else k for k, value in enumerate(at)]
    words = any(isinstance(value, str) for value in at)
    step = _BESIDE * (len(at) - 1 or 1) if words else 0.0
    for k, (label, cells) in enumerate(curves):
        shift = (k - (len(curves) - 1) / 2) * step
        found = zip(numbers, (cell["metrics"][name] for cell in cells), strict=True)
        there = [(x + shift, y["mean"], y["interval"] or (y["mean"],) * 2) for x, y in found if y is not None]
        below, above = ([abs(y - interval[end]) for _, y, interval in there] for end in (0, 1))
        axes.errorbar(
            [x for x, *_ in there],
            [y for _, y, _ in there],
            [below, above],
            label=label,
            color=CAMERAS[k % len(CAMERAS)]
            if words or len(curves) > len(LEVELS)
            else LEVELS[k + len(LEVELS) - len(curves)],  # levels of noise have an order
            marker=_MARKERS[k % len(_MARKERS)],
            markersize=3.2,
            linestyle="none" if words else "-",
            capsize=2.0,
            elinewidth=0.8,
        )
    axes.set_xticks(numbers, [_tick(value, len(at)) for value in at])
    axes.grid(axis="y", color=GRID)
    axes.tick_params(length=0)


def _tick(value: float | str, count: int) -> str:
    """Format a tick label: words are wrapped in lines that leave room for those beside them."""
    if not isinstance(value, str):
        return f"{value:g}"
    return "\n".join(wrap(value.replace(",", ", "), max(int(_LETTERS_PER_IN * _SMALLEST_IN / count) - 1, 1)))


# --- on a session's page -------------------------------------------------------------------------------


@dataclass(frozen=True)
class StudySummary:
    """One study, for the page."""

    key: str  # of its figure
    title: str
    sentence: str
    setting: str
    command: str
    digest: str  # of its metrics.json
    tables: tuple[StudyTable, ...]


def summarise_studies(contents: Sequence[StudyContent]) -> tuple[StudySummary, ...]:
    """Collect everything that the page says of studies.

    Raises:
        KeyError, TypeError, ValueError, IndexError, AttributeError: metrics that are not those of a study.
    """
    return tuple(
        StudySummary(
            key=f"study-{k}",
            title=_title(each.metrics),
            sentence=what_it_shows(each.metrics),
            setting=setting(each.metrics),
            command=each.command,
            digest=each.digest,
            tables=tuple(
                table
                for table in tables(each.metrics)
                if each.metrics["kind"] == "session" or table.title in _SHOWN
            ),
        )
        for k, each in enumerate(contents, start=1)
    )


def _title(metrics: Mapping[str, Any]) -> str:
    if metrics["kind"] == "session":
        return f"Error against way, by {', '.join(metrics['varied'])}"
    return _TITLES[metrics["axis"]]


def draw_studies(contents: Sequence[StudyContent]) -> dict[str, Plate]:
    """Draw the studies' figures, by key."""
    plates = [_plate(f"study-{k}", each.metrics) for k, each in enumerate(contents, start=1)]
    return {plate.key: plate for plate in plates}


def _plate(key: str, metrics: Mapping[str, Any]) -> Plate:
    if metrics["kind"] == "session":
        rows = metrics["cells"]
        columns = [*rows[0]]
        caption = (
            f"Simulated: {plural(len(rows), 'combination')}. A joint that was not measured counts as 150 mm"
            " off. Strokes are the intervals over draws of noise. Filled: no other combination is better or"
            " equal in error, way and range together."
        )
        numbers = {"": tabled(columns, [[row[name] for name in columns] for row in rows])}
        figure = _draw_session(metrics)
        return Plate(key, _title(metrics), caption, what_it_shows(metrics), figure, numbers)
    names = ("tilt_deg", "robots", "noise", "method")
    columns = [*names, *(f"{name}{end}" for name in _DRAWN for end in ("", "_low", "_high"))]
    rows = []
    for cell in metrics["cells"]:
        found = [cell["metrics"][name] or {"mean": None, "interval": None} for name in _DRAWN]
        figures = [value for each in found for value in (each["mean"], *(each["interval"] or (None, None)))]
        rows.append([*(cell[name] for name in names), *figures])
    return Plate(
        key=key,
        title=_title(metrics),
        caption=f"Simulated: {setting(metrics)}.",
        description=what_it_shows(metrics),
        figure=_draw_walk(metrics, WIDTH_IN),
        numbers={"": tabled(columns, rows)},
    )


def what_it_shows(metrics: Mapping[str, Any]) -> str:
    """Describe the best combination, or the error at the ends of the axis, for the best method."""
    if metrics["kind"] == "session":
        verdict = metrics["verdict"]
        return f"{verdict[0].upper()}{verdict[1:]}."
    measured = [cell for cell in metrics["cells"] if cell["metrics"]["mpjpe_mm"]]
    method = min((cell["method"] for cell in measured), key=_BEST.index)
    own = [cell for cell in measured if cell["method"] == method]
    if metrics["axis"] == "noise":
        return _least_and_most(method, own)
    noise = own[-1]["noise"]
    first, *_, last = [cell for cell in own if cell["noise"] == noise] * 2  # a single one is both
    under = "without pose noise" if noise == "none" else f"under {noise} pose noise"
    sentence = f"{under}, {method} errs {_mm(first)} {_where(metrics, first)}"
    if first is last:
        return f"{sentence[0].upper()}{sentence[1:]}."
    times = ""
    if last["ratio"] is not None and first["ratio"]["mean"] == 1:
        times = f", {last['ratio']['mean']:.2f} times as much{_interval(last['ratio'])}"
    return f"{sentence[0].upper()}{sentence[1:]} and {_mm(last)} {_where(metrics, last)}{times}."


def _least_and_most(method: str, cells: Sequence[Mapping[str, Any]]) -> str:
    least, *_, most = sorted(cells, key=lambda cell: float(cell["metrics"]["mpjpe_mm"]["mean"])) * 2
    sentence = f"{method[0].upper()}{method[1:]} errs "
    if least is most:
        return f"{sentence}{_mm(least)} under {least['noise']}."
    ends = [f"under {cell['noise']}, {_mm(cell)}{_interval_mm(cell)}" for cell in (least, most)]
    return f"{sentence}least {ends[0]}, and most {ends[1]}."


def _where(metrics: Mapping[str, Any], cell: Mapping[str, Any]) -> str:
    return (
        f"at {cell['tilt_deg']:g} deg" if metrics["axis"] == "tilt_deg" else f"with {cell['robots']} drones"
    )


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
