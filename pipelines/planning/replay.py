"""Replay of an arm: its planner in flight (`Pilot`), offline, against the logged actor and the maps.

Measurements are simulated: the visibility of joints is exact, by field of view and map; the errors of the
detector and of the logged poses are random, with the same seeds for every arm. Equal arguments give equal
replays. No measurement or map is used before its time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, starmap
from typing import NamedTuple, Protocol

import numpy as np
import pandas as pd

from pipelines.geometry.arrays import Bool, Float, Float32, Int64, Intrinsics
from pipelines.geometry.cameras import project, undistort
from pipelines.geometry.noise import (
    EXACT,
    ROTATION,
    SHIFT_IN_CAMERA,
    NoiseModel,
    Process,
    disturb,
    pose_errors,
)
from pipelines.geometry.poses import (
    conjugate,
    cross_matrix,
    invert,
    look_at,
    matrix_from_quaternion,
    multiply,
    rotation_vector_from_quaternion,
    transform,
)
from pipelines.geometry.triangulation import PIXEL_SIGMA_PX, Views, triangulate
from pipelines.planning.arms import Arm, RollingOut
from pipelines.planning.config import MOST_DRONES, Imperfections, PlannerConfig
from pipelines.planning.distance_field import DistanceField, MapsInTurn, looked, open_space, visible
from pipelines.planning.forecast import ActorFilter, Forecast, positions_at
from pipelines.planning.formation import (
    TILT,
    YAW,
    FormationPath,
    formation_slots,
    slot_of,
    slot_offsets,
    wrapped,
)
from pipelines.planning.guard import FlownMotion, Guard
from pipelines.planning.local import DronePlan, LocalPlanner, tracking_times
from pipelines.planning.scene import ReplayScene, planned_positions
from pipelines.planning.scores import errors_of_views, hidden_by_people, sights, used_kj

# Times are sums of periods: what is due this much early is due.
DUE_ROUNDING_S = 1e-6
# A link that breaks comes back within seconds.
OUTAGE_S = 2.0
# Gusts at the height of drones last for seconds.
GUST_S = 2.0
# Outages and gusts are the same for every arm: they are drawn by the comparison's seed and these numbers.
OUTAGE_STREAM, GUST_STREAM = 1, 2
# Gusts blow half as strongly upwards as along level axes.
GUST_SHARES = (1.0, 1.0, 0.5)
# Rotors of small drones drag by 0.2 to 0.5 of the air's speed a second (Faessler et al. 2018).
DRAG_PER_S = 0.3


class Start(NamedTuple):
    """Formation at the start of a flight."""

    drones: int  # 1 to 20
    yaw_rad: float = 0.0  # of the first camera, counterclockwise from east


@dataclass(frozen=True)
class ArmFlight:
    """Poses of the N cameras of an arm at the T times of the scene."""

    names: tuple[str, ...]
    position: Float  # [N, T, 3] m, world
    quaternion_xyzw: Float  # [N, T, 4] world_from_camera
    slots: Float  # [N, T, 3] commanded yaw (rad from east, continuous), tilt (rad), range (m); NaN: `flown`
    aim: Float  # [N, T, P] shares of people in the place that each camera films
    known: Bool  # [N, T] False where a log has a gap, or a battery is empty
    safety: dict[str, int]  # local plannings by `guard.FlownMotion`; empty for logged arms


@dataclass(frozen=True)
class Replay(ArmFlight):
    """A replayed flight, aimed at the estimate; its times are the tracking steps."""

    t_ns: Int64  # [T] on the clock of the actor's log
    velocity: Float  # [N, T, 3] m/s
    actor: Float  # [T, 3] the log, interpolated; of several people the weighted middle
    estimate: Float  # [N, T, 3] the planner's estimate of whom each camera films

    @property
    def t_s(self) -> Float:
        """Seconds [T] since the start."""
        seconds: Float = (self.t_ns - self.t_ns[0]) / 1e9
        return seconds


class Pilot:
    """One arm in flight. Call `measure` at each measurement and `replan` at the tracking rate."""

    def __init__(
        self, arm: Arm, config: PlannerConfig, start: Start, *, weights: Sequence[float] = (1.0,)
    ) -> None:
        if not 1 <= start.drones <= MOST_DRONES:
            raise ValueError(f"{start.drones} drones: 1 to {MOST_DRONES} can be planned for")
        self._config = config
        self._formation_planner = arm.start(config, drones=start.drones, yaw_rad=start.yaw_rad)
        planner = self._formation_planner
        self._rolling_out = planner if isinstance(planner, RollingOut) else None
        self._local_planner = LocalPlanner(config)
        self._weight = np.array(weights, dtype=np.float64)
        self._by_weight = np.tile(self._weight / self._weight.sum(), (start.drones, 1))
        sigma_m = config.tuning.actor_sigma_m
        self._filter = ActorFilter(q=config.actor_q, sigma_m=sigma_m, weight=weights)
        slots = formation_slots(
            np.array([start.yaw_rad]), start.drones, tilt_rad=config.tilt_rad, range_m=config.radius_m
        )
        self._formation = FormationPath(np.zeros(1), slots, np.array(config.slot_rates))
        self._plans: list[DronePlan | None] = [None] * start.drones
        self._next_central_s = self._next_local_s = -np.inf
        self.guard: Guard | None = None
        """Filter of the local plans: it decides which motion is flown. Set by a replay; None otherwise."""
        self.connected = True
        """False while no new formation reaches the drones."""

    def measure(self, t_s: float, position: Float, person: int = 0) -> None:
        """Take in the position [3] of the actor or of one of several people: the hips' middle, m, world.

        Times of a person must not go back. Everybody must be measured before the first `replan`.
        """
        self._filter.measure(t_s, position, person)

    def replan(self, t_s: float, position: Float, velocity: Float, field: DistanceField) -> None:
        """Replan if a plan is due at `t_s`, from the latest measurement of at least one.

        `position` [N, 3] m and `velocity` [N, 3] m/s are the drones'; `field` has the obstacles known now.
        """
        config = self._config
        if t_s >= self._next_central_s - DUE_ROUNDING_S:
            self._next_central_s = max(self._next_central_s, t_s) + 1.0 / config.tuning.central_hz
            if self.connected:
                self._plan_formation(t_s, position, velocity, field)
        if t_s >= self._next_local_s - DUE_ROUNDING_S:
            self._next_local_s = max(self._next_local_s, t_s) + 1.0 / config.tuning.local_hz
            self._plan_locally(t_s, position, velocity, field)

    @property
    def aim(self) -> Float:
        """Shares [N, P] of people in the place that each camera films: by weight, unless the arm chooses."""
        return self._by_weight if self._formation.aim is None else self._formation.aim

    @property
    def due_s(self) -> float:
        """Time from which `replan` makes the next plan."""
        return min(self._next_central_s, self._next_local_s) - DUE_ROUNDING_S

    def wanted(self, t_s: Float) -> tuple[Float, Float]:
        """Return commanded slots [T, N, 3], yaw from east, and the places [N, T, 3] that cameras aim at."""
        return self._formation.at(t_s), self._aimed(t_s)

    def reference(self, t_s: float) -> tuple[Float, Float]:
        """Return position and velocity [N, 3] of the latest local plans, after `replan`."""
        asked = [plan.at(np.array([t_s]))[:2] for plan in self._plans if plan is not None]
        where, speed = (np.concatenate(part) for part in zip(*asked, strict=True))
        return where, speed

    def _aimed(self, t_s: Float) -> Float:
        """Return the places [N, T, 3] that cameras film, and about which their slots are."""
        people = self._filter.each(t_s)
        aimed: Float = self.aim @ people.reshape(len(people), -1)
        return aimed.reshape(-1, *people.shape[1:])

    def _plan_formation(self, t_s: float, position: Float, velocity: Float, field: DistanceField) -> None:
        config = self._config
        knots = t_s + config.tuning.knot_s * np.arange(1, config.horizon_knots + 1, dtype=np.float64)
        commanded = self._formation.at(np.array([t_s]))[0]
        people = self._filter.each(knots)
        actor = Forecast(self._filter.middle(people), people, self._weight)
        if self._rolling_out is not None:
            self._rolling_out.roll_out = partial(
                self._roll_out, t_s=t_s, position=position, velocity=velocity, field=field
            )
        self._formation = self._formation_planner.plan(t_s, commanded, actor, field)

    def _wanted_ahead(self, path: FormationPath, t_s: float) -> tuple[Float, Float]:
        """Return wanted places of drones [T, N, 3] and the places [N, T, 3] that they film, at waypoints."""
        config = self._config
        times = t_s + config.tuning.waypoint_s * np.arange(1, config.tuning.waypoints + 1, dtype=np.float64)
        aimed = self._aimed(times)
        return aimed.swapaxes(0, 1) + slot_offsets(path.at(times)), aimed

    def _roll_out(
        self, path: FormationPath, *, t_s: float, position: Float, velocity: Float, field: DistanceField
    ) -> tuple[Float, Float]:
        """Predict the flight along a path (`arms.RollOut`): the drones plan locally, one after the other."""
        wanted, aimed = self._wanted_ahead(path, t_s)
        made: list[DronePlan] = []
        people = self._people_ahead(t_s)
        for i, previous in enumerate(self._plans):
            plan = self._local_planner.plan(
                t_s,
                position[i],
                velocity[i],
                slots=wanted[:, i],
                actor=aimed[i],
                others=made,
                people=people,
                field=field,
                previous=previous,
            )
            made.append(plan)
        return np.stack([plan.path[1:] for plan in made]), aimed[0]

    def _people_ahead(self, t_s: float) -> Float:
        """Forecast everybody, [P, N + 1, 3], now and at the waypoints."""
        tuning = self._config.tuning
        return self._filter.each(t_s + tuning.waypoint_s * np.arange(tuning.waypoints + 1, dtype=np.float64))

    def _plan_locally(self, t_s: float, position: Float, velocity: Float, field: DistanceField) -> None:
        slots, aimed = self._wanted_ahead(self._formation, t_s)
        people = self._people_ahead(t_s)
        for i in range(len(self._plans)):
            made = self._local_planner.plan(
                t_s,
                position[i],
                velocity[i],
                slots=slots[:, i],
                actor=aimed[i],
                others=[plan for j, plan in enumerate(self._plans) if j != i and plan is not None],
                people=people,
                field=field,
                previous=self._plans[i],
            )
            self._plans[i] = (
                made if self.guard is None else self.guard.admit(i, t_s, made, self._filter, field)
            )


def replay(
    arm: Arm,
    actor_t_ns: Int64,
    actor: Float,
    fields: Sequence[DistanceField],
    start: Start,
    *,
    config: PlannerConfig,
    weights: Sequence[float] = (1.0,),
    names: Sequence[str] = (),
    seed: int = 0,
) -> Replay:
    """Fly an arm against a log.

    The drones start in their slots, at rest, and fly what `guard.Guard` admits. `actor` [A, 3] m, world, is
    the middle of the hips, or [A, P, 3] of several people: one actor for most arms, in their weighted middle;
    `group` decides whom each drone films. NaN was not measured; the replay lasts while everybody is. `fields`
    are the maps by the time from which they hold; before the first nothing is known. `seed` draws outages and
    gusts. ValueError: times that do not ascend, fewer than two measurements, an impossible number of drones.
    """
    people = actor if actor.ndim == 3 else actor[:, None]
    measured_then = np.isfinite(people.sum(axis=2))  # [A, P]
    rows = measured_then.any(axis=1)
    t_ns, measured, known = actor_t_ns[rows], people[rows], measured_then[rows]
    if known.sum(axis=0).min() < 2 or (np.diff(t_ns) <= 0).any():
        raise ValueError("a replay needs two measurements of the actor or more, their stamps ascending")
    first, last = int(known.argmax(axis=0).max()), len(t_ns) - int(known[::-1].argmax(axis=0).max())
    log_s = (t_ns - t_ns[first]) / 1e9
    maps = sorted(fields, key=lambda field: field.from_ns)
    replay_ns = tracking_times(t_ns[first:last], config)
    seen_ns = replay_ns - round(1e9 * config.imperfections.latency_s)
    map_at = np.searchsorted([field.from_ns for field in maps], seen_ns, side="right")
    fields_known = [open_space(), *maps]
    taken_in = np.maximum(np.searchsorted(t_ns, seen_ns, side="right"), first + 1)
    times_s = (replay_ns - t_ns[first]) / 1e9
    lost = outages(times_s, config.imperfections, seed)
    heard = known & ~np.append(lost, False)[np.searchsorted(times_s, log_s).clip(0, len(lost))][:, None]

    weight = np.array(weights, dtype=np.float64)
    pilot = Pilot(arm, config, start, weights=weights)
    for row, person in np.argwhere(known[: first + 1]):
        pilot.measure(log_s[row], measured[row, person], person)
    first_slots, first_estimate = pilot.wanted(np.zeros(1))
    guard = pilot.guard = Guard(first_estimate[:, 0] + slot_offsets(first_slots[0]), config)
    shape = (start.drones, len(replay_ns), 3)
    position, velocity, slots, estimate = (np.empty(shape) for _ in range(4))
    aim = np.empty((*shape[:2], len(weight)))
    done, k = first + 1, 0
    while k < len(times_s):
        if taken_in[k] > done:
            for row, person in np.argwhere(heard[done : taken_in[k]]):
                pilot.measure(log_s[done + row], measured[done + row, person], person)
            done = int(taken_in[k])
        pilot.connected = not lost[k]
        pilot.replan(float(times_s[k]), guard.position, guard.velocity, fields_known[map_at[k]])
        measured_next = int(np.searchsorted(taken_in, done, side="right"))
        planned_next = int(np.searchsorted(times_s, pilot.due_s))
        until = slice(k, max(min(measured_next, planned_next), k + 1))  # nothing new before
        wanted, estimate[:, until] = pilot.wanted(times_s[until])
        slots[:, until], aim[:, until] = wanted.swapaxes(0, 1), pilot.aim[:, None]
        position[:, until], velocity[:, until] = guard.fly(until.stop - k)
        k = until.stop
    position = blown(position, times_s, config, seed)
    battery_kj = config.imperfections.battery_kj
    return Replay(
        names=tuple(names),
        t_ns=replay_ns,
        position=position,
        velocity=velocity,
        quaternion_xyzw=aimed(position, estimate, times_s, config.imperfections),
        slots=slots,
        actor=np.tensordot(weight / weight.sum(), positions_at(t_ns, measured, replay_ns), 1),
        estimate=estimate,
        aim=aim,
        known=np.ones(shape[:2], dtype=np.bool_)
        if battery_kj is None
        else used_kj(times_s, position, config) <= battery_kj,
        safety={kind.value: guard.counts[kind] for kind in FlownMotion},
    )


FLOWN = "flown"
"""Name of the arm that is no planner: the flight in the log."""
PLANNED = "planned"
"""Name of the other arm that is no planner: the commands of the planner on board, as logged."""
LOGGED = (FLOWN, PLANNED)

# The joint estimate lets joints accelerate by this factor, or it would smooth kicks (`refine`).
FAST_MOTION = 2.0
# A person who stands sways; without any acceleration one error would be that of the whole flight.
MIN_ACCELERATION_MPS2 = 0.1
# Fewer pictures have no second difference in their middle.
MIN_SMOOTHED_TIMES = 4
# What all joints share is not farther off than this, even where no view tells it.
FARTHEST_M = 100.0
# This much information (1/m^2) keeps equations solvable where nothing was measured.
LEAST_INFORMATION = 1e-6
# And so does this share of the stiffness, where that is larger.
LEAST_OF_STIFFNESS = 1e-10
# A person's feet are about this far below the middle of the hips: there cameras see the same ground.
HIPS_ABOVE_GROUND_M = 0.9
# Two cameras place the same ground this differently on each axis, when the ground has bound them.
GROUND_SIGMA_M = 0.015
# What backgrounds leave of changing errors (m, rad): the least levels that `background` estimates.
BACKGROUND_SIGMA = (1e-3, 1e-4)
# Slow errors are linear between knots at least this far apart, and these are at most so many.
KNOT_S, MOST_KNOTS = 2.0, 40
# One random stream for each: poses err alike in every measurement, however many numbers a detector draws.
POSES, KEYPOINTS = range(2)
# Trials are measured together until they have so many errors of joints: some 150 MB with what they need.
ERRORS_TOGETHER = 4_000_000
# Keypoints below this confidence are left out, as in `mocap reconstruct`.
MIN_CONFIDENCE = 0.3

_POSITION = ["x", "y", "z"]
_QUATERNION = ["qx", "qy", "qz", "qw"]
_SLOT = ["slot_yaw_rad", "slot_tilt_rad", "slot_range_m"]


def logged_arm(scene: ReplayScene, name: str) -> ArmFlight:
    """Return the flight of one of `LOGGED`; cameras of `planned` look at the estimate, as in a replay."""
    if name == FLOWN:
        position, quaternion, known = scene.flown
        names = [camera.name for camera in scene.flight.cameras]
        slots = np.full_like(position, np.nan)
    else:
        names = list(scene.flight.planned)
        position, known = planned_positions(scene.flight, scene.t_ns)
        estimates = _estimates(scene)
        quaternion, slots = look_at(position, estimates), slot_of(position - estimates)
        slots[..., YAW] = np.unwrap(slots[..., YAW], axis=1)
    # These cameras film the weighted middle.
    aim = np.broadcast_to(scene.weights, (*known.shape, len(scene.weights)))
    return ArmFlight(tuple(names), position, quaternion, slots, aim, known, {})


def aimed_at(scene: ReplayScene, flown: ArmFlight) -> Float:
    """Compute the places [N, T, 3] that the cameras film, by the reference of the scores."""
    places: Float = np.einsum("ntp,ptx->ntx", flown.aim, scene.people)
    return places


def seen_people(scene: ReplayScene, flown: ArmFlight) -> Bool:
    """Test [P, N, T] who is seen from which camera."""
    return sights(flown.position, looks_rad(flown), scene.people, scene.maps, scene.config)


def looks_rad(flown: ArmFlight) -> Float:
    """Compute the yaw [N, T] of the optical axes from east."""
    axis = matrix_from_quaternion(flown.quaternion_xyzw)[..., 2]
    return np.arctan2(axis[..., 1], axis[..., 0])


def _estimates(scene: ReplayScene) -> Float:
    """Estimate the actor's positions [T, 3] as planners do, from no later measurement."""
    flight, tuning = scene.flight, scene.config.tuning
    actor = ActorFilter(q=scene.config.actor_q, sigma_m=tuning.actor_sigma_m, weight=scene.weights)
    known = np.isfinite(flight.actor[..., 0])
    log_s = (flight.actor_t_ns - flight.actor_t_ns[0]) / 1e9
    until = np.searchsorted(flight.actor_t_ns, scene.t_ns, side="right")
    found, taken = np.empty((len(scene.t_ns), 3)), 0
    for k, t_s in enumerate((scene.t_ns - flight.actor_t_ns[0]) / 1e9):
        for row, person in np.argwhere(known[taken : until[k]]):
            actor.measure(log_s[taken + row], flight.actor[taken + row, person], person)
        taken = int(until[k])
        found[k] = actor.middle(actor.each(np.array([t_s])))[0]
    return found


