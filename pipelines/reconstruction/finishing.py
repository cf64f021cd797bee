"""Optional steps after triangulation: filling of short gaps, then smoothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pipelines.geometry.triangulation import STATUS, Triangulation, Views, reprojection_px
from pipelines.reconstruction.filling import fill_gaps
from pipelines.reconstruction.observations import Observations
from pipelines.reconstruction.smoothing import Smoother


def finish(
    observations: Observations,
    views: Views,
    result: Triangulation,
    *,
    fill_s: float | None,
    smoother: Smoother | None,
) -> tuple[Triangulation, dict[str, Any]]:
    """Fill gaps of at most `fill_s`, smooth, and report both.

    Args:
        observations: the triangulated observations.
        views: the same, one row for each joint-frame.
        result: their triangulation.
        fill_s: the longest gap to fill, None to fill none.
        smoother: the smoother, None for no smoothing.

    Returns:
        The result, and JSON-able `filled` and `smoothing`, None for a step not requested. Residuals are
        those of the new positions. Filled joints have no residuals and no views.
    """
    told: dict[str, Any] = {"filled": None, "smoothing": None}
    shape = observations.confidence.shape[:3]
    position = result.points.reshape(*shape, 3)
    covariance = result.covariance.reshape(*shape, 3, 3)
    status = result.status.reshape(shape)
    if fill_s is not None:
        filled = fill_gaps(observations.t_ns, position, covariance, status, max_gap_s=fill_s)
        position, covariance, status = filled.position, filled.covariance, filled.status
        told["filled"] = {"longest_gap_s": fill_s, **filled.counts}
    residual_px = result.residual_px
    if smoother is not None:
        smooth = smoother.apply(observations.t_ns, position, covariance)
        position, covariance = smooth.position, smooth.covariance
        told["smoothing"] = smooth.told
        measured = result.status == STATUS.index("ok")
        again = reprojection_px(views, position.reshape(-1, 3))
        residual_px = np.where(measured[:, None], again, result.residual_px)
    return replace(
        result,
        points=position.reshape(-1, 3),
        covariance=covariance.reshape(-1, 3, 3),
        status=status.ravel(),
        residual_px=residual_px,
    ), told
