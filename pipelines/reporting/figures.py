"""The figures of a session's page: cameras, paths, errors over time, joints, bones and angles.

Long recordings are drawn with at most `MOST_POINTS` points a path and `MOST_BINS` stretches of time; the
captions say so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import rotate
from pipelines.geometry.triangulation import STATUS
from pipelines.reporting.chart import (
    INK,
    PAPER,
    PEOPLE,
    SIDES,
    STATUS_COLOURS,
    TIME_LABEL,
    WIDTH_IN,
    Area,
    Bars,
    Figure,
    Line,
    Mark,
    Panel,
    Points,
    axis_label,
    bounds,
    colour_and_style,
    line_through,
    near_zero,
    percentiles,
    points_at,
    stride_for,
    time_bins,
)
from pipelines.reporting.content import MeasuredMotion, middles
from pipelines.reporting.summary import CameraRow, Summary
from pipelines.reporting.wording import STATUS_LABELS, joint_label, shortened
from pipelines.session.people import side_of
from pipelines.session.records import Trajectory
from pipelines.session.tables import trajectory_from

# Panels half as wide as the page show no more stretches of time.
MOST_BINS_OF_HALF = 150
# A camera that moves by less than this part of the flight's extent is drawn as one place.
STILL_SHARE = 0.005
# More strokes in the direction of view would hide the path.
STROKES = 12

SIDE_COLOURS = "Left in blue, right in orange."
_SHOWN_ANGLES = (
    *("hip_flexion", "knee_flexion", "ankle_dorsiflexion"),
    *("trunk_flexion", "shoulder_elevation", "elbow_flexion"),
)


def draw_all(
    summary: Summary,
    poses: Mapping[str, pd.DataFrame],
    residuals: Mapping[str, tuple[Float, Float]] | None = None,
    angles: pd.DataFrame | None = None,
) -> list[Figure]:
    """Draw every figure that the session has the data for."""
    motion = summary.motion
    measured = motion if motion is not None and motion.measured.any() else None
    figures: list[Figure | None] = [_timeline(summary.cameras)]
    figures.append(draw_paths(summary.cameras, poses, measured, summary.people))
    if motion is not None:
        figures.append(draw_over_time(summary, motion))
        figures.append(_residuals(summary, residuals) if residuals else None)
        figures.append(_sigmas(summary, motion) if np.isfinite(motion.sigma_m).any() else None)
        figures.append(_joints_and_bones(summary))
    if angles is not None:
        figures.append(_angles(summary, angles))
    return [figure for figure in figures if figure is not None]


def _stretch_words(bins: Float, times: int) -> str:
    return f" Each point stands for {bins[1] - bins[0]:.2g} s." if len(bins) - 1 < times else ""


def _timeline(cameras: tuple[CameraRow, ...]) -> Figure:
    bars = []
    for k, camera in enumerate(cameras):
        colour, _ = colour_and_style(k)
        length = camera.last_s - camera.first_s
        bars.append(Bars([k], [camera.first_s], [length], colour, "frames", 0.34, legend=False))
        starts, lengths = [start for start, _ in camera.gaps_s], [end - start for start, end in camera.gaps_s]
        rows = [k] * len(starts)
        bars.append(Bars(rows, starts, lengths, PAPER, thickness=0.36))
        if starts:
            bars.append(Bars(rows, starts, lengths, colour, "gap in poses", 0.05, legend=False))
    labels = {float(k): shortened(camera.name) for k, camera in enumerate(cameras)}
    panel = Panel(bars, TIME_LABEL, rows=labels, grid="x")
    caption = "A bar spans the frames of a camera; where it is a thin line, its pose log has a gap."
    title = "When each camera had frames and poses"
    return Figure("timeline", title, caption, [[panel]], 0.55 + 0.26 * len(cameras))


def draw_paths(
    cameras: tuple[CameraRow, ...],
    poses: Mapping[str, pd.DataFrame],
    motion: MeasuredMotion | None,
    names: Sequence[str],
) -> Figure:
    """Draw the paths of cameras and people on the ground plane; without a motion those of the cameras."""
    tracks = {camera.name: trajectory_from(poses[camera.name]) for camera in cameras if camera.name in poses}
    people = list(np.moveaxis(middles(motion.measured_position)[..., :2], 1, 0)) if motion is not None else []
    low, high = bounds([*people, *(track.position[:, :2] for track in tracks.values())])
    origin, extent = near_zero(low), np.maximum(high - low, 2.0)
    marks: list[Mark] = []
    for k, camera in enumerate(cameras):
        if camera.name in tracks:
            marks += _camera_marks(camera, tracks[camera.name], k, origin, float(extent.max()))
    for k, (label, person) in enumerate(zip(["actor"] if len(people) == 1 else names, people, strict=False)):
        colour = INK if len(people) == 1 else PEOPLE[k % len(PEOPLE)]
        path = person[:: stride_for(len(person))] - origin
        marks.append(line_through(path, colour, label, width=2.0))
        marks.append(points_at(path[np.isfinite(path[:, 0])][:1], colour, filled=False, size=5))
    panel = Panel(
        marks, axis_label("east", origin[0]), axis_label("north", origin[1]), grid="both", equal=True
    )
    height = float(np.clip(0.75 * WIDTH_IN * extent[1] / extent[0], 3.2, 6.2))
    caption = (
        "Open circles mark the start, squares cameras that stand still, short strokes the direction of view."
    )
    step = max((stride_for(len(track.t_ns)) for track in tracks.values()), default=1)
    caption += f" One pose in {step} is drawn." if step > 1 else ""
    return Figure("top", "Seen from above", caption, [[panel]], height)


def _camera_marks(camera: CameraRow, track: Trajectory, k: int, origin: Float, extent_m: float) -> list[Mark]:
    """Draw a path with strokes in the direction of view; a camera that stands still is a square."""
    ground = track.position[:, :2] - origin
    look = rotate(track.quaternion_xyzw, np.array([0.0, 0.0, 1.0]))[:, :2]
    colour, style = colour_and_style(k)
    still = bool(np.nanmax(np.ptp(ground, axis=0), initial=0.0) < STILL_SHARE * extent_m)
    at = np.unique(np.linspace(0, len(ground) - 1, 1 if still else STROKES).astype(int))
    strokes = np.full((3 * len(at), 2), np.nan)
    strokes[0::3], strokes[1::3] = ground[at], ground[at] + look[at] * 0.035 * extent_m
    looking = line_through(strokes, colour, width=0.8)
    if still:
        return [points_at(ground[:1], colour, camera.name, marker="s", size=5), looking]
    stride = stride_for(len(ground))
    breaks = np.unique(
        np.searchsorted(track.t_ns, [start for start, _ in camera.entry.poses.gaps_ns], side="right")
    )
    pieces = []
    for rows in np.split(np.arange(len(ground)), breaks):
        if rows.size:
            pieces += [ground[np.unique([*rows[::stride], rows[-1]])], np.full((1, 2), np.nan)]
    path = np.concatenate(pieces) if pieces else ground
    start = points_at(ground[:1], colour, filled=False)
    return [line_through(path, colour, camera.name, style=style), start, looking]


def _joints_and_bones(summary: Summary) -> Figure:
    joints, bars, left = summary.joints, [], np.zeros(len(summary.joints))
    for word in summary.statuses:
        share = np.array([100 * row.counts[word] / max(sum(row.counts.values()), 1) for row in joints])
        label = STATUS_LABELS[word]
        bars.append(Bars(range(len(joints)), left.tolist(), share.tolist(), STATUS_COLOURS[word], label))
        left = left + share
    labels = {float(k): shortened(joint_label(row.name)) for k, row in enumerate(joints)}
    panels = [Panel(bars, "share of times (%)", rows=labels, x_span=(0, 100), grid="x")]
    if summary.bones:
        names = list(dict.fromkeys(bone.name for bone in summary.bones))
        aside = {"left": -0.17, "right": 0.17, "": 0.0}
        points = [
            Points(
                [100 * bone.median_m],
                [names.index(bone.name) + aside[bone.side]],
                SIDES[bone.side],
                bone.side or "across",
                [(100 * bone.low_m, 100 * bone.high_m)],
                legend=False,
            )
            for bone in summary.bones
        ]
        rows = {float(k): name for k, name in enumerate(names)}
        panels.append(Panel(points, "length (cm)", rows=rows, x_span=(0, None), grid="x"))
    caption = (
        "Left: how often each joint was measured, and why not. Right: median length of the bones, and the"
        " range from the 10th to the 90th percentile; a bone that changes its length was measured wrongly."
        f" {SIDE_COLOURS}"
    )
    height = 0.9 + 0.175 * max(len(joints), 8)
    title = "Every joint, and the bones"
    return Figure("joints", title, caption, [panels], height, share_x=False, columns=len(STATUS))


def draw_over_time(summary: Summary, motion: MeasuredMotion) -> Figure:
    """Draw errors, and the share of measured joints; distances from truth where that is known."""
    seconds = (motion.t_ns - summary.origin_ns) / 1e9
    values, unit, what = summary.errors_mm, "mm", "distance from truth"
    if values is None:
        values, unit, what = motion.reprojection_px, "px", "reprojection error"
    bins = time_bins(seconds)
    centres = (bins[:-1] + bins[1:]) / 2
    values = np.where(motion.measured, values, np.nan)
    middle, low, high = percentiles(values, seconds, bins)
    lines = [Line(centres, middle, STATUS_COLOURS["ok"], "median", low, high, legend=False)]
    for k, name in enumerate(summary.people if len(summary.people) > 1 else ()):
        own = percentiles(values[:, [k]], seconds, bins)[0]
        lines.append(Line(centres, own, PEOPLE[k % len(PEOPLE)], name, width=0.9))
    top = 1.08 * float(np.nanmax(high, initial=0.0)) or 1.0
    edges = np.searchsorted(seconds, bins)
    per_time = np.stack([(motion.status == s).sum(axis=(1, 2)) for s in range(len(STATUS))])
    running = np.concatenate([np.zeros((len(STATUS), 1)), np.cumsum(per_time, axis=1)], axis=1)
    counts = np.diff(running[:, edges], axis=1)
    shares, areas, base = counts / np.maximum(counts.sum(axis=0), 1), [], np.zeros(len(centres))
    for word in summary.statuses:
        above = base + 100 * shares[STATUS.index(word)]
        areas.append(Area(bins, base, above, STATUS_COLOURS[word], STATUS_LABELS[word]))
        base = above
    panels = [
        [Panel(lines, y_label=f"{what} ({unit})", y_span=(0, top))],
        [Panel(areas, TIME_LABEL, "joints (%)", x_span=(bins[0], bins[-1]), y_span=(0, 100), grid="x")],
    ]
    caption = (
        f"Above: {what} of the measured joints, median and the range from the 10th to the 90th percentile. "
        "Below: the share of joints measured, and why the others were not."
    ) + _stretch_words(bins, len(motion.t_ns))
    title = f"{what.capitalize()} over time, and the status of the joints"
    return Figure("time", title, caption, panels, 3.5, heights=[2.4, 1], columns=len(STATUS))


def _residuals(summary: Summary, residuals: Mapping[str, tuple[Float, Float]]) -> Figure:
    names = [camera.name for camera in summary.cameras]
    highest = [np.nanpercentile(px, 99) for _, px in residuals.values() if np.isfinite(px).any()]
    lines = []
    for name, (t_s, px) in residuals.items():
        colour, style = colour_and_style(names.index(name))
        lines.append(Line(t_s, px, colour, name, style=style, width=0.9))
    top = 1.1 * float(max(highest, default=1.0)) or 1.0
    caption = (
        "Median over the joints of a picture: the distance between the keypoint and the reconstructed joint. "
        "A camera that rises alone has a wrong pose or clock there."
    )
    panel = Panel(lines, TIME_LABEL, "residual (px)", y_span=(0, top))
    return Figure("residuals", "Residuals of each camera over time", caption, [[panel]], 2.1)


def _sigmas(summary: Summary, motion: MeasuredMotion) -> Figure:
    """Draw the standard deviation of each joint over time, left and right of a kind in one panel."""
    seconds = (motion.t_ns - summary.origin_ns) / 1e9
    bins = time_bins(seconds, MOST_BINS_OF_HALF)
    centres, mm = (bins[:-1] + bins[1:]) / 2, 1000 * motion.sigma_m
    kinds: dict[str, list[Line]] = {}
    for j, name in enumerate(motion.joints):
        middle = percentiles(mm[..., j], seconds, bins)[0]
        if np.isfinite(middle).any():
            line = Line(centres, middle, SIDES[side_of(name)], name, width=0.9, legend=False)
            kinds.setdefault(name.removeprefix(f"{side_of(name)}_"), []).append(line)
    top = 1.15 * max(float(np.nanpercentile(line.y, 98)) for lines in kinds.values() for line in lines)
    titled = {shortened(joint_label(kind)): lines for kind, lines in kinds.items()}
    rows = _in_columns([Panel(lines, y_span=(0, top), title=kind) for kind, lines in titled.items()])
    caption = (
        "The stated standard deviation per axis of the measured joints: the square root of a third of the "
        f"covariance’s trace. {SIDE_COLOURS} Gaps: not measured."
    ) + _stretch_words(bins, len(motion.t_ns))
    title = "Standard deviation of each joint over time"
    height = 0.3 + 0.75 * len(rows)
    return Figure("sigmas", title, caption, rows, height, share_y=True, label="σ (mm)")


def _angles(summary: Summary, angles: pd.DataFrame) -> Figure | None:
    """Draw the first person's angles of both sides with their 95 % bands; None where none was determined."""
    known = angles[(angles["person"] == angles["person"].min()) & np.isfinite(angles["value_deg"])]
    times = (np.unique(angles["t_ns"]) - summary.origin_ns) / 1e9
    panels: dict[str, list[Line]] = {kind: [] for kind in _SHOWN_ANGLES}
    bins = time_bins(times, MOST_BINS_OF_HALF) if len(times) else np.zeros(2)
    for name, own in known.groupby("angle", sort=True):
        kind = str(name).removeprefix("left_").removeprefix("right_")
        if kind not in panels:
            continue
        t_s = (own["t_ns"].to_numpy() - summary.origin_ns) / 1e9
        middle, sigma = (
            percentiles(own[column].to_numpy(np.float64), t_s, bins)[0]
            for column in ("value_deg", "sigma_deg")
        )
        low, high = middle - 1.96 * sigma, middle + 1.96 * sigma
        colour, centres = SIDES[side_of(str(name))], (bins[:-1] + bins[1:]) / 2
        panels[kind].append(Line(centres, middle, colour, str(name), low, high, width=0.9, legend=False))
    rows = _in_columns([Panel(lines, title=joint_label(kind)) for kind, lines in panels.items() if lines])
    if not rows:
        return None
    caption = f"{SIDE_COLOURS} Bands: 95 %, from the stated standard deviations. Signs as in docs/outputs.md."
    caption += _stretch_words(bins, len(times))
    return Figure(
        "angles", "Joint angles over time", caption, rows, 0.3 + 1.05 * len(rows), label="angle (°)"
    )


def _in_columns(panels: list[Panel]) -> list[list[Panel]]:
    """Set two panels side by side, and label the time below the last ones."""
    last = (len(panels) - 1) // 2 * 2
    labelled = [replace(each, x_label=TIME_LABEL if k >= last else "") for k, each in enumerate(panels)]
    return [labelled[k : k + 2] for k in range(0, len(panels), 2)]
