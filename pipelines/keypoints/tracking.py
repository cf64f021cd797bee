"""Tracking of people through the pictures of one camera: search, identity, loss and return."""

import math
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Picture
from pipelines.keypoints.search import (
    CROP_PER_HEIGHT,
    SIDE_PER_HEIGHT,
    FoundPerson,
    Hint,
    Tile,
    find_in,
    same_place,
    square_about,
    squares_about,
    tiles,
)
from pipelines.session.registries import KeypointNetworks, Person, Region

# MediaPipe tracks a person from this presence on.
_PRESENT = 0.5
# Who was seen in the last picture counts from this presence on, with the score of a person.
_STILL_PRESENT = 0.2
# A margin (3 sigma) of this many heights leaves the region good enough.
_CENTRED_HEIGHTS = 0.3
# A smaller region shows no person.
_MIN_REGION_PX = 8.0
_WIDER = (1.3, 1.0)  # factors on the last region of a person just lost
# A person who is not seen is searched at the last place for this many pictures.
_PATIENCE_PICTURES = 5
# A number is not given to the same place again after this many pictures.
_MEMORY_PICTURES = 30
# Two estimates of one body scatter by this median distance of joints, in region sides.
_ONE_BODY_SIDES = 0.06
# While a person is followed, one picture has this many tiles searched, to save time.
_TILES_BESIDE = 8
# While nobody is followed, one picture has this many tiles searched.
_TILES_ALONE = 24
# The whole picture is searched once in this many pictures, because newcomers walk in slowly.
_SEARCH_EVERY = 5
# If one person is wanted, the whole picture is searched less often.
_SEARCH_OF_ONE = 10
# If one person is wanted and followed, fewer tiles are searched.
_TILES_OF_ONE = 4
# The mean score of this many pictures decides if a track is a person.
_JUDGED_PICTURES = 5
# Networks misplace the joints of somebody who is turned by more than 45 deg against the region, with a score
# that is lower than this. Nobody of the tuning flights has such a score where nothing hides them.
_SURE_OF_TURN = 0.65
# Regions turned by so much, rad, are looked at then: joints are right up to 30 deg beside a person's turn.
_TURNS_RAD = tuple(np.arange(1, 8) * np.pi / 4)
# A turn is right if the score is higher by this: wrong ones scatter by less.
_SURER = 0.1
# Somebody who stays unsure, since hidden, is looked at so once in this many pictures.
_TURN_EVERY = 3
# Networks recover less than half of a turn between pictures, so a region goes on turning as it turned. Those
# of people who walk, crouch and jump turn by less than the first; beyond the second, rad, it is no turn.
_TURNING_RAD, _MOST_TURNING_RAD = np.radians(5.0), np.radians(60.0)
# This share of the least score is enough in a single picture.
_SINGLE_SCORE_SHARE = 0.9
_BODY = (0.2, 0.5)  # of a region's side, across and along: the body in it; what a tile cuts there is a part
# A region's side is this much larger than the hint's: bodies differ, and arms are raised.
_TALLER = 1.3
# A body that a tile cuts is searched once more below this score of the person detector.
_SURE_SCORE = 0.7
# After this many pictures without a logged person, the place of the hint is searched less often.
_LOST_PICTURES = 30
# The place of a lost person is searched once in this many pictures.
_SEARCH_LOST = 5
# This distance is larger than that of any hint from any region.
_IMPOSSIBLE_PX = 1e6

Hints = Mapping[int, Hint]  # by the number of the logged person; only those whose place is known

_NOBODY: Hints = {}


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
class _PictureTrack:
    number: int
    person: Person
    missing: int = 0  # pictures since last seen
    turned_rad: float = 0.0  # by which the region turned in the last picture
    scores: deque[float] = field(default_factory=lambda: deque(maxlen=_JUDGED_PICTURES))

    def see(self, person: Person) -> None:
        turned = person.region.angle_rad - self.person.region.angle_rad
        self.turned_rad = 0.0 if self.missing > 1 else math.remainder(turned, math.tau)
        self.person, self.missing = person, 0
        self.scores.append(_score(person))

    def next_region(self) -> Region:
        """Return the region in which to search the next picture, turned on if the person turns."""
        region = self.person.region
        on = self.turned_rad if _TURNING_RAD < abs(self.turned_rad) < _MOST_TURNING_RAD else 0.0
        return replace(region, angle_rad=region.angle_rad + on)

    def mean_score(self) -> float:
        return sum(self.scores) / len(self.scores)


