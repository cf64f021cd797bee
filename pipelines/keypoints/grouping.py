"""Which detections of a frame are the same body, and which body is which over time.

Every frame is a small clustering problem: detections are nodes, a group holds at most one detection
of each camera, and the score of a partition adds, over all pairs inside a group,

    3^2 + known_a + known_b - s_ab^2

where s_ab is how many standard deviations the viewing rays of the pair's common joints pass each
other at, and known is 1 when the detection continues, in its own camera's picture, what the group's
track showed there last. Strangers must thus agree within 3 sigma; a known detection stays within 5,
unless another one of its camera fits better.

The sum of squares over a whole assignment matters: a pose error moves everybody in a picture alike, so
the assignment that keeps people apart wins even where one wrong pair happens to fit better than a right
one (exchanging two people costs 2 (their separation)^2 whatever the pose error is). A logged actor takes
part as the only detection of one more camera.

`follow` is the one function called from outside. All that is compiled stands in this module, because
numba's cache watches the file of the outermost function only.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.compilation import cached, helper

Float = NDArray[np.float64]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

_AGREE = 9.0  # a pair of detections without history is one person within 3 sigma
_KNOWN = 1.0  # each side of a pair that continues the track adds this; 8 locked wrong starts in for good
_LOYAL = 14.0  # on top, for leaving company for none: a known detection is refused beyond 5 sigma
_STAY = 4.0  # what continuing a track is worth to a detection that has no company
_CAP = 100.0  # beyond 10 sigma further is no more wrong
_FEW = 3.0  # common joints at which a pair has half the weight of a complete one
_BODY_M = 0.05  # rays that pass this near are one body: joint definitions, left/right swaps, blur
_SIZE_M = (0.03, 1.5)  # median distance of joints from their middle: 0.4 m for an adult, 0.06 for a face
_LOGGED_POINT_M = 0.5  # the log's point (a tag, a phone, the hip) against the joints of a body
_SURE = 0.3  # of the likeness 0..1 with a track's last picture: it is somebody known
_HOLD_S = 0.5  # how long a picture is worth comparing with a later one
_PACE_M_PER_S = 0.7  # random part of a walk, for taking up a track again
_BODY_RADIUS_M = 0.3  # the middle of a body depends on which joints are seen
_SPARE = 16  # tracks remembered beyond one for each possible detection


class Followed(NamedTuple):
    """Who each detection is: T times, C cameras, D detections."""

    track: Int64  # [T, C, D] number of the track, -1 where the detection was not usable
    views: Int64  # [T, C, D] cameras in the detection's group, itself included; 0 where not usable
    middle: Float  # [T, C, D, 3] m, middle of the group's joints, NaN without two views
    spread: Float  # [T, C, D] m, its standard deviation on each axis
    doubtful: Bool  # [T, C, D] another detection of the camera fits the group within one sigma as well
    overruled: Bool  # [T, C, D] taken although the picture's continuity pointed at another detection
    nearest: Float  # [T] the smallest disagreement of two detections (sigma), NaN without a pair


class Nodes(NamedTuple):
    """The detections of one frame, cameras in order, left to right within a camera: arrays of room N."""

    camera: Int64  # [N]
    detection: Int64  # [N] index into D
    points: Float  # [N, J, 2] normalised picture, NaN where not seen
    rays: Float  # [N, J, 3] unit, world
    size: Float  # [N] median distance of joints from their middle, normalised picture
    whole: Bool  # [N] enough joints for `size` to mean something
    weight: Float  # [N, N] 3^2 - s^2, 0 where nothing can be said
    known: Float  # [N, S] how well the node continues each track's last picture, 0..1
    bond: Float  # [N, S + N] the same relative to the best other track, -1..1
    barred: Bool  # [N, S] the node continues somebody else than the track
    label: Int64  # [N] track slot, or S + i for a group without a track
    member: Int64  # [S + N, C] node of each label in each camera, -1 none


class Tracks(NamedTuple):
    """What is remembered of the people so far: arrays of S slots."""

    identity: Int64  # [S] number of the track, -1 free
    views: Int64  # [S] camera-frames in company of another camera
    seen_s: Float  # [S] time of `middle`
    middle: Float  # [S, 3] m
    spread: Float  # [S] m
    held_s: Float  # [S, C] time of the picture held, -inf none
    held: Float  # [S, C, J, 2]
    apart: Bool  # [S, S] seen side by side in one picture: two people


@helper
def _median(values: Float, count: int) -> float:
    """Median of the first `count` values, which are sorted in place."""
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
def _collect(
    nodes: Nodes,
    xy: Float,
    confidence: Float,
    rotation: Float,
    sigma: Float,
    needed: int,
    scratch: Float,
) -> int:
    """Fill in the detections that can be used; their number.

    Their order depends on where they are in the picture and not on the order they came in, and with it
    every tie and every rounding below.
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
    """Points, rays and size of one detection."""
    middle = np.empty(2)
    for axis in range(2):
        count = 0
        for j in range(len(confidence)):
            if _seen(xy[j], confidence[j]):
                scratch[count] = xy[j, axis]
                count += 1
        middle[axis] = _median(scratch, count)
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
    nodes.size[n] = _median(scratch, count)


