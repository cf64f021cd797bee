"""The arms of a comparison over time: tilt, range, hidden sight lines, and the predicted error."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.reporting.plates import MOST_POINTS, Plate, every, quiet, stacked, table
from pipelines.reporting.replanned import Arm, span_s
from pipelines.reporting.svg import CAMERAS, WIDTH_IN, page_style
from pipelines.reporting.wording import fixed, percent, quantity, shortened

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes


def draw_arms_over_time(arms: tuple[Arm, ...]) -> Plate:
    """Draw four strips, one below the other, over the same time."""
    from matplotlib.figure import Figure

    strips = sum(len(arm.cameras) for arm in arms)
    heights_in = [1.35, 1.15, 0.3 + 0.085 * strips, 1.15]
    with page_style():
        figure = Figure((WIDTH_IN, 0.7 + sum(heights_in)), layout="constrained")
        tilt, reach, sight, error = figure.subplots(4, 1, sharex=True, height_ratios=heights_in)
        for arm in arms:
            _band(tilt, arm, arm.tilt_deg)
            _band(reach, arm, arm.range_m)
            expected = _thinned(arm.t_s, 100 * arm.predicted_error_m)
            error.plot(*expected, color=CAMERAS[arm.colour], label=shortened(arm.name))
        _draw_sight(sight, arms)
        tilt.set_ylabel("tilt (deg)")
        reach.set_ylabel("range (m)")
        sight.set_ylabel("hidden")
        error.set_ylabel("predicted\nerror (cm)")
        error.set_ylim(0, _top(arms))
        error.set_xlabel("time (s)")
        for axes in (tilt, reach, error):
            axes.grid(visible=True, axis="y")
            quiet(axes, grid=False)
        quiet(sight)
        sight.spines["bottom"].set_visible(False)
        error.set_xlim(*span_s(arms))
        figure.align_ylabels([tilt, reach, sight, error])
        handles, labels = error.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=len(arms))
        title = "Tilt, range, sight and predicted error over time"
        told = " ".join(_told_over_time(arm) for arm in arms)
    caption = (
        "Above: tilt of the cameras over the actor and their range, the mean of an arm's drones as a line "
        "and all of them within the band. Middle: a row per drone, drawn while something stands between it "
        "and the actor. Below: the error to be expected of the position from all cameras together; "
        "no line where they determine none."
    )
    step = every(len(arms[0].t_s), MOST_POINTS)
    if step > 1:
        caption += f" A point of a line stands for {step} poses, the band holds them all."
    cut = [arm for arm in arms if np.nanmax(arm.predicted_error_m, initial=0.0) * 100 > _top(arms)]
    if cut:
        caption += f" Errors above {quantity(_top(arms), 'cm', 0)} are cut off."
    return Plate("arms-time", title, caption, told, figure, {"": stacked([_numbers(arm) for arm in arms])})


def _numbers(arm: Arm) -> pd.DataFrame:
    """Tabulate every pose of an arm that the bands and rows are drawn from."""
    cameras = len(arm.cameras)
    return table(
        arm=arm.name,
        camera=np.repeat(arm.cameras, len(arm.t_s)),
        t_s=np.tile(arm.t_s, cameras),
        tilt_deg=arm.tilt_deg.ravel(),
        range_m=arm.range_m.ravel(),
        hidden=(~arm.visible).ravel().astype(int),
        predicted_error_cm=np.tile(100 * arm.predicted_error_m, cameras),
    )


def _band(axes: Axes, arm: Arm, values: Float) -> None:
    """Draw the mean over cameras of [C, T] as a line, on the range of all of them."""
    colour = CAMERAS[arm.colour]
    starts = np.arange(0, len(arm.t_s), every(len(arm.t_s), MOST_POINTS))
    seconds, mean = _thinned(arm.t_s, values.mean(axis=0))
    low = np.minimum.reduceat(values.min(axis=0), starts)
    high = np.maximum.reduceat(values.max(axis=0), starts)
    axes.fill_between(seconds, low, high, color=colour, alpha=0.16, linewidth=0)
    axes.plot(seconds, mean, color=colour)


def _thinned(seconds: Float, values: Float) -> tuple[Float, Float]:
    """Return times and means of at most `MOST_POINTS` stretches of equally many values.

    A mean is NaN if one of its values is NaN.
    """
    starts = np.arange(0, len(seconds), every(len(seconds), MOST_POINTS))
    count = np.diff([*starts, len(seconds)])
    return np.add.reduceat(seconds, starts) / count, np.add.reduceat(values, starts) / count


def _draw_sight(axes: Axes, arms: tuple[Arm, ...]) -> None:
    row, middles = 0, []
    for arm in arms:
        middles.append(row + (len(arm.cameras) - 1) / 2)
        for seen in arm.visible:
            spans = [(start, end - start) for start, end in hidden_spans(arm.t_s, seen)]
            axes.broken_barh(spans, (row - 0.36, 0.72), facecolor=CAMERAS[arm.colour])
            row += 1
    axes.set_yticks(middles, [shortened(arm.name) for arm in arms])
    axes.set_ylim(row - 0.4, -0.6)


def hidden_spans(seconds: Float, seen: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Return the start and end of each span in which a drone sees nothing.

    Each moment lasts until the next one.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], ~seen, [False]]).astype(np.int8)))
    ends = np.append(seconds, seconds[-1])
    return [(float(ends[a]), float(ends[b])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _top(arms: tuple[Arm, ...]) -> float:
    """Return the upper end of the axis of predicted errors.

    Cameras on one line make the errors grow without bound.
    """
    every_error = np.concatenate([100 * arm.predicted_error_m for arm in arms])
    known = every_error[np.isfinite(every_error)]
    if not len(known):
        return 1.0
    return float(min(1.08 * known.max(), 3.0 * np.percentile(known, 90))) or 1.0


def _told_over_time(arm: Arm) -> str:
    known = arm.predicted_error_m[np.isfinite(arm.predicted_error_m)]
    median_cm = 100 * float(np.median(known)) if len(known) else None
    return (
        f"{arm.name}: tilt {quantity(float(arm.tilt_deg.mean()), 'deg')} on average and "
        f"{quantity(float(arm.tilt_deg.max()), 'deg')} at most, range {fixed(float(arm.range_m.min()))} to "
        f"{quantity(float(arm.range_m.max()), 'm')}, hidden {percent(float((~arm.visible).mean()))} of the "
        f"time, predicted error {quantity(median_cm, 'cm')} (median)."
    )
