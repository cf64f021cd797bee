"""The figures of a session's page: cameras, errors over time, joints, body and bones; the list of all.

Each function draws one figure from the summary and describes the picture in words.
Long recordings are drawn with at most `MOST_POINTS` points a path and `MOST_BINS` stretches of time;
the captions say so.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.triangulation import STATUS
from pipelines.reporting.from_above import draw_paths
from pipelines.reporting.motion import Motion, side_of, standing_heights
from pipelines.reporting.plates import (
    CAMERAS,
    LINE_STYLES,
    MOST_BINS,
    MUTED,
    PAPER,
    PEOPLE,
    SIDES,
    STATUS_COLOURS,
    TIME_LABEL,
    WIDTH_IN,
    Plate,
    new_figure,
    page_style,
    percentiles,
    quiet,
    stacked,
    table,
    tabled,
    time_bins,
)
from pipelines.reporting.summary import CameraRow, Summary
from pipelines.reporting.wording import (
    STATUS_LABELS,
    fixed,
    joint_label,
    listing,
    percent,
    plural,
    quantity,
    shortened,
)
from pipelines.session.people import bones_of, with_derived

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes


SIDE_COLOURS = "Left in blue, right in orange."
"""Words for the colours of limbs, which no camera has."""


def draw_all(
    summary: Summary,
    poses: Mapping[str, pd.DataFrame],
    residuals: Mapping[str, tuple[Float, Float]] | None = None,
    angles: pd.DataFrame | None = None,
) -> dict[str, Plate]:
    """Draw every figure that the session has the data for, by its key.

    Args:
        residuals: of each camera the times in s and the distances in px, as `residuals_over_time` gives them.
        angles: tables.ANGLES.
    """
    motion = summary.motion
    plates = [_timeline(summary.cameras)]
    measured = motion is not None and bool(motion.measured.any())
    plates.append(draw_paths(summary.cameras, poses, motion if measured else None, summary.people))
    if motion is not None:
        plates.append(draw_over_time(summary, motion))
        if residuals:
            plates.append(_residuals(summary, residuals))
        if np.isfinite(motion.sigma_m).any():
            plates.append(_sigmas(summary, motion))
        plates.append(_joint_bars(summary))
    if angles is not None and (plate := _angles(summary, angles)) is not None:
        plates.append(plate)
    if motion is not None and measured:
        plates.append(draw_snapshots(summary, motion))
        if summary.bones:
            plates.append(_bone_lengths(summary))
    return {plate.key: plate for plate in plates}


# --- cameras -------------------------------------------------------------------------------------------


def _timeline(cameras: tuple[CameraRow, ...]) -> Plate:
    rows = len(cameras)
    with page_style():
        figure = new_figure(0.55 + 0.26 * rows)
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
        axes.set_xlabel(TIME_LABEL)
        quiet(axes, "x")
        title = "When each camera had frames and poses"
    description = " ".join(_describe(camera) for camera in cameras)
    gaps = any(camera.gaps_s for camera in cameras)
    caption = "A bar spans the frames of a camera" + (
        "; where it is cut to a thin line, its pose log has a gap." if gaps else "; no pose log has a gap."
    )
    spans = [(c.name, "frames", c.first_s, c.last_s) for c in cameras]
    spans += [(c.name, "gap in poses", start, end) for c in cameras for start, end in c.gaps_s]
    numbers = tabled(("camera", "what", "start_s", "end_s"), spans)
    return Plate("timeline", title, caption, description, figure, {"": numbers})


def _describe(camera: CameraRow) -> str:
    gaps = f"{plural(len(camera.gaps_s), 'gap')} in the poses" if camera.gaps_s else "no gap in the poses"
    return f"{camera.name}: {fixed(camera.first_s)} s to {fixed(camera.last_s)} s, {gaps}."


# --- joint by joint ------------------------------------------------------------------------------------


def _joint_bars(summary: Summary) -> Plate:
    rows = summary.joints
    with page_style():
        figure = new_figure(_joint_height_in(summary), WIDTH_IN / 2)
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
        quiet(axes, "x")
        title = "Status of every joint"
        listed = listing(f"{joint_label(row.name)} {percent(row.share)}" for row in rows)
    numbers = table(
        joint=[row.name for row in rows],
        **{
            f"{word}_percent": [100 * row.counts[word] / max(sum(row.counts.values()), 1) for row in rows]
            for word in summary.statuses
        },
    )
    caption = "Colours as in the figure of errors over time."
    return Plate("joints", title, caption, f"Share measured: {listed}.", figure, {"": numbers})


def _joint_height_in(summary: Summary) -> float:
    """Return the height of the two figures that stand side by side, inches."""
    return 0.6 + 0.175 * max(len(summary.joints), 8)


def _bone_lengths(summary: Summary) -> Plate:
    bones = summary.bones
    names = list(dict.fromkeys(bone.name for bone in bones))
    with page_style():
        figure = new_figure(_joint_height_in(summary), WIDTH_IN / 2)
        axes = figure.subplots()
        for bone in bones:
            y = names.index(bone.name) + {"left": -0.17, "right": 0.17, "": 0.0}[bone.side]
            colour = SIDES[bone.side]
            axes.plot([100 * bone.low_m, 100 * bone.high_m], [y, y], color=colour, linewidth=2.2, alpha=0.45)
            axes.plot(100 * bone.median_m, y, "o", color=colour, markersize=3.6)
        axes.set_yticks(range(len(names)), names)
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_xlim(left=0)
        axes.set_xlabel("length (cm)")
        quiet(axes, "x")
        title = "Bone lengths"
        listed = listing(
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
    return Plate("bones", title, caption, f"Median and relative spread: {listed}.", figure, {"": numbers})


# --- over time -----------------------------------------------------------------------------------------


def draw_over_time(summary: Summary, motion: Motion) -> Plate:
    """Draw errors, and the share of measured joints; distances from truth where that is known."""
    seconds = (motion.t_ns - summary.origin_ns) / 1e9
    values = motion.reprojection_px if summary.errors_mm is None else summary.errors_mm
    unit = "px" if summary.errors_mm is None else "mm"
    what = "reprojection error" if summary.errors_mm is None else "distance from truth"
    bins = time_bins(seconds)
    centres, shares = _status_shares(seconds, motion, bins)
    shown = {word: 100 * shares[STATUS.index(word)] for word in summary.statuses}
    values = np.where(motion.measured, values, np.nan)
    middle, low, high = percentiles(values, seconds, bins)
    people = [shortened(name) for name in summary.people] if len(summary.people) > 1 else []
    each = {
        f"median_{unit}_of_{name}": percentiles(values[:, [k]], seconds, bins)[0]
        for k, name in enumerate(summary.people)
        if people
    }
    with page_style():
        figure = new_figure(3.5)
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[2.4, 1])
        _draw_errors(upper, centres, middle, low, high)
        for k, own in enumerate(each.values()):
            upper.plot(centres, own, color=PEOPLE[k % len(PEOPLE)], linewidth=0.9, label=people[k])
        upper.set_ylabel(f"{what} ({unit})")
        _draw_percentages(lower, bins, shown)
        lower.set_xlabel(TIME_LABEL)
        figure.legend(loc="outside upper left", ncols=len(STATUS))
        title = f"{what.capitalize()} over time, and the status of the joints"
        worst = int(np.nanargmax(middle)) if np.isfinite(middle).any() else None
        description = (
            "No joint was measured."
            if worst is None
            else f"The median over joints lies between {quantity(float(np.nanmin(middle)), unit)} and "
            f"{quantity(float(middle[worst]), unit)}, the largest at {quantity(float(centres[worst]), 's')}."
        )
    caption = (
        f"Above: {what} of the measured joints, median and the range from the 10th to the 90th percentile. "
        "Below: the share of joints measured, and why the others were not."
    )
    if people:
        caption += " Thin lines are the medians of each person."
    if len(centres) < len(motion.t_ns):
        caption += f" Each point stands for {bins[1] - bins[0]:.2g} s."
    numbers = table(
        t_s=centres,
        **{f"median_{unit}": middle, f"p10_{unit}": low, f"p90_{unit}": high},
        **each,
        **{f"{word}_percent": share for word, share in shown.items()},
    )
    return Plate("time", title, caption, description, figure, {"": numbers})


def _residuals(summary: Summary, residuals: Mapping[str, tuple[Float, Float]]) -> Plate:
    """Draw each camera's distance between keypoints and joints over time."""
    names = [camera.name for camera in summary.cameras]
    highest = [np.nanpercentile(px, 99) for _, px in residuals.values() if np.isfinite(px).any()]
    with page_style():
        figure = new_figure(2.1)
        axes = figure.subplots()
        for name, (t_s, px) in residuals.items():
            k = names.index(name)
            style = LINE_STYLES[k // len(CAMERAS) % len(LINE_STYLES)]
            axes.plot(
                t_s,
                px,
                color=CAMERAS[k % len(CAMERAS)],
                linestyle=style,
                linewidth=0.9,
                label=shortened(name),
            )
        axes.set_ylim(0, 1.3 * max(highest, default=1.0) or 1.0)
        axes.set_ylabel("residual (px)")
        axes.set_xlabel(TIME_LABEL)
        quiet(axes, "y")
        axes.legend(loc="upper left", ncols=4)
    known = [(name, px[np.isfinite(px)]) for name, (_, px) in residuals.items()]
    listed = listing(f"{name} {quantity(float(np.median(px)), 'px')}" for name, px in known if len(px))
    caption = (
        "Median over the joints of a picture: the distance between the keypoint and the reconstructed joint. "
        "A camera that rises alone has a wrong pose or clock there."
    )
    if any(
        len(px) < camera.entry.frames.count
        for camera in summary.cameras
        for _, px in [residuals.get(camera.name, (None, np.empty(camera.entry.frames.count)))]
    ):
        caption += f" At most {MOST_BINS} pictures of a camera, evenly spread."
    numbers = {
        "": stacked([table(t_s=t_s, camera=name, residual_px=px) for name, (t_s, px) in residuals.items()])
    }
    return Plate("residuals", "Residuals of each camera over time", caption, f"{listed}.", figure, numbers)


_SIGMA_COLUMNS = 2


def _sigmas(summary: Summary, motion: Motion) -> Plate:
    """Draw the standard deviation of each joint over time, left and right of a kind in one panel."""
    seconds = (motion.t_ns - summary.origin_ns) / 1e9
    bins = time_bins(seconds, 150)
    centres = (bins[:-1] + bins[1:]) / 2
    mm = 1000 * motion.sigma_m
    middle = {name: percentiles(mm[..., j], seconds, bins)[0] for j, name in enumerate(motion.joints)}
    kinds: dict[str, list[str]] = {}
    for name in motion.joints:
        if np.isfinite(middle[name]).any():
            side = side_of(name)
            kinds.setdefault(name.removeprefix(f"{side}_") if side else name, []).append(name)
    rows = -(-len(kinds) // _SIGMA_COLUMNS)
    top = 1.15 * max(float(np.nanpercentile(middle[name], 98)) for kind in kinds.values() for name in kind)
    with page_style():
        figure = new_figure(0.3 + 0.62 * rows)
        panels = figure.subplots(rows, _SIGMA_COLUMNS, squeeze=False, sharex=True, sharey=True)
        for axes in panels.flat[len(kinds) :]:
            axes.set_axis_off()
        for axes, (kind, names) in zip(panels.flat, kinds.items(), strict=False):
            for name in names:
                axes.plot(centres, middle[name], color=SIDES[side_of(name)], linewidth=0.9)
            axes.set_ylim(0, top)
            words = axes.text(
                0.01, 0.97, shortened(joint_label(kind)), transform=axes.transAxes, va="top", fontsize=7
            )
            words.set_in_layout(False)  # a long name takes no room from the curves
            quiet(axes, "y")
        for axes in panels[-1]:
            axes.set_xlabel(TIME_LABEL)
        figure.supylabel("σ (mm)", fontsize=7.6, color=MUTED)
    listed = listing(
        f"{joint_label(name)} {quantity(float(np.nanmedian(mm[..., j])), 'mm')}"
        for j, name in enumerate(motion.joints)
        if np.isfinite(mm[..., j]).any()
    )
    caption = (
        "The stated standard deviation per axis of the measured joints: the square root of a third of the "
        f"covariance’s trace. {SIDE_COLOURS} Gaps: not measured."
    )
    if len(centres) < len(motion.t_ns):
        caption += f" Each point is the median of {bins[1] - bins[0]:.2g} s."
    numbers = {"": table(t_s=centres, **{f"{name}_mm": values for name, values in middle.items()})}
    title = "Standard deviation of each joint over time"
    return Plate("sigmas", title, caption, f"Medians: {listed}.", figure, numbers)


_SHOWN_ANGLES = (
    *("hip_flexion", "knee_flexion", "ankle_dorsiflexion"),
    *("trunk_flexion", "shoulder_elevation", "elbow_flexion"),
)


def _angles(summary: Summary, angles: pd.DataFrame) -> Plate | None:
    """Draw the first person's angles of both sides with their 95 % bands; None where none was determined."""
    known = angles[(angles["person"] == angles["person"].min()) & np.isfinite(angles["value_deg"])]
    series = {}
    for name, rows in known.groupby("angle", sort=True):
        kind = str(name).removeprefix("left_").removeprefix("right_")
        if kind in _SHOWN_ANGLES:
            series[str(name)] = (kind, rows)
    if not series:
        return None
    kinds = [kind for kind in _SHOWN_ANGLES if any(kind == of for of, _ in series.values())]
    times = (np.unique(angles["t_ns"]) - summary.origin_ns) / 1e9
    bins = time_bins(times, 150)
    centres = (bins[:-1] + bins[1:]) / 2
    rows = -(-len(kinds) // _SIGMA_COLUMNS)
    columns: dict[str, Float] = {}
    with page_style():
        figure = new_figure(0.3 + 1.05 * rows)
        panels = figure.subplots(rows, _SIGMA_COLUMNS, squeeze=False, sharex=True)
        for axes in panels.flat[len(kinds) :]:
            axes.set_axis_off()
        for axes, kind in zip(panels.flat, kinds, strict=False):
            for name, (of, own) in series.items():
                if of != kind:
                    continue
                t_s = (own["t_ns"].to_numpy() - summary.origin_ns) / 1e9
                middle = percentiles(own["value_deg"].to_numpy(np.float64), t_s, bins)[0]
                sigma = percentiles(own["sigma_deg"].to_numpy(np.float64), t_s, bins)[0]
                colour = SIDES[side_of(name)]
                axes.fill_between(
                    centres,
                    middle - 1.96 * sigma,
                    middle + 1.96 * sigma,
                    color=colour,
                    alpha=0.18,
                    linewidth=0,
                )
                axes.plot(centres, middle, color=colour, linewidth=0.9)
                columns |= {f"{name}_deg": middle, f"{name}_sigma_deg": sigma}
            axes.set_title(joint_label(kind), fontsize=7.2, color=MUTED, loc="left")
            quiet(axes, "y")
        for axes in panels[-1]:
            axes.set_xlabel(TIME_LABEL)
        figure.supylabel("angle (°)", fontsize=7.6, color=MUTED)
    listed = listing(
        f"{joint_label(name)} {fixed(float(own['value_deg'].min()), 0)}° to "
        f"{fixed(float(own['value_deg'].max()), 0)}°"
        for name, (_, own) in series.items()
    )
    caption = f"{SIDE_COLOURS} Bands: 95 %, from the stated standard deviations. Signs as in docs/outputs.md."
    if len(centres) < len(times):
        caption += f" Each point is the median of {bins[1] - bins[0]:.2g} s."
    numbers = {"": table(t_s=centres, **columns)}
    return Plate("angles", "Joint angles over time", caption, f"Ranges: {listed}.", figure, numbers)


def _draw_errors(axes: Axes, centres: Float, middle: Float, low: Float, high: Float) -> None:
    """Draw a line on its range, from zero."""
    axes.fill_between(centres, low, high, color=STATUS_COLOURS["ok"], alpha=0.22, linewidth=0)
    axes.plot(centres, middle, color=STATUS_COLOURS["ok"])
    axes.set_ylim(0, 1.08 * np.nanmax(high, initial=0.0) or 1.0)
    quiet(axes, "y")


def _draw_percentages(axes: Axes, bins: Float, shown: Mapping[str, Float]) -> None:
    """Draw the share of joints by status, one on top of the other."""
    base = np.zeros(len(bins) - 1)
    for word, share in shown.items():
        top = base + share
        axes.fill_between(
            *_steps(bins, base, top), color=STATUS_COLOURS[word], linewidth=0, label=STATUS_LABELS[word]
        )
        base = top
    axes.set_ylim(0, 100)
    axes.set_xlim(bins[0], bins[-1])
    axes.set_ylabel("joints (%)")
    quiet(axes, "x")


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


# --- the body ------------------------------------------------------------------------------------------


SNAPSHOTS = 7
_STRIDE_M = 1.3  # between two snapshots of the body
# Above a raised hand, and below the ground by more than errors explain: points beyond are cut off.
_TALLEST_M, _DEEPEST_M = 2.6, 0.5


def draw_snapshots(summary: Summary, motion: Motion) -> Plate:
    """Draw the first person's fullest skeletons, side by side.

    At least one joint must have been measured.
    """
    chosen = _fullest_times(motion)
    joints, position = with_derived(motion.joints, motion.measured_position[chosen, 0])
    ground = standing_heights(motion)[chosen, 0]
    above = position[..., 2] - ground[:, None]
    top = float(np.clip(np.nanmax(above) + 0.1, 1.0, _TALLEST_M))
    bottom = float(np.clip(np.nanmin(above), -_DEEPEST_M, 0.0)) - 0.05
    width = _STRIDE_M * SNAPSHOTS
    with page_style():
        figure = new_figure(0.5 + (WIDTH_IN - 0.6) * (top - bottom) / width)
        axes = figure.subplots()
        seconds = [(int(motion.t_ns[k]) - summary.origin_ns) / 1e9 for k in chosen]
        labels = [f"{fixed(t_s)} s" for t_s in seconds]
        drawn = []
        for k, body in enumerate(position):
            aside, up = _three_quarter_view(body, joints)
            _draw_body(axes, aside + _STRIDE_M * k, up - ground[k], joints)
            drawn.append(np.stack([aside, up - ground[k]], axis=-1))
        axes.set_xlim(-_STRIDE_M / 2, width - _STRIDE_M / 2)
        axes.set_ylim(bottom, top)
        axes.set_yticks(np.arange(0.0, top, 0.5))
        axes.set_aspect("equal")
        axes.set_xticks(_STRIDE_M * np.arange(len(chosen)), labels)
        axes.set_ylabel("height (m)")
        quiet(axes, "y")
        axes.spines["bottom"].set_visible(False)
        axes.tick_params(axis="x", length=0)
        title = "The body at a few moments"
        description = f"{plural(len(chosen), 'snapshot')} at {listing(labels)}."
    whose = "" if motion.position.shape[1] == 1 else " of the first person"
    caption = (
        f"The fullest skeleton{whose} in each stretch of time, facing right and seen from its right, "
        "half from the front; left limbs in blue, right limbs in orange. "
        "Heights count from the lowest joint at that moment, taken over two seconds."
    )
    places = np.concatenate(drawn)
    numbers = table(
        t_s=np.repeat(seconds, len(joints)),
        joint=list(joints) * len(chosen),
        right_m=places[:, 0],
        above_ground_m=places[:, 1],
    )
    return Plate("body", title, caption, description, figure, {"": numbers})


def _fullest_times(motion: Motion) -> list[int]:
    """Choose in each of `SNAPSHOTS` equal stretches the time with most joints, nearest its middle."""
    count = motion.measured[:, 0].sum(axis=1)
    chosen = []
    for rows in np.array_split(np.arange(len(count)), min(SNAPSHOTS, len(count))):
        best = rows[count[rows] == count[rows].max()]
        middle = best[np.argmin(np.abs(best - rows.mean()))]
        if count[middle] >= 2:
            chosen.append(int(middle))
    return chosen or [int(np.argmax(count))]


def _three_quarter_view(body: Float, joints: tuple[str, ...]) -> tuple[Float, Float]:
    """Compute horizontal and vertical picture coordinates in metres of one body [J, 3].

    The picture's right is where the body faces, turned 35 degrees towards its left, so that both sides show.
    """
    facing = np.array([1.0, 0.0])
    for left, right in (("left_hip", "right_hip"), ("left_shoulder", "right_shoulder")):
        if left in joints and right in joints:
            across = (body[joints.index(left)] - body[joints.index(right)])[:2]
            if np.isfinite(across).all() and np.linalg.norm(across) > 0:
                facing = np.array([across[1], -across[0]]) / np.linalg.norm(across)
                break
    leftward = np.array([-facing[1], facing[0]])
    right_of_picture = np.cos(np.radians(35)) * facing + np.sin(np.radians(35)) * leftward
    ground = body[:, :2] - np.nanmedian(body[:, :2], axis=0)
    return ground @ right_of_picture, body[:, 2]


def _draw_body(axes: Axes, aside: Float, up: Float, joints: tuple[str, ...]) -> None:
    place = {name: (aside[j], up[j]) for j, name in enumerate(joints)}
    for start, end in bones_of(joints):
        side = side_of(start, end)
        order = {"left": 2, "right": 4, "": 3}[side]
        axes.plot(*zip(place[start], place[end], strict=True), color=SIDES[side], linewidth=1.7, zorder=order)
    axes.plot(aside, up, "o", color=MUTED, markersize=1.6, zorder=5)
