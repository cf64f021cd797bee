"""Results of studies: means with their intervals, tables, the figure, and their part of a session's page.

Rows are plain: `tilt_deg`, `drones`, `noise`, `noise_model`, `method`, `trial`, and the measured figures.
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
from pipelines.geometry.bootstrap import interval_of, resampled
from pipelines.reporting.content import StudyContent
from pipelines.reporting.plates import (
    CAMERAS,
    GRID,
    INK,
    LEVELS,
    MUTED,
    WIDTH_IN,
    Plate,
    new_figure,
    page_style,
    tabled,
)
from pipelines.reporting.wording import fixed, quantity

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
_CONDITION = ("tilt_deg", "drones", "noise", "noise_model", "method")
_VARIED = {"tilt": "tilt_deg", "robots": "drones"}
_NOTHING_MM = 1e-3  # errors below are none: no ratio is taken to them

_PANEL_IN, _ROW_IN, _SMALLEST_IN = 2.7, 2.0, 5.4
_MARKERS = "osD^vPX*"
_BESIDE = 0.012  # of the axis, between the error bars of neighbouring curves if the axis has words
_LETTERS_PER_IN = 16  # of the title
_HEADROOM, _LEAST_TOP = 1.04, 1.0  # above the highest marker; least top of the axis
_DPI = 160

_TITLES = {
    "tilt": "Error against tilt",
    "robots": "Error against the number of drones",
    "noise": "Error against the kind of pose noise",
}
_SHOWN = (METRICS["mpjpe_mm"], METRICS["reconstructed_share"])  # tables on a session's page
_BEST = ("auto", "robust", "midpoint", "dlt")  # the sentence is about the first one available


def estimates(rows: Sequence[Row], study: str, *, seed: int) -> list[dict[str, Any]]:
    """Compute the means over trials of every condition and method.

    Intervals are those of `geometry.bootstrap` over trials.

    Args:
        study: tilt, robots or noise: the condition that the ratio compares.

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
    varied = _CONDITION.index(_VARIED.get(study, "method"))
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


def results_csv(rows: Sequence[Row]) -> str:
    """Write one line for every condition, trial and method; empty where nothing could be measured."""
    text = io.StringIO()
    columns = [name for name in rows[0] if name != "per_joint"]
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


# --- tables --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Table:
    """One figure of a study; the varied condition is in columns."""

    title: str
    header: list[str]
    names: int  # columns of names, before those of figures
    rows: list[list[str]]  # a figure as `mean [low, high]`, without an interval where there is none


def tables(summary: Mapping[str, Any]) -> list[Table]:
    """Make the tables for readers, as text; `-` where nothing could be measured."""
    settings, study = summary["settings"], summary["study"]
    columns = {
        "tilt": [f"{tilt:g} deg" for tilt in settings["tilts_deg"]],
        "robots": [f"{drones} drones" for drones in settings["drones"]],
    }.get(study, list(settings["noise"]))
    head = ["method"] if study == "noise" else ["noise", "method"]
    first = settings["methods"][0] if study == "noise" else columns[0]
    made = []
    for name, title in [*METRICS.items(), ("ratio", f"MPJPE relative to {first}, on common joint-frames")]:
        rows = [
            [*label, *(_text(cell, name) for cell in cells)]
            for label, cells in _lines(summary)
            if name != "fell_back" or label[-1] == "auto"  # no other method can fall back
        ]
        if rows:
            made.append(Table(title, [*head, *columns], len(head), rows))
    return made


def _lines(summary: Mapping[str, Any]) -> list[tuple[tuple[str, ...], list[Mapping[str, Any]]]]:
    """Group the cells by line, in the order of the varied condition."""
    names = ("method",) if summary["study"] == "noise" else ("noise", "method")
    lines: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for cell in summary["cells"]:
        lines.setdefault(tuple(cell[name] for name in names), []).append(cell)
    return list(lines.items())


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


def draw(folder: Path, summary: Mapping[str, Any]) -> None:
    """Write the study's figure as `figure.svg`, `.png` and `.pdf`; equal summaries give equal bytes."""
    width_in = max(0.6 + _PANEL_IN * len(_panels(summary)), _SMALLEST_IN)
    figure = draw_study(summary, width_in, f"Simulated: {setting(summary)}")
    with page_style():
        # Neither dates nor versions: the same study gives the same files.
        figure.savefig(folder / "figure.svg", metadata={"Date": None, "Creator": None})
        figure.savefig(folder / "figure.png", dpi=_DPI, metadata={"Software": None})
        figure.savefig(
            folder / "figure.pdf", metadata={"CreationDate": None, "Creator": None, "Producer": None}
        )