@helper
def _add_log(nodes: Nodes, n: int, cameras: int) -> int:
    """Let the logged actor take part as the only detection of one more camera, without a picture."""
    nodes.camera[n] = cameras
    for j in range(nodes.points.shape[1]):
        nodes.points[n, j, 0] = nodes.points[n, j, 1] = np.nan
    return n + 1


@helper
def _compare(
    nodes: Nodes, n: int, position: Float, sigma: Float, log: Float, needed: int, scratch: Float
) -> float:
    """Weigh every pair of detections of different cameras; the smallest s (NaN without a pair).

    A pair with few common joints says less: where a detector takes one person for two, the body wins
    over the loose leg.
    """
    nearest = np.inf
    for a in range(n):
        for b in range(a):
            weight = 0.0
            if nodes.camera[a] == len(sigma):
                weight = _AGREE - _distance_from_log(nodes, b, position, sigma, log, scratch)
            elif nodes.camera[a] != nodes.camera[b]:
                square, joints = _disagreement(nodes, a, b, position, sigma, scratch)
                if joints >= needed:
                    weight = (_AGREE - square) * joints / (joints + _FEW)
                    nearest = min(nearest, square)
            nodes.weight[a, b] = weight
            nodes.weight[b, a] = weight
    return math.sqrt(nearest) if nearest < np.inf else math.nan


@helper
def _disagreement(
    nodes: Nodes, a: int, b: int, position: Float, sigma: Float, squares: Float
) -> tuple[float, int]:
    """Mean over the better three quarters of the common joints of the squared, whitened ray distance.

    Two rays o + z d pass each other along n = d_a x d_b, at depths that follow from n (Hartley & Zisserman
    12.1, the midpoint's); an angular error sigma moves a ray by sigma z along n. Joints whose rays are too
    parallel for the depths to mean anything do not count. With it the number of joints.
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
        square = _CAP
        if possible:
            distance2 = (bx * nx + by * ny + bz * nz) ** 2 / sine2
            variance = (sigma[ca] * za) ** 2 + (sigma[cb] * zb) ** 2 + _BODY_M**2
            square = min(distance2 / variance, _CAP)
        squares[count] = square
        count += 1
    if count == 0:
        return _CAP, 0
    _median(squares, count)
    kept = max(1, (3 * count) // 4)
    total = 0.0
    for i in range(kept):
        total += squares[i]
    return total / kept, count


@helper
def _distance_from_log(
    nodes: Nodes, a: int, position: Float, sigma: Float, log: Float, squares: Float
) -> float:
    """Median over the joints of the squared, whitened distance of the logged actor from the joint's ray."""
    c = nodes.camera[a]
    count = 0
    for j in range(nodes.points.shape[1]):
        if math.isnan(nodes.points[a, j, 0]):
            continue
        depth = range2 = 0.0
        for axis in range(3):
            sight = log[axis] - position[c, axis]
            depth += sight * nodes.rays[a, j, axis]
            range2 += sight * sight
        squares[count] = _CAP
        if depth > 0.0:
            square = (range2 - depth * depth) / ((sigma[c] * depth) ** 2 + log[3] ** 2 + _LOGGED_POINT_M**2)
            squares[count] = min(square, _CAP)
        count += 1
    return _median(squares, count)


