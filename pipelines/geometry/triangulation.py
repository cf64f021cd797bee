"""Triangulation of image points to 3D points, over all frames, people and joints in one call.

A view of confidence w has the standard deviation pixel_sigma / w.

- `dlt`: homogeneous linear triangulation of viewing directions by pycolmap, without confidences: a baseline.
  The world is moved to the mean centre of the cameras, and its unit is their RMS distance from it.
- `midpoint`: the point closest to the viewing lines, sum w^2 (I - d d')(X - c) = 0.
- `robust`: least squares of the reprojection errors, whitened by pixel and pose noise together. If every
  view is within `gate` standard deviations, this is the result. Otherwise every pair of views (above 8
  cameras a fixed set of 28) proposes a point. The point with the lowest truncated cost over all views wins
  (MSAC: Torr & Zisserman 2000). It is refined by Gauss-Newton on its inliers until they stay the same. If
  only two of three or more views agree and another pair agrees on a different place, it is `rejected`.

A gate in pixels would reject good views as soon as poses are noisy: 1 deg is 26 px at f = 1500. State the
pose noise in `Views.pose_sigma`, and let `estimate_noise` raise the pixel noise to what the views need.

Such a gate lets gross errors of single joints pass. But a pose error moves all joints of a person in a
picture together. `triangulate_pictures` therefore moves each picture by the median of its joints' residuals,
finds the views with gross errors by `robust` with exact poses, and triangulates all others with the stated
pose noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations, islice, pairwise
from itertools import count as count_up
from math import comb, cos, gcd, radians
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float, Int8, Int64

Method = Literal["dlt", "midpoint", "robust"]

MIN_PARALLAX_DEG = 2.0
"""The least parallax. Below it, depth is about thirty times as uncertain as the other directions."""

PIXEL_SIGMA_PX = 3.0
"""Standard deviation per axis of a good keypoint: detectors place joints in sharp pictures to that."""

GATE = 4.0
"""The gate in standard deviations of a view's image point: one good view in 3000 falls outside."""

STATUS = ("ok", "filled", "few_views", "low_parallax", "rejected", "not_detected", "no_pose")
"""Meanings of `Triangulation.status`; the words of a session's skeleton."""

# These are all pairs of 8 views. Of more views, even if half are bad, 28 nearly always hold a clean pair.
_MAX_PAIRS = 28
# The intermediate arrays of this many joint-frames stay in a processor's cache.
_BLOCK = 4096
# Arrays that hold a pose for each of so many joint-frames, some minutes of a flight, take 200 MB.
ROWS_AT_ONCE = 1 << 18
# A median over this many joint-frames is accurate to one per cent.
_NOISE_SAMPLE = 20_000
# The inliers of the first round set the gate of the second.
_NOISE_ROUNDS = 2
# A constant pose error gives few different pairs: undoubled, 2 % of draws of three cameras lost all joints.
_START_WIDTH = 2.0


@dataclass(frozen=True)
class Views:
    """Observations of N joint-frames by C cameras, and the cameras' poses at F instants.

    A view is absent where `rays` or the pose is NaN or `weight` is 0. Rays are undistorted image points (x/z,
    y/z). Triangulation is fastest if joints of one instant, which share its row of poses, are neighbours in
    N.
    """

    rays: Float  # [N, C, 2]
    weight: Float  # [N, C] confidence
    pose_index: Int64  # [N] row of the three arrays below
    position: Float  # [F, C, 3] m, camera centre in the world
    rotation: Float  # [F, C, 3, 3] world_from_camera
    focal: Float  # [C] px, mean of fx and fy
    pixel_sigma: Float  # [C] px, per axis, of a view of confidence 1
    pose_sigma: Float  # [F, C, 2] per axis: centre in m, rotation in rad; 0 where exact

    def of(self, cameras: Bool) -> Views:
        """Take the views of some of the cameras [C]."""
        return replace(
            self,
            rays=self.rays[:, cameras],
            weight=self.weight[:, cameras],
            position=self.position[:, cameras],
            rotation=self.rotation[:, cameras],
            focal=self.focal[cameras],
            pixel_sigma=self.pixel_sigma[cameras],
            pose_sigma=self.pose_sigma[:, cameras],
        )


