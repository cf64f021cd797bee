"""Gross keypoint errors that pose noise would hide: a pose error moves all joints of a picture, they do not.

The gate of `robust` must be as wide as poses err: 0.3 m and 1 deg move a keypoint by 50 px, and one that
is 100 px off for its own sake passes as a good one. But all joints of a person in a picture share its pose,
so what they share is the pose's error and says nothing about a joint. Each picture is therefore moved by the
median of its joints' residuals, and `robust` with exact poses says which views err grossly beside that.

They are left out, all others are triangulated with the pose noise that is stated. What it gains:
docs/decisions/0007-gross-errors.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipelines.geometry.triangulation import (
    GATE,
    STATUS,
    Bool,
    Float,
    Int64,
    Triangulation,
    Views,
    estimate_noise,
    locate,
    reprojection_px,
    triangulate,
)

_GROSS = 2 * GATE
"""In standard deviations of what a picture's joints do beside each other. A camera that is turned about its
axis, or further away, moves them by different amounts, which are no gross errors."""

_FEWEST = 5
"""Joints that a picture must show: the median of fewer may follow the bad ones."""

_ROUNDS = 2  # the second has residuals of points without gross errors


def triangulate_pictures(
    views: Views, *, picture: Int64, pixel_sigma: Float, threads: int = 1
) -> Triangulation:
    """`robust` without the views that err grossly beside the other joints of their picture.

    Where nothing errs grossly this is `triangulate`, byte for byte. A clock that is off moves limbs apart,
    too, and fast ones are left out where it is off by tenths of a second.

    Args:
        views: what was seen; `views.pixel_sigma` as `estimate_noise` found it.
        picture: [N] rows of one number, not negative, are the joints of one person in one picture of every
            camera. Where a camera shows fewer than five of them its views are not judged.
        pixel_sigma: [C] px, the detector's own, where `views` also holds what poses leave unexplained.
        threads: see `triangulate`.

    Returns:
        As `triangulate`: views left out are no inliers and have their residuals; a joint-frame that lacks
        views because of them is `rejected`.
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
    """Views [N, C] that err grossly, where `points` is about what they see."""
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
    """The views, each moved by what its picture's joints share, as of exact poses; and which [N, C] could be.

    The others count as not seen.
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
