"""Compiled kernels of triangulation; `triangulation` is their only user and explains the methods.

There is no fastmath and no thread here: a joint-frame's result depends only on its own numbers, so any
division of the work gives the same bytes.

Symmetric 3x3 matrices are passed as the six numbers xx, xy, xz, yy, yz, zz. All calculations use a world
moved to the mean camera centre, so that an origin kilometres away costs no precision.
"""

import math
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int8, Int64
from pipelines.geometry.compilation import cached, helper

Vector = tuple[float, float, float]
Symmetric = tuple[float, float, float, float, float, float]

DLT, MIDPOINT, ROBUST = 0, 1, 2
OK, FILLED, FEW_VIEWS, LOW_PARALLAX, REJECTED, NOT_DETECTED, NO_POSE = range(7)  # by STATUS

# Squared length, in standard deviations of the point, below which a Gauss-Newton step is the last one.
# Measured on the walk at 5 views, the remaining error is at most 3e-4 standard deviations for pixel noise
# and 0.1 for 0.5 m / 2 deg (where the covariance changes with the depth); one step more would cost 40 %.
CONVERGED = 1e-2
# Shortened steps count as well, so that the loop always ends.
MAX_STEPS = 10


class ViewArrays(NamedTuple):
    """Contiguous arrays of `triangulation.Views`."""

    rays: Float  # [N, C, 2]
    weight: Float  # [N, C]
    pose_index: Int64  # [N]
    position: Float  # [F, C, 3]
    rotation: Float  # [F, C, 3, 3]
    focal: Float  # [C]
    pixel_sigma: Float  # [C]
    pose_sigma: Float  # [F, C, 2]


class Gates(NamedTuple):
    """Method, and the conditions for a point."""

    method: int  # DLT, MIDPOINT or ROBUST
    min_views: int
    cos2_min: float  # of the least parallax
    gate2: float
    pairs: Int64  # [m, k, 2] pairs of m views that propose a point
    pair_count: Int64  # [m]


class TriangulationArrays(NamedTuple):
    """Results; see `triangulation.Triangulation`."""

    points: Float  # [N, 3]; for DLT it holds the points before the call
    inlier: Bool  # [N, C]
    status: Int8  # [N]
    covariance: Float  # [N, 3, 3], or without rows if points alone are wanted; so the next two
    views: Int64  # [N]
    residual_px: Float  # [N, C]


@helper
def _inverse(a: Symmetric) -> Symmetric:
    """Invert a symmetric 3x3 matrix by cofactors."""
    xx, xy, xz, yy, yz, zz = a
    c0 = yy * zz - yz * yz
    c1 = xz * yz - xy * zz
    c2 = xy * yz - xz * yy
    scale = 1.0 / (xx * c0 + xy * c1 + xz * c2)
    return (
        c0 * scale,
        c1 * scale,
        c2 * scale,
        (xx * zz - xz * xz) * scale,
        (xy * xz - xx * yz) * scale,
        (xx * yy - xy * xy) * scale,
    )


@helper
def _times(a: Symmetric, b: Vector) -> Vector:
    """Multiply a symmetric 3x3 matrix and a vector."""
    return (
        a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
        a[1] * b[0] + a[3] * b[1] + a[4] * b[2],
        a[2] * b[0] + a[4] * b[1] + a[5] * b[2],
    )


@helper
def _load_cameras(
    position: Float, rotation: Float, pose_sigma: Float, pose: int, camera: Float, posed: Bool
) -> Vector:
    """Copy the poses of one instant, moved to their mean centre; return that centre.

    Columns of `camera`: 0-8 world_from_camera rotation by rows, 9-11 centre, 12 and 13 variances of
    position and rotation.
    """
    n_cameras = position.shape[1]
    sx = sy = sz = 0.0
    count = 0
    for c in range(n_cameras):
        total = position[pose, c, 0] + position[pose, c, 1] + position[pose, c, 2]
        for i in range(3):
            for j in range(3):
                camera[c, 3 * i + j] = rotation[pose, c, i, j]
                total += rotation[pose, c, i, j]
        posed[c] = math.isfinite(total)
        if posed[c]:
            sx += position[pose, c, 0]
            sy += position[pose, c, 1]
            sz += position[pose, c, 2]
            count += 1
    scale = 1.0 / max(count, 1)
    sx *= scale
    sy *= scale
    sz *= scale
    for c in range(n_cameras):
        camera[c, 9] = position[pose, c, 0] - sx
        camera[c, 10] = position[pose, c, 1] - sy
        camera[c, 11] = position[pose, c, 2] - sz
        camera[c, 12] = pose_sigma[pose, c, 0] ** 2
        camera[c, 13] = pose_sigma[pose, c, 1] ** 2
    return sx, sy, sz


