"""Solvers of joint-frames: their noise, the choice between them, and how they weigh inliers.

Covariances are wider where nothing is known of the poses' errors. For static, calibrated cameras inliers
get a heavy-tailed loss. Noisy poses move all joints of a view together and by a normal amount: least squares
is right for them, and weighting views by their own residuals costs 11 % at five cameras. With calibrated
poses and no stated noise, a view that disagrees shows a wrong joint, and the size of its residual has no
meaning: its weight should fall with its residual.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64, known_median
from pipelines.geometry.noise import ROTATION, UNKNOWN_SIGMA, PoseErrors
from pipelines.geometry.triangulation import (
    PIXEL_SIGMA_PX,
    STATUS,
    Method,
    Triangulation,
    Views,
    estimate_noise,
    reprojection_px,
    triangulate,
    triangulate_pictures,
)
from pipelines.reconstruction.observations import Camera, Candidates, Observations
from pipelines.session.errors import NoViewsError

# Weight of the middle of all cameras against a line of sight: rays some 10 degrees apart say as much.
AMID_SHARE = 0.01


def ray_sigma(cameras: Sequence[Camera], found: Candidates) -> Float:
    """Compute the standard deviation [T, C] rad of rays, to people taken to be where the cameras look."""
    t_ns, position = found.t_ns, found.position
    posed = ~np.isnan(position[..., 0])
    if not posed.any():
        raise NoViewsError("the cameras", "have no pose at any picture", "check clocks and pose logs")
    middle = _looked_at(found, position[posed].mean(axis=0))
    columns = []
    for c, camera in enumerate(cameras):
        stated = camera.sigma_at(t_ns)
        sigma = np.tile(UNKNOWN_SIGMA, (len(t_ns), 1)) if stated is None else stated
        away = position[posed[:, c], c] - middle
        distance = float(np.median(np.linalg.norm(away, axis=-1))) if len(away) else 1.0
        pixel = PIXEL_SIGMA_PX / camera.focal_px
        columns.append(np.sqrt(pixel**2 + sigma[:, 1] ** 2 + (sigma[:, 0] / max(distance, 1.0)) ** 2))
    return np.stack(columns, axis=1)


def _looked_at(found: Candidates, amid: Float) -> Float:
    """Find the point [3] m to which lines of sight come nearest, about `amid` if they are parallel."""
    seen = (found.confidence > 0)[..., None] & np.isfinite(found.rays)
    centre = known_median(np.where(seen, found.rays, np.nan), axis=3)
    ray = np.einsum("tcij,tcdj->tcdi", found.rotation, np.insert(centre, 2, 1.0, axis=-1))
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    known = np.isfinite(ray[..., 0]) & np.isfinite(found.position[..., :1])
    across = np.eye(3) - ray[known][:, :, None] * ray[known][:, None, :]
    origin = np.broadcast_to(found.position[:, :, None], ray.shape)[known]
    normal = across.sum(axis=0) + AMID_SHARE * max(known.sum(), 1) * np.eye(3)
    aside = np.einsum("nij,nj->i", across, origin - amid)
    return np.asarray(amid + np.linalg.solve(normal, aside))


def views_with_noise(cameras: Sequence[Camera], observations: Observations) -> Views:
    """Build the views; residuals that the stated noise does not explain are added as pixel noise."""
    views = views_as_stated(cameras, observations)
    return replace(views, pixel_sigma=estimate_noise(views))


def views_as_stated(cameras: Sequence[Camera], observations: Observations) -> Views:
    """Build the views with the detector's noise and the stated noise of poses alone."""
    times, people, joints, count = observations.confidence.shape
    focal = np.array([camera.focal_px for camera in cameras])
    stated = observations.pose_sigma
    return Views(
        rays=observations.rays.reshape(-1, count, 2),
        weight=observations.confidence.reshape(-1, count),
        pose_index=np.repeat(np.arange(times), people * joints),
        position=observations.position,
        rotation=observations.rotation,
        focal=focal,
        pixel_sigma=np.full(count, PIXEL_SIGMA_PX),
        pose_sigma=np.zeros((times, count, 2)) if stated is None else stated,
    )


