"""One simulated flight: the truth and the contents of its logs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64, Intrinsics
from pipelines.geometry.cameras import project, row_delay_s, undistort
from pipelines.geometry.noise import NoiseModel
from pipelines.geometry.poses import invert, transform
from pipelines.geometry.rig import BodyMotion
from pipelines.session.errors import DataError
from pipelines.session.records import SkeletalMotion
from pipelines.simulation.body import PosablePerson, make_body
from pipelines.simulation.detector_errors import detect_keypoints, see, view_of
from pipelines.simulation.flying import (
    DronePaths,
    DronePoses,
    Planner,
    PoseLog,
    estimate,
    estimate_actor,
    fly,
    fly_with,
    frame_times,
    log_times,
    moments,
    poses_at,
    ring_slots,
)
from pipelines.simulation.motion_script import perform
from pipelines.simulation.raster import TriangleSurface, hidden_by
from pipelines.simulation.retarget import retarget
from pipelines.simulation.scenario import Actor, Scenario
from pipelines.simulation.world import World, build_world, raise_mounds

Moving = Callable[[Float], BodyMotion]

LEAD_S = 0.2
"""Time that logs run, and the actor moves, before the first picture and after the last, s."""

# The planner is called as often as its tracking steps; it may replan less often.
_PLANNER_HZ = 50.0
# A polynomial through five moments follows an accelerating limb during a readout.
_NODES = 5
# Each step takes away all but some percent of the row error that is left.
_ROW_STEPS = 5
# The wood keeps clear of the place of the actor at every quarter of a second.
_WAY_S = 0.25
# What chance decides, each with numbers of its own: changing one thing leaves the others as they were.
_FRAMES, _LOG, _NOISE, _ACTOR, _KEYPOINTS, _MOTION = range(6)
# Hands, feet, crown and girth of a person of 2.2 m reach this far beyond the keypoints.
_REACH_M = 0.4


@dataclass(frozen=True)
class SimulatedDrone:
    """One drone's part of a flight. Times are ns since the flight's start."""

    name: str
    intrinsics: Intrinsics
    clock_offset_s: float  # true time minus the stamps of its pictures
    at_frames: DronePoses  # [F] the truth when its pictures were taken
    at_log: DronePoses  # [M] the truth at the stamps of its log
    log: PoseLog  # [M] its log
    at: Callable[[Int64], DronePoses]  # the truth at any moments within the log's span


@dataclass(frozen=True)
class Performer:
    """A person who moves."""

    name: str
    look: Actor
    person: PosablePerson
    moving: Moving  # the person's motion at seconds since the flight's start


@dataclass(frozen=True)
class SimulatedPerson(Performer):
    """One person's part of a flight: the truth at the flight's moments T, and what was logged."""

    motion: BodyMotion  # at the moments T
    joints: Float  # [T, J, 3] m, of `person.joints`
    topic: str  # of the logged estimates
    estimate_ns: Int64  # [A] since the flight's start
    estimate: Float  # [A, 3] m, where the hip was thought to be

    def surface(self, row: int) -> TriangleSurface:
        """Return the person's surface at one of the moments T."""
        return self.person.surface(self.motion.root[row], self.motion.rotation[row])


@dataclass(frozen=True)
class SimulatedFlight:
    """A flight. Truth is known at every moment at which any drone took a picture."""

    scenario: Scenario
    world: World
    people: list[SimulatedPerson]  # the drones follow the first
    drones: list[SimulatedDrone]
    t_ns: Int64  # [T] since the flight's start

    def moments_of(self, drone: SimulatedDrone) -> Int64:
        """Return the rows [F] of `t_ns` at which a drone took its pictures."""
        return np.searchsorted(self.t_ns, drone.at_frames.t_ns)


@dataclass(frozen=True)
class Set:
    """The actor and the world: all of a scenario but its drones."""

    world: World
    people: list[Performer]  # the drones follow the first


