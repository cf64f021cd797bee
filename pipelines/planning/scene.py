"""Data that all arms of a comparison share: actor, maps, cameras, skeleton, times and settings."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float, Int64, Intrinsics
from pipelines.geometry.metrics import matched
from pipelines.geometry.noise import NoiseModel, White, sum_sigma
from pipelines.geometry.poses import (
    gaps,
    interpolate_points,
    matrix_from_quaternion,
    quaternion_from_rotation_vector,
    rates,
)
from pipelines.planning.config import MOST_DRONES, ErrorModel, PlannerConfig, planner_config
from pipelines.planning.distance_field import (
    OCCUPIED,
    DistanceField,
    MapsInTurn,
    Unknown,
    distance_field,
    in_turn,
)
from pipelines.planning.forecast import positions_at
from pipelines.planning.formation import YAW, formation_slots, slot_of, slot_offsets
from pipelines.planning.local import tracking_times
from pipelines.session.camera_poses import COMMAND_LINE, known_variances, poses_at, stated_models
from pipelines.session.description import HIP_ABOVE_POINT_M, CameraEntry, Description, Interpolation
from pipelines.session.errors import DataError
from pipelines.session.people import logged_people
from pipelines.session.records import JointMotion, Occupancy, Trajectory
from pipelines.session.stages import StageRecord
from pipelines.session.tables import (
    CAMERA_POSES,
    PLAN,
    SKELETON,
    TRUTH,
    read_motion,
    read_poses,
    read_table,
    trajectory_from,
)

Source = Literal["log", "reconstruction", "truth"]

# Joints are interpolated across a missed frame at 10 Hz.
MIN_INTERPOLATED_NS = 200_000_000
# Joints are not interpolated across more than this many median steps.
MAX_STEPS_INTERPOLATED = 1.5
# A person can turn round within a second, so that longer gaps of the actor's measurements give a warning.
LONG_GAP_NS = 1_000_000_000
# Planners send several commands a second, so that a command that is older does not hold.
COMMAND_HOLDS_NS = 2_000_000_000
# A shorter flight has too few plans to compare.
MIN_FLIGHT_S = 1.0
# Voxels of 0.5 m, soft ground and errors of the hips explain less between the map's ground and the feet.
LARGEST_OFFSET_M = 1.0
# Nobody climbs more within a second: what is higher is no ground, but stands in the way.
HIGHEST_STEP_M = 1.5
# Probabilities are 0 to 1, so that this marks places beyond the map.
OUTSIDE = -1.0
# Others who are reconstructed at less than half of the first person's times are not filmed again.
MIN_SHARE_OF_TIMES = 0.5

_HIPS = ("left_hip", "right_hip")


@dataclass(frozen=True)
class SessionCamera:
    """A camera of the session: lens, poses and pose noise."""

    name: str
    intrinsics: Intrinsics
    trajectory: Trajectory  # one row where it stands still
    static: bool
    noise: tuple[NoiseModel, ...]  # of its logged poses


@dataclass(frozen=True)
class LoggedFlight:
    """The logged flight, as far as the session knows it."""

    actor_t_ns: Int64  # [A] ascending
    actor: Float  # [A, P, 3] m, world: input of the planners, the middle of the hips; NaN: not measured then
    actor_source: Source
    hips: JointMotion | None  # the true hips, [T, P, 1, 3], NaN where unknown; None without truth
    skeleton: JointMotion | None  # [T, P, J, 3] NaN where unknown
    skeleton_source: Source | None
    cameras: tuple[SessionCamera, ...]
    poses_source: Source
    noise_source: str  # source of the poses' noise
    warnings: tuple[str, ...]
    planned: dict[str, tuple[Int64, Float]] = field(default_factory=dict)
    """Positions to which cameras were sent: stamps [K] and [K, 3] m, world."""
    people: tuple[str, ...] = ("",)
    """Names of the P people; the only one may have none."""
    weights: tuple[float, ...] = (1.0,)
    """Weights of the P people."""

    @property
    def moves(self) -> bool:
        """True if any camera moves."""
        return not all(camera.static for camera in self.cameras)

    def scored_actor(self, t_ns: Int64) -> tuple[Float, Source]:
        """Return the positions [P, T, 3] to score against: the true hips if they are known all the time."""
        if self.hips is not None:
            true_hips = points_at(self.hips, t_ns)[:, :, 0]
            if np.isfinite(true_hips).all():
                return true_hips.swapaxes(0, 1), "truth"
        return positions_at(self.actor_t_ns, self.actor, t_ns), self.actor_source


def load_flight(
    folder: Path, description: Description, reconstructed: StageRecord | None, *, pose_noise: str | None
) -> LoggedFlight:
    """Read the flight while the actor and all moving cameras are known; DataError: they never are."""
    warnings: list[str] = []
    skeleton, skeleton_source = _skeleton(folder, description, reconstructed)
    t_ns, actor, source = _actor(folder, description, reconstructed, warnings)
    people = actor.shape[1]
    logged = description.logged_people if source == "log" else []
    if skeleton is not None:
        skeleton = _of_people(skeleton, t_ns, actor, logged=bool(logged))
    cameras, poses_source, noise_source = _cameras(folder, description, pose_noise)
    if noise_source == "nobody":
        warnings.append("nobody states the noise of the cameras' poses: taken as exact; state --pose-noise")
    hips = _hips(skeleton) if skeleton is not None and skeleton_source == "truth" else None
    spans = {f"the poses of {c.name}": c.trajectory.t_ns[[0, -1]] for c in cameras if not c.static}
    if hips is not None:
        known = np.isfinite(hips.position[..., 0, 0]).all(axis=1)
        spans["the truth"] = hips.t_ns[np.flatnonzero(known)[[0, -1]]]
    t_ns, actor = _cut(folder, t_ns, actor, spans)
    missing = [gap for own in np.isfinite(actor[..., 0]).T for gap in gaps(t_ns[own], LONG_GAP_NS)]
    if missing:
        longest_s = max(last - first for first, last in missing) / 1e9
        warnings.append(
            f"the actor was not measured {len(missing)} times for more than {LONG_GAP_NS / 1e9:g} s, at most"
            f" {longest_s:.1f} s: planners take a straight way meanwhile"
        )
    return LoggedFlight(
        actor_t_ns=t_ns,
        actor=actor,
        actor_source=source,
        hips=hips,
        skeleton=skeleton,
        skeleton_source=skeleton_source,
        cameras=cameras,
        poses_source=poses_source,
        noise_source=noise_source,
        warnings=tuple(warnings),
        planned=_planned(folder, description),
        people=tuple(description.names_of_people(people)) if people > 1 else ("",),
        weights=tuple(person.weight for person in logged) or (1.0,) * people,
    )


def points_at(motion: JointMotion, t_ns: Int64) -> Float:
    """Interpolate the joints [T, P, J, 3] at given times; NaN where not known nearby."""
    step_ns = float(np.median(np.diff(motion.t_ns))) if len(motion.t_ns) > 1 else 0.0
    longest_ns = max(MIN_INTERPOLATED_NS, round(MAX_STEPS_INTERPOLATED * step_ns))
    return interpolate_points(motion.t_ns, motion.position, t_ns, max_gap_ns=longest_ns)


class OtherWalk(NamedTuple):
    """Variation of a logged way, for people who walk it another time."""

    speed: float = 1.0  # factor
    delay_s: float = 0.0  # for which everybody stands still
    turn_deg: float = 0.0  # counterclockwise, of the rest of the way
    share: float = 0.5  # of the flight, at which people stand or turn


def walked_otherwise(flight: LoggedFlight, walk: OtherWalk, maps: Sequence[Occupancy]) -> LoggedFlight:
    """Return the flight as if everybody had walked otherwise, over the ground of the last map.

    Joints move as logged, only faster, later or in another direction. DataError: something stands in the way.
    """
    t_ns, first_ns = flight.actor_t_ns, int(flight.actor_t_ns[0])
    when_ns = first_ns + walk.share * float(np.ptp(t_ns))
    middle = positions_at(t_ns, flight.actor, np.array([round(when_ns)]))[:, 0].mean(axis=0)
    turn = matrix_from_quaternion(
        quaternion_from_rotation_vector(np.array([0.0, 0.0, np.radians(walk.turn_deg)]))
    )

    climb_m = np.zeros(len(t_ns))
    if maps and walk.turn_deg:
        way = np.average(positions_at(t_ns, flight.actor, t_ns), axis=0, weights=flight.weights)
        turned = np.where((t_ns > when_ns)[:, None], middle + (way - middle) @ turn.T, way)
        steps = np.subtract(*(_ground_above_feet(maps[-1], places) for places in (turned, way)))
        known = np.isfinite(steps)
        if known.any():
            steps = np.interp(t_ns, t_ns[known], steps[known])
            second = max(round(1e9 / float(np.median(np.diff(t_ns)))), 1)
            highest_m = float(np.abs(steps[second:] - steps[:-second]).max(initial=0.0))
            if highest_m > HIGHEST_STEP_M:
                problem = (
                    f"a way turned by {walk.turn_deg:.0f} deg rises by {highest_m:.1f} m within a second"
                )
                raise DataError("actor", problem, "turn it by another angle", code="bad-value")
            padded = np.pad(steps, (second // 2, second - 1 - second // 2), mode="edge")
            climb_m = np.convolve(padded, np.ones(second) / second, "valid")

    def moved(stamps: Int64, at: Callable[[Int64], Float]) -> tuple[Int64, Float]:
        duration_ns = (stamps[-1] - first_ns) / walk.speed + walk.delay_s * 1e9
        step_ns = max(int(np.median(np.diff(stamps))), 1)
        new_ns = np.arange(min(stamps[0], first_ns), first_ns + duration_ns, step_ns).astype(np.int64)
        walked_ns = walk.speed * (new_ns - first_ns)
        stands_ns = when_ns - first_ns
        late_ns = np.clip(walked_ns - stands_ns, 0.0, walk.speed * walk.delay_s * 1e9)
        old_ns = first_ns + (walked_ns - late_ns).astype(np.int64)
        there = (old_ns >= stamps[0]) & (old_ns <= stamps[-1])
        new_ns, old_ns = new_ns[there], old_ns[there]
        place, after = at(old_ns), old_ns > when_ns
        place[after] = middle + (place[after] - middle) @ turn.T
        place[..., 2] += np.interp(old_ns, t_ns, climb_m).reshape(-1, *(1,) * (place.ndim - 2))
        return new_ns, place

    def motion(of: JointMotion | None) -> JointMotion | None:
        if of is None:
            return None
        new_ns, place = moved(of.t_ns, partial(points_at, of))
        return JointMotion(new_ns, of.joints, place)

    def people(old_ns: Int64) -> Float:
        place = positions_at(t_ns, flight.actor, old_ns).swapaxes(0, 1)
        for p, known in enumerate(np.isfinite(flight.actor[..., 0]).T):
            first, last = t_ns[known][[0, -1]]
            place[(old_ns < first) | (old_ns > last), p] = np.nan
        return place

    new_ns, actor = moved(t_ns, people)
    return replace(
        flight, actor_t_ns=new_ns, actor=actor, hips=motion(flight.hips), skeleton=motion(flight.skeleton)
    )


def flown_poses(flight: LoggedFlight, description: Description, t_ns: Int64) -> tuple[Float, Float, Bool]:
    """Interpolate the cameras' true poses [N, T, ...], straight across gaps, and mask known ones [N, T]."""
    trusted = description.pose_interpolation
    shape = (len(flight.cameras), len(t_ns))
    position, quaternion = np.empty((*shape, 3)), np.empty((*shape, 4))
    known = np.empty(shape, dtype=np.bool_)
    for i, camera in enumerate(flight.cameras):
        log, static = camera.trajectory, camera.static
        known[i] = np.isfinite(poses_at(log, t_ns, trusted, static=static)[0][:, 0])
        everywhere = Interpolation(
            max_gap_s=float(np.ptp(log.t_ns)) / 1e9, max_extrapolation_s=float(np.ptp(t_ns)) / 1e9
        )
        position[i], quaternion[i] = poses_at(log, t_ns, everywhere, static=static)
    return position, quaternion, known


