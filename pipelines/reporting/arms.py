"""The comparison of planners: the flight of every arm, its tables, and its figures.

The colour is the arm's in every figure and in the 3D viewer; the stroke is the drone's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Int64
from pipelines.reporting.chart import (
    CAMERAS,
    INK,
    LINE_STYLES,
    STATUS_COLOURS,
    TIME_LABEL,
    WIDTH_IN,
    Bars,
    Figure,
    Line,
    Mark,
    Note,
    Panel,
    Shades,
    axis_label,
    bounds,
    line_through,
    near_zero,
    points_at,
    stride_for,
)
from pipelines.reporting.content import ReplanContent, items, number, section, text
from pipelines.reporting.wording import (
    THIN,
    Column,
    Table,
    fixed,
    percent,
    plural,
    quantity,
    shortened,
    with_interval,
)
from pipelines.session.maps import MapSurface, surface_of
from pipelines.session.records import Occupancy

# Drones pass obstacles at this distance, so that more of the map would only make the drawing smaller.
MAP_MARGIN_M = 12.0
# Everything lower than this above the ground is ground.
LOWEST_OBSTACLE_M = 0.5
# More cubes cannot be told apart in the 3D view.
MAX_SURFACE_POINTS = 3000
# Finer cells of the top view cannot be told apart in a panel.
MAX_TOP_CELLS = 120
# The level that 5 % of the columns do not reach is the ground: holes and errors lie below.
GROUND_PERCENTILE = 5.0
# Sight lines of more moments would cover each other.
KEYFRAMES = 6
# Levels of height double, as what stands in the way does.
HEIGHT_LEVELS_M = (LOWEST_OBSTACLE_M, 1.0, 2.0, 4.0, 8.0, 16.0)

_HIDDEN = STATUS_COLOURS["rejected"]


# --- the map around the flight ---


@dataclass(frozen=True)
class MapAround:
    """The part of a map around a flight; nothing in it is occupied where the map ends."""

    occupied: NDArray[np.bool_]  # [X, Y, Z]
    corner: Float  # [3] m, of voxel (0, 0, 0), world
    resolution_m: float
    ground_m: float  # world


@dataclass(frozen=True)
class Heights:
    """Height of the highest occupied voxel of each column above the ground."""

    east_m: Float  # [X] middles of the cells, world
    north_m: Float  # [Y]
    above_m: Float  # [X, Y], 0 where nothing is occupied


def map_around(occupancy: Occupancy, low: Float, high: Float) -> MapAround | None:
    """Cut the columns of a map within a box [2], [2] m; None where nothing is occupied (0.5 and above)."""
    shape = np.array(occupancy.probability.shape[:2])
    first, last = (
        np.clip(cells, 0, shape).astype(int)
        for cells in (
            np.floor((low - occupancy.origin[:2]) / occupancy.resolution_m),
            np.ceil((high - occupancy.origin[:2]) / occupancy.resolution_m),
        )
    )
    with np.errstate(invalid="ignore"):
        occupied = occupancy.probability[first[0] : last[0], first[1] : last[1]] >= 0.5
    columns = occupied.any(axis=2)
    if not columns.any():
        return None
    corner = occupancy.origin + occupancy.resolution_m * np.array([*first, 0])
    lowest = float(np.percentile(_tops(occupied)[columns], GROUND_PERCENTILE, method="lower"))
    ground_m = float(corner[2]) + occupancy.resolution_m * lowest
    return MapAround(occupied, corner, occupancy.resolution_m, ground_m)


def _tops(occupied: NDArray[np.bool_]) -> Int64:
    """Count voxels [X, Y] from the grid's floor to the top of each column's highest occupied one."""
    tops: Int64 = occupied.shape[2] - occupied[:, :, ::-1].argmax(axis=2).astype(np.int64)
    return tops


def heights(around: MapAround) -> Heights:
    """Compute heights on a coarse grid: each cell has that of its highest column."""
    above_m = around.corner[2] + around.resolution_m * _tops(around.occupied) - around.ground_m
    above_m = np.where(around.occupied.any(axis=2), np.maximum(above_m, 0.0), 0.0)
    step = -(-max(above_m.shape) // MAX_TOP_CELLS)
    east, north = (np.arange(0, side, step) for side in above_m.shape)
    middle = around.corner[:2] + around.resolution_m * step / 2
    return Heights(
        east_m=middle[0] + around.resolution_m * east,
        north_m=middle[1] + around.resolution_m * north,
        above_m=np.maximum.reduceat(np.maximum.reduceat(above_m, east, axis=0), north, axis=1),
    )


def raised_surface(around: MapAround, most: int = MAX_SURFACE_POINTS) -> MapSurface:
    """Return the surface of everything that rises above the ground, in at most so many cubes."""
    occupancy = Occupancy(around.occupied.astype(np.float32), around.corner, around.resolution_m)
    return surface_of(occupancy, most, above_m=around.ground_m + LOWEST_OBSTACLE_M)


# --- flights ---


@dataclass(frozen=True)
class ArmTrack:
    """The flight of one arm: T times, C cameras. Its yaw is continuous."""

    name: str
    simulated: bool  # False for logged arms
    colour: int  # of the page's camera colours, one that no camera of the session has if any is free
    t_ns: Int64  # [T]
    t_s: Float  # [T] since the page's zero
    cameras: tuple[str, ...]
    position: Float  # [C, T, 3] m, world
    quaternion_xyzw: Float  # [C, T, 4] world_from_camera
    actor: Float  # [T, 3] m, world
    visible: NDArray[np.bool_]  # [C, T]
    tilt_deg: Float  # [C, T] of the camera above the actor
    range_m: Float  # [C, T] from the actor
    yaw_deg: Float  # [T] of the first camera around the actor, counterclockwise from east
    predicted_error_m: Float  # [T] NaN where the cameras determine nothing


@dataclass(frozen=True)
class Replan:
    """A comparison of planners."""

    arms: tuple[ArmTrack, ...]
    around: MapAround | None
    verdict: str
    setting: str  # a sentence about the comparison
    tables: tuple[Table, ...]
    notes: tuple[str, ...]


def summarise_replan(content: ReplanContent, origin_ns: int, cameras: int) -> Replan:
    """Collect what the page says of a comparison; times from `origin_ns`, colours after the cameras'."""
    metrics, filmed = content.metrics, content.filmed
    arms = tuple(
        _arm(name, own, content, origin_ns=origin_ns, colour=cameras + k)
        for k, (name, own) in enumerate(content.arms.items())
        if len(own)
    )
    around = None
    if content.map is not None and arms:
        low, high = bounds_of(arms)
        around = map_around(content.map, low - MAP_MARGIN_M, high + MAP_MARGIN_M)
    return Replan(
        arms=arms,
        around=around,
        verdict=text(filmed, "verdict") or text(metrics, "verdict"),
        setting=_setting(metrics) + (f" Modelled: {text(metrics, 'verdict')}." if filmed else ""),
        tables=(*_film_table(filmed), *_tables(metrics)),
        notes=tuple(str(note) for note in items(metrics, "notes")),
    )


