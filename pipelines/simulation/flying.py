"""Camera poses of a ring as formulas; a flight model of masses, leaning bodies and gimbals; its recorders.

A drone is a mass that two loops steer, as autopilots do: the distance to its slot commands a velocity, the
error in velocity an acceleration. Only these saturate; there is no wind. The attitude follows late: a
multirotor leans so that its thrust makes the acceleration, and its nose turns to the actor. The camera hangs
in a gimbal. Equal steps of at most `STEP_S` between the requested moments integrate all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.mounting import attitude_from_angles, body_from_camera
from pipelines.geometry.noise import GaussMarkov, NoiseModel, disturb, sum_sigma
from pipelines.geometry.poses import (
    compose,
    conjugate,
    interpolate_points,
    interpolate_rotations,
    invert,
    look_at,
    mounted_covariance,
    multiply,
    quaternion_from_matrix,
    rates,
    rotate,
)
from pipelines.session.records import Trajectory
from pipelines.simulation.scenario import FormationSettings, Lens, Limits

# How far a camera strays from its slot at `variation` 1. METHODS of the noise studies use the same
# amounts: they make a constant error of each drone's poses observable.
_YAW_RAD, _RANGE_M, _TILT_RAD = np.radians(10.0), 1.0, np.radians(3.0)


def orbit(
    t_s: Float,
    target: Float,
    *,
    cameras: int,
    range_m: float = 10.0,
    tilt_deg: float = 15.0,
    yaw_deg: float = 0.0,
    yaw_rate_deg_per_s: float = 4.0,
    variation: float = 0.0,
) -> tuple[Float, Float]:
    """Compute the poses of cameras on a ring around a target [T, 3] m; every camera looks at it.

    The slots of Ho et al., "3D Human Reconstruction in the Wild with Collaborative Aerial Cameras": yaw_i =
    yaw + i 2 pi/n (pi/2 for two), from east, of the first camera at time 0. At `variation` 1 each camera
    strays by 10 degrees of yaw, 1 m of range and 3 degrees of tilt, by sines of its own periods. Return
    positions [N, T, 3] and upright world_from_camera [N, T, 4] (xyzw).
    """
    spacing = np.pi / 2 if cameras == 2 else 2 * np.pi / cameras
    camera = np.arange(cameras)[:, None]
    yaw = np.radians(yaw_deg + yaw_rate_deg_per_s * t_s) + spacing * camera
    yaw = yaw + variation * _YAW_RAD * _sway(t_s, 7.0, camera)
    distance = range_m + variation * _RANGE_M * _sway(t_s, 9.0, camera)
    tilt = np.radians(tilt_deg) + variation * _TILT_RAD * _sway(t_s, 5.0, camera)
    direction = np.stack([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), np.sin(tilt)], axis=-1)
    position = target + distance[..., None] * direction
    return position, look_at(position, target)


def _sway(t_s: Float, period_s: float, camera: NDArray[np.int64]) -> Float:
    """Compute a sine [N, T] for each camera, with a period and phase of its own."""
    sway: Float = np.sin(2 * np.pi * t_s / (period_s + 1.3 * camera) + 2.0 * camera)
    return sway


STEP_S = 0.005
"""The integration's longest step."""

LEVER_ARM = (0.10, 0.0, -0.05)
"""Position of the camera in the body (forward, left, up), m."""

POSITION_GAIN_PER_S, VELOCITY_GAIN_PER_S = 1.5, 4.0
# A commanded acceleration comes late because the body must lean first.
ATTITUDE_LAG_S = 0.15
# Half of the acceleration limit brakes, and the rest is left for corrections.
_BRAKING_SHARE = 0.5

HEADING_LAG_S, HEADING_RATE_RADPS = 0.3, math.radians(90.0)
GIMBAL_LAG_S, GIMBAL_RATE_RADPS = 0.05, math.radians(120.0)

# This is the acceleration of gravity in middle latitudes.
_GRAVITY_MPS2 = 9.81
# Rotors and frame brake in proportion to the speed, which leans a drone by 7 degrees at 8 m/s.
_DRAG_PER_S = 0.15
# Rotors do not push down, so a falling drone keeps this share of its lift.
_LEAST_LIFT = 0.2


