"""The comparison of planners: the flight of every arm, its tables, and its figures.

The colour is the arm's in every figure and in the 3D viewer; the stroke is the drone's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Int64
from pipelines.reporting.chart import (
    CAMERAS,
    GRID,
    INK,
    LINE_STYLES,
    MUTED,
    PAPER,
    STATUS_COLOURS,
    WIDTH_IN,
    Bars,
    Line,
    Panel,
    Plate,
    axis_label,
    bounds,
    chart,
    near_zero,
    new_figure,
    page_style,
    quiet,
    shade,
    shade_keys,
    stacked,
    stride_for,
    table,
    way_m,
)
from pipelines.reporting.content import ReplanContent, items, number, section, text
from pipelines.reporting.wording import (
    ABSENT,
    THIN,
    Column,
    Table,
    fixed,
    listing,
    percent,
    plural,
    quantity,
    shortened,
    significant,
    with_interval,
)
from pipelines.session.people import bones_of
from pipelines.session.records import Occupancy

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
# More columns of the cost map cannot be told apart.
MAX_COST_TIMES = 200
# More moments make the people too small to see.
SEEN_MOMENTS = 4
# More cameras of an arm make the people too small to see.
SEEN_CAMERAS = 2
# The sides of a panel are this many lengths of the largest person.
SEEN_ROOM = 1.3

_HIDDEN = STATUS_COLOURS["rejected"]
_ZONE_HATCH = "////"


# --- the map around the flight ---


@dataclass(frozen=True)
class MapAround:
    """The part of a map around a flight; nothing in it is occupied where the map ends."""

    occupied: NDArray[np.bool_]  # [X, Y, Z]
    corner: Float  # [3] m, of voxel (0, 0, 0), world
    resolution_m: float
    ground_m: float  # world

    @property
    def tops(self) -> Int64:
        """Voxels [X, Y] from the grid's floor to the top of each column's highest occupied one."""
        return _tops(self.occupied)


@dataclass(frozen=True)
class Heights:
    """Height of the highest occupied voxel of each column above the ground."""

    east_m: Float  # [X] middles of the cells, world
    north_m: Float  # [Y]
    above_m: Float  # [X, Y], 0 where nothing is occupied


@dataclass(frozen=True)
class RaisedSurface:
    """The surface of everything that rises above the ground, thinned out."""

    points: Float  # [N, 3] m, world: middles of cubes
    cube_m: float  # their side
    voxels: int  # number of surface voxels that they represent


def map_around(occupancy: Occupancy, low: Float, high: Float) -> MapAround | None:
    """Cut the columns of a map within a box [2], [2] m seen from above; None where nothing is occupied.

    0.5 and above is occupied, unknown voxels are not.
    """
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
    tops: Int64 = occupied.shape[2] - occupied[:, :, ::-1].argmax(axis=2).astype(np.int64)
    return tops


def heights(around: MapAround) -> Heights:
    """Compute heights on a coarse grid: each cell has that of its highest column."""
    above_m = around.corner[2] + around.resolution_m * around.tops - around.ground_m
    above_m = np.where(around.occupied.any(axis=2), np.maximum(above_m, 0.0), 0.0)
    step = -(-max(above_m.shape) // MAX_TOP_CELLS)
    east, north = (np.arange(0, side, step) for side in above_m.shape)
    middle = around.corner[:2] + around.resolution_m * step / 2
    return Heights(
        east_m=middle[0] + around.resolution_m * east,
        north_m=middle[1] + around.resolution_m * north,
        above_m=np.maximum.reduceat(np.maximum.reduceat(above_m, east, axis=0), north, axis=1),
    )


def surface(around: MapAround, most: int = MAX_SURFACE_POINTS) -> RaisedSurface:
    """Return the occupied voxels with a free neighbour that rise above the ground.

    They are grouped in cubes of whole voxels, the smallest with which at most `most` cubes are occupied.
    """
    occupied = np.pad(around.occupied, 1)
    inner = occupied[1:-1, 1:-1, 1:-1].copy()
    for axis in range(3):
        for side in (slice(None, -2), slice(2, None)):
            inner &= occupied[tuple(side if a == axis else slice(1, -1) for a in range(3))]
    voxels = np.argwhere(around.occupied & ~inner)
    top_m = around.corner[2] + around.resolution_m * (voxels[:, 2] + 1)
    voxels = voxels[top_m > around.ground_m + LOWEST_OBSTACLE_M - 1e-9 * around.resolution_m]
    gathered = 1
    cubes: Int64 = voxels
    while len(cubes) > most:
        gathered += 1
        cubes = np.unique(voxels // gathered, axis=0)
    cube_m = around.resolution_m * gathered
    return RaisedSurface(around.corner + cube_m * (cubes + 0.5), cube_m, len(voxels))


# --- flights ---


@dataclass(frozen=True)
class SeenJoints:
    """The skeleton in an arm's pictures, at K moments."""

    t_s: Float  # [K] since the page's zero
    cameras: tuple[str, ...]
    joints: tuple[str, ...]
    pixels: Float  # [C, K, J, 2]; NaN outside the picture
    status: NDArray[np.str_]  # [C, K, J] seen, hidden or outside; empty where the joint is unknown


