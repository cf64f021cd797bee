"""Settings of a planner: weights, distances, rates. docs/planner.md explains them."""

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal, get_args

from pipelines.session.errors import DataError

MOST_DRONES = 16
Mode = Literal["plan-only", "closed-loop"]  # of a replay
Frame = Literal["world", "heading"]
_WORDS: dict[str, tuple[str, ...]] = {"yaw_frame": get_args(Frame)}
_SIGNED = ("tilt_deg",)
_NO_SETTING = "errors"
_LEAST_ZONE_M2 = 1e-6
_MAY_BE_ZERO = (
    *("w_obs", "w_occ", "w_turn", "w_error", "l_obs", "l_occ", "l_sep", "a_velocity", "a_acceleration"),
    *("speed_floor_mps", "sight_start_m", "k_integral", "actor_noise_m"),
    *("drone_radius_m", "actor_distance_m"),
)
_MOST = {
    "yaws": 360,
    "lattice_yaws": 360,
    "lattice_knots": 60,
    "horizon_knots": 60,
    "waypoints": 200,
    "iterations": 10_000,
}


@dataclass(frozen=True)
class ErrorModel:
    """Cameras for the ray model: errors of the poses and, by tilt, of a detector; and the field of view.

    A replay takes them from its session (`scene.build_scene`). The defaults are logs of usual drones, and
    BlazePose as `simulation/data/blazepose_errors.csv` has it.
    """

    position_sigma_m: float = 0.3  # per axis
    rotation_sigma_deg: float = 1.0  # per axis
    tilts_deg: tuple[float, ...] = (-0.4, 14.1, 28.9, 43.9, 59.3)  # constant beyond the ends
    keypoint_sigma_m: tuple[float, ...] = (0.0198, 0.0202, 0.0247, 0.0314, 0.0386)  # per axis, at the person
    placed_share: tuple[float, ...] = (0.990, 0.988, 0.973, 0.954, 0.842)  # of joints that are found
    fov_rad: float = math.pi / 3  # level field of view


@dataclass(frozen=True)
class Zone:
    """No-fly zone: an upright prism that drones must not enter. Nothing is hidden by it."""

    polygon_m: tuple[tuple[float, ...], ...]  # corners (east, north) of the world, at least three
    low_m: float | None = None  # None: open to below
    high_m: float | None = None
    name: str = ""


