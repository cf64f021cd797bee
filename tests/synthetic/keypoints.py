"""Keypoints of a simple detector on exact pixels: white noise, missed joints, gross outliers."""

from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Float

_OUTLIER_PX = (30.0, 150.0)  # distance of a gross outlier from the truth


@dataclass(frozen=True)
class KeypointNoise:
    """Errors of a keypoint detector: white noise, joints it misses and joints it puts elsewhere."""

    pixel_px: float = 3.0  # sigma of each coordinate
    missed_share: float = 0.0
    outlier_share: float = 0.0  # of the joints that are not missed


def detect(pixels: Float, noise: KeypointNoise, rng: np.random.Generator) -> tuple[Float, Float]:
    """Simulate the keypoints that a detector reports of exact pixels [..., 2], NaN where nothing can be seen.

    Returns [..., 2] px with NaN for missed joints, and [...] confidences: 0 for those, 0.7 to 1 for good
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