def planned_positions(flight: LoggedFlight, t_ns: Int64) -> tuple[Float, Bool]:
    """Interpolate commanded positions [K, T, 3], and mask those between two commands near each other."""
    position, known = np.empty((len(flight.planned), len(t_ns), 3)), []
    for i, (stamps, sent) in enumerate(flight.planned.values()):
        after = np.searchsorted(stamps, t_ns, side="left").clip(1, max(len(stamps) - 1, 1))
        apart = np.diff(stamps, append=stamps[-1])[after - 1]
        known.append((t_ns >= stamps[0]) & (t_ns <= stamps[-1]) & (apart <= COMMAND_HOLDS_NS))
        for axis in range(3):
            position[i, :, axis] = np.interp(t_ns - stamps[0], stamps - stamps[0], sent[:, axis])
    return position, np.array(known, dtype=np.bool_).reshape(position.shape[:2])


# --- the person ----------------------------------------------------------------------------------------


def _skeleton(
    folder: Path, description: Description, reconstructed: StageRecord | None
) -> tuple[JointMotion | None, Source | None]:
    if description.truth is not None and description.has_true_joints:
        joints = tuple(description.truth.joints)
        return read_motion(folder / "truth.parquet", TRUTH, joints), "truth"
    return (None, None) if reconstructed is None else (_reconstruction(folder), "reconstruction")


