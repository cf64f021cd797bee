"""Settings of a planner that an operator states, and the table of all its other values; docs/planner.md."""

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError

from pipelines.session.errors import DataError

# Twenty drones on a ring of 10 m are 3 m from each other.
MOST_DRONES = 20

Positive = Annotated[float, Field(gt=0, strict=True)]
NotNegative = Annotated[float, Field(ge=0, strict=True)]
Speed = Annotated[float, Field(ge=-50, le=50, strict=True)]
Elevation = Annotated[float, Field(ge=-90, le=90, strict=True)]


def _ascending(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError("write the lower end first")
    return ends


@dataclass(frozen=True)
class ErrorModel:
    """Cameras for the ray model: errors of poses and, by tilt, of BlazePose; and the field of view."""

    position_sigma_m: float = 0.3  # per axis
    rotation_sigma_deg: float = 1.0  # per axis
    tilts_deg: tuple[float, ...] = (-0.4, 14.1, 28.9, 43.9, 59.3)  # constant beyond the ends
    keypoint_sigma_m: tuple[float, ...] = (0.0198, 0.0202, 0.0247, 0.0314, 0.0386)  # per axis, at the person
    placed_share: tuple[float, ...] = (0.990, 0.988, 0.973, 0.954, 0.842)  # of joints that are found
    fov_rad: float = math.pi / 3  # level field of view


@dataclass(frozen=True)
class PlannerTuning:
    """Values that no operator states (docs/results.md, tests/planning); a session replaces `errors`."""

    # --- formation search ---
    # Cells of 45 deg let turning formations sweep through what stands between them; 32 leave 11 deg.
    yaws: int = 32
    # Knots of 2 s leave obstacles between two knots untested.
    knot_s: float = 1.0
    # Slow changes of tilt and range leave the pictures steady.
    tilt_rate_deg_per_s: float = 5.0
    range_rate_mps: float = 1.0
    # A turn of 45 deg must gain more than this, or formations turn to and fro for nothing.
    w_turn: float = 0.05
    # The logarithm of the predicted error counts as much as a line of sight that is wholly occupied.
    w_error: float = 1.0
    # Without a prior, a team with fewer than two free views would have an infinite error.
    prior_sigma_m: float = 2.0
    # Plans replace each other every 0.5 s, because slots move little in that time.
    team_plan_period_s: float = 0.5
    # Slots of `group` are this much farther from everybody than drones have to be, for people walk on.
    group_margin_m: float = 1.0
    # The arm `joint` judges the first 5 s of a path, because the rest is planned anew before it is flown.
    rolled_out_s: float = 5.0
    # A flown path that is 10 deg steeper than asked, or 2 m from the actor's distance, costs more.
    steeper_deg: float = 10.0
    near_actor_m: float = 2.0
    # Each radian steeper and each metre nearer costs as much as an error that is e^3 times larger.
    w_avoided: float = 3.0
    # A hidden view costs this beyond its occupied share and the information that it loses.
    w_hidden: float = 0.3

    # --- local planner ---
    # Other drones weigh as much as obstacles.
    l_sep: float = 50.0
    # Velocity, acceleration and jerk have the same weight in Bonatti et al. 2020.
    a_velocity: float = 1.0
    a_acceleration: float = 1.0
    a_jerk: float = 1.0
    # Obstacles push from 3 m on; the guard alone keeps the last half metre.
    eps_obs_m: float = 3.0
    # At 3 m bare ground alone would push cameras up to a tilt of 39 deg.
    eps_occ_m: float = 0.5
    # Maps contain the actor, so that this end of a line of sight is left out.
    sight_start_m: float = 1.5
    # With the literal form, 0, obstacles do not push a drone at rest.
    speed_floor_mps: float = 1.0
    # Plans avoid each other from this much beyond the least distance, or drones cut corners too closely.
    soft_separation_margin_m: float = 1.5
    # Plans reach 10 s ahead, as far as the formation search does by default.
    waypoints: int = 20
    waypoint_s: float = 0.5
    # The descent ends after so many evaluations, to keep the rate of the local planner.
    iterations: int = 40
    tolerance: float = 1e-3
    # Longer steps jump over thin obstacles.
    step_cap_m: float = 0.5

    # --- rates and tracking ---
    # Formations are planned at 10 Hz and trajectories at 5 Hz.
    central_hz: float = 10.0
    local_hz: float = 5.0
    # A flight controller tracks positions at this rate.
    tracking_hz: float = 50.0
    # The gains damp a position error by four fifths of critical; the integral removes a constant one.
    k_position: float = 6.0
    k_velocity: float = 4.0
    k_integral: float = 0.5

    # --- actor and cameras ---
    # Planners take the logged position of the actor to err by this much per axis.
    actor_sigma_m: float = 0.2
    errors: ErrorModel = ErrorModel()


@dataclass(frozen=True)
class Imperfections:
    """Imperfections of a flight, none of them by default."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid", allow_inf_nan=False)

    # Plans are made of positions and maps that are so old.
    latency_s: Annotated[float, Field(ge=0, le=10, strict=True)] = 0.0
    # For this share of the time drones neither hear where the actor is, nor of new formations.
    outage_share: Annotated[float, Field(ge=0, lt=1, strict=True)] = 0.0
    # The wind to the east and north, which slows drones and changes their energy.
    wind_mps: tuple[Speed, Speed] = (0.0, 0.0)
    # Gusts have this standard deviation along level axes, half of it upwards.
    gust_mps: NotNegative = 0.0
    # Gimbals turn no faster than this.
    gimbal_deg_per_s: Positive | None = None
    # Gimbals reach these elevations of the optical axis.
    gimbal_pitch_deg: Annotated[tuple[Elevation, Elevation], AfterValidator(_ascending)] = (-90.0, 90.0)
    # Drones film until they have used this energy.
    battery_kj: Positive | None = None


@dataclass(frozen=True)
class PlannerConfig:
    """Settings of every arm. Values that come from a user go through `planner_config`, which checks them."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid", allow_inf_nan=False)

    # Slots have this distance from the actor's hips.
    radius_m: Positive = 10.0
    # Slots have this elevation above the actor's hips.
    tilt_deg: Annotated[float, Field(ge=-10, le=85, strict=True)] = 15.0
    # The arm `joint` chooses ranges between the least and the largest of these.
    ranges_m: Annotated[tuple[Positive, ...], Field(min_length=1)] = (8.0, 10.0, 12.0)
    # Formations turn no faster than this.
    yaw_rate_deg_per_s: Positive = 22.5
    # The formation search looks so far ahead.
    horizon_s: Annotated[float, Field(gt=0, le=60, strict=True)] = 10.0
    # The formation search weighs slots near obstacles by this.
    w_obs: NotNegative = 1.0
    # The formation search weighs the occupied share of a line of sight by this.
    w_occ: NotNegative = 1.0
    # The local planner weighs obstacles by this.
    l_obs: NotNegative = 50.0
    # The local planner weighs occupied lines of sight by this.
    l_occ: NotNegative = 5.0
    # The local planner weighs the distance from the slot by this.
    l_form: Positive = 3.0
    # Two drones keep this distance from each other.
    separation_m: Positive = 3.0
    # A drone keeps this distance from obstacles.
    drone_radius_m: NotNegative = 0.5
    # A drone keeps this distance from everybody.
    actor_distance_m: NotNegative = 3.0
    # A drone accelerates by no more than this.
    acceleration_mps2: Positive = 4.0
    # A drone flies no faster than this.
    speed_mps: Positive = 8.0
    # The acceleration of a drone changes no faster than this.
    jerk_mps3: Positive = 50.0
    # The actor's acceleration has this spectral density, m²/s³: 0.1 for walking, 1.5 for jogging.
    actor_q: Positive = 0.1
    # What a replay idealises, by keys of its own: see below.
    imperfections: Imperfections = Imperfections()

    tuning: PlannerTuning = field(default=PlannerTuning(), repr=False)

    @property
    def tilt_rad(self) -> float:
        """Desired elevation of the cameras above the actor."""
        return math.radians(self.tilt_deg)

    @property
    def horizon_knots(self) -> int:
        """Number of knots that the search looks ahead."""
        return math.ceil(self.horizon_s / self.tuning.knot_s - 1e-9)

    @property
    def soft_separation_m(self) -> float:
        """Distance below which plans avoid each other."""
        return self.separation_m + self.tuning.soft_separation_margin_m

    @property
    def soft_actor_distance_m(self) -> float:
        """Distance below which plans avoid people."""
        margin_m = self.tuning.soft_separation_margin_m
        return self.actor_distance_m + margin_m if self.actor_distance_m else 0.0

    @property
    def ground_speed_mps(self) -> float:
        """Speed over the ground that a drone reaches in any direction of the wind."""
        return self.speed_mps - math.hypot(*self.imperfections.wind_mps)

    @property
    def slot_rates(self) -> tuple[float, float, float]:
        """Rates of change of a slot's yaw (rad/s), tilt (rad/s) and range (m/s)."""
        tilt_rate = math.radians(self.tuning.tilt_rate_deg_per_s)
        return math.radians(self.yaw_rate_deg_per_s), tilt_rate, self.tuning.range_rate_mps

    def out_of_reach(self) -> list[str]:
        """Warn of a yaw rate that reaches no other cell between two knots: there formations do not turn."""
        most_deg, cell_deg = self.yaw_rate_deg_per_s * self.tuning.knot_s, 360 / self.tuning.yaws
        if self.tuning.yaws == 1 or most_deg >= cell_deg * (1 - 1e-9):
            return []
        return [
            f"yaw_rate_deg_per_s: formations turn {most_deg:.3g} deg between knots, less than the search's"
            f" cells of {cell_deg:.3g} deg: they keep their yaw"
        ]


