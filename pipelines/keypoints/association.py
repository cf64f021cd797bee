"""Association: one detection per camera and time for the actor, if several people are seen."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.keypoints.grouping import Followed, follow
from pipelines.keypoints.no_people import Scene, tell_no_people

Int64 = NDArray[np.int64]

_NEAR = 9.0  # within 3 sigma of the logged actor counts for a track, beyond against it
_FAR = 25.0  # beyond 5 sigma a track is not the actor at that time
_BODY_M = 0.5  # the log's point (hip, a tag, a phone) against the middle of the joints seen
_PACE_M_PER_S = 3.0  # a lost person is not resumed further away than a run
_REACH_M = 1.0
_OVERLAP = 0.05  # largest share of a track's frames that may overlap with the person it continues


@dataclass(frozen=True)
class Association:
    """Assignment of detections to people. T times, C cameras, P people; person 0 is the actor."""

    choice: Int64  # [T, C, P] index into the detections of the camera at that time, -1 none
    views: Int64  # [P] camera-frames chosen
    ambiguous: Int64  # [P] of these: another detection of the same camera fits within one sigma as well
    switches: Int64  # [P] of these: against the continuity of the picture (swapped ids, bodies crossing)
    refused: Int64  # [P] camera-frames with detections, none of them the person that other cameras see
    resumed: Int64  # [P] times the person was lost by all and taken up again
    people: Int64  # [T] people whom at least two cameras see
    unused: Int64  # [C] usable detections, over all times, that belong to none of the chosen people
    no_people: dict[
        str, Int64
    ]  # [C] detections by the causes of `NoPeople`, which are not used; and those kept
    reasons: tuple[str, ...]  # messages for the user, one line each


@dataclass(frozen=True)
class _Track:
    """Track of one body while it could be followed; rows are the times when two cameras saw it."""

    identity: int
    time: Int64  # [n] index
    views: Int64  # [n]
    middle: Float  # [n, 3] m
    spread: Float  # [n] m
    confidence: float


def associate(
    time_s: Float,
    xy: Float,
    confidence: Float,
    position: Float,
    rotation: Float,
    sigma: Float,
    *,
    actor: Float | None = None,
    actor_sigma_m: float = 1.0,
    people: int = 1,
    scene: Scene | None = None,
) -> Association:
    """Choose the detections of the actor, then of other people, most seen first.

    Detections of different cameras are grouped into bodies by how near their viewing rays pass each
    other, in units of the stated angular noise, and bodies are followed over time by the continuity of
    each camera's picture and by their place (see `grouping`). The actor is the body nearest the logged
    actor; without a log the one seen in most camera-frames by two cameras or more, ties by confidence.
    The order of detections within a camera and frame does not matter.

    Args:
        time_s: [T] seconds, strictly increasing.
        xy: [T, C, D, J, 2] undistorted normalised picture coordinates, NaN where there is nothing. A few
            well-detected joints (8 or so) are enough where memory is short; at least 3 must be common.
        confidence: [T, C, D, J]; joints with 0 or NaN are not used.
        position: [T, C, 3] m, world_from_camera; NaN: the camera has no pose and gets no choice.
        rotation: [T, C, 3, 3] world_from_camera.
        sigma: [T, C] rad, standard deviation of a viewing ray on each axis: pixel and pose noise, and
            clock error times the actor's angular speed.
        actor: [T, 3] m, the logged actor, NaN where unknown.
        actor_sigma_m: standard deviation of the log on each axis.
        people: number of people to choose.
        scene: the surroundings, by which things that are no people are dropped; by default nothing is.

    Returns:
        The choice and its counts. A lone view is kept where its picture continues the person's last one.
    """
    if confidence.shape[2] == 0:  # no detections at all: make room for one absent person
        xy = np.full((*xy.shape[:2], 1, *xy.shape[3:]), np.nan)
        confidence = np.zeros(xy.shape[:-1])
    logged = None if actor is None else np.c_[actor, np.full(len(actor), actor_sigma_m)]
    seen = follow(time_s, xy, confidence, position, rotation, sigma, logged)
    dropped: dict[str, Int64] = {}
    if scene is not None:
        things = tell_no_people(seen, xy, confidence, position, rotation, sigma, scene)
        dropped = {cause: which.sum((0, 2)) for cause, which in things._asdict().items()}
        if (out := things.ground | things.alone).any():
            confidence = np.where(out[..., None], 0.0, confidence)
            seen = follow(time_s, xy, confidence, position, rotation, sigma, logged)
    tracks = _tracks(seen, np.where(np.isfinite(xy).all(-1) & (confidence > 0), confidence, 0.0))
    chosen = np.full((*seen.track.shape[:2], people), -1, np.int64)
    resumed = np.zeros(people, np.int64)
    reasons: list[str] = []
    for person in range(people):
        log = actor if person == 0 else None
        if log is not None and tracks and not any(_likeness(one, log, actor_sigma_m) > 0 for one in tracks):
            reasons.append(_far_from_log(tracks, log))
            log = None
        owner, taken = _chain(tracks, time_s, log, actor_sigma_m)
        chosen[:, :, person] = _detections(seen.track, owner, taken)
        resumed[person] = max(0, len(taken) - 1)
        tracks = [one for one in tracks if one.identity not in taken]
    if not np.any(chosen >= 0):
        reasons.append(_nobody(seen.nearest))
    return _counted(chosen, seen, resumed, dropped, tuple(reasons))


def _tracks(seen: Followed, confidence: Float) -> list[_Track]:
    """Collect the tracks as rows over time, from the values of each detection."""
    time, camera, detection = np.nonzero(np.isfinite(seen.spread))
    identity = seen.track[time, camera, detection]
    order = np.lexsort((camera, time, identity))
    time, camera, detection, identity = time[order], camera[order], detection[order], identity[order]
    # Missing joints count as 0: of two detections of one body the complete one is the person.
    mean_confidence = confidence.mean(-1)
    new_row = np.ones(len(time), bool)
    new_row[1:] = (np.diff(identity) != 0) | (np.diff(time) != 0)
    found = []
    starts = np.flatnonzero(np.diff(identity, prepend=-1))
    for start, stop in pairwise([*starts, len(time)]):
        rows = start + np.flatnonzero(new_row[start:stop])
        at = (time[rows], camera[rows], detection[rows])
        trust = mean_confidence[time[start:stop], camera[start:stop], detection[start:stop]].mean()
        found.append(
            _Track(
                int(identity[start]), at[0], seen.views[at], seen.middle[at], seen.spread[at], float(trust)
            )
        )
    return found


def _squares(track: _Track, log: Float, sigma_m: float) -> Float:
    """Compute the squared, whitened distance of a track from the log; NaN where the log has no value."""
    variance = sigma_m**2 + _BODY_M**2 + track.spread**2
    squares: Float = ((track.middle - log[track.time]) ** 2).sum(-1) / variance
    return squares


def _likeness(track: _Track, log: Float | None, sigma_m: float) -> float:
    """Compute the evidence that a track is the logged actor; 0 without a log."""
    if log is None:
        return 0.0
    return float(np.nansum(track.views * (_NEAR - np.minimum(_squares(track, log, sigma_m), _FAR))))


def _chain(tracks: list[_Track], time_s: Float, log: Float | None, sigma_m: float) -> tuple[Int64, list[int]]:
    """Chain tracks into one person.

    The first track is the one nearest the log, or the one seen most. Other tracks fill the times at which
    no camera saw it.

    Returns:
        The identity of the track at each time [T] (-1 none, -2 refused by the log), and all identities used.
    """
    owner = np.full(len(time_s), -1, np.int64)
    place = np.full((len(time_s), 3), np.nan)
    taken: list[int] = []
    likeness = {one.identity: _likeness(one, log, sigma_m) for one in tracks}
    ranked = sorted(
        (one for one in tracks if likeness[one.identity] >= 0),
        key=lambda one: (-likeness[one.identity], -one.views.sum(), -one.confidence, one.identity),
    )
    for one in ranked:
        logged = likeness[one.identity] > 0
        if taken and not logged and not _continues(one, owner, place, time_s):
            continue
        free = owner[one.time] < 0
        if not free.any():
            continue
        far = np.zeros(len(one.time), bool) if log is None else _squares(one, log, sigma_m) > _FAR
        owner[one.time[free & ~far]] = one.identity
        owner[one.time[free & far]] = -2
        place[one.time[free]] = one.middle[free]
        taken.append(one.identity)
    return owner, taken


def _continues(track: _Track, owner: Int64, place: Float, time_s: Float) -> bool:
    """Test if a lost person can be this track: not beside it, and within reach before and after."""
    if np.mean(owner[track.time] >= 0) > _OVERLAP:
        return False
    owned = np.flatnonzero(owner >= 0)
    for row, neighbour in ((0, owned[owned < track.time[0]][-1:]), (-1, owned[owned > track.time[-1]][:1])):
        for near in neighbour:
            gap_s = abs(time_s[track.time[row]] - time_s[near])
            reach = _REACH_M + 3.0 * track.spread[row] + _PACE_M_PER_S * gap_s
            if np.linalg.norm(track.middle[row] - place[near]) > reach:
                return False
    return True


def _detections(track: Int64, owner: Int64, taken: list[int]) -> Int64:
    """Find the detection [T, C] of the person in each camera, -1 none; lone views fill free times."""
    owner = owner.copy()
    for identity in taken:
        alone = (owner == -1) & (track == identity).any((1, 2))
        owner[alone] = identity
    mine = (track == owner[:, None, None]) & (track >= 0)
    return np.where(mine.any(-1), mine.argmax(-1), -1)


def _far_from_log(tracks: list[_Track], log: Float) -> str:
    distances = [np.linalg.norm(one.middle - log[one.time], axis=-1) for one in tracks]
    distance = np.concatenate(distances)
    distance = distance[np.isfinite(distance)]
    if not len(distance):
        return "the actor's log does not cover the times at which somebody is seen: taken is who is seen most"
    return (
        f"nobody is near the logged actor (nearest {distance.min():.1f} m, median "
        f"{np.median(distance):.1f} m): taken is who is seen most"
    )


def _nobody(nearest: Float) -> str:
    known = nearest[np.isfinite(nearest)]
    if not len(known):
        return "no two cameras with poses see somebody at the same time from directions that differ enough"
    return (
        f"no two cameras agree on anybody: at best their viewing rays pass at {np.median(known):.1f} sigma "
        "(median over frames); check poses, clocks and the stated noise"
    )


def _counted(
    chosen: Int64, seen: Followed, resumed: Int64, dropped: dict[str, Int64], reasons: tuple[str, ...]
) -> Association:
    """Build the result: the choice with its counts."""
    at = np.maximum(chosen.transpose(2, 0, 1), 0)[..., None]  # [P, T, C, 1]
    present = (chosen >= 0).transpose(2, 0, 1)

    def count(flag: Bool) -> Int64:
        counts: Int64 = (np.take_along_axis(flag[None], at, -1)[..., 0] & present).sum((1, 2))
        return counts

    others_see = present.sum(-1, keepdims=True) > 1
    refused = ~present & others_see & (seen.track >= 0).any(-1)
    standing = np.where(
        seen.views > 1, 1.0 / np.maximum(seen.views, 1), 0.0
    )  # a body of n views counts n times 1/n
    return Association(
        choice=chosen,
        views=present.sum((1, 2)),
        ambiguous=count(seen.doubtful),
        switches=count(seen.overruled),
        refused=refused.sum((1, 2)),
        resumed=resumed,
        people=np.rint(standing.sum((1, 2))).astype(np.int64),
        unused=(seen.track >= 0).sum((0, 2)) - present.sum((0, 1)),
        no_people=dropped,
        reasons=reasons,
    )
