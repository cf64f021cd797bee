"""Option `--refine-cameras background`: poses of moving cameras refined by the static background.

Each camera's background is followed through its pictures once. Then its poses are adjusted and replace the
logged poses in all later steps. If a camera's background is not informative enough, the logged poses stay,
with the reason in one line.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.cameras import row_delay_s, undistort
from pipelines.geometry.poses import quaternion_from_matrix, velocities
from pipelines.reconstruction.background_poses import Adjusted, PosePrior, adjust
from pipelines.reconstruction.background_tracks import Tracks
from pipelines.reconstruction.observations import Camera
from pipelines.reconstruction.refinement.problem import ROTATION, SHIFT_IN_WORLD, PoseErrors, Process
from pipelines.session.description import Interpolation
from pipelines.session.records import Int64, Trajectory

_RATE_HZ = 15.0  # of the pictures used: between them poses are interpolated
_LASTS_S = 10.0  # drift over this time is treated as a constant error


@dataclass(frozen=True)
class Followed:
    """Background of one camera."""

    rows: Int64  # [T] of its frames
    tracks: Tracks  # their `picture` counts these rows


def rows_to_follow(camera: Camera) -> Int64:
    """Choose the frames [T] in which a camera's background is followed, the last one included."""
    frames = len(camera.frame_t_ns)
    if frames < 2:
        return np.arange(frames)
    period_s = float(np.median(np.diff(camera.frame_t_ns))) / 1e9
    every = max(1, round(1 / (_RATE_HZ * period_s)))
    return np.union1d(np.arange(0, frames, every), [frames - 1])


def prior_of(errors: PoseErrors | None, level: Float) -> PosePrior:
    """Compute the prior of a camera's logged poses.

    Args:
        errors: stated pose errors over time; None if none are stated.
        level: [2] m, rad per axis, used without `errors`: half of the variance is taken as constant.
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
    """Refine the poses of cameras by their backgrounds.

    Args:
        cameras: all of them.
        followed: background of each camera by its name, or the reason why none was followed.
        priors: prior of each camera's log.
        between: rules for interpolating between logged poses.
        stated: True if the priors were stated by the user: `refined` then uses the remaining errors as its
            own prior.

    Returns:
        The cameras; the entry of each in metrics.json; a line for each camera that keeps its logged poses.
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
                _rays(seen.tracks, camera, t_ns),
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


def _rays(tracks: Tracks, camera: Camera, t_ns: Int64) -> Float:
    """Compute the viewing rays [K, 2] of followed points at the stamps [T] of their pictures.

    Points of a rolling shutter go on from their rows' times by their own velocities.
    """
    xy = undistort(tracks.xy, camera.intrinsics)
    if not camera.intrinsics.readout_s:
        return xy
    delay_s = row_delay_s(tracks.xy[:, 1], camera.intrinsics)
    order = np.lexsort((tracks.picture, tracks.point))
    point, picture = tracks.point[order], tracks.picture[order]
    follows = (np.diff(point) == 0) & (np.diff(picture) == 1)
    t_s = (t_ns[picture] - t_ns[0]) / 1e9 + delay_s[order]
    before, after = velocities(t_s, xy[order], follows)
    sides = np.stack([np.where(np.isnan(before), after, before), np.where(np.isnan(after), before, after)])
    motion = np.empty_like(xy)
    motion[order] = sides.mean(axis=0) * delay_s[order, None]
    # A point that was seen once has no velocity, and is used for nothing.
    return xy - np.nan_to_num(motion)


def _with_poses(camera: Camera, t_ns: Int64, found: Adjusted, prior: PosePrior, stated: bool) -> Camera:
    posed = np.isfinite(found.position[:, 0])
    trajectory = Trajectory(t_ns[posed], found.position[posed], quaternion_from_matrix(found.rotation[posed]))
    covariance = found.covariance[posed]
    variances = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3)
    sigma = np.sqrt(variances.mean(axis=2))
    # The remaining attitude errors change slowly: neighbouring pictures share their points.
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