@dataclass(frozen=True)
class ArmTrack:
    """The flight of one arm: T times, C cameras. Angles are continuous where they are drawn over time."""

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
    commanded_yaw_deg: Float  # [T] of the formation; NaN for logged arms
    predicted_error_m: Float  # [T] NaN where the cameras determine nothing
    seen: SeenJoints | None  # None where no skeleton was known


@dataclass(frozen=True)
class CostMap:
    """Cost of a formation: M times, D yaws of its first camera over one turn, ascending."""

    t_s: Float  # [M]
    yaw_deg: Float  # [D]
    cost: Float  # [M, D]


@dataclass(frozen=True)
class Replan:
    """A comparison of planners."""

    arms: tuple[ArmTrack, ...]
    costs: CostMap | None
    around: MapAround | None
    verdict: str
    setting: str  # a sentence about the comparison
    tables: tuple[Table, ...]
    notes: tuple[str, ...]
    zones: Mapping[str, Float]  # no-fly zones by name: [K, 2] east, north


def summarise_replan(content: ReplanContent, origin_ns: int, cameras: int) -> Replan:
    """Collect everything that the page says and draws of a comparison.

    Times count from `origin_ns`; the arms' colours follow those of the session's cameras, of this number.
    """
    metrics = content.metrics
    arms = tuple(
        _arm(name, own, content, origin_ns=origin_ns, colour=cameras + k)
        for k, (name, own) in enumerate(content.arms.items())
        if len(own)
    )
    around = None
    if content.map is not None and arms:
        low, high = bounds_of(arms)
        around = map_around(content.map, low - MAP_MARGIN_M, high + MAP_MARGIN_M)
    stated = [section({"zone": zone}, "zone") for zone in items(metrics, "zones")]
    return Replan(
        arms=arms,
        costs=None if content.cost_map is None else _costs(content.cost_map, origin_ns),
        around=around,
        verdict=text(metrics, "verdict"),
        setting=_setting(metrics),
        tables=tuple(_tables(metrics)),
        notes=tuple(str(note) for note in items(metrics, "notes")),
        zones={text(zone, "name"): np.array(items(zone, "polygon_m"), dtype=np.float64) for zone in stated},
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
    commanded = np.degrees(dense("formation_yaw_rad")[0, :, 0])
    start = commanded[0] if np.isfinite(commanded[0]) else number(content.metrics, "yaw_deg") or 0.0
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
        yaw_deg=_continuous_deg(np.arctan2(offset[0, :, 1], offset[0, :, 0]), start),
        commanded_yaw_deg=commanded,
        predicted_error_m=dense("predicted_error_m")[0, :, 0],
        seen=_seen(content.seen.get(name), cameras, origin_ns),
    )


def _seen(rows: pd.DataFrame | None, cameras: tuple[str, ...], origin_ns: int) -> SeenJoints | None:
    if rows is None or not len(rows):
        return None
    t_ns, time = np.unique(rows["t_ns"].to_numpy(np.int64), return_inverse=True)
    joints = tuple(dict.fromkeys(rows["joint"]))
    camera, joint = (
        rows[column].map({name: k for k, name in enumerate(names)}).to_numpy(np.intp)
        for column, names in (("camera", cameras), ("joint", joints))
    )
    shape = (len(cameras), len(t_ns), len(joints))
    pixels, status = np.full((*shape, 2), np.nan), np.full(shape, "", dtype="<U7")
    pixels[camera, time, joint] = rows[["x", "y"]].to_numpy(np.float64)
    status[camera, time, joint] = rows["status"].to_numpy(str)
    return SeenJoints((t_ns - origin_ns) / 1e9, cameras, joints, pixels, status)


def _continuous_deg(angle_rad: Float, start_deg: float) -> Float:
    """Convert to degrees without jumps of a turn, the first within half a turn of `start_deg`; NaN stays."""
    known = np.isfinite(angle_rad)
    result = np.full(angle_rad.shape, np.nan)
    if known.any():
        degrees = np.degrees(np.unwrap(angle_rad[known]))
        result[known] = degrees - 360.0 * np.round((degrees[0] - start_deg) / 360.0)
    return result


def _costs(rows: pd.DataFrame, origin_ns: int) -> CostMap | None:
    t_ns, time = np.unique(rows["t_ns"].to_numpy(np.int64), return_inverse=True)
    yaw_rad, yaw = np.unique(rows["yaw_rad"].to_numpy(np.float64), return_inverse=True)
    if len(t_ns) < 2 or len(yaw_rad) < 2:
        return None
    cost = np.full((len(t_ns), len(yaw_rad)), np.nan)
    cost[time, yaw] = rows["cost"].to_numpy(np.float64)
    return CostMap((t_ns - origin_ns) / 1e9, np.degrees(yaw_rad), cost)


# --- tables ---


