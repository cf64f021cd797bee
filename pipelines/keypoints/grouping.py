"""Grouping of a frame's detections into bodies, and identity of the bodies over time.

Every frame is a small clustering problem: detections are nodes, a group holds at most one detection
of each camera, and the score of a partition adds, over all pairs inside a group,

    3^2 + known_a + known_b - s_ab^2

where s_ab is the distance, in standard deviations, at which the viewing rays of the pair's common joints
pass each other. `known` is 1 if the detection continues the last picture of the group's track in the same
camera. Detections without history must thus agree within 3 sigma. A known detection may stay up to 5 sigma,
unless another one of its camera fits better.

The sum of squares over a whole assignment matters: a pose error moves all people in a picture equally, so
the assignment that keeps people apart wins even where one wrong pair happens to fit better than a right
one (exchanging two people costs 2 (their separation)^2 for any pose error). People who were logged take
part as the detections of one more camera.

`follow` is the one function called from outside. `grouping_rays` compares detections and places groups.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.compilation import cached, helper
from pipelines.keypoints.grouping_rays import (
    FEW_JOINTS,
    Nodes,
    add_logged_nodes,
    collect_nodes,
    compare_nodes,
    empty_nodes,
    median_of,
    place_group,
    put_into_group,
    size_of_group,
    views_of_group,
)

Int64 = NDArray[np.int64]

# A picture is compared with later ones for this long.
_HOLD_S = 0.5
# The random part of a walk has this speed, for taking up a track again.
_RANDOM_WALK_M_PER_S = 0.7
# The middle of a body depends on which joints are seen.
_BODY_RADIUS_M = 0.3


class TrackSlots(NamedTuple):
    """State of the people seen so far: arrays of S slots."""

    identity: Int64  # [S] number of the track, -1 free
    views: Int64  # [S] camera-frames in company of another camera
    seen_s: Float  # [S] time of `middle`
    middle: Float  # [S, 3] m
    spread: Float  # [S] m
    held_s: Float  # [S, C] time of the picture held, -inf none
    held: Float  # [S, C, J, 2]
    apart: Bool  # [S, S] seen side by side in one picture: two people


def empty_tracks(slots: int, cameras: int, joints: int) -> TrackSlots:
    """Allocate tracks without any person; the logged people are one more camera."""
    return TrackSlots(
        identity=np.full(slots, -1, np.int64),
        views=np.zeros(slots, np.int64),
        seen_s=np.zeros(slots),
        middle=np.zeros((slots, 3)),
        spread=np.full(slots, np.nan),
        held_s=np.full((slots, cameras + 1), -np.inf),
        held=np.zeros((slots, cameras + 1, joints, 2)),
        apart=np.zeros((slots, slots), np.bool_),
    )


@helper
def recognise_tracks(nodes: Nodes, n: int, tracks: TrackSlots, now: float, scratch: Float) -> None:
    """Rate, 0..1, how well each detection continues each track's last picture in the same camera."""
    slots, cameras = tracks.held_s.shape[0], tracks.held_s.shape[1] - 1
    for a in range(n):
        c = nodes.camera[a]
        for k in range(slots):
            nodes.known[a, k] = 0.0
            if c == cameras:
                held = tracks.identity[k] >= 0 and tracks.held_s[k, c] > -np.inf
                own = tracks.held[k, c, 0, 0] == nodes.detection[a]  # which of the logs; they have no picture
                nodes.known[a, k] = 1.0 if held and own else 0.0
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
                shift = median_of(scratch, count) / (4.0 * nodes.size[a]) / (0.15 + wait)
                nodes.known[a, k] = max(0.0, 1.0 - shift * shift) * count / (count + FEW_JOINTS)


@helper
def resume_tracks(nodes: Nodes, n: int, tracks: TrackSlots, now: float, middle: Float, spread: Float) -> None:
    """Assign lost tracks to groups without a track, nearest first."""
    slots = len(tracks.identity)
    while True:
        best, group, track = 9.0, -1, -1
        for label in range(slots, slots + n):
            if not math.isfinite(spread[label]):
                continue
            for k in range(slots):
                free = tracks.identity[k] >= 0 and size_of_group(nodes, k) == 0
                if free and math.isfinite(tracks.spread[k]):
                    wait = now - tracks.seen_s[k]
                    variance = spread[label] ** 2 + tracks.spread[k] ** 2
                    variance += _BODY_RADIUS_M**2 + (_RANDOM_WALK_M_PER_S * wait) ** 2
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
            put_into_group(nodes, nodes.member[old, c], new)
            nodes.member[old, c] = -1
    for axis in range(3):
        middle[new, axis] = middle[old, axis]
    spread[new] = spread[old]
    spread[old] = np.nan


