"""Exchanges of two people in one camera, found by the evidence of the whole time that both are seen.

While people are followed from picture to picture, a known person is left only for much better evidence. So
two people who were exchanged in one camera, as they stood behind each other for it, stay so, although every
later picture speaks a little against it. Here all times are judged together: for every two tracks and every
camera the times are found at which their detections should be exchanged (two states, Viterbi). An exchange is
cheap to begin or end where the two bodies overlap in the picture or are not seen, and dear where the picture
shows them apart, or one of them alone. Where a camera finds only one of the two, and others find both, the
one detection is given to the other person in the same way.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.compilation import cached, helper
from pipelines.keypoints.grouping import TracksOfDetections
from pipelines.keypoints.grouping_rays import (
    Nodes,
    collect_nodes,
    compare_nodes,
    empty_nodes,
    median_of,
    place_group,
    views_of_group,
)
from pipelines.keypoints.no_people import SightLines

Int64 = NDArray[np.int64]

# Evidence of times that are nearer to each other is hardly independent.
_STEP_S = 0.1
# Only the tracks that are seen most are judged, because pairs grow with the square.
_MAX_TRACKS = 12
# Two cameras must see a track at this many judged times.
_MIN_JUDGED_TIMES = 5
# Each round undoes one exchange, and a flight with more is not understood.
_MAX_EXCHANGES = 20
# An exchange must save this many squares of sigma: one right pair has up to 109 a time more than a wrong one.
_MIN_GAIN = 25.0
_APART, _UNSEEN, _OVERLAPPING = 30.0, 6.0, 2.0  # costs to begin or end an exchange
# Two people overlap in a picture if they are nearer than this many heights of a body.
_OVERLAP_HEIGHTS = 0.3


def undo_exchanges(time_s: Float, views: SightLines, seen: TracksOfDetections) -> TracksOfDetections:
    """Exchange detections of two tracks in one camera where the views of the whole flight fit better so.

    Args:
        time_s: [T] s, increasing.
        views: all detections.
        seen: their tracks; its arrays are changed.
    """
    judged = np.flatnonzero(np.diff(np.floor((time_s - time_s[0]) / _STEP_S + 1e-9), prepend=-1.0) > 0)
    for _ in range(_MAX_EXCHANGES):
        tracks = _tracks(seen, judged)
        best, camera, pair, times = _MIN_GAIN, -1, (-1, -1), np.zeros(0, np.bool_)
        if len(tracks) < 2:
            break
        fit, there, near = _evidence(views, seen, judged, tracks)
        elsewhere = there.sum(axis=2, keepdims=True) > there  # another camera sees the track
        for a in range(1, len(tracks)):
            for b in range(a):
                for c in range(fit.shape[3]):
                    both = there[:, a, c] & there[:, b, c]
                    told = both | (elsewhere[:, a, c] & elsewhere[:, b, c])
                    gain = fit[:, a, b, c] + fit[:, b, a, c] - fit[:, a, a, c] - fit[:, b, b, c]
                    gain = np.where(told, gain, 0.0)
                    if np.maximum(gain, 0.0).sum() <= best:
                        continue
                    exchanged = _best_times(gain, there[:, a, c] | there[:, b, c], near[:, a, b, c])
                    worth = float(gain[exchanged].sum())
                    if worth > best:
                        best, camera, pair, times = worth, c, (tracks[a], tracks[b]), exchanged
        if camera < 0:
            break
        _exchange(views, seen, camera, pair, times[_nearest(judged, len(time_s))])
    return seen


def _tracks(seen: TracksOfDetections, judged: Int64) -> Int64:
    """Return the tracks that two cameras see most."""
    track = seen.track[judged]
    tracks, count = np.unique(track[seen.views[judged] > 1], return_counts=True)
    enough = count >= 2 * _MIN_JUDGED_TIMES
    order = np.argsort(-count[enough], kind="stable")
    return np.asarray(tracks[enough][order[:_MAX_TRACKS]])


def _nearest(judged: Int64, times: int) -> Int64:
    """Return the index [T] of the judged time nearest to each."""
    middles = (judged[1:] + judged[:-1] + 1) // 2
    return np.searchsorted(middles, np.arange(times), side="right")


def _evidence(
    views: SightLines, seen: TracksOfDetections, judged: Int64, tracks: Int64
) -> tuple[Float, Bool, Float]:
    """Compare the detection of every track in every camera with all tracks' detections in other cameras.

    Returns:
        The sum of weights [N, K, K, C] of the first track's detection with the second track's in the other
        cameras; where a track is seen [N, K, C]; and the distances [N, K, K, C] of two tracks' detections in
        a picture, in heights of a body; NaN where one is not seen.
    """
    times, count, cameras = len(judged), len(tracks), views.sigma.shape[1]
    number = np.full(int(seen.track.max()) + 2, -1, np.int64)
    number[tracks] = np.arange(count)
    found = (
        np.zeros((times, count, count, cameras)),
        np.zeros((times, count, cameras), np.bool_),
        np.full((times, count, count, cameras), np.nan),
    )
    room, joints = cameras * views.xy.shape[2], views.xy.shape[3]
    nodes = empty_nodes(room, count, cameras, joints)
    _compare(*_arrays(views, judged), number[seen.track[judged]], nodes, *found)
    return found


def _arrays(views: SightLines, rows: Int64) -> tuple[Float, Float, Float, Float, Float]:
    """Return the detections at some times, as `collect_nodes` takes them."""
    posed = np.isfinite(views.position[rows]).all(-1) & np.isfinite(views.rotation[rows]).all((-1, -2))
    sigma = np.where(posed & (views.sigma[rows] > 0), views.sigma[rows], np.nan)
    return views.xy[rows], views.confidence[rows], views.position[rows], views.rotation[rows], sigma


@cached
def _compare(
    xy: Float,
    confidence: Float,
    position: Float,
    rotation: Float,
    sigma: Float,
    track: Int64,
    nodes: Nodes,
    fit: Float,
    there: Bool,
    near: Float,
) -> None:
    joints = confidence.shape[3]
    needed = min(3, joints)
    scratch = np.empty(max(joints, 1))
    logs = np.full((1, 4), np.nan)
    for t in range(len(xy)):
        n = collect_nodes(nodes, xy[t], confidence[t], rotation[t], sigma[t], needed, scratch)
        compare_nodes(nodes, n, position[t], sigma[t], logs, needed, scratch)
        for a in range(n):
            c, k = nodes.camera[a], track[t, nodes.camera[a], nodes.detection[a]]
            if k < 0:
                continue
            there[t, k, c] = True
            for b in range(n):
                other = track[t, nodes.camera[b], nodes.detection[b]]
                if other < 0 or a == b:
                    continue
                if nodes.camera[b] == c:
                    near[t, k, other, c] = _heights_apart(nodes, a, b, scratch)
                else:
                    fit[t, k, other, c] += nodes.weight[a, b]


@helper
def _heights_apart(nodes: Nodes, a: int, b: int, scratch: Float) -> float:
    """Compute the median distance of two bodies' joints in a picture, in heights of a body."""
    count = 0
    for j in range(nodes.points.shape[1]):
        away = math.hypot(
            nodes.points[a, j, 0] - nodes.points[b, j, 0], nodes.points[a, j, 1] - nodes.points[b, j, 1]
        )
        if math.isfinite(away):
            scratch[count] = away
            count += 1
    height = 4.0 * max(nodes.size[a], nodes.size[b], 1e-9)
    return median_of(scratch, count) / height if count else 0.0


