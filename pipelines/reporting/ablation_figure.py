"""The figure of a study: errors with their intervals, one panel for every method or level of noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from pipelines.reporting.svg import CAMERAS, GRID, INK, LEVELS, MUTED, page_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANEL_IN, _ROW_IN, _SMALLEST_IN = 2.7, 2.0, 5.4
_MARKERS = "osD^vPX*"
_BESIDE = 0.012  # of the axis, between the error bars of neighbouring curves if the axis has words
_LETTERS_PER_IN = 16  # of the title
_HEADROOM, _LEAST_TOP = 1.04, 1.0  # above the highest marker; least top of the axis
_DPI = 160


@dataclass(frozen=True)
class Curve:
    """One line of a panel; None where nothing could be measured."""

    label: str
    mean: Sequence[float | None]
    interval: Sequence[tuple[float, float] | None]


@dataclass(frozen=True)
class Panel:
    """One pair of axes."""

    title: str
    curves: Sequence[Curve]


@dataclass(frozen=True)
class StudyDrawing:
    """Contents of a study's figure."""

    rows: Sequence[tuple[str, Sequence[Panel]]]
    """Name of each measured figure, and its panels, the same number in every row."""
    at: Sequence[float] | Sequence[str]
    """The values along the horizontal axis; words are put side by side."""
    axis: str
    """Title of the horizontal axis."""
    legend: str
    """Title of the legend of curves."""
    ordered: bool
    """True if the curves have an order, which their colours then show."""


def save_study(folder: Path, drawing: StudyDrawing, title: str) -> None:
    """Write `figure.svg`, `.png` and `.pdf`; equal arguments give equal bytes."""
    width_in = max(0.6 + _PANEL_IN * len(drawing.rows[0][1]), _SMALLEST_IN)
    figure = draw_study(drawing, width_in, title)
    with page_style():
        # Neither dates nor versions: the same study gives the same files.
        figure.savefig(folder / "figure.svg", metadata={"Date": None, "Creator": None})
        figure.savefig(folder / "figure.png", dpi=_DPI, metadata={"Software": None})
        figure.savefig(
            folder / "figure.pdf", metadata={"CreationDate": None, "Creator": None, "Producer": None}
        )


def draw_study(drawing: StudyDrawing, width_in: float, title: str = "") -> Figure:
    """Draw a study, with a title above everything if there is one."""
    from matplotlib.figure import Figure

    rows, at = drawing.rows, drawing.at
    columns = len(rows[0][1])
    with page_style():
        figure = Figure((width_in, 0.9 + _ROW_IN * len(rows)), layout="constrained")
        grid = figure.subplots(len(rows), columns, sharex=True, sharey="row", squeeze=False)
        for (measured, panels), line in zip(rows, grid, strict=True):
            for panel, axes in zip(panels, line, strict=True):
                _draw(axes, panel, at, ordered=drawing.ordered)
            line[0].set_ylabel(measured)
            line[0].set_ylim(0, _HEADROOM * max(line[0].get_ylim()[1], _LEAST_TOP))
        for panel, axes in zip(rows[0][1], grid[0], strict=True):
            axes.set_title(panel.title, color=INK, fontsize=8.4)
        for axes in grid[-1]:
            axes.set_xlabel(drawing.axis)
        handles, labels = grid[0][0].get_legend_handles_labels()
        below = min(len(labels), 3 * columns)
        figure.legend(handles, labels, title=drawing.legend, loc="outside lower center", ncols=below)
        if title:
            lines = wrap(title, int(_LETTERS_PER_IN * width_in))
            figure.suptitle("\n".join(lines), color=MUTED, fontsize=8.0)
    return figure


def _draw(axes: Axes, panel: Panel, at: Sequence[float] | Sequence[str], *, ordered: bool) -> None:
    numbers = [float(value) if isinstance(value, int | float) else k for k, value in enumerate(at)]
    words = any(isinstance(value, str) for value in at)
    step = _BESIDE * (len(at) - 1 or 1) if words else 0.0
    for k, curve in enumerate(panel.curves):
        shift = (k - (len(panel.curves) - 1) / 2) * step
        there = [
            (x + shift, y, interval or (y, y))
            for x, y, interval in zip(numbers, curve.mean, curve.interval, strict=True)
            if y is not None
        ]
        below, above = ([abs(y - interval[end]) for _, y, interval in there] for end in (0, 1))
        axes.errorbar(
            [x for x, *_ in there],
            [y for _, y, _ in there],
            [below, above],
            label=curve.label,
            color=_colour(k, len(panel.curves), ordered),
            marker=_MARKERS[k % len(_MARKERS)],
            markersize=3.2,
            linestyle="none" if words else "-",
            capsize=2.0,
            elinewidth=0.8,
        )
    axes.set_xticks(numbers, [_label(value, len(at)) for value in at])
    axes.grid(axis="y", color=GRID)
    axes.tick_params(length=0)


def _colour(k: int, count: int, ordered: bool) -> Any:
    if ordered and count <= len(LEVELS):
        return LEVELS[k + len(LEVELS) - count]
    return CAMERAS[k % len(CAMERAS)]


def _label(value: float | str, count: int) -> str:
    """Format a tick label: words are wrapped in lines that leave room for those beside them."""
    if not isinstance(value, str):
        return f"{value:g}"
    return "\n".join(wrap(value.replace(",", ", "), max(int(_LETTERS_PER_IN * _SMALLEST_IN / count) - 1, 1)))