@helper
def _recognise(nodes: Nodes, n: int, tracks: Tracks, now: float, scratch: Float) -> None:
    """How well each detection continues each track's last picture in the same camera."""
    slots, cameras = tracks.held_s.shape[0], tracks.held_s.shape[1] - 1
    for a in range(n):
        c = nodes.camera[a]
        for k in range(slots):
            nodes.known[a, k] = 0.0
            if c == cameras:
                held = tracks.identity[k] >= 0 and tracks.held_s[k, c] > -np.inf
                nodes.known[a, k] = 1.0 if held else 0.0
                continue
            wait = now - tracks.held_s[k, c]
            if tracks.identity[k] < 0 or wait > _HOLD_S:
                continue
            count = 0
            for j in range(nodes.points.shape[1]):
                du = nodes.points[a, j, 0] - tracks.held[k, c, j, 0]
                dv = nodes.points[a, j, 1] - tracks.held[k, c, j, 1]
                if math.isfinite(du):
                    scratch[count] = math.hypot(du, dv)
                    count += 1
            if count > 0 and nodes.size[a] > 0.0:
                # A body is about four sizes tall. It may shift a seventh of its height at once (jitter, a
                # gimbal's jerk) and a height per second beside: a walk, and the camera's own turning.
                shift = _median(scratch, count) / (4.0 * nodes.size[a]) / (0.15 + wait)
                nodes.known[a, k] = max(0.0, 1.0 - shift * shift) * count / (count + _FEW)


@helper
def _size(nodes: Nodes, label: int) -> int:
    size = 0
    for c in range(nodes.member.shape[1]):
        if nodes.member[label, c] >= 0:
            size += 1
    return size


@helper
def _views(nodes: Nodes, label: int) -> int:
    """Cameras in a group; the log, in the last column, is none."""
    return _size(nodes, label) - (1 if nodes.member[label, -1] >= 0 else 0)


@helper
def _put(nodes: Nodes, a: int, label: int) -> None:
    nodes.label[a] = label
    nodes.member[label, nodes.camera[a]] = a


@helper
def _begin(nodes: Nodes, n: int, slots: int) -> None:
    """Start from the pictures: each detection goes to the track it continues best, or stands alone."""
    nodes.member[:] = -1
    for a in range(n):
        best = -1
        for k in range(slots):
            if nodes.known[a, k] > 0.0 and (best < 0 or nodes.known[a, k] > nodes.known[a, best]):
                best = k
        if best < 0:
            _put(nodes, a, slots + a)
            continue
        rival = nodes.member[best, nodes.camera[a]]
        if rival >= 0 and nodes.known[rival, best] >= nodes.known[a, best]:
            _put(nodes, a, slots + a)
            continue
        if rival >= 0:
            _put(nodes, rival, slots + rival)
        _put(nodes, a, best)


@helper
def _affinity(nodes: Nodes, one: int, two: int) -> float:
    """Mean weight between two groups; -inf where they share a camera, 0 where nothing can be said."""
    total: float = 0.0
    pairs = 0
    for c in range(nodes.member.shape[1]):
        a = nodes.member[one, c]
        if a < 0:
            continue
        if nodes.member[two, c] >= 0:
            return -np.inf
        for other in range(nodes.member.shape[1]):
            b = nodes.member[two, other]
            if b >= 0 and nodes.weight[a, b] != 0.0:
                total += nodes.weight[a, b]
                pairs += 1
    return total / pairs if pairs else 0.0


