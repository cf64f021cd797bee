"""Detections of one frame as rays: distance between two of them, and place of a group."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.compilation import helper

Int64 = NDArray[np.int64]

# A pair of detections without history is one person within 3 sigma.
_AGREE_CHI2 = 9.0
# Beyond 10 sigma the penalty does not grow.
_MAX_CHI2 = 100.0
# A pair with this many common joints has half the weight of a complete one.
FEW_JOINTS = 3.0
# Rays of one body pass within this: joint definitions, swaps of left and right, blur.
_SAME_BODY_M = 0.05
_SIZE_M = (0.03, 1.5)  # median distance of joints from their middle: 0.4 m for an adult, 0.06 for a face
# The log's point (a tag, a phone, the hip) lies this far from the joints of a body.
_LOGGED_POINT_M = 0.5
# Logs with a larger standard deviation do not tell apart people who stand together.
_EXACT_LOG_M = 0.5
# As _LOGGED_POINT_M: the noise of such a log is estimated from bodies, and contains some of it.
_EXACT_POINT_M = 0.3


class Nodes(NamedTuple):
    """Detections of one frame, cameras in order, left to right within a camera: arrays of room N."""

    camera: Int64  # [N]
    detection: Int64  # [N] index into D
    points: Float  # [N, J, 2] normalised picture, NaN where not seen
    rays: Float  # [N, J, 3] unit, world
    size: Float  # [N] median distance of joints from their middle, normalised picture
    whole: Bool  # [N] enough joints for `size` to mean something
    weight: Float  # [N, N] 3^2 - s^2, 0 where a pair cannot be compared
    known: Float  # [N, S] 0..1, continuity of the node with each track's last picture
    bond: Float  # [N, S + N] the same relative to the best other track, -1..1
    barred: Bool  # [N, S] the node continues another person than the track
    label: Int64  # [N] track slot, or S + i for a group without a track
    member: Int64  # [S + N, C] node of each label in each camera, -1 none


def empty_nodes(room: int, slots: int, cameras: int, joints: int) -> Nodes:
    """Allocate arrays for the detections of any frame; the logged people are one more camera."""
    return Nodes(
        camera=np.zeros(room, np.int64),
        detection=np.zeros(room, np.int64),
        points=np.zeros((room, joints, 2)),
        rays=np.zeros((room, joints, 3)),
        size=np.zeros(room),
        whole=np.zeros(room, np.bool_),
        weight=np.zeros((room, room)),
        known=np.zeros((room, slots)),
        bond=np.zeros((room, slots + room)),
        barred=np.zeros((room, slots), np.bool_),
        label=np.zeros(room, np.int64),
        member=np.zeros((slots + room, cameras + 1), np.int64),
    )


@helper
def median_of(values: Float, count: int) -> float:
    """Return the median of the first `count` values, which are sorted in place."""
    for i in range(1, count):
        value = values[i]
        j = i - 1
        while j >= 0 and values[j] > value:
            values[j + 1] = values[j]
            j -= 1
        values[j + 1] = value
    half = count // 2
    return float(values[half] if count % 2 else 0.5 * (values[half - 1] + values[half]))


@helper
def _seen(xy: Float, confidence: float) -> bool:
    return confidence > 0.0 and math.isfinite(xy[0]) and math.isfinite(xy[1])


@helper
def collect_nodes(
    nodes: Nodes,
    xy: Float,
    confidence: Float,
    rotation: Float,
    sigma: Float,
    needed: int,
    scratch: Float,
) -> int:
    """Fill in the usable detections and return their number.

    Their order depends on their place in the picture and not on the order of the input. So all ties and
    roundings below do not depend on the order of the input either.
    """
    cameras, detections, joints = confidence.shape
    key = np.empty((detections, 2))
    n = 0
    for c in range(cameras):
        if math.isnan(sigma[c]):
            continue
        for d in range(detections):
            count = 0
            key[d, 0] = key[d, 1] = 0.0
            for j in range(joints):
                if _seen(xy[c, d, j], confidence[c, d, j]):
                    count += 1
                    key[d, 0] += xy[c, d, j, 0]
                    key[d, 1] += xy[c, d, j, 1]
            key[d, 0] = key[d, 0] / count if count >= needed else np.inf
            key[d, 1] = key[d, 1] / max(count, 1)
        for _ in range(detections):
            first = 0
            for d in range(1, detections):
                if key[d, 0] < key[first, 0] or (key[d, 0] == key[first, 0] and key[d, 1] < key[first, 1]):
                    first = d
            if key[first, 0] == np.inf:
                break
            key[first, 0] = np.inf
            nodes.camera[n] = c
            nodes.detection[n] = first
            _describe(nodes, n, xy[c, first], confidence[c, first], rotation[c], scratch)
            n += 1
    return n


@helper
def _describe(nodes: Nodes, n: int, xy: Float, confidence: Float, rotation: Float, scratch: Float) -> None:
    """Compute the points, rays and size of one detection."""
    middle = np.empty(2)
    for axis in range(2):
        count = 0
        for j in range(len(confidence)):
            if _seen(xy[j], confidence[j]):
                scratch[count] = xy[j, axis]
                count += 1
        middle[axis] = median_of(scratch, count)
    count = 0
    for j in range(len(confidence)):
        if not _seen(xy[j], confidence[j]):
            nodes.points[n, j] = np.nan
            continue
        u, v = xy[j, 0], xy[j, 1]
        nodes.points[n, j, 0] = u
        nodes.points[n, j, 1] = v
        length = math.sqrt(u * u + v * v + 1.0)
        for axis in range(3):
            nodes.rays[n, j, axis] = (
                rotation[axis, 0] * u + rotation[axis, 1] * v + rotation[axis, 2]
            ) / length
        scratch[count] = math.hypot(u - middle[0], v - middle[1])
        count += 1
    nodes.whole[n] = count >= 5
    nodes.size[n] = median_of(scratch, count)


@helper
def add_logged_nodes(nodes: Nodes, n: int, cameras: int, logs: Float) -> int:
    """Add the people who are logged [A, 4] now as detections of one more camera, which has no picture."""
    for person in range(len(logs)):
        if math.isnan(logs[person, 0]):
            continue
        nodes.camera[n] = cameras
        nodes.detection[n] = person
        for j in range(nodes.points.shape[1]):
            nodes.points[n, j, 0] = nodes.points[n, j, 1] = np.nan
        n += 1
    return n


@helper
def compare_nodes(
    nodes: Nodes, n: int, position: Float, sigma: Float, logs: Float, needed: int, scratch: Float
) -> float:
    """Weigh every pair of detections of different cameras and return the smallest s (NaN without a pair).

    A pair with few common joints has less weight: if a detector splits one person in two, the body wins
    over the loose leg.
    """
    nearest = np.inf
    for a in range(n):
        for b in range(a):
            weight = 0.0
            if nodes.camera[a] == nodes.camera[b]:
                pass
            elif nodes.camera[a] == len(sigma):
                log = logs[nodes.detection[a]]
                weight = _AGREE_CHI2 - _distance_from_log(nodes, b, position, sigma, log, scratch)
            else:
                square, joints = _disagreement(nodes, a, b, position, sigma, scratch)
                if joints >= needed:
                    weight = (_AGREE_CHI2 - square) * joints / (joints + FEW_JOINTS)
                    nearest = min(nearest, square)
            nodes.weight[a, b] = weight
            nodes.weight[b, a] = weight
    return math.sqrt(nearest) if nearest < np.inf else math.nan


@helper
def _disagreement(
    nodes: Nodes, a: int, b: int, position: Float, sigma: Float, squares: Float
) -> tuple[float, int]:
    """Compute the mean squared, whitened ray distance over the better three quarters of the common joints.

    Two rays o + z d pass each other along n = d_a x d_b, at depths that follow from n (Hartley & Zisserman
    12.1, the midpoint's); an angular error sigma moves a ray by sigma z along n. Joints with almost parallel
    rays, which have no usable depth, do not count. Also returns the number of joints that count.
    """
    ca, cb = nodes.camera[a], nodes.camera[b]
    bx = position[cb, 0] - position[ca, 0]
    by = position[cb, 1] - position[ca, 1]
    bz = position[cb, 2] - position[ca, 2]
    least = 4.0 * (sigma[ca] ** 2 + sigma[cb] ** 2)
    check_size = nodes.whole[a] and nodes.whole[b]
    count = 0
    for j in range(nodes.points.shape[1]):
        if math.isnan(nodes.points[a, j, 0]) or math.isnan(nodes.points[b, j, 0]):
            continue
        px, py, pz = nodes.rays[a, j, 0], nodes.rays[a, j, 1], nodes.rays[a, j, 2]
        qx, qy, qz = nodes.rays[b, j, 0], nodes.rays[b, j, 1], nodes.rays[b, j, 2]
        nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
        sine2 = nx * nx + ny * ny + nz * nz
        if sine2 <= max(least, 1e-12):
            continue
        za = ((by * qz - bz * qy) * nx + (bz * qx - bx * qz) * ny + (bx * qy - by * qx) * nz) / sine2
        zb = ((by * pz - bz * py) * nx + (bz * px - bx * pz) * ny + (bx * py - by * px) * nz) / sine2
        possible = za > 0.0 and zb > 0.0
        if possible and check_size:
            small, large = za * nodes.size[a], zb * nodes.size[b]
            possible = min(small, large) > _SIZE_M[0] and max(small, large) < _SIZE_M[1]
        square = _MAX_CHI2
        if possible:
            distance2 = (bx * nx + by * ny + bz * nz) ** 2 / sine2
            variance = (sigma[ca] * za) ** 2 + (sigma[cb] * zb) ** 2 + _SAME_BODY_M**2
            square = min(distance2 / variance, _MAX_CHI2)
        squares[count] = square
        count += 1
    if count == 0:
        return _MAX_CHI2, 0
    median_of(squares, count)
    kept = max(1, (3 * count) // 4)
    total = 0.0
    for i in range(kept):
        total += squares[i]
    return total / kept, count


@helper
def _distance_from_log(
    nodes: Nodes, a: int, position: Float, sigma: Float, log: Float, squares: Float
) -> float:
    """Compute the median over joints of the squared, whitened distance of the logged actor from the ray."""
    c = nodes.camera[a]
    count = 0
    point_m = _EXACT_POINT_M if log[3] <= _EXACT_LOG_M else _LOGGED_POINT_M
    for j in range(nodes.points.shape[1]):
        if math.isnan(nodes.points[a, j, 0]):
            continue
        depth = range2 = 0.0
        for axis in range(3):
            sight = log[axis] - position[c, axis]
            depth += sight * nodes.rays[a, j, axis]
            range2 += sight * sight
        squares[count] = _MAX_CHI2
        if depth > 0.0:
            square = (range2 - depth * depth) / ((sigma[c] * depth) ** 2 + log[3] ** 2 + point_m**2)
            squares[count] = min(square, _MAX_CHI2)
        count += 1
    return median_of(squares, count)


@helper
def size_of_group(nodes: Nodes, label: int) -> int:
    """Count the detections of a group, the log included."""
    size = 0
    for c in range(nodes.member.shape[1]):
        if nodes.member[label, c] >= 0:
            size += 1
    return size


@helper
def views_of_group(nodes: Nodes, label: int) -> int:
    """Count the cameras in a group; the log, in the last column, does not count."""
    return size_of_group(nodes, label) - (1 if nodes.member[label, -1] >= 0 else 0)


@helper
def put_into_group(nodes: Nodes, a: int, label: int) -> None:
    """Put a detection into a group."""
    nodes.label[a] = label
    nodes.member[label, nodes.camera[a]] = a


@helper
def place_group(
    nodes: Nodes, label: int, position: Float, sigma: Float, middle: Float, scratch: Float
) -> float:
    """Compute the middle of a group's joints and return its standard deviation (m), NaN without two views.

    Each joint is the point nearest to its rays by least squares. The middle is the median over joints, axis
    by axis, so that outliers do not move it.
    """
    cameras, joints = len(sigma), nodes.points.shape[1]
    found = np.empty((joints, 3))
    normal, target, sight = np.empty(6), np.empty(3), np.empty(3)
    count = 0
    for j in range(joints):
        normal[:] = 0.0
        target[:] = 0.0
        views = 0
        for c in range(cameras):
            a = nodes.member[label, c]
            if a >= 0 and not math.isnan(nodes.points[a, j, 0]):
                views += 1
                _add_ray(normal, target, nodes.rays[a, j], position[c], 1.0 / sigma[c] ** 2)
        if views > 1 and _solve(normal, target, found[count]) >= 0.0:
            count += 1
    if count == 0:
        return math.nan
    for axis in range(3):
        for i in range(count):
            scratch[i] = found[i, axis]
        middle[axis] = median_of(scratch, count)
    normal[:] = 0.0
    for c in range(cameras):
        if nodes.member[label, c] >= 0:
            range2 = 0.0
            for axis in range(3):
                sight[axis] = middle[axis] - position[c, axis]
                range2 += sight[axis] ** 2
            reach = max(math.sqrt(range2), 1e-6)
            for axis in range(3):
                sight[axis] /= reach
            _add_ray(normal, target, sight, position[c], 1.0 / (sigma[c] * reach) ** 2)
    variance = _solve(normal, target, found[0])
    return math.sqrt(variance / 3.0) if variance >= 0.0 else math.nan


@helper
def _add_ray(normal: Float, target: Float, ray: Float, origin: Float, weight: float) -> None:
    """Add w (I - r r') to the upper triangle of the normal matrix and w (I - r r') o to its right side."""
    along = ray[0] * origin[0] + ray[1] * origin[1] + ray[2] * origin[2]
    i = 0
    for row in range(3):
        target[row] += weight * (origin[row] - along * ray[row])
        for column in range(row, 3):
            normal[i] += weight * ((1.0 if row == column else 0.0) - ray[row] * ray[column])
            i += 1


@helper
def _solve(normal: Float, target: Float, solution: Float) -> float:
    """Solve the 3x3 system by its adjugate and return the trace of the inverse, -1 if it is singular."""
    xx, xy, xz, yy, yz, zz = normal[0], normal[1], normal[2], normal[3], normal[4], normal[5]
    ax, ay, az = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    by, bz, cz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * ax + xy * ay + xz * az
    if determinant <= 1e-9 * ((xx + yy + zz) / 3.0) ** 3:
        return -1.0
    solution[0] = (ax * target[0] + ay * target[1] + az * target[2]) / determinant
    solution[1] = (ay * target[0] + by * target[1] + bz * target[2]) / determinant
    solution[2] = (az * target[0] + bz * target[1] + cz * target[2]) / determinant
    return float((ax + by + cz) / determinant)
