"""Association: one detection per camera and time for each person, if several people are seen."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float, Int64, best_pairs, known_median
from pipelines.geometry.poses import matrix_from_quaternion, quaternion_from_rotation_vector
from pipelines.keypoints.bodies import SAME_BODY_M, Bodies, SightLines, find_bodies, meeting_points, rays_of

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
    refused: Int64  # [P] camera-frames with detections, none of them the person that other cameras see
    resumed: Int64  # [P] times the person was lost by all and taken up again
    people: Int64  # [T] people whom at least two cameras see
    unused: Int64  # [C] usable detections, over all times, that belong to none of the chosen people
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

    Detections are grouped into bodies (see `bodies`); where several are seen, again without the pose errors
    that all bodies of a picture share. Of the bodies each logged person is the one that fits their log best,
    with the greatest sum over all; nobody stands in for a logged person whom no camera sees. Others are those
    seen in most camera-frames by two cameras or more, ties by confidence. A lone view is kept where its
    picture continues the person's last one.

    `xy` [T, C, D, J, 2] are undistorted and normalised, NaN for nothing; joints of `confidence` 0 or NaN are
    not used; poses [T, C, ...] are world_from_camera, NaN without one; `sigma` [T, C] rad is that of a ray
    per axis, by pixels, poses and clocks. `actors` [T, A, 3] m were logged, NaN where unknown, with
    `actor_sigma_m` per axis; of several that is the largest, and is estimated from bodies that three cameras
    place. `people` None: those who were logged and whoever else is a person (`why_no_person`), at least one.
    """
    if confidence.shape[2] == 0:  # no detections at all: make room for one absent person
        xy = np.full((*xy.shape[:2], 1, *xy.shape[3:]), np.nan)
        confidence = np.zeros(xy.shape[:-1])
    logs, noise_m = None, actor_sigma_m
    logged = [] if actors is None else [actors[:, k] for k in range(actors.shape[1])]
    if logged:
        logs = np.stack([np.c_[log, np.full(len(log), actor_sigma_m)] for log in logged], axis=1)
    views = SightLines(xy, confidence, position, rotation, sigma)
    seen = find_bodies(time_s, views, logs)
    again = False
    if logs is not None and len(logged) > 1:
        noise_m = _noise_of_logs_m(seen, logs[..., :3], actor_sigma_m)
        logs[..., 3] = noise_m
        again = noise_m < actor_sigma_m
    if ((seen.track >= 0).sum(axis=-1) > 1).any():
        views, before = without_common_errors(time_s, views, seen), views
        again |= views is not before
    if again:
        seen = find_bodies(time_s, views, logs, seen)
    xy, confidence = views.xy, views.confidence
    tracks = _tracks(seen, np.where(np.isfinite(xy).all(-1) & (confidence > 0), confidence, 0.0))
    near, unseen, reasons = _near_logs(tracks, logged, noise_m, actor_sigma_m)
    chains, tracks = _chains(tracks, time_s, near, people)
    refused: Counter[str] = Counter()
    if scene is not None and scene.ground is None:
        scene = scene._replace(ground=level_of_most_seen(seen))
    # Bodies are judged by the noise that they have.
    views = views._replace(sigma=views.sigma * max(seen.noise, 1.0))
    if people is None:
        refused = _add_people(chains, tracks, time_s, seen.track, views, scene)
    bodies = [chain.body(seen.track) for chain in chains]
    doubts = tuple(why_no_body(body, views, scene) for body in bodies)
    chosen = np.stack([body.choice for body in bodies], axis=-1)
    resumed = np.array([max(0, len(chain.taken) - 1) for chain in chains], np.int64)
    if not np.any(chosen >= 0):
        reasons.append("no two cameras agree on anybody: check poses, clocks and the stated noise")
    return _counted(chosen, seen, resumed, refused, doubts, unseen, tuple(reasons))


