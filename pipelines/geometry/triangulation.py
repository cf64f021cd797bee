"""Triangulation of image points to 3D points, over all frames, people and joints in one call.

There are three methods. `midpoint` and `robust` are weighted by the square of the detector's confidence w.
A view of confidence w has the standard deviation pixel_sigma / w: its rows are multiplied by w.

- `dlt`: homogeneous linear triangulation of viewing directions by pycolmap, without confidences: a baseline.
  The world is moved to the mean centre of the cameras, and its unit is their RMS distance from it. Without
  that, the result depends on the origin and fails under pose noise.
- `midpoint`: the point closest to the viewing lines, sum w^2 (I - d d')(X - c) = 0.
- `robust`: least squares of the reprojection errors, whitened by pixel and pose noise together. If every
  view is within `gate` standard deviations, this is the result. Otherwise every pair of views (above 8
  cameras a fixed set of 28) proposes a point. The point with the lowest truncated cost over all views wins
  (MSAC: Torr & Zisserman 2000). It is refined by Gauss-Newton on its inliers, which are chosen again until
  they stay the same.

Two views agree by their epipolar distance alone. If only two of three or more views agree and another
pair agrees on a different place, it is not possible to know which pair is right, and the joint is
`rejected`. On the walk of docs/results.md this costs 0.1 % of the joint-frames and reduces the mean error
from 13.6 to 13.0 mm.

A gate in pixels would reject good views as soon as poses are noisy: 1 deg is 26 px at f = 1500. State
the pose noise in `Views.pose_sigma`, and let `estimate_noise` raise the pixel noise to what the views need.

That gate must be as wide as the pose errors: 0.3 m and 1 deg move a keypoint by 50 px, so a keypoint that is
itself wrong by 100 px passes it. But a pose error moves all joints of a person in a picture together, and a
gross error of one joint does not. `triangulate_pictures` therefore moves each picture by the median of its
joints' residuals, which removes the pose error, and finds the views with gross errors by `robust` with exact
poses. These are left out; all others are triangulated with the stated pose noise. The benefit is measured in
docs/estimate.md.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations, islice
from itertools import count as count_up
from math import comb, cos, gcd, radians
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int8, Int64

if TYPE_CHECKING:
    from pipelines.geometry.triangulation_kernels import TriangulationArrays

Method = Literal["dlt", "midpoint", "robust"]

MIN_PARALLAX_DEG = 2.0
"""The least parallax. Below it, depth is about thirty times as uncertain as the other directions."""

GATE = 4.0
"""The gate in standard deviations of a view's image point: one good view in 3000 falls outside."""

STATUS = ("ok", "filled", "few_views", "low_parallax", "rejected", "not_detected", "no_pose")
"""Meanings of `Triangulation.status`; the words of a session's skeleton."""

# These are all pairs of 8 views. Of more views, even if half are bad, 28 nearly always hold a clean pair.
_MAX_PAIRS = 28
# A thread takes this many joint-frames at once.
_BLOCK = 4096
# A median over this many joint-frames is accurate to one per cent.
_NOISE_SAMPLE = 20_000
# The inliers of the first round set the gate of the second.
_NOISE_ROUNDS = 2
# A constant pose error gives few different pairs: undoubled, 2 % of draws of three cameras lost all joints.
_START_WIDTH = 2.0


