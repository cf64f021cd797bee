"""Heavy-tailed loss for static, calibrated cameras, where disagreement comes from the detector.

Noisy poses move all joints of a view together and by a normal amount: least squares is right for them,
and weighting views by their own residuals costs 11 % at five cameras. With calibrated poses and no stated
noise, a view that disagrees shows a wrong joint, and the size of its residual has no meaning:
its weight should fall with its residual (docs/decisions/0002-loss-of-still-cameras.md).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipelines.geometry.triangulation import Triangulation, Views, reprojection_px, triangulate

_ROUNDS = 12  # the effect of more rounds: docs/decisions/0002-loss-of-still-cameras.md


def triangulate_heavy_tailed(views: Views, *, threads: int) -> Triangulation:
    """Triangulate with `robust`, then weigh its inliers by Cauchy's loss (iteratively reweighted).

    A view of whitened residual r gets the weight 1 / (1 + r^2) (Holland and Welsch 1977, table 1, with
    the scale `views.pixel_sigma` instead of their tuning constant). `robust` decides which views are
    inliers; the covariance is that of the weights in the last round.

    Args:
        views: the views; `pixel_sigma` from `estimate_noise`.
        threads: see `triangulate`.
    """
    first = triangulate(views, method="robust", threads=threads)
    inliers = np.where(first.inlier, views.weight, 0.0)
    result = first
    for _ in range(_ROUNDS):
        whitened = inliers * result.residual_px / views.pixel_sigma
        # Without a residual (not reconstructed, behind the camera) there is nothing to weight by.
        loss = np.where(np.isfinite(whitened), np.nan_to_num(whitened) ** 2, 0.0)
        weighted = replace(views, weight=inliers / np.sqrt(1.0 + loss))
        result = triangulate(weighted, method="robust", threads=threads)
    lost = first.points[:, :1] * result.points[:, :1]  # NaN where either has no point
    return replace(
        result,
        inlier=first.inlier & result.inlier,
        residual_px=np.where(np.isnan(lost), first.residual_px, reprojection_px(views, result.points)),
        status=np.where(np.isnan(first.points[:, 0]), first.status, result.status),
    )
