"""A heavy-tailed loss for still, calibrated cameras, where what disagrees is the detector.

Noisy poses move all joints of a view together and by a normal amount: least squares is right for them,
and weighting views by their own residuals costs 11 % at five cameras. Where poses were calibrated and
nobody states noise, a view that disagrees has mistaken its joint, and how far off it is says little:
its weight should fall with its residual (docs/decisions/0002-loss-of-still-cameras.md).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipelines.geometry.triangulation import Triangulation, Views, triangulate

_ROUNDS = 12  # the median joint moves by less than 0.1 mm after that, on a real recording


def triangulate_heavy_tailed(views: Views, *, threads: int) -> Triangulation:
    """`robust` triangulation under Cauchy's loss: iteratively reweighted least squares.

    A view of whitened residual r counts 1 / (1 + r^2) as much (Holland and Welsch 1977, table 1, with
    the scale that `views.pixel_sigma` states instead of their tuning constant).

    Args:
        views: what was seen; `pixel_sigma` as `estimate_noise` found it.
        threads: see `triangulate`.
    """
    result = triangulate(views, method="robust", threads=threads)
    for _ in range(_ROUNDS):
        whitened = views.weight * result.residual_px / views.pixel_sigma
        # Without a residual (not reconstructed, behind the camera) there is nothing to weight by.
        loss = np.where(np.isfinite(whitened), np.nan_to_num(whitened) ** 2, 0.0)
        weighted = replace(views, weight=views.weight / np.sqrt(1.0 + loss))
        result = triangulate(weighted, method="robust", threads=threads)
    return result
