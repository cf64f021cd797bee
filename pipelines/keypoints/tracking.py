"""Tracking of people through the pictures of one camera: search, identity, loss and return."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Picture
from pipelines.keypoints.hints import Hint
from pipelines.keypoints.tiles import (
    CROP_PER_HEIGHT,
    SIDE_PER_HEIGHT,
    find_in,
    same_place,
    square_about,
    squares_about,
    tiles,
)
from pipelines.session.registries import KeypointNetworks, Person, Region

_PRESENT = 0.5
_CENTRED = 0.3  # a margin (3 sigma) of this many heights, 0.1 per sigma, leaves the region good enough
_SMALLEST_PX = 8.0
_WIDER = 1.3  # factor on the last region of a person just lost
_PATIENCE = 5  # a person not seen is searched at the last place for this many pictures
_MEMORY = 30  # pictures after which a number is not given to the same place again
_ONE_BODY = 0.06  # median distance of joints, in region sides: about the scatter of one body's two estimates
_TILES_BESIDE = 8  # tiles searched in one picture while a person is followed
_TILES_ALONE = 24  # the same while nobody is followed


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

    def see(self, person: Person) -> None:
        self.person, self.missing = person, 0


class PeopleTracker:
    """Tracker of people through the pictures of one camera.

    A person is searched at the place of the joints in the last picture. The person detector runs around
    people just lost, and around the hint if the logged actor is not followed. It runs on tiles of the whole
    picture if nobody is followed, and every `search_every` pictures. Each such search takes the next few
    tiles, so that the cost of a large picture spreads over several. The first picture is searched until a
    person is found.

    Results depend only on the pictures and hints so far.

    Attributes:
        counts: frames; searched (frames in which the person detector ran); found (new numbers); lost
            (not seen for more than 5 frames); found again (at the place where they were lost, under the
            old number); merged (two numbers on one body, the older stays); beyond the most (people
            found but not followed, in each search again); without anybody (frames).
    """

    def __init__(self, networks: KeypointNetworks, *, most_people: int = 6, search_every: int = 10) -> None:
        self.counts: Counter[str] = Counter()
        self._networks = networks
        self._most_people = most_people
        self._search_every = search_every
        self._tracks: list[_Track] = []
        self._next_number = 0
        self._next_tile = 0

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
        self._search(picture, hint)
        self.counts["frames"] += 1
        seen = sorted(self._seen(), key=lambda track: track.number)
        self.counts["without anybody"] += not seen
        return [TrackedPerson(track.number, track.person) for track in seen]

    # --- those known -----------------------------------------------------------------------------------

    def _follow(self, picture: Picture) -> None:
        """Search each person at the last place; two passes for those not seen in the last picture."""
        followed, missed = self._seen(), [t for t in self._tracks if 0 < t.missing <= _PATIENCE]
        for track in self._tracks:
            track.missing += 1
        once = self._locate(picture, [track.person.region for track in followed])
        for track, person in zip(followed, once, strict=True):
            if person is not None:
                track.see(person)
        wide = [replace(t.person.region, side=t.person.region.side * _WIDER) for t in missed]
        for track, person in zip(missed, self._locate_twice(picture, wide), strict=True):
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

    # --- those to be found -----------------------------------------------------------------------------

    def _search(self, picture: Picture, hint: Hint | None) -> None:
        height, width = picture.shape[:2]
        likely = [
            square_about(t.person.region.centre, _detector_side(t.person.region), width, height)
            for t in self._tracks
            if 0 < t.missing <= _PATIENCE
        ]
        if wanted := hint is not None and not self._follows(hint):
            likely += squares_about(hint.centre, hint.height_px, hint.margin_px, width, height)
        if likely:
            self._take_up(picture, [region for region, _ in find_in(self._networks, picture, likely)], hint)
        if (
            wanted
            and hint is not None
            and not self._follows(hint)
            and hint.margin_px <= _CENTRED * hint.height_px
        ):
            self._take_up(picture, [Region(hint.centre, SIDE_PER_HEIGHT * hint.height_px)], hint)
        tiled = self.counts["frames"] % self._search_every == 0 or not self._seen()
        if tiled:
            self._search_tiles(picture, hint)
        self.counts["searched"] += bool(likely) or tiled

    def _search_tiles(self, picture: Picture, hint: Hint | None) -> None:
        """Search the next tiles in turn; in the first picture all of them, until a person is found."""
        cover = tiles(picture.shape[1], picture.shape[0])
        rounds = math.ceil(len(cover) / _TILES_ALONE) if self.counts["frames"] == 0 else 1
        for _ in range(rounds):
            count = min(_TILES_BESIDE if self._seen() else _TILES_ALONE, len(cover))
            parts = [cover[(self._next_tile + i) % len(cover)] for i in range(count)]
            self._next_tile = (self._next_tile + count) % len(cover)
            self._take_up(picture, [region for region, _ in find_in(self._networks, picture, parts)], hint)
            if self._seen():
                break

    def _take_up(self, picture: Picture, regions: Sequence[Region], hint: Hint | None) -> None:
        """Follow the people in these regions who are not followed already, best first."""
        new = [r for r in regions if not any(same_place(r, t.person.region) for t in self._seen())]
        for person in self._locate_twice(picture, new):
            if person is None or self._is_followed(person):
                continue
            if (known := self._lost_at(person.region)) is not None and self._has_place_for(known):
                self.counts["found again"] += known.missing > _PATIENCE
                known.see(person)
                continue
            if not self._has_place_for(None) and hint is not None and _agrees(person.region, hint):
                self._make_place(hint)
            if self._has_place_for(None):
                self._tracks.append(_Track(self._next_number, person))
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

    def _make_place(self, hint: Hint) -> None:
        """Drop the newest track that cannot be the actor: bystanders must not keep the actor out."""
        others = [t for t in self._tracks if t.missing <= _PATIENCE and not _agrees(t.person.region, hint)]
        if others:
            self._tracks.remove(max(others, key=lambda track: track.number))
            self.counts["lost"] += 1

    # --- small questions -------------------------------------------------------------------------------

    def _seen(self) -> list[_Track]:
        return [track for track in self._tracks if track.missing == 0]

    def _follows(self, hint: Hint) -> bool:
        return any(_agrees(track.person.region, hint) for track in self._seen())

    def _is_followed(self, person: Person) -> bool:
        """Test if a person is followed, by place or joints: a poor second estimate is no second person."""
        return any(
            same_place(person.region, track.person.region) or _one_body(person, track.person)
            for track in self._seen()
        )

    def _locate(self, picture: Picture, regions: Sequence[Region]) -> list[Person | None]:
        """Locate the person in each region, None if there is none."""
        if not regions:
            return []
        people = self._networks.locate(picture, regions)
        return [person if _is_present(person, picture) else None for person in people]

    def _locate_twice(self, picture: Picture, regions: Sequence[Region]) -> list[Person | None]:
        """Locate people twice, for regions not from their own joints: one pass alone flips left and right."""
        first = self._locate(picture, regions)
        second = iter(self._locate(picture, [person.region for person in first if person is not None]))
        return [None if person is None else next(second) for person in first]


def _is_present(person: Person, picture: Picture) -> bool:
    """Test if a person is present, with a region that the next picture can be searched in."""
    region, (height, width) = person.region, picture.shape[:2]
    x, y = region.centre
    reach = region.side / 2
    within = -reach <= x <= width + reach and -reach <= y <= height + reach
    return person.presence >= _PRESENT and _SMALLEST_PX <= region.side < math.inf and within


def _one_body(a: Person, b: Person) -> bool:
    """Test if most joints of two people are at the same places; False if no joint was found in both."""
    distance: NDArray[np.float64] = np.linalg.norm(a.xy - b.xy, axis=1)
    distance = distance[np.isfinite(distance)]
    if not distance.size:
        return False
    return float(np.median(distance)) < _ONE_BODY * max(a.region.side, b.region.side)


def _agrees(region: Region, hint: Hint) -> bool:
    """Test if a person can be the logged actor."""
    return math.dist(region.centre, hint.centre) <= hint.margin_px + hint.height_px / 2


def _detector_side(region: Region) -> float:
    return CROP_PER_HEIGHT / SIDE_PER_HEIGHT * region.side