def _best_times(gain: Float, seen: Bool, near: Float) -> Bool:
    """Find the times [N] at which an exchange is worth most (Viterbi, two states)."""
    cost = np.where(seen, np.where(near < _OVERLAP_HEIGHTS, _OVERLAPPING, _APART), _UNSEEN)
    change = np.minimum(cost[1:], cost[:-1])
    score = np.array([0.0, gain[0]])
    came = np.zeros((len(gain), 2), np.int64)
    for t in range(1, len(gain)):
        other = score[::-1] - change[t - 1]
        came[t] = np.where(other > score, [1, 0], [0, 1])
        score = np.maximum(score, other)
        score[1] += gain[t]
    state = int(score[1] > score[0])
    states = np.zeros(len(gain), np.bool_)
    for t in range(len(gain) - 1, -1, -1):
        states[t] = state == 1
        state = int(came[t, state])
    return states


def _exchange(
    views: SightLines, seen: TracksOfDetections, camera: int, pair: tuple[int, int], times: Bool
) -> None:
    """Exchange the detections of two tracks in one camera at some times [T], and place both again."""
    own = seen.track[:, camera]
    first, second = (times[:, None] & (own == track) for track in pair)
    own[first], own[second] = pair[1], pair[0]
    rows = np.flatnonzero((first | second).any(axis=1))
    cameras, joints = views.sigma.shape[1], views.xy.shape[3]
    nodes = empty_nodes(cameras * views.xy.shape[2], 2, cameras, joints)
    parts = seen.views[rows], seen.middle[rows], seen.spread[rows]
    _place(*_arrays(views, rows), seen.track[rows], np.array(pair), nodes, *parts)
    seen.views[rows], seen.middle[rows], seen.spread[rows] = parts


@cached
def _place(
    xy: Float,
    confidence: Float,
    position: Float,
    rotation: Float,
    sigma: Float,
    track: Int64,
    pair: Int64,
    nodes: Nodes,
    views: Int64,
    middles: Float,
    spreads: Float,
) -> None:
    joints = confidence.shape[3]
    scratch = np.empty(max(joints, 1))
    middle = np.empty(3)
    for t in range(len(xy)):
        n = collect_nodes(nodes, xy[t], confidence[t], rotation[t], sigma[t], min(3, joints), scratch)
        nodes.member[:] = -1
        for a in range(n):
            for k in range(2):
                if track[t, nodes.camera[a], nodes.detection[a]] == pair[k]:
                    nodes.member[k, nodes.camera[a]] = a
        for k in range(2):
            count = views_of_group(nodes, k)
            spread = place_group(nodes, k, position[t], sigma[t], middle, scratch) if count > 1 else math.nan
            for c in range(len(sigma[t])):
                a = nodes.member[k, c]
                if a >= 0:
                    d = nodes.detection[a]
                    views[t, c, d] = count
                    spreads[t, c, d] = spread
                    for axis in range(3):
                        middles[t, c, d, axis] = middle[axis] if math.isfinite(spread) else math.nan