@dataclass(frozen=True)
class Triangulation:
    """Points with their uncertainty and residuals, NaN (and no inliers) wherever `status` is not "ok".

    `covariance` is of first order: pixel and pose noise of the inlier views, independent between cameras. It
    includes the part of a pose error that all joints share.
    """

    points: Float  # [N, 3] m, world
    inlier: Bool  # [N, C]
    status: Int8  # [N] index into STATUS
    covariance: Float  # [N, 3, 3] m^2
    views: Int64  # [N] inlier views
    residual_px: Float  # [N, C] reprojection distance of every view, also rejected ones; inf behind a camera


def triangulate(
    views: Views, *, method: Method, gate: float = GATE, with_covariance: bool = True
) -> Triangulation:
    """Triangulate every joint-frame by a method of the module.

    `gate` counts standard deviations of a view's image point, pixel and pose noise together. Covariances and
    reprojections are NaN without `with_covariance`, which saves time. Statuses besides "ok": `not_detected`
    by any camera; `few_views`: detected by only one; `no_pose`: fewer of the detections have one;
    `low_parallax`: no two lines differ by `MIN_PARALLAX_DEG`; `rejected`: fewer views agree within `gate`
    (`robust`), or the point is behind a camera (`dlt`, `midpoint`, which reject no view).
    """
    poses, count = _poses_of(views), len(views.weight)
    return _joined(
        (
            _triangulate_block(
                rows_of(views, slice(first, first + _BLOCK)), poses, method, gate, with_covariance
            )
            for first in range(0, max(count, 1), _BLOCK)
        ),
        count,
    )


def _joined(parts: Iterable[Sequence[NDArray[Any]]], count: int) -> Triangulation:
    """Join the fields of parts of `count` points as they come, so that they are not in memory twice."""
    whole: list[NDArray[Any]] = []
    begin = 0
    for part in parts:
        whole = whole or [np.empty((count, *each.shape[1:]), each.dtype) for each in part]
        for all_rows, each in zip(whole, part, strict=True):
            all_rows[begin : begin + len(each)] = each
        begin += len(part[0])
    return Triangulation(*whole)


class _Poses(NamedTuple):
    """Poses of all instants in a world moved to the mean centre of the cameras of each; 0 where unknown."""

    known: Bool  # [F, C]
    middle: Float  # [F, 3] m
    rows: Float  # [F, C, 12]: rotation by rows, centre
    sigma: Float  # [F, C, 2], m and rad


def _poses_of(views: Views) -> _Poses:
    finite = np.isfinite(views.position).all(axis=-1) & np.isfinite(views.rotation).all(axis=(-1, -2))
    known: Bool = np.asarray(finite, np.bool_)
    count = np.maximum(known.sum(axis=1), 1)[:, None]
    middle = np.where(known[..., None], views.position, 0.0).sum(axis=1) / count
    rotation = views.rotation.reshape(*known.shape, 9)
    rows = np.concatenate([rotation, views.position - middle[:, None]], axis=-1)
    rows = np.where(known[..., None], rows, 0.0)
    return _Poses(known, middle, _plain(rows), _plain(views.pose_sigma))


def _plain(values: Float) -> Float:
    """Store an array in the one order and type for which the kernels are compiled."""
    return np.ascontiguousarray(values, np.float64)


