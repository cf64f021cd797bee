"""Poses of moving cameras corrected by the static background.

Each camera's background is followed through its pictures once (`background_tracks`). Then its poses are
adjusted (`background_adjustment`) and replace the logged poses in all later steps. Where the background says
nothing, or contradicts the log, the logged poses stay, with the reason in one line.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.cameras import row_delay_s, undistort
from pipelines.geometry.noise import EXACT, ROTATION, PoseErrors, Process
from pipelines.geometry.poses import quaternion_from_matrix, velocities
from pipelines.reconstruction.background_adjustment import (
    Adjusted,
    Background,
    PosePrior,
    SeenPoints,
    adjust,
    clock_offset,
)
from pipelines.reconstruction.background_tracks import Followed, Tracks
from pipelines.reconstruction.doubts.turning import common_offset
from pipelines.reconstruction.observations import Camera
from pipelines.session.description import Interpolation
from pipelines.session.records import Trajectory

# --- tuning ---

# Few pictures show a clock roughly. A stated one within so many standard deviations needs no closer look.
SIGMAS_TO_LOOK_CLOSER = 3.0


def refine_cameras(
    cameras: Sequence[Camera],
    followed: Mapping[str, Followed | str],
    errors: Sequence[PoseErrors | None],
    *,
    between: Interpolation,
) -> tuple[list[Camera], dict[str, Any], list[str]]:
    """Refine the poses of cameras by their backgrounds.

    Args:
        cameras: all of them.
        followed: background of each camera by its name, or the reason why none was followed.
        errors: those stated for each camera's log; None for unknown ones, whose levels are estimated.
        between: rules for interpolating between logged poses.

    Returns:
        The cameras, with the errors that remain. The entry of each in metrics.json. A warning for each camera
        that keeps its logged poses, or whose log may be frozen.
    """
    refined: list[Camera] = []
    entries: dict[str, Any] = {}
    warnings: list[str] = []
    for camera, stated in zip(cameras, errors, strict=True):
        seen = followed[camera.name]
        if isinstance(seen, str):
            refined.append(camera)
            entries[camera.name] = {"used": False, "reason": seen}
        else:
            t_ns = camera.frame_t_ns[seen.rows]
            found = adjust(background_of(camera, seen), *camera.poses_at(t_ns, between), PosePrior.of(stated))
            refined.append(_with_poses(camera, t_ns, found))
            entries[camera.name] = _entry(found)
            if found.frozen:
                warnings.append(
                    f"{camera.name}: its logged position never changes, but its pictures do not show a camera"
                    " that stands: is the log frozen?"
                )
        if entries[camera.name]["reason"] is not None:
            reason = entries[camera.name]["reason"]
            warnings.append(f"{camera.name}: its logged poses stay, because {reason}")
    return refined, entries, warnings


def clocks_of_backgrounds(
    cameras: Sequence[Camera],
    followed: Mapping[str, Followed | str],
    errors: Sequence[PoseErrors | None],
    clock_sigma_s: Float,
    stated: Bool | None = None,
    *,
    between: Interpolation,
) -> tuple[Float, Float]:
    """Find the clock offset of each camera that turns: its log turns as its background does.

    A rough search finds offsets of some tenths of a second, and the adjustment of the poses the rest.

    Args:
        cameras: all of them.
        followed: background of each camera by its name, or the reason why none was followed.
        errors: as for `refine_cameras`.
        clock_sigma_s: [C] prior standard deviation of each clock offset, 0 for a known clock.
        stated: [C] True for clocks of which a quick look decides if they are estimated; by default none.
        between: rules for interpolating between logged poses.

    Returns:
        Offset [C] to add to the pictures' times and its standard deviation [C], s; NaN where the clock is
        known or the background does not determine it.
    """
    found = np.full((len(cameras), 2), np.nan)
    for c, (camera, stated_errors) in enumerate(zip(cameras, errors, strict=True)):
        seen = followed[camera.name]
        if clock_sigma_s[c] == 0 or isinstance(seen, str):
            continue
        background, prior = background_of(camera, seen), PosePrior.of(stated_errors)
        if stated is not None and stated[c]:
            poses_at = partial(_poses_late, camera, camera.frame_t_ns[seen.rows], 0.0, between)
            look = clock_offset(background, poses_at, prior, quick=True)
            if look is None or abs(look[0]) <= SIGMAS_TO_LOOK_CLOSER * look[1]:
                found[c] = (np.nan, np.nan) if look is None else (0.0, look[1])
                continue
        rough = common_offset([camera], {camera.name: seen}, between)
        about_s = 0.0 if rough is None else rough.late_s
        poses_at = partial(_poses_late, camera, camera.frame_t_ns[seen.rows], about_s, between)
        clock = clock_offset(background, poses_at, prior)
        if clock is not None:
            share = clock_sigma_s[c] ** 2 / (clock_sigma_s[c] ** 2 + clock[1] ** 2)
            found[c] = share * (about_s + clock[0]), np.sqrt(share) * clock[1]
    return found[:, 0], found[:, 1]


def _poses_late(
    camera: Camera, t_ns: Int64, about_s: float, between: Interpolation, late_s: float
) -> tuple[Float, Float]:
    return camera.poses_at(t_ns + round(1e9 * (about_s + late_s)), between)


def background_of(camera: Camera, followed: Followed) -> Background:
    """Return a camera's background as it is adjusted."""
    t_ns = camera.frame_t_ns[followed.rows]

    def between(first: int, stop: int) -> SeenPoints:
        parts = [SeenPoints(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))]
        for tracks in followed.between(first, stop):
            rays = _rays(tracks, camera, t_ns)  # of whole parts: velocities need the neighbours
            parts.append(SeenPoints(tracks.picture, tracks.point, rays).between(first, stop))
        return SeenPoints(
            np.concatenate([part.picture for part in parts]),
            np.concatenate([part.point for part in parts]),
            np.concatenate([part.rays for part in parts]),
        )

    loosened = None if camera.loosened is None else camera.loosened_at(t_ns)
    return Background(between, camera.focal_px, (t_ns - t_ns[0]) / 1e9, loosened)