@dataclass(frozen=True)
class DronePaths:
    """Positions of all drones, and attitudes of bodies and cameras."""

    t_s: Float  # [T] seconds since the flight's start, strictly increasing
    position: Float  # [N, T, 3] m, the body's origin in the world
    velocity: Float  # [N, T, 3] m/s
    body_xyzw: Float  # [N, T, 4] world_from_body (x forward, y left, z up)
    camera_xyzw: Float  # [N, T, 4] world_from_camera (x right, y down, z forward)

    @property
    def camera_position(self) -> Float:
        """Position of the cameras [N, T, 3] m; the lever arm turns with the body."""
        return self.position + rotate(self.body_xyzw, np.array(LEVER_ARM))


class Known(NamedTuple):
    """Input of a planner: nothing later than `t_s`, and only estimates of the actor."""

    t_s: float
    actor_t_s: Float  # [M] stamps of the estimates so far
    actor: Float  # [M, 3] m, estimated positions of the actor's hip
    position: Float  # [N, 3] m, the drones
    velocity: Float  # [N, 3] m/s


Planner = Callable[[Known], tuple[Float, Float]]
"""Function, called at a fixed rate, that returns every drone's slot [N, 3] m and its velocity [N, 3] m/s.

Until it is called again the slots move on in straight lines. A planner that plans trajectories samples its
latest one here and replans as often as it likes; it keeps its own state.
"""


def moments(first_s: float, last_s: float) -> Float:
    """Return moments [T] to fly at: 100 a second, from `first_s` to `last_s` or just beyond."""
    return first_s + np.arange(math.ceil((last_s - first_s) * 100 - 1e-6) + 1) / 100


def ring_slots(formation: FormationSettings, count: int, actor: Float, t_s: Float) -> Float:
    """Compute slots [N, T, 3] m on a ring about the actor [T, 3] m; obstacles are ignored."""
    position, _ = orbit(
        t_s,
        actor,
        cameras=count,
        range_m=formation.radius_m,
        tilt_deg=formation.tilt_deg,
        yaw_deg=formation.yaw_deg,
        yaw_rate_deg_per_s=formation.yaw_rate_deg_per_s,
        variation=formation.variation,
    )
    return position


def fly(slots: Float, aim: Float, t_s: Float, limits: Limits) -> DronePaths:
    """Fly after slots [N, T, 3] m of the bodies that are known in advance; cameras look at `aim` [T, 3] m.

    The drones start in their slots and move with them as fast as the limits allow. A drone lags behind a slot
    that accelerates by `a` by about a / (POSITION_GAIN_PER_S VELOCITY_GAIN_PER_S): the slot's velocity is fed
    forward, its acceleration is not. The camera lags by the rate at which its aim turns times GIMBAL_LAG_S.
    """
    velocity = np.gradient(slots, t_s, axis=1) if len(t_s) > 1 else np.zeros_like(slots)
    flight = _Flight.starting(slots[:, :1], velocity[:, :1], t_s, limits)
    flight.advance(0, slots, velocity)
    return flight.paths(aim)


def fly_with(
    planner: Planner,
    start: Float,
    aim: Float,
    t_s: Float,
    limits: Limits,
    *,
    actor_t_s: Float,
    actor: Float,
    rate_hz: float,
) -> DronePaths:
    """Fly after slots that a planner gives at `rate_hz`; the drones hover at `start` [N, 3] m at first."""
    flight = _Flight.starting(start[:, None], np.zeros_like(start[:, None]), t_s, limits)
    ticks = np.floor((t_s - t_s[:1]) * rate_hz + 1e-9)
    calls = np.flatnonzero(np.diff(ticks, prepend=-1.0)).tolist()
    for first, following in pairwise([*calls, len(t_s) - 1]):
        now = t_s[first]
        so_far = int(np.searchsorted(actor_t_s, now, side="right"))
        position, velocity = flight.position[:, first].copy(), flight.velocity[:, first].copy()
        slot, slot_velocity = planner(
            Known(float(now), actor_t_s[:so_far], actor[:so_far], position, velocity)
        )
        since = (t_s[first : following + 1] - now)[:, None]
        moving = slot[:, None] + slot_velocity[:, None] * since
        flight.advance(first, moving, np.broadcast_to(slot_velocity[:, None], moving.shape))
    return flight.paths(aim)