def _triangulate_block(
    views: Views, poses: _Poses, method: Method, gate: float, with_covariance: bool
) -> tuple[Float, Bool, Int8, Float, Int64, Float]:
    """Triangulate some joint-frames; return the fields of `Triangulation`."""
    from pipelines.geometry.triangulation_kernels import fit_robustly, prepare

    shape, at = views.weight.shape, views.pose_index
    cos2_min = cos(radians(MIN_PARALLAX_DEG)) ** 2
    view, inlier = np.zeros((*shape, 12)), np.zeros(shape, np.bool_)
    point, status = np.zeros((len(at), 3)), np.zeros(len(at), np.int8)
    rays, weight = _plain(views.rays), _plain(views.weight)
    pixel, sigma = _plain((views.pixel_sigma / views.focal) ** 2), poses.sigma
    given = (rays, weight, pixel, sigma, at, poses.known, poses.rows)
    prepare(*given, cos2_min, view, inlier, point, status)
    if method == "robust":
        pairs = _pair_table(shape[1])
        fit_robustly(view, poses.rows, at, *pairs, gate**2, cos2_min, point, inlier, status)
    if method != "robust" or with_covariance:
        rows = poses.rows[at]
        rotation, centre = rows[..., :9].reshape(*shape, 3, 3), rows[..., 9:]
        if method == "dlt":
            point = _linear_points(rotation, centre, view[..., :2], inlier & (status == 0)[:, None])
        place = (rotation.mT @ (point[:, None] - centre)[..., None])[..., 0]
    if method != "robust":
        behind = (inlier & ~(place[..., 2] > 0)).any(axis=1)
        status[(status == 0) & behind] = STATUS.index("rejected")
    ok = status == 0
    inlier &= ok[:, None]
    covariance = np.full((len(ok), 3, 3), np.nan)
    if with_covariance:
        covariance[ok] = _covariance(method, place, rotation, views.weight, view[..., 5:], inlier)[ok]
    points = np.where(ok[:, None], point + poses.middle[at], np.nan)
    off_px = reprojection_px(views, points) if with_covariance else np.full(shape, np.nan)
    return points, inlier, status, covariance, inlier.sum(axis=1), off_px


def _linear_points(rotation: Float, centre: Float, rays: Float, seen: Bool) -> Float:
    """Triangulate each joint-frame [N, 3] by pycolmap from the seen views; NaN where it finds no point."""
    from pycolmap import triangulate_multi_view_point

    spread = (np.where(seen[..., None], centre, 0.0) ** 2).sum(axis=(1, 2)) / np.maximum(seen.sum(axis=1), 1)
    unit = np.where(spread > 0, np.sqrt(spread), 1.0)  # [N] m
    shift = -rotation.mT @ (centre / unit[:, None, None])[..., None]
    projection = np.concatenate([rotation.mT, shift], axis=-1)
    along = np.concatenate([rays, np.ones((*seen.shape, 1))], axis=-1)
    direction = along / np.linalg.norm(along, axis=-1, keepdims=True)
    points = np.full((len(seen), 3), np.nan)
    for n in np.flatnonzero(seen.any(axis=1)):
        found = triangulate_multi_view_point(list(projection[n, seen[n]]), direction[n, seen[n]])
        if found is not None:
            points[n] = found.ravel()
    return points * unit[:, None]


def _closed(normal: Float) -> Float:
    """Add a little information to normal matrices [N, 3, 3] of less than full rank."""
    from pipelines.geometry.triangulation_kernels import LEAST_DETERMINANT, LEAST_INFORMATION

    trace = np.maximum(np.trace(normal, axis1=1, axis2=2), np.finfo(float).tiny ** 0.5)
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(normal / trace[:, None, None], 0, -1)
    is_open = a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) <= LEAST_DETERMINANT
    more = np.where(is_open, LEAST_INFORMATION * trace, 0.0)[:, None, None] * np.eye(3)
    return np.asarray(normal + more)