def bounds_of(arms: tuple[ArmTrack, ...]) -> tuple[Float, Float]:
    """Return the corners [2] of the box that holds all arms and the actor, seen from above, in m."""
    return bounds([path[..., :2].reshape(-1, 2) for arm in arms for path in (arm.position, arm.actor)])


def _arm(name: str, rows: pd.DataFrame, content: ReplanContent, *, origin_ns: int, colour: int) -> ArmTrack:
    t_ns, time = np.unique(rows["t_ns"].to_numpy(np.int64), return_inverse=True)
    cameras = tuple(dict.fromkeys(rows["camera"]))
    camera = rows["camera"].map({name: k for k, name in enumerate(cameras)}).to_numpy(np.intp)

    def dense(*columns: str) -> Float:
        values = np.full((len(cameras), len(t_ns), len(columns)), np.nan)
        values[camera, time] = rows[list(columns)].to_numpy(np.float64)
        return values

    position = dense("x", "y", "z")
    stamps, seconds = content.actor["t_ns"].to_numpy(np.int64), (t_ns - t_ns[0]) / 1e9
    logged = [content.actor[axis].to_numpy(np.float64) for axis in "xyz"]
    actor = np.stack([np.interp(seconds, (stamps - t_ns[0]) / 1e9, axis) for axis in logged], axis=-1)
    offset = position - actor
    metrics = section(section(content.metrics, "arms"), name)
    return ArmTrack(
        name=name,
        simulated=metrics.get("simulated") is not False,
        colour=colour % len(CAMERAS),
        t_ns=t_ns,
        t_s=(t_ns - origin_ns) / 1e9,
        cameras=cameras,
        position=position,
        quaternion_xyzw=dense("qx", "qy", "qz", "qw"),
        actor=actor,
        visible=dense("visible")[..., 0] > 0.5,
        tilt_deg=np.degrees(dense("tilt_rad")[..., 0]),
        range_m=np.sqrt((offset**2).sum(axis=-1)),
        yaw_deg=_continuous_deg(np.arctan2(offset[0, :, 1], offset[0, :, 0])),
        predicted_error_m=dense("predicted_error_m")[0, :, 0],
    )


