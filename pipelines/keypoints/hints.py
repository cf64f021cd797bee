"""Place of the actor in a picture by the log, with its uncertainty."""

import math
from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.cameras import Intrinsics, project
from pipelines.geometry.poses import invert, transform
from pipelines.session.camera_poses import poses_at, stated_noise
from pipelines.session.description import CameraEntry, Interpolation
from pipelines.session.people import LoggedActor
from pipelines.session.records import Trajectory

# The actor lies within this many standard deviations of the log, but for 3 of 1,000 times.
_MARGIN_SIGMAS = 3.0
# This share of the range is small against a body and large against rounding.
_RANGE_STEP = 1e-4


@dataclass(frozen=True)
class Hint:
    """Place of the actor in a picture by the log."""

    centre: tuple[float, float]  # px
    height_px: float  # of the actor standing across the line of sight
    margin_px: float  # three sigma: how far from `centre` the actor may be
    tallest_px: float = (
        math.inf
    )  # of the same actor nearer by three sigma; inf where that is behind the camera


def project_actor(
    position_world: Float,
    world_from_camera: tuple[Float, Float],
    intrinsics: Intrinsics,
    *,
    sigma_m: float,
    sigma_rad: float,
    height_m: float = 1.75,
) -> Hint | None:
    """Project the actor's logged position into a camera's picture.

    The height is that of a body across the line of sight, for any tilt of the camera; sizes of regions are
    measured in it. Lengths are converted to pixels at the actor's place, so they include distortion
    and the stretch away from the axis.

    Args:
        position_world: [3] m, the point of the actor that the log follows (hip or near it).
        world_from_camera: position [3] m and quaternion [4] xyzw of the camera at that time.
        sigma_m: one sigma per axis of the actor's position relative to the camera's, both errors together.
        sigma_rad: one sigma per axis of the camera's rotation.
        height_m: height of the actor.

    Returns:
        The hint; None where a number is missing (NaN), the actor is behind the camera or beyond the
        model's valid radius, or outside the picture by more than the margin.
    """
    actor = transform(invert(*world_from_camera), position_world)
    # project() expects depth to be comparable, and NaN fails every comparison.
    if not actor[2] > 0:
        return None
    distance = float(np.linalg.norm(actor))
    across = np.linalg.svd(actor[None, :])[2][1:]  # two unit vectors at right angles to the line of sight
    points = np.vstack([actor, actor + _RANGE_STEP * distance * across])
    pixels = project(points, intrinsics)
    if not np.isfinite(pixels).all():
        return None
    px_per_rad = float(np.sqrt(abs(np.linalg.det(pixels[1:] - pixels[0])))) / _RANGE_STEP
    nearest = distance - _MARGIN_SIGMAS * sigma_m
    margin = _MARGIN_SIGMAS * px_per_rad * float(np.hypot(sigma_m / distance, sigma_rad))
    x, y = float(pixels[0, 0]), float(pixels[0, 1])
    if not (-margin <= x <= intrinsics.width - 1 + margin and -margin <= y <= intrinsics.height - 1 + margin):
        return None
    tallest = px_per_rad * height_m / nearest if nearest > 0 else math.inf
    return Hint((x, y), px_per_rad * height_m / distance, margin, tallest)


ACTOR_SIGMA_M = 1.0
"""Standard deviation of the actor's logged position, used to distinguish people."""
UNKNOWN_SIGMA_RAD = float(np.radians(1.0))
"""Standard deviation of a camera's rotation if the user states none.

The position noise of such a camera counts as part of `ACTOR_SIGMA_M`.
"""


def actor_hints(
    actor: LoggedActor,
    name: str,
    entry: CameraEntry,
    trajectory: Trajectory,
    between: Interpolation,
    t_ns: Int64,
) -> list[Hint | None]:
    """Predict the logged actor's hips in a camera's pictures; None where the log or the pose is missing.

    Args:
        between: rules for interpolating between the logged poses.
        t_ns: [T] times of the pictures.
    """
    position, quaternion = poses_at(trajectory, t_ns, between, static=entry.poses.static)
    sigma = hint_sigma(name, entry, trajectory, t_ns)
    intrinsics = entry.intrinsics.intrinsics()
    return [
        project_actor(at, (centre, turned), intrinsics, sigma_m=float(off_m), sigma_rad=float(off_rad))
        if np.isfinite(at).all() and np.isfinite(centre).all()
        else None
        for at, centre, turned, (off_m, off_rad) in zip(
            actor.hips_at(t_ns), position, quaternion, sigma, strict=True
        )
    ]


def hint_sigma(name: str, entry: CameraEntry, trajectory: Trajectory, t_ns: Int64) -> Float:
    """Compute the uncertainty of the logged actor as seen from a camera's logged pose.

    Args:
        entry: the camera's entry in session.json; its pose noise is used, else the log's covariances.
        t_ns: [T] times of the pictures.

    Returns:
        Standard deviation per axis [T, 2]. First column: position of the actor relative to the camera (m),
        with the errors of both. Second column: rotation of the camera (rad). Each row uses the noise of
        the last logged pose before the picture.
    """
    stated = stated_noise(name, entry, trajectory).sigma
    if stated is None:
        at_pictures = np.tile((0.0, UNKNOWN_SIGMA_RAD), (len(t_ns), 1))
    else:
        before = np.searchsorted(trajectory.t_ns, t_ns, side="right") - 1
        at_pictures = stated[np.clip(before, 0, len(stated) - 1)]
    return np.column_stack([np.hypot(ACTOR_SIGMA_M, at_pictures[:, 0]), at_pictures[:, 1]])