@helper
def _join(nodes: Nodes, n: int, tracks: Tracks) -> None:
    """Join groups that agree, best first, until none does; joined tracks become the one seen more."""
    slots = len(tracks.identity)
    while True:
        best, stay, leave = 0.0, -1, -1
        for two in range(slots + n):
            if _size(nodes, two) == 0:
                continue
            for one in range(two):
                if _size(nodes, one) == 0 or (two < slots and tracks.apart[one, two]):
                    continue
                affinity = _affinity(nodes, one, two)
                if affinity > best:
                    best, stay, leave = affinity, one, two
        if stay < 0:
            return
        if leave < slots and tracks.views[leave] > tracks.views[stay]:
            stay, leave = leave, stay
        for c in range(nodes.member.shape[1]):
            if nodes.member[leave, c] >= 0:
                _put(nodes, nodes.member[leave, c], stay)
                nodes.member[leave, c] = -1
        if leave < slots:
            for a in range(n):
                nodes.known[a, stay] = max(nodes.known[a, stay], nodes.known[a, leave])
                nodes.known[a, leave] = 0.0
            tracks.identity[leave] = -1


@helper
def _bind(nodes: Nodes, n: int, tracks: Tracks) -> None:
    """What belonging to each track is worth: continuity less that of the best other track.

    A detection that continues somebody who once stood beside the track in one picture is not taken for
    it (the actor disappears behind a tree and the bystander stays), unless the two exchange places.
    """
    slots = len(tracks.identity)
    for a in range(n):
        first, second = -1, -1
        for k in range(slots):
            if nodes.known[a, k] > 0.0:
                if first < 0 or nodes.known[a, k] > nodes.known[a, first]:
                    first, second = k, first
                elif second < 0 or nodes.known[a, k] > nodes.known[a, second]:
                    second = k
        best = nodes.known[a, first] if first >= 0 else 0.0
        next_best = nodes.known[a, second] if second >= 0 else 0.0
        for k in range(slots, slots + n):
            nodes.bond[a, k] = -best
        for k in range(slots):
            if k == first:
                nodes.bond[a, k] = best - next_best
            else:
                nodes.bond[a, k] = nodes.known[a, k] - best
            nodes.barred[a, k] = best > _SURE and k != first and tracks.apart[first, k]


@helper
def _gain(nodes: Nodes, a: int, label: int) -> float:
    """What a detection adds to a group's score, whoever of its own camera may be in it."""
    bond = float(nodes.bond[a, label])
    total = _STAY * bond
    for c in range(nodes.member.shape[1]):
        b = nodes.member[label, c]
        if c != nodes.camera[a] and b >= 0:
            total += nodes.weight[a, b] + _KNOWN * (bond + nodes.bond[b, label])
    return total


@helper
def _settle(nodes: Nodes, n: int, slots: int) -> None:
    """Move and exchange detections while the score of the partition rises."""
    labels = slots + n
    for _ in range(100):
        changed = False
        for a in range(n):
            here, c = nodes.label[a], nodes.camera[a]
            own = _gain(nodes, a, here)
            best, target, exchange = 1e-9, -1, False
            empty_tried = False
            for label in range(labels):
                if label == here:
                    continue
                empty = _size(nodes, label) == 0
                if empty and label < slots and nodes.known[a, label] == 0.0:
                    continue
                if empty and label >= slots:
                    if empty_tried:
                        continue
                    empty_tried = True
                gain = _gain(nodes, a, label) - own
                rival = nodes.member[label, c]
                if empty and label >= slots:
                    mates = max(0, _size(nodes, here) - 1)
                    gain -= _LOYAL * mates * nodes.known[a, here] if here < slots else 0.0
                barred = label < slots and nodes.barred[a, label]
                if rival < 0:
                    if gain > best and not barred:
                        best, target, exchange = gain, label, False
                    continue
                gain -= _gain(nodes, rival, label)
                swapped = gain + _gain(nodes, rival, here)
                if swapped > best:
                    best, target, exchange = swapped, label, True
                evicted = gain + _STAY * nodes.bond[rival, labels - 1]
                if evicted > best and not barred:
                    best, target, exchange = evicted, label, False
            if target < 0:
                continue
            changed = True
            rival = nodes.member[target, c]
            nodes.member[here, c] = -1
            _put(nodes, a, target)
            if rival >= 0:
                _put(nodes, rival, here if exchange else _empty_label(nodes, slots, labels))
        if not changed:
            return