class _Flight(NamedTuple):
    """A flight in progress; rows are filled as it advances."""

    t_s: Float  # [T]
    limits: Limits
    position: Float  # [N, T, 3]
    velocity: Float
    acceleration: Float

    @classmethod
    def starting(cls, position: Float, velocity: Float, t_s: Float, limits: Limits) -> _Flight:
        """Return a flight with all drones at [N, 1, 3], not yet flown."""
        speed = np.linalg.norm(velocity, axis=-1, keepdims=True)
        allowed = velocity * (limits.speed_mps / np.maximum(speed, limits.speed_mps))
        rows = (1, len(t_s), 1)
        positions = np.tile(position, rows)
        return cls(t_s, limits, positions, np.tile(allowed, rows), np.zeros_like(positions))

    def advance(self, first: int, slot: Float, slot_velocity: Float) -> None:
        """Track slots [N, S, 3] from the moment `first` to their end, and fill in the rows of the motion."""
        kept = _BRAKING_SHARE * self.limits.acceleration_mps2
        motion = (self.position, self.velocity, self.acceleration)
        at, moving, pushed = (rows[:, first] for rows in motion)
        for k in range(slot.shape[1] - 1):
            steps, step_s = _substeps(self.t_s, first + k)
            response = 1 - math.exp(-step_s / ATTITUDE_LAG_S)
            for m in range(steps):
                share = m / steps
                missing = slot[:, k] + share * (slot[:, k + 1] - slot[:, k]) - at
                distance = _length(missing)
                wanted = slot_velocity[:, k] + share * (slot_velocity[:, k + 1] - slot_velocity[:, k])
                towards = np.divide(_approach(distance, kept), distance, where=distance > 0, out=0 * distance)
                wanted = _shortened(wanted + missing * towards, self.limits.speed_mps)
                push = _shortened(VELOCITY_GAIN_PER_S * (wanted - moving), self.limits.acceleration_mps2)
                pushed = pushed + response * (push - pushed)
                faster = _shortened(moving + pushed * step_s, self.limits.speed_mps)
                at = at + (moving + faster) * (step_s / 2)
                pushed = (faster - moving) / step_s
                moving = faster
            for rows, reached in zip(motion, (at, moving, pushed), strict=True):
                rows[:, first + k + 1] = reached

    def paths(self, aim: Float) -> DronePaths:
        """Compute the bodies' attitudes, which follow from the motion, and the cameras'."""
        away = aim - self.position
        ahead = np.arctan2(away[..., 1], away[..., 0])
        heading = _followed(ahead, self.t_s, HEADING_LAG_S, HEADING_RATE_RADPS)
        thrust = self.acceleration + _DRAG_PER_S * self.velocity
        lift = np.maximum(thrust[..., 2] + _GRAVITY_MPS2, _LEAST_LIFT * _GRAVITY_MPS2)
        up = _unit(np.concatenate([thrust[..., :2], lift[..., None]], axis=-1))
        level_left = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], axis=-1)
        forward = _unit(np.cross(level_left, up))
        body_xyzw = quaternion_from_matrix(np.stack([forward, np.cross(up, forward), up], axis=-1))
        sight = away - rotate(body_xyzw, np.array(LEVER_ARM))
        pan = np.arctan2(sight[..., 1], sight[..., 0])
        down = np.arctan2(-sight[..., 2], np.hypot(sight[..., 0], sight[..., 1]))
        yaw, pitch = (_followed(angle, self.t_s, GIMBAL_LAG_S, GIMBAL_RATE_RADPS) for angle in (pan, down))
        gimbal = attitude_from_angles(
            np.stack([yaw, pitch, np.zeros_like(yaw)], axis=-1), order="ypr", units="rad"
        )
        camera_xyzw = multiply(gimbal, body_from_camera("forward"))
        return DronePaths(self.t_s, self.position, self.velocity, body_xyzw, camera_xyzw)