def associate_one_camera(
    time_s: Float,
    views: SightLines,
    *,
    actors: Float | None = None,
    actor_sigma_m: float = 1.0,
    people: int | None = 1,
) -> Association:
    """Choose the detections of people in one camera, as `associate` does: the logged first, then most seen.

    A body that is seen at other times than a person continues them. Without a number of people (None) those
    who were logged are chosen, and whoever else is seen for half as long as the first.
    """
    logs = None if actors is None else np.append(actors, np.full((*actors.shape[:2], 1), actor_sigma_m), -1)
    seen = find_bodies(time_s, views, logs)
    track, there = seen.track[:, 0], np.isfinite(views.xy).all(axis=-1) & (views.confidence > 0)
    trust = np.where(there, views.confidence, 0.0).sum(axis=(1, 3))
    ray = rays_of(views.xy[:, 0], np.nan_to_num(views.rotation[:, 0, None]))
    middle = known_median(np.where(there[:, 0, ..., None], ray, np.nan), axis=2)
    bodies = []
    for identity in np.unique(track[track >= 0]).tolist():
        time, detection = np.nonzero(track == identity)
        away = np.full((1 if actors is None else actors.shape[1], len(time)), np.nan)
        if actors is not None:
            sight = np.swapaxes(actors[time], 0, 1) - views.position[time, 0]
            away = np.linalg.norm(np.cross(middle[time, detection], sight), axis=-1) ** 2
            away /= actor_sigma_m**2 + _LOGGED_POINT_M**2
        near = np.nansum(_NEAR_CHI2 - np.minimum(away, _FAR_CHI2), axis=1)
        bodies.append((identity, time, near, float(trust[time].sum())))
    reasons: list[str] = []
    if actors is not None and bodies and not any((near > 0).any() for _, _, near, _ in bodies):
        reasons.append("nobody is near the logged actor: taken is who is seen most")
        actors = None
    chosen, total = np.full((len(time_s), 1, 0), -1, np.int64), 0.0
    wanted = (0 if actors is None else actors.shape[1]) if people is None else people
    resumed: list[int] = []
    unseen: list[int] = []
    while bodies and (chosen.shape[2] < max(wanted, 1) or people is None):
        person = chosen.shape[2]
        logged = actors is not None and person < actors.shape[1]
        if logged and not any(body[2][person] > 0 for body in bodies):
            chosen, resumed = np.append(chosen, np.full((len(time_s), 1, 1), -1), axis=2), [*resumed, 0]
            unseen.append(person)
            continue
        rank = [(body[2][person] if logged else 0.0, body[3]) for body in bodies]
        first = bodies.pop(max(range(len(rank)), key=rank.__getitem__))
        if person >= max(wanted, 1) and first[3] < total / 2:
            break
        total = total or first[3]
        owner = np.full(len(time_s), -1, np.int64)
        owner[first[1]] = first[0]
        for body in sorted(bodies, key=lambda body: -body[3]):
            overlap = np.mean(owner[body[1]] >= 0) > _MAX_OVERLAP_SHARE
            if not overlap and (not logged or body[2][person] > 0):
                owner[body[1]] = body[0]
                bodies.remove(body)
        mine = (track == owner[:, None]) & (track >= 0)
        choice = np.where(mine.any(axis=1), mine.argmax(axis=1), -1)[:, None, None]
        chosen = np.concatenate([chosen, choice], axis=2)
        resumed.append(len(np.unique(owner[owner >= 0])) - 1)
    while chosen.shape[2] < max(wanted, 1):
        chosen, resumed = np.append(chosen, np.full((len(time_s), 1, 1), -1), axis=2), [*resumed, 0]
    doubts = ("",) * chosen.shape[2]
    return _counted(chosen, seen, np.array(resumed, np.int64), {}, doubts, tuple(unseen), tuple(reasons))


def _noise_of_logs_m(seen: Bodies, logs: Float, most_m: float) -> float:
    """Estimate the standard deviation on each axis (m) of the logs [T, A, 3] of several people."""
    sure = np.isfinite(seen.spread) & (seen.views > 2)
    apart = np.linalg.norm(seen.middle[sure][:, None] - logs[np.nonzero(sure)[0]], axis=-1)
    apart = apart[np.isfinite(apart).any(axis=1)]
    if not len(apart):
        return most_m
    return float(np.clip(np.median(np.nanmin(apart, axis=1)) / _MEDIAN_NORM_3D, _MIN_LOG_SIGMA_M, most_m))


