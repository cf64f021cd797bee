"""Compiled kernels of `picture_gate`: the common motion of a picture's joints."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.compilation import cached, helper

Int64 = NDArray[np.int64]


@helper
def _median(values: Float, count: int) -> float:
    """Compute the median of the first `count` values, which are sorted in place."""
    for i in range(1, count):
        value = values[i]
        k = i
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value
    half = count // 2
    if count % 2 == 1:
        middle: float = values[half]
        return middle
    mean: float = 0.5 * (values[half - 1] + values[half])
    return mean


@helper
def _seen(xy: Float, weight: Float, n: int, c: int) -> bool:
    return weight[n, c] > 0.0 and math.isfinite(weight[n, c] + xy[n, c, 0] + xy[n, c, 1])


@cached
def move_pictures(
    order: Int64,
    starts: Int64,
    fewest: int,
    points: Float,
    xy: Float,
    weight: Float,
    pose_index: Int64,
    position: Float,
    rotation: Float,
    moved: Float,
    judged: Bool,
) -> None:
    """Move the views of each picture by the median residual of its joints, and mark those that were.

    Rows order[starts[p]] ... of `points` are those of picture p in every camera. A view without a point in
    front of its camera has no residual and is moved with the others. Pictures with fewer than `fewest`
    residuals stay as they are.

    `order` [N], `starts` [P + 1]; `points` [N, 3] m in the world, NaN where there is none; `xy` [N, C, 2]
    normalised, NaN or of weight 0 where unseen; `weight` [N, C]; `pose_index` [N] into `position` [F, C, 3] m
    and `rotation` [F, C, 3, 3] world_from_camera, NaN without a pose. Written: `moved` [N, C, 2], which
    starts as a copy of `xy`, and `judged` [N, C], which starts as False.
    """
    most = 0
    for p in range(len(starts) - 1):
        most = max(most, starts[p + 1] - starts[p])
    u = np.empty(most)
    v = np.empty(most)
    for p in range(len(starts) - 1):
        for c in range(weight.shape[1]):
            count = 0
            for k in range(starts[p], starts[p + 1]):
                n = order[k]
                if not _seen(xy, weight, n, c):
                    continue
                at = pose_index[n]
                dx = points[n, 0] - position[at, c, 0]
                dy = points[n, 1] - position[at, c, 1]
                dz = points[n, 2] - position[at, c, 2]
                depth = rotation[at, c, 0, 2] * dx + rotation[at, c, 1, 2] * dy + rotation[at, c, 2, 2] * dz
                if not depth > 0.0:
                    continue
                right = rotation[at, c, 0, 0] * dx + rotation[at, c, 1, 0] * dy + rotation[at, c, 2, 0] * dz
                down = rotation[at, c, 0, 1] * dx + rotation[at, c, 1, 1] * dy + rotation[at, c, 2, 1] * dz
                u[count] = right / depth - xy[n, c, 0]
                v[count] = down / depth - xy[n, c, 1]
                count += 1
            if count < fewest:
                continue
            shift_u = _median(u, count)
            shift_v = _median(v, count)
            for k in range(starts[p], starts[p + 1]):
                n = order[k]
                if _seen(xy, weight, n, c):
                    moved[n, c, 0] = xy[n, c, 0] + shift_u
                    moved[n, c, 1] = xy[n, c, 1] + shift_v
                    judged[n, c] = True