def _setting(metrics: Mapping[str, object]) -> str:
    """Describe the flight and the reference of its scores."""
    names = list(section(metrics, "arms"))
    flown = [name for name in names if section(section(metrics, "arms"), name).get("simulated") is False]
    drones, duration_s = number(metrics, "drones"), number(metrics, "duration_s")
    trials, skeleton = number(metrics, "trials"), text(metrics, "skeleton")
    sentences = [
        f"{plural(drones or 0, 'drone')} over {fixed(duration_s)} s, {text(metrics, 'mode') or 'replayed'}.",
        f"Simulated: {listing(name for name in names if name not in flown)}"
        + (f"; {listing(flown)} {'comes' if len(flown) == 1 else 'come'} from the log." if flown else "."),
        "No skeleton was known, so there is no reconstruction error."
        if not skeleton
        else f"Every reconstruction error is simulated: {plural(trials or 0, 'draw')} of noise, filming "
        + ("the true skeleton." if skeleton == "truth" else f"the skeleton of {skeleton}."),
    ]
    return " ".join(sentences)


_HIDDEN_COLUMN = Column("Hidden", "share of time")
_ERROR_COLUMNS = (
    Column("PCK150", "of all joints, %"),
    Column("MPJPE", "simulated, mm"),
    Column("Measured", "joints, %"),
)
_ARM_COLUMNS = (
    Column("Arm", text=True),
    Column("Flight", text=True),
    Column("Tilt", "mean, deg"),
    Column("Tilt", "largest, deg"),
    Column("Tilt", "near obstacles, deg"),
    Column("Drones"),
    _HIDDEN_COLUMN,
    Column("Range", "m"),
    Column("Way", "of a drone, m"),
    Column("Energy", "of a drone, modelled, kJ"),
    Column("Clearance", "least, m"),
    Column("Separation", "least, m"),
    Column("Predicted", "error, cm"),
    *_ERROR_COLUMNS,
    Column("Limits", "broken", text=True),
)


def _tables(metrics: Mapping[str, object]) -> list[Table]:
    """Make the tables of the arms, of people, and of the differences between arms."""
    stated = section(metrics, "arms")
    groups = [section({"group": group}, "group") for group in items(metrics, "equal_ranges")]
    near_first = [str(name) for group in groups for name in items(group, "arms")]
    names = near_first if set(near_first) == set(stated) else list(stated)  # as older versions stored
    share = number(section(metrics, "intervals"), "level")
    level = ABSENT if share is None else f"{100 * share:g}{THIN}%"
    people = [
        [arm, person, *_of_person(section(by_person, person))]
        for arm in names
        for by_person in [section(section(stated, arm), "by_person")]
        for person in by_person
    ]
    differences = [section({"one": one}, "one") for one in items(metrics, "differences")]
    found = [
        Table(
            "arms",
            f"The arms. Below a value its {level} interval, over draws of noise. MPJPE is that of the joints"
            " that all arms measured; PCK150 is the share of all joints that are within 150 mm, and a joint"
            " that was not measured counts as wrong.",
            _ARM_COLUMNS,
            [_arm_row(name, section(stated, name)) for name in names],
            "arms",
        ),
        Table(
            "arms-people",
            "By person. Hidden counts times out of view, too.",
            (
                Column("Arm", text=True),
                Column("Person", text=True),
                _HIDDEN_COLUMN,
                *_ERROR_COLUMNS,
                Column("View quality"),
            ),
            people,
            "measures arms",
        ),
        Table(
            "differences",
            f"One arm less another, and the {level} interval of the difference: the arms differ where it does"
            " not contain 0. Errors are those of the joint-frames that all arms measured.",
            (
                Column("Arms", text=True),
                Column("Tilt", "deg"),
                Column("Hidden", "points of %"),
                Column("PCK150", "of all joints, points of %"),
                Column("MPJPE", "simulated, mm"),
                Column("Measured", "joints, points of %"),
            ),
            [
                [
                    f"{text(one, 'arm')} less {text(one, 'against')}",
                    *(
                        _estimate(section(one, key), scale, digits=2, signed=True)
                        for key, scale in (
                            *(("tilt_deg", 1.0), ("occluded_share", 100.0), ("pck150", 100.0)),
                            *(("mpjpe_mm", 1.0), ("coverage", 100.0)),
                        )
                    ),
                ]
                for one in differences
            ],
            "measures arms",
        ),
    ]
    return [one for one in found if one.rows or one.key == "arms"]


def _arm_row(name: str, stated: Mapping[str, object]) -> list[Any]:
    tilt, predicted_m = section(stated, "tilt_deg"), number(section(stated, "predicted_error_m"), "median")
    least, most = (number(section(stated, "range_m"), key) for key in ("min", "max"))
    violations = section(stated, "limit_violations")
    broken = [f"{kind} {fixed(count, 0)}" for kind in violations if (count := number(violations, kind))]
    return [
        name,
        "as logged" if stated.get("simulated") is False else "simulated",
        *(fixed(number(tilt, key)) for key in ("mean", "max", "near_obstacle")),
        fixed(number(stated, "drones"), 0),
        _hidden(stated),
        ABSENT if least is None else f"{fixed(least)} to {fixed(most)}",
        fixed(number(stated, "path_m"), 0),
        *(fixed(number(stated, key)) for key in ("energy_kj", "min_clearance_m", "min_separation_m")),
        fixed(None if predicted_m is None else 100 * predicted_m),
        *_errors(section(stated, "reconstruction_error")),
        ", ".join(broken) or "none",
    ]