def _continuous_deg(angle_rad: Float) -> Float:
    """Convert to degrees without jumps of a turn; NaN stays."""
    known = np.isfinite(angle_rad)
    result = np.full(angle_rad.shape, np.nan)
    result[known] = np.degrees(np.unwrap(angle_rad[known]))
    return result


# --- tables ---


def _setting(metrics: Mapping[str, object]) -> str:
    drones, skeleton = number(metrics, "drones") or 0, text(metrics, "skeleton")
    trials = plural(number(metrics, "trials") or 0, "draw")
    filmed = {
        "": "none, because no skeleton is known",
        "truth": f"simulated in {trials} of the true skeleton",
    }
    error = filmed.get(skeleton, f"simulated in {trials} of the skeleton of {skeleton}")
    return (
        f"{plural(drones, 'drone')} over {fixed(number(metrics, 'duration_s'))} s."
        f" Reconstruction error: {error}, smoothed as the estimate smooths it."
    )


# Column, key in metrics.json, and scale of a figure with an interval.
_ERRORS = (
    (Column("PCK150", "of all joints, %"), "pck150", 100.0),
    (Column("MPJPE", "simulated, mm"), "mpjpe_mm", 1.0),
    (Column("Measured", "joints, %"), "coverage", 100.0),
)
_DIFFERENCES = (
    (Column("Tilt", "deg"), "tilt_deg", 1.0),
    (Column("Hidden", "points of %"), "occluded_share", 100.0),
    *_ERRORS,
)
_HIDDEN_COLUMN = Column("Hidden", "share of time")


