"""Compiled kernels of the triangulation; `triangulation` is their only user and explains the methods.

Rows by camera: `camera` has 0-8 the world_from_camera rotation by rows and 9-11 the centre, in a world moved
to the mean centre; `view` has 0-1 the image point, 2-4 its direction in the world (depth 1), 5 the squared
length of that, and the covariance of the image point, 6-8 from pixels and rotation, 9-11 from the position
for depth 1. Symmetric 3x3 matrices are the six numbers xx, xy, xz, yy, yz, zz.
"""

import math

from pipelines.geometry.arrays import Bool, Float, Int8, Int64
from pipelines.geometry.compilation import cached, helper

Vector = tuple[float, float, float]
Symmetric = tuple[float, float, float, float, float, float]

# Indices of triangulation.STATUS.
OK, FEW_VIEWS, LOW_PARALLAX, REJECTED, NOT_DETECTED, NO_POSE = 0, 2, 3, 4, 5, 6

# Rays that leave a direction open are taken to determine it by this share of what they determine in all.
LEAST_INFORMATION = 1e-12
# A determinant of a normal matrix of trace 1 that rounding alone can make.
LEAST_DETERMINANT = 3.0 * 2.0**-52

# Squared length, in standard deviations of the point, below which a Gauss-Newton step is the last one.
# Measured on the walk at 5 views, the remaining error is at most 3e-4 standard deviations for pixel noise
# and 0.1 for 0.5 m / 2 deg (where the covariance changes with the depth); one step more would cost 40 %.
CONVERGED = 1e-2
# Shortened steps count as well, so that the loop always ends.
MAX_STEPS = 10


@helper
def _are_apart(view: Float, i: int, j: int, cos2_min: float) -> bool:
    """Test if two viewing lines differ by more than the least parallax (opposite directions do not)."""
    dot = view[i, 2] * view[j, 2] + view[i, 3] * view[j, 3] + view[i, 4] * view[j, 4]
    differ: bool = dot * dot < cos2_min * view[i, 5] * view[j, 5]
    return differ


@helper
def _image_covariance(view: Float, pixel: float, shift: float, turn: float) -> None:
    """Write the covariances of an image point: from pixels and rotation; and from position at depth 1.

    The image moves by J t under a shift t and by L w under a turn w of the camera, with the interaction
    matrices J = [1 0 -x; 0 1 -y]/z and L = [xy, -1-x^2, y; 1+y^2, -xy, -x] (Chaumette and Hutchinson
    2006, eq. 11).
    """
    x = view[0]
    y = view[1]
    xx = 1.0 + x * x
    yy = 1.0 + y * y
    cross = x * y
    view[6] = pixel + turn * (cross * cross + xx * xx + y * y)
    view[7] = turn * cross * (xx + yy - 1.0)
    view[8] = pixel + turn * (cross * cross + yy * yy + x * x)
    view[9] = shift * xx
    view[10] = shift * cross
    view[11] = shift * yy


@helper
def _closest_point(view: Float, weight: Float, seen: Bool, camera: Float) -> Vector:
    """Compute the point closest to the seen viewing lines: sum w^2 (I - d d') (X - c) = 0."""
    xx = xy = xz = yy = yz = zz = 0.0
    gx = gy = gz = 0.0
    for c in range(len(seen)):
        if not seen[c]:
            continue
        w = weight[c] * weight[c]
        a, b, d = view[c, 2], view[c, 3], view[c, 4]
        x, y, z = camera[c, 9], camera[c, 10], camera[c, 11]
        by = w / view[c, 5]
        along = by * (a * x + b * y + d * z)
        xx += w - by * a * a
        xy -= by * a * b
        xz -= by * a * d
        yy += w - by * b * b
        yz -= by * b * d
        zz += w - by * d * d
        gx += w * x - along * a
        gy += w * y - along * b
        gz += w * z - along * d
    trace = xx + yy + zz
    more = LEAST_INFORMATION * trace
    for _ in range(2):
        c0 = yy * zz - yz * yz
        c1 = xz * yz - xy * zz
        c2 = xy * yz - xz * yy
        determinant = xx * c0 + xy * c1 + xz * c2
        if determinant > LEAST_DETERMINANT * trace * trace * trace:
            break
        xx += more
        yy += more
        zz += more
    scale = 1.0 / determinant
    return (
        scale * (c0 * gx + c1 * gy + c2 * gz),
        scale * (c1 * gx + (xx * zz - xz * xz) * gy + (xy * xz - xx * yz) * gz),
        scale * (c2 * gx + (xy * xz - xx * yz) * gy + (xx * yy - xy * xy) * gz),
    )