def setting(summary: Mapping[str, Any]) -> str:
    """Describe the filmed scene and the number of trials."""
    settings = summary["settings"]
    drones, tilt = f"{settings['drones'][0]} drones", f"tilt {settings['tilts_deg'][0]:g} deg"
    fixed = {"tilt": drones, "robots": tilt}.get(summary["study"], f"{drones}, {tilt}")
    return (
        f"{fixed}, {settings['seconds']:g} s of walking, keypoints: {summary['keypoints']};"
        f" mean and 95 % interval, trials: {settings['trials']}"
    )


def _panels(summary: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, list[Mapping[str, Any]]]]]]:
    """Return the title of each panel of a row, and its curves: their names, and the cells along the axis."""
    lines = _lines(summary)
    if summary["study"] == "noise":
        return [("", [(label[0], cells) for label, cells in lines])]
    return [
        (method, [(noise, cells) for (noise, of), cells in lines if of == method])
        for method in summary["settings"]["methods"]
    ]


def draw_study(summary: Mapping[str, Any], width_in: float, title: str = "") -> Figure:
    """Draw a row of panels for each of two metrics, with a title above everything if there is one."""
    settings = summary["settings"]
    at, axis, legend = {
        "tilt": (settings["tilts_deg"], "tilt of the formation, deg", "pose noise"),
        "robots": (settings["drones"], "drones", "pose noise"),
    }.get(summary["study"], (list(settings["noise"]), "pose noise", "method"))
    panels = _panels(summary)
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
            axes.set_xlabel(axis)
        handles, labels = grid[0][0].get_legend_handles_labels()
        below = min(len(labels), 3 * len(panels))
        figure.legend(handles, labels, title=legend, loc="outside lower center", ncols=below)
        if title:
            lines = wrap(title, int(_LETTERS_PER_IN * width_in))
            figure.suptitle("\n".join(lines), color=MUTED, fontsize=8.0)
    return figure


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
class Study:
    """One study, for the page."""

    key: str  # of its figure
    title: str
    sentence: str
    setting: str
    command: str
    digest: str  # of its summary.json
    tables: tuple[Table, ...]


def summarise_studies(contents: Sequence[StudyContent]) -> tuple[Study, ...]:
    """Collect everything that the page says of studies.

    Raises:
        KeyError, TypeError, ValueError, IndexError, AttributeError: a summary that is not that of a study.
    """
    return tuple(
        Study(
            key=f"study-{k}",
            title=_TITLES[each.summary["study"]],
            sentence=what_it_shows(each.summary),
            setting=setting(each.summary),
            command=each.command,
            digest=each.digest,
            tables=tuple(table for table in tables(each.summary) if table.title in _SHOWN),
        )
        for k, each in enumerate(contents, start=1)
    )


def draw_studies(contents: Sequence[StudyContent]) -> dict[str, Plate]:
    """Draw the studies' figures, by key."""
    plates = [_plate(f"study-{k}", each.summary) for k, each in enumerate(contents, start=1)]
    return {plate.key: plate for plate in plates}


def _plate(key: str, summary: Mapping[str, Any]) -> Plate:
    names = ("tilt_deg", "drones", "noise", "method")
    columns = [*names, *(f"{name}{end}" for name in _DRAWN for end in ("", "_low", "_high"))]
    rows = []
    for cell in summary["cells"]:
        found = [cell["metrics"][name] or {"mean": None, "interval": None} for name in _DRAWN]
        figures = [value for each in found for value in (each["mean"], *(each["interval"] or (None, None)))]
        rows.append([*(cell[name] for name in names), *figures])
    return Plate(
        key=key,
        title=_TITLES[summary["study"]],
        caption=f"Simulated: {setting(summary)}.",
        description=what_it_shows(summary),
        figure=draw_study(summary, WIDTH_IN),
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
    sentence = f"{under}, {method} errs {_mm(first)} {_where(summary, first)}"
    if first is last:
        return f"{sentence[0].upper()}{sentence[1:]}."
    times = ""
    if last["ratio"] is not None and first["ratio"]["mean"] == 1:
        times = f", {last['ratio']['mean']:.2f} times as much{_interval(last['ratio'])}"
    return f"{sentence[0].upper()}{sentence[1:]} and {_mm(last)} {_where(summary, last)}{times}."


def _least_and_most(method: str, cells: Sequence[Mapping[str, Any]]) -> str:
    least, *_, most = sorted(cells, key=lambda cell: float(cell["metrics"]["mpjpe_mm"]["mean"])) * 2
    sentence = f"{method[0].upper()}{method[1:]} errs "
    if least is most:
        return f"{sentence}{_mm(least)} under {least['noise']}."
    ends = [f"under {cell['noise']}, {_mm(cell)}{_interval_mm(cell)}" for cell in (least, most)]
    return f"{sentence}least {ends[0]}, and most {ends[1]}."


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