def _tables(metrics: Mapping[str, object]) -> list[Table]:
    stated = section(metrics, "arms")
    groups = [section({"group": group}, "group") for group in items(metrics, "equal_ranges")]
    names = [str(name) for group in groups for name in items(group, "arms")]  # near ones first
    level = f"{fixed(100 * (number(section(metrics, 'intervals'), 'level') or 0), 0)}{THIN}%"
    errors, quality = [column for column, *_ in _ERRORS], Column("View quality")
    columns = [Column("Arm", text=True), *(column for column, _ in _ARM_FIGURES), _HIDDEN_COLUMN]
    columns += [*errors, Column("Limits", "broken", text=True)]
    people = [
        [arm, person, _hidden(own), *_estimates(own, _ERRORS), fixed(number(own, "view_quality"), 3)]
        for arm in names
        for person, own in (
            (p, section(of, p)) for of in [section(section(stated, arm), "by_person")] for p in of
        )
    ]
    differences = [section({"one": one}, "one") for one in items(metrics, "differences")]
    rows = [
        [f"{text(one, 'arm')} less {text(one, 'against')}", *_estimates(one, _DIFFERENCES, signed=True)]
        for one in differences
    ]
    found = [
        Table(
            "arms",
            f"The arms; below a value its {level} interval over draws of noise. MPJPE is that of the joints"
            " that all arms measured. For PCK150 a joint that was not measured counts as wrong.",
            columns,
            [_arm_row(name, section(stated, name)) for name in names],
            "arms",
        ),
        Table(
            "arms-people",
            "By person. Hidden counts times out of view, too.",
            [Column("Arm", text=True), Column("Person", text=True), _HIDDEN_COLUMN, *errors, quality],
            people,
            "measures arms",
        ),
        Table(
            "differences",
            f"One arm less another, with the {level} interval: they differ where it does not contain 0.",
            [Column("Arms", text=True), *(column for column, *_ in _DIFFERENCES)],
            rows,
            "measures arms",
        ),
    ]
    return [one for one in found if one.rows]


def _film_table(metrics: Mapping[str, object]) -> list[Table]:
    if not metrics:
        return []
    arms, rate = section(metrics, "arms"), fixed(number(metrics, "rate_hz"))
    rows = [
        [
            arm,
            fixed(number(section(arms, arm), "pictures"), 0),
            fixed(number(section(section(arms, arm), "tilt_deg"), "mean")),
            percent(number(section(arms, arm), "keypoint_pck")),
            *_estimates(section(section(arms, arm), "reconstruction_error"), _ERRORS),
        ]
        for arm in arms
    ]
    columns = [
        Column("Arm", text=True),
        Column("Pictures"),
        Column("Tilt", "mean, deg"),
        Column("Keypoints", "right"),
    ]
    title = f"Filmed (rendered) at {rate} Hz, keypoints by {text(metrics, 'detector')}, with intervals."
    return [
        Table("arms-filmed", title, [*columns, *(column for column, *_ in _ERRORS)], rows, "measures arms")
    ]


_ARM_FIGURES: tuple[tuple[Column, tuple[str, ...]], ...] = (
    (Column("Drones"), ("drones",)),
    (Column("Range", "mean, m"), ("range_m", "mean")),
    (Column("Tilt", "mean, deg"), ("tilt_deg", "mean")),
    (Column("Tilt", "largest, deg"), ("tilt_deg", "max")),
    (Column("Way", "of a drone, m"), ("path_m",)),
    (Column("Energy", "of a drone, modelled, kJ"), ("energy_kj",)),
    (Column("Clearance", "least, m"), ("min_clearance_m",)),
    (Column("Separation", "least, m"), ("min_separation_m",)),
)


def _arm_row(name: str, stated: Mapping[str, object]) -> list[object]:
    figures = []
    for column, (*sections, key) in _ARM_FIGURES:
        value = number(section(stated, sections[0]) if sections else stated, key)
        figures.append(fixed(value, 0 if column.title in {"Drones", "Way"} else 1))
    violations = section(stated, "limit_violations")
    broken = [f"{kind} {fixed(count, 0)}" for kind in violations if (count := number(violations, kind))]
    errors = _estimates(section(stated, "reconstruction_error"), _ERRORS)
    flown = "as logged" if stated.get("simulated") is False else "simulated"
    return [(name, flown), *figures, _hidden(stated), *errors, ", ".join(broken) or "none"]


def _hidden(stated: Mapping[str, object]) -> tuple[str, str]:
    blind_s = number(stated, "blind_s")
    return percent(number(stated, "occluded_share")), "" if blind_s is None else f"{fixed(blind_s)} s blind"


def _estimates(
    stated: Mapping[str, object], columns: Sequence[tuple[Column, str, float]], *, signed: bool = False
) -> list[tuple[str, str]]:
    found = []
    for _, key, scale in columns:
        own = section(stated, key)
        low, high = (items(own, "interval") or [None, None])[:2]
        ends = (scale * low, scale * high) if isinstance(low, float) and isinstance(high, float) else None
        mean = number(own, "mean")
        found.append(with_interval(None if mean is None else scale * mean, ends, 1 + signed, signed=signed))
    return found