@dataclass(frozen=True)
class PlannerConfig:
    """Settings of every arm; docs/results.md measures the defaults.

    Raises:
        ValueError: an impossible value; the message names it.
    """

    # The formation.
    radius_m: float = 10.0
    tilt_deg: float = 15.0
    yaws: int = 32  # D: over a full turn, one of them the yaw of the start
    knot_s: float = 1.0
    horizon_knots: int = 10  # T
    yaw_rate_deg_per_s: float = 22.5
    yaw_frame: Frame = "world"  # or yaws count from the actor's heading (forecast.YawZero)
    heading_speed_mps: float = 0.5  # a slower actor stands, and keeps the last heading
    tilt_rate_deg_per_s: float = 5.0  # tilt and range are searched by `covariance`, `greedy`, `joint`
    range_rate_mps: float = 1.0
    tilts_deg: tuple[float, ...] = (5.0, 15.0, 25.0, 35.0)
    ranges_m: tuple[float, ...] = (8.0, 10.0, 12.0)
    lattice_yaws: int = 8  # of `covariance` and `greedy`: their lattice has more dimensions
    lattice_knots: int = 2  # knots between two of their decisions

    # Weights of the formation search.
    w_obs: float = 1.0
    w_occ: float = 1.0
    w_turn: float = 0.05  # per 45 deg of yaw, or 2 s of tilting or approaching
    w_error: float = 1.0  # per unit of the log of predicted error, or of log det of the information

    # Weights and distances of the local planner.
    l_obs: float = 50.0
    l_occ: float = 5.0
    l_form: float = 3.0
    l_sep: float = 50.0
    a_velocity: float = 1.0
    a_acceleration: float = 1.0
    a_jerk: float = 1.0
    eps_obs_m: float = 3.0
    eps_occ_m: float = 0.5
    sight_start_m: float = 1.5  # maps contain the actor
    speed_floor_mps: float = 1.0  # 0 is the literal form: obstacles do not push a drone at rest
    separation_m: float = 3.0
    soft_separation_m: float = 4.5
    waypoints: int = 20
    waypoint_s: float = 0.5
    iterations: int = 40
    tolerance: float = 1e-3
    step_cap_m: float = 0.5

    # Rates, and tracking of plans.
    central_hz: float = 10.0
    local_hz: float = 5.0
    tracking_hz: float = 50.0
    k_position: float = 6.0
    k_velocity: float = 4.0
    k_integral: float = 0.5
    acceleration_mps2: float = 4.0
    speed_mps: float = 8.0
    jerk_mps3: float = 50.0

    # Distances that every drone keeps.
    drone_radius_m: float = 0.5  # to obstacles
    actor_distance_m: float = 3.0  # to the actor's position
    zones: tuple[Zone, ...] = ()  # where drones must not fly

    # The actor's estimate.
    actor_sigma_m: float = 0.2  # of the logged position, per axis
    actor_q: float = 0.1  # m^2/s^3, spectral density of the acceleration's noise
    actor_noise_m: float = 0.0  # added to the log by a replay, drawn from its seed

    # The ray model of a camera's information.
    errors: ErrorModel = ErrorModel()  # no setting: taken from the session
    prior_sigma_m: float = 2.0  # prior of a joint without any camera

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in (_NO_SETTING, "zones"):  # zones are checked where they are read
                continue
            if words := _WORDS.get(field.name):
                if value not in words:
                    raise ValueError(f"{field.name}: {value!r} is none of {', '.join(words)}")
                continue
            for number in value if isinstance(value, tuple) else (value,):
                least = -10.0 if field.name in _SIGNED else 0.0
                if (
                    not math.isfinite(number)
                    or number < least
                    or (number == 0 and field.name not in _MAY_BE_ZERO + _SIGNED)
                ):
                    raise ValueError(f"{field.name}: {number:g} is out of range")
            if value == ():
                raise ValueError(f"{field.name}: needs at least one value")
        for name, most in _MOST.items():
            if getattr(self, name) > most:
                raise ValueError(f"{name}: {getattr(self, name)} is more than {most}")
        if max(self.tilt_deg, *self.tilts_deg) > 85:
            raise ValueError("tilt_deg and tilts_deg: at most 85, cameras do not look straight down")
        if self.soft_separation_m < self.separation_m:
            raise ValueError(
                "soft_separation_m: less than separation_m, plans would be pushed apart too late"
            )

    @property
    def tilt_rad(self) -> float:
        """Desired elevation of the cameras above the actor."""
        return math.radians(self.tilt_deg)

    @property
    def slot_rates(self) -> tuple[float, float, float]:
        """Rates of change of a slot's yaw (rad/s), tilt (rad/s) and range (m/s)."""
        yaw, tilt = math.radians(self.yaw_rate_deg_per_s), math.radians(self.tilt_rate_deg_per_s)
        return yaw, tilt, self.range_rate_mps

    def out_of_reach(self) -> list[str]:
        """List the lattices whose cells are too wide to reach the next one between two knots.

        There formations do not turn.
        """
        lattices = (
            ("yaws", self.yaws, self.knot_s, "formations of adaptive keep"),
            (
                "lattice_yaws",
                self.lattice_yaws,
                self.lattice_knots * self.knot_s,
                "those of covariance and greedy keep",
            ),
        )
        doubts = []
        for name, yaws, seconds, keeps in lattices:
            most_deg = self.yaw_rate_deg_per_s * seconds
            if 1 < yaws < 360 / most_deg * (1 - 1e-9):
                doubts.append(
                    f"{name}: {yaws} cells of {360 / yaws:.3g} deg, but formations turn {most_deg:.3g} deg"
                    f" between knots: {keeps} to their yaw, state at least {math.ceil(360 / most_deg - 1e-9)}"
                )
        return doubts


def planner_config(values: Mapping[str, object], source: Path | str = "planner settings") -> PlannerConfig:
    """Read settings from a mapping, as from YAML; keys that are missing keep their defaults.

    Raises:
        DataError: an unknown key, a value of another type, or one out of range; every problem of the
            first two kinds in one message.
    """
    known = {field.name: field.default for field in fields(PlannerConfig) if field.name != _NO_SETTING}
    problems, taken = [], {}
    for key, value in values.items():
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1)
            problems.append(f"unknown key {key!r}" + (f" (did you mean {near[0]!r}?)" if near else ""))
            continue
        try:
            taken[key] = _zones(value) if key == "zones" else _like(known[key], value)
        except TypeError as error:
            problems.append(f"{key}: {error}")
    if problems:
        unknown = not set(values) <= set(known)
        remedy = f"there are {', '.join(known)}" if unknown else "correct it (docs/planner.md)"
        raise DataError(source, "; ".join(problems), remedy, code="bad-value")
    try:
        return PlannerConfig(**taken)  # type: ignore[arg-type]  # checked one by one above
    except ValueError as error:
        raise DataError(source, str(error)) from None