def _reconstruction(folder: Path) -> JointMotion:
    """Read the reconstructed skeleton; joints that are not `ok` are NaN."""
    motion = read_motion(folder / "reconstruct" / "skeleton.parquet", SKELETON)
    if motion.status is not None:
        motion.position[motion.status != "ok"] = np.nan
    return motion


def _of_people(skeleton: JointMotion, t_ns: Int64, actor: Float, *, logged: bool) -> JointMotion:
    """Return the skeletons of the P people whose hips [A, P, 3] were measured; NaN for those without one."""
    people = actor.shape[1]
    position = np.full((len(skeleton.t_ns), people, *skeleton.position.shape[2:]), np.nan)
    hips = _hips_of(skeleton)
    if logged or hips is None:
        person = whose = np.arange(min(people, skeleton.position.shape[1]))
    else:
        there = positions_at(t_ns, actor, skeleton.t_ns).swapaxes(0, 1)
        person, whose = matched(there[:, :, None], hips[:, :, None])
    position[:, person] = skeleton.position[:, whose]
    return JointMotion(skeleton.t_ns, skeleton.joints, position)


def _hips_of(skeleton: JointMotion) -> Float | None:
    """Compute the middle of everybody's hips [T, P, 3]; None where the skeleton has none."""
    names = ("hip",) if "hip" in skeleton.joints else _HIPS
    if not set(names) <= set(skeleton.joints):
        return None
    middle: Float = skeleton.position[:, :, [skeleton.joints.index(name) for name in names]].mean(axis=2)
    return middle


