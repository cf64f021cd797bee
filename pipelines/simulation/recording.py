"""Recorders of a flight: their own stamps, and poses with the errors of an estimator."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.mounting import body_from_camera
from pipelines.geometry.noise import GaussMarkov, NoiseModel, disturb, sum_sigma
from pipelines.geometry.poses import (
    compose,
    conjugate,
    interpolate_points,
    interpolate_poses,
    invert,
    mounted_covariance,
    multiply,
    rates,
    rotate,
)
from pipelines.session.records import Trajectory
from pipelines.simulation.flying import LEVER_ARM, DronePaths
from pipelines.simulation.scenario import Lens

JITTER_SHARE = 0.02  # sigma of a log's stamps, of the time between them; at most ten times that
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
    """The log of the estimator on board of one drone, row by row at the same stamps.

    `gimbal_xyzw` is world_from_gimbal: with it, `body` and the lever arm `compose_gimbal` gives `camera`.
    """

    body: Trajectory
    gimbal_xyzw: Float  # [M, 4]
    camera: Trajectory


# --- stamps --------------------------------------------------------------------------------------------


def log_times(rate_hz: float, span_s: tuple[float, float], rng: np.random.Generator) -> Int64:
    """Draw the stamps [M] of a log within a span, ns since the flight's start, strictly increasing.

    The recorder's ticks have a random phase against the flight's start. Every stamp has a small jitter about
    its tick.
    """
    first, last = span_s
    ticks = first + (np.arange(max(0, np.ceil((last - first) * rate_hz))) + rng.random()) / rate_hz
    jitter = np.clip(JITTER_SHARE * rng.standard_normal(len(ticks)), -_LARGEST_JITTER, _LARGEST_JITTER)
    t_s: Float = ticks + jitter / rate_hz
    return _nanoseconds(t_s[(t_s >= first) & (t_s <= last)])


def frame_times(lens: Lens, duration_s: float, rng: np.random.Generator) -> Int64:
    """Draw the stamps [F] of the frames that one camera kept, ns since the flight's start.

    The shutter is periodic. It starts at a random time within the first frame's period, or at the flight's
    start where shutters are synchronised. Frames are lost one by one with the lens's share; the first and the
    last are kept.
    """
    phase = rng.random() * (lens.shutters == "free")
    count = max(0, int(np.ceil(duration_s * lens.rate_hz - phase)))
    shutter_s = np.arange(count, dtype=np.float64) / lens.rate_hz + phase / lens.rate_hz
    t_ns = _nanoseconds(shutter_s)
    kept = rng.random(count) >= lens.dropped_share
    kept[:1] = kept[-1:] = True
    return t_ns[kept]


# --- poses ---------------------------------------------------------------------------------------------


def poses_at(paths: DronePaths, drone: int, t_ns: Int64) -> DronePoses:
    """Interpolate the true poses of one drone at moments [M] (ns since the flight's start) of its path.

    Positions follow the cubic through the path's positions and velocities, attitudes turn evenly. The
    camera always sits at the lever arm's end.

    Raises:
        ValueError: a moment outside the path.
    """
    grid_ns = _nanoseconds(paths.t_s)
    if len(t_ns) and not (len(grid_ns) and grid_ns[0] <= t_ns.min() and t_ns.max() <= grid_ns[-1]):
        raise ValueError("poses are asked for before or after the flight")
    position = _hermite(grid_ns, paths.position[drone], paths.velocity[drone], t_ns)
    longest_ns = int(np.diff(grid_ns).max(initial=0))
    body_xyzw, camera_xyzw = (
        interpolate_poses(
            grid_ns,
            paths.position[drone],
            quaternion[drone],
            t_ns,
            max_gap_ns=longest_ns,
            max_extrapolation_ns=0,
        )[1]
        for quaternion in (paths.body_xyzw, paths.camera_xyzw)
    )
    camera_position = position + rotate(body_xyzw, np.array(LEVER_ARM))
    return DronePoses(t_ns, position, body_xyzw, camera_position, camera_xyzw)


def sample_log(
    paths: DronePaths, drone: int, rate_hz: float, span_s: tuple[float, float], rng: np.random.Generator
) -> DronePoses:
    """Interpolate one drone's true poses at the stamps of its log (`log_times`).

    Raises:
        ValueError: the span reaches beyond the path.
    """
    return poses_at(paths, drone, log_times(rate_hz, span_s, rng))


def gimbal_attitude(camera_xyzw: Float) -> Float:
    """Convert world_from_camera [..., 4] to world_from_gimbal [..., 4].

    The gimbal's x points where the camera looks, z up in the picture.
    """
    return multiply(camera_xyzw, conjugate(body_from_camera("forward")))


def estimate(truth: DronePoses, models: Sequence[NoiseModel], rng: np.random.Generator) -> PoseLog:
    """Simulate one drone's log with the errors of some models, and the covariances that belong to them.

    The models' errors are the camera's. The body is logged where a camera with those errors has it: body
    and gimbal share the error in rotation, as both come from the same estimate of north and down, and
    the angles between them are exact.

    Args:
        truth: the true poses, stamps strictly increasing.
        models: the errors, drawn in this order.

    Returns:
        Poses whose covariances [M, 6, 6] (position in world, rotation vector in the body or the camera)
        hold the models' marginal sigmas at each stamp; None if no model has any. ROS states
        rotations about fixed axes: `pose_covariance_in_body(covariance, conjugate(quaternion))`.
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
        gimbal_attitude(camera[1]),
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
    """Simulate the estimated positions of the actor's hip.

    The error is a Gauss-Markov process: `sigma_m` per axis at any moment, and correlated over
    ACTOR_CORRELATION_S.

    Args:
        t_s: [T] seconds, strictly increasing.
        hip: [T, 3] m, the truth; linear between the moments.
        sigma_m: of the error, per axis.
        rate_hz: rate of the logged estimates.
        span_s: first and last second of the log, within `t_s`.

    Returns:
        Stamps [M], ns since the flight's start, and positions [M, 3]; never NaN.

    Raises:
        ValueError: the span reaches beyond `t_s`, or the truth has gaps.
    """
    t_ns = log_times(rate_hz, span_s, rng)
    grid_ns = _nanoseconds(t_s)
    position = interpolate_points(grid_ns, hip, t_ns, max_gap_ns=int(np.ptp(grid_ns)) if len(grid_ns) else 0)
    if np.isnan(position).any():
        raise ValueError("the actor's hip is not known throughout the log")
    error = GaussMarkov(position_m=sigma_m, correlation_s=ACTOR_CORRELATION_S)
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_ns), 1))
    return t_ns, position + error.errors(t_ns, position, level, rng)[:, :3]


def _nanoseconds(t_s: Float) -> Int64:
    t_ns: Int64 = np.rint(t_s * 1e9).astype(np.int64)
    return t_ns


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
    points: Float = start + blend * (end - start) + bend_before - bend_after
    return points
