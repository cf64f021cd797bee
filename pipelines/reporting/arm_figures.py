"""The figures of a comparison of planners: over time, the formations' yaw, the list of all.

The colour is the arm's in every figure and in the 3D viewer; the stroke is the drone's.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.reporting.arms_as_seen import draw_as_seen
from pipelines.reporting.from_above import draw_from_above
from pipelines.reporting.plates import (
    CAMERAS,
    LINE_STYLES,
    PAPER,
    Plate,
    new_figure,
    page_style,
    quiet,
    shade,
    shade_keys,
    stacked,
    stride_for,
    table,
)
from pipelines.reporting.replanned import Arm, CostMap, Replan, span_s
from pipelines.reporting.wording import fixed, percent, quantity, shortened, significant

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MARKERS = "osD^vPX*"  # by number of drones


def draw_arms(replan: Replan) -> dict[str, Plate]:
    """Draw every figure of a comparison, by its key; none where nothing flew."""
    if not replan.arms:
        return {}
    plates = [
        draw_from_above(replan),
        draw_arms_over_time(replan.arms),
        draw_yaw(replan.arms, replan.costs),
        draw_as_seen(replan),
    ]
    return {plate.key: plate for plate in plates if plate is not None}


# --- over time -----------------------------------------------------------------------------------------


def draw_arms_over_time(arms: tuple[Arm, ...]) -> Plate:
    """Draw four strips, one below the other, over the same time."""
    strips = sum(len(arm.cameras) for arm in arms)
    heights_in = [1.35, 1.15, 0.3 + 0.085 * strips, 1.15]
    with page_style():
        figure = new_figure(0.7 + sum(heights_in))
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
            quiet(axes, "y")
        quiet(sight, "x")
        sight.spines["bottom"].set_visible(False)
        error.set_xlim(*span_s(arms))
        figure.align_ylabels([tilt, reach, sight, error])
        handles, labels = error.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=len(arms))
        title = "Tilt, range, sight and predicted error over time"
        description = " ".join(_describe_over_time(arm) for arm in arms)
    caption = (
        "Above: tilt of the cameras over the actor and their range, the mean of an arm's drones as a line "
        "and all of them within the band. Middle: a row per drone, drawn while something stands between it "
        "and the actor. Below: the error to be expected of the position from all cameras together; "
        "no line where they determine none."
    )
    step = stride_for(len(arms[0].t_s))
    if step > 1:
        caption += f" A point of a line stands for {step} poses, the band holds them all."
    cut = [arm for arm in arms if np.nanmax(arm.predicted_error_m, initial=0.0) * 100 > _top(arms)]
    if cut:
        caption += f" Errors above {quantity(_top(arms), 'cm', 0)} are cut off."
    numbers = {"": stacked([_numbers_over_time(arm) for arm in arms])}
    return Plate("arms-time", title, caption, description, figure, numbers)


def _numbers_over_time(arm: Arm) -> pd.DataFrame:
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
    starts = np.arange(0, len(arm.t_s), stride_for(len(arm.t_s)))
    seconds, mean = _thinned(arm.t_s, values.mean(axis=0))
    low = np.minimum.reduceat(values.min(axis=0), starts)
    high = np.maximum.reduceat(values.max(axis=0), starts)
    axes.fill_between(seconds, low, high, color=colour, alpha=0.16, linewidth=0)
    axes.plot(seconds, mean, color=colour)


def _thinned(seconds: Float, values: Float) -> tuple[Float, Float]:
    """Return times and means of at most `MOST_POINTS` stretches of equally many values.

    A mean is NaN if one of its values is NaN.
    """
    starts = np.arange(0, len(seconds), stride_for(len(seconds)))
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


def _describe_over_time(arm: Arm) -> str:
    known = arm.predicted_error_m[np.isfinite(arm.predicted_error_m)]
    median_cm = 100 * float(np.median(known)) if len(known) else None
    return (
        f"{arm.name}: tilt {quantity(float(arm.tilt_deg.mean()), 'deg')} on average and "
        f"{quantity(float(arm.tilt_deg.max()), 'deg')} at most, range {fixed(float(arm.range_m.min()))} to "
        f"{quantity(float(arm.range_m.max()), 'm')}, hidden {percent(float((~arm.visible).mean()))} of the "
        f"time, predicted error {quantity(median_cm, 'cm')} (median)."
    )


# --- yaw -----------------------------------------------------------------------------------------------


_MOST_TIMES = 200
_TURN_DEG = 360.0


def draw_yaw(arms: tuple[Arm, ...], costs: CostMap | None) -> Plate:
    """Draw all arms in one figure; without a cost map their yaws alone."""
    low, high = _span_deg(arms)
    with page_style():
        figure = new_figure(3.3)
        axes = figure.subplots()
        levels, step = ([], 1) if costs is None else _draw_costs(axes, costs, low, high)
        for arm in arms:
            _draw_yaws(axes, arm)
        axes.set_ylim(low, high)
        axes.set_yticks(np.arange(np.ceil(low / 90) * 90, high, 90))
        axes.set_xlim(*span_s(arms))
        axes.set_xlabel("time (s)")
        axes.set_ylabel("formation yaw (deg)")
        quiet(axes, "y")
        _yaw_legend(figure, axes, levels)
        title = "The formation's yaw" + ("" if costs is None else " over what it would cost")
        description = " ".join(_describe_yaw(arm) for arm in arms)
    caption = (
        "Solid: the yaw that an arm chose for its first drone, counterclockwise from east and without "
        "jumps of a turn; dashed: where that drone was."
    )
    if costs is not None:
        caption += (
            " Shades: what a formation at the stated tilt and radius would cost there, the stronger the "
            "more; it repeats after a full turn."
            if levels
            else " Every yaw would have cost the same at any time."
        )
        caption += f" One column in {step} is drawn." if step > 1 else ""
    return Plate("arms-yaw", title, caption, description, figure, _yaw_numbers(arms, costs))


def _span_deg(arms: tuple[Arm, ...]) -> tuple[float, float]:
    """Return a range of yaws from below the least to above the largest, one turn at least."""
    everything = np.concatenate([line for arm in arms for line in (arm.yaw_deg, arm.commanded_yaw_deg)])
    known = everything[np.isfinite(everything)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    spare = max(_TURN_DEG - (high - low), 40.0) / 2
    return low - spare, high + spare


def _draw_yaws(axes: Axes, arm: Arm) -> None:
    """Draw the yaw of the first drone, and solid the commanded yaw, if there is one."""
    stride = stride_for(len(arm.t_s))
    t_s, colour, name = arm.t_s[::stride], CAMERAS[arm.colour], shortened(arm.name)
    chosen = arm.commanded_yaw_deg[::stride]
    commanded = np.isfinite(arm.commanded_yaw_deg).any()
    if commanded:
        axes.plot(t_s, chosen, color=PAPER, linewidth=3.0, zorder=3)
        axes.plot(t_s, chosen, color=colour, linewidth=1.6, zorder=4, label=name)
    axes.plot(
        t_s,
        arm.yaw_deg[::stride],
        color=colour,
        linewidth=0.9,
        linestyle=LINE_STYLES[1],
        zorder=4,
        label=None if commanded else name,
    )


def _yaw_numbers(arms: tuple[Arm, ...], costs: CostMap | None) -> dict[str, pd.DataFrame]:
    """Tabulate every pose of the arms, and every column of the cost map."""
    yaws = [
        table(arm=arm.name, t_s=arm.t_s, yaw_deg=arm.yaw_deg, commanded_yaw_deg=arm.commanded_yaw_deg)
        for arm in arms
    ]
    if costs is None:
        return {"": stacked(yaws)}
    cost = table(
        t_s=np.repeat(costs.t_s, len(costs.yaw_deg)),
        yaw_deg=np.tile(costs.yaw_deg, len(costs.t_s)),
        cost=costs.cost.ravel(),
    )
    return {"": stacked(yaws), "costs": cost}


def _draw_costs(axes: Axes, costs: CostMap, low: float, high: float) -> tuple[list[float], int]:
    """Shade the cost map over all drawn turns; return its levels, and the stride of the drawn times."""
    from matplotlib.ticker import MaxNLocator

    step = stride_for(len(costs.t_s), _MOST_TIMES)
    t_s, cost = costs.t_s[::step], costs.cost[::step]
    least, most = float(np.nanmin(cost)), float(np.nanpercentile(cost, 98))
    levels = [float(v) for v in MaxNLocator(5).tick_values(least, most) if least < v < float(np.nanmax(cost))]
    if most <= least or not levels:
        return [], step
    turns = range(int(np.floor((low - costs.yaw_deg[0]) / _TURN_DEG)) - 1, int(np.ceil(high / _TURN_DEG)) + 2)
    yaw_deg = np.concatenate([costs.yaw_deg + _TURN_DEG * turn for turn in turns])
    drawn = (yaw_deg > low - 20) & (yaw_deg < high + 20)
    over_turns = np.tile(cost, (1, len(turns)))[:, drawn]
    shade(axes, t_s, yaw_deg[drawn], over_turns, levels)
    return levels, step


def _yaw_legend(figure: Figure, axes: Axes, levels: list[float]) -> None:
    entries, _ = axes.get_legend_handles_labels()
    words = [significant(level, 2) for level in levels]
    shades = shade_keys([f"cost above {word}" if k == 0 else word for k, word in enumerate(words)])
    figure.legend(handles=[*entries, *shades], loc="outside upper left", ncols=len(entries) + len(shades))


def _describe_yaw(arm: Arm) -> str:
    chosen = arm.commanded_yaw_deg[np.isfinite(arm.commanded_yaw_deg)]
    found = chosen if len(chosen) else arm.yaw_deg[np.isfinite(arm.yaw_deg)]
    if not len(found):
        return f"{arm.name}: nothing is known of its yaw."
    way = sum(abs(b - a) for a, b in pairwise(found.tolist()))
    return (
        f"{arm.name}: from {quantity(float(found[0]), 'deg')} to {quantity(float(found[-1]), 'deg')}, "
        f"turning by {quantity(way, 'deg')} in all."
    )
