"""Compiled kernels of the adjustment by the background; `background` is their only user and explains it.

Unknowns of pictures and knots stand in the order of time, so that the normal matrix has a band: row `j` of
the array `band` [n, width] holds the entries (j, j), (j + 1, j), ... of its lower triangle. Everything runs
in one thread and in a fixed order, so that the same input gives the same bytes.
"""

import math
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.compilation import cached, helper
from pipelines.reconstruction.refinement.kernels import backward, factorise, forward

# A direction of unit length with a smaller depth is not in front of the camera.
_BEHIND = 0.05


class BackgroundSightings(NamedTuple):
    """Sightings of points, sorted by point; point `n` has those from `first[n]` to `first[n + 1]`."""

    first: Int64  # [N + 1]
    picture: Int64  # [K] rows of the poses
    rays: Float  # [K, 2] undistorted normalised image coordinates
    sigma: float  # of one


class BackgroundPoints(NamedTuple):
    """Points X as homogeneous world coordinates: direction + inverse depth * (origin - place)."""

    origin: Float  # [N, 3] place from which direction and inverse depth are counted
    direction: Float  # [N, 3] of about unit length
    inverse_depth: Float  # [N] 1/m; 0 for a point at infinity
    across: Float  # [N, 2, 3] unit vectors across the direction, along which it is moved


class PosePriorArrays(NamedTuple):
    """Prior of the errors of T pictures, about slow errors at N knots in time and constant errors."""

    place: Int64  # [T] first unknown of each picture
    knot_place: Int64  # [N]
    knot: Int64  # [T] the knot before each picture
    share: Float  # [T] of the knot after it
    white: Float  # [T, 6] precisions of white errors
    start: Float  # [6] precisions of the first knot
    left: Float  # [N - 1, 6] share of a knot's error that is left at the next one
    added: Float  # [N - 1, 6] precisions of what is added to it


@helper
def _sighting(
    t: int, place: Float, turned: Float, points: BackgroundPoints, n: int, ray: Float, out: Float
) -> tuple[float, float, bool]:
    """Compute the residual, and if it is in front; fill derivatives [2, 9] by pose error and point."""
    origin, direction, across = points.origin[n], points.direction[n], points.across[n]
    inverse = points.inverse_depth[n]
    x, y, z = 0.0, 0.0, 0.0
    for k in range(3):
        toward = direction[k] + inverse * (origin[k] - place[t, k])
        x += turned[t, k, 0] * toward
        y += turned[t, k, 1] * toward
        z += turned[t, k, 2] * toward
    if z < _BEHIND:
        return 0.0, 0.0, False
    u, v = x / z, y / z
    for k in range(3):
        a, b, c = 0.0, 0.0, 0.0
        for i in range(3):
            along = across[k, i] if k < 2 else origin[i] - place[t, i]
            a += turned[t, i, 0] * along
            b += turned[t, i, 1] * along
            c += turned[t, i, 2] * along
        out[0, 6 + k] = (a - u * c) / z
        out[1, 6 + k] = (b - v * c) / z
        out[0, k] = inverse * (turned[t, k, 0] - u * turned[t, k, 2]) / z
        out[1, k] = inverse * (turned[t, k, 1] - v * turned[t, k, 2]) / z
    # A rotation error w turns the point in the camera by w x seen.
    out[0, 3], out[0, 4], out[0, 5] = -u * v, 1 + u * u, -v
    out[1, 3], out[1, 4], out[1, 5] = -1 - v * v, u * v, u
    return ray[0] - u, ray[1] - v, True


@helper
def _hold(normal: Float) -> None:
    """Make a point's equations positive definite; a point behind all of its pictures stays where it is.

    What is added must be small: with 1e-9, thousands of points held a camera's place as a log of 2.5 m does.
    """
    for i in range(3):
        sighted = normal[0, 0] + normal[1, 1]
        normal[i, i] += 1e-13 * sighted if sighted > 0.0 else 1.0


