"""Data that all arms of a comparison share: settings, the actor, the maps, the cameras and the times."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.noise import sum_sigma
from pipelines.geometry.poses import rates
from pipelines.planning.config import ErrorModel, PlannerConfig, planner_config
from pipelines.planning.distance_field import (
    DistanceField,
    MapsInTurn,
    Unknown,
    distance_field,
    in_turn,
    zone_edges,
)
from pipelines.planning.forecast import first_heading
from pipelines.planning.formation import (
    YAW,
    formation_slots,
    slot_of,
    slot_offsets,
)
from pipelines.planning.loading import LoggedFlight, Source, flown_poses, points_at
from pipelines.planning.tracking import tracking_times
from pipelines.session.description import Description
from pipelines.session.errors import DataError
from pipelines.session.records import Occupancy

# More drones are refused, because no comparison of more was ever checked.
MOST_DRONES = 8
# The detector's errors are modelled for 30 Hz, and 25 divide the 50 of the tracking.
PICTURES_HZ = 25.0
# Errors of poses change slowly along a flight, so that the mean over 200 moments is that of all.
NOISE_LOOKS = 200


@dataclass(frozen=True)
class ReplanSettings:
    """Settings that determine a comparison, in addition to the session; None takes the session's value."""

    arms: tuple[str, ...] | None = (
        None  # adaptive and fixed, flown if cameras moved, planned if commands are logged
    )
    drones: int | None = None  # the number of cameras, 2 to 8
    yaw_deg: float | None = None  # of the first camera at the start, from the zero of yaws
    trials: int = 100
    seed: int = 0
    pose_noise: str | None = None
    planner: PlannerConfig = field(default_factory=PlannerConfig)


def replan_settings(values: Mapping[str, object], source: Path | str, **others: Any) -> ReplanSettings:
    """Make settings of a mapping, as from YAML: those of the planner, and `yaw_deg`.

    Raises:
        DataError: a setting is unknown or out of range.
    """
    planner = dict(values)
    own: dict[str, Any] = {}
    if "yaw_deg" in planner:
        yaw_deg = own["yaw_deg"] = planner.pop("yaw_deg")
        if isinstance(yaw_deg, bool) or not isinstance(yaw_deg, int | float) or not abs(yaw_deg) <= 360:
            raise DataError(source, f"yaw_deg: {yaw_deg!r} is no angle from -360 to 360", code="bad-value")
    return ReplanSettings(planner=planner_config(planner, source), **own, **others)


@dataclass(frozen=True)
class ReplayScene:
    """A flight that can be flown again. T times, one per tracking step; C cameras of the session."""

    flight: LoggedFlight
    settings: ReplanSettings
    drones: int
    yaw_rad: float  # of the first camera at the start, from east
    heading_rad: float  # of the actor's first way, from east; 0 where yaws count from east
    t_ns: Int64  # [T]
    people: Float  # [P, T, 3] reference of the scores
    actor_source: Source
    fields: tuple[DistanceField, ...]  # by the time from which they hold
    flown: tuple[Float, Float, Bool]  # positions [C, T, 3], quaternions [C, T, 4], mask of logged ones [C, T]
    notes: tuple[str, ...]  # choices made for the user
    warnings: tuple[str, ...]

    @property
    def config(self) -> PlannerConfig:
        """Planner settings."""
        return self.settings.planner

    @property
    def weights(self) -> Float:
        """Weights [P] of the people, of sum 1."""
        weights = np.array(self.flight.weights)
        shares: Float = weights / weights.sum()
        return shares

    @cached_property
    def actor(self) -> Float:
        """Reference of the scores [T, 3]: the actor, of several people their weighted middle."""
        middle: Float = np.tensordot(self.weights, self.people, 1)
        return middle

    @property
    def t_s(self) -> Float:
        """Seconds [T] since the start."""
        seconds: Float = (self.t_ns - self.t_ns[0]) / 1e9
        return seconds

    @property
    def maps(self) -> MapsInTurn:
        """Map of each moment."""
        return self.maps_at(self.t_ns)

    def maps_at(self, t_ns: Int64) -> MapsInTurn:
        """Return the map of each of some moments [T], ascending."""
        return in_turn(self.fields, t_ns)

    @property
    def names(self) -> list[str]:
        """Names of the drones: those of the session's cameras, and then drone1, ... as far as free."""
        own = [camera.name for camera in self.flight.cameras]
        free = [f"drone{k + 1}" for k in range(self.drones + len(own)) if f"drone{k + 1}" not in own]
        return [*own, *free][: self.drones]

    @property
    def pictures(self) -> slice:
        """Times at which pictures are taken."""
        return slice(None, None, max(round(self.config.tuning.tracking_hz / PICTURES_HZ), 1))

    @cached_property
    def joints(self) -> Float | None:
        """Joints [K, P J, 3] of all people at the times of the pictures; None where no skeleton is known."""
        skeleton, t_ns = self.flight.skeleton, self.t_ns[self.pictures]
        return None if skeleton is None else points_at(skeleton, t_ns).reshape(len(t_ns), -1, 3)

    def _first_slots(self) -> Float:
        """Compute the places [N, T, 3] of the slots of the start's formation."""
        slots = formation_slots(
            np.array(self.yaw_rad), self.drones, tilt_rad=self.config.tilt_rad, range_m=self.config.radius_m
        )
        return self.actor + slot_offsets(slots)[:, None]

    def start_slots_inside(self) -> int:
        """Count the slots of the start that are within the drones' radius of an obstacle, or in it."""
        (_, first), *_ = self.maps_at(self.t_ns[:1])
        clearance_m = first.barring(zone_edges(self.config.zones)).sample(self._first_slots()[:, 0])[0]
        return int((clearance_m < self.config.drone_radius_m).sum())