def solver_for(
    method: Method | Literal["refined", "auto"],
    cameras: Sequence[Camera],
    observations: Observations,
) -> Callable[[Views], Triangulation]:
    """Choose the solver from views to points; for `refined` and `auto`, the solver of their start.

    For calibrated cameras, `robust` has its own loss. For poses with errors, it has a gate that knows the
    common error of a picture's joints. Its covariances are wider than
    residuals say where nothing is known of the poses' errors.
    """
    if method in ("robust", "auto") and are_calibrated(cameras, observations):
        return triangulate_heavy_tailed
    if method in ("dlt", "midpoint"):
        return partial(triangulate, method=method)
    picture, of_detector = pictures_of(observations), np.full(len(cameras), PIXEL_SIGMA_PX)
    in_pictures = partial(triangulate_pictures, picture=picture, pixel_sigma=of_detector)
    if observations.pose_sigma is None:
        return partial(triangulate_widened, solve=in_pictures)
    return in_pictures


def are_calibrated(cameras: Sequence[Camera], observations: Observations) -> bool:
    """Test if all cameras stand still and nobody stated errors of their poses."""
    return observations.pose_sigma is None and all(camera.static for camera in cameras)


def pictures_of(observations: Observations) -> Int64:
    """Number the person-pictures: index [T * P * J] of the time and person of each joint-frame."""
    times, people, joints, _ = observations.confidence.shape
    return np.repeat(np.arange(times * people), joints)


def refused_people(result: Triangulation, observations: Observations, seen: Bool) -> Triangulation:
    """Mark joints of a person without any chosen view as rejected, at times when `seen` [T] is True."""
    shape = observations.confidence.shape[:3]
    status = result.status.reshape(shape)
    nobody = (status == STATUS.index("not_detected")).all(axis=2)
    refused = nobody & seen[:, None]
    marked = np.where(refused[:, :, None], STATUS.index("rejected"), status).astype(np.int8)
    return replace(result, status=marked.ravel())


def noise_text(views: Views) -> str:
    """Describe the noise that the gates used."""
    position_m, rotation_rad = np.median(views.pose_sigma, axis=(0, 1))
    pixels = float(np.median(views.pixel_sigma))
    rotation_deg = np.degrees(rotation_rad)
    return f"noise taken for poses {position_m:.3g} m and {rotation_deg:.3g} deg, pixels {pixels:.3g}"


# --- nothing known of the poses' errors -----------------------------------------------------------------

_UNKNOWN_POSES = 1.3
"""Covariance over what residuals say of it. A constant error of a pose is a single draw, and residuals do not
show how it moves joints along their viewing rays. The mean NEES of the rendered flights for tuning becomes 3
with it (docs/estimate.md)."""


def triangulate_widened(views: Views, *, solve: Callable[[Views], Triangulation]) -> Triangulation:
    """Triangulate, and widen covariances by `_UNKNOWN_POSES`."""
    found = solve(views)
    return replace(found, covariance=_UNKNOWN_POSES * found.covariance)


# --- heavy-tailed loss ---------------------------------------------------------------------------------

# More rounds change little (docs/estimate.md).
_ROUNDS = 12


def triangulate_heavy_tailed(views: Views) -> Triangulation:
    """Triangulate with `robust`, then weigh its inliers by Cauchy's loss (iteratively reweighted).

    A view of whitened residual r gets the weight 1 / (1 + r^2) (Holland and Welsch 1977, table 1), with the
    scale of `estimate_noise` in place of their tuning constant. The covariance is that of the last weights.
    """
    first = triangulate(views, method="robust")
    inliers = np.where(first.inlier, views.weight, 0.0)
    result = first
    for _ in range(_ROUNDS):
        whitened = inliers * result.residual_px / views.pixel_sigma
        # Without a residual (not reconstructed, behind the camera) there is nothing to weight by.
        loss = np.where(np.isfinite(whitened), np.nan_to_num(whitened) ** 2, 0.0)
        weighted = replace(views, weight=inliers / np.sqrt(1.0 + loss))
        result = triangulate(weighted, method="robust")
    lost = first.points[:, :1] * result.points[:, :1]  # NaN where either has no point
    return replace(
        result,
        inlier=first.inlier & result.inlier,
        residual_px=np.where(np.isnan(lost), first.residual_px, reprojection_px(views, result.points)),
        status=np.where(np.isnan(first.points[:, 0]), first.status, result.status),
    )


