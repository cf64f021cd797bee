"""Covariances of points as ellipsoids, for viewers."""

from __future__ import annotations

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import quaternion_from_matrix

CHI2_95 = 7.815
"""95 % of a Gaussian in three dimensions lie within {x : x' S^-1 x = 7.815} (chi-square)."""


def ellipsoids_95(covariance: Float) -> tuple[Float, Float]:
    """Compute half axes [..., 3] in m and world_from_axes quaternions [..., 4] of 95 % ellipsoids.

    Args:
        covariance: [..., 6] m^2, upper triangle: xx, xy, xz, yy, yz, zz; NaN gives NaN.
    """
    full = covariance[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*covariance.shape[:-1], 3, 3)
    known = np.isfinite(full).all(axis=(-2, -1))
    half = np.full((*known.shape, 3), np.nan)
    turn = np.full((*known.shape, 4), np.nan)
    values, vectors = np.linalg.eigh(full[known])
    vectors[..., 0] *= np.sign(np.linalg.det(vectors))[..., None]  # a rotation, not a reflection
    half[known] = np.sqrt(CHI2_95 * np.maximum(values, 0.0))
    turn[known] = quaternion_from_matrix(vectors)
    return half, turn