# --- figures ---


def draw_arms_over_time(arms: tuple[ArmTrack, ...]) -> Figure:
    """Draw tilt, range, sight, predicted error and yaw of all arms over the same time."""
    lines: dict[str, list[Line]] = {
        "tilt (deg)": [],
        "range (m)": [],
        "predicted\nerror (cm)": [],
        "yaw (deg)": [],
    }
    hidden, rows, strips = [], {}, 0
    for arm in arms:
        colour = CAMERAS[arm.colour]
        starts = np.arange(0, len(arm.t_s), stride_for(len(arm.t_s)))
        t_s = _means(arm.t_s, starts)
        for label, values in (("tilt (deg)", arm.tilt_deg), ("range (m)", arm.range_m)):
            low = np.minimum.reduceat(values.min(axis=0), starts)
            high = np.maximum.reduceat(values.max(axis=0), starts)
            middle = _means(values.mean(axis=0), starts)
            lines[label].append(Line(t_s, middle, colour, arm.name, low, high))
        error_cm, yaw_deg = _means(100 * arm.predicted_error_m, starts), arm.yaw_deg[starts]
        lines["predicted\nerror (cm)"].append(Line(t_s, error_cm, colour, arm.name))
        lines["yaw (deg)"].append(Line(arm.t_s[starts], yaw_deg, colour, arm.name))
        rows[strips + (len(arm.cameras) - 1) / 2] = shortened(arm.name)
        for camera, seen in zip(arm.cameras, arm.visible, strict=True):
            spans = np.array(hidden_spans(arm.t_s, seen)).reshape(-1, 2)
            lasting = np.diff(spans, axis=1)[:, 0].tolist()
            name = f"{arm.name}, {camera}"
            hidden.append(
                Bars([strips] * len(spans), spans[:, 0].tolist(), lasting, colour, name, legend=False)
            )
            strips += 1
    panels = [[Panel(own, y_label=label)] for label, own in lines.items()]
    panels[2] = [
        Panel(lines["predicted\nerror (cm)"], y_label="predicted\nerror (cm)", y_span=(0, _top(arms)))
    ]
    panels.append([Panel(hidden, TIME_LABEL, "hidden", rows={**rows, strips - 0.5: ""}, grid="x")])
    heights = [1.35, 1.15, 1.15, 1.15, 0.3 + 0.085 * strips]
    caption = (
        "Tilt of the cameras over the actor and their range: the mean of an arm's drones, and all of them"
        " within the band. The error to be expected of all views together; no line where they determine none."
        " Yaw of the first drone about the actor, from east. Hidden: a row for each drone, drawn while"
        " something stands between it and the actor."
    )
    title = "Tilt, range, predicted error, yaw and sight over time"
    return Figure("arms-time", title, caption, panels, 0.7 + sum(heights), heights=heights)


def _means(values: Float, starts: Int64) -> Float:
    """Compute the means of the stretches that begin at `starts`; NaN if one of a stretch's values is NaN."""
    return np.asarray(np.add.reduceat(values, starts) / np.diff([*starts, len(values)]))