def _of_person(stated: Mapping[str, object]) -> list[Any]:
    return [_hidden(stated), *_errors(stated), fixed(number(stated, "view_quality"), 3)]


def _hidden(stated: Mapping[str, object]) -> tuple[str, str]:
    blind_s = number(stated, "blind_s")
    return percent(number(stated, "occluded_share")), "" if blind_s is None else f"{fixed(blind_s)} s blind"


def _errors(stated: Mapping[str, object]) -> list[tuple[str, str]]:
    scales = {"pck150": 100.0, "mpjpe_mm": 1.0, "coverage": 100.0}
    return [_estimate(section(stated, key), scale) for key, scale in scales.items()]


def _estimate(
    stated: Mapping[str, object], scale: float = 1.0, *, digits: int = 1, signed: bool = False
) -> tuple[str, str]:
    ends = [float(end) for end in items(stated, "interval") if isinstance(end, int | float)]
    interval = (scale * ends[0], scale * ends[1]) if len(ends) == 2 else None
    mean = number(stated, "mean")
    return with_interval(None if mean is None else scale * mean, interval, digits, signed=signed)


# --- figures ---


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


def _span_s(arms: tuple[ArmTrack, ...]) -> tuple[float, float]:
    """Return the first and the last moment, or a tenth of a second around a single one."""
    first, last = min(float(arm.t_s[0]) for arm in arms), max(float(arm.t_s[-1]) for arm in arms)
    return (first, last) if last > first else (first - 0.05, last + 0.05)


def _drawn_words(step: int, noun: str) -> str:
    return f" One {noun} in {step} is drawn." if step > 1 else ""


def draw_arms_over_time(arms: tuple[ArmTrack, ...]) -> Plate:
    """Draw four strips, one below the other, over the same time."""
    bands: dict[str, list[Line]] = {"tilt_deg": [], "range_m": []}
    errors, hidden, rows = [], [], {}
    strips = 0
    for arm in arms:
        colour = CAMERAS[arm.colour]
        starts = np.arange(0, len(arm.t_s), stride_for(len(arm.t_s)))
        t_s = _means(arm.t_s, starts)
        for key, lines in bands.items():
            values: Float = getattr(arm, key)
            low = np.minimum.reduceat(values.min(axis=0), starts)
            high = np.maximum.reduceat(values.max(axis=0), starts)
            lines.append(Line(t_s, _means(values.mean(axis=0), starts), colour, low=low, high=high))
        errors.append(Line(t_s, _means(100 * arm.predicted_error_m, starts), colour, shortened(arm.name)))
        rows[strips + (len(arm.cameras) - 1) / 2] = shortened(arm.name)
        for seen in arm.visible:
            spans = np.array(hidden_spans(arm.t_s, seen)).reshape(-1, 2)
            lasting = np.diff(spans, axis=1)[:, 0]
            hidden.append(Bars([strips] * len(spans), spans[:, 0].tolist(), lasting.tolist(), colour))
            strips += 1
    heights_in = [1.35, 1.15, 0.3 + 0.085 * strips, 1.15]
    top = _top(arms)
    error = Panel(errors, "time (s)", "predicted\nerror (cm)", x_span=_span_s(arms), y_span=(0, top))
    panels = [
        [Panel(bands["tilt_deg"], y_label="tilt (deg)")],
        [Panel(bands["range_m"], y_label="range (m)")],
        [Panel(hidden, y_label="hidden", rows=rows, row_span=(strips - 0.4, -0.6), grid="x")],
        [error],
    ]
    figure = chart(panels, 0.7 + sum(heights_in), heights=heights_in, columns=len(arms))
    caption = (
        "Above: tilt of the cameras over the actor and their range, the mean of an arm's drones as a line "
        "and all of them within the band. Middle: a row per drone, drawn while something stands between it "
        "and the actor. Below: the error to be expected of the position from all cameras together; "
        "no line where they determine none."
    )
    step = stride_for(len(arms[0].t_s))
    if step > 1:
        caption += f" A point of a line stands for {step} poses, the band holds them all."
    if any(np.nanmax(arm.predicted_error_m, initial=0.0) * 100 > top for arm in arms):
        caption += f" Errors above {quantity(top, 'cm', 0)} are cut off."
    numbers = stacked(
        [
            table(
                arm=arm.name,
                camera=np.repeat(arm.cameras, len(arm.t_s)),
                t_s=np.tile(arm.t_s, len(arm.cameras)),
                tilt_deg=arm.tilt_deg.ravel(),
                range_m=arm.range_m.ravel(),
                hidden=(~arm.visible).ravel().astype(int),
                predicted_error_cm=np.tile(100 * arm.predicted_error_m, len(arm.cameras)),
            )
            for arm in arms
        ]
    )
    title = "Tilt, range, sight and predicted error over time"
    words = " ".join(_describe_over_time(arm) for arm in arms)
    return Plate("arms-time", title, caption, words, figure, {"": numbers})


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