@helper
def _point_equations(
    n: int,
    seen: BackgroundSightings,
    points: BackgroundPoints,
    place: Float,
    turned: Float,
    loss: float,
    prior: Float,
    by: Float,
    normal: Float,
    pull: Float,
) -> None:
    """Compute the Cholesky factor [3, 3] of a point's own equations, and their right side [3]."""
    normal[:] = 0.0
    pull[:] = 0.0
    normal[2, 2] = prior[1]
    pull[2] = prior[1] * (prior[0] - points.inverse_depth[n])
    for s in range(seen.first[n], seen.first[n + 1]):
        t = seen.picture[s]
        right, down, front = _sighting(t, place, turned, points, n, seen.rays[s], by)
        if not front:
            continue
        missed = (right**2 + down**2) / seen.sigma**2
        weight = 1 / (1 + missed / loss**2) / seen.sigma**2
        for i in range(3):
            u, v = weight * by[0, 6 + i], weight * by[1, 6 + i]
            pull[i] += u * right + v * down
            for k in range(i + 1):
                normal[i, k] += u * by[0, 6 + k] + v * by[1, 6 + k]
    _hold(normal)
    factorise(normal)


@helper
def _move(points: BackgroundPoints, n: int, step: Float) -> None:
    for k in range(3):
        points.direction[n, k] += step[0] * points.across[n, 0, k] + step[1] * points.across[n, 1, k]
    points.inverse_depth[n] += min(max(step[2], -0.2), 0.2)


@cached
def eliminate_points(
    seen: BackgroundSightings,
    points: BackgroundPoints,
    place: Float,
    turned: Float,
    loss: float,
    prior: Float,
    settle: int,
    offset: Int64,
    band: Float,
    force: Float,
    missed: Float,
    kept: Float,
) -> None:
    """Add the sightings to the normal equations of the poses, `band` and `force`; eliminate the points.

    `place` and `turned` are world_from_camera. A sighting counts half at `loss` standard deviations.
    `prior` is mean and precision of an inverse depth. Before, points are moved `settle` times to where
    the cameras see them. `offset` is the first of each picture's six unknowns. `missed` [K] receives the
    residuals in standard deviations, NaN behind the camera; `kept` [N, 12] each point's Cholesky factor
    and whitened force.
    """
    longest = 0
    for n in range(len(seen.first) - 1):
        longest = max(longest, seen.first[n + 1] - seen.first[n])
    half = np.zeros((longest, 3, 6))
    by, normal, pull = np.empty((2, 9)), np.empty((3, 3)), np.empty(3)
    for n in range(len(seen.first) - 1):
        start, stop = seen.first[n], seen.first[n + 1]
        for _ in range(settle):
            _point_equations(n, seen, points, place, turned, loss, prior, by, normal, pull)
            forward(normal, pull)
            backward(normal, pull)
            _move(points, n, pull)
        _point_equations(n, seen, points, place, turned, loss, prior, by, normal, pull)
        # Whitened: mixed F^-T, and F^-1 pull.
        forward(normal, pull)
        for i in range(3):
            kept[n, 9 + i] = pull[i]
            for k in range(3):
                kept[n, 3 * i + k] = normal[i, k]
        for s in range(start, stop):
            t, mixed = seen.picture[s], half[s - start]
            right, down, front = _sighting(t, place, turned, points, n, seen.rays[s], by)
            if not front:
                mixed[:] = 0.0
                missed[s] = math.nan
                continue
            square = (right**2 + down**2) / seen.sigma**2
            missed[s] = math.sqrt(square)
            weight = 1 / (1 + square / loss**2) / seen.sigma**2
            at = offset[t]
            for i in range(6):
                u, v = weight * by[0, i], weight * by[1, i]
                for k in range(3):
                    mixed[k, i] = u * by[0, 6 + k] + v * by[1, 6 + k]
                    for m in range(k):
                        mixed[k, i] -= normal[k, m] * mixed[m, i]
                    mixed[k, i] /= normal[k, k]
                force[at + i] += u * right + v * down
                force[at + i] -= mixed[0, i] * pull[0] + mixed[1, i] * pull[1] + mixed[2, i] * pull[2]
                for k in range(i + 1):
                    band[at + k, i - k] += u * by[0, k] + v * by[1, k]
        for s in range(start, stop):
            later = half[s - start]
            after = offset[seen.picture[s]]
            for r in range(start, s + 1):
                earlier = half[r - start]
                before = offset[seen.picture[r]]
                away = after - before
                for k in range(6):
                    e0, e1, e2 = earlier[0, k], earlier[1, k], earlier[2, k]
                    for i in range(k if away == 0 else 0, 6):
                        band[before + k, away + i - k] -= (
                            later[0, i] * e0 + later[1, i] * e1 + later[2, i] * e2
                        )