@helper
def _load_views(
    rays: Float, weight: Float, n: int, camera: Float, posed: Bool, ids: Int64, ray: Float
) -> tuple[int, int]:
    """Collect the usable views of one joint-frame; return their number and the number of detections.

    Columns of `ray`: 0-1 image point, 2 squared confidence, 3-5 direction in the world (depth 1), 6 its
    squared length; `_load_noise` writes the rest.
    """
    views = detected = 0
    for c in range(weight.shape[1]):
        x = rays[n, c, 0]
        y = rays[n, c, 1]
        w = weight[n, c]
        if not (w > 0.0 and math.isfinite(w + x + y)):
            continue
        detected += 1
        if not posed[c]:
            continue
        ids[views] = c
        ray[views, 0] = x
        ray[views, 1] = y
        ray[views, 2] = w * w
        ray[views, 3] = camera[c, 0] * x + camera[c, 1] * y + camera[c, 2]
        ray[views, 4] = camera[c, 3] * x + camera[c, 4] * y + camera[c, 5]
        ray[views, 5] = camera[c, 6] * x + camera[c, 7] * y + camera[c, 8]
        ray[views, 6] = x * x + y * y + 1.0
        views += 1
    return views, detected


@helper
def _load_noise(ids: Int64, ray: Float, views: int, camera: Float, pixel_variance: Float) -> None:
    """Compute covariances of image points: columns 7-9 pixels and rotation, 10-12 position at depth 1.

    The image moves by J t under a shift t and by L w under a turn w of the camera, with the interaction
    matrices J = [1 0 -x; 0 1 -y]/z and L = [xy, -1-x^2, y; 1+y^2, -xy, -x] (Chaumette and Hutchinson
    2006, eq. 11).
    """
    for k in range(views):
        c = ids[k]
        x = ray[k, 0]
        y = ray[k, 1]
        pixel = pixel_variance[c] / ray[k, 2]
        shift = camera[c, 12]
        turn = camera[c, 13]
        xx = 1.0 + x * x
        yy = 1.0 + y * y
        cross = x * y
        ray[k, 7] = pixel + turn * (cross * cross + xx * xx + y * y)
        ray[k, 8] = turn * cross * (xx + yy - 1.0)
        ray[k, 9] = pixel + turn * (cross * cross + yy * yy + x * x)
        ray[k, 10] = shift * xx
        ray[k, 11] = shift * cross
        ray[k, 12] = shift * yy


@helper
def _pair_parallax(ray: Float, i: int, j: int, cos2_min: float) -> bool:
    """Test if two viewing lines differ by more than the least parallax (opposite directions do not)."""
    dot = ray[i, 3] * ray[j, 3] + ray[i, 4] * ray[j, 4] + ray[i, 5] * ray[j, 5]
    differ: bool = dot * dot < cos2_min * ray[i, 6] * ray[j, 6]
    return differ


@helper
def _parallax(ray: Float, used: Bool, views: int, cos2_min: float) -> bool:
    """Test if any two used viewing lines have enough parallax; nearly always the first pair decides."""
    for i in range(views):
        if used[i]:
            for j in range(i + 1, views):
                if used[j] and _pair_parallax(ray, i, j, cos2_min):
                    return True
    return False


