"""Option `--refine-cameras background`: poses of moving cameras refined by what stands still.

Once for each camera its background is followed through the pictures; then its poses are adjusted, and take
the place of the logged ones in everything that comes after. Where a camera's background says too little the
logged poses stay, with the reason in one line.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipelines.geometry.cameras import undistort
from pipelines.geometry.poses import quaternion_from_matrix
from pipelines.reconstruction.background_poses import Adjusted, PosePrior, adjust
from pipelines.reconstruction.background_tracks import Tracks
from pipelines.reconstruction.observations import Camera
from pipelines.reconstruction.refinement.problem import ROTATION, SHIFT_IN_WORLD, PoseErrors, Process
from pipelines.session.description import Interpolation
from pipelines.session.records import Float, Int64, Trajectory

_RATE_HZ = 15.0  # of the pictures that are looked at: between them poses are interpolated
_LASTS_S = 10.0  # over which drift is taken for a constant


@dataclass(frozen=True)
class Followed:
    """The background of one camera."""

    rows: Int64  # [T] of its frames
    tracks: Tracks  # whose pictures count these


def rows_to_follow(camera: Camera) -> Int64:
    """The frames [T] at which a camera's background is looked at, the last one included."""
    frames = len(camera.frame_t_ns)
    if frames < 2:
        return np.arange(frames)
    period_s = float(np.median(np.diff(camera.frame_t_ns))) / 1e9
    every = max(1, round(1 / (_RATE_HZ * period_s)))
    return np.union1d(np.arange(0, frames, every), [frames - 1])


def prior_of(errors: PoseErrors | None, level: Float) -> PosePrior:
    """How far a camera's log may be off.

    Args:
        errors: as somebody states it over time; None when nobody does.
        level: [2] m, rad per axis, where nobody does: half of the variance is taken for lasting.
    """
    if errors is None:
        half = (float(level[0] / np.sqrt(2)), float(level[1] / np.sqrt(2)))
        return PosePrior(half, half)
    lasting = np.zeros(2)
    for process in errors.processes:
        kind = 1 if process.number == ROTATION else 0
        lasting[kind] += process.sigma0**2 + process.rate**2 * _LASTS_S
    return PosePrior(errors.white, (float(np.sqrt(lasting[0])), float(np.sqrt(lasting[1]))))


def refine_cameras(
    cameras: Sequence[Camera],
    followed: Mapping[str, Followed | str],
    priors: Sequence[PosePrior],
    *,
    between: Interpolation,
    stated: bool,
) -> tuple[list[Camera], dict[str, Any], list[str]]:
    """Cameras with the poses that their backgrounds tell.

    Args:
        cameras: all of them.
        followed: of each by its name, or why nothing was followed.
        priors: how far each log may be off.
        between: how far logged poses are trusted.
        stated: whether somebody stated the priors: `refined` then takes what is left as its own.

    Returns:
        The cameras; what metrics.json says of each; a line for each whose logged poses stay.
    """
    refined: list[Camera] = []
    told: dict[str, Any] = {}
    refusals: list[str] = []
    for camera, prior in zip(cameras, priors, strict=True):
        seen = followed[camera.name]
        if isinstance(seen, str):
            refined.append(camera)
            told[camera.name] = {"used": False, "reason": seen}
        else:
            t_ns = camera.frame_t_ns[seen.rows]
            logged = camera.poses_at(t_ns, between)
            found = adjust(
                seen.tracks.picture,
                seen.tracks.point,
                undistort(seen.tracks.xy, camera.intrinsics),
                camera.focal_px,
                *logged,
                prior,
            )
            refined.append(camera if found.refused else _with_poses(camera, t_ns, found, prior, stated))
            told[camera.name] = _told(found, prior)
        if told[camera.name]["reason"] is not None:
            reason = told[camera.name]["reason"]
            refusals.append(f"{camera.name}: its logged poses stay, because {reason}")
    return refined, told, refusals


def _with_poses(camera: Camera, t_ns: Int64, found: Adjusted, prior: PosePrior, stated: bool) -> Camera:
    posed = np.isfinite(found.position[:, 0])
    trajectory = Trajectory(t_ns[posed], found.position[posed], quaternion_from_matrix(found.rotation[posed]))
    covariance = found.covariance[posed]
    variances = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3)
    sigma = np.sqrt(variances.mean(axis=2))
    # What is left of attitudes changes slowly: neighbouring pictures share their points.
    turn = float(np.median(sigma[:, 1]))
    left = PoseErrors(
        (max(float(np.sqrt(max(np.median(sigma[:, 0]) ** 2 - prior.lasting[0] ** 2, 0.0))), 1e-3), turn / 2),
        (Process(SHIFT_IN_WORLD, max(prior.lasting[0], 1e-3)), Process(ROTATION, turn)),
    )
    return replace(
        camera, trajectory=trajectory, sigma=sigma, covariance=covariance, errors=left if stated else None
    )


def _told(found: Adjusted, prior: PosePrior) -> dict[str, Any]:
    used = found.refused is None
    turn = np.diagonal(found.covariance[:, 3:, 3:], axis1=1, axis2=2).mean(axis=1)
    return {
        "used": used,
        "reason": found.refused,
        "pictures": len(found.position),
        "points": found.points,
        "reprojection_px": found.reprojection_px if used else None,
        "rotation_sigma_deg": {
            "log": float(np.degrees(prior.level[1])),
            "background": float(np.degrees(np.sqrt(np.median(turn)))) if used else None,
        },
    }