def fly_arm(scene: ReplayScene, arm: Arm) -> ArmFlight:
    """Fly a scene again with an arm's planner."""
    return replay(
        arm,
        scene.flight.actor_t_ns,
        scene.flight.actor,
        scene.fields,
        Start(scene.drones, scene.yaw_rad),
        config=scene.config,
        weights=scene.flight.weights,
        names=scene.names,
        seed=scene.settings.seed,
    )


def measure_arm(scene: ReplayScene, flown: ArmFlight, detect: Detect) -> MeasuredJoints | None:
    """Simulate what an arm's cameras measure of skeletons; it is known which keypoints belong to whom."""
    if scene.joints is None:
        return None
    cameras = scene.flight.cameras
    own = {camera.name: camera for camera in cameras}
    carried = [own.get(name, cameras[k % len(cameras)]) for k, name in enumerate(flown.names)]
    pictures = scene.pictures
    paths = CameraPaths(
        t_ns=scene.t_ns[pictures],
        position=flown.position[:, pictures],
        quaternion_xyzw=flown.quaternion_xyzw[:, pictures],
        known=flown.known[:, pictures],
        intrinsics=[camera.intrinsics for camera in carried],
        noise=[camera.noise for camera in carried],
        joints=scene.joints,
        middle=scene.actor[pictures],
    )
    people, each = scene.people[:, pictures], np.split(scene.joints, len(scene.people), axis=1)
    found = [
        measure(
            replace(paths, joints=each[p], middle=people[p], person=p, others=np.delete(people, p, axis=0)),
            scene.maps_at(paths.t_ns),
            detect,
            start_m=scene.config.tuning.sight_start_m,
            trials=scene.settings.trials,
            seed=scene.settings.seed,
        )
        for p in range(len(people))
    ]
    return joined(found)


