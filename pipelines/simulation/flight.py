"""One simulated flight: everything that is true of it, and everything its logs would say."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.cameras import Intrinsics
from pipelines.geometry.noise import NoiseModel
from pipelines.session.errors import DataError
from pipelines.session.records import SkeletalMotion
from pipelines.simulation.body import Person, make_body
from pipelines.simulation.detector_errors import detect_keypoints, view_of
from pipelines.simulation.flying import DronePaths, Planner, fly, fly_with, moments, ring_slots
from pipelines.simulation.motion.retarget import retarget
from pipelines.simulation.motion.script import perform
from pipelines.simulation.observe import see
from pipelines.simulation.recording import (
    DronePoses,
    PoseLog,
    estimate,
    estimate_actor,
    frame_times,
    poses_at,
    sample_log,
)
from pipelines.simulation.rig import BodyMotion
from pipelines.simulation.scenario import Actor, Lens, Scenario
from pipelines.simulation.world.scene import World, build_world
from pipelines.simulation.world.terrain import raise_mounds

Float = NDArray[np.float64]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]
Moving = Callable[[Float], BodyMotion]

LEAD_S = 0.2
"""How long logs run, and the actor moves, before the first picture and after the last."""

_PLANNER_HZ = 50.0  # how often a planner is asked; it replans as often as it likes
_WAY_S = 0.25  # between the points of the actor's way that the wood keeps clear of
# What chance decides, each with numbers of its own: changing one thing leaves the others as they were.
_FRAMES, _LOG, _NOISE, _ACTOR, _KEYPOINTS = range(5)


@dataclass(frozen=True)
class SimulatedDrone:
    """One drone's part of a flight. Times are ns since the flight's start."""

    name: str
    intrinsics: Intrinsics
    clock_offset_s: float  # true time minus what its pictures are stamped with
    at_frames: DronePoses  # [F] the truth when its pictures were taken
    at_log: DronePoses  # [M] the truth at the stamps of its log
    log: PoseLog  # [M] what it logged


@dataclass(frozen=True)
class SimulatedFlight:
    """A flight. Truth stands at every moment at which any drone took a picture."""

    scenario: Scenario
    world: World
    person: Person
    drones: list[SimulatedDrone]
    t_ns: Int64  # [T] since the flight's start
    motion: BodyMotion  # at those moments
    joints: Float  # [T, J, 3] m, of `person.joints`
    actor_ns: Int64  # [A] since the flight's start
    actor: Float  # [A, 3] m, where the hip was thought to be

    def moments_of(self, drone: SimulatedDrone) -> Int64:
        """The rows [F] of `motion` and `joints` at which a drone took its pictures."""
        rows: Int64 = np.searchsorted(self.t_ns, drone.at_frames.t_ns)
        return rows


@dataclass(frozen=True)
class Set:
    """Who is filmed, and where: all of a scenario but its drones."""

    world: World
    person: Person
    moving: Moving  # the person's motion at seconds since the flight's start


def build_set(scenario: Scenario, *, bvh: SkeletalMotion | None = None) -> Set:
    """Build a scenario's world and let its actor move there.

    Raises:
        DataError: the world cannot be built, or the motion is not that of a person.
    """
    person = make_body(scenario.actor.body)
    moving = _moving(scenario.actor, person, scenario, bvh)
    way = moving(np.arange(*_span_s(scenario), _WAY_S)).root[:, :2]
    return Set(build_world(scenario.world, scenario.seed, keep_clear=way), person, moving)


def fly_scenario(
    scenario: Scenario,
    noise: Sequence[NoiseModel],
    *,
    bvh: SkeletalMotion | None = None,
    planner: Callable[[World], Planner] | None = None,
) -> SimulatedFlight:
    """Let the actor move, the drones fly, and the recorders run.

    Args:
        scenario: who, where and how.
        noise: the errors of the logged poses.
        bvh: the motion that the scenario names, if it names one.
        planner: makes a planner for a world; without one drones fly on a ring about where the actor
            truly is, whatever stands in the way.

    Raises:
        DataError: the world cannot be built, the motion is not that of a person, or the flight is over
            before a drone takes its first picture.
    """
    seed = scenario.seed
    set_up = build_set(scenario, bvh=bvh)
    world, person, moving = set_up.world, set_up.person, set_up.moving
    span_s = _span_s(scenario)

    t_s = moments(*span_s)
    hip = moving(t_s).root
    actor_ns, actor = estimate_actor(
        t_s,
        hip,
        sigma_m=scenario.actor.estimate_sigma_m,
        rate_hz=scenario.actor.estimate_rate_hz,
        span_s=span_s,
        rng=np.random.default_rng([seed, _ACTOR]),
    )
    paths = _paths(scenario, t_s, hip, actor_ns / 1e9, actor, world, planner)
    lens = intrinsics_of(scenario.drones.camera)
    drones = [_drone(scenario, lens, paths, index, noise, span_s) for index in range(scenario.drones.count)]

    t_ns = np.unique(np.concatenate([drone.at_frames.t_ns for drone in drones]))
    motion = moving(t_ns / 1e9)
    return SimulatedFlight(
        scenario, world, person, drones, t_ns, motion, person.keypoints(motion), actor_ns, actor
    )


def picture_stamps(flight: SimulatedFlight, drone: SimulatedDrone) -> Int64:
    """Stamps [F] of a drone's pictures by its own camera's clock, ns since the epoch."""
    offset_ns = round(drone.clock_offset_s * 1e9)
    stamps: Int64 = drone.at_frames.t_ns + flight.scenario.start_ns - offset_ns
    return stamps


def visible_joints(flight: SimulatedFlight, drone: SimulatedDrone) -> tuple[Float, Bool]:
    """Where a drone's pictures show the joints, and whether they do.

    Returns:
        [F, J, 2] exact px, NaN outside the picture; [F, J] whether a joint is in the picture and nothing of
        the world stands before it. The person's own body hides nothing here.
    """
    truth, joints = drone.at_frames, flight.joints[flight.moments_of(drone)]
    pixels = see(joints, truth.camera_position, truth.camera_quaternion_xyzw, drone.intrinsics)
    hidden = flight.world.hidden(truth.camera_position[:, None], joints)
    return pixels, np.isfinite(pixels).all(axis=-1) & ~hidden


def keypoints_of(flight: SimulatedFlight, drone: SimulatedDrone) -> tuple[Float, Float]:
    """What a detector would find in a drone's pictures, by the measured errors of one.

    Returns:
        [F, J, 2] px, NaN for what was missed, and [F, J] confidences.
    """
    scenario, truth = flight.scenario, drone.at_frames
    rows = flight.moments_of(drone)
    pixels, visible = visible_joints(flight, drone)
    tilt_deg, height_px = view_of(
        truth.camera_position,
        flight.motion.root[rows],
        height_m=scenario.actor.body.height_m,
        focal_px=drone.intrinsics.fx,
    )
    return detect_keypoints(
        pixels,
        visible,
        tilt_deg,
        height_px,
        scenario.keypoints,
        np.random.default_rng([scenario.seed, _KEYPOINTS, flight.drones.index(drone)]),
        joints=flight.person.joints,
    )


def intrinsics_of(lens: Lens) -> Intrinsics:
    """A pinhole that looks straight ahead: the picture's middle is half a pixel inside of its pixels."""
    focal = lens.width / 2 / float(np.tan(np.radians(lens.hfov_deg / 2)))
    return Intrinsics(lens.width, lens.height, focal, focal, (lens.width - 1) / 2, (lens.height - 1) / 2)