def _hips(skeleton: JointMotion) -> JointMotion | None:
    """Compute the middle of everybody's hips, [T, P, 1, 3]; None if somebody's are never known."""
    middle = _hips_of(skeleton)
    if middle is None or not np.isfinite(middle[..., 0]).all(axis=1).any():
        return None
    return JointMotion(skeleton.t_ns, ("hip",), middle[:, :, None])


def _actor(
    folder: Path, description: Description, reconstructed: StageRecord | None, warnings: list[str]
) -> tuple[Int64, Float, Source]:
    """Return the planners' input, [A] and [A, P, 3]: the logs of the people, or the reconstructed hips."""
    logged = logged_people(folder, description)
    warnings.extend(
        f"the {entry.point} of {entry.name or 'the actor'} were logged: hips taken"
        f" {entry.hip_above_m:+.2f} m above"
        for entry in description.logged_people
        if entry.point in ("feet", "head")
    )
    if logged:
        t_ns = np.unique(np.concatenate([person.t_ns for person in logged]))
        hips = np.full((len(t_ns), len(logged), 3), np.nan)
        for k, person in enumerate(logged):
            hips[np.searchsorted(t_ns, person.t_ns), k] = person.hips
        return *_measured(folder, t_ns, hips, "the actor's log"), "log"
    if reconstructed is None:
        problem = "has no logged actor and no reconstruction to take one from"
        remedy = "run `mocap reconstruct`, or name the actor's topic under `actor:` in flight.yaml"
        raise DataError(folder, problem, remedy, code="no-actor")
    found = _reconstruction(folder)
    middle = _hips_of(found)
    if middle is None or not np.isfinite(middle[:, 0]).any():
        problem = "has no logged actor, and the reconstruction has no time at which both hips are ok"
        remedy = "name the actor's topic under `actor:` in flight.yaml, or mend the reconstruction"
        raise DataError(folder, problem, remedy, code="no-actor")
    known = np.isfinite(middle[..., 0])
    filmed = known[known[:, 0]].mean(axis=0) >= MIN_SHARE_OF_TIMES
    return *_measured(folder, found.t_ns, middle[:, filmed], "the reconstruction's hips"), "reconstruction"