def _followed(angle: Float, t_s: Float, lag_s: float, fastest_radps: float) -> Float:
    """Compute angles [N, T] of something that turns after `angle` and starts there."""
    target = np.unwrap(angle, axis=1) if angle.size else angle
    followed = target.copy()
    now = followed[:, 0] if len(t_s) else np.zeros(len(angle))
    for k in range(len(t_s) - 1):
        steps, step_s = _substeps(t_s, k)
        for m in range(steps):
            wanted = target[:, k] + m / steps * (target[:, k + 1] - target[:, k])
            now = now + np.clip((wanted - now) / lag_s, -fastest_radps, fastest_radps) * step_s
        followed[:, k + 1] = now
    return followed


def _unit(vectors: Float) -> Float:
    unit: Float = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit


# --- the integration -----------------------------------------------------------------------------------


def _substeps(t_s: Float, k: int) -> tuple[int, float]:
    """Return number and length (s) of the equal steps to the next moment; the margin is for rounding."""
    span_s = float(t_s[k + 1] - t_s[k])
    steps = max(1, math.ceil(span_s / STEP_S - 1e-6))
    return steps, span_s / steps


def _length(vectors: Float) -> Float:
    x, y, z = vectors.T
    return np.asarray(np.sqrt(x**2 + y**2 + z**2)[:, None])


def _shortened(vectors: Float, longest: float) -> Float:
    """Limit the lengths of vectors [N, 3] to `longest`; keep the directions."""
    length = _length(vectors)
    return np.where(length > longest, vectors * (longest / np.maximum(length, longest)), vectors)


def _approach(distance_m: Float, braking_mps2: float) -> Float:
    """Compute the speed towards a slot: in proportion while near, such that it can stop while far."""
    near = braking_mps2 / POSITION_GAIN_PER_S**2
    far = np.sqrt(np.maximum(2 * braking_mps2 * (distance_m - near / 2), 0.0))
    return np.where(distance_m <= near, POSITION_GAIN_PER_S * distance_m, far)


# --- recorders -----------------------------------------------------------------------------------------

# The stamps of a log scatter by this share of the time between them.
JITTER_SHARE = 0.02
# Stamps that scatter by more would lose their order.
_LARGEST_JITTER = 0.2

ACTOR_CORRELATION_S = 0.5
"""Correlation time of the errors of an actor's estimate: they come out of a filter."""


@dataclass(frozen=True)
class DronePoses:
    """The exact poses of one drone at some moments: its body and its camera in the world."""

    t_ns: Int64  # [M] since the flight's start
    position: Float  # [M, 3] m, world_from_body
    quaternion_xyzw: Float  # [M, 4]
    camera_position: Float  # [M, 3] m, world_from_camera
    camera_quaternion_xyzw: Float  # [M, 4]


@dataclass(frozen=True)
class PoseLog:
    """The log of a drone's estimator, by stamp; body, `gimbal_xyzw` and lever arm give `camera`."""

    body: Trajectory
    gimbal_xyzw: Float  # [M, 4]
    camera: Trajectory


# --- stamps --------------------------------------------------------------------------------------------


def log_times(rate_hz: float, span_s: tuple[float, float], rng: np.random.Generator) -> Int64:
    """Draw the stamps [M] of a log's ticks, of random phase and small jitter, ns since the flight's start."""
    first, last = span_s
    ticks = first + (np.arange(max(0, np.ceil((last - first) * rate_hz))) + rng.random()) / rate_hz
    jitter = np.clip(JITTER_SHARE * rng.standard_normal(len(ticks)), -_LARGEST_JITTER, _LARGEST_JITTER)
    t_s: Float = ticks + jitter / rate_hz
    return _nanoseconds(t_s[(t_s >= first) & (t_s <= last)])


def frame_times(lens: Lens, duration_s: float, rng: np.random.Generator) -> Int64:
    """Draw the stamps [F] of the frames that a camera kept of its shutter, ns since the flight's start."""
    phase = rng.random() * (lens.shutters == "free")
    count = max(0, int(np.ceil(duration_s * lens.rate_hz - phase)))
    shutter_s = np.arange(count, dtype=np.float64) / lens.rate_hz + phase / lens.rate_hz
    t_ns = _nanoseconds(shutter_s)
    kept = rng.random(count) >= lens.dropped_share
    kept[:1] = kept[-1:] = True
    return t_ns[kept]


# --- poses ---------------------------------------------------------------------------------------------