@helper
def _midpoint(ids: Int64, ray: Float, views: int, camera: Float) -> Vector:
    """Compute the point closest to the viewing lines: sum w^2 (I - d d') (X - c) = 0."""
    xx = xy = xz = yy = yz = zz = 0.0
    bx = by = bz = 0.0
    for k in range(views):
        c = ids[k]
        w = ray[k, 2]
        dx = ray[k, 3]
        dy = ray[k, 4]
        dz = ray[k, 5]
        cx = camera[c, 9]
        cy = camera[c, 10]
        cz = camera[c, 11]
        q = w / ray[k, 6]
        qx = q * dx
        qy = q * dy
        qz = q * dz
        xx += w - qx * dx
        xy -= qx * dy
        xz -= qx * dz
        yy += w - qy * dy
        yz -= qy * dz
        zz += w - qz * dz
        along = dx * cx + dy * cy + dz * cz
        bx += w * cx - qx * along
        by += w * cy - qy * along
        bz += w * cz - qz * along
    return _times(_inverse((xx, xy, xz, yy, yz, zz)), (bx, by, bz))


@helper
def _project(camera: Float, c: int, x: float, y: float, z: float) -> Vector:
    """Transform a point to the camera's frame."""
    dx = x - camera[c, 9]
    dy = y - camera[c, 10]
    dz = z - camera[c, 11]
    return (
        camera[c, 0] * dx + camera[c, 3] * dy + camera[c, 6] * dz,
        camera[c, 1] * dx + camera[c, 4] * dy + camera[c, 7] * dz,
        camera[c, 2] * dx + camera[c, 5] * dy + camera[c, 8] * dz,
    )


@helper
def _information(ray: Float, k: int, inverse_depth: float) -> Vector:
    """Compute the inverse of the image point's covariance for a point at that depth."""
    at = inverse_depth * inverse_depth
    a = ray[k, 7] + ray[k, 10] * at
    b = ray[k, 8] + ray[k, 11] * at
    d = ray[k, 9] + ray[k, 12] * at
    scale = 1.0 / (a * d - b * b)
    return d * scale, -b * scale, a * scale


@helper
def _jacobian(camera: Float, c: int, u: float, v: float, inverse_depth: float) -> tuple[Vector, Vector]:
    """Compute the derivatives of the two image coordinates by the point."""
    return (
        (
            (camera[c, 0] - u * camera[c, 2]) * inverse_depth,
            (camera[c, 3] - u * camera[c, 5]) * inverse_depth,
            (camera[c, 6] - u * camera[c, 8]) * inverse_depth,
        ),
        (
            (camera[c, 1] - v * camera[c, 2]) * inverse_depth,
            (camera[c, 4] - v * camera[c, 5]) * inverse_depth,
            (camera[c, 7] - v * camera[c, 8]) * inverse_depth,
        ),
    )


@helper
def _add_quadratic(to: Symmetric, a: float, b: float, d: float, p: Vector, q: Vector) -> Symmetric:
    """Add J' [a b; b d] J for the Jacobian J with rows p and q."""
    sx = a * p[0] + b * q[0]
    sy = a * p[1] + b * q[1]
    sz = a * p[2] + b * q[2]
    tx = b * p[0] + d * q[0]
    ty = b * p[1] + d * q[1]
    tz = b * p[2] + d * q[2]
    return (
        to[0] + sx * p[0] + tx * q[0],
        to[1] + sx * p[1] + tx * q[1],
        to[2] + sx * p[2] + tx * q[2],
        to[3] + sy * p[1] + ty * q[1],
        to[4] + sy * p[2] + ty * q[2],
        to[5] + sz * p[2] + tz * q[2],
    )


@helper
def _chi2(ids: Int64, ray: Float, k: int, camera: Float, x: float, y: float, z: float) -> float:
    """Compute the squared whitened reprojection error of view k, infinite behind its camera."""
    u, v, depth = _project(camera, ids[k], x, y, z)
    if not depth > 0.0:
        return math.inf
    inverse = 1.0 / depth
    a, b, d = _information(ray, k, inverse)
    ru = u * inverse - ray[k, 0]
    rv = v * inverse - ray[k, 1]
    chi2: float = a * ru * ru + 2.0 * b * ru * rv + d * rv * rv
    return chi2