def _near_logs(
    tracks: list[_BodyTrack], logged: list[Float], usual_m: float, most_m: float
) -> tuple[list[tuple[Float, float]], tuple[int, ...], list[str]]:
    """Give each log [T, 3] its standard deviation: `usual_m`, or `most_m` where no track is near by that."""
    logs = [(log, usual_m if _is_near(tracks, log, usual_m) else most_m) for log in logged]
    unseen = tuple(k for k, (log, sigma_m) in enumerate(logs) if not _is_near(tracks, log, sigma_m))
    if tracks and len(unseen) == len(logs):
        return [], (), [_far_from_log(tracks, log) for log in logged]
    return logs, (unseen if len(logs) > 1 else ()), []


def _is_near(tracks: list[_BodyTrack], log: Float, sigma_m: float) -> bool:
    return any(_likeness(track, log, sigma_m) > 0 for track in tracks)


def _tracks(seen: Bodies, confidence: Float) -> list[_BodyTrack]:
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
    """Chain tracks into people: those with logs together, each of the others after the one before."""
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
    """Add everybody else who is a person; return how many bodies are left out, by `why_no_person`."""
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
        row, person = best_pairs(np.maximum(likeness[open_], 0.0))
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


def _counted(
    chosen: Int64,
    seen: Bodies,
    resumed: Int64,
    phantoms: Mapping[str, int],
    doubts: tuple[str, ...],
    unseen: tuple[int, ...],
    reasons: tuple[str, ...],
) -> Association:
    present = (chosen >= 0).transpose(2, 0, 1)
    others_see = present.sum(-1, keepdims=True) > 1
    refused = ~present & others_see & (seen.track >= 0).any(-1)
    standing = np.where(
        seen.views > 1, 1.0 / np.maximum(seen.views, 1), 0.0
    )  # a body of n views counts n times 1/n
    return Association(
        choice=chosen,
        views=present.sum((1, 2)),
        refused=refused.sum((1, 2)),
        resumed=resumed,
        people=np.rint(standing.sum((1, 2))).astype(np.int64),
        unused=(seen.track >= 0).sum((0, 2)) - present.sum((0, 1)),
        phantoms=dict(sorted(phantoms.items())),
        doubts=doubts,
        unseen=unseen,
        reasons=reasons,
    )


# --- errors of a whole picture ---------------------------------------------------------------------------

# The errors of keypoints average out over this time, and those of poses hardly change.
_ERROR_WINDOW_S = 0.5
# The last round changes the disagreement by less than a tenth.
_TURNS = 3
# About this many joints are used, which is enough to average their errors.
_FEW_JOINTS = 8
# The rays of this many times take 30 MB of memory.
_TIMES_AT_ONCE = 2_000
# A larger correction means that the person may be none.
_MAX_CORRECTION_SIGMAS = 3.0
# If more of the first squares remains, the errors change from picture to picture.
_MAX_REMAINING_SHARE = 0.4
# Position errors move the far less than the near, so this share of the noise of rays remains.
_REMAINING_NOISE_SHARE = 0.7