@helper
def _empty_label(nodes: Nodes, slots: int, labels: int) -> int:
    for label in range(slots, labels):
        if _size(nodes, label) == 0:
            return label
    return labels - 1  # never reached: an evicted node leaves fewer than N others for N labels


@helper
def _place(nodes: Nodes, label: int, position: Float, sigma: Float, middle: Float, scratch: Float) -> float:
    """Middle of a group's joints and its standard deviation (m); NaN where no joint has two views.

    Least squares closest point to each joint's rays, then the median over joints, axis by axis, so that
    stray joints do not move it.
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
        middle[axis] = _median(scratch, count)
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
    """Solve the 3x3 system by its adjugate; the trace of the inverse, -1 where it is singular."""
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


@helper
def _resume(nodes: Nodes, n: int, tracks: Tracks, now: float, middle: Float, spread: Float) -> None:
    """Give groups without a track the lost track that they can be, nearest first."""
    slots = len(tracks.identity)
    while True:
        best, group, track = 9.0, -1, -1
        for label in range(slots, slots + n):
            if not math.isfinite(spread[label]):
                continue
            for k in range(slots):
                free = tracks.identity[k] >= 0 and _size(nodes, k) == 0
                if free and math.isfinite(tracks.spread[k]):
                    wait = now - tracks.seen_s[k]
                    variance = spread[label] ** 2 + tracks.spread[k] ** 2
                    variance += _BODY_RADIUS_M**2 + (_PACE_M_PER_S * wait) ** 2
                    square = 0.0
                    for axis in range(3):
                        square += (middle[label, axis] - tracks.middle[k, axis]) ** 2 / variance
                    if square < best:
                        best, group, track = square, label, k
        if group < 0:
            return
        _rename(nodes, group, track, middle, spread)


@helper
def _rename(nodes: Nodes, old: int, new: int, middle: Float, spread: Float) -> None:
    for c in range(nodes.member.shape[1]):
        if nodes.member[old, c] >= 0:
            _put(nodes, nodes.member[old, c], new)
            nodes.member[old, c] = -1
    for axis in range(3):
        middle[new, axis] = middle[old, axis]
    spread[new] = spread[old]
    spread[old] = np.nan


@helper
def _found(
    nodes: Nodes, n: int, tracks: Tracks, now: float, identity: int, middle: Float, spread: Float
) -> int:
    """Begin a track for every group that has none; the next free identity."""
    slots = len(tracks.identity)
    for label in range(slots, slots + n):
        if _size(nodes, label) == 0:
            continue
        k = _vacant(nodes, tracks, now)
        tracks.identity[k] = identity
        tracks.views[k] = 0
        tracks.spread[k] = np.nan
        for c in range(tracks.held_s.shape[1]):
            tracks.held_s[k, c] = -np.inf
        for other in range(slots):
            tracks.apart[k, other] = tracks.apart[other, k] = False
        identity += 1
        _rename(nodes, label, k, middle, spread)
    return identity


@helper
def _vacant(nodes: Nodes, tracks: Tracks, now: float) -> int:
    """A slot to use: a free one, else one that nobody can return to, else the least seen."""
    best, score = 0, np.inf
    for k in range(len(tracks.identity)):
        if tracks.identity[k] < 0:
            return k
        if _size(nodes, k) > 0:
            continue
        lost = tracks.views[k] == 0
        for c in range(tracks.held_s.shape[1]):
            lost = lost and now - tracks.held_s[k, c] > _HOLD_S
        value = -1.0 if lost else float(tracks.views[k])
        if value < score:
            best, score = k, value
    return best


@helper
def _remember(nodes: Nodes, n: int, tracks: Tracks, now: float, middle: Float, spread: Float) -> None:
    """Hold the pictures and places of this frame."""
    slots, cameras = tracks.held_s.shape
    for k in range(slots):
        for c in range(cameras):
            a = nodes.member[k, c]
            if a >= 0:
                tracks.held_s[k, c] = now
                for j in range(nodes.points.shape[1]):
                    for axis in range(2):
                        tracks.held[k, c, j, axis] = nodes.points[a, j, axis]
                for other in range(k):
                    if nodes.member[other, c] >= 0:
                        tracks.apart[k, other] = True
                        tracks.apart[other, k] = True
            elif tracks.identity[k] >= 0 and now - tracks.held_s[k, c] <= _HOLD_S:
                _hand_over(nodes, n, tracks, k, c)
        if math.isfinite(spread[k]):
            tracks.views[k] += _views(nodes, k)
            tracks.seen_s[k] = now
            for axis in range(3):
                tracks.middle[k, axis] = middle[k, axis]
            tracks.spread[k] = spread[k]


@helper
def _hand_over(nodes: Nodes, n: int, tracks: Tracks, k: int, c: int) -> None:
    """Forget a track's picture when its continuation was given to another track.

    The detection would else be claimed by both for as long as the old picture is held.
    """
    best = -1
    for a in range(n):
        if (
            nodes.camera[a] == c
            and nodes.known[a, k] > 0.0
            and (best < 0 or nodes.known[a, k] > nodes.known[best, k])
        ):
            best = a
    if best >= 0 and _most_like(nodes, best, k):
        tracks.held_s[k, c] = -np.inf


@helper
def _most_like(nodes: Nodes, a: int, track: int) -> bool:
    greatest = 0.0
    for k in range(nodes.known.shape[1]):
        greatest = max(greatest, nodes.known[a, k])
    return bool(nodes.known[a, track] >= greatest)


@helper
def _doubtful(nodes: Nodes, n: int, a: int) -> bool:
    """Whether another detection of the camera fits the group's rays within one sigma as well."""
    label, c = nodes.label[a], nodes.camera[a]
    for b in range(n):
        if b == a or nodes.camera[b] != c:
            continue
        difference, pairs = 0.0, 0
        for other in range(nodes.member.shape[1]):
            m = nodes.member[label, other]
            if m >= 0 and other != c:
                difference += nodes.weight[a, m] - nodes.weight[b, m]
                pairs += 1
        if pairs and difference < pairs:
            return True
    return False