@helper
def _linearise(
    ids: Int64, ray: Float, views: int, used: Bool, camera: Float, x: float, y: float, z: float
) -> tuple[float, float, Symmetric, Vector]:
    """Linearise the used views: sum and largest of the squared whitened errors, normal matrix, gradient."""
    normal = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    gx = gy = gz = 0.0
    total = worst = 0.0
    for k in range(views):
        if not used[k]:
            continue
        c = ids[k]
        u, v, depth = _project(camera, c, x, y, z)
        if not depth > 0.0:
            total = worst = math.inf
            break
        inverse = 1.0 / depth
        u *= inverse
        v *= inverse
        a, b, d = _information(ray, k, inverse)
        ru = u - ray[k, 0]
        rv = v - ray[k, 1]
        au = a * ru + b * rv
        av = b * ru + d * rv
        chi2 = ru * au + rv * av
        total += chi2
        worst = max(worst, chi2)
        p, q = _jacobian(camera, c, u, v, inverse)
        normal = _add_quadratic(normal, a, b, d, p, q)
        gx += p[0] * au + q[0] * av
        gy += p[1] * au + q[1] * av
        gz += p[2] * au + q[2] * av
    return total, worst, normal, (gx, gy, gz)


@helper
def _refine(
    ids: Int64,
    ray: Float,
    views: int,
    used: Bool,
    camera: Float,
    start: Vector,
    hopeless: float,
) -> tuple[float, float, float, float, float]:
    """Refine a point by Gauss-Newton on the whitened reprojection errors of the used views.

    A step that raises the cost is shortened, so the result is never worse than the start. The function stops
    if the linear model predicts a cost above `hopeless`. It returns the point, the cost and the largest term.
    """
    x, y, z = start
    dx = dy = dz = 0.0
    before = math.inf
    best_worst = math.inf
    for _ in range(MAX_STEPS):
        total, worst, normal, gradient = _linearise(ids, ray, views, used, camera, x + dx, y + dy, z + dz)
        if not total <= before * (1.0 + 1e-9):
            dx *= 0.25
            dy *= 0.25
            dz *= 0.25
            continue
        x += dx
        y += dy
        z += dz
        before = total
        best_worst = worst
        dx, dy, dz = _times(_inverse(normal), (-gradient[0], -gradient[1], -gradient[2]))
        decrement = -(gradient[0] * dx + gradient[1] * dy + gradient[2] * dz)
        if not math.isfinite(decrement) or total - decrement > hopeless:
            return x, y, z, math.inf, math.inf
        if decrement <= CONVERGED:
            x += dx
            y += dy
            z += dz
            break
    return x, y, z, before, best_worst


@helper
def _pair_point(ids: Int64, ray: Float, i: int, j: int, camera: Float) -> tuple[float, float, float, bool]:
    """Compute the middle of the shortest link between two viewing lines, and test if it is before both."""
    ci = ids[i]
    cj = ids[j]
    ox = camera[cj, 9] - camera[ci, 9]
    oy = camera[cj, 10] - camera[ci, 10]
    oz = camera[cj, 11] - camera[ci, 11]
    dot = ray[i, 3] * ray[j, 3] + ray[i, 4] * ray[j, 4] + ray[i, 5] * ray[j, 5]
    p = ray[i, 3] * ox + ray[i, 4] * oy + ray[i, 5] * oz
    q = ray[j, 3] * ox + ray[j, 4] * oy + ray[j, 5] * oz
    scale = 1.0 / (ray[i, 6] * ray[j, 6] - dot * dot)
    s = (p * ray[j, 6] - q * dot) * scale
    t = (p * dot - q * ray[i, 6]) * scale
    return (
        0.5 * (camera[ci, 9] + camera[cj, 9] + s * ray[i, 3] + t * ray[j, 3]),
        0.5 * (camera[ci, 10] + camera[cj, 10] + s * ray[i, 4] + t * ray[j, 4]),
        0.5 * (camera[ci, 11] + camera[cj, 11] + s * ray[i, 5] + t * ray[j, 5]),
        s > 0.0 and t > 0.0,
    )


