"""The figure of all paths from above: the cameras' and the actor's."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import rotate
from pipelines.reporting.motion import Motion
from pipelines.reporting.plates import (
    LINE_STYLES,
    MOST_POINTS,
    Plate,
    axis_label,
    every,
    near_zero,
    quiet,
    stacked,
    table,
)
from pipelines.reporting.summary import CameraRow
from pipelines.reporting.svg import (
    CAMERAS,
    INK,
    PAPER,
    WIDTH_IN,
    page_style,
)
from pipelines.reporting.wording import (
    listing,
    quantity,
    shortened,
)
from pipelines.session.records import Int64, Trajectory
from pipelines.session.tables import trajectory_from

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes


def draw_paths(
    cameras: tuple[CameraRow, ...], poses: Mapping[str, pd.DataFrame], motion: Motion | None
) -> Plate:
    """Draw the paths on the ground plane; without a motion those of the cameras alone."""
    from matplotlib.figure import Figure

    tracks = {camera.name: trajectory_from(poses[camera.name]) for camera in cameras if camera.name in poses}
    people = _middles(motion) if motion is not None else []
    low, high = _bounds([*people, *(track.position[:, :2] for track in tracks.values())])
    origin = near_zero(low)
    extent = np.maximum(high - low, 2.0)
    height_in = float(np.clip(0.75 * WIDTH_IN * extent[1] / extent[0], 3.2, 6.2))

    with page_style():
        figure = Figure((WIDTH_IN, height_in), layout="constrained")
        axes = figure.subplots()
        axes.grid(visible=True)
        drawn = []
        for k, camera in enumerate(cameras):
            if camera.name in tracks:
                style = (CAMERAS[k % len(CAMERAS)], LINE_STYLES[k // len(CAMERAS) % len(LINE_STYLES)])
                path, stride = _draw_camera(
                    axes, camera, tracks[camera.name], origin, style, float(extent.max())
                )
                drawn.append((camera.name, path + origin, stride))
        for k, person in enumerate(people):
            label = "actor" if len(people) == 1 else f"person {k}"
            path, stride = _draw_person(axes, label, person - origin, LINE_STYLES[k % len(LINE_STYLES)])
            drawn.append((label, path + origin, stride))
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.06)
        axes.set_xlabel(axis_label("east", origin[0]))
        axes.set_ylabel(axis_label("north", origin[1]))
        figure.legend(loc="outside right upper")
        quiet(axes, grid=False)
        title = "Seen from above"
        paths = [f"{name} over {quantity(_length_m(t.position), 'm')}" for name, t in tracks.items()]
        paths += [f"the actor over {quantity(_length_m(person), 'm')}" for person in people]
        told = f"Paths on the ground plane: {listing(paths)}."
    caption = "Paths of the cameras" + (" and of the actor (middle of the measured joints)" if people else "")
    caption += "; an open circle marks the start, short strokes the direction of view."
    caption += _decimation(max((stride for _, _, stride in drawn), default=1), "pose")
    numbers = [table(who=who, east_m=path[:, 0], north_m=path[:, 1]) for who, path, _ in drawn]
    return Plate("top", title, caption, told, figure, {"": stacked(numbers)})


def _bounds(paths: list[Float]) -> tuple[Float, Float]:
    """Return the corners [2] of the box that holds all paths [N, 2]; zero where there is none."""
    everything = np.concatenate([np.full((1, 2), np.nan), *paths])
    everything = everything[np.isfinite(everything).all(axis=1)]
    return (everything.min(axis=0), everything.max(axis=0)) if len(everything) else (np.zeros(2),) * 2


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


def _draw_person(axes: Axes, label: str, person: Float, line: object) -> tuple[Float, int]:
    """Draw a person's path [T, 2] and its start; return the drawn path, and the stride of its poses."""
    stride = every(len(person), MOST_POINTS)
    path = person[::stride]
    axes.plot(*path.T, color=INK, linewidth=2.0, linestyle=line, label=label, zorder=4)
    start = path[np.isfinite(path[:, 0])][:1]
    axes.plot(*start.T, "o", color=INK, markerfacecolor=PAPER, markersize=5, zorder=5)
    return path, stride


def _drawn_path(t_ns: Int64, path: Float, gap_starts_ns: list[int]) -> tuple[Float, int]:
    """Return a decimated path, broken where the poses have a gap, and the stride of its poses."""
    stride = every(len(path), MOST_POINTS)
    breaks = np.unique(np.searchsorted(t_ns, gap_starts_ns, side="right"))
    pieces = []
    for rows in np.split(np.arange(len(path)), breaks):
        if rows.size:
            kept = np.unique([*rows[::stride], rows[-1]])
            pieces += [path[kept], np.full((1, 2), np.nan)]
    return (np.concatenate(pieces), stride) if pieces else (path, stride)


def _middles(motion: Motion) -> list[Float]:
    """Compute the middle of each person's measured joints from above, [T, 2]; NaN where there are none.

    It is the coordinate-wise median: one wrong joint does not bend the path.
    """
    middles = []
    for position in np.moveaxis(motion.measured_position[..., :2], 1, 0):
        seen = np.isfinite(position[..., 0]).any(axis=1)
        middle = np.full((len(position), 2), np.nan)
        middle[seen] = np.nanmedian(position[seen], axis=1)
        middles.append(middle)
    return middles


def _length_m(path: Float) -> float:
    steps = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1)
    return float(steps[np.isfinite(steps)].sum())


def _decimation(step: int, noun: str) -> str:
    return f" One {noun} in {step} is drawn." if step > 1 else ""
