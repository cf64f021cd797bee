"""The figures from above: paths of a session's cameras and actor, and of the arms of a comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.poses import rotate
from pipelines.reporting.motion import Motion, middles
from pipelines.reporting.plates import (
    CAMERAS,
    INK,
    LINE_STYLES,
    MUTED,
    PAPER,
    PEOPLE,
    STATUS_COLOURS,
    WIDTH_IN,
    Plate,
    axis_label,
    bounds,
    near_zero,
    new_figure,
    page_style,
    quiet,
    shade,
    shade_keys,
    stacked,
    stride_for,
    table,
)
from pipelines.reporting.replanned import Arm, NoFlyZone, Replan, bounds_of
from pipelines.reporting.summary import CameraRow
from pipelines.reporting.terrain import LOWEST_M, Heights, heights
from pipelines.reporting.wording import fixed, listing, plural, quantity, shortened
from pipelines.session.records import Trajectory
from pipelines.session.tables import trajectory_from

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_paths(
    cameras: tuple[CameraRow, ...],
    poses: Mapping[str, pd.DataFrame],
    motion: Motion | None,
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
    height_in = float(np.clip(0.75 * WIDTH_IN * extent[1] / extent[0], 3.2, 6.2))

    with page_style():
        figure = new_figure(height_in)
        axes = figure.subplots()
        drawn = []
        labels = ["actor"] if len(people) == 1 else [shortened(name) for name in names[: len(people)]]
        whom = "the actor" if len(people) == 1 else "people"
        for k, camera in enumerate(cameras):
            if camera.name in tracks:
                style = (CAMERAS[k % len(CAMERAS)], LINE_STYLES[k // len(CAMERAS) % len(LINE_STYLES)])
                path, stride = _draw_camera(
                    axes, camera, tracks[camera.name], origin, style, float(extent.max())
                )
                drawn.append((camera.name, path + origin, stride))
        for k, (label, person) in enumerate(zip(labels, people, strict=True)):
            colour = INK if len(people) == 1 else PEOPLE[k % len(PEOPLE)]
            path, stride = _draw_person(axes, label, person - origin, colour)
            drawn.append((label, path + origin, stride))
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.06)
        axes.set_xlabel(axis_label("east", origin[0]))
        axes.set_ylabel(axis_label("north", origin[1]))
        figure.legend(loc="outside right upper")
        quiet(axes, "both")
        title = "Seen from above"
        paths = [f"{name} over {quantity(_way_m(t.position), 'm')}" for name, t in tracks.items()]
        who = ["the actor"] if len(people) == 1 else labels
        paths += [f"{name} over {quantity(_way_m(p), 'm')}" for name, p in zip(who, people, strict=True)]
        description = f"Paths on the ground plane: {listing(paths)}."
    caption = "Paths of the cameras" + (f" and of {whom} (middle of the measured joints)" if people else "")
    caption += "; an open circle marks the start, short strokes the direction of view."
    caption += _decimation(max((stride for _, _, stride in drawn), default=1), "pose")
    numbers = [table(who=name, east_m=path[:, 0], north_m=path[:, 1]) for name, path, _ in drawn]
    return Plate("top", title, caption, description, figure, {"": stacked(numbers)})


def _draw_camera(
    axes: Axes,
    camera: CameraRow,
    track: Trajectory,
    origin: Float,
    style: tuple[str, object],
    extent_m: float,
) -> tuple[Float, int]:
    """Draw a path with strokes in the direction of view; a camera that stands still is a square.

    Returns the path as drawn, from the origin, and the stride of the drawn poses.
    """
    ground = track.position[:, :2] - origin
    look = rotate(track.quaternion_xyzw, np.array([0.0, 0.0, 1.0]))[:, :2]
    path, stride = _drawn_path(track.t_ns, ground, [start for start, _ in camera.entry.poses.gaps_ns])
    label = shortened(camera.name)
    colour, line = style
    still = bool(np.nanmax(np.ptp(ground, axis=0), initial=0.0) < 0.005 * extent_m)
    if still:
        axes.plot(*ground[:1].T, "s", color=colour, markersize=5, label=label)
    else:
        axes.plot(*path.T, color=colour, linestyle=line, label=label)
        axes.plot(*ground[:1].T, "o", color=colour, markerfacecolor=PAPER, markersize=4)
    at = np.unique(np.linspace(0, len(ground) - 1, 1 if still else 12).astype(int))
    tip = ground[at] + look[at] * 0.035 * extent_m
    strokes = np.full((3 * len(at), 2), np.nan)
    strokes[0::3], strokes[1::3] = ground[at], tip
    axes.plot(*strokes.T, color=colour, linewidth=0.8)
    return path, stride


def _draw_person(axes: Axes, label: str, person: Float, colour: str) -> tuple[Float, int]:
    """Draw a person's path [T, 2] and its start; return the drawn path, and the stride of its poses."""
    stride = stride_for(len(person))
    path = person[::stride]
    axes.plot(*path.T, color=colour, linewidth=2.0, label=label, zorder=4)
    start = path[np.isfinite(path[:, 0])][:1]
    axes.plot(*start.T, "o", color=colour, markerfacecolor=PAPER, markersize=5, zorder=5)
    return path, stride


