"""The figures of a session's page: cameras, errors over time, joints, body and bones; the list of all.

Each function draws one figure from the summary and describes the picture in words.
Long recordings are drawn with at most `MOST_POINTS` points a path and `MOST_BINS` stretches of time;
the captions say so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.poses import rotate
from pipelines.geometry.triangulation import STATUS
from pipelines.reporting.chart import (
    INK,
    MOST_BINS,
    MUTED,
    PAPER,
    PEOPLE,
    SIDES,
    STATUS_COLOURS,
    TIME_LABEL,
    WIDTH_IN,
    Bars,
    Line,
    Panel,
    Plate,
    RowPoints,
    Stack,
    axis_label,
    bounds,
    chart,
    colour_and_style,
    near_zero,
    new_figure,
    page_style,
    percentiles,
    quiet,
    stacked,
    stride_for,
    table,
    tabled,
    time_bins,
    way_m,
)
from pipelines.reporting.content import MeasuredMotion, middles, side_of, standing_heights
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
from pipelines.session.records import Trajectory
from pipelines.session.tables import trajectory_from

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

# Panels half as wide as the page show no more stretches of time.
MOST_BINS_OF_HALF = 150
# The body is drawn this often, which fills the width of the page.
SNAPSHOTS = 7
# Bodies with stretched arms do not touch each other at this distance.
SNAPSHOT_STRIDE_M = 1.3
# A raised hand is lower, so that points above are errors and are cut off.
TALLEST_M = 2.6
# Errors of the ground do not reach deeper, so that points below are cut off.
DEEPEST_M = 0.5
# A camera that moves by less than this part of the flight's extent is drawn as one place.
STILL_SHARE = 0.005

SIDE_COLOURS = "Left in blue, right in orange."
"""Words for the colours of limbs, which no camera has."""

_SHOWN_ANGLES = (
    *("hip_flexion", "knee_flexion", "ankle_dorsiflexion"),
    *("trunk_flexion", "shoulder_elevation", "elbow_flexion"),
)


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
    plates: list[Plate | None] = [_timeline(summary.cameras)]
    measured = motion is not None and bool(motion.measured.any())
    plates.append(draw_paths(summary.cameras, poses, motion if measured else None, summary.people))
    if motion is not None:
        plates.append(draw_over_time(summary, motion))
        if residuals:
            plates.append(_residuals(summary, residuals))
        if np.isfinite(motion.sigma_m).any():
            plates.append(_sigmas(summary, motion))
        plates.append(_joint_bars(summary))
    if angles is not None:
        plates.append(_angles(summary, angles))
    if motion is not None and measured:
        plates.append(draw_snapshots(summary, motion))
        if summary.bones:
            plates.append(_bone_lengths(summary))
    return {plate.key: plate for plate in plates if plate is not None}


def stretch_words(bins: Float, times: int) -> str:
    """State what a point of a line stands for where stretches of time are drawn; empty where each time is."""
    return f" Each point stands for {bins[1] - bins[0]:.2g} s." if len(bins) - 1 < times else ""


# --- cameras ---


def _timeline(cameras: tuple[CameraRow, ...]) -> Plate:
    bars = []
    for k, camera in enumerate(cameras):
        colour, _ = colour_and_style(k)
        bars.append(Bars([k], camera.first_s, [camera.last_s - camera.first_s], colour, thickness=0.34))
        for start, end in camera.gaps_s:
            bars.append(Bars([k], start, [end - start], PAPER, thickness=0.36))
            bars.append(Bars([k], start, [end - start], colour, thickness=0.05))
    rows = {float(k): shortened(camera.name) for k, camera in enumerate(cameras)}
    panel = Panel(bars, x_label=TIME_LABEL, rows=rows, grid="x")
    words = [
        f"{c.name}: {fixed(c.first_s)} s to {fixed(c.last_s)} s, "
        f"{plural(len(c.gaps_s), 'gap') if c.gaps_s else 'no gap'} in the poses."
        for c in cameras
    ]
    caption = "A bar spans the frames of a camera" + (
        "; where it is cut to a thin line, its pose log has a gap."
        if any(camera.gaps_s for camera in cameras)
        else "; no pose log has a gap."
    )
    spans = [(c.name, "frames", c.first_s, c.last_s) for c in cameras]
    spans += [(c.name, "gap in poses", start, end) for c in cameras for start, end in c.gaps_s]
    numbers = {"": tabled(("camera", "what", "start_s", "end_s"), spans)}
    figure = chart([[panel]], 0.55 + 0.26 * len(cameras))
    return Plate(
        "timeline", "When each camera had frames and poses", caption, " ".join(words), figure, numbers
    )


def draw_paths(
    cameras: tuple[CameraRow, ...],
    poses: Mapping[str, pd.DataFrame],
    motion: MeasuredMotion | None,
    names: Sequence[str],
) -> Plate:
    """Draw the paths on the ground plane; without a motion those of the cameras alone.

    `names` are those of the people, and have a colour each where there are several.
    """
    tracks = {camera.name: trajectory_from(poses[camera.name]) for camera in cameras if camera.name in poses}
    people = list(np.moveaxis(middles(motion.measured_position)[..., :2], 1, 0)) if motion is not None else []
    low, high = bounds([*people, *(track.position[:, :2] for track in tracks.values())])
    origin = near_zero(low)
    extent = np.maximum(high - low, 2.0)
    labels = ["actor"] if len(people) == 1 else [shortened(name) for name in names[: len(people)]]
    drawn = []
    with page_style():
        figure = new_figure(float(np.clip(0.75 * WIDTH_IN * extent[1] / extent[0], 3.2, 6.2)))
        axes = figure.subplots()
        for k, camera in enumerate(cameras):
            if camera.name in tracks:
                path, stride = _draw_camera(
                    axes, camera, tracks[camera.name], origin, colour_and_style(k), float(extent.max())
                )
                drawn.append((camera.name, path + origin, stride))
        for k, (label, person) in enumerate(zip(labels, people, strict=True)):
            colour = INK if len(people) == 1 else PEOPLE[k % len(PEOPLE)]
            stride = stride_for(len(person))
            path = person[::stride] - origin
            axes.plot(*path.T, color=colour, linewidth=2.0, label=label, zorder=4)
            start = path[np.isfinite(path[:, 0])][:1]
            axes.plot(*start.T, "o", color=colour, markerfacecolor=PAPER, markersize=5, zorder=5)
            drawn.append((label, path + origin, stride))
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.06)
        axes.set_xlabel(axis_label("east", origin[0]))
        axes.set_ylabel(axis_label("north", origin[1]))
        figure.legend(loc="outside right upper")
        quiet(axes, "both")
    ways = [f"{name} over {quantity(way_m(t.position), 'm')}" for name, t in tracks.items()]
    who = ["the actor"] if len(people) == 1 else labels
    ways += [f"{name} over {quantity(way_m(p), 'm')}" for name, p in zip(who, people, strict=True)]
    whom = "the actor" if len(people) == 1 else "people"
    caption = "Paths of the cameras" + (f" and of {whom} (middle of the measured joints)" if people else "")
    caption += "; an open circle marks the start, short strokes the direction of view."
    step = max((stride for *_, stride in drawn), default=1)
    caption += f" One pose in {step} is drawn." if step > 1 else ""
    numbers = [table(who=name, east_m=path[:, 0], north_m=path[:, 1]) for name, path, _ in drawn]
    description = f"Paths on the ground plane: {listing(ways)}."
    return Plate("top", "Seen from above", caption, description, figure, {"": stacked(numbers)})


def _draw_camera(
    axes: Axes,
    camera: CameraRow,
    track: Trajectory,
    origin: Float,
    style: tuple[str, Any],
    extent_m: float,
) -> tuple[Float, int]:
    """Draw a path with strokes in the direction of view; a camera that stands still is a square."""
    ground = track.position[:, :2] - origin
    look = rotate(track.quaternion_xyzw, np.array([0.0, 0.0, 1.0]))[:, :2]
    path, stride = _drawn_path(track.t_ns, ground, [start for start, _ in camera.entry.poses.gaps_ns])
    label, (colour, line) = shortened(camera.name), style
    still = bool(np.nanmax(np.ptp(ground, axis=0), initial=0.0) < STILL_SHARE * extent_m)
    if still:
        axes.plot(*ground[:1].T, "s", color=colour, markersize=5, label=label)
    else:
        axes.plot(*path.T, color=colour, linestyle=line, label=label)
        axes.plot(*ground[:1].T, "o", color=colour, markerfacecolor=PAPER, markersize=4)
    at = np.unique(np.linspace(0, len(ground) - 1, 1 if still else 12).astype(int))
    strokes = np.full((3 * len(at), 2), np.nan)
    strokes[0::3], strokes[1::3] = ground[at], ground[at] + look[at] * 0.035 * extent_m
    axes.plot(*strokes.T, color=colour, linewidth=0.8)
    return path, stride


def _drawn_path(t_ns: Int64, path: Float, gap_starts_ns: list[int]) -> tuple[Float, int]:
    """Return a decimated path, broken where the poses have a gap, and the stride of its poses."""
    stride = stride_for(len(path))
    breaks = np.unique(np.searchsorted(t_ns, gap_starts_ns, side="right"))
    pieces = []
    for rows in np.split(np.arange(len(path)), breaks):
        if rows.size:
            pieces += [path[np.unique([*rows[::stride], rows[-1]])], np.full((1, 2), np.nan)]
    return (np.concatenate(pieces), stride) if pieces else (path, stride)


# --- joint by joint ---


def _joint_bars(summary: Summary) -> Plate:
    rows = summary.joints
    shares = {
        word: [100 * row.counts[word] / max(sum(row.counts.values()), 1) for row in rows]
        for word in summary.statuses
    }
    bars, left = [], np.zeros(len(rows))
    for word, share in shares.items():
        bars.append(Bars(range(len(rows)), left.tolist(), share, STATUS_COLOURS[word]))
        left = left + share
    labels = {float(k): shortened(joint_label(row.name)) for k, row in enumerate(rows)}
    panel = Panel(bars, x_label="share of times (%)", rows=labels, x_span=(0, 100), grid="x")
    listed = listing(f"{joint_label(row.name)} {percent(row.share)}" for row in rows)
    numbers = table(
        joint=[row.name for row in rows], **{f"{word}_percent": share for word, share in shares.items()}
    )
    figure = chart([[panel]], _joint_height_in(summary), width_in=WIDTH_IN / 2)
    caption = "Colours as in the figure of errors over time."
    words = f"Share measured: {listed}."
    return Plate("joints", "Status of every joint", caption, words, figure, {"": numbers})


def _joint_height_in(summary: Summary) -> float:
    """Return the height of the two figures that stand side by side, inches."""
    return 0.6 + 0.175 * max(len(summary.joints), 8)


def _bone_lengths(summary: Summary) -> Plate:
    bones = summary.bones
    names = list(dict.fromkeys(bone.name for bone in bones))
    marks = [
        RowPoints(
            [names.index(bone.name) + {"left": -0.17, "right": 0.17, "": 0.0}[bone.side]],
            [100 * bone.median_m],
            [(100 * bone.low_m, 100 * bone.high_m)],
            SIDES[bone.side],
            width=2.2,
            opacity=0.45,
        )
        for bone in bones
    ]
    rows = {float(k): name for k, name in enumerate(names)}
    panel = Panel(marks, x_label="length (cm)", rows=rows, x_span=(0, None), grid="x")
    caption = (
        "Median and the range from the 10th to the 90th percentile; left in blue, above, right in orange."
        " A bone that changes its length was measured wrongly."
    )
    labels = [f"{b.side} {b.name}".strip() for b in bones]
    listed = listing(
        f"{label} {quantity(100 * b.median_m, 'cm')} ± {percent(b.spread)}"
        for label, b in zip(labels, bones, strict=True)
    )
    numbers = table(
        bone=labels,
        median_cm=[100 * b.median_m for b in bones],
        p10_cm=[100 * b.low_m for b in bones],
        p90_cm=[100 * b.high_m for b in bones],
        relative_spread=[b.spread for b in bones],
    )
    figure = chart([[panel]], _joint_height_in(summary), width_in=WIDTH_IN / 2)
    words = f"Median and relative spread: {listed}."
    return Plate("bones", "Bone lengths", caption, words, figure, {"": numbers})


# --- over time ---


def draw_over_time(summary: Summary, motion: MeasuredMotion) -> Plate:
    """Draw errors, and the share of measured joints; distances from truth where that is known."""
    seconds = (motion.t_ns - summary.origin_ns) / 1e9
    values = motion.reprojection_px if summary.errors_mm is None else summary.errors_mm
    unit = "px" if summary.errors_mm is None else "mm"
    what = "reprojection error" if summary.errors_mm is None else "distance from truth"
    bins = time_bins(seconds)
    centres, shares = _status_shares(seconds, motion, bins)
    values = np.where(motion.measured, values, np.nan)
    middle, low, high = percentiles(values, seconds, bins)
    shown = {STATUS_LABELS[word]: 100 * shares[STATUS.index(word)] for word in summary.statuses}
    lines = [Line(centres, middle, STATUS_COLOURS["ok"], low=low, high=high, shade=0.22)]
    each: dict[str, Float] = {}
    if len(summary.people) > 1:
        for k, name in enumerate(summary.people):
            own = each[f"median_{unit}_of_{name}"] = percentiles(values[:, [k]], seconds, bins)[0]
            lines.append(Line(centres, own, PEOPLE[k % len(PEOPLE)], shortened(name), width=0.9))
    top = 1.08 * float(np.nanmax(high, initial=0.0)) or 1.0
    upper = Panel(lines, y_label=f"{what} ({unit})", y_span=(0, top))
    stack = Stack(bins, shown, {STATUS_LABELS[word]: STATUS_COLOURS[word] for word in summary.statuses})
    lower = Panel(
        [stack], TIME_LABEL, "joints (%)", x_span=(float(bins[0]), float(bins[-1])), y_span=(0, 100), grid="x"
    )
    figure = chart([[upper], [lower]], 3.5, heights=[2.4, 1], columns=len(STATUS))
    description = "No joint was measured."
    if np.isfinite(middle).any():
        worst = int(np.nanargmax(middle))
        description = (
            f"The median over joints lies between {quantity(float(np.nanmin(middle)), unit)} and "
            f"{quantity(float(middle[worst]), unit)}, the largest at {quantity(float(centres[worst]), 's')}."
        )
    caption = (
        f"Above: {what} of the measured joints, median and the range from the 10th to the 90th percentile. "
        "Below: the share of joints measured, and why the others were not."
    )
    caption += " Thin lines are the medians of each person." if each else ""
    caption += stretch_words(bins, len(motion.t_ns))
    numbers = table(
        t_s=centres,
        **{f"median_{unit}": middle, f"p10_{unit}": low, f"p90_{unit}": high},
        **each,
        **{f"{word}_percent": 100 * shares[STATUS.index(word)] for word in summary.statuses},
    )
    title = f"{what.capitalize()} over time, and the status of the joints"
    return Plate("time", title, caption, description, figure, {"": numbers})


def _status_shares(seconds: Float, motion: MeasuredMotion, bins: Float) -> tuple[Float, Float]:
    """Return the bins' centres, and the share of every status in each, [S, bins]; 0 without rows."""
    edges = np.searchsorted(seconds, bins)
    per_time = np.stack([(motion.status == s).sum(axis=(1, 2)) for s in range(len(STATUS))])
    running = np.concatenate([np.zeros((len(STATUS), 1)), np.cumsum(per_time, axis=1)], axis=1)
    counts = np.diff(running[:, edges], axis=1)
    return (bins[:-1] + bins[1:]) / 2, counts / np.maximum(counts.sum(axis=0), 1)