class PeopleTracker:
    """Tracker of people through the pictures of one camera; results depend only on pictures and hints so far.

    A person is searched at the place of the joints in the last picture. The person detector runs around
    people just lost, and around the hint of each logged person who is not seen (in the first 30 pictures,
    then every fifth), on tiles of the whole picture if nobody is followed, and every `search_every` pictures
    (10 with `only_one`, else 5), a few tiles each time.

    With `only_one` fewer tiles are searched while somebody is followed. With a hint, those who cannot be the
    actor, by place or size, are not followed while somebody can. Things that are no people are dropped by
    their scores, where the networks say which (`TellsPeople`), but never the only track.

    `counts` are frames; searched; found (new numbers); lost (not seen for more than 5 frames); found again;
    merged (two numbers on one body); beyond the most; no people; not the actor; turned (people located in a
    region of another turn); without anybody (frames).
    """

    def __init__(
        self,
        networks: KeypointNetworks,
        *,
        only_one: bool = False,
        most_people: int = 6,
        search_every: int | None = None,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._networks = networks
        self._least_score = networks.person_confidence if isinstance(networks, TellsPeople) else 0.0
        self._only_one = only_one
        self._most_people = most_people
        self._search_every = search_every or (_SEARCH_OF_ONE if only_one else _SEARCH_EVERY)
        self._tracks: list[_PictureTrack] = []
        self._next_number = 0
        self._next_tile = 0
        self._next_square = 0
        self._unseen_for: Counter[int] = Counter()  # pictures with a hint, since the logged person was seen

    def step(self, picture: Picture, *, hints: Sequence[Hint | None] = ()) -> list[TrackedPerson]:
        """Find the people in the next picture [H, W, 3] BGR, sorted by number.

        Hints are the places of logged people, None if unknown, in the same order for all pictures.
        """
        logged = {k: hint for k, hint in enumerate(hints) if hint is not None}
        self._most_people = max(self._most_people, len(hints))
        self._follow(picture)
        self._merge()
        self._drop(logged)
        self._search(picture, logged)
        self._drop(logged)
        unseen = self._unseen(logged)
        for k in logged:
            self._unseen_for[k] = self._unseen_for[k] + 1 if k in unseen else 0
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
        regions = [track.next_region() for track in followed]
        for track, person in zip(followed, self._locate(picture, regions, followed=True), strict=True):
            if (person := self._turned(picture, track, person)) is not None:
                track.see(person)
        for share in _WIDER:
            still = [track for track in missed if track.missing]
            wide = [replace(t.person.region, side=t.person.region.side * share) for t in still]
            for track, person in zip(still, self._locate_twice(picture, wide), strict=True):
                # A person hidden behind another one must not return as that one.
                if person is not None and not self._is_followed(person):
                    track.see(person)
        self.counts["lost"] += sum(track.missing == _PATIENCE_PICTURES + 1 for track in self._tracks)
        self._tracks = [track for track in self._tracks if track.missing <= _MEMORY_PICTURES]

    def _turned(self, picture: Picture, track: _PictureTrack, person: Person | None) -> Person | None:
        """Look at somebody whose joints are unsure in turned regions, too; return the surest one.

        Networks take somebody upside down for another who stands, and regions do not turn as fast as people.
        """
        score = 0.0 if person is None else _score(person)
        lately = track.scores[-1] < _SURE_OF_TURN and self.counts["frames"] % _TURN_EVERY
        if not self._least_score or score >= _SURE_OF_TURN or lately:
            return person
        last = track.person.region
        turned = [replace(last, angle_rad=last.angle_rad + turn) for turn in _TURNS_RAD]
        others = [other.person for other in self._tracks if other is not track and other.missing < 2]
        found = [new for new in self._locate(picture, turned) if new and not _are_bodies(new, others)]
        best = max(found, key=_score, default=None)
        if best is None or _score(best) < score + _SURER:
            return person
        self.counts["turned"] += 1
        (again,) = self._locate(picture, [best.region])
        return max(best, best if again is None or _are_bodies(again, others) else again, key=_score)

    def _merge(self) -> None:
        """Merge tracks on one body; the older one stays."""
        kept: list[_PictureTrack] = []
        for track in sorted(self._seen(), key=lambda track: track.number):
            if _are_bodies(track.person, [older.person for older in kept]):
                self._tracks.remove(track)
                self.counts["merged"] += 1
            else:
                kept.append(track)

    def _drop(self, logged: Hints) -> None:
        """Drop those who are not the actor and things that are no people, if somebody better is seen."""
        seen = self._seen()
        actors = [track for track in seen if _can_be(track.person.region, logged)]
        if self._only_one and actors:
            self._remove([t for t in seen if t not in actors], "not the actor")
        no_people = [track for track in self._tracks if self._is_no_person(track)]
        # Who can be a logged person is replaced only by somebody else who can, and anybody by a person.
        can_be = [[t for t in actors if _agrees(t.person.region, hint)] for hint in logged.values()]
        for rivals in can_be if actors else [seen]:
            if rivals and all(track in no_people for track in rivals):
                no_people.remove(max(rivals, key=_PictureTrack.mean_score))
        self._remove(no_people, "no people")

    def _remove(self, tracks: Sequence[_PictureTrack], cause: str) -> None:
        self._tracks = [track for track in self._tracks if track not in tracks]
        self.counts[cause] += len(tracks)

    def _is_no_person(self, track: _PictureTrack) -> bool:
        """Test the mean score of a few pictures, or of those seen so far if the track is lost."""
        known = len(track.scores) == _JUDGED_PICTURES or track.missing
        return bool(known) and track.mean_score() < self._least_score

    # --- those to be found -----------------------------------------------------------------------------

    def _search(self, picture: Picture, logged: Hints) -> None:
        height, width = picture.shape[:2]
        frame = self.counts["frames"]
        parts = [
            square_about(t.person.region.centre, _detector_side(t.person.region), width, height)
            for t in self._missed()
        ]
        parts += self._squares(logged, width, height)
        if parts:
            self._take_up(picture, find_in(self._networks, picture, dict.fromkeys(parts)), logged)
        for k in self._unseen(logged):
            if logged[k].margin_px <= _CENTRED_HEIGHTS * logged[k].height_px:
                region = Region(logged[k].centre, SIDE_PER_HEIGHT * logged[k].height_px)
                self._take_up_one(picture, region, logged)
        due = frame % self._search_every == 0
        tiled = due or not self._seen()
        if self._only_one and logged:
            tiled = tiled and bool(unseen := self._unseen(logged)) and self._is_due(unseen[0])
        if tiled:
            self._search_tiles(picture, logged)
        self.counts["searched"] += bool(parts) or tiled

    def _squares(self, logged: Hints, width: int, height: int) -> list[Tile]:
        """List the squares about the hints that are searched in this picture."""

        def squares(k: int) -> list[Tile]:
            hint = logged[k]
            return squares_about(hint.centre, hint.height_px, hint.margin_px, width, height)

        unseen = self._unseen(logged)
        parts = [square for k in unseen if self._is_due(k) for square in squares(k)]
        if unseen or not logged or not self._only_one or self.counts["frames"] % self._search_every:
            return parts
        if all(self._is_no_person(t) for t in self._seen() if _can_be(t.person.region, logged)):
            return squares(min(logged))
        self._next_square = (self._next_square + 1) % len(squares(min(logged)))
        return [squares(min(logged))[self._next_square]]

    def _is_due(self, k: int) -> bool:
        """Test if a logged person who is not seen is searched in this picture."""
        return self._unseen_for[k] < _LOST_PICTURES or (self.counts["frames"] + k) % _SEARCH_LOST == 0

    def _search_tiles(self, picture: Picture, logged: Hints) -> None:
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
            self._take_up(picture, find_in(self._networks, picture, parts), logged)
            if not first or self._seen() or self._next_tile >= len(cover):
                break

    def _take_up(self, picture: Picture, found: Iterable[FoundPerson], logged: Hints) -> None:
        """Follow the people found who are not followed already, best first."""
        only_actor = self._only_one and bool(logged)
        if only_actor:
            found = sorted(found, key=lambda each: not _can_be(each.region, logged))
        for each in found:
            if only_actor and not self._unseen(logged) and not _can_be(each.region, logged):
                break
            if self._is_part_of_seen(each, logged):
                continue
            if each.cut and each.score < _SURE_SCORE and self._seen():
                # A search about the place is cheaper than the landmarks of a limb or a tree.
                about = square_about(each.region.centre, _detector_side(each.region), *picture.shape[1::-1])
                again = find_in(self._networks, picture, [about])
                whole = [one for one in again if not (one.cut or self._is_part_of_seen(one, logged))]
                if not whole:
                    continue
                each = whole[0]  # noqa: PLW2901  # the same body, whole
            self._take_up_one(picture, each.region, logged)

    def _take_up_one(self, picture: Picture, region: Region, logged: Hints) -> None:
        """Follow the person in a region, if there is one who is not followed already."""
        person = self._locate_new(picture, region, logged)
        if person is None or self._is_followed(person, logged):
            return
        if (known := self._lost_at(person.region)) is not None and self._has_place_for(known):
            self.counts["found again"] += known.missing > _PATIENCE_PICTURES
            known.see(person)
            return
        if not self._has_place_for(None) and _can_be(person.region, logged):
            # Drop the newest track that cannot be a logged person: bystanders must not keep them out.
            held = [track for track in self._tracks if track.missing <= _PATIENCE_PICTURES]
            others = [track for track in held if not _can_be(track.person.region, logged)]
            if others:
                self._tracks.remove(max(others, key=lambda track: track.number))
                self.counts["lost"] += 1
        if self._has_place_for(None):
            track = _PictureTrack(self._next_number, person)
            track.see(person)
            self._tracks.append(track)
            self._next_number += 1
            self.counts["found"] += 1
        else:
            self.counts["beyond the most"] += 1

    def _lost_at(self, region: Region) -> _PictureTrack | None:
        """Find the track lost nearest to that place, within the region's side; None if there is none."""
        reach = [
            (math.dist(track.person.region.centre, region.centre), track.number, track)
            for track in self._tracks
            if track.missing
        ]
        distance, _, track = min(reach, default=(math.inf, 0, None))
        return track if distance < region.side else None

    def _has_place_for(self, track: _PictureTrack | None) -> bool:
        """Test if another person may be followed; people just lost keep their place."""
        held = [other for other in self._tracks if other.missing <= _PATIENCE_PICTURES]
        return track in held or len(held) < self._most_people

    # --- small questions -------------------------------------------------------------------------------

    def _seen(self) -> list[_PictureTrack]:
        return [track for track in self._tracks if track.missing == 0]

    def _missed(self) -> list[_PictureTrack]:
        """List those just lost who were seen for a few pictures; the others too while nobody is seen."""
        lost = [track for track in self._tracks if 0 < track.missing <= _PATIENCE_PICTURES]
        return [track for track in lost if len(track.scores) == _JUDGED_PICTURES] if self._seen() else lost

    def _unseen(self, logged: Hints) -> list[int]:
        """List the logged people who are not seen, where each track can be one of them."""
        regions = [track.person.region for track in self._seen()]
        if not logged or not regions:
            return list(logged)
        from scipy.optimize import linear_sum_assignment

        apart_px = np.array(
            [
                [
                    math.dist(region.centre, hint.centre) if _agrees(region, hint) else _IMPOSSIBLE_PX
                    for region in regions
                ]
                for hint in logged.values()
            ]
        )
        # As many as possible are seen, and of such choices the nearest.
        chosen = zip(*linear_sum_assignment(apart_px), strict=True)
        seen = {row for row, track in chosen if apart_px[row, track] < _IMPOSSIBLE_PX}
        return [k for row, k in enumerate(logged) if row not in seen]

    def _is_part_of_seen(self, candidate: FoundPerson, logged: Hints) -> bool:
        return any(_is_part_of(candidate, track) for track in self._seen_at(candidate.region, logged))

    def _is_followed(self, person: Person, logged: Hints = _NOBODY) -> bool:
        """Test if a person is followed, by place or joints: a poor second estimate is no second person."""
        return any(
            same_place(person.region, track.person.region) or _one_body(person, track.person)
            for track in self._seen_at(person.region, logged)
        )

    def _seen_at(self, region: Region, logged: Hints) -> list[_PictureTrack]:
        """List those seen; if the region can be a logged person's, those alone who can be one, too."""
        return [
            track
            for track in self._seen()
            if not _can_be(region, logged) or _can_be(track.person.region, logged)
        ]

    def _locate(
        self, picture: Picture, regions: Sequence[Region], *, followed: bool = False
    ) -> list[Person | None]:
        """Locate the person in each region, None if there is none."""
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

    def _locate_new(self, picture: Picture, region: Region, logged: Hints) -> Person | None:
        """Locate a person twice; None for a thing that is no person, if somebody is seen already."""
        for _ in range(2):
            (person,) = self._locate(picture, [region])
            if person is None:
                return None
            if (
                self._seen()
                and not _can_be(person.region, logged)
                and _score(person) < _SINGLE_SCORE_SHARE * self._least_score
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
    return _MIN_REGION_PX <= region.side < math.inf and within


def _one_body(a: Person, b: Person) -> bool:
    """Test if most joints of two people are at the same places; False if no joint was found in both."""
    distance: NDArray[np.float64] = np.linalg.norm(a.xy - b.xy, axis=1)
    distance = distance[np.isfinite(distance)]
    if not distance.size:
        return False
    return float(np.median(distance)) < _ONE_BODY_SIDES * max(a.region.side, b.region.side)


def _are_bodies(person: Person, others: Iterable[Person]) -> bool:
    """Test if a person is one of several others, by `_one_body`."""
    return any(_one_body(person, other) for other in others)


def _is_part_of(candidate: FoundPerson, track: _PictureTrack) -> bool:
    """Test if a candidate is a person who is followed, whole or cut by a tile."""
    followed = track.person.region
    apart = np.abs(np.subtract(candidate.region.centre, followed.centre)) / followed.side
    return same_place(candidate.region, followed) or (candidate.cut and bool((apart < _BODY).all()))


def _can_be(region: Region, logged: Hints) -> bool:
    """Test if a person can be one of those logged."""
    return any(_agrees(region, hint) for hint in logged.values())


def _agrees(region: Region, hint: Hint) -> bool:
    """Test if a person can be the logged one, by place and size."""
    near = math.dist(region.centre, hint.centre) <= hint.margin_px + hint.height_px / 2
    return near and region.side <= _TALLER * SIDE_PER_HEIGHT * hint.tallest_px


def _score(person: Person) -> float:
    """Return the upper quartile of the joints' confidences: a person may be hidden or cut off in part."""
    return float(np.quantile(np.nan_to_num(person.confidence), 0.75))


def _detector_side(region: Region) -> float:
    return CROP_PER_HEIGHT / SIDE_PER_HEIGHT * region.side


class FollowedPeople:
    """Tracker of the people in one camera's pictures; joints unknown to the detector stay NaN."""

    def __init__(self, networks: KeypointNetworks, joints: Sequence[str], *, only_one: bool) -> None:
        self._tracker = PeopleTracker(networks, only_one=only_one)
        self._column = [networks.joints.index(name) if name in networks.joints else None for name in joints]

    def step(self, picture: Picture, *, hints: Sequence[Hint | None]) -> tuple[Float, Float]:
        """Return the K people in the next picture: positions [K, J, 2] px and confidences [K, J].

        The highest presence comes first. Joints not found are NaN, their confidence 0.
        """
        people = [seen.person for seen in self._tracker.step(picture, hints=hints)]
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