@helper
def _agreed(count: int, total: float, gate2: float) -> bool:
    """Test agreement: two views have only their epipolar distance, one degree of freedom for both errors."""
    return count > 2 or (count == 2 and total <= gate2)


@helper
def _rivalled(
    ids: Int64,
    ray: Float,
    views: int,
    used: Bool,
    camera: Float,
    pairs: Int64,
    n_pairs: int,
    gate2: float,
    cos2_min: float,
) -> bool:
    """Test if another pair agrees on a place that is not that of the two used views (twice the gate away)."""
    for p in range(n_pairs):
        i = pairs[p, 0]
        j = pairs[p, 1]
        if (used[i] and used[j]) or not _pair_parallax(ray, i, j, cos2_min):
            continue
        x, y, z, front = _pair_point(ids, ray, i, j, camera)
        if not front:
            continue
        if _chi2(ids, ray, i, camera, x, y, z) + _chi2(ids, ray, j, camera, x, y, z) > gate2:
            continue
        for k in range(views):
            if used[k] and _chi2(ids, ray, k, camera, x, y, z) > 4.0 * gate2:
                return True
    return False


@helper
def _consensus(
    ids: Int64,
    ray: Float,
    views: int,
    used: Bool,
    camera: Float,
    pairs: Int64,
    n_pairs: int,
    gate2: float,
    cos2_min: float,
    min_views: int,
) -> tuple[float, float, float, int]:
    """Find the best point of all pairs of views by truncated cost over all views; refine it on inliers."""
    best = math.inf
    bx = by = bz = 0.0
    wide = False
    for p in range(n_pairs):
        i = pairs[p, 0]
        j = pairs[p, 1]
        if not _pair_parallax(ray, i, j, cos2_min):
            continue
        wide = True
        x, y, z, front = _pair_point(ids, ray, i, j, camera)
        if not front:
            continue
        cost = 0.0
        for k in range(views):
            cost += min(_chi2(ids, ray, k, camera, x, y, z), gate2)
            if cost >= best:
                break
        if cost < best:
            best = cost
            bx = x
            by = y
            bz = z
    if not wide:
        return bx, by, bz, LOW_PARALLAX
    if best == math.inf:
        return bx, by, bz, REJECTED
    for k in range(views):
        used[k] = _chi2(ids, ray, k, camera, bx, by, bz) <= gate2
    changed = True
    count = 0
    total = 0.0
    for _ in range(4):
        if not _parallax(ray, used, views, cos2_min):
            return bx, by, bz, REJECTED
        bx, by, bz, total, _worst = _refine(ids, ray, views, used, camera, (bx, by, bz), math.inf)
        changed = False
        count = 0
        for k in range(views):
            inside = _chi2(ids, ray, k, camera, bx, by, bz) <= gate2
            changed = changed or inside != used[k]
            used[k] = inside
            count += inside
        if not changed:
            break
    if changed or count < min_views or not _agreed(count, total, gate2):
        return bx, by, bz, REJECTED
    # Two views that agree by chance look like two that are right. They count only without a rival pair.
    if count == 2 and _rivalled(ids, ray, views, used, camera, pairs, n_pairs, gate2, cos2_min):
        return bx, by, bz, REJECTED
    return bx, by, bz, OK


@helper
def _robust(
    ids: Int64,
    ray: Float,
    views: int,
    used: Bool,
    camera: Float,
    pairs: Int64,
    n_pairs: int,
    gate2: float,
    cos2_min: float,
    min_views: int,
) -> tuple[float, float, float, int]:
    """Fit all views by least squares if all agree, else the inliers of the best pair's point."""
    if not _parallax(ray, used, views, cos2_min):
        return 0.0, 0.0, 0.0, LOW_PARALLAX
    start = _midpoint(ids, ray, views, camera)
    x, y, z, total, worst = _refine(ids, ray, views, used, camera, start, views * gate2)
    if worst <= gate2 and _agreed(views, total, gate2):
        return x, y, z, OK
    return _consensus(ids, ray, views, used, camera, pairs, n_pairs, gate2, cos2_min, min_views)