SETTINGS = tuple(each.name for each in fields(PlannerConfig) if each.name != "tuning")
"""Names of the settings, as users write them."""

_DOTTED = "imperfections."

_ADAPTER = TypeAdapter(PlannerConfig)


def planner_config(values: Mapping[str, object], source: Path | str = "planner settings") -> PlannerConfig:
    """Read settings from a mapping, as from YAML; DataError: everything unknown, or of a wrong value."""
    problems = []
    dotted = [key for key in values if str(key).startswith(_DOTTED)]
    if dotted:
        within = {key.removeprefix(_DOTTED): values[key] for key in dotted}
        values = {key: value for key, value in values.items() if key not in dotted}
        stated = values.get("imperfections", {})
        values = {**values, "imperfections": {**stated, **within} if isinstance(stated, dict) else stated}
    for key in values:
        if key not in SETTINGS:
            near = difflib.get_close_matches(str(key), SETTINGS, n=1)
            problems.append(f"unknown key {key!r}" + (f" (did you mean {near[0]!r}?)" if near else ""))
    remedy = f"there are {', '.join(SETTINGS)}" if problems else "correct it (docs/planner.md)"
    try:
        config = _ADAPTER.validate_python({key: value for key, value in values.items() if key in SETTINGS})
    except ValidationError as error:
        for found in error.errors():
            place = ".".join(str(part) for part in found["loc"])
            problems.append(f"{place}: {found['msg']}")
    else:
        if config.ground_speed_mps <= 0.0:
            problems.append(
                f"imperfections.wind_mps: drones of {config.speed_mps:g} m/s cannot fly against it"
            )
    if problems:
        raise DataError(source, "; ".join(problems), remedy, code="bad-value")
    return config