def build_set(scenario: Scenario, *, bvh: Mapping[str, SkeletalMotion] | None = None) -> Set:
    """Build a scenario's world, and move its actors; DataError: impossible, or no person's motion."""
    people = []
    for index, (name, look) in enumerate(scenario.people.items()):
        person = make_body(look.body)
        seed = int(np.random.default_rng([scenario.seed, _MOTION, index]).integers(2**32))
        moving = _moving(look, person, scenario, (bvh or {}).get(name), seed if index else scenario.seed)
        people.append(Performer(name, look, person, moving))
    way_s = np.arange(*_span_s(scenario), _WAY_S)
    ways = np.concatenate([each.moving(way_s).root[:, :2] for each in people])
    return Set(build_world(scenario.world, scenario.seed, keep_clear=ways), people)


def fly_scenario(
    scenario: Scenario,
    noise: Sequence[NoiseModel],
    *,
    bvh: Mapping[str, SkeletalMotion] | None = None,
    planner: Callable[[World], Planner] | None = None,
) -> SimulatedFlight:
    """Let actors move, drones fly (by planners, else on a ring about the first actor), recorders run."""
    set_up = build_set(scenario, bvh=bvh)
    world, followed = set_up.world, set_up.people[0]
    span_s = _span_s(scenario)

    t_s = moments(*span_s)
    estimates = [_estimated(each, k, scenario, t_s) for k, each in enumerate(set_up.people)]
    actor_ns, actor = estimates[0]
    paths = _paths(scenario, t_s, followed.moving(t_s).root, actor_ns / 1e9, actor, world, planner)
    lens = _usable(scenario.drones.camera.intrinsics())
    drones = [_drone(scenario, lens, paths, index, noise, span_s) for index in range(scenario.drones.count)]

    t_ns = np.unique(np.concatenate([drone.at_frames.t_ns for drone in drones]))
    people = [
        _person(each, estimated, scenario, t_ns)
        for each, estimated in zip(set_up.people, estimates, strict=True)
    ]
    return SimulatedFlight(scenario, world, people, drones, t_ns)


def picture_stamps(flight: SimulatedFlight, drone: SimulatedDrone) -> Int64:
    """Return the stamps [F] of a drone's pictures by its own camera's clock, ns since the epoch."""
    offset_ns = round(drone.clock_offset_s * 1e9)
    return drone.at_frames.t_ns + flight.scenario.start_ns - offset_ns


def visible_joints(
    flight: SimulatedFlight, drone: SimulatedDrone, person: SimulatedPerson
) -> tuple[Float, Bool]:
    """Project a person's joints into pictures, row by row: [F, J, 2] px, NaN outside; [F, J] if seen."""
    truth, joints = drone.at_frames, person.joints[flight.moments_of(drone)]
    t_ns = truth.t_ns[:, None]
    place, turn = truth.camera_position[:, None], truth.camera_quaternion_xyzw[:, None]
    if drone.intrinsics.readout_s:
        t_ns, joints, place, turn = _at_their_rows(flight, drone, person)
    pixels = see(joints, place, turn, drone.intrinsics)
    hidden = flight.world.hidden(place, joints)
    for other in flight.people:
        if other is not person:
            hidden |= _hidden_by_person(other, _during_readouts(flight, drone, other), t_ns, place, joints)
    return pixels, np.isfinite(pixels).all(axis=-1) & ~hidden


def _at_their_rows(
    flight: SimulatedFlight, drone: SimulatedDrone, person: SimulatedPerson
) -> tuple[Int64, Float, Float, Float]:
    """Find the time at which each joint's row is read, and what is where then."""
    lens, stamps = drone.intrinsics, drone.at_frames.t_ns
    nodes_s = _nodes_s(lens)
    near = _during_readouts(flight, drone, person)
    delay_s = np.zeros(near.shape[:2])
    for _ in range(_ROW_STEPS):
        t_ns = stamps[:, None] + np.rint(1e9 * delay_s).astype(np.int64)
        away = delay_s[..., None] - nodes_s
        weights = [
            np.prod(np.delete(away, k, axis=-1) / (nodes_s[k] - np.delete(nodes_s, k)), axis=-1)
            for k in range(len(nodes_s))
        ]
        joints = np.einsum("fjik,fjk->fji", near, np.stack(weights, axis=-1))
        poses = drone.at(t_ns.ravel())
        place = poses.camera_position.reshape(*delay_s.shape, 3)
        turn = poses.camera_quaternion_xyzw.reshape(*delay_s.shape, 4)
        row = project(transform(invert(place, turn), joints), lens)[..., 1]
        # A joint outside the picture is never read: its time only has to stay within the log.
        row = np.clip(np.where(np.isnan(row), 0.0, row), 0, lens.height - 1)
        delay_s = row_delay_s(row, lens)
    return t_ns, joints, place, turn