def _describe_over_time(arm: ArmTrack) -> str:
    known = arm.predicted_error_m[np.isfinite(arm.predicted_error_m)]
    median_cm = 100 * float(np.median(known)) if len(known) else None
    return (
        f"{arm.name}: tilt {quantity(float(arm.tilt_deg.mean()), 'deg')} on average and "
        f"{quantity(float(arm.tilt_deg.max()), 'deg')} at most, range {fixed(float(arm.range_m.min()))} to "
        f"{quantity(float(arm.range_m.max()), 'm')}, hidden {percent(float((~arm.visible).mean()))} of the "
        f"time, predicted error {quantity(median_cm, 'cm')} (median)."
    )


# --- from above ---


def keyframes(arm: ArmTrack) -> NDArray[np.intp]:
    """Return the rows of an arm's keyframes: evenly spread, with the first and the last."""
    return np.unique(np.round(np.linspace(0, len(arm.t_s) - 1, KEYFRAMES)).astype(np.intp))


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
    ground = None if replan.around is None else heights(replan.around)
    levels = [] if ground is None else [m for m in HEIGHT_LEVELS_M if ground.above_m.max() >= m]
    with page_style():
        figure = new_figure(0.75 + rows * (height_in + 0.25))
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for k, axes in enumerate(panels.flat):
            if k >= len(arms):
                axes.set_visible(False)
                continue
            axes.set_xlim(low[0] - origin[0], high[0] - origin[0])
            axes.set_ylim(low[1] - origin[1], high[1] - origin[1])
            axes.set_aspect("equal")
            axes.grid(visible=True)
            if ground is not None and min(ground.above_m.shape) >= 2:
                shade(axes, ground.east_m - origin[0], ground.north_m - origin[1], ground.above_m, levels)
            _draw_arm(axes, arms[k], origin)
            axes.set_title(shortened(arms[k].name), fontsize=8.2, color=CAMERAS[arms[k].colour], loc="left")
            for corners in replan.zones.values():
                closed = (np.concatenate([corners, corners[:1]]) - origin).T
                style = {"facecolor": "none", "edgecolor": _HIDDEN, "hatch": _ZONE_HATCH}
                axes.fill(*closed, linewidth=0.9, zorder=2, **style)
            if k + columns >= len(arms):
                axes.set_xlabel(axis_label("east", origin[0]))
                axes.tick_params(labelbottom=True)
            if k % columns == 0:
                axes.set_ylabel(axis_label("north", origin[1]))
            quiet(axes)
        _legend_from_above(figure, replan, levels)
    numbers = {"": stacked([_numbers_from_above(arm) for arm in arms])}
    if ground is not None:
        east_m, north_m = np.meshgrid(ground.east_m, ground.north_m, indexing="ij")
        numbers["heights"] = table(
            east_m=east_m.ravel(), north_m=north_m.ravel(), above_ground_m=ground.above_m.ravel()
        )
    words = " ".join(_describe_from_above(arm) for arm in arms)
    return Plate(
        "arms-top", "The arms from above", _caption_from_above(replan, levels), words, figure, numbers
    )


def _draw_arm(axes: Axes, arm: ArmTrack, origin: Float) -> None:
    stride, chosen, colour = stride_for(len(arm.t_s)), keyframes(arm), CAMERAS[arm.colour]
    actor, places = arm.actor[:, :2] - origin, arm.position[..., :2] - origin
    for c, path in enumerate([actor, *places]):
        own = INK if c == 0 else colour
        style: dict[str, Any] = (
            {"linewidth": 1.8} if c == 0 else {"linestyle": LINE_STYLES[(c - 1) % len(LINE_STYLES)]}
        )
        axes.plot(*path[::stride].T, color=own, zorder=4, **style)
        axes.plot(*path[chosen].T, "o", color=own, markersize=2.6, zorder=5)
        axes.plot(*path[:1].T, "o", color=own, markerfacecolor=PAPER, markersize=4.2, zorder=6)
    for c, path in enumerate(places):
        for k in chosen:
            free = {"color": colour, "linestyle": "-", "linewidth": 0.7, "alpha": 0.7}
            blocked = {"color": _HIDDEN, "linestyle": LINE_STYLES[2], "linewidth": 1.1}
            style = free if arm.visible[c, k] else blocked
            axes.plot(*np.stack([path[k], actor[k]]).T, zorder=3, **style)
    for k in chosen:
        if np.isfinite(places[0, k]).all() and np.isfinite(actor[k]).all():
            outward = places[0, k] - actor[k]
            outward = 7.5 * outward / max(float(np.sqrt((outward**2).sum())), 1e-9)
            axes.annotate(
                fixed(float(arm.t_s[k]), 0),
                (float(places[0, k, 0]), float(places[0, k, 1])),
                (float(outward[0]), float(outward[1])),
                textcoords="offset points",
                fontsize=6.4,
                color=MUTED,
                ha="center",
                va="center",
                zorder=7,
            )