def without_common_errors(time_s: Float, views: SightLines, seen: Bodies) -> SightLines:
    """Turn the cameras so that the views of the person seen most agree.

    A camera that is turned or shifted moves everybody in its picture by about the same. Without these errors,
    which the views of one body show, two people who stand near each other are further apart than the views of
    one person. Only the part on which views can disagree is found: cameras that all err alike still agree.
    Views with other rotations and less noise are returned; the same ones where the errors do not last, and
    without anybody whom two cameras see.
    """
    person = _most_seen(seen)
    if person is None:
        return views
    detection = np.where(person.any(axis=-1), person.argmax(axis=-1), -1)
    fewer = slice(None, None, max(1, views.xy.shape[3] // _FEW_JOINTS))
    few = views._replace(xy=views.xy[..., fewer, :], confidence=views.confidence[..., fewer])
    rotation = views.rotation.copy()
    total = np.zeros((*views.sigma.shape, 2))
    left = []
    for _ in range(_TURNS):
        missed = np.concatenate(
            [
                _missed(few, rotation, detection, slice(start, start + _TIMES_AT_ONCE))
                for start in range(0, len(time_s), _TIMES_AT_ONCE)
            ]
        )
        left.append(
            float(np.mean(missed**2, where=np.isfinite(missed))) if np.isfinite(missed).any() else 0.0
        )
        # A mean of means has no negative weight at any frequency, so the rounds do not amplify one.
        turn = np.stack([_mean(time_s, _mean(time_s, missed[:, c])) for c in range(missed.shape[1])], axis=1)
        total += turn
        across, along = np.moveaxis(turn, -1, 0)
        vector = np.stack([-along, across, np.zeros_like(across)], axis=-1)
        rotation = rotation @ matrix_from_quaternion(quaternion_from_rotation_vector(vector))
    small = np.hypot(*np.moveaxis(total, -1, 0)) <= _MAX_CORRECTION_SIGMAS * views.sigma
    if not left[-1] < _MAX_REMAINING_SHARE * left[0]:
        return views
    return views._replace(
        rotation=np.where(small[..., None, None], rotation, views.rotation),
        sigma=np.where(small, _REMAINING_NOISE_SHARE, 1.0) * views.sigma,
    )


def _most_seen(seen: Bodies) -> Bool | None:
    """Find the detections [T, C, D] of the track whom two cameras or more see most; None without one."""
    tracks, views = np.unique(seen.track[np.isfinite(seen.spread)], return_counts=True)
    if not len(tracks):
        return None
    person = np.isfinite(seen.spread) & (seen.track == tracks[views.argmax()])
    return np.asarray(person)


def _missed(views: SightLines, rotation: Float, detection: Int64, rows: slice) -> Float:
    """Compute how far a person's joints are from where they are seen [N, C, 2], median over joints."""
    taken = np.maximum(detection[rows], 0)[..., None, None]
    xy = np.take_along_axis(views.xy[rows], taken[..., None], axis=2)[:, :, 0]
    confidence = np.take_along_axis(views.confidence[rows], taken, axis=2)[:, :, 0]
    origin, rotation = np.nan_to_num(views.position[rows]), np.nan_to_num(rotation[rows])
    there = (detection[rows] >= 0)[..., None] & (confidence > 0) & np.isfinite(xy).all(axis=-1)
    there &= np.isfinite(views.position[rows][..., :1])
    rays = np.moveaxis(rays_of(xy, rotation), 1, 2)
    weight = np.moveaxis(np.asarray(there), 1, 2).astype(np.float64)
    points, _ = meeting_points(rays, np.broadcast_to(origin[:, None], rays.shape), weight)
    u, v, depth = np.einsum("ncji,nckj->inck", rotation, points[:, None] - origin[:, :, None])
    ahead = np.where(there & (depth > 0), depth, np.nan)
    return known_median(np.stack([u / ahead, v / ahead], axis=-1) - xy, axis=2)


def _mean(time_s: Float, values: Float) -> Float:
    """Average values [T, 2] within the window about each time; where none is, the nearest average; or 0."""
    known = np.isfinite(values[:, 0])
    if not known.any():
        return np.zeros_like(values)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(np.c_[np.nan_to_num(values), known], axis=0)])
    first = np.searchsorted(time_s, time_s - _ERROR_WINDOW_S / 2, side="left")
    last = np.searchsorted(time_s, time_s + _ERROR_WINDOW_S / 2, side="right")
    within = total[last] - total[first]
    rows = np.flatnonzero(within[:, 2] > 0)
    mean = within[rows, :2] / within[rows, 2:]
    return np.stack([np.interp(time_s, time_s[rows], column) for column in mean.T], axis=1)


# --- who is no person ------------------------------------------------------------------------------------

# A body has a size, and people stand on the ground: what several cameras see has a place, which is near the
# ground or not.

Ground = Callable[[Float], tuple[Float, Float]]
"""Function from points [N, 3] to the heights (m) [N] of the ground there and their errors; NaN if unknown."""

# The diagonal of the box about a body's joints: crouching, and arms stretched upwards.
_EXTENT_M = (0.8, 2.6)
# The middle of a body above the ground: lying in a hollow, and standing.
_HEIGHT_M = (-1.0, 1.6)
# More than this share of the times must speak against a person.
_MIN_REFUSED_SHARE = 0.5
# The place of a body counts if its standard deviation is smaller.
_MAX_PLACE_SIGMA_M = 1.0
# Who is in one picture with a person in a smaller share of the times is never beside them.
_MIN_COMPANY_SHARE = 0.05
# The ground may rise this much from where somebody went.
_MAX_SLOPE = 0.3
# The hip of a standing actor is this high above the ground.
_HIP_HEIGHT_M = 0.95
# The ground under a person is this uncertain, by posture and log.
_GROUND_SIGMA_M = 1.0