def _nodes_s(lens: Intrinsics) -> Float:
    """Return times [N] of a readout to interpolate joints between, s after the picture's stamp."""
    return np.linspace(-0.5, 0.5, _NODES) * lens.readout_s


def _during_readouts(flight: SimulatedFlight, drone: SimulatedDrone, person: SimulatedPerson) -> Float:
    """Compute a person's joints [F, J, 3, N] at the nodes of each picture's readout; N is 1 without one."""
    if not drone.intrinsics.readout_s:
        return person.joints[flight.moments_of(drone)][..., None]
    t_s = drone.at_frames.t_ns / 1e9
    at_nodes = [person.person.keypoints(person.moving(t_s + node)) for node in _nodes_s(drone.intrinsics)]
    return np.stack(at_nodes, axis=-1)


def keypoints_of(
    flight: SimulatedFlight, drone: SimulatedDrone, person: SimulatedPerson
) -> tuple[Float, Float]:
    """Model a detector's keypoints [F, J, 2] px of a person, NaN for missed ones; confidences [F, J]."""
    scenario, truth = flight.scenario, drone.at_frames
    rows = flight.moments_of(drone)
    pixels, visible = visible_joints(flight, drone, person)
    tilt_deg, height_px = view_of(
        truth.camera_position,
        person.motion.root[rows],
        height_m=person.look.body.height_m,
        focal_px=drone.intrinsics.fx,
    )
    return detect_keypoints(
        pixels,
        visible,
        tilt_deg,
        height_px,
        scenario.keypoints,
        np.random.default_rng(
            [scenario.seed, _KEYPOINTS, flight.drones.index(drone), *_of_others(flight.people.index(person))]
        ),
        joints=person.person.joints,
    )


def _usable(lens: Intrinsics) -> Intrinsics:
    """Return the same camera, if its distortion reaches the whole picture."""
    right, bottom = lens.width - 0.5, lens.height - 0.5
    corners = np.array([[-0.5, -0.5], [right, -0.5], [-0.5, bottom], [right, bottom]])
    if np.isnan(undistort(corners, lens)).any():
        raise DataError(
            "drones.camera.distortion",
            f"no ray reaches the corners of a picture of {lens.width}x{lens.height} px and fx {lens.fx:.0f}",
            "state the coefficients of such a lens, [] for none, or a smaller hfov_deg",
        )
    return lens


def _span_s(scenario: Scenario) -> tuple[float, float]:
    return -LEAD_S, scenario.duration_s + LEAD_S


def _of_others(person: int) -> list[int]:
    """Return the part of a random seed that is a person's own; the first has the numbers of an only one."""
    return [person] if person else []


def _estimated(each: Performer, index: int, scenario: Scenario, t_s: Float) -> tuple[Int64, Float]:
    """Estimate a person's positions as a flight logs them (`estimate_actor`)."""
    return estimate_actor(
        t_s,
        each.moving(t_s).root,
        sigma_m=each.look.estimate_sigma_m,
        rate_hz=each.look.estimate_rate_hz,
        span_s=_span_s(scenario),
        rng=np.random.default_rng([scenario.seed, _ACTOR, *_of_others(index)]),
    )


def _person(
    each: Performer, estimated: tuple[Int64, Float], scenario: Scenario, t_ns: Int64
) -> SimulatedPerson:

    def moving(t_s: Float) -> BodyMotion:
        # A script is planned up to the last time asked for: the flight's last moment, as for the truth.
        found = each.moving(np.append(t_s, t_ns[-1] / 1e9))
        return BodyMotion(t_s, found.root[:-1], found.rotation[:-1])

    motion = each.moving(t_ns / 1e9)
    topic = "/actor" if scenario.actors is None else f"/actor/{each.name}"
    joints = each.person.keypoints(motion)
    return SimulatedPerson(each.name, each.look, each.person, moving, motion, joints, topic, *estimated)