@dataclass(frozen=True)
class Views:
    """Observations of N joint-frames by C cameras, and the cameras' poses at F instants.

    A view is absent where `rays` or the pose is NaN or `weight` is 0. Rays are normalised image points,
    undistorted, (x/z, y/z) in the camera's frame. Joints of one instant share its row of poses. Triangulation
    is fastest if joints of one instant are neighbours in N.
    """

    rays: Float  # [N, C, 2]
    weight: Float  # [N, C] confidence
    pose_index: Int64  # [N] row of the three arrays below
    position: Float  # [F, C, 3] m, camera centre in the world
    rotation: Float  # [F, C, 3, 3] world_from_camera
    focal: Float  # [C] px, mean of fx and fy
    pixel_sigma: Float  # [C] px, per axis, of a view of confidence 1
    pose_sigma: Float  # [F, C, 2] per axis: centre in m, rotation in rad; 0 where exact

    def __post_init__(self) -> None:
        """Check the shapes against each other and that every pose row exists."""
        n, cameras = self.weight.shape
        instants = self.position.shape[0]
        expected = {
            "rays": (n, cameras, 2),
            "pose_index": (n,),
            "position": (instants, cameras, 3),
            "rotation": (instants, cameras, 3, 3),
            "focal": (cameras,),
            "pixel_sigma": (cameras,),
            "pose_sigma": (instants, cameras, 2),
        }
        for name, shape in expected.items():
            actual = getattr(self, name).shape
            if actual != shape:
                raise ValueError(f"{name} has the shape {actual}, not {shape}")
        if n and (self.pose_index.min() < 0 or self.pose_index.max() >= instants):
            raise ValueError(f"pose_index leaves 0..{instants - 1}")

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
class Points:
    """Points without uncertainty; NaN, and no inliers, wherever `status` is not "ok"."""

    points: Float  # [N, 3] m, world
    inlier: Bool  # [N, C]
    status: Int8  # [N] index into STATUS


@dataclass(frozen=True)
class Triangulation(Points):
    """Points with their uncertainty and residuals, NaN wherever `status` is not "ok".

    `covariance` is of first order: pixel and pose noise of the inlier views, independent between cameras. It
    includes the part of a pose error that all joints share, so it is that of the absolute position.
    """

    covariance: Float  # [N, 3, 3] m^2
    views: Int64  # [N] inlier views
    residual_px: Float  # [N, C] reprojection distance of every view, also rejected ones; inf behind a camera


def triangulate(
    views: Views,
    *,
    method: Method,
    min_views: int = 2,
    gate: float = GATE,
    threads: int = 1,
) -> Triangulation:
    """Triangulate every joint-frame; the result has the same bytes for any number of threads.

    Statuses besides "ok":

    * `not_detected`: by no camera.
    * `few_views`: detected by fewer than `min_views` cameras.
    * `no_pose`: fewer than `min_views` of the detections have a camera pose.
    * `low_parallax`: no two viewing lines differ by `MIN_PARALLAX_DEG` (opposite directions do not count).
    * `rejected`: fewer than `min_views` views agree within `gate` (`robust`), or the point is behind one of
      its cameras (`dlt` and `midpoint`, which reject no view).

    Args:
        method: see the module; `min_views` and the parallax apply to all three, `gate` to `robust`.
        min_views: views needed, and inliers needed; at least 2.
        gate: in standard deviations of a view's image point, pixel and pose noise together.
        threads: at most this many, and no more than there are processors.

    Raises:
        ValueError: min_views below 2, or a gate that is not above 0.
    """
    found = _run(views, method, min_views, gate, threads, len(views.weight))
    return Triangulation(*found)


def locate(views: Views, *, method: Method, gate: float = GATE, threads: int = 1) -> Points:
    """Triangulate without covariances and residuals, for studies over many draws of noise."""
    return Points(*_run(views, method, 2, gate, threads, 0)[:3])