@helper
def _in_front(ids: Int64, views: int, camera: Float, x: float, y: float, z: float) -> bool:
    """Test if the point lies in front of every view's camera."""
    behind = 0
    for k in range(views):
        behind += not _project(camera, ids[k], x, y, z)[2] > 0.0
    return behind == 0


@helper
def _sandwich(inverse: Symmetric, middle: Symmetric) -> Symmetric:
    """Compute the product H^-1 M H^-1 of symmetric matrices, given H^-1."""
    xx, xy, xz, yy, yz, zz = inverse
    # The product is symmetric, so its columns are those of H^-1 taken twice through the middle.
    c0 = _times(inverse, _times(middle, (xx, xy, xz)))
    c1 = _times(inverse, _times(middle, (xy, yy, yz)))
    c2 = _times(inverse, _times(middle, (xz, yz, zz)))
    return c0[0], c0[1], c0[2], c1[1], c1[2], c2[2]


@helper
def _describe(
    n: int,
    method: int,
    ids: Int64,
    ray: Float,
    views: int,
    camera: Float,
    focal: Float,
    x: float,
    y: float,
    z: float,
    inlier: Bool,
    residual_px: Float,
) -> Symmetric:
    """Write the residuals of one joint-frame and return its covariance H^-1 M H^-1.

    To first order, every method solves sum J'V(r + J dX) = 0 with its own weight V of a view's image
    residual r. So with H = sum J'VJ, the noise S of the views gives M = sum J'VSVJ.
    """
    h = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    m = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for k in range(views):
        c = ids[k]
        u, v, depth = _project(camera, c, x, y, z)
        if not depth > 0.0:
            residual_px[n, c] = math.inf
            continue
        inverse = 1.0 / depth
        u *= inverse
        v *= inverse
        residual_px[n, c] = focal[c] * math.sqrt((u - ray[k, 0]) ** 2 + (v - ray[k, 1]) ** 2)
        if not inlier[n, c]:
            continue
        p, q = _jacobian(camera, c, u, v, inverse)
        if method == ROBUST:
            a, b, d = _information(ray, k, inverse)
            h = _add_quadratic(h, a, b, d, p, q)
            continue
        # The distance to the line is z times the part of (r, 0) across the direction (u, v, 1). DLT minimises
        # its square, too, without the confidence.
        scale = depth * depth
        if method == MIDPOINT:
            scale *= ray[k, 2]
        across = scale / ray[k, 6]
        a = scale - across * u * u
        b = -across * u * v
        d = scale - across * v * v
        at = inverse * inverse
        sa = ray[k, 7] + ray[k, 10] * at
        sb = ray[k, 8] + ray[k, 11] * at
        sd = ray[k, 9] + ray[k, 12] * at
        # V S V of symmetric 2x2 matrices
        ea = a * sa + b * sb
        eb = a * sb + b * sd
        fa = b * sa + d * sb
        fb = b * sb + d * sd
        h = _add_quadratic(h, a, b, d, p, q)
        m = _add_quadratic(m, ea * a + eb * b, ea * b + eb * d, fa * b + fb * d, p, q)
    spread = _inverse(h)
    if method == ROBUST:
        return spread
    return _sandwich(spread, m)