@helper
def found_tracks(
    nodes: Nodes, n: int, tracks: TrackSlots, now: float, identity: int, middle: Float, spread: Float
) -> int:
    """Start a track for every group that has none and return the next free identity."""
    slots = len(tracks.identity)
    for label in range(slots, slots + n):
        if size_of_group(nodes, label) == 0:
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
def _vacant(nodes: Nodes, tracks: TrackSlots, now: float) -> int:
    """Choose a slot: a free one, else one that no person can return to, else the least seen."""
    best, score = 0, np.inf
    for k in range(len(tracks.identity)):
        if tracks.identity[k] < 0:
            return k
        if size_of_group(nodes, k) > 0:
            continue
        lost = tracks.views[k] == 0
        for c in range(tracks.held_s.shape[1]):
            lost = lost and now - tracks.held_s[k, c] > _HOLD_S
        value = -1.0 if lost else float(tracks.views[k])
        if value < score:
            best, score = k, value
    return best


@helper
def remember_tracks(
    nodes: Nodes, n: int, tracks: TrackSlots, now: float, middle: Float, spread: Float
) -> None:
    """Store the pictures and places of this frame."""
    slots, cameras = tracks.held_s.shape
    for k in range(slots):
        for c in range(cameras):
            a = nodes.member[k, c]
            if a >= 0:
                tracks.held_s[k, c] = now
                for j in range(nodes.points.shape[1]):
                    for axis in range(2):
                        tracks.held[k, c, j, axis] = nodes.points[a, j, axis]
                if c == cameras - 1:
                    tracks.held[k, c, 0, 0] = nodes.detection[a]
                for other in range(k):
                    if nodes.member[other, c] >= 0:
                        tracks.apart[k, other] = True
                        tracks.apart[other, k] = True
            elif tracks.identity[k] >= 0 and now - tracks.held_s[k, c] <= _HOLD_S:
                _hand_over(nodes, n, tracks, k, c)
        if math.isfinite(spread[k]):
            tracks.views[k] += views_of_group(nodes, k)
            tracks.seen_s[k] = now
            for axis in range(3):
                tracks.middle[k, axis] = middle[k, axis]
            tracks.spread[k] = spread[k]


@helper
def _hand_over(nodes: Nodes, n: int, tracks: TrackSlots, k: int, c: int) -> None:
    """Forget a track's picture when its continuation was given to another track.

    Otherwise both tracks would claim the detection while the old picture is held.
    """
    best = -1
    for a in range(n):
        if (
            nodes.camera[a] == c
            and nodes.known[a, k] > 0.0
            and (best < 0 or nodes.known[a, k] > nodes.known[best, k])
        ):
            best = a
    if best >= 0 and is_most_like(nodes, best, k):
        tracks.held_s[k, c] = -np.inf


@helper
def is_most_like(nodes: Nodes, a: int, track: int) -> bool:
    """Test if no other track is more like a detection than this one."""
    greatest = 0.0
    for k in range(nodes.known.shape[1]):
        greatest = max(greatest, nodes.known[a, k])
    return bool(nodes.known[a, track] >= greatest)


# Each side of a pair that continues the track adds this score. With 8, wrong starts are never left.
_KNOWN_SCORE = 1.0
# A known detection that leaves its group for none is refused beyond 5 sigma.
_LOYALTY_SCORE = 14.0
# A detection that is alone in its group gets this score for continuing a track.
_STAY_SCORE = 4.0
# A detection more like a track's last picture than this (0..1) is a known person.
_KNOWN_LIKENESS = 0.3


@helper
def begin_groups(nodes: Nodes, n: int, slots: int) -> None:
    """Start from the pictures: each detection goes to the track it continues best, or stands alone."""
    nodes.member[:] = -1
    for a in range(n):
        best = -1
        for k in range(slots):
            if nodes.known[a, k] > 0.0 and (best < 0 or nodes.known[a, k] > nodes.known[a, best]):
                best = k
        if best < 0:
            put_into_group(nodes, a, slots + a)
            continue
        rival = nodes.member[best, nodes.camera[a]]
        if rival >= 0 and nodes.known[rival, best] >= nodes.known[a, best]:
            put_into_group(nodes, a, slots + a)
            continue
        if rival >= 0:
            put_into_group(nodes, rival, slots + rival)
        put_into_group(nodes, a, best)


