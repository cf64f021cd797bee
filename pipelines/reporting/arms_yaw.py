"""The yaw of the formations of a comparison, over the cost of every yaw."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from pipelines.reporting.arms_from_above import SHADE
from pipelines.reporting.plates import LINE_STYLES, MOST_POINTS, Plate, every, quiet, stacked, table
from pipelines.reporting.replanned import Arm, CostMap, span_s
from pipelines.reporting.svg import CAMERAS, MUTED, PAPER, WIDTH_IN, page_style
from pipelines.reporting.wording import quantity, shortened, significant

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_TIMES = 200
_TURN_DEG = 360.0


def draw_yaw(arms: tuple[Arm, ...], costs: CostMap | None) -> Plate:
    """Draw all arms in one figure; without a cost map their yaws alone."""
    from matplotlib.figure import Figure

    low, high = _span_deg(arms)
    with page_style():
        figure = Figure((WIDTH_IN, 3.3), layout="constrained")
        axes = figure.subplots()
        axes.grid(visible=True, axis="y")
        levels, step = ([], 1) if costs is None else _draw_costs(axes, costs, low, high)
        for arm in arms:
            _draw_arm(axes, arm)
        axes.set_ylim(low, high)
        axes.set_yticks(np.arange(np.ceil(low / 90) * 90, high, 90))
        axes.set_xlim(*span_s(arms))
        axes.set_xlabel("time (s)")
        axes.set_ylabel("formation yaw (deg)")
        quiet(axes, grid=False)
        _legend(figure, axes, levels)
        title = "The formation's yaw" + ("" if costs is None else " over what it would cost")
        told = " ".join(_told(arm) for arm in arms)
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
    return Plate("arms-yaw", title, caption, told, figure, _numbers(arms, costs))


def _span_deg(arms: tuple[Arm, ...]) -> tuple[float, float]:
    """Return a range of yaws from below the least to above the largest, one turn at least."""
    everything = np.concatenate([line for arm in arms for line in (arm.yaw_deg, arm.commanded_yaw_deg)])
    known = everything[np.isfinite(everything)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    spare = max(_TURN_DEG - (high - low), 40.0) / 2
    return low - spare, high + spare


def _draw_arm(axes: Axes, arm: Arm) -> None:
    """Draw the yaw of the first drone, and solid the commanded yaw, if there is one."""
    stride = every(len(arm.t_s), MOST_POINTS)
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


def _numbers(arms: tuple[Arm, ...], costs: CostMap | None) -> dict[str, pd.DataFrame]:
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

    step = every(len(costs.t_s), _MOST_TIMES)
    t_s, cost = costs.t_s[::step], costs.cost[::step]
    least, most = float(np.nanmin(cost)), float(np.nanpercentile(cost, 98))
    levels = [float(v) for v in MaxNLocator(5).tick_values(least, most) if least < v < float(np.nanmax(cost))]
    if most <= least or not levels:
        return [], step
    turns = range(int(np.floor((low - costs.yaw_deg[0]) / _TURN_DEG)) - 1, int(np.ceil(high / _TURN_DEG)) + 2)
    yaw_deg = np.concatenate([costs.yaw_deg + _TURN_DEG * turn for turn in turns])
    drawn = (yaw_deg > low - 20) & (yaw_deg < high + 20)
    over_turns = np.tile(cost, (1, len(turns)))[:, drawn]
    for level in levels:
        axes.contourf(
            t_s, yaw_deg[drawn], over_turns.T, levels=[level, np.inf], colors=[MUTED], alpha=SHADE, zorder=1
        )
    return levels, step


def _legend(figure: Figure, axes: Axes, levels: list[float]) -> None:
    from matplotlib.patches import Patch

    entries, _ = axes.get_legend_handles_labels()
    shades = [
        Patch(
            color=MUTED,
            alpha=1 - (1 - SHADE) ** (k + 1),
            linewidth=0,
            label=f"cost above {significant(level, 2)}" if k == 0 else significant(level, 2),
        )
        for k, level in enumerate(levels)
    ]
    figure.legend(handles=[*entries, *shades], loc="outside upper left", ncols=len(entries) + len(shades))


def _told(arm: Arm) -> str:
    chosen = arm.commanded_yaw_deg[np.isfinite(arm.commanded_yaw_deg)]
    found = chosen if len(chosen) else arm.yaw_deg[np.isfinite(arm.yaw_deg)]
    if not len(found):
        return f"{arm.name}: nothing is known of its yaw."
    way = sum(abs(b - a) for a, b in pairwise(found.tolist()))
    return (
        f"{arm.name}: from {quantity(float(found[0]), 'deg')} to {quantity(float(found[-1]), 'deg')}, "
        f"turning by {quantity(way, 'deg')} in all."
    )
