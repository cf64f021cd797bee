"""The figures of a session's page: those of its cameras, joints and bones, and the list of all.

Each function draws one figure from the summary and describes the picture in words.
Long recordings are drawn with at most `MOST_POINTS` points a path and `MOST_BINS` stretches of time;
the captions say so.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from pipelines.reporting.over_time import draw_over_time
from pipelines.reporting.paths_from_above import draw_paths
from pipelines.reporting.plates import (
    Plate,
    quiet,
    table,
    tabled,
)
from pipelines.reporting.snapshots import draw_snapshots
from pipelines.reporting.summary import CameraRow, Summary
from pipelines.reporting.svg import (
    CAMERAS,
    LEFT,
    MIDDLE,
    PAPER,
    RIGHT,
    STATUS_COLOURS,
    WIDTH_IN,
    page_style,
)
from pipelines.reporting.wording import (
    fixed,
    joint_label,
    listing,
    percent,
    plural,
    quantity,
    shortened,
)

if TYPE_CHECKING:
    import pandas as pd


def draw_all(summary: Summary, poses: Mapping[str, pd.DataFrame]) -> dict[str, Plate]:
    """Draw every figure that the session has the data for, by its key."""
    motion = summary.motion
    plates = [_timeline(summary.cameras)]
    measured = motion is not None and bool(motion.measured.any())
    plates.append(draw_paths(summary.cameras, poses, motion if measured else None))
    if motion is not None:
        plates.append(draw_over_time(summary, motion))
        plates.append(_joint_bars(summary))
    if motion is not None and measured:
        plates.append(draw_snapshots(summary, motion))
        if summary.bones:
            plates.append(_bone_lengths(summary))
    return {plate.key: plate for plate in plates}


# --- cameras -------------------------------------------------------------------------------------------


def _timeline(cameras: tuple[CameraRow, ...]) -> Plate:
    from matplotlib.figure import Figure

    rows = len(cameras)
    with page_style():
        figure = Figure((WIDTH_IN, 0.55 + 0.26 * rows), layout="constrained")
        axes = figure.subplots()
        for k, camera in enumerate(cameras):
            axes.barh(
                k, camera.last_s - camera.first_s, 0.34, camera.first_s, color=CAMERAS[k % len(CAMERAS)]
            )
            for start, end in camera.gaps_s:
                axes.barh(k, end - start, 0.36, start, color=PAPER)
                axes.barh(k, end - start, 0.05, start, color=CAMERAS[k % len(CAMERAS)])
        axes.set_yticks(range(rows), [shortened(camera.name) for camera in cameras])
        axes.set_ylim(rows - 0.5, -0.5)
        axes.set_xlabel("time (s)")
        quiet(axes)
        title = "When each camera had frames and poses"
    told = " ".join(_spoken(camera) for camera in cameras)
    gaps = any(camera.gaps_s for camera in cameras)
    caption = "A bar spans the frames of a camera" + (
        "; where it is cut to a thin line, its pose log has a gap." if gaps else "; no pose log has a gap."
    )
    spans = [(c.name, "frames", c.first_s, c.last_s) for c in cameras]
    spans += [(c.name, "gap in poses", start, end) for c in cameras for start, end in c.gaps_s]
    numbers = tabled(("camera", "what", "start_s", "end_s"), spans)
    return Plate("timeline", title, caption, told, figure, {"": numbers})


def _spoken(camera: CameraRow) -> str:
    gaps = f"{plural(len(camera.gaps_s), 'gap')} in the poses" if camera.gaps_s else "no gap in the poses"
    return f"{camera.name}: {fixed(camera.first_s)} s to {fixed(camera.last_s)} s, {gaps}."


# --- joint by joint ------------------------------------------------------------------------------------


def _joint_bars(summary: Summary) -> Plate:
    from matplotlib.figure import Figure

    rows = summary.joints
    with page_style():
        figure = Figure((WIDTH_IN / 2, _joint_height_in(summary)), layout="constrained")
        axes = figure.subplots()
        left = np.zeros(len(rows))
        for word in summary.statuses:
            share = np.array([100 * row.counts[word] / max(sum(row.counts.values()), 1) for row in rows])
            axes.barh(range(len(rows)), share, 0.72, left, color=STATUS_COLOURS[word])
            left += share
        axes.set_yticks(range(len(rows)), [shortened(joint_label(row.name)) for row in rows])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlim(0, 100)
        axes.set_xlabel("share of times (%)")
        quiet(axes)
        axes.tick_params(axis="y", length=0)
        title = "What became of every joint"
        told = listing(f"{joint_label(row.name)} {percent(row.share)}" for row in rows)
    numbers = table(
        joint=[row.name for row in rows],
        **{
            f"{word}_percent": [100 * row.counts[word] / max(sum(row.counts.values()), 1) for row in rows]
            for word in summary.statuses
        },
    )
    caption = "Colours as in the figure of errors over time."
    return Plate("joints", title, caption, f"Share measured: {told}.", figure, {"": numbers})


def _joint_height_in(summary: Summary) -> float:
    """Return the height of the two figures that stand side by side, inches."""
    return 0.6 + 0.175 * max(len(summary.joints), 8)


def _bone_lengths(summary: Summary) -> Plate:
    from matplotlib.figure import Figure

    bones = summary.bones
    names = list(dict.fromkeys(bone.name for bone in bones))
    colours = {"left": LEFT, "right": RIGHT, "": MIDDLE}
    with page_style():
        figure = Figure((WIDTH_IN / 2, _joint_height_in(summary)), layout="constrained")
        axes = figure.subplots()
        for bone in bones:
            y = names.index(bone.name) + {"left": -0.17, "right": 0.17, "": 0.0}[bone.side]
            colour = colours[bone.side]
            axes.plot([100 * bone.low_m, 100 * bone.high_m], [y, y], color=colour, linewidth=2.2, alpha=0.45)
            axes.plot(100 * bone.median_m, y, "o", color=colour, markersize=3.6)
        axes.grid(visible=True, axis="x")
        axes.set_yticks(range(len(names)), names)
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_xlim(left=0)
        axes.set_xlabel("length (cm)")
        quiet(axes, grid=False)
        axes.tick_params(axis="y", length=0)
        title = "Bone lengths"
        told = listing(
            f"{f'{b.side} {b.name}'.strip()} {quantity(100 * b.median_m, 'cm')} ± {percent(b.spread)}"
            for b in bones
        )
    caption = (
        "Median and the range from the 10th to the 90th percentile; left in blue, above, right in orange."
    )
    caption += " A bone that changes its length was measured wrongly."
    numbers = table(
        bone=[f"{b.side} {b.name}".strip() for b in bones],
        median_cm=[100 * b.median_m for b in bones],
        p10_cm=[100 * b.low_m for b in bones],
        p90_cm=[100 * b.high_m for b in bones],
        relative_spread=[b.spread for b in bones],
    )
    return Plate("bones", title, caption, f"Median and relative spread: {told}.", figure, {"": numbers})
