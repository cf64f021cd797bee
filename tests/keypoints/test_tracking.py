"""Tracking of people through pictures in which their places are known."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.arrays import Picture
from pipelines.keypoints.search import Hint
from pipelines.keypoints.tracking import PeopleTracker, TrackedPerson
from pipelines.session.registries import Person, Region
from tests.keypoints.bars import Bar, BarNetworks, draw

WIDTH, HEIGHT = 960, 540
AWAY = Bar(-1000, -1000, 101)


def _run(
    pictures: Iterable[Picture],
    hints: Iterable[Hint | None] | None = None,
    only_one: bool = False,
    **options: int,
) -> tuple[list[list[TrackedPerson]], PeopleTracker, BarNetworks]:
    networks = BarNetworks()
    tracker = PeopleTracker(networks, only_one=only_one, **options)
    pictures = list(pictures)
    hints = [None] * len(pictures) if hints is None else hints
    seen = [tracker.step(picture, hints=[hint]) for picture, hint in zip(pictures, hints, strict=True)]
    return seen, tracker, networks


class _Shortsighted(BarNetworks):
    """Person detector that misses everybody."""

    def find_people(self, picture: Picture) -> list[tuple[Region, float]]:
        return super().find_people(np.zeros_like(picture))


def _tracks(seen: list[list[TrackedPerson]]) -> list[list[int]]:
    return [[person.track for person in people] for people in seen]


def _assert_joints(found: TrackedPerson, truth: Bar) -> None:
    # The bars' joints are whole or half pixels and read from the same pixels.
    np.testing.assert_allclose(found.person.xy, truth.joints(), atol=1e-9)


def test_people_keep_their_numbers_and_joints_while_they_walk() -> None:
    walks = [[Bar(200 + 3 * k, 200, 121), Bar(700 - 3 * k, 380, 151)] for k in range(60)]

    seen, tracker, _ = _run(draw(WIDTH, HEIGHT, *people) for people in walks)

    numbers = {round(person.person.region.side): person.track for person in seen[10]}
    assert sorted(numbers.values()) == [0, 1]
    for people, truth in zip(seen[10:], walks[10:], strict=True):
        for bar in truth:
            number = numbers[round(1.25 * (bar.box[3] - bar.box[2] + 1))]
            _assert_joints(next(person for person in people if person.track == number), bar)
    assert tracker.counts["found"] == 2
    assert tracker.counts["frames"] == 60
    assert not any(tracker.counts[word] for word in ("lost", "found again", "merged", "beyond the most"))


def test_somebody_small_in_4k_is_found_in_the_first_picture() -> None:
    truth = Bar(3100, 1700, 191)

    seen, _, networks = _run([draw(3840, 2160, truth)])

    (found,) = seen[0]
    _assert_joints(found, truth)
    assert len(networks.searched) <= 85


@pytest.mark.parametrize("gap", [1, 5])
def test_a_short_gap_keeps_the_number_and_counts_nothing(gap: int) -> None:
    person = Bar(480, 270, 121)
    pictures = [draw(WIDTH, HEIGHT, person)] + [draw(WIDTH, HEIGHT)] * gap + [draw(WIDTH, HEIGHT, person)]

    seen, tracker, _ = _run(pictures)

    assert _tracks(seen) == [[0], *([[]] * gap), [0]]
    assert not tracker.counts["lost"]
    assert not tracker.counts["found again"]
    assert tracker.counts["without anybody"] == gap


def test_lost_and_found_again_at_the_place_is_the_same_person() -> None:
    pictures = [draw(WIDTH, HEIGHT, Bar(480, 270, 121))] * 2
    pictures += [draw(WIDTH, HEIGHT)] * 15
    pictures += [draw(WIDTH, HEIGHT, Bar(520, 280, 121))] * 6

    seen, tracker, _ = _run(pictures)

    assert _tracks(seen)[-1] == [0]
    assert (tracker.counts["lost"], tracker.counts["found again"], tracker.counts["found"]) == (1, 1, 1)
    _assert_joints(seen[-1][0], Bar(520, 280, 121))


def test_no_more_people_than_asked_for_but_the_actor_always() -> None:
    people = [Bar(100 + 150 * k, 270, 121) for k in range(5)]
    pictures = [draw(WIDTH, HEIGHT, *people)] * 40
    hints = [None] * 39 + [Hint((703.0, 270.0), 121.0, 20.0)]

    seen, tracker, _ = _run(pictures, hints, most_people=2, search_every=5)

    assert max(len(people) for people in seen) == 2
    assert tracker.counts["beyond the most"] > 0
    assert any(abs(person.person.region.centre[0] - 700) < 1 for person in seen[-1])


class _Telling(BarNetworks):
    """Networks whose confidences tell people from trees: bars of 71 px are trees."""

    person_confidence = 0.55

    def locate(self, picture: Picture, regions: Sequence[Region]) -> list[Person]:
        return [
            replace(person, confidence=np.full(5, self._confidence(person)))
            for person in super().locate(picture, regions)
        ]

    def _confidence(self, person: Person) -> float:
        return 0.45 if person.region.side < 100 else 0.9


def test_a_tree_is_dropped_after_a_few_pictures_beside_a_person() -> None:
    """Look at a tree that is found first: it is alone for two pictures and has five to be a person."""
    tree, person = Bar(200, 270, 71), Bar(700, 270, 121)
    pictures = [draw(WIDTH, HEIGHT, tree)] * 2 + [draw(WIDTH, HEIGHT, tree, person)] * 40
    tracker = PeopleTracker(networks := _Telling(), search_every=1)

    tracks = _tracks([tracker.step(picture, hints=[]) for picture in pictures])

    assert tracks[:6] == [[0], [0], [0, 1], [0, 1], [1], [1]]
    assert tracks[6:] == [[1]] * 36
    assert tracker.counts["no people"] > 1
    # Each search finds the tree again; a single pass is enough to see what it is.
    assert len([region for region in networks.located[-20:] if region.side < 100]) <= 10


@dataclass
class _Doubting(BarNetworks):
    """Networks whose presence is low in some pictures, and which tell people by confidences or do not."""

    presence: float = 1.0
    confidence: float = 0.9

    def locate(self, picture: Picture, regions: Sequence[Region]) -> list[Person]:
        return [
            replace(
                person, presence=min(person.presence, self.presence), confidence=np.full(5, self.confidence)
            )
            for person in super().locate(picture, regions)
        ]


@dataclass
class _TellingAndDoubting(_Doubting):
    person_confidence: float = 0.55


@pytest.mark.parametrize(
    ("networks", "presence", "confidence", "followed"),
    [
        (_TellingAndDoubting, 0.3, 0.9, True),
        (_TellingAndDoubting, 0.3, 0.4, False),  # joints that are no person's
        (_TellingAndDoubting, 0.1, 0.9, False),  # hardly anybody there
        (_Doubting, 0.3, 0.9, False),  # its confidences tell nothing
    ],
)
def test_who_is_followed_outlasts_a_low_presence(
    networks: type[_Doubting], presence: float, confidence: float, followed: bool
) -> None:
    """Nobody who is not followed yet is taken with such a presence."""
    picture = draw(WIDTH, HEIGHT, Bar(500, 270, 121))
    tracker = PeopleTracker(fake := networks())
    fake.presence, fake.confidence = presence, confidence
    assert tracker.step(picture, hints=[]) == []
    fake.presence, fake.confidence = 1.0, 0.9
    assert _tracks([tracker.step(picture, hints=[]) for _ in range(6)]) == [[0]] * 6
    fake.presence, fake.confidence = presence, confidence
    assert bool(tracker.step(picture, hints=[])) is followed


def test_the_actor_alone_is_followed_and_the_whole_picture_not_searched() -> None:
    actor, bystander = Bar(700, 270, 121), Bar(200, 270, 121)
    pictures = [draw(WIDTH, HEIGHT, bystander, actor)] * 40
    hint = Hint((705.0, 265.0), 121.0, 30.0)

    seen, tracker, networks = _run(pictures, [hint] * 40, only_one=True)

    assert _tracks(seen) == [[0]] * 40
    _assert_joints(seen[-1][0], actor)
    # Two passes when found and one a picture; the square about the hint, and that again every ten pictures.
    assert len(networks.located) == 2 + 39
    assert networks.searched == [(363, 363)] * (1 + 3)
    assert tracker.counts["searched"] == 4


def test_each_logged_person_is_searched_until_they_are_seen() -> None:
    """Let two logged people stand where one detection could be either of them."""
    anna, ben = Bar(420, 270, 121), Bar(560, 270, 121)
    pictures = [draw(WIDTH, HEIGHT, anna)] + [draw(WIDTH, HEIGHT, anna, ben)] * 3
    hints = [Hint((425.0, 265.0), 121.0, 200.0), Hint((555.0, 265.0), 121.0, 200.0)]
    networks = BarNetworks()
    tracker = PeopleTracker(networks, search_every=1000)

    seen = [tracker.step(picture, hints=hints) for picture in pictures]

    assert _tracks(seen) == [[0], [0, 1], [0, 1], [0, 1]]
    _assert_joints(seen[1][1], ben)
    searched = len(networks.searched)
    tracker.step(pictures[-1], hints=hints)
    assert len(networks.searched) == searched, "nobody is missing"


@settings(max_examples=10, deadline=None)
@given(st.lists(st.tuples(st.integers(60, 900), st.booleans()), min_size=2, max_size=15))
def test_what_is_found_depends_on_the_pictures_alone(scenes: list[tuple[int, bool]]) -> None:
    """Compare two trackers that step in turn on the same networks: they agree to the bit."""
    networks = BarNetworks()
    trackers = [PeopleTracker(networks, search_every=3) for _ in range(2)]
    for x, shown in scenes:
        picture = draw(WIDTH, HEIGHT, Bar(x, 270, 121) if shown else AWAY, Bar(400, 300, 141))
        one, other = (tracker.step(picture, hints=[]) for tracker in trackers)
        assert [person.track for person in one] == [person.track for person in other]
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a.person.xy, b.person.xy)
    assert trackers[0].counts == trackers[1].counts
