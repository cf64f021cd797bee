"""Inputs of the solvers of joint-frames: rays, noise, and the choice of the solver."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.picture_gate import triangulate_pictures
from pipelines.geometry.triangulation import (
    STATUS,
    Method,
    Triangulation,
    Views,
    estimate_noise,
    triangulate,
)
from pipelines.reconstruction.observations import Camera, Observations
from pipelines.reconstruction.pose_weighting import triangulate_weighted
from pipelines.reconstruction.reweighting import triangulate_heavy_tailed
from pipelines.session.errors import DataError
from pipelines.session.records import Int64

UNKNOWN_SIGMA = (0.3, np.radians(1.0))
"""Camera pose noise (m, rad) for associating people if none is stated: the studies' medium level."""


def ray_sigma(cameras: Sequence[Camera], t_ns: Int64, position: Float, *, pixel_sigma: float) -> Float:
    """Compute the standard deviation [T, C] rad of a viewing ray, accurate enough to associate people.

    The distance to the actor is not known yet. The distance to the middle of the cameras replaces it,
    because they surround the actor.

    Args:
        cameras: C of them.
        t_ns: [T].
        position: [T, C, 3] m of the cameras, NaN without a pose.
        pixel_sigma: standard deviation of a good keypoint (px).

    Raises:
        DataError: no camera has a pose at any time.
    """
    posed = ~np.isnan(position[..., 0])
    if not posed.any():
        raise DataError("the cameras", "have no pose at any picture", "check clocks and pose logs")
    middle = position[posed].mean(axis=0)
    columns = []
    for c, camera in enumerate(cameras):
        stated = camera.sigma_at(t_ns)
        sigma = np.tile(UNKNOWN_SIGMA, (len(t_ns), 1)) if stated is None else stated
        away = position[posed[:, c], c] - middle
        distance = float(np.median(np.linalg.norm(away, axis=-1))) if len(away) else 1.0
        pixel = pixel_sigma / camera.focal_px
        columns.append(np.sqrt(pixel**2 + sigma[:, 1] ** 2 + (sigma[:, 0] / max(distance, 1.0)) ** 2))
    return np.stack(columns, axis=1)


def views_with_noise(
    cameras: Sequence[Camera], observations: Observations, *, pixel_sigma: float, threads: int
) -> Views:
    """Build the views, one row for each joint-frame, with the noise that the gates need.

    Residuals that the stated noise does not explain are added as pixel noise: with too little noise the
    gates would reject good views.
    """
    times, people, joints, count = observations.confidence.shape
    focal = np.array([camera.focal_px for camera in cameras])
    stated = observations.pose_sigma
    views = Views(
        xy=observations.xy.reshape(-1, count, 2),
        weight=observations.confidence.reshape(-1, count),
        pose_index=np.repeat(np.arange(times), people * joints),
        position=observations.position,
        rotation=observations.rotation,
        focal=focal,
        pixel_sigma=np.full(count, pixel_sigma),
        pose_sigma=np.zeros((times, count, 2)) if stated is None else stated,
    )
    return replace(views, pixel_sigma=estimate_noise(views, threads=threads))


def solver_for(
    method: Method | Literal["refined"],
    cameras: Sequence[Camera],
    observations: Observations,
    *,
    pixel_sigma: float,
    threads: int,
) -> Callable[[Views], Triangulation]:
    """Choose the solver from views to points; for `refined`, the solver of its start.

    For calibrated cameras, `robust` has its own loss. For poses with errors, it has a gate that knows the
    common error of a picture's joints, and weights from logged covariances.
    """
    calibrated = observations.pose_sigma is None and all(camera.static for camera in cameras)
    if method == "robust" and calibrated:
        return partial(triangulate_heavy_tailed, threads=threads)
    if method in ("dlt", "midpoint"):
        return partial(triangulate, method=method, threads=threads)
    in_pictures = partial(
        triangulate_pictures,
        picture=pictures_of(observations),
        pixel_sigma=np.full(len(cameras), pixel_sigma),
        threads=threads,
    )
    if observations.pose_covariance is None:
        return in_pictures
    return partial(triangulate_weighted, solve=in_pictures, pose_covariance=observations.pose_covariance)


def pictures_of(observations: Observations) -> Int64:
    """Number the person-pictures: index [T * P * J] of the time and person of each joint-frame."""
    times, people, joints, _ = observations.confidence.shape
    return np.repeat(np.arange(times * people), joints)


def refused_people(
    result: Triangulation, observations: Observations, seen: NDArray[np.bool_]
) -> Triangulation:
    """Mark joints of a person without any chosen view as rejected, at times when `seen` [T] is True."""
    shape = observations.confidence.shape[:3]
    status = result.status.reshape(shape)
    nobody = (status == STATUS.index("not_detected")).all(axis=2)
    refused = nobody & seen[:, None]
    marked = np.where(refused[:, :, None], STATUS.index("rejected"), status).astype(np.int8)
    return replace(result, status=marked.ravel())


def said_noise(views: Views) -> str:
    """Describe the noise that the gates used."""
    position_m, rotation_rad = np.median(views.pose_sigma, axis=(0, 1))
    pixels = float(np.median(views.pixel_sigma))
    rotation_deg = np.degrees(rotation_rad)
    return f"noise taken for poses {position_m:.3g} m and {rotation_deg:.3g} deg, pixels {pixels:.3g}"
