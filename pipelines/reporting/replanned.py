"""The comparison of planners in numbers: the flight of every arm, and the rows of its tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Int64
from pipelines.reporting.content import ReplanContent, items, number, section, text
from pipelines.reporting.plates import bounds
from pipelines.reporting.terrain import Terrain, terrain_around
from pipelines.reporting.wording import ABSENT, THIN, fixed, listing, percent, plural

if TYPE_CHECKING:
    import pandas as pd

_MARGIN_M = 12.0  # of the map that is shown around the flight


@dataclass(frozen=True)
class Seen:
    """The skeleton in an arm's pictures, at K moments."""

    t_s: Float  # [K] since the page's zero
    cameras: tuple[str, ...]
    joints: tuple[str, ...]
    pixels: Float  # [C, K, J, 2]; NaN outside the picture
    status: NDArray[np.str_]  # [C, K, J] seen, hidden or outside; empty where the joint is unknown


@dataclass(frozen=True)
class Arm:
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
    seen: Seen | None  # None where no skeleton was known


@dataclass(frozen=True)
class CostMap:
    """Cost of a formation: M times, D yaws of its first camera over one turn, ascending."""

    t_s: Float  # [M]
    yaw_deg: Float  # [D]
    cost: Float  # [M, D]


@dataclass(frozen=True)
class ArmRow:
    """One arm in the table; numbers as they are printed."""

    name: str
    simulated: bool
    tilt_deg: tuple[str, str, str]  # mean, largest, mean near an obstacle
    drones: str
    hidden: tuple[str, str]  # share of the time, and seconds in which fewer than two drones see
    range_m: str
    path_m: str
    energy_kj: str
    clearance_m: str
    separation_m: str
    predicted_cm: str
    right: tuple[str, str]  # % of all joint-frames within 150 mm, and its interval
    error: tuple[str, str]  # mm, and its interval
    coverage: tuple[str, str]
    violations: str


@dataclass(frozen=True)
class PersonRow:
    """Figures of one of several people in one arm; numbers as they are printed."""

    arm: str
    person: str
    hidden: tuple[str, str]
    right: tuple[str, str]
    error: tuple[str, str]
    coverage: tuple[str, str]
    view_quality: str


@dataclass(frozen=True)
class DifferenceRow:
    """Difference of one arm from another: the mean and the interval of each figure."""

    names: tuple[str, str]
    tilt_deg: tuple[str, str]
    hidden: tuple[str, str]
    right: tuple[str, str]
    error: tuple[str, str]
    coverage: tuple[str, str]


@dataclass(frozen=True)
class NoFlyZone:
    """No-fly zone as it is drawn from above."""

    name: str
    polygon_m: Float  # [K, 2] east, north


@dataclass(frozen=True)
class Replan:
    """A comparison of planners."""

    arms: tuple[Arm, ...]
    costs: CostMap | None
    terrain: Terrain | None
    verdict: str
    setting: str  # a sentence about the comparison
    rows: tuple[ArmRow, ...]
    people: tuple[PersonRow, ...]  # empty for one person
    differences: tuple[DifferenceRow, ...]
    level: str  # of the intervals
    notes: tuple[str, ...]
    zones: tuple[NoFlyZone, ...] = ()


def summarise_replan(content: ReplanContent, origin_ns: int, cameras: int) -> Replan:
    """Collect everything that the page says and draws of a comparison.

    Times count from `origin_ns`; the arms' colours follow those of the session's cameras, of this number.
    """
    metrics = content.metrics
    stated = section(metrics, "arms")
    near_first = _by_range(metrics, stated)
    arms = tuple(
        _arm(name, table, content, origin_ns=origin_ns, colour=cameras + k)
        for k, (name, table) in enumerate(content.arms.items())
        if len(table)
    )
    return Replan(
        arms=arms,
        costs=None if content.cost_map is None else _costs(content.cost_map, origin_ns),
        terrain=_terrain(content, arms),
        verdict=text(metrics, "verdict"),
        setting=_setting(metrics),
        rows=tuple(_row(name, section(stated, name)) for name in near_first),
        people=tuple(
            _person(name, person, section(by_person, person))
            for name in near_first
            for by_person in [section(section(stated, name), "by_person")]
            for person in by_person
        ),
        differences=tuple(_difference(found) for found in items(metrics, "differences")),
        level=_level(number(section(metrics, "intervals"), "level")),
        notes=tuple(str(note) for note in items(metrics, "notes")),
        zones=tuple(_zone(stated) for stated in items(metrics, "zones")),
    )


