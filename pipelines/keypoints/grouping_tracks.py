"""Tracks of earlier frames: recognising, resuming and storing them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.compilation import helper
from pipelines.keypoints.grouping_rays import (
    FEW_JOINTS,
    Nodes,
    median_of,
    put_into_group,
    size_of_group,
    views_of_group,
)

Int64 = NDArray[np.int64]

_HOLD_S = 0.5  # a picture is compared with later ones for this long
_PACE_M_PER_S = 0.7  # random part of a walk, for taking up a track again
_BODY_RADIUS_M = 0.3  # the middle of a body depends on which joints are seen


class Tracks(NamedTuple):
    """State of the people seen so far: arrays of S slots."""

    identity: Int64  # [S] number of the track, -1 free
    views: Int64  # [S] camera-frames in company of another camera
    seen_s: Float  # [S] time of `middle`
    middle: Float  # [S, 3] m
    spread: Float  # [S] m
    held_s: Float  # [S, C] time of the picture held, -inf none
    held: Float  # [S, C, J, 2]
    apart: Bool  # [S, S] seen side by side in one picture: two people


def empty_tracks(slots: int, cameras: int, joints: int) -> Tracks:
    """Allocate tracks without any person; the logged actor is one more camera."""
    return Tracks(
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
def recognise_tracks(nodes: Nodes, n: int, tracks: Tracks, now: float, scratch: Float) -> None:
    """Rate, 0..1, how well each detection continues each track's last picture in the same camera."""
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
                shift = median_of(scratch, count) / (4.0 * nodes.size[a]) / (0.15 + wait)
                nodes.known[a, k] = max(0.0, 1.0 - shift * shift) * count / (count + FEW_JOINTS)


@helper
def resume_tracks(nodes: Nodes, n: int, tracks: Tracks, now: float, middle: Float, spread: Float) -> None:
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
            put_into_group(nodes, nodes.member[old, c], new)
            nodes.member[old, c] = -1
    for axis in range(3):
        middle[new, axis] = middle[old, axis]
    spread[new] = spread[old]
    spread[old] = np.nan


@helper
def found_tracks(
    nodes: Nodes, n: int, tracks: Tracks, now: float, identity: int, middle: Float, spread: Float
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
def _vacant(nodes: Nodes, tracks: Tracks, now: float) -> int:
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
def remember_tracks(nodes: Nodes, n: int, tracks: Tracks, now: float, middle: Float, spread: Float) -> None:
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
def _hand_over(nodes: Nodes, n: int, tracks: Tracks, k: int, c: int) -> None:
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