class Surroundings(NamedTuple):
    """Surroundings of the people, as far as they are known."""

    ground: Ground | None  # of a map or a log; without either it is that under who is seen most
    fields: Float  # [C, 4] left, top, right, bottom of each camera's picture, normalised


# Two cameras must see somebody for this long before they count as a person.
_MIN_SIGHT_S = 1.0
# A second body nearer to a person than this, never beside them in a picture, is theirs.
_SAME_PERSON_M = 0.5
# The median of chi-square per degree of freedom has an expectation of 1.
_MAX_MISFIT = 4.0
# A body is triangulated at this many times, which suffices for medians.
_SAMPLES = 200
# Where a level is all that is known, a crown at 3 m is not on the ground.
_DOUBTED_SHARE = 0.5


class PossiblePerson(NamedTuple):
    """Detections that may be one person over time."""

    choice: Int64  # [T, C] index of the detection in each camera, -1 none
    middle: Float  # [T, 3] m, NaN where fewer than two cameras see the body


def why_no_person(
    body: PossiblePerson,
    people: list[PossiblePerson],
    time_s: Float,
    views: SightLines,
    scene: Surroundings | None,
) -> str:
    """Say why a body that two cameras see is no further person to reconstruct; empty if it is one.

    "short": seen by two cameras for less than a second, or never together with anybody, as the pieces of one
    lost person; "same": alongside a person already taken, and never with them in one picture; "ground": too
    high or too low; "size": not of a person's extent; "misfit": the views do not fit each other; "bystander":
    beyond the ring of the cameras, and never in all of their pictures.
    """
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    there: Bool = np.isfinite(body.middle[:, 0])
    together = np.zeros(len(there), np.bool_)
    for other in people:
        both = there & np.isfinite(other.middle[:, 0])
        together |= both
        side_by_side: Bool = np.asarray(((body.choice >= 0) & (other.choice >= 0)).any(axis=1))
        apart = np.linalg.norm(body.middle - other.middle, axis=1)
        if (
            both.any()
            and np.median(apart[both]) < _SAME_PERSON_M
            and np.mean(side_by_side[both]) < _MIN_COMPANY_SHARE
        ):
            return "same"
    if (there if not people else together).sum() * step_s < _MIN_SIGHT_S:
        return "short"
    if cause := why_no_body(body, views, scene):
        return cause
    return "bystander" if scene is not None and _is_bystander(body, people, views, scene.fields) else ""