@helper
def _affinity(nodes: Nodes, one: int, two: int) -> float:
    """Compute the mean weight between two groups; -inf if they share a camera, 0 without comparable pairs."""
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
def join_groups(nodes: Nodes, n: int, tracks: TrackSlots) -> None:
    """Join groups that agree, best first, until none does; joined tracks become the one seen more."""
    slots = len(tracks.identity)
    while True:
        best, stay, leave = 0.0, -1, -1
        for two in range(slots + n):
            if size_of_group(nodes, two) == 0:
                continue
            for one in range(two):
                if size_of_group(nodes, one) == 0 or (two < slots and tracks.apart[one, two]):
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
                put_into_group(nodes, nodes.member[leave, c], stay)
                nodes.member[leave, c] = -1
        if leave < slots:
            for a in range(n):
                nodes.known[a, stay] = max(nodes.known[a, stay], nodes.known[a, leave])
                nodes.known[a, leave] = 0.0
            tracks.identity[leave] = -1


@helper
def bind_known(nodes: Nodes, n: int, tracks: TrackSlots) -> None:
    """Compute the bond of each detection to each track: continuity minus that of the best other track.

    If a detection continues a person who was once seen beside the track in one picture, it is not assigned
    to the track (the actor disappears behind a tree and the bystander stays), unless the two exchange places.
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
            nodes.barred[a, k] = best > _KNOWN_LIKENESS and k != first and tracks.apart[first, k]


@helper
def _gain(nodes: Nodes, a: int, label: int) -> float:
    """Compute a detection's contribution to a group's score; ignore others of its own camera in the group."""
    bond = float(nodes.bond[a, label])
    total = _STAY_SCORE * bond
    for c in range(nodes.member.shape[1]):
        b = nodes.member[label, c]
        if c != nodes.camera[a] and b >= 0:
            total += nodes.weight[a, b] + _KNOWN_SCORE * (bond + nodes.bond[b, label])
    return total


@helper
def settle_nodes(nodes: Nodes, n: int, slots: int) -> None:
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
                empty = size_of_group(nodes, label) == 0
                if empty and label < slots and nodes.known[a, label] == 0.0:
                    continue
                if empty and label >= slots:
                    if empty_tried:
                        continue
                    empty_tried = True
                gain = _gain(nodes, a, label) - own
                rival = nodes.member[label, c]
                if empty and label >= slots:
                    mates = max(0, size_of_group(nodes, here) - 1)
                    gain -= _LOYALTY_SCORE * mates * nodes.known[a, here] if here < slots else 0.0
                barred = label < slots and nodes.barred[a, label]
                if rival < 0:
                    if gain > best and not barred:
                        best, target, exchange = gain, label, False
                    continue
                gain -= _gain(nodes, rival, label)
                swapped = gain + _gain(nodes, rival, here)
                if swapped > best:
                    best, target, exchange = swapped, label, True
                evicted = gain + _STAY_SCORE * nodes.bond[rival, labels - 1]
                if evicted > best and not barred:
                    best, target, exchange = evicted, label, False
            if target < 0:
                continue
            changed = True
            rival = nodes.member[target, c]
            nodes.member[here, c] = -1
            put_into_group(nodes, a, target)
            if rival >= 0:
                put_into_group(nodes, rival, here if exchange else _empty_label(nodes, slots, labels))
        if not changed:
            return


@helper
def _empty_label(nodes: Nodes, slots: int, labels: int) -> int:
    for label in range(slots, labels):
        if size_of_group(nodes, label) == 0:
            return label
    return labels - 1  # never reached: an evicted node leaves fewer than N others for N labels


# This many tracks are remembered beyond one for each possible detection.
_SPARE_TRACKS = 16


class TracksOfDetections(NamedTuple):
    """Identity of each detection: T times, C cameras, D detections."""

    track: Int64  # [T, C, D] number of the track, -1 where the detection was not usable
    views: Int64  # [T, C, D] cameras in the detection's group, itself included; 0 where not usable
    middle: Float  # [T, C, D, 3] m, middle of the group's joints, NaN without two views
    spread: Float  # [T, C, D] m, its standard deviation on each axis
    doubtful: Bool  # [T, C, D] another detection of the camera fits the group within one sigma as well
    overruled: Bool  # [T, C, D] taken although the picture's continuity pointed at another detection
    nearest: Float  # [T] the smallest disagreement of two detections (sigma), NaN without a pair


@helper
def _doubtful(nodes: Nodes, n: int, a: int) -> bool:
    """Test if another detection of the camera also fits the group's rays within one sigma."""
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
    """Test if another detection than the chosen one continues the track's picture in this camera."""
    label, c = nodes.label[a], nodes.camera[a]
    for b in range(n):
        if (
            nodes.camera[b] == c
            and nodes.known[b, label] > max(0.5, nodes.known[a, label])
            and is_most_like(nodes, b, label)
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
    logs: Float,
    nodes: Nodes,
    tracks: TrackSlots,
    followed: TracksOfDetections,
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
        n = collect_nodes(nodes, xy[t], confidence[t], rotation[t], sigma[t], needed, scratch)
        n = add_logged_nodes(nodes, n, cameras, logs[t])
        followed.nearest[t] = compare_nodes(nodes, n, position[t], sigma[t], logs[t], needed, scratch)
        recognise_tracks(nodes, n, tracks, now, scratch)
        begin_groups(nodes, n, slots)
        join_groups(nodes, n, tracks)
        bind_known(nodes, n, tracks)
        settle_nodes(nodes, n, slots)
        for label in range(slots + n):
            spread[label] = np.nan
            if views_of_group(nodes, label) > 1:
                spread[label] = place_group(nodes, label, position[t], sigma[t], middle[label], scratch)
        resume_tracks(nodes, n, tracks, now, middle, spread)
        identity = found_tracks(nodes, n, tracks, now, identity, middle, spread)
        for a in range(n):
            c, d, k = nodes.camera[a], nodes.detection[a], nodes.label[a]
            if c == cameras:
                continue
            followed.track[t, c, d] = tracks.identity[k]
            followed.views[t, c, d] = views_of_group(nodes, k)
            if math.isfinite(spread[k]):
                for axis in range(3):
                    followed.middle[t, c, d, axis] = middle[k, axis]
                followed.spread[t, c, d] = spread[k]
            followed.doubtful[t, c, d] = _doubtful(nodes, n, a)
            followed.overruled[t, c, d] = _overruled(nodes, n, a)
        remember_tracks(nodes, n, tracks, now, middle, spread)


def follow(
    time_s: Float,
    xy: Float,
    confidence: Float,
    position: Float,
    rotation: Float,
    sigma: Float,
    logs: Float | None = None,
) -> TracksOfDetections:
    """Group the detections of every frame into people and follow these over time.

    Args:
        time_s: [T] s, increasing.
        xy: [T, C, D, J, 2] normalised picture coordinates, NaN where nothing is.
        confidence: [T, C, D, J]; joints at 0 or NaN are not used.
        position: [T, C, 3] m, world_from_camera, NaN without a pose.
        rotation: [T, C, 3, 3] world_from_camera.
        sigma: [T, C] rad, standard deviation of a viewing ray on each axis.
        logs: [T, A, 4] m, the places of logged people and their standard deviation on each axis, NaN where
            unknown.
    """
    posed = np.isfinite(position).all(-1) & np.isfinite(rotation).all((-1, -2)) & (sigma > 0)
    times, cameras, detections, joints = confidence.shape
    logs = np.full((times, 1, 4), np.nan) if logs is None else np.ascontiguousarray(logs, np.float64)
    room = cameras * detections + logs.shape[1]
    slots = room + _SPARE_TRACKS
    followed = TracksOfDetections(
        track=np.full(confidence.shape[:3], -1, np.int64),
        views=np.zeros(confidence.shape[:3], np.int64),
        middle=np.full((times, cameras, detections, 3), np.nan),
        spread=np.full(confidence.shape[:3], np.nan),
        doubtful=np.zeros(confidence.shape[:3], np.bool_),
        overruled=np.zeros(confidence.shape[:3], np.bool_),
        nearest=np.full(times, np.nan),
    )
    nodes = empty_nodes(room, slots, cameras, joints)
    tracks = empty_tracks(slots, cameras, joints)
    _follow(
        np.ascontiguousarray(time_s, np.float64),
        np.ascontiguousarray(xy, np.float64),
        np.ascontiguousarray(confidence, np.float64),
        np.ascontiguousarray(position, np.float64),
        np.ascontiguousarray(rotation, np.float64),
        np.where(posed, sigma, np.nan),
        logs,
        nodes,
        tracks,
        followed,
    )
    return followed