def _span_s(scenario: Scenario) -> tuple[float, float]:
    """When the logs begin and end."""
    return -LEAD_S, scenario.duration_s + LEAD_S


def _moving(actor: Actor, person: Person, scenario: Scenario, bvh: SkeletalMotion | None) -> Moving:
    """The actor's motion as a function of time since the flight's start."""
    terrain = raise_mounds(scenario.world.mounds)
    start = np.array(actor.start)

    def moving(t_s: Float) -> BodyMotion:
        since = t_s + LEAD_S
        if bvh is not None:
            motion = retarget(
                bvh,
                person.rig,
                since,
                ground=terrain.height,
                start=start,
                heading_deg=actor.heading_deg,
                repeat=actor.motion.repeat,
            )
        else:
            motion = perform(
                actor.motion.steps or [],
                person.rig,
                since,
                ground=terrain.height,
                start=start,
                heading_deg=actor.heading_deg,
                repeat=actor.motion.repeat,
                seed=scenario.seed,
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
        planner(world),
        start,
        hip,
        t_s,
        drones.limits,
        actor_t_s=actor_s,
        actor=actor,
        rate_hz=_PLANNER_HZ,
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
    frames_ns = frame_times(lens_spec, scenario.duration_s, np.random.default_rng([seed, _FRAMES, index]))
    if not len(frames_ns):
        raise DataError(
            "duration_s",
            f"{name} takes no picture within {scenario.duration_s:g} s at {lens_spec.rate_hz:g} Hz",
            "film longer, or more often",
        )
    at_log = sample_log(paths, index, drones.odometry_hz, span_s, np.random.default_rng([seed, _LOG, index]))
    offsets = drones.clock_offsets_s
    return SimulatedDrone(
        name=name,
        intrinsics=lens,
        clock_offset_s=offsets[index] if index < len(offsets) else 0.0,
        at_frames=poses_at(paths, index, frames_ns),
        at_log=at_log,
        log=estimate(at_log, noise, np.random.default_rng([seed, _NOISE, index])),
    )