def why_no_body(body: PossiblePerson, views: SightLines, scene: Surroundings | None) -> str:
    """Say why detections are no body ("ground", "size" or "misfit", as `why_no_person`); empty if one."""
    rows = np.flatnonzero(np.isfinite(body.middle[:, 0]))
    if not len(rows):
        return ""
    if scene is not None and scene.ground is not None:
        level, doubt = scene.ground(body.middle[rows])
        height = body.middle[rows, 2] - level
        known = np.isfinite(height)
        slack = _DOUBTED_SHARE * doubt[known]
        off = (height[known] - slack > _HEIGHT_M[1]) | (height[known] + slack < _HEIGHT_M[0])
        if known.any() and off.mean() > _MIN_REFUSED_SHARE:
            return "ground"
    extent_m, misfit = _body_of(body.choice, rows[:: -(-len(rows) // _SAMPLES)], views)
    if not _EXTENT_M[0] <= extent_m <= _EXTENT_M[1]:
        return "size"
    return "misfit" if misfit > _MAX_MISFIT else ""


def _is_bystander(
    body: PossiblePerson, people: list[PossiblePerson], views: SightLines, fields: Float
) -> bool:
    """Test if a body stands beyond the cameras that film the people, and never in all of their pictures."""
    rows = np.flatnonzero(np.isfinite(body.middle[:, 0]))
    off = np.array([np.hypot(*(body.middle[rows] - one.middle[rows]).T[:2]) for one in people])
    if not np.isfinite(off).any():
        return False
    off = np.where(np.isfinite(off), off, np.inf)
    nearest = np.array([one.middle[rows] for one in people])[off.argmin(axis=0), np.arange(len(rows))]
    met = np.isfinite(nearest[:, 0])
    rows, nearest, apart = rows[met], nearest[met], off.min(axis=0)[met]
    position, rotation = views.position[rows], views.rotation[rows]
    posed = np.isfinite(position).all(axis=-1) & np.isfinite(rotation).all(axis=(-2, -1))
    ring = np.where(posed, np.hypot(*np.moveaxis(position - nearest[:, None], -1, 0)[:2]), np.nan)
    whole = np.ones(len(rows), np.bool_)
    for c, field in enumerate(fields):
        u, v, depth = np.einsum("nij,ni->jn", rotation[:, c], body.middle[rows] - position[:, c])
        left, top, right, bottom = field
        with np.errstate(invalid="ignore", divide="ignore"):
            across, along = u / depth, v / depth
            inside = (across > left) & (across < right) & (along > top) & (along < bottom)
        shown = np.asarray(inside & (depth > 0), dtype=np.bool_)
        whole &= shown | ~posed[:, c]
    beyond = apart > np.nanmedian(ring, axis=1)
    return bool(beyond.mean() > _MIN_REFUSED_SHARE and whole.mean() < _MIN_COMPANY_SHARE)


def _body_of(choice: Int64, rows: NDArray[np.intp], views: SightLines) -> tuple[float, float]:
    """Triangulate a body at some times [N] by least squares on its viewing rays."""
    time, camera = rows[:, None], np.arange(choice.shape[1])
    taken = np.maximum(choice[rows], 0)
    xy = views.xy[time, camera, taken]
    confidence = np.where((choice[rows] >= 0)[..., None], views.confidence[time, camera, taken], 0.0)
    seen = (confidence > 0) & np.isfinite(xy).all(axis=-1) & np.isfinite(views.position[rows])[..., :1]
    rays = np.moveaxis(rays_of(xy, np.nan_to_num(views.rotation[rows])), 1, 2)  # [N, J, C, 3]
    origin = np.nan_to_num(views.position[rows])[:, None]
    weight = np.moveaxis(seen, 1, 2).astype(np.float64)
    points, _ = meeting_points(rays, np.broadcast_to(origin, rays.shape), weight)
    several = np.isfinite(points[..., 0])
    box = np.nanmax(points, axis=1, initial=-np.inf) - np.nanmin(points, axis=1, initial=np.inf)
    extent = np.linalg.norm(box[several.sum(axis=1) > 1], axis=-1)
    sight = points[:, :, None] - origin
    off2 = (np.cross(rays, sight) ** 2).sum(axis=-1)
    variance = (views.sigma[rows][:, None] * np.linalg.norm(sight, axis=-1)) ** 2 + SAME_BODY_M**2
    used = (weight > 0) & several[..., None]
    square = np.where(used, off2 / variance, 0.0).sum(axis=2)
    misfit = (square / np.maximum(2 * used.sum(axis=2) - 3, 1))[several]
    if not len(extent):
        return np.nan, np.nan
    return float(np.median(extent)), float(np.median(misfit))


def level_of(hips: Float) -> Ground:
    """Return the ground at the level of somebody whose hips [A, 3] m were there, less certain far away."""
    way = hips[np.isfinite(hips).all(axis=1)]
    way = way[:: max(1, len(way) // 100)]

    def ground(points: Float) -> tuple[Float, Float]:
        away = np.stack([np.hypot(*(points[:, :2] - place[:2]).T) for place in way])
        nearest = away.argmin(axis=0)
        return way[nearest, 2] - _HIP_HEIGHT_M, _GROUND_SIGMA_M + _MAX_SLOPE * away.min(axis=0)

    return ground


def level_of_most_seen(seen: Bodies) -> Ground | None:
    """Return the level of the person whom several cameras see most; None without one."""
    placed = seen.spread < _MAX_PLACE_SIGMA_M
    people, views = np.unique(seen.track[placed], return_counts=True)
    if not len(people):
        return None
    return level_of(seen.middle[placed & (seen.track == people[views.argmax()])])