def _hidden_by_person(other: SimulatedPerson, around: Float, t_ns: Int64, eye: Float, joints: Float) -> Bool:
    """Find the joints [F, J] of somebody that a person's body hides."""
    low, high = around.min(axis=(1, 3)) - _REACH_M, around.max(axis=(1, 3)) + _REACH_M
    way = joints - eye
    with np.errstate(divide="ignore", invalid="ignore"):  # a line along an axis: infinite, or NaN on a face
        sides = np.stack([(low[:, None] - eye) / way, (high[:, None] - eye) / way])
    enter, leave = np.fmin(*sides).max(axis=-1), np.fmax(*sides).min(axis=-1)
    near: Bool = np.fmax(enter, 0.0) <= np.fmin(leave, 1.0)
    # A global shutter takes all joints of a picture at once, a rolling one each of them at a time of its own.
    asked, targets = near.reshape(*t_ns.shape, -1), joints.reshape(*t_ns.shape, -1, 3)
    hidden = np.zeros_like(asked)
    moments = np.nonzero(asked.any(axis=-1))
    if not len(moments[0]):
        return near
    ascending_ns, row = np.unique(t_ns[moments], return_inverse=True)
    motion = other.moving(ascending_ns / 1e9)
    for k, frame, taken in zip(row.tolist(), *(axis.tolist() for axis in moments), strict=True):
        surface, of = other.person.surface(motion.root[k], motion.rotation[k]), asked[frame, taken]
        hidden[frame, taken, of] = hidden_by(surface, eye[frame, taken], targets[frame, taken, of])
    return hidden.reshape(near.shape)


def _moving(
    actor: Actor, person: PosablePerson, scenario: Scenario, bvh: SkeletalMotion | None, seed: int
) -> Moving:
    """Return the actor's motion as a function of time since the flight's start."""
    terrain = raise_mounds(scenario.world.mounds)
    start = np.array(actor.start)

    def moving(t_s: Float) -> BodyMotion:
        since, heading_deg, repeat = t_s + LEAD_S, actor.heading_deg, actor.motion.repeat
        ground = terrain.height
        if bvh is not None:
            motion = retarget(
                bvh, person.rig, since, ground=ground, start=start, heading_deg=heading_deg, repeat=repeat
            )
        else:
            motion = perform(
                actor.motion.steps or [],
                *(person.rig, since),
                ground=ground,
                start=start,
                heading_deg=heading_deg,
                repeat=repeat,
                seed=seed,
            )
        return BodyMotion(t_s, motion.root, motion.rotation)

    return moving


def _paths(
    scenario: Scenario,
    t_s: Float,
    hip: Float,
    actor_s: Float,
    actor: Float,
    world: World,
    planner: Callable[[World], Planner] | None,
) -> DronePaths:
    drones = scenario.drones
    slots = ring_slots(drones.formation, drones.count, hip, t_s)
    if planner is None:
        return fly(slots, hip, t_s, drones.limits)
    start = slots[:, 0]
    return fly_with(
        planner(world), start, hip, t_s, drones.limits, actor_t_s=actor_s, actor=actor, rate_hz=_PLANNER_HZ
    )


def _drone(
    scenario: Scenario,
    lens: Intrinsics,
    paths: DronePaths,
    index: int,
    noise: Sequence[NoiseModel],
    span_s: tuple[float, float],
) -> SimulatedDrone:
    drones, seed = scenario.drones, scenario.seed
    name, lens_spec = f"drone{index + 1}", drones.camera

    def at(t_ns: Int64) -> DronePoses:
        return poses_at(paths, index, t_ns)

    frames_ns = frame_times(lens_spec, scenario.duration_s, np.random.default_rng([seed, _FRAMES, index]))
    if not len(frames_ns):
        problem = f"{name} takes no picture within {scenario.duration_s:g} s at {lens_spec.rate_hz:g} Hz"
        raise DataError("duration_s", problem, "film longer, or more often", code="no-pictures")
    at_log = at(log_times(drones.odometry_hz, span_s, np.random.default_rng([seed, _LOG, index])))
    offsets = drones.clock_offsets_s
    return SimulatedDrone(
        name=name,
        intrinsics=lens,
        clock_offset_s=offsets[index] if index < len(offsets) else 0.0,
        at_frames=at(frames_ns),
        at_log=at_log,
        log=estimate(at_log, noise, np.random.default_rng([seed, _NOISE, index])),
        at=at,
    )