def _run(
    views: Views, method: Method, min_views: int, gate: float, threads: int, described: int
) -> TriangulationArrays:
    """Run the kernel over blocks of joint-frames; `described` is the length of the last three results."""
    if min_views < 2 or not gate > 0:
        raise ValueError(f"min_views={min_views}, gate={gate}: out of range")
    from pipelines.geometry import triangulation_kernels as kernels

    n, cameras = views.weight.shape
    found = kernels.TriangulationArrays(
        _linear_points(views) if method == "dlt" else np.empty((n, 3)),
        np.empty((n, cameras), np.bool_),
        np.empty(n, np.int8),
        np.empty((described, 3, 3)),
        np.empty(described, np.int64),
        np.empty((described, cameras)),
    )
    contiguous: list[Any] = [
        np.ascontiguousarray(getattr(views, name), np.int64 if name == "pose_index" else np.float64)
        for name in kernels.ViewArrays._fields
    ]
    arrays = kernels.ViewArrays(*contiguous)
    gates = kernels.Gates(
        {"dlt": kernels.DLT, "midpoint": kernels.MIDPOINT, "robust": kernels.ROBUST}[method],
        min_views,
        cos(radians(MIN_PARALLAX_DEG)) ** 2,
        float(gate) ** 2,
        *_pair_table(cameras),
    )
    starts = range(0, n, _BLOCK)
    workers = min(threads, os.cpu_count() or 1, len(starts))
    if workers <= 1:
        kernels.triangulate_range(0, n, arrays, gates, found)
        return found
    # The kernel releases the interpreter lock and each block writes its own rows, so plain threads suffice.
    # Unlike numba's own threads, they may be started from several threads at once.
    with ThreadPoolExecutor(workers) as pool:
        for done in [
            pool.submit(kernels.triangulate_range, first, min(first + _BLOCK, n), arrays, gates, found)
            for first in starts
        ]:
            done.result()
    return found


def _linear_points(views: Views) -> Float:
    """Triangulate each joint-frame [N, 3] by pycolmap from all its views; NaN where it finds no point."""
    from pycolmap import triangulate_multi_view_point

    known = np.isfinite(views.position).all(axis=-1) & np.isfinite(views.rotation).all(axis=(-1, -2))
    posed: Bool = np.asarray(known, np.bool_)
    count = np.maximum(posed.sum(axis=1), 1)[:, None]
    centre = np.where(posed[..., None], views.position, 0.0).sum(axis=1) / count  # [F, 3]
    away = views.position - centre[:, None]
    spread = np.where(posed, (away**2).sum(axis=-1), 0.0).sum(axis=1, keepdims=True)
    unit = np.where(spread > 0, np.sqrt(spread / count), 1.0)  # [F, 1] m
    camera_from_world = np.swapaxes(views.rotation, -1, -2)
    shift = -camera_from_world @ (away / unit[..., None])[..., None]
    projection = np.concatenate([camera_from_world, shift], axis=-1)
    seen = (views.weight > 0) & np.isfinite(views.rays).all(axis=-1) & posed[views.pose_index]
    rays = np.where(seen[..., None], views.rays, 0.0)
    direction = np.concatenate([rays, np.ones((*seen.shape, 1))], axis=-1)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    points = np.full((len(seen), 3), np.nan)
    for n in np.flatnonzero(seen.sum(axis=1) >= 2):
        own = seen[n]
        found = triangulate_multi_view_point(list(projection[views.pose_index[n], own]), direction[n, own])
        if found is not None:
            points[n] = found.ravel()
    result: Float = points * unit[views.pose_index] + centre[views.pose_index]
    return result


def reprojection_px(views: Views, points: Float) -> Float:
    """Compute the reprojection distance [N, C] in px of views; NaN for absent views, inf behind a camera.

    Args:
        points: [N, 3] m; NaN gives NaN.
    """
    rotation, position = views.rotation[views.pose_index], views.position[views.pose_index]
    x, y, z = np.einsum("ncij,nci->jnc", rotation, points[:, None] - position)
    depth = np.where(z > 0, z, 1.0)
    distance = views.focal * np.hypot(x / depth - views.rays[..., 0], y / depth - views.rays[..., 1])
    seen = (views.weight > 0) & np.isfinite(distance)
    result: Float = np.where(seen, np.where(z > 0, distance, np.inf), np.nan)
    return result