def _drawn_path(t_ns: Int64, path: Float, gap_starts_ns: list[int]) -> tuple[Float, int]:
    """Return a decimated path, broken where the poses have a gap, and the stride of its poses."""
    stride = stride_for(len(path))
    breaks = np.unique(np.searchsorted(t_ns, gap_starts_ns, side="right"))
    pieces = []
    for rows in np.split(np.arange(len(path)), breaks):
        if rows.size:
            kept = np.unique([*rows[::stride], rows[-1]])
            pieces += [path[kept], np.full((1, 2), np.nan)]
    return (np.concatenate(pieces), stride) if pieces else (path, stride)


def _decimation(step: int, noun: str) -> str:
    return f" One {noun} in {step} is drawn." if step > 1 else ""


# --- arms ----------------------------------------------------------------------------------------------


KEYFRAMES = 6
HEIGHT_LEVELS_M = (LOWEST_M, 1.0, 2.0, 4.0, 8.0, 16.0)
_HIDDEN = STATUS_COLOURS["rejected"]
_ZONE_HATCH = "////"


def draw_from_above(replan: Replan) -> Plate:
    """Draw one panel for each arm, all of the same stretch of land."""
    arms = replan.arms
    low, high = bounds_of(arms)
    margin = 0.08 * float((high - low).max()) + 2.0
    low, high = low - margin, high + margin
    origin = near_zero(low)
    columns = min(len(arms), 2 if (high - low)[0] > 1.3 * (high - low)[1] else 3)
    rows = -(-len(arms) // columns)
    panel_in = (WIDTH_IN - 0.5) / columns
    height_in = float(np.clip(panel_in * (high - low)[1] / (high - low)[0], 0.5 * panel_in, 6.0))
    ground = None if replan.terrain is None else heights(replan.terrain)
    with page_style():
        figure = new_figure(0.75 + rows * (height_in + 0.25))
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for k, axes in enumerate(panels.flat):
            if k >= len(arms):
                axes.set_visible(False)
                continue
            _draw_panel(axes, arms[k], ground, low, high)
            _draw_zones(axes, replan.zones, origin)
            if k + columns >= len(arms):
                axes.set_xlabel(axis_label("east", origin[0]))
                axes.tick_params(labelbottom=True)
            if k % columns == 0:
                axes.set_ylabel(axis_label("north", origin[1]))
            quiet(axes)
        levels = [] if ground is None else [m for m in HEIGHT_LEVELS_M if ground.above_m.max() >= m]
        _legend(figure, arms, levels, has_zones=bool(replan.zones))
        title = "The arms from above"
        description = " ".join(_describe(arm) for arm in arms)
    numbers = {"": stacked([_arm_numbers(arm) for arm in arms])}
    if ground is not None:
        east_m, north_m = np.meshgrid(ground.east_m, ground.north_m, indexing="ij")
        numbers["heights"] = table(
            east_m=east_m.ravel(), north_m=north_m.ravel(), above_ground_m=ground.above_m.ravel()
        )
    return Plate("arms-top", title, _caption(replan, levels), description, figure, numbers)


def _arm_numbers(arm: Arm) -> pd.DataFrame:
    """Tabulate the paths of an arm, and its hidden sight lines."""
    tracks = zip(arm.cameras, arm.position, arm.visible, strict=True)
    paths = [
        table(
            arm=arm.name,
            who=camera,
            t_s=arm.t_s,
            east_m=path[:, 0],
            north_m=path[:, 1],
            hidden=(~seen).astype(int),
        )
        for camera, path, seen in tracks
    ]
    actor = table(
        arm=arm.name,
        who="actor",
        t_s=arm.t_s,
        east_m=arm.actor[:, 0],
        north_m=arm.actor[:, 1],
        hidden=np.full(len(arm.t_s), np.nan),
    )
    return stacked([*paths, actor])


def keyframes(arm: Arm) -> NDArray[np.intp]:
    """Return the rows of an arm's keyframes: evenly spread, with the first and the last."""
    chosen = np.round(np.linspace(0, len(arm.t_s) - 1, KEYFRAMES)).astype(np.intp)
    return np.unique(chosen)


def _draw_panel(axes: Axes, arm: Arm, ground: Heights | None, low: Float, high: Float) -> None:
    """Draw an arm on its stretch of land, from corner to corner [2] in m."""
    origin = near_zero(low)
    axes.set_xlim(low[0] - origin[0], high[0] - origin[0])
    axes.set_ylim(low[1] - origin[1], high[1] - origin[1])
    axes.set_aspect("equal")
    axes.grid(visible=True)
    if ground is not None and min(ground.above_m.shape) >= 2:
        east_m, north_m = ground.east_m - origin[0], ground.north_m - origin[1]
        levels = [level for level in HEIGHT_LEVELS_M if ground.above_m.max() >= level]
        shade(axes, east_m, north_m, ground.above_m, levels)
    _draw_arm(axes, arm, origin)
    axes.set_title(shortened(arm.name), fontsize=8.2, color=CAMERAS[arm.colour], loc="left")


def _draw_zones(axes: Axes, zones: tuple[NoFlyZone, ...], origin: Float) -> None:
    """Hatch the no-fly zones; what lies outside of the panel is cut off."""
    for zone in zones:
        corners = np.concatenate([zone.polygon_m, zone.polygon_m[:1]]) - origin
        axes.fill(*corners.T, facecolor="none", edgecolor=_HIDDEN, hatch=_ZONE_HATCH, linewidth=0.9, zorder=2)


def _draw_arm(axes: Axes, arm: Arm, origin: Float) -> None:
    stride = stride_for(len(arm.t_s))
    actor, places = arm.actor[:, :2] - origin, arm.position[..., :2] - origin
    axes.plot(*actor[::stride].T, color=INK, linewidth=1.8, zorder=4)
    chosen = keyframes(arm)
    axes.plot(*actor[chosen].T, "o", color=INK, markersize=2.6, zorder=5)
    axes.plot(*actor[:1].T, "o", color=INK, markerfacecolor=PAPER, markersize=4.2, zorder=6)
    colour = CAMERAS[arm.colour]
    for c, path in enumerate(places):
        axes.plot(*path[::stride].T, color=colour, linestyle=LINE_STYLES[c % len(LINE_STYLES)], zorder=4)
        axes.plot(*path[chosen].T, "o", color=colour, markersize=2.6, zorder=5)
        axes.plot(*path[:1].T, "o", color=colour, markerfacecolor=PAPER, markersize=4.2, zorder=6)
        for k in chosen:
            hidden = not arm.visible[c, k]
            axes.plot(
                *np.stack([path[k], actor[k]]).T,
                color=_HIDDEN if hidden else colour,
                linestyle=LINE_STYLES[2] if hidden else "-",
                linewidth=1.1 if hidden else 0.7,
                alpha=1.0 if hidden else 0.7,
                zorder=3,
            )
    for k in chosen:
        if np.isfinite(places[0, k]).all() and np.isfinite(actor[k]).all():
            outward = places[0, k] - actor[k]
            outward = outward / max(float(np.sqrt((outward**2).sum())), 1e-9)
            axes.annotate(
                fixed(float(arm.t_s[k]), 0),
                (float(places[0, k, 0]), float(places[0, k, 1])),
                (7.5 * float(outward[0]), 7.5 * float(outward[1])),
                textcoords="offset points",
                fontsize=6.4,
                color=MUTED,
                ha="center",
                va="center",
                zorder=7,
            )


def _legend(figure: Figure, arms: tuple[Arm, ...], levels: list[float], *, has_zones: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    cameras = max((arm.cameras for arm in arms), key=len)
    entries: list[Line2D | Patch] = [Line2D([], [], color=INK, linewidth=1.8, label="actor")]
    entries += [
        Line2D([], [], color=MUTED, linestyle=LINE_STYLES[c % len(LINE_STYLES)], label=shortened(name))
        for c, name in enumerate(cameras)
    ]
    if not all(arm.visible[:, keyframes(arm)].all() for arm in arms):
        entries.append(Line2D([], [], color=_HIDDEN, linestyle=LINE_STYLES[2], linewidth=1.0, label="hidden"))
    if has_zones:
        entries.append(Patch(facecolor="none", edgecolor=_HIDDEN, hatch=_ZONE_HATCH, label="no-fly zone"))
    entries += shade_keys([f"above {level:g} m" for level in levels])
    figure.legend(handles=entries, loc="outside upper left", ncols=len(entries) if len(entries) <= 8 else 6)


def _caption(replan: Replan, levels: list[float]) -> str:
    caption = (
        f"Paths of the drones and of the actor (thick); open circles mark the start. At {KEYFRAMES} moments, "
        "whose seconds stand beside the first drone, a line leads from each drone to the actor: "
        "red and dotted where something stands in the sight line."
    )
    if replan.terrain is not None:
        caption += (
            " Shades: how high the map's highest occupied voxel reaches above the ground, "
            f"which is at {quantity(replan.terrain.ground_m, 'm', 2)}."
            if levels
            else f" Nothing in the map rises {quantity(LOWEST_M, 'm')} above the ground."
        )
    if replan.zones:
        named = listing(zone.name for zone in replan.zones)
        caption += f" Hatched: {plural(len(replan.zones), 'no-fly zone')} ({named})."
    step = stride_for(len(replan.arms[0].t_s))
    return caption + (f" One pose in {step} is drawn." if step > 1 else "")


def _describe(arm: Arm) -> str:
    paths = zip(arm.cameras, arm.position, strict=True)
    ways = [f"{name} {quantity(_way_m(path), 'm')}" for name, path in paths]
    chosen = keyframes(arm)
    hidden = int((~arm.visible[:, chosen]).sum())
    return (
        f"{arm.name}: {listing(ways)} over ground, the actor {quantity(_way_m(arm.actor), 'm')}; "
        f"{hidden} of {plural(len(arm.cameras) * len(chosen), 'sight line')} hidden."
    )


def _way_m(path: Float) -> float:
    steps = np.sqrt((np.diff(path[:, :2], axis=0) ** 2).sum(axis=1))
    return float(steps[np.isfinite(steps)].sum())
