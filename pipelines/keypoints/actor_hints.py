"""Where a camera should see the logged actor, picture by picture."""

from __future__ import annotations

import numpy as np

from pipelines.keypoints.hints import Hint, project_actor
from pipelines.session.camera_poses import poses_at
from pipelines.session.description import CameraEntry, Interpolation
from pipelines.session.logged_actor import LoggedActor
from pipelines.session.pose_noise import stated_noise
from pipelines.session.records import Float, Int64, Trajectory

ACTOR_SIGMA_M = 1.0
"""Of the actor's log, as it is taken for telling people apart."""
UNKNOWN_SIGMA_RAD = float(np.radians(1.0))
"""Of a camera's rotation where nobody states it; the noise of its position is in the actor's then."""


def actor_hints(
    actor: LoggedActor,
    name: str,
    entry: CameraEntry,
    trajectory: Trajectory,
    between: Interpolation,
    t_ns: Int64,
) -> list[Hint | None]:
    """Where the hips of the logged actor should be in a camera's pictures; None where log or pose is silent.

    Args:
        actor: who was logged.
        name: of the camera.
        entry: what session.json says of it.
        trajectory: its logged poses.
        between: how far they are trusted.
        t_ns: [T] when the pictures were taken.
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
    """How far the logged actor may be from where a camera's logged pose has them.

    Args:
        name: of the camera.
        entry: what session.json says of it; its pose noise, else the log's covariances, are taken.
        trajectory: its logged poses.
        t_ns: [T] when pictures were taken.

    Returns:
        Standard deviation per axis [T, 2]: of the actor's position relative to the camera's (m), the errors
        of both together, and of the camera's rotation (rad); of the logged pose before each picture.
    """
    stated = stated_noise(name, entry, trajectory).sigma
    if stated is None:
        at_pictures = np.tile((0.0, UNKNOWN_SIGMA_RAD), (len(t_ns), 1))
    else:
        before = np.searchsorted(trajectory.t_ns, t_ns, side="right") - 1
        at_pictures = stated[np.clip(before, 0, len(stated) - 1)]
    return np.column_stack([np.hypot(ACTOR_SIGMA_M, at_pictures[:, 0]), at_pictures[:, 1]])
