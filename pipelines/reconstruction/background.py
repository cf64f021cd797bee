"""Option `--refine-cameras background`: poses of moving cameras refined by the static background.

Each camera's background is followed through its pictures once. Then its poses are adjusted and replace the
logged poses in all later steps. If a camera's background is not informative enough, the logged poses stay,
with the reason in one line.

Poses are adjusted by bundle adjustment of one camera, with its log as the prior. Unknowns are the points, an
error of every logged pose, and the part of these errors that is constant over a stretch of the flight.
Attitudes are well determined, because an attitude error changes the motion of the background against the
logged path. Positions are not: the whole path can be moved without any residual. On a straight path the
rotation about the path is not determined either; that axis keeps the log's value. pycolmap's adjustment has
priors of positions only; here the attitude prior matters.

Points are eliminated (Schur complement). Cauchy's loss handles points off the background and lost tracks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.cameras import row_delay_s, undistort
from pipelines.geometry.noise import ROTATION, SHIFT_IN_WORLD, PoseErrors, Process
from pipelines.geometry.poses import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    velocities,
)
from pipelines.reconstruction.background_tracks import Tracks
from pipelines.reconstruction.observations import Camera
from pipelines.session.description import Interpolation
from pipelines.session.records import Trajectory

_RATE_HZ = 15.0  # of the pictures used: between them poses are interpolated
_CONSTANT_S = 10.0  # drift over this time is treated as a constant error


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
    constant = np.zeros(2)
    for process in errors.processes:
        kind = 1 if process.number == ROTATION else 0
        constant[kind] += process.sigma0**2 + process.rate**2 * _CONSTANT_S
    return PosePrior(errors.white, (float(np.sqrt(constant[0])), float(np.sqrt(constant[1]))))


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
    entries: dict[str, Any] = {}
    refusals: list[str] = []
    for camera, prior in zip(cameras, priors, strict=True):
        seen = followed[camera.name]
        if isinstance(seen, str):
            refined.append(camera)
            entries[camera.name] = {"used": False, "reason": seen}
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
            entries[camera.name] = _entry(found, prior)
        if entries[camera.name]["reason"] is not None:
            reason = entries[camera.name]["reason"]
            refusals.append(f"{camera.name}: its logged poses stay, because {reason}")
    return refined, entries, refusals


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


def _with_poses(camera: Camera, t_ns: Int64, found: Adjusted, prior: PosePrior, stated: bool) -> Camera:
    posed = np.isfinite(found.position[:, 0])
    trajectory = Trajectory(t_ns[posed], found.position[posed], quaternion_from_matrix(found.rotation[posed]))
    covariance = found.covariance[posed]
    variances = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3)
    sigma = np.sqrt(variances.mean(axis=2))
    # The remaining attitude errors change slowly: neighbouring pictures share their points.
    turn = float(np.median(sigma[:, 1]))
    left = PoseErrors(
        (max(float(np.sqrt(max(np.median(sigma[:, 0]) ** 2 - prior.constant[0] ** 2, 0.0))), 1e-3), turn / 2),
        (Process(SHIFT_IN_WORLD, max(prior.constant[0], 1e-3)), Process(ROTATION, turn)),
    )
    return replace(
        camera, trajectory=trajectory, sigma=sigma, covariance=covariance, errors=left if stated else None
    )


def _entry(found: Adjusted, prior: PosePrior) -> dict[str, Any]:
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


# --- bundle adjustment ---------------------------------------------------------------------------------

STRETCH = 200
"""Approximate number of pictures adjusted together: more would share no points and make large matrices."""

_PIXEL_SIGMA = 0.5  # of a followed point; they drift by some tenths
_LOSS = 2.0  # standard deviations at which a sighting counts half
_FEWEST_SIGHTINGS = 5  # of a point
_FEWEST_POINTS = 50
_PARALLAX = 1e-4  # of a point's rays: mean square of the sine of the angle between them
_NEAREST_M, _FARTHEST_M = 1.0, 300.0
_WORST_PX = 2.0
_ROUNDS = 8
_CONVERGED = 1e-4  # m and rad
_SIGMAS = 4.0
_DAMPING = 1e-9
_LEAST_GAIN = 0.9  # of the attitude's prior sigma: above it the background adds no information


@dataclass(frozen=True)
class PosePrior:
    """Standard deviations (m, rad) per axis of the white and of the constant part of logged pose errors."""

    white: tuple[float, float]
    constant: tuple[float, float]

    @property
    def level(self) -> Float:
        """Standard deviation of both parts together [2] (m, rad)."""
        level: Float = np.hypot(self.white, self.constant)
        return level

    def covariance(self, times: int) -> Float:
        """Return the covariance [times, 6, 6] of the logged poses."""
        return np.tile(np.diag(np.repeat(self.level**2, 3)), (times, 1, 1))


@dataclass(frozen=True)
class Adjusted:
    """Poses after adjustment of T pictures."""

    position: Float  # [T, 3] m
    rotation: Float  # [T, 3, 3] world_from_camera
    covariance: Float  # [T, 6, 6] position in the world (m^2), then rotation vector in the camera (rad^2)
    points: int  # that were used
    reprojection_px: float  # median; NaN where refused
    refused: str | None  # reason why the logged poses stay, in one line


def adjust(
    picture: Int64,
    point: Int64,
    rays: Float,
    focal_px: float,
    position: Float,
    rotation: Float,
    prior: PosePrior,
) -> Adjusted:
    """Refine the poses of one camera by its background.

    Args:
        picture: [K] row of the poses in which a point was seen.
        point: [K] its number.
        rays: [K, 2] normalised undistorted image coordinates.
        focal_px: focal length, to convert them to pixels.
        position: [T, 3] m, logged; NaN without a pose.
        rotation: [T, 3, 3] logged world_from_camera.
        prior: standard deviations of the log's errors.

    Returns:
        Adjusted poses, in stretches of about 200 pictures. If one stretch is refused, all logged poses stay
        and `refused` gives the reason. Pictures without a pose stay without one.
    """
    new_position, new_rotation = position.copy(), rotation.copy()
    covariance = prior.covariance(len(position))
    used, residuals = 0, []
    posed = np.flatnonzero(np.isfinite(position[:, 0]))
    if not len(posed):
        return _refused(position, rotation, prior, 0, "none of its pictures has a pose")
    # Equal lengths: a short remainder would have too little parallax.
    for rows in np.array_split(posed, max(round(len(posed) / STRETCH), 1)):
        place = np.full(len(position), -1)
        place[rows] = np.arange(len(rows))
        mine = place[picture] >= 0
        stretch = _Stretch.of(
            place[picture[mine]], point[mine], rays[mine], focal_px, position[rows], rotation[rows], prior
        )
        if stretch.points_count < _FEWEST_POINTS:
            reason = (
                f"{stretch.points_count} points of the background show parallax, {_FEWEST_POINTS} are needed"
            )
            return _refused(position, rotation, prior, stretch.points_count, reason)
        done = stretch.solve()
        if done is None:
            return _refused(
                position, rotation, prior, stretch.points_count, "the adjustment did not converge"
            )
        new_position[rows], new_rotation[rows], covariance[rows], errors, median_px = done
        used += stretch.points_count
        residuals.append(median_px)
        surprise = float(np.abs(errors.mean(axis=0) / np.repeat(prior.level, 3)).max())
        if surprise > _SIGMAS:
            reason = f"its poses would be {surprise:.0f} standard deviations from the log"
            return _refused(position, rotation, prior, used, reason)
    pixels = float(np.median(residuals))
    if pixels > _WORST_PX:
        reason = f"the background moves by {pixels:.1f} px against itself"
        return _refused(position, rotation, prior, used, reason)
    turn = np.sqrt(np.diagonal(covariance[:, 3:, 3:], axis1=1, axis2=2).mean(axis=1))
    if float(np.median(turn)) > _LEAST_GAIN * prior.level[1]:
        return _refused(
            position, rotation, prior, used, "the background says no more of attitudes than the log"
        )
    return Adjusted(new_position, new_rotation, covariance, used, pixels, None)


def _refused(position: Float, rotation: Float, prior: PosePrior, points: int, reason: str) -> Adjusted:
    return Adjusted(position, rotation, prior.covariance(len(position)), points, np.nan, reason)


@dataclass(frozen=True)
class _Stretch:
    """Pictures that are adjusted together, and the points seen in them, numbered from 0."""

    picture: Int64  # [K]
    point: Int64  # [K]
    rays: Float  # [K, 2]
    sigma: float  # of a normalised image coordinate
    position: Float  # [T, 3]
    rotation: Float  # [T, 3, 3]
    prior: PosePrior
    start: Float  # [N, 3]

    @property
    def points_count(self) -> int:
        return len(self.start)

    @classmethod
    def of(
        cls,
        picture: Int64,
        point: Int64,
        rays: Float,
        focal_px: float,
        position: Float,
        rotation: Float,
        prior: PosePrior,
    ) -> _Stretch:
        """Build a stretch from the points seen often enough, with enough parallax, in front of the camera."""
        names, number = np.unique(point, return_inverse=True)
        count = np.bincount(number, minlength=len(names))
        ray = np.einsum("kij,kj->ki", rotation[picture], np.append(rays, np.ones((len(rays), 1)), axis=1))
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        normal = _sum_by(across, number, len(names))
        right = _sum_by(np.einsum("kij,kj->ki", across, position[picture]), number, len(names))
        kept = count >= _FEWEST_SIGHTINGS
        kept &= np.linalg.eigvalsh(normal)[:, 0] > _PARALLAX * np.maximum(count, 1)
        start = np.zeros((len(names), 3))
        start[kept] = np.linalg.solve(normal[kept], right[kept, :, None])[..., 0]
        depth = np.einsum("ki,ki->k", start[number] - position[picture], rotation[picture][:, :, 2])
        kept[number[(depth < _NEAREST_M) | (depth > _FARTHEST_M)]] = False
        seen = kept[number]
        renumbered = np.cumsum(kept) - 1
        return cls(
            picture[seen],
            renumbered[number[seen]],
            rays[seen],
            _PIXEL_SIGMA / focal_px,
            position,
            rotation,
            prior,
            start[kept],
        )

    def solve(self) -> tuple[Float, Float, Float, Float, float] | None:
        """Solve for positions, rotations, their covariances, pose errors [T, 6] and the median residual (px).

        Returns None if the adjustment does not converge.
        """
        times = len(self.position)
        errors, constant, points = np.zeros((times, 6)), np.zeros(6), self.start
        white = np.repeat(self.prior.white, 3)
        # A shift of the whole path causes no residual: the path stays at the logged position.
        steady = np.repeat([0.0, self.prior.constant[1]], 3)
        white, steady = np.maximum(white, 1e-5), np.maximum(steady, 1e-5)
        normal = np.empty((0, 0))
        whitened = np.empty(0)
        for _ in range(_ROUNDS):
            position, rotation = self._poses(errors)
            by_pose, by_point, residual = self._linearised(position, rotation, points)
            whitened = np.linalg.norm(residual, axis=1) / self.sigma
            weight = 1 / (1 + (whitened / _LOSS) ** 2) / self.sigma**2
            normal, step, moves = self._step(
                by_pose, by_point, residual, weight, errors, constant, white, steady
            )
            if not np.isfinite(step).all():
                return None
            errors = errors + step[:-6].reshape(times, 6)
            constant = constant + step[-6:]
            points = points + moves
            if np.abs(step).max() < _CONVERGED:
                break
        position, rotation = self._poses(errors)
        inverse = np.linalg.inv(normal)[:-6, :-6].reshape(times, 6, times, 6)
        covariance: Float = np.asarray(inverse, dtype=np.float64)[np.arange(times), :, np.arange(times)]
        if not (np.linalg.eigvalsh(covariance) > 0).all():
            return None
        covariance[:, range(3), range(3)] += self.prior.constant[0] ** 2
        return position, rotation, covariance, errors, _PIXEL_SIGMA * float(np.median(whitened))

    def _poses(self, errors: Float) -> tuple[Float, Float]:
        """Remove errors from the logged poses: (p - e, R exp(-w))."""
        back = matrix_from_quaternion(quaternion_from_rotation_vector(-errors[:, 3:]))
        return self.position - errors[:, :3], self.rotation @ back

    def _linearised(self, position: Float, rotation: Float, points: Float) -> tuple[Float, Float, Float]:
        """Compute derivatives of image points by pose error [K, 2, 6] and point [K, 2, 3], and residuals."""
        own = rotation[self.picture]
        seen = np.einsum("kji,kj->ki", own, points[self.point] - position[self.picture])
        depth = np.where(np.abs(seen[:, 2]) > 1e-3, seen[:, 2], 1e-3)
        u, v = seen[:, 0] / depth, seen[:, 1] / depth
        project = np.zeros((len(seen), 2, 3))
        project[:, 0, 0] = project[:, 1, 1] = 1 / depth
        project[:, 0, 2], project[:, 1, 2] = -u / depth, -v / depth
        by_point = project @ np.swapaxes(own, 1, 2)
        # With w the point stands at exp(w) R'(X - p + e): it moves as R' e and as w x it.
        x, y, z = seen.T
        o = np.zeros_like(x)
        turned = np.stack([o, z, -y, -z, o, x, y, -x, o], axis=-1).reshape(-1, 3, 3)
        by_pose = np.concatenate([by_point, project @ turned], axis=2)
        return by_pose, by_point, self.rays - np.stack([u, v], axis=1)

    def _step(
        self,
        by_pose: Float,
        by_point: Float,
        residual: Float,
        weight: Float,
        errors: Float,
        constant: Float,
        white: Float,
        steady: Float,
    ) -> tuple[Float, Float, Float]:
        """Compute one Gauss-Newton step: reduced normal matrix, step of the poses, and of the points."""
        from scipy.sparse import csr_matrix

        times, points = len(self.position), self.points_count
        size = 6 * times
        weighted_pose, weighted_point = by_pose * weight[:, None, None], by_point * weight[:, None, None]
        pose = _sum_by(np.swapaxes(by_pose, 1, 2) @ weighted_pose, self.picture, times)
        pull = _sum_by((np.swapaxes(weighted_pose, 1, 2) @ residual[..., None])[..., 0], self.picture, times)
        own = _sum_by(np.swapaxes(by_point, 1, 2) @ weighted_point, self.point, points)
        own += _DAMPING * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        right = _sum_by((np.swapaxes(weighted_point, 1, 2) @ residual[..., None])[..., 0], self.point, points)
        inverse = np.linalg.inv(own)
        mixed = np.swapaxes(by_pose, 1, 2) @ weighted_point
        rows = 6 * self.picture[:, None, None] + np.arange(6)[:, None] + np.zeros((1, 1, 3), dtype=np.int64)
        columns = 3 * self.point[:, None, None] + np.zeros((1, 6, 1), dtype=np.int64) + np.arange(3)
        shape = (size, 3 * points)
        across = csr_matrix((mixed.ravel(), (rows.ravel(), columns.ravel())), shape=shape)
        eliminated = mixed @ inverse[self.point]
        cut = csr_matrix((eliminated.ravel(), (rows.ravel(), columns.ravel())), shape=shape)
        normal = np.zeros((size + 6, size + 6))
        normal[:size, :size] = -(cut @ across.T).toarray()
        force = np.zeros(size + 6)
        force[:size] = pull.ravel() - cut @ right.ravel()
        for t in range(times):
            place = slice(6 * t, 6 * t + 6)
            normal[place, place] += pose[t] + np.diag(1 / white**2)
            normal[place, size:] = normal[size:, place] = -np.diag(1 / white**2)
        normal[size:, size:] = np.diag(1 / steady**2 + times / white**2)
        apart = (errors - constant) / white**2
        force[:size] -= apart.ravel()
        force[size:] = apart.sum(axis=0) - constant / steady**2
        step = np.asarray(np.linalg.solve(normal, force), dtype=np.float64)
        back = right - np.asarray(across.T @ step[:size]).reshape(points, 3)
        return normal, step, np.einsum("nij,nj->ni", inverse, back)


def _sum_by(values: Float, number: Int64, count: int) -> Float:
    """Sum the values [K, ...] with the same number: [count, ...]."""
    flat = values.reshape(len(values), math.prod(values.shape[1:]))
    sums = np.stack([np.bincount(number, weights=column, minlength=count) for column in flat.T], axis=-1)
    return np.asarray(sums, dtype=np.float64).reshape(count, *values.shape[1:])