def _legend_from_above(figure: Figure, replan: Replan, levels: list[float]) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    arms = replan.arms
    entries: list[Line2D | Patch] = [Line2D([], [], color=INK, linewidth=1.8, label="actor")]
    entries += [
        Line2D([], [], color=MUTED, linestyle=LINE_STYLES[c % len(LINE_STYLES)], label=shortened(name))
        for c, name in enumerate(max(arms, key=lambda arm: len(arm.cameras)).cameras)
    ]
    if not all(arm.visible[:, keyframes(arm)].all() for arm in arms):
        entries.append(Line2D([], [], color=_HIDDEN, linestyle=LINE_STYLES[2], linewidth=1.0, label="hidden"))
    if replan.zones:
        entries.append(Patch(facecolor="none", edgecolor=_HIDDEN, hatch=_ZONE_HATCH, label="no-fly zone"))
    entries += shade_keys([f"above {level:g} m" for level in levels])
    figure.legend(handles=entries, loc="outside upper left", ncols=len(entries) if len(entries) <= 8 else 6)


def _caption_from_above(replan: Replan, levels: list[float]) -> str:
    caption = (
        f"Paths of the drones and of the actor (thick); open circles mark the start. At {KEYFRAMES} moments, "
        "whose seconds stand beside the first drone, a line leads from each drone to the actor: "
        "red and dotted where something stands in the sight line."
    )
    if replan.around is not None:
        caption += (
            " Shades: how high the map's highest occupied voxel reaches above the ground, "
            f"which is at {quantity(replan.around.ground_m, 'm', 2)}."
            if levels
            else f" Nothing in the map rises {quantity(LOWEST_OBSTACLE_M, 'm')} above the ground."
        )
    if replan.zones:
        caption += f" Hatched: {plural(len(replan.zones), 'no-fly zone')} ({listing(replan.zones)})."
    return caption + _drawn_words(stride_for(len(replan.arms[0].t_s)), "pose")


def _numbers_from_above(arm: ArmTrack) -> pd.DataFrame:
    """Tabulate the paths of an arm, and its hidden sight lines."""
    tracks = [*zip(arm.cameras, arm.position, (~arm.visible).astype(int), strict=True)]
    return stacked(
        [
            table(arm=arm.name, who=who, t_s=arm.t_s, east_m=path[:, 0], north_m=path[:, 1], hidden=hidden)
            for who, path, hidden in [*tracks, ("actor", arm.actor, np.full(len(arm.t_s), np.nan))]
        ]
    )


def _describe_from_above(arm: ArmTrack) -> str:
    paths = zip(arm.cameras, arm.position, strict=True)
    ways = [f"{name} {quantity(way_m(path), 'm')}" for name, path in paths]
    chosen = keyframes(arm)
    hidden = int((~arm.visible[:, chosen]).sum())
    return (
        f"{arm.name}: {listing(ways)} over ground, the actor {quantity(way_m(arm.actor), 'm')}; "
        f"{hidden} of {plural(len(arm.cameras) * len(chosen), 'sight line')} hidden."
    )


# --- yaw ---