def _measured(folder: Path, t_ns: Int64, position: Float, what: str) -> tuple[Int64, Float]:
    known = np.isfinite(position[..., 0])
    fewest = int(known.sum(axis=0).min())
    if fewest < 2:
        raise DataError(folder, f"{what} hold {fewest} positions", "a replay needs two or more")
    rows = known.any(axis=1)
    return t_ns[rows], position[rows]


def _cut(folder: Path, t_ns: Int64, actor: Float, spans: dict[str, NDArray[np.int64]]) -> tuple[Int64, Float]:
    """Cut the actor to the time in which all else is known."""
    own = [t_ns[known][[0, -1]] for known in np.isfinite(actor[..., 0]).T]
    first_ns = max(int(span[0]) for span in [*own, *spans.values()])
    last_ns = min(int(span[1]) for span in [*own, *spans.values()])
    kept = (t_ns >= first_ns) & (t_ns <= last_ns)
    shared_s = float(np.ptp(t_ns[kept]) / 1e9) if kept.any() else 0.0
    if shared_s < MIN_FLIGHT_S:
        problem = (
            f"{', '.join(['the actor', *spans])} are known together for {shared_s:.2f} s, less than"
            f" {MIN_FLIGHT_S:g} s"
        )
        raise DataError(folder, problem, "check the clocks of the logs", code="no-overlap")
    return t_ns[kept], actor[kept]


# --- the cameras ---------------------------------------------------------------------------------------


def _cameras(
    folder: Path, description: Description, pose_noise: str | None
) -> tuple[tuple[SessionCamera, ...], Source, str]:
    true_poses = _true_poses(folder, description)
    cameras, stating = [], set()
    for name, entry in description.cameras.items():
        logged = read_poses(folder / "cameras" / name / "poses.parquet")
        noise, stated_by = _noise(name, entry, logged, pose_noise)
        stating.add(stated_by)
        cameras.append(
            SessionCamera(
                name=name,
                intrinsics=entry.intrinsics,
                trajectory=true_poses.get(name, logged) if not entry.poses.static else logged,
                static=entry.poses.static,
                noise=noise,
            )
        )
    noise_source = "nobody" if "nobody" in stating else ", ".join(sorted(stating))
    return tuple(cameras), "truth" if true_poses else "log", noise_source


def _true_poses(folder: Path, description: Description) -> dict[str, Trajectory]:
    moving = {name for name, entry in description.cameras.items() if not entry.poses.static}
    if description.truth is None or not moving or not moving <= set(description.truth.cameras):
        return {}
    table = read_table(folder / "truth_poses.parquet", CAMERA_POSES)
    return {name: trajectory_from(table[table["camera"] == name]) for name in sorted(moving)}


def _planned(folder: Path, description: Description) -> dict[str, tuple[Int64, Float]]:
    """Read the positions to which the on-board planner sent each camera of the session."""
    if not description.plan:
        return {}
    table = read_table(folder / "plan.parquet", PLAN)
    found = {}
    for name in (camera for camera in description.cameras if camera in description.plan):
        own = table[table["camera"] == name]
        found[name] = own["t_ns"].to_numpy(np.int64), own[["x", "y", "z"]].to_numpy(np.float64)
    return found