@helper
def _overruled(nodes: Nodes, n: int, a: int) -> bool:
    """Whether the track's picture in this camera went on in another detection than the chosen one."""
    label, c = nodes.label[a], nodes.camera[a]
    for b in range(n):
        if (
            nodes.camera[b] == c
            and nodes.known[b, label] > max(0.5, nodes.known[a, label])
            and _most_like(nodes, b, label)
        ):
            return True
    return False


@cached
def _follow(
    time_s: Float,
    xy: Float,
    confidence: Float,
    position: Float,
    rotation: Float,
    sigma: Float,
    log: Float,
    nodes: Nodes,
    tracks: Tracks,
    followed: Followed,
) -> None:
    times, cameras, _, joints = confidence.shape
    needed = min(3, joints)
    slots = len(tracks.identity)
    middle = np.empty((slots + len(nodes.label), 3))
    spread = np.empty(slots + len(nodes.label))
    scratch = np.empty(max(joints, 1))
    identity = 0
    for t in range(times):
        now = time_s[t]
        n = _collect(nodes, xy[t], confidence[t], rotation[t], sigma[t], needed, scratch)
        if not math.isnan(log[t, 0]):
            n = _add_log(nodes, n, cameras)
        followed.nearest[t] = _compare(nodes, n, position[t], sigma[t], log[t], needed, scratch)
        _recognise(nodes, n, tracks, now, scratch)
        _begin(nodes, n, slots)
        _join(nodes, n, tracks)
        _bind(nodes, n, tracks)
        _settle(nodes, n, slots)
        for label in range(slots + n):
            spread[label] = np.nan
            if _views(nodes, label) > 1:
                spread[label] = _place(nodes, label, position[t], sigma[t], middle[label], scratch)
        _resume(nodes, n, tracks, now, middle, spread)
        identity = _found(nodes, n, tracks, now, identity, middle, spread)
        for a in range(n):
            c, d, k = nodes.camera[a], nodes.detection[a], nodes.label[a]
            if c == cameras:
                continue
            followed.track[t, c, d] = tracks.identity[k]
            followed.views[t, c, d] = _views(nodes, k)
            if math.isfinite(spread[k]):
                for axis in range(3):
                    followed.middle[t, c, d, axis] = middle[k, axis]
                followed.spread[t, c, d] = spread[k]
            followed.doubtful[t, c, d] = _doubtful(nodes, n, a)
            followed.overruled[t, c, d] = _overruled(nodes, n, a)
        _remember(nodes, n, tracks, now, middle, spread)