def draw_yaw(arms: tuple[ArmTrack, ...], costs: CostMap | None) -> Plate:
    """Draw all arms in one figure; without a cost map their yaws alone."""
    everything = np.concatenate([line for arm in arms for line in (arm.yaw_deg, arm.commanded_yaw_deg)])
    known = everything[np.isfinite(everything)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    spare = max(360.0 - (high - low), 40.0) / 2  # one turn at least
    low, high = low - spare, high + spare
    with page_style():
        figure = new_figure(3.3)
        axes = figure.subplots()
        levels, step = ([], 1) if costs is None else _draw_costs(axes, costs, low, high)
        for arm in arms:
            rows = slice(None, None, stride_for(len(arm.t_s)))
            t_s, colour, name = arm.t_s[rows], CAMERAS[arm.colour], shortened(arm.name)
            if np.isfinite(arm.commanded_yaw_deg).any():
                axes.plot(t_s, arm.commanded_yaw_deg[rows], color=PAPER, linewidth=3.0, zorder=3)
                axes.plot(t_s, arm.commanded_yaw_deg[rows], color=colour, linewidth=1.6, zorder=4, label=name)
                name = ""
            style: dict[str, Any] = {"color": colour, "linewidth": 0.9, "linestyle": LINE_STYLES[1]}
            axes.plot(t_s, arm.yaw_deg[rows], zorder=4, label=name or None, **style)
        axes.set_ylim(low, high)
        axes.set_yticks(np.arange(np.ceil(low / 90) * 90, high, 90))
        axes.set_xlim(*_span_s(arms))
        axes.set_xlabel("time (s)")
        axes.set_ylabel("formation yaw (deg)")
        quiet(axes, "y")
        entries, _ = axes.get_legend_handles_labels()
        words = [significant(level, 2) for level in levels]
        entries += shade_keys([f"cost above {word}" if k == 0 else word for k, word in enumerate(words)])
        figure.legend(handles=entries, loc="outside upper left", ncols=len(entries))
    caption = (
        "Solid: the yaw that an arm chose for its first drone, counterclockwise from east and without "
        "jumps of a turn; dashed: where that drone was."
    )
    numbers = {
        "": stacked(
            [
                table(
                    arm=arm.name,
                    t_s=arm.t_s,
                    yaw_deg=arm.yaw_deg,
                    commanded_yaw_deg=arm.commanded_yaw_deg,
                )
                for arm in arms
            ]
        )
    }
    if costs is not None:
        caption += (
            " Shades: what a formation at the stated tilt and radius would cost there, the stronger the "
            "more; it repeats after a full turn."
            if levels
            else " Every yaw would have cost the same at any time."
        )
        caption += _drawn_words(step, "column")
        t_s, yaw_deg = np.repeat(costs.t_s, len(costs.yaw_deg)), np.tile(costs.yaw_deg, len(costs.t_s))
        numbers["costs"] = table(t_s=t_s, yaw_deg=yaw_deg, cost=costs.cost.ravel())
    title = "The formation's yaw" + ("" if costs is None else " over what it would cost")
    return Plate("arms-yaw", title, caption, " ".join(map(_describe_yaw, arms)), figure, numbers)


def _draw_costs(axes: Axes, costs: CostMap, low: float, high: float) -> tuple[list[float], int]:
    """Shade the cost map over all drawn turns; return its levels, and the stride of the drawn times."""
    from matplotlib.ticker import MaxNLocator

    step = stride_for(len(costs.t_s), MAX_COST_TIMES)
    t_s, cost = costs.t_s[::step], costs.cost[::step]
    least, most = float(np.nanmin(cost)), float(np.nanpercentile(cost, 98))
    levels = [float(v) for v in MaxNLocator(5).tick_values(least, most) if least < v < float(np.nanmax(cost))]
    if most <= least or not levels:
        return [], step
    turns = range(int(np.floor((low - costs.yaw_deg[0]) / 360.0)) - 1, int(np.ceil(high / 360.0)) + 2)
    yaw_deg = np.concatenate([costs.yaw_deg + 360.0 * turn for turn in turns])
    drawn = (yaw_deg > low - 20) & (yaw_deg < high + 20)
    shade(axes, t_s, yaw_deg[drawn], np.tile(cost, (1, len(turns)))[:, drawn], levels)
    return levels, step


def _describe_yaw(arm: ArmTrack) -> str:
    chosen = arm.commanded_yaw_deg[np.isfinite(arm.commanded_yaw_deg)]
    found = chosen if len(chosen) else arm.yaw_deg[np.isfinite(arm.yaw_deg)]
    if not len(found):
        return f"{arm.name}: nothing is known of its yaw."
    way = sum(abs(b - a) for a, b in pairwise(found.tolist()))
    return (
        f"{arm.name}: from {quantity(float(found[0]), 'deg')} to {quantity(float(found[-1]), 'deg')}, "
        f"turning by {quantity(way, 'deg')} in all."
    )


# --- as the cameras see the actor ---


def draw_as_seen(replan: Replan) -> Plate | None:
    """Draw a panel for every arm and camera at a few moments; None where no skeleton was known."""
    looks = [(arm, arm.seen) for arm in replan.arms if arm.seen is not None and len(arm.seen.t_s)]
    if not looks:
        return None
    chosen = moments(looks)
    side_px = SEEN_ROOM * max(_largest_px(seen) for _, seen in looks)
    columns = min(SEEN_CAMERAS, max(len(seen.cameras) for _, seen in looks))
    panel_in = (WIDTH_IN - 0.3) / (len(chosen) * columns)
    with page_style():
        figure = new_figure(0.5 + len(looks) * (panel_in + 0.2))
        panels = figure.subplots(len(looks), len(chosen) * columns, squeeze=False)
        for row, (arm, seen) in zip(panels, looks, strict=True):
            for k, at_s in enumerate(chosen.tolist()):
                at = int(_nearest(seen.t_s, np.array([at_s]))[0])
                for c in range(columns):
                    axes = row[k * columns + c]
                    _draw_seen(axes, arm, seen, c, at, side_px)
                    if arm is looks[-1][0] and c == 0:
                        axes.set_xlabel(f"at {quantity(at_s, 's', 0)}", loc="left")
            row[0].set_ylabel(shortened(arm.name), color=CAMERAS[arm.colour], fontsize=8.2)
        style: dict[str, Any] = {"marker": "o", "markersize": 2.6}
        panels[0, 0].plot([], [], color=MUTED, label="seen, in the arm's colour", **style)
        hidden: dict[str, Any] = {"markerfacecolor": PAPER, "linestyle": LINE_STYLES[2], "label": "hidden"}
        panels[0, 0].plot([], [], color=_HIDDEN, **hidden, **style)
        figure.legend(loc="outside upper left", ncols=2)
    skipped = max(len(seen.cameras) for _, seen in looks) > columns
    caption = (
        "The skeleton in the pictures of each arm's cameras, all enlarged alike"
        + (f" (the first {columns} cameras)" if skipped else "")
        + ", with its tilt over the actor and how many joints it sees. Each quarter of the flight is shown "
        "at the moment when the arms differ most in the joints that they do not see; of several such "
        "moments, in their largest tilts. Open and dotted: hidden by an obstacle; joints outside the picture "
        "are left out. Computed from map and field of view, without a detector's errors."
    )
    words, numbers = [], []
    for arm, seen in looks:
        known = seen.status != ""
        count = {word: int((seen.status == word).sum()) for word in ("seen", "hidden", "outside")}
        shares = listing(f"{plural(n, 'joint')} {word}" for word, n in count.items())
        words.append(f"{arm.name}: of {int(known.sum())} in {plural(len(seen.t_s), 'look')}, {shares}.")
        camera, time, joint = np.nonzero(known)
        numbers.append(
            table(
                arm=arm.name,
                camera=np.array(seen.cameras)[camera],
                t_s=seen.t_s[time],
                joint=np.array(seen.joints)[joint],
                x_px=seen.pixels[camera, time, joint, 0],
                y_px=seen.pixels[camera, time, joint, 1],
                status=seen.status[camera, time, joint],
            )
        )
    title = "The actor as each arm would have seen it"
    return Plate("arms-seen", title, caption, " ".join(words), figure, {"": stacked(numbers)})


def moments(looks: list[tuple[ArmTrack, SeenJoints]]) -> Float:
    """Choose the moment of each equal part of the flight at which the arms differ most.

    They differ by the joints that their drawn cameras lose; of several such moments, by their largest tilts;
    then the moment with most lost joints is taken. A single arm is shown where it loses most.
    """
    t_s = looks[0][1].t_s
    lost, tilt_deg = np.zeros((len(looks), len(t_s))), np.zeros((len(looks), len(t_s)))
    for a, (arm, seen) in enumerate(looks):
        missing = (seen.status[:SEEN_CAMERAS] != "") & (seen.status[:SEEN_CAMERAS] != "seen")
        flown_deg = np.nan_to_num(arm.tilt_deg[:SEEN_CAMERAS, _nearest(arm.t_s, seen.t_s)]).max(axis=0)
        at = _nearest(seen.t_s, t_s)
        lost[a], tilt_deg[a] = missing.sum(axis=(0, 2))[at], flown_deg[at]
    spread = np.ptp(tilt_deg, axis=0) if len(looks) > 1 else tilt_deg[0]
    order = (lost.sum(axis=0), spread, np.ptp(lost, axis=0) if len(looks) > 1 else lost[0])
    parts = [part for part in np.array_split(np.arange(len(t_s)), SEEN_MOMENTS) if len(part)]
    return np.array([t_s[part[np.lexsort([each[part] for each in order])[-1]]] for part in parts])


def _nearest(t_s: Float, wanted_s: Float) -> Int64:
    """Find the rows of ascending times that are nearest to others."""
    places: Int64 = np.abs(t_s[:, None] - wanted_s).argmin(axis=0)
    return places


def _largest_px(seen: SeenJoints) -> float:
    """Return the longest side of any person's box, px."""
    flat = seen.pixels.reshape(-1, len(seen.joints), 2)
    flat = flat[np.isfinite(flat).any(axis=(1, 2))]
    return max(float((np.nanmax(flat, axis=1) - np.nanmin(flat, axis=1)).max()), 1.0) if len(flat) else 1.0


def _draw_seen(axes: Axes, arm: ArmTrack, seen: SeenJoints, camera: int, at: int, side_px: float) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():  # a picture's edge in place of axes
        spine.set_visible(True)
        spine.set_color(GRID)
    axes.set_aspect("equal")
    if camera >= len(seen.cameras):
        axes.set_visible(False)
        return
    pixels, status = seen.pixels[camera, at], seen.status[camera, at]
    inside = np.isfinite(pixels[:, 0])
    ends = pixels[inside]
    middle = (ends.max(axis=0) + ends.min(axis=0)) / 2 if len(ends) else np.zeros(2)
    axes.set_xlim(middle[0] - side_px / 2, middle[0] + side_px / 2)
    axes.set_ylim(middle[1] + side_px / 2, middle[1] - side_px / 2)  # rows count downwards
    colour, place = CAMERAS[arm.colour], {joint: k for k, joint in enumerate(seen.joints)}
    for a, b in bones_of(seen.joints):
        bone = [place[a], place[b]]
        if inside[bone].all():
            free = (status[bone] == "seen").all()
            axes.plot(
                *pixels[bone].T,
                color=colour if free else _HIDDEN,
                linestyle="-" if free else LINE_STYLES[2],
                linewidth=1.2 if free else 0.8,
                zorder=2,
            )
    axes.plot(*pixels[status == "seen"].T, "o", color=colour, markersize=2.2, zorder=3)
    open_circle: dict[str, Any] = {"markersize": 2.2, "markerfacecolor": PAPER, "markeredgewidth": 0.7}
    axes.plot(*pixels[status == "hidden"].T, "o", color=_HIDDEN, zorder=3, **open_circle)
    found, known = int((status == "seen").sum()), int((status != "").sum())
    tilt_deg = float(arm.tilt_deg[camera, _nearest(arm.t_s, seen.t_s[at : at + 1])[0]])
    words = f"{shortened(seen.cameras[camera])}, {quantity(tilt_deg, 'deg', 0)}"
    axes.set_title(words, fontsize=6.4, loc="left", pad=2, color=MUTED)
    style: dict[str, Any] = {"transform": axes.transAxes, "fontsize": 6.4, "ha": "right"}
    axes.text(0.97, 0.03, f"{found} of {known}", color=_HIDDEN if found < known else MUTED, **style)
