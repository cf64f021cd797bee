"""The figures of a comparison of sessions: errors over time, joint by joint, and all differences.

The colour is the session's in every figure.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.reporting.comparison import MEASURE_OF, MEASURES, Comparison, Judged, Measure, Pair
from pipelines.reporting.plates import (
    CAMERAS,
    LINE_STYLES,
    MUTED,
    Plate,
    means,
    new_figure,
    page_style,
    percentiles,
    quiet,
    stacked,
    table,
    tabled,
    time_bins,
)
from pipelines.reporting.wording import fixed, joint_label, listing, quantity, shortened

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

_MOST_BINS = 150
_OVER_TIME = ("predicted", "tilt", "share")
_MOST_BANDS = 3
"""Number of sessions above which no ranges are drawn: they would hide each other."""


def draw_comparison(comparison: Comparison) -> dict[str, Plate]:
    """Draw every figure that has data, by its key."""
    measure = shown_measure(comparison)
    plates = []
    if measure is not None:
        plates += [_over_time(comparison, measure), _joint_bars(comparison, measure)]
    if any(pair.differences for pair in comparison.pairs):
        plates.insert(0, _differences(comparison))
    return {plate.key: plate for plate in plates}


def shown_measure(comparison: Comparison) -> Measure | None:
    """Return the error from truth if every session with a skeleton has it, else the reprojection."""
    having = [one for one in comparison.sessions if one.values]
    for key in ("mpjpe", "reprojection"):
        if having and all(key in one.estimates for one in having):
            return MEASURE_OF[key]
    return None


def colour_of(comparison: Comparison, session: Judged) -> str:
    """Return the colour of a session in all figures."""
    return CAMERAS[comparison.sessions.index(session) % len(CAMERAS)]


def seconds_of(comparison: Comparison, session: Judged) -> Float:
    """Return the times [T] of a session, in s.

    They count from the first frame of all where the motion is the same, else from its own first frame.
    """
    together = {id(comparison.sessions[0])} | {id(pair.other) for pair in comparison.pairs if pair.by_time}
    same = [one for one in comparison.sessions if id(one) in together]
    among = same if id(session) in together else [session]
    return (session.t_ns - min(one.summary.origin_ns for one in among)) / 1e9


# --- over time -----------------------------------------------------------------------------------------


def _over_time(comparison: Comparison, measure: Measure) -> Plate:
    there = [one for one in comparison.sessions if one.values]
    shown = [measure] + [
        MEASURE_OF[key] for key in _OVER_TIME if any(key in one.values for one in comparison.sessions)
    ]
    seconds = {one.label: seconds_of(comparison, one) for one in there}
    drawn = []
    with page_style():
        figure = new_figure(0.7 + 1.5 + 1.1 * (len(shown) - 1))
        panels = figure.subplots(
            len(shown), 1, sharex=True, squeeze=False, height_ratios=[1.5, *[1.1] * (len(shown) - 1)]
        )[:, 0]
        for axes, of in zip(panels, shown, strict=True):
            drawn += [
                _draw_over_time(axes, comparison, one, of, seconds[one.label], band=of is measure)
                for one in there
                if of.key in one.values
            ]
            axes.set_ylabel(f"{of.name.replace(' ', chr(10))}\n({of.unit})")
            if of.unit == "%":
                axes.set_ylim(0, 104)
            elif of.key != "tilt":
                axes.set_ylim(bottom=0)
            quiet(axes, "y")
        panels[-1].set_xlabel("time (s)")
        panels[-1].set_xlim(min(s[0] for s in seconds.values()), max(s[-1] for s in seconds.values()))
        figure.align_ylabels(list(panels))
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=min(len(labels), 4))
        title = f"{measure.label} over time, and what goes with it"
        listed = listing(
            f"{one.label} {quantity(one.estimates[measure.key].value, measure.unit, measure.digits)}"
            for one in there
        )
        description = f"Means over the flights: {listed}."
    caption = _caption_over_time(comparison, shown, bands=len(there) <= _MOST_BANDS)
    return Plate("compare-time", title, caption, description, figure, {"": stacked(drawn)})


def _caption_over_time(comparison: Comparison, shown: list[Measure], *, bands: bool) -> str:
    caption = f"From above: {listing(of.name for of in shown)}. "
    caption += "Errors are medians over joints"
    if bands:
        caption += ", the range in the uppermost drawing from the 10th to the 90th percentile"
    caption += "; tilt and share are means. "
    return caption + (
        "Times count from the first frame of all."
        if all(pair.by_time for pair in comparison.pairs)
        else "Times of flights that do not hold the same motion count from the first frame of each."
    )


def _draw_over_time(
    axes: Axes, comparison: Comparison, session: Judged, measure: Measure, seconds: Float, *, band: bool
) -> pd.DataFrame:
    """Draw a session's line, and return its numbers."""
    values = session.values[measure.key].values
    bins = time_bins(seconds, _MOST_BINS)
    centres = (bins[:-1] + bins[1:]) / 2
    k = comparison.sessions.index(session)
    colour = colour_of(comparison, session)
    if measure.key in {"share", "tilt"}:
        middle = means(values, seconds, bins)
        low = high = np.full(len(middle), np.nan)
    else:
        middle, low, high = percentiles(values, seconds, bins)
        if band and len(comparison.sessions) <= _MOST_BANDS:
            axes.fill_between(centres, low, high, color=colour, alpha=0.14, linewidth=0)
    line = LINE_STYLES[k // len(CAMERAS) % len(LINE_STYLES)]
    axes.plot(centres, middle, color=colour, linestyle=line, label=shortened(session.label))
    what = f"{measure.name} ({measure.unit})"
    return table(session=session.label, measure=what, t_s=centres, value=middle, p10=low, p90=high)


# --- joint by joint ------------------------------------------------------------------------------------


def joints_of(comparison: Comparison) -> list[str]:
    """List every joint of every session, in the order in which the first names them."""
    motions = [one.summary.motion for one in comparison.sessions]
    return list(dict.fromkeys(name for motion in motions if motion is not None for name in motion.joints))


def _joint_bars(comparison: Comparison, measure: Measure) -> Plate:
    joints = [
        name
        for name in joints_of(comparison)
        if any(name in one.per_joint.get(measure.key, {}) for one in comparison.sessions)
    ]
    there = [one for one in comparison.sessions if one.values]
    thick = 0.8 / len(there)
    with page_style():
        height = 0.8 + max(0.075 * len(there), 0.15) * 1.25 * max(len(joints), 6)
        figure = new_figure(height)
        sides = figure.subplots(1, 2, sharey=True, width_ratios=[1.5, 1])
        for axes, of in zip(sides, (measure, MEASURE_OF["share"]), strict=True):
            for k, one in enumerate(there):
                _draw_bars(axes, one, of, joints, (k - (len(there) - 1) / 2) * thick, thick, comparison)
            axes.set_ylim(len(joints) - 0.5, -0.5)
            axes.set_xlabel(f"{of.name} ({of.unit})")
            quiet(axes, "x")
        sides[0].set_yticks(range(len(joints)), [shortened(joint_label(name)) for name in joints])
        sides[0].set_xlim(left=0)
        sides[1].set_xlim(0, 100)
        handles, labels = sides[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=min(len(labels), 4))
        title = f"{measure.label} of every joint, and how often it was measured"
        description = " ".join(
            f"{one.label}: "
            + listing(
                f"{joint_label(name)} {fixed(found.value, measure.digits)}"
                for name, found in one.per_joint[measure.key].items()
            )
            + f" {measure.unit}."
            for one in there
        )
    caption = "Thin lines: the 95 % intervals of the means."
    rows = [
        (one.label, f"{of.name} ({of.unit})", name, estimate.value, *(estimate.interval or (np.nan, np.nan)))
        for of in (measure, MEASURE_OF["share"])
        for one in there
        for name, estimate in one.per_joint.get(of.key, {}).items()
    ]
    numbers = tabled(("session", "measure", "joint", "value", "low", "high"), rows)
    return Plate("compare-joints", title, caption, description, figure, {"": numbers})


def _draw_bars(
    axes: Axes,
    session: Judged,
    measure: Measure,
    joints: list[str],
    shift: float,
    thick: float,
    comparison: Comparison,
) -> None:
    found = session.per_joint.get(measure.key, {})
    rows = [(k, found[name]) for k, name in enumerate(joints) if name in found]
    axes.barh(
        [k + shift for k, _ in rows],
        [estimate.value for _, estimate in rows],
        0.92 * thick,
        color=colour_of(comparison, session),
        label=shortened(session.label),
    )
    for k, estimate in rows:
        if estimate.interval is not None:
            axes.plot(estimate.interval, [k + shift] * 2, color=MUTED, linewidth=0.8)


# --- all at a glance -----------------------------------------------------------------------------------


def _differences(comparison: Comparison) -> Plate:
    measures = [
        one
        for one in MEASURES
        if any(
            one.key in pair.differences and pair.differences[one.key].first > 0 for pair in comparison.pairs
        )
    ]
    pairs = comparison.pairs
    step = 0.7 / len(pairs)
    drawn = []
    with page_style():
        rows = len(measures)
        figure = new_figure(0.9 + rows * max(0.2, 0.1 * len(pairs)))
        axes = figure.subplots()
        axes.axvline(0, color=MUTED, linewidth=0.8)
        for p, pair in enumerate(pairs):
            shift = (p - (len(pairs) - 1) / 2) * step
            drawn += _draw_pair(axes, pair, measures, shift, colour_of(comparison, pair.other))
        axes.set_yticks(range(rows), [f"{one.label}{_ARROW[one.better]}" for one in measures])
        axes.set_ylim(rows - 0.5, -0.5)
        first = shortened(comparison.sessions[0].label)
        axes.set_xlabel(f"difference from {first} (% of its value)")
        quiet(axes, "x")
        if len(pairs) > 1:
            figure.legend(loc="outside upper left", ncols=min(len(pairs), 4))
        title = "All differences at a glance"
    caption = (
        "A point is the paired difference from the first session, relative to that one, its line the 95 % "
        "interval; a line across zero is within noise. Beside each measure stands which way is better."
    )
    columns = ("session", "measure", "difference_percent", "low_percent", "high_percent")
    listed = listing(f"{session} {measure} {fixed(value)} %" for session, measure, value, _, _ in drawn)
    numbers = tabled(columns, drawn)
    return Plate("compare-differences", title, caption, f"{listed}.", figure, {"": numbers})


def _draw_pair(
    axes: Axes, pair: Pair, measures: list[Measure], shift: float, colour: str
) -> list[tuple[str, str, float, float, float]]:
    """Draw a session's differences, a row for each measure, and return them in percent."""
    drawn = []
    for k, measure in enumerate(measures):
        found = pair.differences.get(measure.key)
        if found is None or found.first <= 0:
            continue
        y, scale = k + shift, 100 / found.first
        value = scale * found.estimate.value
        low, high = (scale * end for end in found.estimate.interval or (np.nan, np.nan))
        if found.estimate.interval is not None:
            axes.plot([low, high], [y, y], color=colour, linewidth=1.4)
        axes.plot(value, y, "o", color=colour, markersize=4)
        drawn.append((pair.other.label, measure.label, value, low, high))
    axes.plot([], [], "o-", color=colour, markersize=4, label=shortened(pair.other.label))
    return drawn


_ARROW = {"less": " (less is better)", "more": " (more is better)", "": ""}
