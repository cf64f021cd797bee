"""Detection of gross keypoint errors that pose noise would hide.

The gate of `robust` must be as wide as the pose errors: 0.3 m and 1 deg move a keypoint by 50 px, so a
keypoint that is itself wrong by 100 px passes the gate. But a pose error moves all joints of a person in a
picture together, and a gross error of one joint does not. Each picture is therefore moved by the median of
its joints' residuals, which removes the pose error. Then `robust` with exact poses finds the views with gross
errors.

These are left out; all others are triangulated with the stated pose noise. The benefit is measured in
docs/decisions/0007-gross-errors.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.triangulation import (
    GATE,
    STATUS,
    Int64,
    Triangulation,
    Views,
    estimate_noise,
    locate,
    reprojection_px,
    triangulate,
)

_GROSS = 2 * GATE
"""Gate for gross errors, in standard deviations of the joints' residuals after their picture is moved. A
rotation of the camera about its axis, or an error of its distance, moves joints by different amounts; these
are not gross errors."""

_FEWEST = 5
"""Joints that a picture must have: the median of fewer may follow the bad ones."""

_ROUNDS = 2  # the second has residuals of points without gross errors


def triangulate_pictures(
    views: Views, *, picture: Int64, pixel_sigma: Float, threads: int = 1
) -> Triangulation:
    """Triangulate with `robust`, without views that have gross errors relative to the rest of their picture.

    Without gross errors, the result is that of `triangulate`, byte for byte. A wrong clock offset moves
    joints of a picture apart as well: with some tenths of a second, fast limbs are left out.

    Args:
        views: the observations; `views.pixel_sigma` as `estimate_noise` found it.
        picture: [N] rows with the same number (not negative) are the joints of one person in one picture of
            every camera. If a camera shows fewer than five of them, its views are not judged.
        pixel_sigma: [C] px, that of the detector alone; `views.pixel_sigma` includes unexplained pose errors.
        threads: see `triangulate`.

    Returns:
        As `triangulate`. Views that are left out are not inliers but have their residuals. A joint-frame with
        too few views because of them is `rejected`.
    """
    first = triangulate(views, method="robust", threads=threads)
    gross = _gross(views, picture, first.points, pixel_sigma, threads)
    if not gross.any():
        return first
    found = triangulate(_without(gross, views), method="robust", threads=threads)
    (rows,) = np.nonzero(gross.any(axis=1))
    lost = rows[np.isnan(found.points[rows, 0])]
    status, residual_px = found.status.copy(), found.residual_px.copy()
    status[lost] = STATUS.index("rejected")
    own = replace(views, xy=views.xy[rows], weight=views.weight[rows], pose_index=views.pose_index[rows])
    residual_px[rows] = np.where(gross[rows], reprojection_px(own, found.points[rows]), residual_px[rows])
    return replace(found, status=status, residual_px=residual_px)


def _gross(views: Views, picture: Int64, points: Float, pixel_sigma: Float, threads: int) -> Bool:
    """Find views [N, C] with gross errors; `points` are approximate positions of the joint-frames."""
    gross = np.zeros(views.weight.shape, dtype=np.bool_)
    for _ in range(_ROUNDS):
        moved, judged = _moved(replace(views, pixel_sigma=pixel_sigma), picture, points)
        moved = replace(moved, pixel_sigma=estimate_noise(moved, threads=threads))
        agreed = locate(moved, method="robust", gate=_GROSS, threads=threads)
        told = np.isin(agreed.status, (STATUS.index("ok"), STATUS.index("rejected")))
        before, gross = gross, told[:, None] & judged & ~agreed.inlier
        if np.array_equal(before, gross):
            break
        points = locate(_without(gross, views), method="robust", threads=threads).points
    return gross


def _moved(views: Views, picture: Int64, points: Float) -> tuple[Views, Bool]:
    """Move each view by the median residual of its picture; return also which views [N, C] could be moved.

    The moved views have exact poses. The others count as not seen.
    """
    from pipelines.geometry.picture_kernels import move_pictures

    order = np.argsort(picture, kind="stable")
    starts = np.flatnonzero(np.diff(picture[order], prepend=-1, append=-1))
    xy, judged = np.array(views.xy, np.float64, order="C"), np.zeros(views.weight.shape, dtype=np.bool_)
    move_pictures(
        order,
        starts,
        _FEWEST,
        np.ascontiguousarray(points),
        np.ascontiguousarray(views.xy, np.float64),
        np.ascontiguousarray(views.weight, np.float64),
        np.ascontiguousarray(views.pose_index, np.int64),
        np.ascontiguousarray(views.position, np.float64),
        np.ascontiguousarray(views.rotation, np.float64),
        xy,
        judged,
    )
    weight = np.where(judged, views.weight, 0.0)
    return replace(views, xy=xy, weight=weight, pose_sigma=np.zeros_like(views.pose_sigma)), judged


def _without(gross: Bool, views: Views) -> Views:
    return replace(views, weight=np.where(gross, 0.0, views.weight))