def poses_at(paths: DronePaths, drone: int, t_ns: Int64) -> DronePoses:
    """Interpolate a drone's true poses at moments [M]: cubic positions, even turns, the lever arm's end."""
    grid_ns = _nanoseconds(paths.t_s)
    position = _hermite(grid_ns, paths.position[drone], paths.velocity[drone], t_ns)
    longest_ns = int(np.diff(grid_ns).max(initial=0))
    body_xyzw, camera_xyzw = (
        interpolate_rotations(grid_ns, quaternion[drone], t_ns, max_gap_ns=longest_ns)
        for quaternion in (paths.body_xyzw, paths.camera_xyzw)
    )
    camera_position = position + rotate(body_xyzw, np.array(LEVER_ARM))
    return DronePoses(t_ns, position, body_xyzw, camera_position, camera_xyzw)


def estimate(truth: DronePoses, models: Sequence[NoiseModel], rng: np.random.Generator) -> PoseLog:
    """Simulate one drone's log with the errors of some models, and the covariances that belong to them.

    The models' errors, drawn in this order, are the camera's. The body is logged where a camera with those
    errors has it: body and gimbal share the error in rotation, and the angles between them are exact.
    Covariances [M, 6, 6] (position in world, rotation vector in the body or the camera) hold the models'
    marginal sigmas at each stamp; None if no model has any. ROS states rotations about fixed axes:
    `pose_covariance_in_body(covariance, conjugate(quaternion))`.
    """
    true_camera = truth.camera_position, truth.camera_quaternion_xyzw
    camera_from_body = compose(invert(*true_camera), (truth.position, truth.quaternion_xyzw))
    camera = disturb(models, truth.t_ns, *true_camera, rng)
    body = compose(camera, camera_from_body)

    elapsed_s = (truth.t_ns - truth.t_ns[:1]) / 1e9
    sigma = sum_sigma(models, elapsed_s, *rates(truth.t_ns, *true_camera))
    covariance = np.repeat(sigma**2, 3, axis=1)[:, :, None] * np.eye(6)
    carried = mounted_covariance(covariance, camera[1], camera_from_body[0], body[1])
    stated = bool(covariance.any())
    return PoseLog(
        Trajectory(truth.t_ns, *body, carried if stated else None),
        multiply(camera[1], conjugate(body_from_camera("forward"))),
        Trajectory(truth.t_ns, *camera, covariance if stated else None),
    )


def estimate_actor(
    t_s: Float,
    hip: Float,
    *,
    sigma_m: float,
    rate_hz: float,
    span_s: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[Int64, Float]:
    """Simulate estimates of the actor's hip with Gauss-Markov errors: stamps [M] ns, positions [M, 3]."""
    t_ns = log_times(rate_hz, span_s, rng)
    grid_ns = _nanoseconds(t_s)
    position = interpolate_points(grid_ns, hip, t_ns, max_gap_ns=int(np.ptp(grid_ns)) if len(grid_ns) else 0)
    error = GaussMarkov(position_m=sigma_m, correlation_s=ACTOR_CORRELATION_S)
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_ns), 1))
    return t_ns, position + error.errors(t_ns, position, level, rng)[:, :3]


def _nanoseconds(t_s: Float) -> Int64:
    return np.rint(t_s * 1e9).astype(np.int64)


def _hermite(grid_ns: Int64, position: Float, velocity: Float, t_ns: Int64) -> Float:
    """Evaluate the cubic [M, 3] through positions and velocities [T, 3], within the grid."""
    if len(grid_ns) < 2 or not len(t_ns):
        return np.tile(position[:1], (len(t_ns), 1))
    before = np.clip(np.searchsorted(grid_ns, t_ns, side="right") - 1, 0, len(grid_ns) - 2)
    span_s = (grid_ns[before + 1] - grid_ns[before])[:, None] / 1e9
    u = (t_ns - grid_ns[before])[:, None] / 1e9 / span_s
    bend_before = span_s * velocity[before] * u * (1 - u) ** 2
    bend_after = span_s * velocity[before + 1] * u**2 * (1 - u)
    blend = u**2 * (3 - 2 * u)
    start, end = position[before], position[before + 1]
    return start + blend * (end - start) + bend_before - bend_after
