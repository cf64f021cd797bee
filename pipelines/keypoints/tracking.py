"""Tracking of people through the pictures of one camera: search, identity, loss and return."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Picture
from pipelines.keypoints.hints import Hint
from pipelines.keypoints.tiles import (
    CROP_PER_HEIGHT,
    SIDE_PER_HEIGHT,
    Candidate,
    Tile,
    find_in,
    same_place,
    square_about,
    squares_about,
    tiles,
)
from pipelines.session.registries import KeypointNetworks, Person, Region

_PRESENT = 0.5
_STILL_PRESENT = 0.2  # of who was seen in the last picture, if the score is that of a person
_CENTRED = 0.3  # a margin (3 sigma) of this many heights, 0.1 per sigma, leaves the region good enough
_SMALLEST_PX = 8.0
_WIDER = (1.3, 1.0)  # factors on the last region of a person just lost
_PATIENCE = 5  # a person not seen is searched at the last place for this many pictures
_MEMORY = 30  # pictures after which a number is not given to the same place again
_ONE_BODY = 0.06  # median distance of joints, in region sides: about the scatter of one body's two estimates
_TILES_BESIDE = 8  # tiles searched in one picture while a person is followed
_TILES_ALONE = 24  # the same while nobody is followed
_TILES_OF_ONE = 4  # tiles searched in one picture while a person is followed and one is wanted
_JUDGED = 5  # pictures whose mean score decides if a track is a person
_ONE_PICTURE = 0.9  # of the least score: enough in a single picture
_BODY = (0.2, 0.5)  # of a region's side, across and along: the body in it; what a tile cuts there is a part
_TALLER = 1.3  # a region's side over that of the hint: bodies differ, and arms are raised
_SURE = 0.7  # score of the person detector: of a body that a tile cuts, below it is searched once more
_LOST = 30  # pictures without the actor after which the place of the hint is searched less often
_SEARCH_LOST = 5  # pictures from one such search to the next


@runtime_checkable
class TellsPeople(Protocol):
    """Networks whose confidences separate people from other things."""

    @property
    def person_confidence(self) -> float:
        """The least score of a person: the upper quartile of the joints' confidences."""


@dataclass(frozen=True)
class TrackedPerson:
    """Person seen in a picture, with the track number assigned when they were found."""

    track: int
    person: Person


@dataclass
class _Track:
    number: int
    person: Person
    missing: int = 0  # pictures since last seen
    scores: deque[float] = field(default_factory=lambda: deque(maxlen=_JUDGED))

    def see(self, person: Person) -> None:
        self.person, self.missing = person, 0
        self.scores.append(_score(person))

    def mean_score(self) -> float:
        return sum(self.scores) / len(self.scores)


