"""Detector noise on true keypoints; noise on logged poses is in `geometry.noise`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.cameras import Intrinsics, project
from pipelines.geometry.poses import invert, transform

_OUTLIER_PX = (30.0, 150.0)  # distance of a gross outlier from the truth


@dataclass(frozen=True)
class KeypointNoise:
    """Errors of a keypoint detector: white noise, joints it misses and joints it puts elsewhere."""

    pixel_px: float = 3.0  # sigma of each coordinate
    missed_share: float = 0.0
    outlier_share: float = 0.0  # of the joints that are not missed


def see(joints: Float, position: Float, quaternion_xyzw: Float, intrinsics: Intrinsics) -> Float:
    """Compute the exact pixels of joints; nothing hides anything.

    Args:
        joints: [T, J, 3] metres, world.
        position: [T, 3] metres, world_from_camera; or [T, J, 3] of each joint (or [T, 1, 3]).
        quaternion_xyzw: [T, 4] unit, or as many as positions.
        intrinsics: the camera.

    Returns:
        [T, J, 2] px; NaN behind the camera and outside the picture, whose corner pixels have their
        centres at (0, 0) and (width - 1, height - 1).
    """
    if position.ndim == 2:
        position, quaternion_xyzw = position[:, None], quaternion_xyzw[:, None]
    camera_from_world = invert(position, quaternion_xyzw)
    pixels = project(transform(camera_from_world, joints), intrinsics)
    inside = (pixels >= -0.5) & (pixels <= np.array([intrinsics.width, intrinsics.height]) - 0.5)
    return np.where(inside.all(axis=-1, keepdims=True), pixels, np.nan)


def detect(pixels: Float, noise: KeypointNoise, rng: np.random.Generator) -> tuple[Float, Float]:
    """Simulate the keypoints that a detector reports.

    Args:
        pixels: [..., 2] exact pixels, NaN for joints that cannot be seen.
        noise: the detector's errors.
        rng: draws as many numbers for joints that are seen as for those that are not.

    Returns:
        [..., 2] px with NaN for missed joints, and [...] confidences: 0 for those, 0.7 to 1 for good
        ones, 0.3 to 0.9 for outliers, because detectors often have high confidence in wrong keypoints.
    """
    shape = pixels.shape[:-1]
    offset = noise.pixel_px * rng.standard_normal(pixels.shape)
    angle, length = rng.uniform(0.0, 2 * np.pi, shape), rng.uniform(*_OUTLIER_PX, shape)
    outlier = rng.random(shape) < noise.outlier_share
    missed = rng.random(shape) < noise.missed_share
    sureness = rng.random(shape)

    gross = length[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    found = pixels + np.where(outlier[..., None], gross, offset)
    found = np.where(missed[..., None], np.nan, found)
    confidence = np.where(outlier, 0.3 + 0.6 * sureness, 0.7 + 0.3 * sureness)
    return found, np.where(np.isnan(found).any(axis=-1), 0.0, confidence)