def trajectories(scene: ReplayScene, flown: ArmFlight) -> pd.DataFrame:
    """Return the rows of `tables.REPLAN`."""
    count, times = flown.position.shape[:2]
    position, slots = _rows(flown.position), _rows(flown.slots)
    seen = seen_people(scene, flown)
    error = errors_of_views(flown.position, scene.people, seen, scene.config).mean(axis=0)
    table = pd.DataFrame(
        {"t_ns": np.repeat(scene.t_ns, count), "camera": np.tile(np.array(flown.names, dtype=object), times)}
    )
    table[_POSITION] = position
    table[_QUATERNION] = _rows(flown.quaternion_xyzw)
    table["formation_yaw_rad"] = np.repeat(flown.slots[0, :, 0], count)
    table[_SLOT] = slots
    table["tilt_rad"] = _rows(slot_of(flown.position - aimed_at(scene, flown)))[:, TILT]
    table["visible"] = seen.any(axis=0).T.ravel()
    table["predicted_error_m"] = np.repeat(np.where(np.isfinite(error), error, np.nan), count)
    table["known"] = flown.known.T.ravel()
    return table


def flight_from(table: pd.DataFrame, aim: Float, safety: dict[str, int]) -> ArmFlight:
    """Rebuild the flight that `trajectories` stored."""
    names, position, quaternion = poses_from(table)
    slots = _dense(table, _SLOT, len(names))
    return ArmFlight(names, position, quaternion, slots, aim, known_from(table, len(names)), safety)