def _noise(
    name: str, entry: CameraEntry, logged: Trajectory, pose_noise: str | None
) -> tuple[tuple[NoiseModel, ...], str]:
    """Return the errors of a camera's poses, and the source of that statement."""
    models = stated_models(name, entry, pose_noise)
    if models is not None:
        return tuple(models), COMMAND_LINE if pose_noise else "flight.yaml"
    sigma = _logged_sigma(logged)
    if sigma is not None:
        white = White(position_m=sigma[0], rotation_deg=float(np.degrees(sigma[1])))
        return (white,), "the logs' covariances, as white noise"
    return (), "still cameras are exact" if entry.poses.static else "nobody"


def _logged_sigma(trajectory: Trajectory) -> tuple[float, float] | None:
    """Compute the median standard deviation per axis (m, rad) of the logged covariances."""
    if trajectory.covariance is None:
        return None
    variances, known_axes = known_variances(trajectory.covariance)
    known = [variances[:, block][known_axes[:, block]] for block in range(2)]
    if not all(values.size for values in known):
        return None
    position, rotation = (float(np.sqrt(np.median(values))) for values in known)
    return position, rotation


# A film of the arms has as many pictures; errors of five a second are nearly independent.
PICTURES_HZ = 5.0
# Errors of poses change slowly along a flight, so that the mean over 200 moments is that of all.
NOISE_LOOKS = 200


@dataclass(frozen=True)
class ReplanSettings:
    """Settings that determine a comparison, in addition to the session; None takes the session's value.

    `arms` are names (by default adaptive and fixed, joint or group, flown if cameras moved, planned if
    commands are logged), `drones` 2 to 20, `yaw_deg` the direction of the first camera at the start, from
    east. `trials` are draws of all errors with this `seed`; `pose_noise` is text as of `--pose-noise`, and
    `planner` has the settings of docs/planner.md.
    """

    arms: tuple[str, ...] | None = None
    drones: int | None = None
    yaw_deg: float | None = None
    trials: int = 100
    seed: int = 0
    pose_noise: str | None = None
    planner: PlannerConfig = field(default_factory=PlannerConfig)


def replan_settings(values: Mapping[str, object], source: Path | str, **others: Any) -> ReplanSettings:
    """Make settings of a mapping: those of the planner, and `yaw_deg`; DataError: one is unknown or wrong."""
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
        return np.tensordot(self.weights, self.people, 1)

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

    @property
    def first_slots(self) -> Float:
        """The places [N, T, 3] of the slots of the start's formation."""
        slots = formation_slots(
            np.array(self.yaw_rad), self.drones, tilt_rad=self.config.tilt_rad, range_m=self.config.radius_m
        )
        return self.actor + slot_offsets(slots)[:, None]

    def start_slots_inside(self) -> int:
        """Count the slots of the start that are within the drones' radius of an obstacle, or in it."""
        (_, first), *_ = self.maps_at(self.t_ns[:1])
        clearance_m = first.sample(self.first_slots[:, 0])[0]
        return int((clearance_m < self.config.drone_radius_m).sum())


def build_scene(
    flight: LoggedFlight,
    maps: Sequence[Occupancy],
    description: Description,
    settings: ReplanSettings,
    *,
    errors: ErrorModel | None = None,
) -> ReplayScene:
    """Prepare a comparison: distance fields, times, the first camera's start, and warnings."""
    notes = []
    unknown: Unknown = description.map.unknown if description.map else "free"
    maps = sorted(maps, key=lambda one: one.from_ns)
    fields = tuple(distance_field(one, unknown=unknown) for one in maps)
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
        notes.append(f"{drones} drones are replayed; cameras of the session: {len(flight.cameras)}")
    if settings.yaw_deg is not None:
        yaw_rad = float(np.radians(settings.yaw_deg))
    else:
        yaw_rad = float(slot_of(flown[0][0, 0] - actor[0])[YAW])
        first = flight.cameras[0].name
        notes.append(f"formations start at {np.degrees(yaw_rad):.1f} deg, where {first} was")
    scene = ReplayScene(
        flight=flight,
        settings=settings,
        drones=drones,
        yaw_rad=yaw_rad,
        t_ns=t_ns,
        people=people,
        actor_source=actor_source,
        fields=fields,
        flown=flown,
        notes=tuple(notes),
        warnings=(),
    )
    return replace(scene, warnings=(*flight.warnings, *map_doubts(scene, maps), *_doubts(scene)))