def _covariance(
    method: Method,
    place: Float,
    rotation: Float,
    weight: Float,
    view: Float,
    inlier: Bool,
) -> Float:
    """Compute the covariances [N, 3, 3] of points that are at `place` [N, C, 3] in the cameras' frames.

    The last numbers of `view` [N, C, 7] are the kernels' squared length and covariances of the image point.

    Every method solves sum J'V(r + J dX) = 0 with its own weight V of a view's image residual r. With H = sum
    J'VJ, the noise S of the views gives H^-1 (sum J'VSVJ) H^-1. For `robust`, V is S^-1; `midpoint` minimises
    the square of the distance to a line times that of the confidence, `dlt` its square.
    """
    depth = np.where(inlier & (place[..., 2] > 0), place[..., 2], 1.0)
    image = place[..., :2] / depth[..., None]
    jacobian = (rotation.mT[..., :2, :] - image[..., None] * rotation.mT[..., 2:, :]) / depth[..., None, None]
    spread = (view[..., 1:4] + view[..., 4:] / depth[..., None] ** 2)[..., [[0, 1], [1, 2]]]
    if method == "robust":
        xx, xy, yy = spread[..., 0, 0], spread[..., 0, 1], spread[..., 1, 1]
        determinant = (xx * yy - xy**2)[..., None, None]
        by_view = spread[..., ::-1, ::-1] * [[1.0, -1.0], [-1.0, 1.0]] / determinant
    else:
        scale = depth**2 * (weight**2 if method == "midpoint" else 1.0)
        outer = image[..., :, None] * image[..., None, :]
        by_view = scale[..., None, None] * (np.eye(2) - outer / view[..., :1, None])
    by_view = np.where(inlier[..., None, None], by_view, 0.0)
    weighted = by_view @ jacobian
    rows = (len(jacobian), 2 * jacobian.shape[1], 3)  # those of all views
    normal = jacobian.reshape(rows).mT @ weighted.reshape(rows)
    known: Bool = np.asarray(inlier.any(axis=1) & (np.trace(normal, axis1=1, axis2=2) > 0))
    # Parallel rays leave a direction open: its variance is then huge, and finite.
    chosen: Float = np.where(known[:, None, None], normal, np.eye(3)).astype(np.float64)
    inverse: Float = np.asarray(np.linalg.inv(_closed(chosen)), dtype=np.float64)
    if method != "robust":
        inverse = inverse @ (weighted.reshape(rows).mT @ (spread @ weighted).reshape(rows)) @ inverse
    return inverse


def reprojection_px(views: Views, points: Float) -> Float:
    """Compute the reprojection distance [N, C] in px of views; NaN for absent views, inf behind a camera."""
    if len(points) > ROWS_AT_ONCE:
        parts = [slice(first, first + ROWS_AT_ONCE) for first in range(0, len(points), ROWS_AT_ONCE)]
        return np.concatenate([reprojection_px(rows_of(views, part), points[part]) for part in parts])
    rotation, position = views.rotation[views.pose_index], views.position[views.pose_index]
    x, y, z = np.einsum("ncij,nci->jnc", rotation, points[:, None] - position)
    depth = np.where(z > 0, z, 1.0)
    distance = views.focal * np.hypot(x / depth - views.rays[..., 0], y / depth - views.rays[..., 1])
    seen = (views.weight > 0) & np.isfinite(distance + z)
    return np.where(seen, np.where(z > 0, distance, np.inf), np.nan)


def estimate_noise(views: Views) -> Float:
    """Estimate the pixel noise per axis [C] that explains the views' residuals; at least the stated one.

    The excess is added as pixel noise by one factor k for all cameras: k^2 is the median over joint-frames of
    the whitened squared residuals divided by the median of their chi-square distribution with 2m - 3 degrees
    of freedom. The first k comes from one pair of views per joint-frame, later ones from the inliers of
    `robust`. One factor, not one per camera: under constant pose errors a camera's residuals are a single
    draw.

    For still, calibrated cameras, state the detector's pixel noise instead: their residuals are its errors.
    """
    n, cameras = views.weight.shape
    if cameras < 2:
        return views.pixel_sigma
    chosen = np.linspace(0, n - 1, min(n, _NOISE_SAMPLE)).astype(np.int64)
    sample = rows_of(views, chosen)

    def explain(seen: Views, method: Method, sigma: Float) -> Float:
        result = triangulate(replace(seen, pixel_sigma=sigma), method=method)
        return residual_sigma(sample, result, views.pixel_sigma)

    table, count = _pair_table(cameras)
    pair = table[cameras, np.arange(len(chosen)) % count[cameras]]
    in_pair = np.zeros_like(sample.weight)
    np.put_along_axis(in_pair, pair, 1.0, axis=1)
    in_pairs = replace(sample, weight=sample.weight * in_pair)
    sigma = _START_WIDTH * explain(in_pairs, "midpoint", views.pixel_sigma)
    for _ in range(_NOISE_ROUNDS):
        sigma = explain(sample, "robust", sigma)
    return sigma


