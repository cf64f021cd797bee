"""Association: one detection per camera and time for each person, if several people are seen."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from pipelines.geometry.arrays import Bool, Float
from pipelines.keypoints.common_errors import without_common_errors
from pipelines.keypoints.exchanges import undo_exchanges
from pipelines.keypoints.grouping import TracksOfDetections, follow
from pipelines.keypoints.no_people import (
    PossiblePerson,
    SightLines,
    Surroundings,
    level_of_most_seen,
    tell_no_people,
    why_no_body,
    why_no_person,
)

Int64 = NDArray[np.int64]

# Within 3 sigma of the logged actor counts for a track, beyond it against the track.
_NEAR_CHI2 = 9.0
# Beyond 5 sigma a track is not the actor at that time.
_FAR_CHI2 = 25.0
# The log's point (hip, a tag, a phone) lies this far from the middle of the joints.
_LOGGED_POINT_M = 0.5
# Logs of people claim less error than they have, so at least this is assumed.
_MIN_LOG_SIGMA_M = 0.2
# A vector of three components with a standard deviation of 1 has this median length.
_MEDIAN_NORM_3D = 1.54
# A lost person is not resumed further away than a run.
_RUN_M_PER_S = 3.0
# The middle of a body moves by this much with the joints that are seen.
_RESUME_REACH_M = 1.0
# More people than this are a crowd, which no formation films apart.
_MAX_PEOPLE = 12
# A track that continues a person may overlap with them in this share of its frames.
_MAX_OVERLAP_SHARE = 0.05


@dataclass(frozen=True)
class Association:
    """Assignment of detections to people. T times, C cameras, P people; those who were logged come first."""

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
    phantoms: dict[str, int]  # bodies that two cameras see and that are left out, by `why_no_person`
    doubts: tuple[str, ...]  # [P] why each of the people may be nobody, by `why_no_body`; "" without a doubt
    unseen: tuple[int, ...]  # of several logged people, those near whose logs nobody is seen
    reasons: tuple[str, ...]  # messages for the user, one line each


@dataclass(frozen=True)
class _BodyTrack:
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
    actors: Float | None = None,
    actor_sigma_m: float = 1.0,
    people: int | None = 1,
    scene: Surroundings | None = None,
) -> Association:
    """Choose the detections of the people who were logged, then of others, most seen first.

    Detections of different cameras are grouped into bodies by how near their viewing rays pass each
    other, in units of the stated angular noise, and bodies are followed over time by the continuity of
    each camera's picture and by their place (see `grouping`). Where several are seen, this is done again
    without the pose errors that all bodies of a picture share (`common_errors`). Of the bodies each logged
    person is the one that fits their log best, so that the sum over all of them is greatest; nobody stands in
    for a logged person whom no camera sees. Others are those seen in most camera-frames by two cameras or
    more, ties by confidence. The order of detections within a camera and frame does not matter.

    Args:
        time_s: [T] seconds, strictly increasing.
        xy: [T, C, D, J, 2] undistorted normalised picture coordinates, NaN where there is nothing. A few
            well-detected joints (8 or so) are enough where memory is short; at least 3 must be common.
        confidence: [T, C, D, J]; joints with 0 or NaN are not used.
        position: [T, C, 3] m, world_from_camera; NaN: the camera has no pose and gets no choice.
        rotation: [T, C, 3, 3] world_from_camera.
        sigma: [T, C] rad, standard deviation of a viewing ray on each axis: pixel and pose noise, and
            clock error times the actor's angular speed.
        actors: [T, A, 3] m, the people who were logged, person 0 first, NaN where unknown. If no log is
            near anybody, none is used.
        actor_sigma_m: standard deviation of the logs on each axis; the largest one if several people are
            logged, whose noise is estimated from bodies that three cameras place.
        people: number of people to choose; None: those who were logged and whoever else is a person as far
            as two cameras or more can tell (`why_no_person`), at least one.
        scene: the surroundings, by which things that are no people are dropped; by default nothing is.

    Returns:
        The choice and its counts. A lone view is kept where its picture continues the person's last one.
    """
    if confidence.shape[2] == 0:  # no detections at all: make room for one absent person
        xy = np.full((*xy.shape[:2], 1, *xy.shape[3:]), np.nan)
        confidence = np.zeros(xy.shape[:-1])
    logs, noise_m = None, actor_sigma_m
    logged = [] if actors is None else [actors[:, k] for k in range(actors.shape[1])]
    if logged:
        logs = np.stack([np.c_[log, np.full(len(log), actor_sigma_m)] for log in logged], axis=1)
    views = SightLines(xy, confidence, position, rotation, sigma)
    seen = follow(time_s, *views, logs)
    dropped: dict[str, Int64] = {}
    kept = seen.track >= 0
    if scene is not None:
        things = tell_no_people(seen, *views, scene)
        dropped = {cause: which.sum((0, 2)) for cause, which in things._asdict().items()}
        kept &= ~(things.ground | things.alone)
    again = bool((kept != (seen.track >= 0)).any())
    if again:
        views = views._replace(confidence=np.where(kept[..., None], confidence, 0.0))
    several = bool((kept.sum(axis=-1) > 1).any())
    if logs is not None and len(logged) > 1:
        noise_m = _noise_of_logs_m(seen, logs[..., :3], actor_sigma_m)
        logs[..., 3] = noise_m
        again |= noise_m < actor_sigma_m
    if several:
        views, before = without_common_errors(time_s, views, undo_exchanges(time_s, views, seen)), views
        again |= views is not before
    if again:
        seen = follow(time_s, *views, logs)
        seen = undo_exchanges(time_s, views, seen) if several else seen
    xy, confidence = views.xy, views.confidence
    tracks = _tracks(seen, np.where(np.isfinite(xy).all(-1) & (confidence > 0), confidence, 0.0))
    near, unseen, reasons = _near_logs(tracks, logged, noise_m, actor_sigma_m)
    chains, tracks = _chains(tracks, time_s, near, people)
    refused: Counter[str] = Counter()
    if scene is not None and scene.ground is None:
        scene = scene._replace(ground=level_of_most_seen(seen))
    if people is None:
        refused = _add_people(chains, tracks, time_s, seen.track, views, scene)
    bodies = [chain.body(seen.track) for chain in chains]
    doubts = tuple(why_no_body(body, views, scene) for body in bodies)
    chosen = np.stack([body.choice for body in bodies], axis=-1)
    resumed = np.array([max(0, len(chain.taken) - 1) for chain in chains], np.int64)
    if not np.any(chosen >= 0):
        reasons.append(_nobody(seen.nearest))
    return _counted(chosen, seen, resumed, dropped, refused, doubts, unseen, tuple(reasons))


def _noise_of_logs_m(seen: TracksOfDetections, logs: Float, most_m: float) -> float:
    """Estimate the standard deviation on each axis (m) of the logs [T, A, 3] of several people.

    Bodies that three cameras or more place are right. Their median distance to the nearest log gives one
    value for all logs, between 0.2 m and `most_m`. In a crowd a small value separates neighbours. Without
    such a body it is `most_m`.
    """
    sure = np.isfinite(seen.spread) & (seen.views > 2)
    apart = np.linalg.norm(seen.middle[sure][:, None] - logs[np.nonzero(sure)[0]], axis=-1)
    apart = apart[np.isfinite(apart).any(axis=1)]
    if not len(apart):
        return most_m
    return float(np.clip(np.median(np.nanmin(apart, axis=1)) / _MEDIAN_NORM_3D, _MIN_LOG_SIGMA_M, most_m))


def _near_logs(
    tracks: list[_BodyTrack], logged: list[Float], usual_m: float, most_m: float
) -> tuple[list[tuple[Float, float]], tuple[int, ...], list[str]]:
    """Give each log [T, 3] its standard deviation: `usual_m`, or `most_m` where no track is near by that.

    Returns:
        The logs that are used, with their standard deviations: all, or none if there are tracks and none of
        them is near any log. The numbers of those of several logs that no track is near. Messages.
    """
    logs = [(log, usual_m if _is_near(tracks, log, usual_m) else most_m) for log in logged]
    unseen = tuple(k for k, (log, sigma_m) in enumerate(logs) if not _is_near(tracks, log, sigma_m))
    if tracks and len(unseen) == len(logs):
        return [], (), [_far_from_log(tracks, log) for log in logged]
    return logs, (unseen if len(logs) > 1 else ()), []


def _is_near(tracks: list[_BodyTrack], log: Float, sigma_m: float) -> bool:
    return any(_likeness(track, log, sigma_m) > 0 for track in tracks)


def _tracks(seen: TracksOfDetections, confidence: Float) -> list[_BodyTrack]:
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
            _BodyTrack(
                int(identity[start]), at[0], seen.views[at], seen.middle[at], seen.spread[at], float(trust)
            )
        )
    return found


def _squares(track: _BodyTrack, log: Float, sigma_m: float) -> Float:
    """Compute the squared, whitened distance of a track from the log; NaN where the log has no value."""
    variance = sigma_m**2 + _LOGGED_POINT_M**2 + track.spread**2
    squares: Float = ((track.middle - log[track.time]) ** 2).sum(-1) / variance
    return squares


def _likeness(track: _BodyTrack, log: Float | None, sigma_m: float) -> float:
    """Compute the evidence that a track is the logged actor; 0 without a log."""
    if log is None:
        return 0.0
    return float(np.nansum(track.views * (_NEAR_CHI2 - np.minimum(_squares(track, log, sigma_m), _FAR_CHI2))))


class _PersonTracks:
    """Tracks that are one person, one after the other."""

    def __init__(self, time_s: Float, log: Float | None, sigma_m: float) -> None:
        self.owner = np.full(len(time_s), -1, np.int64)  # track at each time, -1 none, -2 refused by the log
        self.place = np.full((len(time_s), 3), np.nan)
        self.taken: list[int] = []
        self._time_s, self._log, self._sigma_m = time_s, log, sigma_m

    def likeness(self, track: _BodyTrack) -> float:
        """Compute the evidence that a track is this person by the log; 0 without a log."""
        return _likeness(track, self._log, self._sigma_m)

    def offer(self, track: _BodyTrack) -> bool:
        """Take a track for the times at which no camera saw the person, if it has any."""
        free = self.owner[track.time] < 0
        if not free.any():
            return False
        far = np.zeros(len(track.time), bool)
        if self._log is not None:
            far = _squares(track, self._log, self._sigma_m) > _FAR_CHI2
        self.owner[track.time[free & ~far]] = track.identity
        self.owner[track.time[free & far]] = -2
        self.place[track.time[free]] = track.middle[free]
        self.taken.append(track.identity)
        return True

    def offer_without_log(self, track: _BodyTrack) -> bool:
        """Take a track on which the log says nothing, if nobody or this person was seen before it."""
        if self.taken and not _continues(track, self.owner, self.place, self._time_s):
            return False
        return self.offer(track)

    def body(self, track: Int64) -> PossiblePerson:
        """Return the detections and places of the person, from the track [T, C, D] of each detection."""
        middle = np.where((self.owner >= 0)[:, None], self.place, np.nan)
        return PossiblePerson(_detections(track, self.owner, self.taken), middle)


def _chains(
    tracks: list[_BodyTrack], time_s: Float, logs: list[tuple[Float, float]], people: int | None
) -> tuple[list[_PersonTracks], list[_BodyTrack]]:
    """Chain tracks into people: those with logs together, each of the others after the one before.

    Args:
        tracks: all of them.
        time_s: [T] of their rows.
        logs: the hips [T, 3] m of each logged person, with their standard deviation on each axis, m.
        people: their number; None for those with logs, or one.

    Returns:
        The people (at least one), and the tracks that are nobody's.
    """
    tracks = sorted(tracks, key=lambda one: (-one.views.sum(), -one.confidence, one.identity))
    chains = [_PersonTracks(time_s, log, sigma_m) for log, sigma_m in logs]
    tracks = _by_logs(tracks, chains)
    chains = chains[:people]  # all of them for None
    while len(chains) < (people or 1):
        chain, tracks = _next_chain(tracks, time_s)
        chains.append(chain)
    return chains, tracks


def _next_chain(tracks: list[_BodyTrack], time_s: Float) -> tuple[_PersonTracks, list[_BodyTrack]]:
    """Chain the track seen most, and what continues it, into a person; also return the tracks left over."""
    chain = _PersonTracks(time_s, None, 1.0)
    return chain, [one for one in tracks if not chain.offer_without_log(one)]


def _add_people(
    chains: list[_PersonTracks],
    tracks: list[_BodyTrack],
    time_s: Float,
    track: Int64,
    views: SightLines,
    scene: Surroundings | None,
) -> Counter[str]:
    """Add everybody else who is a person; return how many bodies are left out, by `why_no_person`.

    Bodies come in the order of how much they are seen. After one that is seen too shortly there are only
    pieces of bodies, which are not counted.
    """
    refused: Counter[str] = Counter()
    people = [chain.body(track) for chain in chains if chain.taken]
    while tracks and len(chains) < _MAX_PEOPLE:
        chain, tracks = _next_chain(tracks, time_s)
        candidate = chain.body(track)
        cause = why_no_person(candidate, people, time_s, views, scene)
        if cause == "short":
            break
        if cause:
            refused[cause] += 1
            continue
        chains.append(chain)
        people.append(candidate)
    return refused


def _by_logs(tracks: list[_BodyTrack], chains: list[_PersonTracks]) -> list[_BodyTrack]:
    """Give tracks to logged people, as many at once as there are people, best sum first; return the rest."""
    if not chains or not tracks:
        return tracks
    likeness = np.array([[chain.likeness(one) for chain in chains] for one in tracks])
    left = np.ones(len(tracks), bool)
    spent = np.zeros(len(tracks), bool)
    while (open_ := np.flatnonzero(left & ~spent & (likeness > 0).any(axis=1))).size:
        row, person = linear_sum_assignment(np.maximum(likeness[open_], 0.0), maximize=True)
        for k, p in zip(open_[row].tolist(), person.tolist(), strict=True):
            if likeness[k, p] > 0:
                left[k] = not chains[p].offer(tracks[k])
                spent[k] = True
    for k, one in enumerate(tracks):
        said_nothing = left[k] and (likeness[k] == 0).any() and not (likeness[k] > 0).any()
        if said_nothing:
            ready = (chains[p] for p in np.flatnonzero(likeness[k] == 0).tolist() if chains[p].taken)
            left[k] = not any(chain.offer_without_log(one) for chain in ready)
    return [one for k, one in enumerate(tracks) if left[k]]


def _continues(track: _BodyTrack, owner: Int64, place: Float, time_s: Float) -> bool:
    """Test if a lost person can be this track: not beside it, and within reach before and after."""
    if np.mean(owner[track.time] >= 0) > _MAX_OVERLAP_SHARE:
        return False
    owned = np.flatnonzero(owner >= 0)
    for row, neighbour in ((0, owned[owned < track.time[0]][-1:]), (-1, owned[owned > track.time[-1]][:1])):
        for near in neighbour:
            gap_s = abs(time_s[track.time[row]] - time_s[near])
            reach = _RESUME_REACH_M + 3.0 * track.spread[row] + _RUN_M_PER_S * gap_s
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


def _far_from_log(tracks: list[_BodyTrack], log: Float) -> str:
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
    chosen: Int64,
    seen: TracksOfDetections,
    resumed: Int64,
    dropped: dict[str, Int64],
    phantoms: Mapping[str, int],
    doubts: tuple[str, ...],
    unseen: tuple[int, ...],
    reasons: tuple[str, ...],
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
        phantoms=dict(sorted(phantoms.items())),
        doubts=doubts,
        unseen=unseen,
        reasons=reasons,
    )