@cached
def triangulate_range(
    first: int, last: int, views: ViewArrays, gates: Gates, found: TriangulationArrays
) -> None:
    """Triangulate the joint-frames first <= n < last."""
    rays, weight, pose_index, position, rotation, focal, pixel_sigma, pose_sigma = views
    method, min_views, cos2_min, gate2, pair_table, pair_count = gates
    points, inlier, status, covariance, count, residual_px = found
    n_cameras = weight.shape[1]
    describe = covariance.shape[0] > 0
    camera = np.empty((n_cameras, 14))
    posed = np.empty(n_cameras, np.bool_)
    ids = np.empty(n_cameras, np.int64)
    ray = np.empty((n_cameras, 13))
    used = np.empty(n_cameras, np.bool_)
    pixel_variance = (pixel_sigma / focal) ** 2
    loaded = -1
    origin = (0.0, 0.0, 0.0)
    for n in range(first, last):
        if pose_index[n] != loaded:
            loaded = pose_index[n]
            origin = _load_cameras(position, rotation, pose_sigma, loaded, camera, posed)
        seen, detected = _load_views(rays, weight, n, camera, posed, ids, ray)
        if describe or method == ROBUST:
            _load_noise(ids, ray, seen, camera, pixel_variance)
        x = y = z = math.nan
        if detected == 0:
            outcome = NOT_DETECTED
        elif detected < min_views:
            outcome = FEW_VIEWS
        elif seen < min_views:
            outcome = NO_POSE
        else:
            for k in range(seen):
                used[k] = True
            outcome = OK
            if method == ROBUST:
                x, y, z, outcome = _robust(
                    ids, ray, seen, used, camera, pair_table[seen], pair_count[seen], gate2, cos2_min,
                    min_views,
                )  # fmt: skip
            elif not _parallax(ray, used, seen, cos2_min):
                outcome = LOW_PARALLAX
            else:
                if method == MIDPOINT:
                    x, y, z = _midpoint(ids, ray, seen, camera)
                else:
                    x = points[n, 0] - origin[0]
                    y = points[n, 1] - origin[1]
                    z = points[n, 2] - origin[2]
                if not _in_front(ids, seen, camera, x, y, z):
                    outcome = REJECTED
        status[n] = outcome
        for c in range(n_cameras):
            inlier[n, c] = False
        if outcome == OK:
            points[n, 0] = x + origin[0]
            points[n, 1] = y + origin[1]
            points[n, 2] = z + origin[2]
            for k in range(seen):
                inlier[n, ids[k]] = used[k]
        else:
            points[n, :] = math.nan
        if describe:
            residual_px[n, :] = math.nan
            total = 0
            if outcome == OK:
                s = _describe(n, method, ids, ray, seen, camera, focal, x, y, z, inlier, residual_px)
                covariance[n, 0, 0] = s[0]
                covariance[n, 0, 1] = covariance[n, 1, 0] = s[1]
                covariance[n, 0, 2] = covariance[n, 2, 0] = s[2]
                covariance[n, 1, 1] = s[3]
                covariance[n, 1, 2] = covariance[n, 2, 1] = s[4]
                covariance[n, 2, 2] = s[5]
                for k in range(seen):
                    total += used[k]
            else:
                covariance[n, :, :] = math.nan
            count[n] = total


# --- the common motion of a picture's joints -----------------------------------------------------------


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
def _seen(rays: Float, weight: Float, n: int, c: int) -> bool:
    return weight[n, c] > 0.0 and math.isfinite(weight[n, c] + rays[n, c, 0] + rays[n, c, 1])


@cached
def move_pictures(
    order: Int64,
    starts: Int64,
    fewest: int,
    points: Float,
    rays: Float,
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

    `order` [N], `starts` [P + 1]; `points` [N, 3] m in the world, NaN where there is none; `rays` [N, C, 2]
    normalised, NaN or of weight 0 where unseen; `weight` [N, C]; `pose_index` [N] into `position` [F, C, 3] m
    and `rotation` [F, C, 3, 3] world_from_camera, NaN without a pose. Written: `moved` [N, C, 2], which
    starts as a copy of `rays`, and `judged` [N, C], which starts as False.
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
                if not _seen(rays, weight, n, c):
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
                u[count] = right / depth - rays[n, c, 0]
                v[count] = down / depth - rays[n, c, 1]
                count += 1
            if count < fewest:
                continue
            shift_u = _median(u, count)
            shift_v = _median(v, count)
            for k in range(starts[p], starts[p + 1]):
                n = order[k]
                if _seen(rays, weight, n, c):
                    moved[n, c, 0] = rays[n, c, 0] + shift_u
                    moved[n, c, 1] = rays[n, c, 1] + shift_v
                    judged[n, c] = True