def hidden_spans(seconds: Float, seen: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Return the start and end of each span in which a drone sees nothing; a moment lasts until the next."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], ~seen, [False]]).astype(np.int8)))
    ends = np.append(seconds, seconds[-1])
    return [(float(ends[a]), float(ends[b])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _top(arms: tuple[ArmTrack, ...]) -> float:
    """Return the upper end of the axis of errors, which cameras on one line make grow without bound."""
    every_error = np.concatenate([100 * arm.predicted_error_m for arm in arms])
    known = every_error[np.isfinite(every_error)]
    return float(min(1.08 * known.max(), 3.0 * np.percentile(known, 90))) or 1.0 if len(known) else 1.0


def keyframes(arm: ArmTrack) -> NDArray[np.intp]:
    """Return the rows of an arm's keyframes: evenly spread, with the first and the last."""
    return np.unique(np.round(np.linspace(0, len(arm.t_s) - 1, KEYFRAMES)).astype(np.intp))


def draw_from_above(replan: Replan) -> Figure:
    """Draw one panel for each arm, all of the same stretch of land."""
    arms = replan.arms
    low, high = bounds_of(arms)
    margin = 0.08 * float((high - low).max()) + 2.0
    low, high = low - margin, high + margin
    origin = near_zero(low)
    columns = min(len(arms), 2 if (high - low)[0] > 1.3 * (high - low)[1] else 3)
    panel_in = (WIDTH_IN - 0.5) / columns
    height_in = float(np.clip(panel_in * (high - low)[1] / (high - low)[0], 0.5 * panel_in, 6.0))
    ground = None if replan.around is None else heights(replan.around)
    levels = [] if ground is None else [m for m in HEIGHT_LEVELS_M if ground.above_m.max() >= m]
    east_span, north_span = ((float(a), float(b)) for a, b in zip(low - origin, high - origin, strict=True))
    panels = []
    for k, arm in enumerate(arms):
        marks: list[Mark] = []
        if ground is not None and levels and min(ground.above_m.shape) >= 2:
            east, north = ground.east_m - origin[0], ground.north_m - origin[1]
            marks.append(Shades(east, north, ground.above_m, levels, "above" if k == 0 else ""))
        marks += _from_above(arm, origin)
        x_label = axis_label("east", origin[0]) if k + columns >= len(arms) else ""
        y_label = axis_label("north", origin[1]) if k % columns == 0 else ""
        title = shortened(arm.name)
        panels.append(
            Panel(marks, x_label, y_label, None, east_span, north_span, None, title, "both", equal=True)
        )
    caption = (
        f"Paths of the drones and of the actor (thick); open circles mark the start. At {KEYFRAMES} moments, "
        "whose seconds stand beside the first drone, a line leads from each drone to the actor: "
        "red and dotted where something stands in the line of sight."
    )
    if replan.around is not None:
        caption += (
            f" Shades: height of the map above the ground at {quantity(replan.around.ground_m, 'm', 2)}."
        )
    rows = [panels[k : k + columns] for k in range(0, len(panels), columns)]
    size = 0.75 + len(rows) * (height_in + 0.25)
    return Figure("arms-top", "The arms from above", caption, rows, size, share_y=True)


def _from_above(arm: ArmTrack, origin: Float) -> list[Mark]:
    rows, chosen, colour = slice(None, None, stride_for(len(arm.t_s))), keyframes(arm), CAMERAS[arm.colour]
    actor, places = arm.actor[:, :2] - origin, arm.position[..., :2] - origin
    marks: list[Mark] = [
        line_through(actor[rows], INK, "actor", width=1.8),
        points_at(actor[:1], INK, filled=False),
    ]
    for c, (camera, path) in enumerate(zip(arm.cameras, places, strict=True)):
        style = LINE_STYLES[c % len(LINE_STYLES)]
        marks.append(line_through(path[rows], colour, f"{arm.name}, {camera}", style=style, legend=False))
        marks += [points_at(path[chosen], colour, size=2.6), points_at(path[:1], colour, filled=False)]
        for k in chosen:
            ends, free = np.stack([path[k], actor[k]]), arm.visible[c, k]
            if free:
                marks.append(line_through(ends, colour, width=0.6))
            else:
                marks.append(line_through(ends, _HIDDEN, "hidden", style=LINE_STYLES[2], width=1.1))
    for k in chosen:
        place, outward = places[0, k], places[0, k] - actor[k]
        if np.isfinite(outward).all():
            x, y = place + outward / max(float(np.hypot(*outward)), 1e-9)
            marks.append(Note(float(x), float(y), fixed(float(arm.t_s[k]), 0)))
    return marks