def _residuals(summary: Summary, residuals: Mapping[str, tuple[Float, Float]]) -> Plate:
    """Draw each camera's distance between keypoints and joints over time."""
    names = [camera.name for camera in summary.cameras]
    highest = [np.nanpercentile(px, 99) for _, px in residuals.values() if np.isfinite(px).any()]
    lines = []
    for name, (t_s, px) in residuals.items():
        colour, style = colour_and_style(names.index(name))
        lines.append(Line(t_s, px, colour, shortened(name), style=style, width=0.9))
    top = 1.3 * float(max(highest, default=1.0)) or 1.0
    figure = chart([[Panel(lines, TIME_LABEL, "residual (px)", y_span=(0, top))]], 2.1, legend="inside")
    known = [(name, px[np.isfinite(px)]) for name, (_, px) in residuals.items()]
    listed = listing(f"{name} {quantity(float(np.median(px)), 'px')}" for name, px in known if len(px))
    caption = (
        "Median over the joints of a picture: the distance between the keypoint and the reconstructed joint. "
        "A camera that rises alone has a wrong pose or clock there."
    )
    counts = {camera.name: camera.entry.frames.count for camera in summary.cameras}
    if any(len(px) < counts[name] for name, (_, px) in residuals.items()):
        caption += f" At most {MOST_BINS} pictures of a camera, evenly spread."
    numbers = stacked([table(t_s=t_s, camera=name, residual_px=px) for name, (t_s, px) in residuals.items()])
    title = "Residuals of each camera over time"
    return Plate("residuals", title, caption, f"{listed}.", figure, {"": numbers})


