"""Gross keypoint errors that pose noise would hide: a pose error moves all joints of a picture, they do not.

The gate of `robust` must be as wide as poses err: 0.3 m and 1 deg move a keypoint by 50 px, and one that
is 100 px off for its own sake passes as a good one. But all joints of a picture share its pose, so what
they share is the pose's error and says nothing about a joint. Each picture is therefore moved by the
median of its joints' residuals, and `robust` with exact poses says which views err grossly beside that.
(A similarity instead of a shift was worse: least squares follows the gross errors.)

They are left out, all others are triangulated with the pose noise that is stated. Five cameras, 5 % of the
keypoints 100 to 300 px off and 5 % missing: with 0.3 m / 1 deg these cost 22 % without this gate and 8 %
with it, as much as leaving out exactly the bad views (docs/benchmarks.md).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pipelines.geometry.triangulation import (
    GATE,
    STATUS,
    Float,
    Triangulation,
    Views,
    estimate_noise,
    locate,
    reprojection_px,
    triangulate,
)

_GROSS = 2 * GATE
"""In standard deviations of what a picture's joints do beside each other. A camera that is turned about its
axis, or further away, moves them by different amounts: at 1.5 times the gate 1 in 1000 good views was left
out where 0.5 m / 2 deg err anew in every picture, here less than 1 in 3000."""

_FEWEST = 5
"""Joints that a picture must show: the median of fewer may follow the bad ones."""

_ROUNDS = 2  # the second has residuals of points without gross errors; a third changes nothing


def triangulate_pictures(views: Views, *, pixel_sigma: Float, threads: int = 1) -> Triangulation:
    """`robust` without the views that err grossly beside the other joints of their picture.

    Rows of one `pose_index` are the joints of one picture of every camera. Pictures of fewer than five
    joints are left as they are. Where nothing errs grossly this is `triangulate`, byte for byte.

    Args:
        views: what was seen; `views.pixel_sigma` as `estimate_noise` found it.
        pixel_sigma: [C] px, the detector's own, where `views` also holds what poses leave unexplained.
        threads: see `triangulate`.

    Returns:
        As `triangulate`: views left out are no inliers and have their residuals; a joint-frame that lacks
        views because of them is `rejected`.
    """
    first = triangulate(views, method="robust", threads=threads)
    gross = _gross(views, first.points, pixel_sigma, threads)
    if not gross.any():
        return first
    found = triangulate(_without(gross, views), method="robust", threads=threads)
    left_out = gross & (views.weight > 0)
    lost = np.isnan(found.points[:, 0]) & left_out.any(axis=1)
    return replace(
        found,
        residual_px=np.where(left_out, reprojection_px(views, found.points), found.residual_px),
        status=np.where(lost, STATUS.index("rejected"), found.status).astype(np.int8),
    )


def _gross(views: Views, points: Float, pixel_sigma: Float, threads: int) -> NDArray[np.bool_]:
    """Views [N, C] that err grossly, where `points` is about what they see."""
    gross = np.zeros(views.weight.shape, dtype=np.bool_)
    for _ in range(_ROUNDS):
        moved, told = _moved(views, points)
        moved = replace(moved, pixel_sigma=pixel_sigma)
        moved = replace(moved, pixel_sigma=estimate_noise(moved, threads=threads))
        agreed = locate(moved, method="robust", gate=_GROSS, threads=threads)
        judged = np.isin(agreed.status, (STATUS.index("ok"), STATUS.index("rejected")))
        before, gross = gross, judged[:, None] & told & ~agreed.inlier
        if np.array_equal(before, gross):
            break
        points = locate(_without(gross, views), method="robust", threads=threads).points
    return gross


def _moved(views: Views, points: Float) -> tuple[Views, NDArray[np.bool_]]:
    """The views, each moved by what its picture's joints share, as of exact poses; and which could be."""
    residual = _residual(views, points)
    columns = pd.DataFrame(residual.reshape(len(residual), 2 * residual.shape[1])).groupby(views.pose_index)
    enough = columns.transform("count").to_numpy().reshape(residual.shape)[..., 0] >= _FEWEST
    shared = columns.transform("median").to_numpy().reshape(residual.shape)
    told = enough & (views.weight > 0)
    moved = replace(
        views,
        xy=views.xy + np.where(told[..., None], shared, 0.0),
        weight=np.where(told, views.weight, 0.0),
        pose_sigma=np.zeros_like(views.pose_sigma),
    )
    return moved, told


def _residual(views: Views, points: Float) -> Float:
    """Where the points should be seen less where they were [N, C, 2]; NaN where they were not, or behind."""
    rotation, position = views.rotation[views.pose_index], views.position[views.pose_index]
    x, y, z = np.einsum("ncij,nci->jnc", rotation, points[:, None] - position)
    seen = (views.weight > 0) & (z > 0)
    depth = np.where(seen, z, np.nan)
    residual: Float = np.stack([x / depth, y / depth], axis=-1) - views.xy
    return residual


def _without(gross: NDArray[np.bool_], views: Views) -> Views:
    return replace(views, weight=np.where(gross, 0.0, views.weight))
