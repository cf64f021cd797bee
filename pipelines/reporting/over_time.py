"""The figure of errors over time, and the time bins that long recordings are drawn by."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.triangulation import STATUS
from pipelines.reporting.motion import Motion
from pipelines.reporting.plates import (
    Plate,
    quiet,
    table,
)
from pipelines.reporting.summary import Summary
from pipelines.reporting.svg import (
    STATUS_COLOURS,
    WIDTH_IN,
    page_style,
)
from pipelines.reporting.wording import (
    STATUS_LABELS,
    quantity,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_BINS = 300


def draw_over_time(summary: Summary, motion: Motion) -> Plate:
    """Draw errors, and the share of measured joints; distances from truth where that is known."""
    from matplotlib.figure import Figure

    seconds = (motion.t_ns - summary.origin_ns) / 1e9
    values = motion.reprojection_px if summary.errors_mm is None else summary.errors_mm
    unit = "px" if summary.errors_mm is None else "mm"
    what = "reprojection error" if summary.errors_mm is None else "distance from truth"
    bins = time_bins(seconds)
    centres, shares = _status_shares(seconds, motion, bins)
    shown = {word: 100 * shares[STATUS.index(word)] for word in summary.statuses}
    middle, low, high = percentiles(np.where(motion.measured, values, np.nan), seconds, bins)
    with page_style():
        figure = Figure((WIDTH_IN, 3.5), layout="constrained")
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[2.4, 1])
        _draw_errors(upper, centres, middle, low, high)
        upper.set_ylabel(f"{what} ({unit})")
        _draw_percentages(lower, bins, shown)
        lower.set_xlabel("time (s)")
        figure.legend(loc="outside upper left", ncols=len(STATUS))
        title = f"{what.capitalize()} over time, and what became of the joints"
        worst = int(np.nanargmax(middle)) if np.isfinite(middle).any() else None
        told = (
            "No joint was measured."
            if worst is None
            else f"The median over joints lies between {quantity(float(np.nanmin(middle)), unit)} and "
            f"{quantity(float(middle[worst]), unit)}, the largest at {quantity(float(centres[worst]), 's')}."
        )
    caption = (
        f"Above: {what} of the measured joints, median and the range from the 10th to the 90th percentile. "
        "Below: the share of joints measured, and why the others were not."
    )
    if len(centres) < len(motion.t_ns):
        caption += f" Each point stands for {bins[1] - bins[0]:.2g} s."
    numbers = table(
        t_s=centres,
        **{f"median_{unit}": middle, f"p10_{unit}": low, f"p90_{unit}": high},
        **{f"{word}_percent": share for word, share in shown.items()},
    )
    return Plate("time", title, caption, told, figure, {"": numbers})


def _draw_errors(axes: Axes, centres: Float, middle: Float, low: Float, high: Float) -> None:
    """Draw a line on its range, from zero."""
    axes.grid(visible=True, axis="y")
    axes.fill_between(centres, low, high, color=STATUS_COLOURS["ok"], alpha=0.22, linewidth=0)
    axes.plot(centres, middle, color=STATUS_COLOURS["ok"])
    axes.set_ylim(0, 1.08 * np.nanmax(high, initial=0.0) or 1.0)
    quiet(axes, grid=False)


def _draw_percentages(axes: Axes, bins: Float, shown: Mapping[str, Float]) -> None:
    """Draw the share of joints by status, one on top of the other."""
    base = np.zeros(len(bins) - 1)
    for word, percent in shown.items():
        top = base + percent
        axes.fill_between(
            *_steps(bins, base, top), color=STATUS_COLOURS[word], linewidth=0, label=STATUS_LABELS[word]
        )
        base = top
    axes.set_ylim(0, 100)
    axes.set_xlim(bins[0], bins[-1])
    axes.set_ylabel("joints (%)")
    quiet(axes)


def time_bins(seconds: Float, most: int = MOST_BINS) -> Float:
    """Return the edges of at most so many bins; one per stamp if there are fewer stamps."""
    count = min(len(seconds), most)
    step = (seconds[-1] - seconds[0]) / max(len(seconds) - 1, 1) or 1.0
    edges: Float = np.linspace(seconds[0] - step / 2, seconds[-1] + step / 2, count + 1)
    return edges


def percentiles(values: Float, seconds: Float, bins: Float) -> tuple[Float, Float, Float]:
    """Compute median, 10th and 90th percentile of the finite values in each bin; NaN in an empty one."""
    edges = np.searchsorted(seconds, bins)
    result = np.full((3, len(bins) - 1), np.nan)
    for k in range(len(bins) - 1):
        inside = values[edges[k] : edges[k + 1]]
        finite = inside[np.isfinite(inside)]
        if finite.size:
            result[:, k] = np.percentile(finite, [50, 10, 90])
    return result[0], result[1], result[2]


def _status_shares(seconds: Float, motion: Motion, bins: Float) -> tuple[Float, Float]:
    """Return the bins' centres, and the share of every status in each, [S, bins]; 0 without rows."""
    edges = np.searchsorted(seconds, bins)
    per_time = np.stack([(motion.status == s).sum(axis=(1, 2)) for s in range(len(STATUS))])
    running = np.concatenate([np.zeros((len(STATUS), 1)), np.cumsum(per_time, axis=1)], axis=1)
    counts = np.diff(running[:, edges], axis=1)
    return (bins[:-1] + bins[1:]) / 2, counts / np.maximum(counts.sum(axis=0), 1)


def _steps(bins: Float, low: Float, high: Float) -> tuple[Float, Float, Float]:
    """Return the corners of a step line: a share holds for the whole of its bin."""
    corners = np.repeat(bins, 2)[1:-1]
    return corners, np.repeat(low, 2), np.repeat(high, 2)