def _sigmas(summary: Summary, motion: MeasuredMotion) -> Plate:
    """Draw the standard deviation of each joint over time, left and right of a kind in one panel."""
    seconds = (motion.t_ns - summary.origin_ns) / 1e9
    bins = time_bins(seconds, MOST_BINS_OF_HALF)
    centres = (bins[:-1] + bins[1:]) / 2
    mm = 1000 * motion.sigma_m
    middle = {name: percentiles(mm[..., j], seconds, bins)[0] for j, name in enumerate(motion.joints)}
    kinds: dict[str, list[str]] = {}
    for name in motion.joints:
        if np.isfinite(middle[name]).any():
            kinds.setdefault(name.removeprefix(f"{side_of(name)}_"), []).append(name)
    top = 1.15 * max(float(np.nanpercentile(middle[name], 98)) for kind in kinds.values() for name in kind)
    panels = [
        Panel(
            [Line(centres, middle[name], SIDES[side_of(name)], width=0.9) for name in names],
            y_span=(0, top),
            title=shortened(joint_label(kind)),
            title_inside=True,
        )
        for kind, names in kinds.items()
    ]
    rows = _in_columns(panels)
    figure = chart(rows, 0.3 + 0.62 * len(rows), share_y=True, label="σ (mm)")
    listed = listing(
        f"{joint_label(name)} {quantity(float(np.nanmedian(mm[..., j])), 'mm')}"
        for j, name in enumerate(motion.joints)
        if np.isfinite(mm[..., j]).any()
    )
    caption = (
        "The stated standard deviation per axis of the measured joints: the square root of a third of the "
        f"covariance’s trace. {SIDE_COLOURS} Gaps: not measured."
    )
    caption += stretch_words(bins, len(motion.t_ns))
    numbers = {"": table(t_s=centres, **{f"{name}_mm": values for name, values in middle.items()})}
    title = "Standard deviation of each joint over time"
    return Plate("sigmas", title, caption, f"Medians: {listed}.", figure, numbers)