class PeopleTracker:
    """Tracker of people through the pictures of one camera.

    A person is searched at the place of the joints in the last picture. The person detector runs around
    people just lost, and around the hint if the logged actor is not followed. It runs on tiles of the whole
    picture if nobody is followed, and every `search_every` pictures. Each such search takes the next few
    tiles, so that the cost of a large picture spreads over several. The first picture is searched until a
    person is found.

    With `only_one`, one person is wanted: fewer tiles are searched while somebody is followed. With a hint,
    those who cannot be the actor, by place or size, are not followed while somebody can, and the whole
    picture is searched only while nobody can: in each of the first 30 pictures, then in every fifth. The
    place of the hint is searched in turns, a square every `search_every` pictures, because the one who is
    followed may be somebody who stands near.

    Things that are no people are dropped by their scores, where the networks say which (`TellsPeople`). The
    only track is kept, and so is the only one that can be the actor.

    Results depend only on the pictures and hints so far.

    Attributes:
        counts: frames; searched (frames in which the person detector ran); found (new numbers); lost
            (not seen for more than 5 frames); found again (at the place where they were lost, under the
            old number); merged (two numbers on one body, the older stays); beyond the most (people
            found but not followed, in each search again); no people (tracks dropped by their scores);
            not the actor (tracks dropped by place or size); without anybody (frames).
    """

    def __init__(
        self,
        networks: KeypointNetworks,
        *,
        only_one: bool = False,
        most_people: int = 6,
        search_every: int = 10,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._networks = networks
        self._least_score = networks.person_confidence if isinstance(networks, TellsPeople) else 0.0
        self._only_one = only_one
        self._most_people = most_people
        self._search_every = search_every
        self._tracks: list[_Track] = []
        self._next_number = 0
        self._next_tile = 0
        self._next_square = 0
        self._without_actor = 0  # pictures, with hints, since somebody was seen who can be the actor

    def step(self, picture: Picture, *, hint: Hint | None) -> list[TrackedPerson]:
        """Find the people in the next picture.

        Args:
            picture: [H, W, 3] BGR.
            hint: place of the actor by the log, None if unknown.

        Returns:
            The people seen in this picture, sorted by number.
        """
        self._follow(picture)
        self._merge()
        self._drop(hint)
        self._search(picture, hint)
        self._drop(hint)
        if hint is not None:
            self._without_actor = 0 if self._follows(hint) else self._without_actor + 1
        self.counts["frames"] += 1
        seen = sorted(self._seen(), key=lambda track: track.number)
        self.counts["without anybody"] += not seen
        return [TrackedPerson(track.number, track.person) for track in seen]

    # --- those known -----------------------------------------------------------------------------------

    def _follow(self, picture: Picture) -> None:
        """Search each person at the last place; two passes for those not seen in the last picture."""
        followed, missed = self._seen(), self._missed()
        for track in self._tracks:
            track.missing += 1
        regions = [track.person.region for track in followed]
        for track, person in zip(followed, self._locate(picture, regions, followed=True), strict=True):
            if person is not None:
                track.see(person)
        for share in _WIDER:
            still = [track for track in missed if track.missing]
            wide = [replace(t.person.region, side=t.person.region.side * share) for t in still]
            for track, person in zip(still, self._locate_twice(picture, wide), strict=True):
                # A person hidden behind another one must not return as that one.
                if person is not None and not self._is_followed(person):
                    track.see(person)
        self.counts["lost"] += sum(track.missing == _PATIENCE + 1 for track in self._tracks)
        self._tracks = [track for track in self._tracks if track.missing <= _MEMORY]

    def _merge(self) -> None:
        """Merge tracks on one body; the older one stays."""
        kept: list[_Track] = []
        for track in sorted(self._seen(), key=lambda track: track.number):
            if any(_one_body(track.person, older.person) for older in kept):
                self._tracks.remove(track)
                self.counts["merged"] += 1
            else:
                kept.append(track)

    def _drop(self, hint: Hint | None) -> None:
        """Drop those who are not the actor and things that are no people, if somebody better is seen."""
        seen = self._seen()
        actors = [track for track in seen if _agrees(track.person.region, hint)]
        if self._only_one and actors:
            self._remove([t for t in seen if t not in actors], "not the actor")
            seen = actors
        no_people = [track for track in self._tracks if self._is_no_person(track)]
        # Who can be the actor is replaced only by somebody else who can, and anybody by a person.
        rivals = actors or seen
        if rivals and all(track in no_people for track in rivals):
            no_people.remove(max(rivals, key=_Track.mean_score))
        self._remove(no_people, "no people")

    def _remove(self, tracks: Sequence[_Track], cause: str) -> None:
        self._tracks = [track for track in self._tracks if track not in tracks]
        self.counts[cause] += len(tracks)

    def _is_no_person(self, track: _Track) -> bool:
        """Test the mean score of a few pictures, or of those seen so far if the track is lost."""
        known = len(track.scores) == _JUDGED or track.missing
        return bool(known) and track.mean_score() < self._least_score

    # --- those to be found -----------------------------------------------------------------------------

    def _search(self, picture: Picture, hint: Hint | None) -> None:
        height, width = picture.shape[:2]
        frame = self.counts["frames"]
        parts = [
            square_about(t.person.region.centre, _detector_side(t.person.region), width, height)
            for t in self._missed()
        ]
        if hint:
            parts += self._squares(hint, width, height)
        if parts:
            self._take_up(picture, find_in(self._networks, picture, parts), hint)
        if hint and hint.margin_px <= _CENTRED * hint.height_px and not self._follows(hint):
            self._take_up_one(picture, Region(hint.centre, SIDE_PER_HEIGHT * hint.height_px), hint)
        due = frame % self._search_every == 0
        tiled = due or not self._seen()
        if self._only_one and hint is not None:
            tiled = tiled and not self._follows(hint) and self._is_hint_due()
        if tiled:
            self._search_tiles(picture, hint)
        self.counts["searched"] += bool(parts) or tiled

    def _squares(self, hint: Hint, width: int, height: int) -> list[Tile]:
        """List the squares about the hint that are searched in this picture."""
        squares = squares_about(hint.centre, hint.height_px, hint.margin_px, width, height)
        frame = self.counts["frames"]
        actors = [track for track in self._seen() if _agrees(track.person.region, hint)]
        if not actors:
            return squares if self._is_hint_due() else []
        if not self._only_one or frame % self._search_every:
            return []
        if all(self._is_no_person(track) for track in actors):
            return squares
        self._next_square = (self._next_square + 1) % len(squares)
        return [squares[self._next_square]]

    def _is_hint_due(self) -> bool:
        """Test if the actor, who is not seen, is searched in this picture."""
        return self._without_actor < _LOST or self.counts["frames"] % _SEARCH_LOST == 0

    def _search_tiles(self, picture: Picture, hint: Hint | None) -> None:
        """Search the next tiles in turn; in the first picture all of them, until a person is found."""
        cover = tiles(picture.shape[1], picture.shape[0])
        first = self.counts["frames"] == 0
        while True:
            if first and self._only_one and not self._next_tile:
                count = sum(max(tile.width, tile.height) >= min(picture.shape[:2]) for tile in cover)
            elif self._seen():
                count = _TILES_OF_ONE if self._only_one else _TILES_BESIDE
            else:
                count = _TILES_ALONE
            parts = [cover[(self._next_tile + i) % len(cover)] for i in range(min(count, len(cover)))]
            self._next_tile += len(parts)
            self._take_up(picture, find_in(self._networks, picture, parts), hint)
            if not first or self._seen() or self._next_tile >= len(cover):
                break

    def _take_up(self, picture: Picture, found: Iterable[Candidate], hint: Hint | None) -> None:
        """Follow the people found who are not followed already, best first."""
        only_actor = self._only_one and hint is not None
        if only_actor:
            found = sorted(found, key=lambda each: not _agrees(each.region, hint))
        for each in found:
            if only_actor and self._follows(hint) and not _agrees(each.region, hint):
                break
            if self._is_part_of_seen(each, hint):
                continue
            if each.cut and each.score < _SURE and self._seen():
                # A search about the place is cheaper than the landmarks of a limb or a tree.
                about = square_about(each.region.centre, _detector_side(each.region), *picture.shape[1::-1])
                again = find_in(self._networks, picture, [about])
                whole = [other for other in again if not other.cut and not self._is_part_of_seen(other, hint)]
                if not whole:
                    continue
                each = whole[0]  # noqa: PLW2901  # the same body, whole
            self._take_up_one(picture, each.region, hint)

    def _take_up_one(self, picture: Picture, region: Region, hint: Hint | None) -> None:
        """Follow the person in a region, if there is one who is not followed already."""
        person = self._locate_new(picture, region, hint)
        if person is None or self._is_followed(person, hint):
            return
        if (known := self._lost_at(person.region)) is not None and self._has_place_for(known):
            self.counts["found again"] += known.missing > _PATIENCE
            known.see(person)
            return
        if not self._has_place_for(None) and _agrees(person.region, hint):
            self._make_place(hint)
        if self._has_place_for(None):
            track = _Track(self._next_number, person)
            track.see(person)
            self._tracks.append(track)
            self._next_number += 1
            self.counts["found"] += 1
        else:
            self.counts["beyond the most"] += 1

    def _lost_at(self, region: Region) -> _Track | None:
        """Find the track lost nearest to that place, within the region's side; None if there is none."""
        reach = [
            (math.dist(track.person.region.centre, region.centre), track.number, track)
            for track in self._tracks
            if track.missing
        ]
        distance, _, track = min(reach, default=(math.inf, 0, None))
        return track if distance < region.side else None

    def _has_place_for(self, track: _Track | None) -> bool:
        """Test if another person may be followed; people just lost keep their place."""
        held = [other for other in self._tracks if other.missing <= _PATIENCE]
        return track in held or len(held) < self._most_people

    def _make_place(self, hint: Hint | None) -> None:
        """Drop the newest track that cannot be the actor: bystanders must not keep the actor out."""
        others = [t for t in self._tracks if t.missing <= _PATIENCE and not _agrees(t.person.region, hint)]
        if others:
            self._tracks.remove(max(others, key=lambda track: track.number))
            self.counts["lost"] += 1

    # --- small questions -------------------------------------------------------------------------------

    def _seen(self) -> list[_Track]:
        return [track for track in self._tracks if track.missing == 0]

    def _missed(self) -> list[_Track]:
        """List those just lost who were seen for a few pictures; the others too while nobody is seen."""
        lost = [track for track in self._tracks if 0 < track.missing <= _PATIENCE]
        return [track for track in lost if len(track.scores) == _JUDGED] if self._seen() else lost

    def _follows(self, hint: Hint | None) -> bool:
        """Test if somebody is seen who can be the actor."""
        return any(_agrees(track.person.region, hint) for track in self._seen())

    def _is_part_of_seen(self, candidate: Candidate, hint: Hint | None) -> bool:
        return any(_is_part_of(candidate, track) for track in self._seen_at(candidate.region, hint))

    def _is_followed(self, person: Person, hint: Hint | None = None) -> bool:
        """Test if a person is followed, by place or joints: a poor second estimate is no second person."""
        return any(
            same_place(person.region, track.person.region) or _one_body(person, track.person)
            for track in self._seen_at(person.region, hint)
        )

    def _seen_at(self, region: Region, hint: Hint | None) -> list[_Track]:
        """List those seen; if the region can be the actor's, without those too large or too far for that."""
        return [
            track for track in self._seen() if not _agrees(region, hint) or _agrees(track.person.region, hint)
        ]

    def _locate(
        self, picture: Picture, regions: Sequence[Region], *, followed: bool = False
    ) -> list[Person | None]:
        """Locate the person in each region, None if there is none.

        Who is followed may have a low presence in a single picture: the joints' confidences are surer.
        """
        if not regions:
            return []
        return [
            person
            if _is_within(person, picture)
            and (
                person.presence >= _PRESENT
                or (
                    followed and person.presence >= _STILL_PRESENT and _score(person) >= self._least_score > 0
                )
            )
            else None
            for person in self._networks.locate(picture, regions)
        ]

    def _locate_twice(self, picture: Picture, regions: Sequence[Region]) -> list[Person | None]:
        """Locate people twice, for regions not from their own joints: one pass alone flips left and right."""
        first = self._locate(picture, regions)
        second = iter(self._locate(picture, [person.region for person in first if person is not None]))
        return [None if person is None else next(second) for person in first]

    def _locate_new(self, picture: Picture, region: Region, hint: Hint | None) -> Person | None:
        """Locate a person twice; None for a thing that is no person, if somebody is seen already.

        Who can be the actor, and the first one, are judged by a few pictures instead.
        """
        for _ in range(2):
            (person,) = self._locate(picture, [region])
            if person is None:
                return None
            if (
                self._seen()
                and not _agrees(person.region, hint)
                and _score(person) < _ONE_PICTURE * self._least_score
            ):
                self.counts["no people"] += 1
                return None
            region = person.region
        return person


def _is_within(person: Person, picture: Picture) -> bool:
    """Test if a person has a region that the next picture can be searched in."""
    region, (height, width) = person.region, picture.shape[:2]
    x, y = region.centre
    reach = region.side / 2
    within = -reach <= x <= width + reach and -reach <= y <= height + reach
    return _SMALLEST_PX <= region.side < math.inf and within


def _one_body(a: Person, b: Person) -> bool:
    """Test if most joints of two people are at the same places; False if no joint was found in both."""
    distance: NDArray[np.float64] = np.linalg.norm(a.xy - b.xy, axis=1)
    distance = distance[np.isfinite(distance)]
    if not distance.size:
        return False
    return float(np.median(distance)) < _ONE_BODY * max(a.region.side, b.region.side)


def _is_part_of(candidate: Candidate, track: _Track) -> bool:
    """Test if a candidate is a person who is followed, whole or cut by a tile."""
    followed = track.person.region
    apart = np.abs(np.subtract(candidate.region.centre, followed.centre)) / followed.side
    return same_place(candidate.region, followed) or (candidate.cut and bool((apart < _BODY).all()))


def _agrees(region: Region, hint: Hint | None) -> bool:
    """Test if a person can be the logged actor, by place and size; False without a hint."""
    if hint is None:
        return False
    near = math.dist(region.centre, hint.centre) <= hint.margin_px + hint.height_px / 2
    return near and region.side <= _TALLER * SIDE_PER_HEIGHT * hint.tallest_px


def _score(person: Person) -> float:
    """Return the upper quartile of the joints' confidences: a person may be hidden or cut off in part."""
    return float(np.quantile(np.nan_to_num(person.confidence), 0.75))


def _detector_side(region: Region) -> float:
    return CROP_PER_HEIGHT / SIDE_PER_HEIGHT * region.side


class FollowedPeople:
    """Tracker of the people in the pictures of one camera, built on `PeopleTracker`.

    Args:
        networks: the detector, loaded.
        joints: the J whose keypoints are wanted; those that the detector does not have are never found.
        only_one: nobody but one person is in the pictures.
    """

    def __init__(self, networks: KeypointNetworks, joints: Sequence[str], *, only_one: bool) -> None:
        self._tracker = PeopleTracker(networks, only_one=only_one)
        self._column = [networks.joints.index(name) if name in networks.joints else None for name in joints]

    def step(self, picture: Picture, *, hint: Hint | None) -> tuple[Float, Float]:
        """Return the keypoints of the K people in the next picture, the highest presence first.

        Args:
            picture: [H, W, 3] BGR.
            hint: place of the actor by the log, None if unknown.

        Returns:
            Positions [K, J, 2] px, NaN for joints not found, and confidences [K, J], 0 for joints not found.
        """
        people = [seen.person for seen in self._tracker.step(picture, hint=hint)]
        xy, confidence = (
            np.full((len(people), len(self._column), 2), np.nan),
            np.zeros((len(people), len(self._column))),
        )
        for i, person in enumerate(sorted(people, key=lambda person: -person.presence)):
            for j, k in enumerate(self._column):
                if k is not None:
                    xy[i, j], confidence[i, j] = person.xy[k], person.confidence[k]
        confidence[np.isnan(xy).any(axis=-1)] = 0.0
        return xy, confidence