@cached
def prepare(
    rays: Float,
    weight: Float,
    pixel: Float,
    pose_sigma: Float,
    pose_index: Int64,
    known: Bool,
    camera: Float,
    cos2_min: float,
    view: Float,
    seen: Bool,
    point: Float,
    status: Int8,
) -> None:
    """Write what all methods need: rows of views, usable views, the points closest to them, and statuses.

    `rays`, `weight`, `pose_sigma`, `pose_index` are those of `triangulation.Views`, `pixel` [C] the variance
    of an image point of confidence 1, `known` [F, C] where `camera` [F, C, 12] has a pose. `view` [N, C, 12],
    `seen` [N, C], `point` [N, 3] (0 where the status is not OK) and `status` [N] are written.
    """
    for n in range(len(status)):
        f = pose_index[n]
        detected = usable = 0
        for c in range(len(pixel)):
            x = rays[n, c, 0]
            y = rays[n, c, 1]
            w = weight[n, c]
            found = w > 0.0 and math.isfinite(w) and math.isfinite(x) and math.isfinite(y)
            seen[n, c] = found and known[f, c]
            detected += found
            usable += seen[n, c]
            if not seen[n, c]:  # what numpy computes of it stays finite
                x = y = 0.0
                w = 1.0
            row = view[n, c]
            row[0] = x
            row[1] = y
            for axis in range(3):
                of = camera[f, c, 3 * axis : 3 * axis + 3]
                row[2 + axis] = of[0] * x + of[1] * y + of[2]
            row[5] = x * x + y * y + 1.0
            _image_covariance(row, pixel[c] / (w * w), pose_sigma[f, c, 0] ** 2, pose_sigma[f, c, 1] ** 2)
        wide = False
        for i in range(len(pixel)):
            for j in range(i + 1, len(pixel)):
                wide = wide or (seen[n, i] and seen[n, j] and _are_apart(view[n], i, j, cos2_min))
        if detected == 0:
            status[n] = NOT_DETECTED
        elif detected < 2:
            status[n] = FEW_VIEWS
        elif usable < 2:
            status[n] = NO_POSE
        elif not wide:
            status[n] = LOW_PARALLAX
        else:
            point[n] = _closest_point(view[n], weight[n], seen[n], camera[f])
            status[n] = OK


@helper
def _project(camera: Float, x: float, y: float, z: float) -> Vector:
    """Transform a point to the frame of a camera, whose row is given."""
    dx = x - camera[9]
    dy = y - camera[10]
    dz = z - camera[11]
    return (
        camera[0] * dx + camera[3] * dy + camera[6] * dz,
        camera[1] * dx + camera[4] * dy + camera[7] * dz,
        camera[2] * dx + camera[5] * dy + camera[8] * dz,
    )


@helper
def _information(view: Float, inverse_depth: float) -> Vector:
    """Compute the inverse of the image point's covariance for a point at that depth."""
    at = inverse_depth * inverse_depth
    a = view[6] + view[9] * at
    b = view[7] + view[10] * at
    d = view[8] + view[11] * at
    scale = 1.0 / (a * d - b * b)
    return d * scale, -b * scale, a * scale


@helper
def _chi2(view: Float, camera: Float, x: float, y: float, z: float) -> float:
    """Compute the squared whitened reprojection error of a view, infinite behind its camera."""
    u, v, depth = _project(camera, x, y, z)
    if not depth > 0.0:
        return math.inf
    inverse = 1.0 / depth
    a, b, d = _information(view, inverse)
    ru = u * inverse - view[0]
    rv = v * inverse - view[1]
    chi2: float = a * ru * ru + 2.0 * b * ru * rv + d * rv * rv
    return chi2