def _zones(value: object) -> tuple[Zone, ...]:
    """Read no-fly zones: `polygon` with `heights`, or `box` with two opposite corners.

    Raises:
        TypeError: the message names the zone and what is wrong with it.
    """
    if not isinstance(value, list | tuple):
        raise TypeError("must be a list of zones")
    zones: list[Zone] = []
    for k, stated in enumerate(value):
        try:
            zone = _zone(stated)
        except TypeError as error:
            raise TypeError(f"zone {k + 1}: {error}") from None
        zones.append(zone if zone.name else replace(zone, name=f"zone {k + 1}"))
    return tuple(zones)


def _zone(stated: object) -> Zone:
    if not isinstance(stated, Mapping) or ("polygon" in stated) == ("box" in stated):
        raise TypeError("must have either `polygon` and `heights`, or `box`")
    unknown = set(stated) - ({"name", "polygon", "heights"} if "polygon" in stated else {"name", "box"})
    if unknown:
        raise TypeError(f"unknown key {', '.join(sorted(map(repr, unknown)))}")
    name = str(stated.get("name") or "")
    if "box" in stated:
        low, high = _points(stated["box"], "box", size=3, least=2)[:2]
        (x0, x1), (y0, y1), (z0, z1) = (sorted(ends) for ends in zip(low, high, strict=True))
        corners: tuple[tuple[float, ...], ...] = ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
        heights: tuple[float | None, float | None] = (z0, z1)
    else:
        corners = tuple(_points(stated["polygon"], "polygon", size=2, least=3))
        corners = corners[:-1] if corners[0] == corners[-1] else corners
        ends = stated.get("heights", (None, None))
        if not isinstance(ends, list | tuple) or len(ends) != 2:
            raise TypeError("heights must be the lowest and the highest, null where it is open")
        lowest, highest = (None if end is None else float(_number(end)) for end in ends)
        heights = (lowest, highest)
    low_m, high_m = heights
    if low_m is not None and high_m is not None and low_m >= high_m:
        raise TypeError(f"its lowest point {low_m:g} must be below its highest {high_m:g}")
    if any(one == other for one, other in zip(corners, (*corners[1:], corners[0]), strict=True)):
        raise TypeError("two corners that follow each other are the same")
    if len(corners) < 3 or abs(_area_m2(corners)) < _LEAST_ZONE_M2:
        raise TypeError("its corners enclose nothing")
    return Zone(corners, low_m, high_m, name)


def _points(value: object, key: str, *, size: int, least: int) -> list[tuple[float, ...]]:
    fits = isinstance(value, list | tuple) and len(value) >= least
    if not fits or any(not isinstance(one, list | tuple) or len(one) != size for one in value):  # type: ignore[attr-defined]
        raise TypeError(f"{key} must be a list of {least} points or more, of {size} numbers each")
    if key == "box" and len(value) != 2:  # type: ignore[arg-type]
        raise TypeError("box must be two opposite corners, of 3 numbers each")
    return [tuple(float(_number(part)) for part in one) for one in value]  # type: ignore[attr-defined]


def _area_m2(corners: Sequence[tuple[float, ...]]) -> float:
    """Compute the signed area of a polygon."""
    after = (*corners[1:], corners[0])
    return sum(a[0] * b[1] - a[1] * b[0] for a, b in zip(corners, after, strict=True)) / 2.0


def _like(default: object, value: object) -> object:
    """Convert a value to the default's type.

    Text is not converted to numbers, nor fractions to counts.
    """
    if isinstance(default, str):
        return value  # one of `_WORDS`, checked in `PlannerConfig`
    if isinstance(default, tuple):
        if not isinstance(value, list | tuple):
            raise TypeError("must be a list of numbers")
        return tuple(float(_number(part)) for part in value)
    number = _number(value)
    if isinstance(default, int):
        if number != int(number):
            raise TypeError(f"{number:g} is no whole number")
        return int(number)
    return float(number)


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise TypeError(f"{value!r} is no number")
    return value