def estimate_noise(views: Views, *, threads: int = 1) -> Float:
    """Estimate the pixel noise per axis [C] that explains the views' residuals; at least the stated one.

    Residuals may be larger than the stated pixel and pose noise explain, because poses are worse than their
    log states or the detector is less accurate than assumed. The excess is added as pixel noise by one factor
    k for all cameras. k^2 is the median over joint-frames of the whitened squared residuals divided by the
    median of their chi-square distribution with 2m - 3 degrees of freedom. The first k comes from one pair of
    views per joint-frame, which tolerates up to 29 % bad views for any number of cameras. Later values come
    from the inliers that `robust` finds with it.

    One factor, not one per camera: under constant pose errors a camera's residuals are a single draw, and
    weighting by them costs 3 to 7 % (docs/results.md).

    Use it as `replace(views, pixel_sigma=estimate_noise(views))` if poses come from a log, even one that
    states its noise: if that is right, little changes. For still, calibrated cameras, state the detector's
    pixel noise instead: their residuals are the detector's errors, and a wider gate would keep these errors.
    """
    n, cameras = views.weight.shape
    if cameras < 2:
        return views.pixel_sigma
    chosen = np.linspace(0, n - 1, min(n, _NOISE_SAMPLE)).astype(np.int64)
    sample = replace(
        views, rays=views.rays[chosen], weight=views.weight[chosen], pose_index=views.pose_index[chosen]
    )

    def explain(seen: Views, method: Method, sigma: Float) -> Float:
        result = triangulate(replace(seen, pixel_sigma=sigma), method=method, threads=threads)
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
    """Compute the pixel noise per axis [C] with which the inliers' residuals have their expected median.

    Args:
        views: the views, with the stated noise.
        result: their triangulation.
        least_px: [C] the least that is returned.
    """
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
    own = replace(views, rays=views.rays[rows], weight=views.weight[rows], pose_index=views.pose_index[rows])
    residual_px[rows] = np.where(gross[rows], reprojection_px(own, found.points[rows]), residual_px[rows])
    return replace(found, status=status, residual_px=residual_px)


def _gross(views: Views, picture: Int64, points: Float, pixel_sigma: Float, threads: int) -> Bool:
    """Find views [N, C] with gross errors; `points` are approximate positions of the joint-frames."""
    gross = np.zeros(views.weight.shape, dtype=np.bool_)
    for _ in range(_GROSS_ROUNDS):
        moved, judged = _moved(replace(views, pixel_sigma=pixel_sigma), picture, points)
        moved = replace(moved, pixel_sigma=estimate_noise(moved, threads=threads))
        agreed = locate(moved, method="robust", gate=_GROSS_GATE, threads=threads)
        located = np.isin(agreed.status, (STATUS.index("ok"), STATUS.index("rejected")))
        before, gross = gross, located[:, None] & judged & ~agreed.inlier
        if np.array_equal(before, gross):
            break
        points = locate(_without(gross, views), method="robust", threads=threads).points
    return gross


def _moved(views: Views, picture: Int64, points: Float) -> tuple[Views, Bool]:
    """Move each view by the median residual of its picture; return also which views [N, C] could be moved.

    The moved views have exact poses. The others count as not seen.
    """
    from pipelines.geometry.triangulation_kernels import move_pictures

    order = np.argsort(picture, kind="stable")
    starts = np.flatnonzero(np.diff(picture[order], prepend=-1, append=-1))
    rays, judged = np.array(views.rays, np.float64, order="C"), np.zeros(views.weight.shape, dtype=np.bool_)
    move_pictures(
        order,
        starts,
        _MIN_JOINTS,
        np.ascontiguousarray(points),
        np.ascontiguousarray(views.rays, np.float64),
        np.ascontiguousarray(views.weight, np.float64),
        np.ascontiguousarray(views.pose_index, np.int64),
        np.ascontiguousarray(views.position, np.float64),
        np.ascontiguousarray(views.rotation, np.float64),
        rays,
        judged,
    )
    weight = np.where(judged, views.weight, 0.0)
    return replace(views, rays=rays, weight=weight, pose_sigma=np.zeros_like(views.pose_sigma)), judged


def _without(gross: Bool, views: Views) -> Views:
    return replace(views, weight=np.where(gross, 0.0, views.weight))