def build_scene(
    flight: LoggedFlight,
    maps: Sequence[Occupancy],
    description: Description,
    settings: ReplanSettings,
    *,
    errors: ErrorModel | None = None,
) -> ReplayScene:
    """Prepare a comparison: distance fields, times, the first camera's start, and warnings.

    `errors` are those of the detector, by default as in `ErrorModel`; those of the poses are the flight's.
    """
    notes = []
    unknown: Unknown = "occupied" if description.map and description.map.unknown == "occupied" else "free"
    fields = tuple(
        sorted((distance_field(one, unknown=unknown) for one in maps), key=lambda field: field.from_ns)
    )
    notes.append(
        f"unknown voxels of the map count as {unknown}" if fields else "no map: open space, nothing is hidden"
    )
    own = [flight.actor_t_ns[known][[0, -1]] for known in np.isfinite(flight.actor[..., 0]).T]
    span_ns = np.array([max(first for first, _ in own), min(last for _, last in own)])
    t_ns = tracking_times(span_ns, settings.planner)
    people, actor_source = flight.scored_actor(t_ns)
    actor = np.average(people, axis=0, weights=flight.weights)
    flown = flown_poses(flight, description, t_ns)
    errors = with_pose_errors(errors or ErrorModel(), flight, t_ns, *flown[:2])
    settings = replace(
        settings, planner=replace(settings.planner, tuning=replace(settings.planner.tuning, errors=errors))
    )
    drones = settings.drones or min(max(len(flight.cameras), 2), MOST_DRONES)
    if settings.drones is None and drones != len(flight.cameras):
        notes.append(f"{drones} drones are replayed, the session has {len(flight.cameras)} cameras")
    heading_rad = 0.0
    if settings.planner.yaw_frame == "heading":
        heading_rad = first_heading(np.average(flight.actor, axis=1, weights=flight.weights))
        notes.append(f"yaws count from where the actor heads, {np.degrees(heading_rad):.1f} deg at first")
    if settings.yaw_deg is not None:
        yaw_rad = float(np.radians(settings.yaw_deg)) + heading_rad
    else:
        yaw_rad = float(slot_of(flown[0][0, 0] - actor[0])[YAW])
        first = flight.cameras[0].name
        notes.append(f"formations start at {np.degrees(yaw_rad):.1f} deg, where {first} was")
    scene = ReplayScene(
        flight=flight,
        settings=settings,
        drones=drones,
        yaw_rad=yaw_rad,
        heading_rad=heading_rad,
        t_ns=t_ns,
        people=people,
        actor_source=actor_source,
        fields=fields,
        flown=flown,
        notes=tuple(notes),
        warnings=(),
    )
    return replace(scene, warnings=(*flight.warnings, *_doubts(scene)))


def with_pose_errors(
    errors: ErrorModel, flight: LoggedFlight, t_ns: Int64, position: Float, quaternion_xyzw: Float
) -> ErrorModel:
    """Take the errors of the poses and the field of view from a flight; those of the detector are kept.

    Errors are root mean squares over its cameras and times [T], along the poses as flown [C, T, 3] and [C,
    T, 4]; of several fields of view the narrowest counts.
    """
    rows = slice(None, None, max(len(t_ns) // NOISE_LOOKS, 1))
    elapsed_s = (t_ns[rows] - t_ns[0]) / 1e9
    sigma = [
        sum_sigma(camera.noise, elapsed_s, *rates(t_ns[rows], position[c, rows], quaternion_xyzw[c, rows]))
        for c, camera in enumerate(flight.cameras)
    ]
    meters, radians = np.sqrt(np.mean(np.square(sigma), axis=(0, 1)))
    lenses = [camera.intrinsics for camera in flight.cameras]
    return replace(
        errors,
        position_sigma_m=float(meters),
        rotation_sigma_deg=float(np.degrees(radians)),
        fov_rad=min(2.0 * np.arctan(lens.width / 2.0 / lens.fx) for lens in lenses),
    )


def _doubts(scene: ReplayScene) -> list[str]:
    """List problems of the maps, the start and the skeleton, one line each."""
    doubts = []
    fields = scene.fields
    if fields and not any(field.has_obstacles for field in fields):
        doubts.append("nothing in the map is occupied")
    covered = [
        field.covers(scene.people[:, rows]).mean(axis=0)
        for rows, field in scene.maps
        if any(field is one for one in fields)
    ]
    outside = float(1.0 - np.concatenate(covered).mean()) if covered else 0.0
    if outside > 0.0:
        doubts.append(
            f"the map does not cover {100 * outside:.0f} % of the actor's way: what lies outside is free"
        )
    if fields and fields[0].from_ns > scene.t_ns[0]:
        late_s = min((fields[0].from_ns - int(scene.t_ns[0])) / 1e9, float(scene.t_s[-1]))
        doubts.append(f"the first map comes {late_s:.1f} s after the start: nothing is known until then")
    inside = scene.start_slots_inside()
    if inside:
        doubts.append(
            f"{inside} of {scene.drones} drones start within {scene.config.drone_radius_m:g} m of an obstacle"
            " or a no-fly zone and leave by the shortest way: choose another yaw_deg, radius_m or tilt_deg"
        )
    doubts += scene.config.out_of_reach()
    if scene.flight.skeleton is None:
        doubts.append("no skeleton to look at, so no reconstruction error: run `mocap reconstruct` first")
    return doubts