# --- positions that are metres off -----------------------------------------------------------------------

# The nose is this share of the stature above the ankles (Winter 2009).
NOSE_TO_ANKLES = 0.9
# People bend, and their stature is known to 5 %: a camera shows their distance to this share.
DISTANCE_SIGMA_SHARE = 0.15
# A logged person is where its receiver says, to this.
LOGGED_PERSON_SIGMA_M = 2.0
# Smaller errors let rays meet well enough to start from.
MIN_SIGMA_M = 1.0
# Nearer to each other, rays meet and tell more than sizes do.
MIN_SIGMAS_APART = 2.0
# Fewer moments are no mean.
MIN_MOMENTS = 5


def position_sigma_m(errors: PoseErrors | None) -> float:
    """Return the standard deviation per axis of a log's lasting position errors; 0 where nobody states it."""
    lasting = [each.sigma0 for each in (errors.processes if errors else ()) if each.number != ROTATION]
    return float(np.linalg.norm(lasting))


def away_by_size(ankles: Float, nose: Float, stature_m: float) -> Float:
    """Return how far a person's middle is from the camera [..., 3] m, by upright rays [..., 3]; NaN: behind.

    Ankles and nose are one above the other: distances along both rays by least squares.
    """
    lines = np.stack([-ankles, nose], axis=-1)
    far = np.linalg.pinv(np.nan_to_num(lines)) @ np.array([0.0, 0.0, NOSE_TO_ANKLES * stature_m])
    middle = (far[..., :1] * ankles + far[..., 1:] * nose) / 2
    return np.where((far > 0).all(axis=-1, keepdims=True), middle, np.nan)


def placed_by_size(
    joints: Sequence[str], found: Candidates, stated_m: Sequence[float], hips: Float | None, stature_m: float
) -> Float:
    """Estimate lasting position errors so large that rays of different cameras do not meet at all: [C, 3] m.

    Each camera by itself sees the person as far away as the person is tall in its pictures. The places that
    cameras see, and `hips` [T, 3] of a log, are brought together, each by as much as its stated error [C] m
    allows.
    """
    nothing = np.zeros((len(stated_m), 3))
    if not {"nose", "left_ankle", "right_ankle"} <= {*joints}:
        return nothing
    surest = found.confidence.sum(axis=3).argmax(axis=2)[:, :, None, None, None]
    rays = np.take_along_axis(found.rays, surest, axis=2)[:, :, 0]
    left, right, nose = (rays[:, :, joints.index(name)] for name in ("left_ankle", "right_ankle", "nose"))
    ends = np.insert(np.stack([(left + right) / 2, nose], axis=2), 2, 1.0, axis=-1)
    ends = np.einsum("tcij,tckj->tcki", found.rotation, ends)
    away = away_by_size(ends[:, :, 0], ends[:, :, 1], stature_m)
    places = found.position + away
    if hips is not None:
        places = np.concatenate([places, hips[:, None]], axis=1)
    rows = np.isfinite(places).all(axis=(1, 2))
    if rows.sum() < MIN_MOMENTS:
        return nothing
    sigma_m = DISTANCE_SIGMA_SHARE * np.median(np.linalg.norm(away[rows], axis=2), axis=0)
    constant_m = np.array(stated_m)
    if hips is not None:
        sigma_m, constant_m = np.append(sigma_m, LOGGED_PERSON_SIGMA_M), np.append(constant_m, 0.0)
    apart = np.median(places[rows] - places[rows].mean(axis=1, keepdims=True), axis=0)
    variance = np.square(constant_m) + np.square(sigma_m)
    apart -= (apart / variance[:, None]).sum(axis=0) / (1 / variance).sum()
    if (np.linalg.norm(apart, axis=1) < MIN_SIGMAS_APART * sigma_m).all():
        return nothing
    return np.asarray(-(np.square(constant_m) / variance)[:, None] * apart)[: len(stated_m)]