def residual_sigma(views: Views, result: Triangulation, least_px: Float) -> Float:
    """Compute pixel noise per axis [C], at least `least_px`, that gives inliers their expected median."""
    seen = np.where(result.inlier, views.weight, np.nan)
    variance = views.pixel_sigma**2 + seen**2 * pose_variance_px(views, result.points)  # of confidence 1
    whitened = np.nansum((seen * result.residual_px) ** 2 / variance, axis=1)
    freedom = 2.0 * result.views - 3.0
    ok = (freedom > 0) & np.isfinite(whitened)  # wrong poses put points into a camera's own plane
    if not ok.any():
        return views.pixel_sigma
    # Median of the chi-square distribution by Wilson and Hilferty (1931).
    factor = np.median(whitened[ok] / (freedom[ok] * (1 - 2 / (9 * freedom[ok])) ** 3))
    typical = np.array(
        [np.median(of[np.isfinite(of)]) if np.isfinite(of).any() else 0.0 for of in variance.T]
    )
    sigma: Float = np.sqrt(np.maximum(views.pixel_sigma**2 + (factor - 1.0) * typical, least_px**2))
    return sigma


def pose_variance_px(views: Views, points: Float) -> Float:
    """Compute the variance of every image point [N, C] from pose noise, px^2, near the optical axis."""
    position, rotation = views.position[views.pose_index], views.rotation[views.pose_index]
    depth = np.einsum("nci,nci->nc", rotation[..., 2], points[:, None] - position)
    shift, turn = np.moveaxis(views.pose_sigma[views.pose_index], -1, 0)
    variance: Float = views.focal**2 * ((shift / depth) ** 2 + turn**2)
    return variance


@cache
def _pair_table(cameras: int) -> tuple[Int64, Int64]:
    """List the pairs of views that propose a point: [m, k] for m views in order of trial; and counts [m]."""
    table = np.zeros((cameras + 1, _MAX_PAIRS, 2), np.int64)
    count = np.zeros(cameras + 1, np.int64)
    for m in range(2, cameras + 1):
        pairs = (
            list(islice(_spread_pairs(m), _MAX_PAIRS))
            if comb(m, 2) > _MAX_PAIRS
            else combinations(range(m), 2)
        )
        for i, j in pairs:
            table[m, count[m]] = i, j
            count[m] += 1
    return table, count


def _spread_pairs(m: int) -> Iterator[tuple[int, int]]:
    """Yield distinct pairs of m views, spread over views and distances by golden section steps."""
    seen = set()
    for trial in count_up():
        i = trial * _golden_step(m) % m
        j = (i + 1 + trial * _golden_step(m - 1) % (m - 1)) % m
        pair = (min(i, j), max(i, j))
        if pair not in seen:
            seen.add(pair)
            yield pair


def _golden_step(n: int) -> int:
    """Find the first step, from 0.618 n upwards, that visits all of 0..n-1."""
    return next(step for step in count_up(max(round(0.618 * n), 1)) if gcd(step, n) == 1)


# --- gross errors that pose noise would hide -----------------------------------------------------------

_GROSS_GATE = 2 * GATE
"""Gate for gross errors, in standard deviations of the joints' residuals after their picture is moved. A
rotation of the camera about its axis, or an error of its distance, moves joints by different amounts; these
are not gross errors."""

_MIN_JOINTS = 5
"""Joints that a picture must have: the median of fewer may follow the bad ones."""

# The second round has residuals of points without gross errors.
_GROSS_ROUNDS = 2