def bounds_of(arms: tuple[Arm, ...]) -> tuple[Float, Float]:
    """Return the corners [2] of the box that holds all arms and the actor, seen from above, in m."""
    return bounds([path[..., :2].reshape(-1, 2) for arm in arms for path in (arm.position, arm.actor)])


def span_s(arms: tuple[Arm, ...]) -> tuple[float, float]:
    """Return the first and the last moment, or a tenth of a second around a single one."""
    first, last = min(float(arm.t_s[0]) for arm in arms), max(float(arm.t_s[-1]) for arm in arms)
    return (first, last) if last > first else (first - 0.05, last + 0.05)


# --- tracks --------------------------------------------------------------------------------------------


def _arm(name: str, table: pd.DataFrame, content: ReplanContent, *, origin_ns: int, colour: int) -> Arm:
    t_ns, time = np.unique(table["t_ns"].to_numpy(np.int64), return_inverse=True)
    cameras = tuple(dict.fromkeys(table["camera"]))
    camera = table["camera"].map({name: k for k, name in enumerate(cameras)}).to_numpy(np.intp)

    def dense(*columns: str) -> Float:
        values = np.full((len(cameras), len(t_ns), len(columns)), np.nan)
        values[camera, time] = table[list(columns)].to_numpy(np.float64)
        return values

    position = dense("x", "y", "z")
    actor = _at(content.actor, t_ns)
    offset = position - actor
    metrics = section(section(content.metrics, "arms"), name)
    commanded = np.degrees(dense("formation_yaw_rad")[0, :, 0])
    start = commanded[0] if np.isfinite(commanded[0]) else number(content.metrics, "yaw_deg") or 0.0
    return Arm(
        name=name,
        simulated=metrics.get("simulated") is not False,
        colour=colour % 6,
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


def _seen(table: pd.DataFrame | None, cameras: tuple[str, ...], origin_ns: int) -> Seen | None:
    if table is None or not len(table):
        return None
    t_ns, time = np.unique(table["t_ns"].to_numpy(np.int64), return_inverse=True)
    joints = tuple(dict.fromkeys(table["joint"]))
    camera, joint = (
        table[column].map({name: k for k, name in enumerate(names)}).to_numpy(np.intp)
        for column, names in (("camera", cameras), ("joint", joints))
    )
    shape = (len(cameras), len(t_ns), len(joints))
    pixels, status = np.full((*shape, 2), np.nan), np.full(shape, "", dtype="<U7")
    pixels[camera, time, joint] = table[["x", "y"]].to_numpy(np.float64)
    status[camera, time, joint] = table["status"].to_numpy(str)
    return Seen((t_ns - origin_ns) / 1e9, cameras, joints, pixels, status)


def _at(actor: pd.DataFrame, t_ns: Int64) -> Float:
    """Interpolate the actor [T, 3] at the times of an arm."""
    stamps = actor["t_ns"].to_numpy(np.int64)
    seconds, wanted = (stamps - t_ns[0]) / 1e9, (t_ns - t_ns[0]) / 1e9
    return np.stack([np.interp(wanted, seconds, actor[axis].to_numpy(np.float64)) for axis in "xyz"], axis=-1)


def _continuous_deg(angle_rad: Float, start_deg: float) -> Float:
    """Convert to degrees without jumps of a turn; NaN stays NaN.

    The first one is within half a turn of `start_deg`.
    """
    known = np.isfinite(angle_rad)
    result = np.full(angle_rad.shape, np.nan)
    if known.any():
        degrees = np.degrees(np.unwrap(angle_rad[known]))
        result[known] = degrees - 360.0 * np.round((degrees[0] - start_deg) / 360.0)
    return result


def _costs(table: pd.DataFrame, origin_ns: int) -> CostMap | None:
    t_ns, time = np.unique(table["t_ns"].to_numpy(np.int64), return_inverse=True)
    yaw_rad, yaw = np.unique(table["yaw_rad"].to_numpy(np.float64), return_inverse=True)
    if len(t_ns) < 2 or len(yaw_rad) < 2:
        return None
    cost = np.full((len(t_ns), len(yaw_rad)), np.nan)
    cost[time, yaw] = table["cost"].to_numpy(np.float64)
    return CostMap((t_ns - origin_ns) / 1e9, np.degrees(yaw_rad), cost)


def _terrain(content: ReplanContent, arms: tuple[Arm, ...]) -> Terrain | None:
    if content.map is None or not arms:
        return None
    low, high = bounds_of(arms)
    return terrain_around(content.map, low - _MARGIN_M, high + _MARGIN_M)


def _zone(found: object) -> NoFlyZone:
    stated = section({"found": found}, "found")
    return NoFlyZone(text(stated, "name"), np.array(items(stated, "polygon_m"), dtype=np.float64))


# --- tables --------------------------------------------------------------------------------------------


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


def _by_range(metrics: Mapping[str, object], stated: Mapping[str, object]) -> list[str]:
    """List the arms from near to far, those of equal range beside each other; as stored by older versions."""
    groups = items(metrics, "equal_ranges")
    named = [str(name) for group in groups for name in items(section({"group": group}, "group"), "arms")]
    return named if set(named) == set(stated) else list(stated)


def _level(level: float | None) -> str:
    return ABSENT if level is None else f"{100 * level:g}{THIN}%"


def _row(name: str, stated: Mapping[str, object]) -> ArmRow:
    tilt, errors = section(stated, "tilt_deg"), section(stated, "reconstruction_error")
    predicted_m = number(section(stated, "predicted_error_m"), "median")
    least, most = (number(section(stated, "range_m"), key) for key in ("min", "max"))
    violations = section(stated, "limit_violations")
    broken = [f"{kind} {fixed(count, 0)}" for kind in violations if (count := number(violations, kind))]
    return ArmRow(
        name=name,
        simulated=stated.get("simulated") is not False,
        tilt_deg=(
            fixed(number(tilt, "mean")),
            fixed(number(tilt, "max")),
            fixed(number(tilt, "near_obstacle")),
        ),
        drones=fixed(number(stated, "drones"), 0),
        hidden=_hidden(stated),
        range_m=ABSENT if least is None else f"{fixed(least)} to {fixed(most)}",
        path_m=fixed(number(stated, "path_m"), 0),
        energy_kj=fixed(number(stated, "energy_kj")),
        clearance_m=fixed(number(stated, "min_clearance_m")),
        separation_m=fixed(number(stated, "min_separation_m")),
        predicted_cm=fixed(None if predicted_m is None else 100 * predicted_m),
        right=_estimate(section(errors, "pck150"), 100),
        error=_estimate(section(errors, "mpjpe_mm")),
        coverage=_estimate(section(errors, "coverage"), 100),
        violations=", ".join(broken) or "none",
    )


def _person(arm: str, person: str, stated: Mapping[str, object]) -> PersonRow:
    return PersonRow(
        arm=arm,
        person=person,
        hidden=_hidden(stated),
        right=_estimate(section(stated, "pck150"), 100),
        error=_estimate(section(stated, "mpjpe_mm")),
        coverage=_estimate(section(stated, "coverage"), 100),
        view_quality=fixed(number(stated, "view_quality"), 3),
    )


def _hidden(stated: Mapping[str, object]) -> tuple[str, str]:
    blind_s = number(stated, "blind_s")
    return percent(number(stated, "occluded_share")), "" if blind_s is None else f"{fixed(blind_s)} s blind"


def _difference(found: object) -> DifferenceRow:
    stated = section({"found": found}, "found")
    return DifferenceRow(
        names=(text(stated, "arm"), text(stated, "against")),
        tilt_deg=_estimate(section(stated, "tilt_deg"), digits=2, signed=True),
        hidden=_estimate(section(stated, "occluded_share"), 100, digits=2, signed=True),
        right=_estimate(section(stated, "pck150"), 100, digits=2, signed=True),
        error=_estimate(section(stated, "mpjpe_mm"), digits=2, signed=True),
        coverage=_estimate(section(stated, "coverage"), 100, digits=2, signed=True),
    )


def _estimate(
    stated: Mapping[str, object], scale: float = 1.0, *, digits: int = 1, signed: bool = False
) -> tuple[str, str]:
    """Format a mean and its interval, `4.2` and `4.0 to 4.4`; a dash and nothing where there is none."""
    mean = number(stated, "mean")
    if mean is None:
        return ABSENT, ""
    ends = [float(end) for end in items(stated, "interval") if isinstance(end, int | float)]
    plus = "+" if signed and round(scale * mean, digits) > 0 else ""
    between = " to ".join(fixed(scale * end, digits) for end in ends) if len(ends) == 2 else ""
    return plus + fixed(scale * mean, digits), between