def _angles(summary: Summary, angles: pd.DataFrame) -> Plate | None:
    """Draw the first person's angles of both sides with their 95 % bands; None where none was determined."""
    known = angles[(angles["person"] == angles["person"].min()) & np.isfinite(angles["value_deg"])]
    times = (np.unique(angles["t_ns"]) - summary.origin_ns) / 1e9
    panels: dict[str, list[Line]] = {kind: [] for kind in _SHOWN_ANGLES}
    columns: dict[str, Float] = {}
    ranges = []
    bins = time_bins(times, MOST_BINS_OF_HALF) if len(times) else np.zeros(2)
    centres = (bins[:-1] + bins[1:]) / 2
    for angle, own in known.groupby("angle", sort=True):
        name = str(angle)
        kind = name.removeprefix("left_").removeprefix("right_")
        if kind not in panels:
            continue
        t_s = (own["t_ns"].to_numpy() - summary.origin_ns) / 1e9
        value = own["value_deg"].to_numpy(np.float64)
        middle = percentiles(value, t_s, bins)[0]
        sigma = percentiles(own["sigma_deg"].to_numpy(np.float64), t_s, bins)[0]
        low, high = middle - 1.96 * sigma, middle + 1.96 * sigma
        colour = SIDES[side_of(name)]
        panels[kind].append(Line(centres, middle, colour, low=low, high=high, width=0.9, shade=0.18))
        columns |= {f"{name}_deg": middle, f"{name}_sigma_deg": sigma}
        ends = f"{fixed(float(value.min()), 0)}° to {fixed(float(value.max()), 0)}°"
        ranges.append(f"{joint_label(name)} {ends}")
    if not ranges:
        return None
    rows = _in_columns([Panel(lines, title=joint_label(kind)) for kind, lines in panels.items() if lines])
    figure = chart(rows, 0.3 + 1.05 * len(rows), label="angle (°)")
    caption = f"{SIDE_COLOURS} Bands: 95 %, from the stated standard deviations. Signs as in docs/outputs.md."
    caption += stretch_words(bins, len(times))
    numbers = {"": table(t_s=centres, **columns)}
    words = f"Ranges: {listing(ranges)}."
    return Plate("angles", "Joint angles over time", caption, words, figure, numbers)