def triangulate_pictures(views: Views, *, picture: Int64, pixel_sigma: Float) -> Triangulation:
    """Triangulate with `robust`, without views that have gross errors relative to the rest of their picture.

    `views.pixel_sigma` is that of `estimate_noise`, `pixel_sigma` [C] px that of the detector alone.
    `picture` [N] ascends; rows with the same number are the joints of one person in one picture of every
    camera. A camera that shows fewer than five of them is not judged. Views that are left out are not inliers
    but have their residuals. Without gross errors, the result is that of `triangulate`, byte for byte.
    """
    if len(picture) > ROWS_AT_ONCE:
        cuts = np.searchsorted(picture, picture[ROWS_AT_ONCE::ROWS_AT_ONCE]).tolist()
        parts = (
            triangulate_pictures(rows_of(views, part), picture=picture[part], pixel_sigma=pixel_sigma)
            for part in (slice(*ends) for ends in pairwise([0, *cuts, len(picture)]))
        )
        return _joined((tuple(vars(part).values()) for part in parts), len(picture))
    first = triangulate(views, method="robust")
    gross = _gross(views, picture, first.points, pixel_sigma)
    if not gross.any():
        return first
    found = triangulate(_without(gross, views), method="robust")
    (rows,) = np.nonzero(gross.any(axis=1))
    lost = rows[np.isnan(found.points[rows, 0])]
    status, residual_px = found.status.copy(), found.residual_px.copy()
    status[lost] = STATUS.index("rejected")
    again = reprojection_px(rows_of(views, rows), found.points[rows])
    residual_px[rows] = np.where(gross[rows], again, residual_px[rows])
    return replace(found, status=status, residual_px=residual_px)


def rows_of(views: Views, rows: slice | Int64) -> Views:
    """Take the views of some joint-frames."""
    return replace(views, rays=views.rays[rows], weight=views.weight[rows], pose_index=views.pose_index[rows])


def _gross(views: Views, picture: Int64, points: Float, pixel_sigma: Float) -> Bool:
    """Find views [N, C] with gross errors; `points` are approximate positions of the joint-frames."""
    gross = np.zeros(views.weight.shape, dtype=np.bool_)
    for _ in range(_GROSS_ROUNDS):
        moved, judged = _moved(replace(views, pixel_sigma=pixel_sigma), picture, points)
        moved = replace(moved, pixel_sigma=estimate_noise(moved))
        agreed = triangulate(moved, method="robust", gate=_GROSS_GATE)
        located = np.isin(agreed.status, (STATUS.index("ok"), STATUS.index("rejected")))
        before, gross = gross, located[:, None] & judged & ~agreed.inlier
        if np.array_equal(before, gross):
            break
        points = triangulate(_without(gross, views), method="robust").points
    return gross


def _moved(views: Views, picture: Int64, points: Float) -> tuple[Views, Bool]:
    """Move views to exact poses by the median residual of their picture; also mark those moved [N, C]."""
    rotation, position = views.rotation[views.pose_index], views.position[views.pose_index]
    place = (rotation.mT @ (points[:, None] - position)[..., None])[..., 0]
    seen: Bool = np.asarray((views.weight > 0) & np.isfinite(views.rays).all(axis=-1))
    depth = np.where(seen & (place[..., 2] > 0), place[..., 2], np.nan)[..., None]
    _, row, count = np.unique(picture, return_inverse=True, return_counts=True)
    order = np.argsort(row, kind="stable")
    column = np.empty_like(row)
    column[order] = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    residual = np.full((len(count), count.max(initial=1), *depth.shape[1:2], 2), np.nan)
    residual[row, column] = place[..., :2] / depth - views.rays
    residual.sort(axis=1)  # NaN last
    known = np.isfinite(residual).all(axis=-1).sum(axis=1)[:, None, :, None]
    low, high = (np.take_along_axis(residual, np.maximum(known - k, 0) // 2, axis=1)[:, 0] for k in (1, 0))
    shift = np.where(known[:, 0] >= _MIN_JOINTS, (low + high) / 2, np.nan)[row]
    judged: Bool = np.asarray(seen & np.isfinite(shift).all(axis=-1))
    rays = np.where(judged[..., None], views.rays + shift, views.rays)
    weight = np.where(judged, views.weight, 0.0)
    return replace(views, rays=rays, weight=weight, pose_sigma=np.zeros_like(views.pose_sigma)), judged


def _without(gross: Bool, views: Views) -> Views:
    return replace(views, weight=np.where(gross, 0.0, views.weight))
