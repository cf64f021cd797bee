"""Exchanges of left and right in one or two of several cameras at the same time.

If the viewing rays of a limb's joints do not meet, exchanging left and right in one or two cameras can make
them meet. All sets of one or two cameras are tried, first for each limb, then for each pair of joints.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from pipelines.geometry.arrays import Bool, Float
from pipelines.keypoints.swaps import VISIBLE, limb_pairs, mirrored_pairs
from pipelines.session.records import Int64

_MOST = 2  # cameras that are wrong at once
_GAIN = 16.0  # squared misses, in variances, that an exchange must save
_BAD, _GOOD = 5.0, 4.0  # mean squared miss of the rays of one camera before and after it; 2 is expected
_CAP = 25.0  # a single ray counts up to five standard deviations


def swaps_across_views(
    xy: Float, position: Float, rotation: Float, sigma: Float, joints: Sequence[str]
) -> tuple[Int64, dict[str, int]]:
    """Find the side of each joint where the rays of the other cameras meet.

    If an exchange in exactly half of the cameras (one of two) mends it, the right half is unknown: the limb
    is dropped from all cameras at that time.

    Args:
        xy: [T, J, C, 2] one person's joints, undistorted normalised picture coordinates, NaN not seen.
        position: [T, C, 3] m, world_from_camera, NaN without a pose.
        rotation: [T, C, 3, 3] world_from_camera.
        sigma: [T, C] rad, standard deviation of a ray on each axis: of pixels and poses together.
        joints: the names of the J joints.

    Returns:
        The joint [T, J, C] whose view belongs to each joint: its own number, its mirror's if the two are
        exchanged, -1 if it is dropped; and the numbers of joint views `undone` and `dropped`.
    """
    xy, sides = xy.copy(), np.tile(np.arange(xy.shape[1])[:, None], (len(xy), 1, xy.shape[2]))
    counts: Counter[str] = Counter()
    limbs = [pairs for pairs in limb_pairs(joints).values() if len(pairs) > 1]
    for group in [*limbs, *([pair] for pair in mirrored_pairs(joints).values())]:
        flipped, undecided = _wrong_views(xy[:, np.ravel(group)], position, rotation, sigma, len(group))
        for left, right in group:
            for values in (xy, sides):
                a, b = values[:, left], values[:, right]
                a[flipped], b[flipped] = b[flipped], a[flipped]
            for side in (left, right):
                counts["undone"] += int((flipped & np.isfinite(xy[:, side, :, 0])).sum())
                counts["dropped"] += int((undecided[:, None] & np.isfinite(xy[:, side, :, 0])).sum())
                xy[undecided, side] = np.nan
                sides[undecided, side] = -1
    return sides, dict(+counts)


def _wrong_views(xy: Float, position: Float, rotation: Float, sigma: Float, pairs: int) -> tuple[Bool, Bool]:
    """Find in which views a limb [T, 2 K, C, 2] (left, right, ...) is exchanged [T, C], or undecided [T]."""
    times, _, cameras, _ = xy.shape
    flipped, undecided = np.zeros((times, cameras), np.bool_), np.zeros(times, np.bool_)
    rays = _world_rays(xy, rotation).reshape(times, pairs, 2, cameras, 3)
    posed = np.asarray(np.isfinite(position).all(-1))[:, None, None]
    seen: Bool = np.asarray(np.isfinite(rays).all(-1)) & posed
    both = np.asarray(np.all(seen, axis=2))
    whole = np.asarray(np.any(both, axis=1))  # [T, C] cameras that see both sides of some pair
    misses = _misses(rays, seen, position, sigma)
    worst = np.max([_mean(misses[..., camera]) for camera in range(cameras)], axis=0)
    (rows,) = np.nonzero((np.sum(whole, axis=1) >= 2) & (worst > _BAD))
    if not len(rows):
        return flipped, undecided
    rays, seen, whole = rays[rows], seen[rows], whole[rows]
    position, sigma = position[rows], sigma[rows]
    views = np.sum(whole, axis=1)
    apart2 = np.nansum((xy[rows, ::2] - xy[rows, 1::2]) ** 2, axis=(1, 3)) / sigma**2
    whole &= apart2 > VISIBLE
    before = _capped(misses[rows])
    least = before - _GAIN
    best = np.zeros((len(rows), cameras), np.bool_)
    for count in range(1, _MOST + 1):
        for chosen in combinations(range(cameras), count):
            own = list(chosen)
            allowed = whole[:, own].all(1) & (2 * count <= views)
            other, there = rays.copy(), seen.copy()
            other[..., own, :] = rays[:, :, ::-1, own]
            there[..., own] = seen[:, :, ::-1, own]
            tried = _misses(other, there, position, sigma)
            after = _capped(tried) + _GAIN * (count - 1)
            better = allowed & (after < least) & (_mean(tried[..., own]) < _GOOD)
            least = np.where(better, after, least)
            best[better] = np.isin(np.arange(cameras), own)
    half = 2 * best.sum(1) == views
    flipped[rows] = best & ~half[:, None]
    undecided[rows] = half & best.any(1)
    return flipped, undecided


def _world_rays(xy: Float, rotation: Float) -> Float:
    """Compute the viewing rays as unit vectors [T, J, C, 3] in the world."""
    camera = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
    world: Float = np.einsum("tcik,tjck->tjci", rotation, camera)
    unit: Float = world / np.linalg.norm(world, axis=-1, keepdims=True)
    return unit


def _misses(rays: Float, seen: Bool, position: Float, sigma: Float) -> Float:
    """Compute squared distances [T, K, 2, C] of rays from their common point, in variances; NaN if not seen.

    The point is the least squares midpoint of the rays, weighed by their accuracy. A ray's error is its
    angular error times the distance. Also NaN for fewer than two rays, or if all are parallel.
    """
    weight = np.where(seen, 1 / sigma[:, None, None] ** 2, 0.0)
    rays = np.where(seen[..., None], rays, 0.0)
    origin = np.nan_to_num(position)[:, None, None]
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    normal = np.einsum("tksc,tkscij->tksij", weight, across)
    right = np.einsum("tksc,tkscij,tkscj->tksi", weight, across, np.broadcast_to(origin, rays.shape))
    scale = np.maximum(np.trace(normal, axis1=-2, axis2=-1), np.finfo(float).tiny)[..., None, None]
    fixed = (seen.sum(-1) >= 2) & (np.linalg.det(normal / scale) > 1e-9)
    solvable = np.where(fixed[..., None, None], normal, np.eye(3))
    point = np.linalg.solve(solvable, right[..., None])[..., 0]
    sight = point[..., None, :] - origin
    offset = np.einsum("tkscij,tkscj->tksci", across, sight)
    depth = np.einsum("tksci,tksci->tksc", rays, sight)
    variance = (np.maximum(depth, 1e-6) * sigma[:, None, None]) ** 2
    misses: Float = np.where(seen & fixed[..., None], (offset**2).sum(-1) / variance, np.nan)
    return misses


def _mean(misses: Float) -> Float:
    """Compute the mean [T] of the finite values; 0 if there are none."""
    axes = tuple(range(1, misses.ndim))
    count = np.isfinite(misses).sum(axis=axes)
    mean: Float = np.nansum(misses, axis=axes) / np.maximum(count, 1)
    return mean


def _capped(misses: Float) -> Float:
    total: Float = np.nansum(np.minimum(misses, _CAP), axis=(1, 2, 3))
    return total