@helper
def _linearise(
    view: Float, used: Bool, camera: Float, x: float, y: float, z: float
) -> tuple[float, float, Symmetric, Vector]:
    """Linearise the used views: sum and largest of the squared whitened errors, normal matrix, gradient."""
    xx = xy = xz = yy = yz = zz = 0.0
    gx = gy = gz = 0.0
    total = worst = 0.0
    for c in range(len(used)):
        if not used[c]:
            continue
        u, v, depth = _project(camera[c], x, y, z)
        if not depth > 0.0:
            total = worst = math.inf
            break
        inverse = 1.0 / depth
        u *= inverse
        v *= inverse
        a, b, d = _information(view[c], inverse)
        ru = u - view[c, 0]
        rv = v - view[c, 1]
        au = a * ru + b * rv
        av = b * ru + d * rv
        chi2 = ru * au + rv * av
        total += chi2
        worst = max(worst, chi2)
        # The derivatives of u and v by the point, and those weighted.
        px = (camera[c, 0] - u * camera[c, 2]) * inverse
        py = (camera[c, 3] - u * camera[c, 5]) * inverse
        pz = (camera[c, 6] - u * camera[c, 8]) * inverse
        qx = (camera[c, 1] - v * camera[c, 2]) * inverse
        qy = (camera[c, 4] - v * camera[c, 5]) * inverse
        qz = (camera[c, 7] - v * camera[c, 8]) * inverse
        xx += a * px * px + 2.0 * b * px * qx + d * qx * qx
        xy += a * px * py + b * (px * qy + qx * py) + d * qx * qy
        xz += a * px * pz + b * (px * qz + qx * pz) + d * qx * qz
        yy += a * py * py + 2.0 * b * py * qy + d * qy * qy
        yz += a * py * pz + b * (py * qz + qy * pz) + d * qy * qz
        zz += a * pz * pz + 2.0 * b * pz * qz + d * qz * qz
        gx += px * au + qx * av
        gy += py * au + qy * av
        gz += pz * au + qz * av
    return total, worst, (xx, xy, xz, yy, yz, zz), (gx, gy, gz)


@helper
def _refine(
    view: Float, used: Bool, camera: Float, start: Vector, hopeless: float
) -> tuple[float, float, float, float, float]:
    """Refine a point by Gauss-Newton, never to a worse one; return it, the cost and the largest term."""
    # It stops where the linear model predicts a cost above `hopeless`.
    x, y, z = start
    dx = dy = dz = 0.0
    before = math.inf
    best_worst = math.inf
    for _ in range(MAX_STEPS):
        total, worst, normal, gradient = _linearise(view, used, camera, x + dx, y + dy, z + dz)
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
        xx, xy, xz, yy, yz, zz = normal  # inverted by its cofactors
        gx, gy, gz = gradient
        c0 = yy * zz - yz * yz
        c1 = xz * yz - xy * zz
        c2 = xy * yz - xz * yy
        scale = -1.0 / (xx * c0 + xy * c1 + xz * c2)
        dx = scale * (c0 * gx + c1 * gy + c2 * gz)
        dy = scale * (c1 * gx + (xx * zz - xz * xz) * gy + (xy * xz - xx * yz) * gz)
        dz = scale * (c2 * gx + (xy * xz - xx * yz) * gy + (xx * yy - xy * xy) * gz)
        decrement = -(gx * dx + gy * dy + gz * dz)
        if not math.isfinite(decrement) or total - decrement > hopeless:
            return x, y, z, math.inf, math.inf
        if decrement <= CONVERGED:
            x += dx
            y += dy
            z += dz
            break
    return x, y, z, before, best_worst


@helper
def _pair_point(view: Float, i: int, j: int, camera: Float) -> tuple[float, float, float, bool]:
    """Compute the middle of the shortest link between two viewing lines, and test if it is before both."""
    ox = camera[j, 9] - camera[i, 9]
    oy = camera[j, 10] - camera[i, 10]
    oz = camera[j, 11] - camera[i, 11]
    dot = view[i, 2] * view[j, 2] + view[i, 3] * view[j, 3] + view[i, 4] * view[j, 4]
    p = view[i, 2] * ox + view[i, 3] * oy + view[i, 4] * oz
    q = view[j, 2] * ox + view[j, 3] * oy + view[j, 4] * oz
    scale = 1.0 / (view[i, 5] * view[j, 5] - dot * dot)
    s = (p * view[j, 5] - q * dot) * scale
    t = (p * dot - q * view[i, 5]) * scale
    return (
        0.5 * (camera[i, 9] + camera[j, 9] + s * view[i, 2] + t * view[j, 2]),
        0.5 * (camera[i, 10] + camera[j, 10] + s * view[i, 3] + t * view[j, 3]),
        0.5 * (camera[i, 11] + camera[j, 11] + s * view[i, 4] + t * view[j, 4]),
        s > 0.0 and t > 0.0,
    )