@cached
def move_points(
    seen: BackgroundSightings,
    points: BackgroundPoints,
    place: Float,
    turned: Float,
    loss: float,
    kept: Float,
    offset: Int64,
    step: Float,
) -> None:
    """Move the points by what the step [n] of the poses leaves to them; `kept` is of `eliminate_points`."""
    by, factor, force = np.empty((2, 9)), np.zeros((3, 3)), np.empty(3)
    for n in range(len(seen.first) - 1):
        force[:] = 0.0
        for s in range(seen.first[n], seen.first[n + 1]):
            t = seen.picture[s]
            right, down, front = _sighting(t, place, turned, points, n, seen.rays[s], by)
            if not front:
                continue
            weight = 1 / (1 + (right**2 + down**2) / seen.sigma**2 / loss**2) / seen.sigma**2
            for a in range(2):
                along = 0.0
                for i in range(6):
                    along += by[a, i] * step[offset[t] + i]
                for i in range(3):
                    force[i] -= weight * by[a, 6 + i] * along
        for i in range(3):
            for k in range(3):
                factor[i, k] = kept[n, 3 * i + k]
        forward(factor, force)
        for i in range(3):
            force[i] += kept[n, 9 + i]  # the points' own part is kept whitened
        backward(factor, force)
        _move(points, n, force)


@helper
def _tie(band: Float, one: int, other: int, value: float) -> None:
    """Add to the entry of two unknowns."""
    first, second = min(one, other), max(one, other)
    band[first, second - first] += value


@cached
def add_ties(
    ties: PosePriorArrays,
    design: Float,
    errors: Float,
    knots: Float,
    constant: Float,
    band: Float,
    force: Float,
    border: Float,
    corner: Float,
    pull: Float,
) -> None:
    """Add the prior to the normal equations: `band` and `force` as in `eliminate_points`.

    `design` [T, 6, N] has the derivatives of the errors by the constant ones, whose equations are
    `corner` and `pull`; `border` has the entries of pictures and knots with them. `errors`, `knots` and
    `constant` are the estimates.
    """
    count = len(constant)
    for t in range(len(ties.place)):
        before, after = ties.knot[t], ties.knot[t] + 1
        share = ties.share[t]
        for a in range(6):
            row = design[t, a]
            left = errors[t, a] - (1 - share) * knots[before, a] - share * knots[after, a]
            for k in range(count):
                left -= row[k] * constant[k]
            own, old, new = ties.place[t] + a, ties.knot_place[before] + a, ties.knot_place[after] + a
            w = ties.white[t, a]
            band[own, 0] += w
            band[old, 0] += (1 - share) ** 2 * w
            band[new, 0] += share**2 * w
            _tie(band, own, old, -(1 - share) * w)
            _tie(band, own, new, -share * w)
            _tie(band, old, new, share * (1 - share) * w)
            force[own] -= w * left
            force[old] += (1 - share) * w * left
            force[new] += share * w * left
            for k in range(count):
                border[own, k] -= w * row[k]
                border[old, k] += (1 - share) * w * row[k]
                border[new, k] += share * w * row[k]
                pull[k] += w * row[k] * left
                for m in range(count):
                    corner[k, m] += w * row[k] * row[m]
    for a in range(6):
        band[ties.knot_place[0] + a, 0] += ties.start[a]
        force[ties.knot_place[0] + a] -= ties.start[a] * knots[0, a]
        for k in range(len(ties.left)):
            old, new = ties.knot_place[k] + a, ties.knot_place[k + 1] + a
            kept, w = ties.left[k, a], ties.added[k, a]
            left = knots[k + 1, a] - kept * knots[k, a]
            band[new, 0] += w
            band[old, 0] += kept**2 * w
            _tie(band, old, new, -kept * w)
            force[new] -= w * left
            force[old] += kept * w * left


@cached
def inverse_in_band(band: Float) -> Float:
    """Compute the entries of the inverse that lie in the band, from the factor (Takahashi et al. 1973)."""
    count, width = band.shape
    inverse = np.zeros((count, width))
    sums = np.zeros(width)
    for j in range(count - 1, -1, -1):
        reach = min(width, count - j)
        sums[:] = 0.0
        for k in range(1, reach):
            share = band[j, k] / band[j, 0]
            row = inverse[j + k]
            for i in range(k, reach):
                sums[i] += row[i - k] * share
        for i in range(1, reach):
            row = inverse[j + i]
            total = 0.0
            for k in range(i + 1, reach):
                total += row[k - i] * (band[j, k] / band[j, 0])
            inverse[j, i] = -(sums[i] + total)
        total = 1 / band[j, 0] ** 2
        for k in range(1, reach):
            total -= inverse[j, k] * band[j, k] / band[j, 0]
        inverse[j, 0] = total
    return inverse
