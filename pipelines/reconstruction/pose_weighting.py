"""Weights and covariances of `robust` from the full logged 6x6 pose covariances.

Triangulation uses one standard deviation for a position and one for a rotation; its gates and its choice
of views need no more. Logs contain more: satellite positioning errs more upwards, a compass more than
a level, and a lever arm correlates position and rotation. With each view's own 2x2 covariance the inliers
are weighted again: a few Gauss-Newton steps on the reprojection, from the result of `robust`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.triangulation import STATUS, Triangulation, Views, reprojection_px
from pipelines.session.records import Int64

_ROUNDS = 4  # the last moves the median joint by less than a thousandth of its standard deviation
_BLOCK = 8192  # joint-frames at once: memory


def triangulate_weighted(
    views: Views, *, solve: Callable[[Views], Triangulation], pose_covariance: Float
) -> Triangulation:
    """Triangulate with `robust`, then weigh its inliers by their poses' full covariances.

    Args:
        views: the views; `pose_sigma` holds the level of the same covariances.
        solve: `robust` with the options for these views.
        pose_covariance: [F, C, 6, 6] position in the world (m^2), then rotation vector in the camera (rad^2).
    """
    first = solve(views)
    points, covariance = first.points.copy(), first.covariance.copy()
    (ok,) = np.nonzero(first.status == STATUS.index("ok"))
    for start in range(0, len(ok), _BLOCK):
        rows = ok[start : start + _BLOCK]
        refit = _refit(views, first, pose_covariance, rows)
        good = np.isfinite(refit[0]).all(axis=1) & np.isfinite(refit[1]).all(axis=(1, 2))
        points[rows[good]], covariance[rows[good]] = refit[0][good], refit[1][good]
    measured = np.isfinite(points[:, 0])
    residual_px = np.where(measured[:, None], reprojection_px(views, points), first.residual_px)
    return replace(first, points=points, covariance=covariance, residual_px=residual_px)


def _refit(views: Views, first: Triangulation, pose_covariance: Float, rows: Int64) -> tuple[Float, Float]:
    """Refit these joint-frames: points [N, 3] and covariances [N, 3, 3]."""
    pose = views.pose_index[rows]
    rotation, centre = views.rotation[pose], views.position[pose]
    inlier = first.inlier[rows]
    weight = np.where(inlier, views.weight[rows], 1.0)
    pixel = (views.pixel_sigma / views.focal / weight) ** 2
    seen = np.where(inlier[..., None], views.xy[rows], 0.0)
    covariance = pose_covariance[pose]
    points = first.points[rows].copy()
    normal = np.empty((len(rows), 3, 3))
    for _ in range(_ROUNDS):
        away = np.einsum("ncji,ncj->nci", rotation, points[:, None] - centre)
        away[~inlier] = [0.0, 0.0, 1.0]
        u, v, z = np.moveaxis(away, -1, 0)
        u, v = u / z, v / z
        project = np.zeros((*u.shape, 2, 3))
        project[..., 0, 0] = project[..., 1, 1] = 1 / z
        project[..., 0, 2], project[..., 1, 2] = -u / z, -v / z
        by_point = np.einsum("ncij,nckj->ncik", project, rotation)
        # A camera that stands e further, and is turned by w about its axes, sees the point at
        # exp(-w) R' (X - p - e): by e as by -X, by w as by the cross product with the point.
        by_turn = project @ _cross_matrix(away)
        by_pose = np.concatenate([-by_point, by_turn], axis=-1)
        spread = by_pose @ covariance @ np.swapaxes(by_pose, -1, -2)
        spread[..., 0, 0] += pixel
        spread[..., 1, 1] += pixel
        information = np.where(inlier[..., None, None], np.linalg.inv(spread), 0.0)
        residual = seen - np.stack([u, v], axis=-1)
        weighted = np.swapaxes(by_point, -1, -2) @ information
        normal = (weighted @ by_point).sum(axis=1)
        right = np.einsum("ncij,ncj->ni", weighted, residual)
        points = points + np.linalg.solve(normal, right[..., None])[..., 0]
    return points, np.asarray(np.linalg.inv(normal), dtype=np.float64)


def _cross_matrix(vector: Float) -> Float:
    """Return the cross-product matrix [..., 3, 3] of v: (v x) u."""
    x, y, z = np.moveaxis(vector, -1, 0)
    o = np.zeros_like(x)
    rows = [[o, -z, y], [z, o, -x], [-y, x, o]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