@helper
def _is_rivalled(view: Float, used: Bool, camera: Float, pairs: Int64, gate2: float, cos2_min: float) -> bool:
    """Test if another pair agrees on a place that is not that of the two used views (twice the gate away)."""
    for p in range(len(pairs)):
        i = pairs[p, 0]
        j = pairs[p, 1]
        if (used[i] and used[j]) or not _are_apart(view, i, j, cos2_min):
            continue
        x, y, z, front = _pair_point(view, i, j, camera)
        if not front:
            continue
        if _chi2(view[i], camera[i], x, y, z) + _chi2(view[j], camera[j], x, y, z) > gate2:
            continue
        for c in range(len(used)):
            if used[c] and _chi2(view[c], camera[c], x, y, z) > 4.0 * gate2:
                return True
    return False


@helper
def _consensus(
    view: Float, seen: Bool, used: Bool, camera: Float, pairs: Int64, gate2: float, cos2_min: float
) -> tuple[float, float, float, int]:
    """Find the best point of all pairs of views by truncated cost over all views; refine it on inliers."""
    best = math.inf
    bx = by = bz = 0.0
    for p in range(len(pairs)):
        i = pairs[p, 0]
        j = pairs[p, 1]
        if not _are_apart(view, i, j, cos2_min):
            continue
        x, y, z, front = _pair_point(view, i, j, camera)
        if not front:
            continue
        cost = 0.0
        for c in range(len(seen)):
            if seen[c]:
                cost += min(_chi2(view[c], camera[c], x, y, z), gate2)
                if cost >= best:
                    break
        if cost < best:
            best = cost
            bx = x
            by = y
            bz = z
    if best == math.inf:
        return bx, by, bz, REJECTED
    for c in range(len(seen)):
        used[c] = seen[c] and _chi2(view[c], camera[c], bx, by, bz) <= gate2
    changed = True
    count = 0
    total = 0.0
    for _ in range(4):
        wide = False
        for i in range(len(used)):
            for j in range(i + 1, len(used)):
                wide = wide or (used[i] and used[j] and _are_apart(view, i, j, cos2_min))
        if not wide:
            return bx, by, bz, REJECTED
        bx, by, bz, total, _worst = _refine(view, used, camera, (bx, by, bz), math.inf)
        changed = False
        count = 0
        for c in range(len(seen)):
            inside = seen[c] and _chi2(view[c], camera[c], bx, by, bz) <= gate2
            changed = changed or inside != used[c]
            used[c] = inside
            count += inside
        if not changed:
            break
    # Two views have only their epipolar distance, one degree of freedom for both errors.
    if changed or count < 2 or (count == 2 and total > gate2):
        return bx, by, bz, REJECTED
    # Two views that agree by chance look like two that are right. They count only without a rival pair.
    if count == 2 and _is_rivalled(view, used, camera, pairs, gate2, cos2_min):
        return bx, by, bz, REJECTED
    return bx, by, bz, OK


@cached
def fit_robustly(
    view: Float,
    camera: Float,
    pose_index: Int64,
    pairs_by_count: Int64,
    pair_count: Int64,
    gate2: float,
    cos2_min: float,
    point: Float,
    inlier: Bool,
    status: Int8,
) -> None:
    """Fit the joint-frames of status OK: all views by least squares if all agree, else the best inliers.

    `view` [N, C, 12] and `camera` [F, C, 12] are rows of the module, `pose_index` [N] the row of `camera`,
    `pairs_by_count` [m, k, 2] with `pair_count` [m] the pairs of m views that propose a point, `gate2` and
    `cos2_min` squares of the gate and of the cosine of the least parallax. `point` [N, 3], first the closest
    to the viewing lines, `inlier` [N, C], first the usable views, and `status` [N] become the result.
    """
    for n in range(len(status)):
        if status[n] != OK:
            continue
        cameras = camera[pose_index[n]]
        seen = inlier[n].copy()
        used = inlier[n]
        count = 0
        for c in range(len(seen)):
            count += seen[c]
        start = (point[n, 0], point[n, 1], point[n, 2])
        x, y, z, total, worst = _refine(view[n], used, cameras, start, count * gate2)
        if not worst <= gate2 or (count == 2 and total > gate2):
            pairs = pairs_by_count[count, : pair_count[count]].copy()
            number = 0
            for c in range(len(seen)):
                if seen[c]:  # the pairs count the seen views only
                    for p in range(len(pairs)):
                        for end in range(2):
                            if pairs_by_count[count, p, end] == number:
                                pairs[p, end] = c
                    number += 1
            x, y, z, status[n] = _consensus(view[n], seen, used, cameras, pairs, gate2, cos2_min)
        point[n, 0] = x
        point[n, 1] = y
        point[n, 2] = z