def known_from(table: pd.DataFrame, cameras: int) -> Bool:
    """Return where cameras have a pose and film, [N, T], of stored trajectories."""
    known: Bool = table["known"].to_numpy(np.bool_).reshape(-1, cameras).T
    return known


def poses_from(table: pd.DataFrame) -> tuple[tuple[str, ...], Float, Float]:
    """Return the cameras' names, positions [N, T, 3] and quaternions [N, T, 4] of stored trajectories."""
    names = tuple(dict.fromkeys(table["camera"]))
    return names, _dense(table, _POSITION, len(names)), _dense(table, _QUATERNION, len(names))


def _dense(table: pd.DataFrame, columns: list[str], cameras: int) -> Float:
    rows = table[columns].to_numpy(np.float64).reshape(-1, cameras, len(columns))
    return np.ascontiguousarray(rows.swapaxes(0, 1))


def _rows(values: Float) -> Float:
    """Return [N, T, K] as rows sorted by time, then camera."""
    return values.swapaxes(0, 1).reshape(-1, values.shape[2])


class Detect(Protocol):
    """Function that simulates a keypoint detector on one camera's pictures."""

    def __call__(
        self,
        pixels: Float,
        free: Bool,
        camera: Float,
        target: Float,
        skeleton: Float,
        focal_px: float,
        rng: np.random.Generator,
        /,
    ) -> tuple[Float, Float]:
        """Return keypoints [T, J, 2] px (NaN: missed) and confidences [T, J] of exact pixels.

        `free` [T, J] is where nothing hides the joint, `camera` and `target` (the person's middle) are [T, 3]
        m, world, the `skeleton` [T, J, 3]. As many random numbers are drawn for any visibility.
        """


