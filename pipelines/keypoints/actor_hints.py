"""Expected place of the logged actor in each picture of a camera."""

from __future__ import annotations

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.keypoints.hints import Hint, project_actor
from pipelines.session.camera_poses import poses_at, stated_noise
from pipelines.session.description import CameraEntry, Interpolation
from pipelines.session.people import LoggedActor
from pipelines.session.records import Int64, Trajectory

ACTOR_SIGMA_M = 1.0
"""Standard deviation of the actor's logged position, used to tell people apart."""
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
        actor: the logged actor.
        name: name of the camera.
        entry: the camera's entry in session.json.
        trajectory: its logged poses.
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
        name: name of the camera.
        entry: the camera's entry in session.json; its pose noise is used, else the log's covariances.
        trajectory: its logged poses.
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
