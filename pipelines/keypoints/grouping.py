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
one (exchanging two people costs 2 (their separation)^2 for any pose error). A logged actor takes
part as the only detection of one more camera.

`follow` is the one function called from outside. `grouping_rays` compares detections and places groups,
`grouping_partition` finds the partition, `grouping_tracks` keeps the identities of earlier frames.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.compilation import cached, helper
from pipelines.keypoints.grouping_partition import begin_groups, bind_known, join_groups, settle_nodes
from pipelines.keypoints.grouping_rays import (
    Nodes,
    add_logged_node,
    collect_nodes,
    compare_nodes,
    empty_nodes,
    place_group,
    views_of_group,
)
from pipelines.keypoints.grouping_tracks import (
    Tracks,
    empty_tracks,
    found_tracks,
    is_most_like,
    recognise_tracks,
    remember_tracks,
    resume_tracks,
)

Int64 = NDArray[np.int64]

_SPARE = 16  # tracks remembered beyond one for each possible detection


class Followed(NamedTuple):
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
        n = collect_nodes(nodes, xy[t], confidence[t], rotation[t], sigma[t], needed, scratch)
        if not math.isnan(log[t, 0]):
            n = add_logged_node(nodes, n, cameras)
        followed.nearest[t] = compare_nodes(nodes, n, position[t], sigma[t], log[t], needed, scratch)
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
    nodes = empty_nodes(room, slots, cameras, joints)
    tracks = empty_tracks(slots, cameras, joints)
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