def _in_columns(panels: list[Panel]) -> list[list[Panel]]:
    """Set two panels side by side, and label the time below the last ones."""
    last = (len(panels) - 1) // 2 * 2
    labelled = [replace(each, x_label=TIME_LABEL if k >= last else "") for k, each in enumerate(panels)]
    return [labelled[k : k + 2] for k in range(0, len(panels), 2)]


# --- the body ---


def draw_snapshots(summary: Summary, motion: MeasuredMotion) -> Plate:
    """Draw the first person's fullest skeletons, side by side.

    At least one joint must have been measured.
    """
    chosen = _fullest_times(motion)
    joints, position = with_derived(motion.joints, motion.measured_position[chosen, 0])
    ground = standing_heights(motion)[chosen, 0]
    above = position[..., 2] - ground[:, None]
    top = float(np.clip(np.nanmax(above) + 0.1, 1.0, TALLEST_M))
    bottom = float(np.clip(np.nanmin(above), -DEEPEST_M, 0.0)) - 0.05
    width = SNAPSHOT_STRIDE_M * SNAPSHOTS
    with page_style():
        figure = new_figure(0.5 + (WIDTH_IN - 0.6) * (top - bottom) / width)
        axes = figure.subplots()
        seconds = [(int(motion.t_ns[k]) - summary.origin_ns) / 1e9 for k in chosen]
        labels = [f"{fixed(t_s)} s" for t_s in seconds]
        drawn = []
        for k, body in enumerate(position):
            aside, up = _three_quarter_view(body, joints)
            _draw_body(axes, aside + SNAPSHOT_STRIDE_M * k, up - ground[k], joints)
            drawn.append(np.stack([aside, up - ground[k]], axis=-1))
        axes.set_xlim(-SNAPSHOT_STRIDE_M / 2, width - SNAPSHOT_STRIDE_M / 2)
        axes.set_ylim(bottom, top)
        axes.set_yticks(np.arange(0.0, top, 0.5))
        axes.set_aspect("equal")
        axes.set_xticks(SNAPSHOT_STRIDE_M * np.arange(len(chosen)), labels)
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


def _fullest_times(motion: MeasuredMotion) -> list[int]:
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
    """Compute horizontal and vertical picture coordinates in metres of one body [J, 3]."""
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