def follow(
    time_s: Float,
    xy: Float,
    confidence: Float,
    position: Float,
    rotation: Float,
    sigma: Float,
    log: Float | None = None,
) -> Followed:
    """Group the detections of every frame into people and follow these over time.

    Args:
        time_s: [T] s, increasing.
        xy: [T, C, D, J, 2] normalised picture coordinates, NaN where nothing is.
        confidence: [T, C, D, J]; joints at 0 or NaN are not used.
        position: [T, C, 3] m, world_from_camera, NaN without a pose.
        rotation: [T, C, 3, 3] world_from_camera.
        sigma: [T, C] rad, standard deviation of a viewing ray on each axis.
        log: [T, 4] m, the logged actor's place and its standard deviation on each axis, NaN where unknown.
    """
    posed = np.isfinite(position).all(-1) & np.isfinite(rotation).all((-1, -2)) & (sigma > 0)
    times, cameras, detections, joints = confidence.shape
    room = cameras * detections + 1  # the log is one more
    slots = room + _SPARE
    followed = Followed(
        track=np.full(confidence.shape[:3], -1, np.int64),
        views=np.zeros(confidence.shape[:3], np.int64),
        middle=np.full((times, cameras, detections, 3), np.nan),
        spread=np.full(confidence.shape[:3], np.nan),
        doubtful=np.zeros(confidence.shape[:3], np.bool_),
        overruled=np.zeros(confidence.shape[:3], np.bool_),
        nearest=np.full(times, np.nan),
    )
    nodes = Nodes(
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
    tracks = Tracks(
        identity=np.full(slots, -1, np.int64),
        views=np.zeros(slots, np.int64),
        seen_s=np.zeros(slots),
        middle=np.zeros((slots, 3)),
        spread=np.full(slots, np.nan),
        held_s=np.full((slots, cameras + 1), -np.inf),
        held=np.zeros((slots, cameras + 1, joints, 2)),
        apart=np.zeros((slots, slots), np.bool_),
    )
    _follow(
        np.ascontiguousarray(time_s, np.float64),
        np.ascontiguousarray(xy, np.float64),
        np.ascontiguousarray(confidence, np.float64),
        np.ascontiguousarray(position, np.float64),
        np.ascontiguousarray(rotation, np.float64),
        np.where(posed, sigma, np.nan),
        np.full((times, 4), np.nan) if log is None else np.ascontiguousarray(log, np.float64),
        nodes,
        tracks,
        followed,
    )
    return followed