def with_pose_errors(
    errors: ErrorModel, flight: LoggedFlight, t_ns: Int64, position: Float, quaternion_xyzw: Float
) -> ErrorModel:
    """Take the errors of the poses (RMS) and the narrowest field of view from a flight as flown."""
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


def map_doubts(scene: ReplayScene, maps: Sequence[Occupancy]) -> list[str]:
    """List what the maps (in the order of `scene.fields`) lack where people walk and drones fly."""
    doubts = []
    if scene.fields and not any(field.has_obstacles for field in scene.fields):
        doubts.append("nothing in the map is occupied")
    held = {id(field): one for field, one in zip(scene.fields, maps, strict=True)}
    shown = [(rows, held[id(field)]) for rows, field in scene.maps if id(field) in held]
    ways = {"the actor's way": scene.people, "the way of the drones' first slots": scene.first_slots}
    for name, way in ways.items() if shown else ():
        found = np.concatenate([_probability_at(one, way[:, rows]).ravel() for rows, one in shown])
        outside, unknown = float((found == OUTSIDE).mean()), float(np.isnan(found).mean())
        if outside > 0.0:
            doubts.append(
                f"the map does not cover {100 * outside:.0f} % of {name}: what lies outside is free"
            )
        if unknown > 0.0:
            doubts.append(f"the map knows nothing of {100 * unknown:.0f} % of {name}")
    above = [_ground_above_feet(one, scene.people[:, rows].reshape(-1, 3)) for rows, one in shown]
    known = np.concatenate(above) if above else np.empty(0)
    known = known[np.isfinite(known)]
    if len(known) and abs(offset_m := float(np.median(known))) > LARGEST_OFFSET_M:
        side = "above" if offset_m > 0 else "below"
        doubts.append(f"the map's ground is {abs(offset_m):.1f} m {side} the actor's feet: check its heights")
    return doubts


def _probability_at(occupancy: Occupancy, points: Float) -> Float:
    """Look up the voxels of points [..., 3]: NaN where unknown, `OUTSIDE` beyond the map."""
    place = np.floor((points - occupancy.origin) / occupancy.resolution_m).astype(np.int64)
    inside = ((place >= 0) & (place < occupancy.probability.shape)).all(axis=-1)
    found = np.full(inside.shape, OUTSIDE)
    found[inside] = occupancy.probability[tuple(place[inside].T)]
    return found


def _ground_above_feet(occupancy: Occupancy, hips: Float) -> Float:
    """Compute how far the ground, a column's lowest occupied voxels, is above the feet of hips [K, 3]."""
    place = np.floor((hips - occupancy.origin) / occupancy.resolution_m).astype(np.int64)[:, :2]
    inside = ((place >= 0) & (place < occupancy.probability.shape[:2])).all(axis=1)
    above = np.full(len(hips), np.nan)
    columns = occupancy.probability[tuple(place[inside].T)] >= OCCUPIED
    first = columns.argmax(axis=1)
    free = ~columns & (np.arange(columns.shape[1]) > first[:, None])
    top = np.where(free.any(axis=1), free.argmax(axis=1), columns.shape[1])
    ground = occupancy.origin[2] + top * occupancy.resolution_m
    feet = hips[inside, 2] - HIP_ABOVE_POINT_M["feet"]
    above[inside] = np.where(columns.any(axis=1), ground - feet, np.nan)
    return above


def _doubts(scene: ReplayScene) -> list[str]:
    """List problems of the start and the skeleton, one line each."""
    doubts = []
    fields = scene.fields
    if fields and fields[0].from_ns > scene.t_ns[0]:
        late_s = min((fields[0].from_ns - int(scene.t_ns[0])) / 1e9, float(scene.t_s[-1]))
        doubts.append(f"the first map comes {late_s:.1f} s after the start: nothing is known until then")
    inside = scene.start_slots_inside()
    if inside:
        doubts.append(
            f"{inside} of {scene.drones} drones start within {scene.config.drone_radius_m:g} m of an obstacle"
            " and leave by the shortest way: choose another yaw_deg, radius_m or tilt_deg"
        )
    doubts += scene.config.out_of_reach()
    if scene.flight.skeleton is None:
        doubts.append("no skeleton to look at, so no reconstruction error: run `mocap reconstruct` first")
    return doubts