def _rays(tracks: Tracks, camera: Camera, t_ns: Int64) -> Float:
    """Compute the viewing rays [K, 2] of followed points at the stamps [T] of their pictures.

    Points of a rolling shutter go on from their rows' times by their own velocities.
    """
    rays = undistort(tracks.xy, camera.intrinsics)
    if not camera.intrinsics.readout_s:
        return rays
    delay_s = row_delay_s(tracks.xy[:, 1], camera.intrinsics)
    order = np.lexsort((tracks.picture, tracks.point))
    point, picture = tracks.point[order], tracks.picture[order]
    follows = (np.diff(point) == 0) & (np.diff(picture) == 1)
    t_s = (t_ns[picture] - t_ns[0]) / 1e9 + delay_s[order]
    before, after = velocities(t_s, rays[order], follows)
    sides = np.stack([np.where(np.isnan(before), after, before), np.where(np.isnan(after), before, after)])
    motion = np.empty_like(rays)
    motion[order] = sides.mean(axis=0) * delay_s[order, None]
    # A point that was seen once has no velocity, and is used for nothing.
    return rays - np.nan_to_num(motion)


def _with_poses(camera: Camera, t_ns: Int64, found: Adjusted) -> Camera:
    if found.left is None:
        return camera
    posed = np.isfinite(found.position[:, 0])
    trajectory = Trajectory(t_ns[posed], found.position[posed], quaternion_from_matrix(found.rotation[posed]))
    covariance = found.covariance[posed]
    variances = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3)
    return replace(
        camera,
        trajectory=trajectory,
        sigma=np.sqrt(variances.mean(axis=2)),
        covariance=covariance,
        errors=found.left,
        loosened=_loosened_still(camera.loosened_at(t_ns[posed]), variances.mean(axis=2)),
    )


def _loosened_still(loosened: Float, variance: Float) -> Float | None:
    """Compute what is left of loosened poses [T, 2], from the variances [T, 2] that all poses have now."""
    if not loosened.any():
        return None
    more = np.sqrt(np.maximum(variance - np.median(variance, axis=0), 0.0))
    return np.where((loosened > 0).any(axis=1, keepdims=True), more, 0.0)


def _entry(found: Adjusted) -> dict[str, Any]:
    used = found.refused is None
    turn = np.diagonal(found.covariance[:, 3:, 3:], axis1=1, axis2=2).mean(axis=1)
    prior = found.prior
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
        "levels": {
            "estimated": prior.estimated,
            "white": _m_deg(prior.white),
            "constant": _m_deg(prior.constant[:2]),
            "slow": [_described(process) for process in prior.slow if process.rate or process.sigma0 > EXACT],
        },
        "left": None if found.left is None else _left(found.left),
    }


def _left(left: PoseErrors) -> dict[str, Any]:
    """Describe the errors that remain."""
    return {"white": _m_deg(left.white), "processes": [_described(process) for process in left.processes]}


def _m_deg(sigma: tuple[float, float]) -> dict[str, float]:
    return {"m": sigma[0], "deg": float(np.degrees(sigma[1]))}


def _described(process: Process) -> dict[str, Any]:
    """Describe an error over time: its standard deviation, its drift in a second, its memory."""
    unit, scale = ("deg", np.degrees(1.0)) if process.number == ROTATION else ("m", 1.0)
    return {
        unit: float(scale * process.sigma0),
        f"{unit}_per_sqrt_s": float(scale * process.rate),
        "correlation_s": process.correlation_s if np.isfinite(process.correlation_s) else None,
    }