@dataclass(frozen=True)
class CameraPaths:
    """Cameras N on their paths at the times T of their pictures, and the filmed person."""

    t_ns: Int64  # [T]
    position: Float  # [N, T, 3] m, world
    quaternion_xyzw: Float  # [N, T, 4] world_from_camera
    known: Bool  # [N, T] True where the camera has a pose; other pictures are not used
    intrinsics: Sequence[Intrinsics]
    noise: Sequence[Sequence[NoiseModel]]
    joints: Float  # [T, J, 3] m, world; NaN where unknown
    middle: Float  # [T, 3] m, world, of the person
    person: int = 0  # number, for draws of their own
    others: Float | None = None  # [Q, T, 3] m, world: hips of others, who can stand in the way


@dataclass(frozen=True)
class MeasuredJoints:
    """Result of the simulated measurements."""

    error_m: Float32  # [trials, T, J]; NaN where the joint was not measured or the truth is unknown
    joint_frames: int  # with a truth


def measure(
    paths: CameraPaths,
    maps: DistanceField | MapsInTurn,
    detect: Detect,
    *,
    start_m: float,
    trials: int,
    seed: int,
) -> MeasuredJoints:
    """Measure a skeleton in several trials; sight is tested in the map of each moment.

    Joints are triangulated by `robust` in the true poses and smoothed; the error that `auto` leaves of poses
    is added (`_Smoother`). The last `start_m` of a sight line, next to the joint, is left out: maps contain
    the person. Trial k of camera i has the same random numbers for any other path.
    """
    joints = paths.joints
    cameras, times, count = len(paths.position), *joints.shape[:2]
    pixels = np.stack([_pixels(paths, i) for i in range(cameras)])
    known = np.isfinite(joints[..., 0])
    standing_in = np.where(known[..., None], joints, paths.middle[:, None])
    knees = paths.middle[:, None] - [0.0, 0.0, HIPS_ABOVE_GROUND_M / 2]
    looked_at = np.concatenate([standing_in, knees], axis=1)
    sights_free = looked(
        maps,
        lambda field, rows: visible(field, paths.position[:, rows, None], looked_at[rows], start_m=start_m),
        axis=1,
    )
    free, near_ground = sights_free[..., :-1], sights_free[..., -1]
    if paths.others is not None and len(paths.others):
        eyes, others = paths.position[:, :, None], paths.others[:, None, :, None]
        free &= ~hidden_by_people(eyes, standing_in, others)
    error = np.empty((trials, times, count), dtype=np.float32)
    smoother = _Smoother(paths, standing_in, near_ground)
    true_rotation = matrix_from_quaternion(paths.quaternion_xyzw)
    for together in np.array_split(
        np.arange(trials), min(trials, 1 + trials * known.size // ERRORS_TOGETHER)
    ):
        own = np.full((len(together), times, count, 3), np.nan, dtype=np.float32)
        logged = np.empty((len(together), times, cameras, 6))
        passed = np.empty((len(together), times, cameras, 3))
        for row, trial in enumerate(together.tolist()):
            rays = np.empty((times, count, cameras, 2))
            weight = np.empty((times, count, cameras))
            for i, lens in enumerate(paths.intrinsics):
                path, attitude = paths.position[i], paths.quaternion_xyzw[i]
                rng = np.random.default_rng([seed, POSES, trial, i])
                shifted, turned = disturb(paths.noise[i], paths.t_ns, path, attitude, rng)
                logged[row, :, i, :3] = shifted - path
                logged[row, :, i, 3:] = rotation_vector_from_quaternion(multiply(conjugate(attitude), turned))
                rng = np.random.default_rng([seed, KEYPOINTS, trial, i, paths.person])
                xy, confidence = detect(pixels[i], free[i], path, paths.middle, joints, _focal(lens), rng)
                rays[:, :, i] = undistort(xy, lens)
                weight[:, :, i] = np.where(confidence >= MIN_CONFIDENCE, confidence, 0.0)
            views = Views(
                rays=rays.reshape(-1, cameras, 2),
                weight=weight.reshape(-1, cameras),
                pose_index=np.repeat(np.arange(times), count),
                position=paths.position.swapaxes(0, 1),
                rotation=true_rotation.swapaxes(0, 1),
                focal=np.array([_focal(lens) for lens in paths.intrinsics]),
                pixel_sigma=np.full(cameras, PIXEL_SIGMA_PX),
                pose_sigma=np.zeros((times, cameras, 2)),
            )
            found = triangulate(views, method="robust", with_covariance=False)
            off = found.points.reshape(joints.shape) - joints
            seen = found.inlier.reshape(times, count, cameras) & np.isfinite(off[..., :1])
            passed[row] = smoother.passed(rays, seen)
            own[row] = smoother.own(off, seen)
        for row, shared in enumerate(smoother.shared(passed, logged)):
            error[together[row]] = np.linalg.norm(own[row] + shared[:, None], axis=-1)
    return MeasuredJoints(error, int(known.sum()))


class _Smoother:
    """Errors that the joint estimate leaves of triangulated joints.

    Each joint's own error is smoothed by the least accelerations, as large as those of the joints, that agree
    with its keypoints. The error that all joints share is that of a linear estimate with the unknowns and the
    evidence of `auto`. Its background leaves each camera a shift, a rotation and a scale of its whole path
    about its middle (7 numbers). Unknown are these, the constant and slow errors of the log, and the shared
    error at each time. Evidence are the log, the ground near the person while two cameras see it, the mean
    keypoint of each picture, and the smoothness of the shared error. `ground` is where cameras see that
    ground, [N, T]: nothing hides the person's knees.
    """

    def __init__(self, paths: CameraPaths, joints: Float, ground: Bool) -> None:
        self._ground = ground
        step_s = float(np.median(np.diff(paths.t_ns))) / 1e9 if len(paths.t_ns) > 1 else 1.0
        change = np.diff(paths.joints, 2, axis=0) / step_s**2
        shared = change.mean(axis=1, keepdims=True) if change.size else change
        moving = np.concatenate([shared, change - shared], axis=1)
        known = np.isfinite(moving[..., 0])
        square = np.where(known, np.sum(moving**2, axis=-1), 0.0).sum(axis=0) / np.maximum(
            known.sum(axis=0), 1
        )
        least = np.maximum(FAST_MOTION * np.sqrt(square / 3.0), MIN_ACCELERATION_MPS2)
        self._stiffness = 1.0 / (least * step_s**2) ** 2
        self._paths, self._joints = paths, joints
        self._pixel = np.array([(PIXEL_SIGMA_PX / _focal(lens)) ** 2 for lens in paths.intrinsics])[:, None]
        across, square_m2 = _across_ray(paths.position[:, :, None] - joints)
        own = across / (self._pixel[..., None] * square_m2)[..., None, None]
        self._information = own  # [N, T, J, 3, 3]
        self._away = joints - paths.position[:, :, None]
        self._axes = np.moveaxis(matrix_from_quaternion(paths.quaternion_xyzw), -1, 0)[..., None, :]

    def passed(self, rays: Float, seen: Bool) -> Float:
        """Compute by how much (m) rays [T, J, N, 2] pass joints that are seen [T, J, N]: means [T, N, 3]."""
        where: Float = seen.transpose(2, 0, 1).astype(np.float64)
        x, y = np.where(seen[..., None], rays, 0.0).transpose(3, 2, 0, 1)[..., None]
        along = self._axes[0] * x + self._axes[1] * y + self._axes[2]
        depth = np.einsum("ntja,ntja->ntj", along, self._away) / np.einsum("ntja,ntja->ntj", along, along)
        past = along * depth[..., None] - self._away
        total = np.einsum("ntja,ntj->nta", past, where)
        count = where.sum(axis=2)[..., None]
        mean: Float = np.where(count > 0, total / np.maximum(count, 1), np.nan).swapaxes(0, 1)
        return mean

    def own(self, off: Float, seen: Bool) -> Float:
        """Smooth what errors [T, J, 3] m do not share, of joints that cameras see, [T, J, N]; NaN stays."""
        there = np.isfinite(off[..., 0])
        own = np.einsum("ntjab,tjn->tjab", self._information, seen.astype(np.float64))
        weighted = np.einsum("tjab,tjb->tja", own, np.where(there[..., None], off, 0.0))
        total = own.sum(axis=1) + np.eye(3) / FARTHEST_M**2
        shared = np.linalg.solve(total, weighted.sum(axis=1)[..., None])[..., 0]
        series = np.where(there[..., None], off - shared[:, None], 0.0)
        if len(off) >= MIN_SMOOTHED_TIMES:
            right = (weighted - np.einsum("tjab,tb->tja", own, shared))[..., None].swapaxes(0, 1)
            series = smooth(right, own.swapaxes(0, 1), self._stiffness[1:])[..., 0].swapaxes(0, 1)
        return np.where(there[..., None], series, np.nan)

    def shared(self, passed: Float, logged: Float) -> Float:
        """Compute the error [K, T, 3] m that all joints share, in K trials.

        Keypoints pass joints by `passed` [K, T, N, 3] m on average, NaN where none was found; `logged`
        [K, T, N, 6] are the errors of the log, positions in the world (m) and rotations in the camera (rad).
        """
        paths, (trials, times, cameras) = self._paths, passed.shape[:3]
        across, square_m2 = _across_ray(paths.position - paths.middle)
        often = np.isfinite(passed[..., 0]).mean(axis=0).T > 0.5  # [N, T]
        sure = often * self._joints.shape[1] / (self._pixel * square_m2)
        weight = across * sure[..., None, None]  # [N, T, 3, 3]
        gaps = pd.DataFrame(passed.swapaxes(0, 1).reshape(times, -1))
        filled = gaps.interpolate(limit_direction="both").fillna(0.0).to_numpy().reshape(times, trials, -1, 3)
        seen = np.einsum("ntab,tknb->ntak", weight, filled)
        own = [self._unknowns(i) for i in range(cameras)]
        ends = np.cumsum([0, *(of.prior.shape[0] for of in own)])
        normal, right = np.zeros((ends[-1], ends[-1])), np.zeros((ends[-1], trials))
        pulled, paired = [], np.zeros((cameras, 7, cameras, 7))
        for i, (of, mine) in enumerate(zip(own, starmap(slice, pairwise(ends)), strict=True)):
            pulled.append(weight[i] @ of.at_person)
            normal[mine, mine] = of.prior + _squared(of.of_log, of.of_log)
            errors = logged[:, :, i].transpose(1, 2, 0) / of.log_sigma[:, None]
            right[mine] = _squared(of.of_log, errors)
            right[mine][:7] -= _squared(of.at_person, seen[i])
            paired[i, :, i] += _squared(of.at_person, pulled[i])
            for k in range(i):
                rows = self._ground[i] & self._ground[k]
                differ = np.concatenate([of.at_ground[rows], -own[k].at_ground[rows]], axis=-1)
                both = _squared(differ, differ).reshape(2, 7, 2, 7) / (times * GROUND_SIGMA_M**2)
                paired[np.ix_([i, k], range(7), [i, k], range(7))] += both
        # The shared error is eliminated: it is smooth, whatever the cameras are.
        sides = np.concatenate([seen.sum(axis=0), *pulled], axis=-1)
        smoothed = smooth(sides, weight.sum(axis=0), self._stiffness[0])
        first = (ends[:-1, None] + np.arange(7)).ravel()  # background's numbers
        both = _squared(sides[..., trials:], smoothed)
        normal[np.ix_(first, first)] += paired.reshape(2 * first.shape) - both[:, trials:]
        right[first] += both[:, :trials]
        normal[np.diag_indices_from(normal)] += LEAST_INFORMATION
        found = np.linalg.solve(normal, right)[first]
        error: Float = (smoothed[..., :trials] + smoothed[..., trials:] @ found).transpose(2, 0, 1)
        return error

    def _unknowns(self, i: int) -> _Unknowns:
        """Build the equations of one camera: 7 numbers, then the constant and slow errors of its log."""
        paths, errors = self._paths, pose_errors(self._paths.noise[i])
        t_s = (paths.t_ns - paths.t_ns[0]) / 1e9
        knots = min(int(t_s[-1] / KNOT_S) + 2, MOST_KNOTS)
        position, rotation = paths.position[i], matrix_from_quaternion(paths.quaternion_xyzw[i])
        centre = position.mean(axis=0)
        at_person = _moved(paths.middle - centre)
        at_person[..., 6] = position - centre  # pictures show directions, not the scale
        ground = paths.middle - centre - [0.0, 0.0, HIPS_ABOVE_GROUND_M]
        of_log: list[Float] = [np.zeros((len(t_s), 6, 7))]
        of_log[0][:, :3] = _moved(position - centre)
        of_log[0][:, 3:, 3:6] = rotation.swapaxes(1, 2)
        priors: list[Float] = [np.zeros((7, 7))]
        for process in errors.processes:
            basis, prior = _over_time(process, t_s, knots)
            axes = rotation if process.number == SHIFT_IN_CAMERA else np.tile(np.eye(3), (len(t_s), 1, 1))
            columns = np.zeros((len(t_s), 6, 3 * len(prior)))
            first = 3 if process.number == ROTATION else 0
            columns[:, first : first + 3] = np.einsum("tk,tab->takb", basis, axes).reshape(len(t_s), 3, -1)
            of_log.append(columns)
            priors.append(np.asarray(np.kron(prior, np.eye(3)), dtype=np.float64))
        log_sigma = np.repeat(np.maximum(errors.white_with_stray(t_s[-1] / (knots - 1)), BACKGROUND_SIGMA), 3)
        from scipy.linalg import block_diag

        prior = block_diag(*priors)
        in_sigmas = np.concatenate(of_log, axis=-1) / log_sigma[:, None]
        return _Unknowns(prior, in_sigmas, log_sigma, at_person, _moved(ground))


class _Unknowns(NamedTuple):
    """Equations of the M unknowns of one camera."""

    prior: Float  # [M, M] precision
    of_log: Float  # [T, 6, M] errors of logged poses, in standard deviations
    log_sigma: Float  # [6] these, m and rad
    at_person: Float  # [T, 3, 7] m, displacement of what it sees at the person
    at_ground: Float  # [T, 3, 7] m, and at the ground below


def _moved(place: Float) -> Float:
    """Compute by how much a shift, a rotation and a scale about the origin move places, [T, 3, 7]."""
    shift = np.broadcast_to(np.eye(3), (len(place), 3, 3))
    return np.concatenate([shift, -cross_matrix(place), place[..., None]], axis=-1)


def _over_time(process: Process, t_s: Float, knots: int) -> tuple[Float, Float]:
    """Return how much each knot of a process counts at times, [T, K], and the knots' precision [K, K]."""
    if process.constant:
        return np.ones((len(t_s), 1)), np.full((1, 1), process.sigma0**-2)
    at_s = np.linspace(0.0, t_s[-1], knots)
    kept, variance = process.step(float(at_s[1]))
    steps = np.eye(knots) - kept * np.eye(knots, k=-1)
    steps[0] /= max(process.sigma0, EXACT)
    steps[1:] /= max(np.sqrt(variance), EXACT)
    return np.stack([np.interp(t_s, at_s, hat) for hat in np.eye(knots)], axis=1), steps.T @ steps


def _squared(one: Float, other: Float) -> Float:
    """Sum products of [T, A, M] and [T, A, K] over times and axes, [M, K]."""
    product: Float = one.reshape(-1, one.shape[-1]).T @ other.reshape(-1, other.shape[-1])
    return product


def _across_ray(offset: Float) -> tuple[Float, Float]:
    """Return projections [..., 3, 3] across offsets [..., 3] m, and the squares of their lengths."""
    square = np.maximum(np.sum(offset**2, axis=-1), EXACT**2)
    return np.eye(3) - offset[..., :, None] * offset[..., None, :] / square[..., None, None], square


def smooth(right: Float, information: Float, stiffness: Float) -> Float:
    """Minimise sum x'Wx / 2 - x'r + s sum |x''|^2 / 2 for r [..., T, 3, K], W [..., T, 3, 3], s [...]."""
    from scipy.linalg import solveh_banded

    times, stiff = information.shape[-3], np.reshape(stiffness, (-1, 1, 1))
    bend = np.zeros((3, times, 1))  # squares of second differences by lag, 0 to 2, and the later time
    bend[0, :-2] += 1.0
    bend[0, 1:-1] += 4.0
    bend[:, 2:] += np.array([1.0, -2.0, 1.0])[:, None, None]
    bend[1, 1:-1] -= 2.0
    band = np.zeros((7, len(stiff), times, 3))  # of all series in a row: nothing joins one to the next
    for a, b in zip(*np.tril_indices(3), strict=True):
        band[6 - a + b, ..., a] = information[..., a, b]
    if times >= MIN_SMOOTHED_TIMES:
        band[[6, 3, 0]] += stiff * bend[:, None]
    band[6] += LEAST_INFORMATION + LEAST_OF_STIFFNESS * stiff
    rows = right.reshape(-1, right.shape[-1])
    solved = solveh_banded(band.reshape(7, -1), rows, overwrite_ab=True, check_finite=False)
    return solved.reshape(right.shape)


def joined(people: Sequence[MeasuredJoints]) -> MeasuredJoints:
    """Join what was measured of several people: their joints in a row."""
    errors = np.concatenate([person.error_m for person in people], axis=2)
    return MeasuredJoints(errors, sum(person.joint_frames for person in people))


def _pixels(paths: CameraPaths, i: int) -> Float:
    """Compute the exact pixels [T, J, 2] of one camera; NaN outside its picture and where it has no pose."""
    lens = paths.intrinsics[i]
    camera_from_world = invert(paths.position[i, :, None], paths.quaternion_xyzw[i, :, None])
    pixels = project(transform(camera_from_world, paths.joints), lens)
    inside = (pixels >= -0.5) & (pixels <= np.array([lens.width, lens.height]) - 0.5)
    return np.where(inside.all(axis=-1, keepdims=True) & paths.known[i, :, None, None], pixels, np.nan)


def _focal(lens: Intrinsics) -> float:
    return (lens.fx + lens.fy) / 2


# --- imperfections (`config.Imperfections`) ----------------------------------------------------------------


def outages(t_s: Float, imperfections: Imperfections, seed: int) -> Bool:
    """Mark the times [T], ascending, at which drones hear nobody: stretches of 2 s, by chance."""
    blocks = np.asarray((t_s - t_s[0]) // OUTAGE_S, dtype=np.int64)
    lost = np.random.default_rng([seed, OUTAGE_STREAM]).random(blocks[-1] + 1) < imperfections.outage_share
    lost[0] = False
    found: Bool = lost[blocks]
    return found


def blown(position: Float, t_s: Float, config: PlannerConfig, seed: int) -> Float:
    """Add the way to which Gauss-Markov gusts push drones at [N, T, 3] m off their tracks, as they track."""
    gust_mps = config.imperfections.gust_mps
    if not gust_mps:
        return position
    rng, tuning = np.random.default_rng([seed, GUST_STREAM]), config.tuning
    off, rate, total = (np.zeros((len(position), 3)) for _ in range(3))
    sigma_mps = gust_mps * np.array(GUST_SHARES)
    gust = sigma_mps * rng.standard_normal(off.shape)
    pushed = np.zeros_like(position)
    for k, step_s in enumerate(np.diff(t_s), start=1):
        kept = np.exp(-step_s / GUST_S)
        gust = kept * gust + np.sqrt(1 - kept**2) * sigma_mps * rng.standard_normal(off.shape)
        total = total + off * step_s
        feedback = tuning.k_position * off + tuning.k_velocity * rate + tuning.k_integral * total
        rate = rate + (DRAG_PER_S * gust - feedback) * step_s
        off = off + rate * step_s
        pushed[:, k] = off
    return position + pushed


def aimed(position: Float, target: Float, t_s: Float, imperfections: Imperfections) -> Float:
    """Return world_from_camera [N, T, 4] of gimbals that follow targets [N, T, 3] within their limits."""
    low, high = np.radians(imperfections.gimbal_pitch_deg)
    way = target - position
    level = np.hypot(way[..., 0], way[..., 1])
    yaw, pitch = np.arctan2(way[..., 1], way[..., 0]), np.arctan2(way[..., 2], level)
    inside = np.clip(pitch, low, high)
    if imperfections.gimbal_deg_per_s is not None:
        most = np.radians(imperfections.gimbal_deg_per_s) * np.diff(t_s)
        for k, step in enumerate(most, start=1):
            yaw[:, k] = yaw[:, k - 1] + np.clip(wrapped(yaw[:, k] - yaw[:, k - 1]), -step, step)
            inside[:, k] = inside[:, k - 1] + np.clip(inside[:, k] - inside[:, k - 1], -step, step)
    elif (inside == pitch).all():
        return look_at(position, target)
    axis = np.stack([np.cos(inside) * np.cos(yaw), np.cos(inside) * np.sin(yaw), np.sin(inside)], axis=-1)
    return look_at(position, position + axis)
