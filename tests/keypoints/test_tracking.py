"""Tracking of people through pictures in which their places are known."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.arrays import Picture
from pipelines.keypoints.hints import Hint
from pipelines.keypoints.tracking import PeopleTracker, TrackedPerson
from pipelines.session.registries import Region
from tests.keypoints.bars import Bar, BarNetworks, draw

WIDTH, HEIGHT = 960, 540
AWAY = Bar(-1000, -1000, 101)


def _run(
    pictures: Iterable[Picture], hints: Iterable[Hint | None] | None = None, **options: int
) -> tuple[list[list[TrackedPerson]], PeopleTracker, BarNetworks]:
    networks = BarNetworks()
    tracker = PeopleTracker(networks, **options)
    pictures = list(pictures)
    hints = [None] * len(pictures) if hints is None else hints
    seen = [tracker.step(picture, hint=hint) for picture, hint in zip(pictures, hints, strict=True)]
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


def test_one_who_is_followed_costs_one_region_a_picture() -> None:
    _, tracker, networks = _run(draw(WIDTH, HEIGHT, Bar(300 + k, 270, 121)) for k in range(9))

    # Two passes when found, one in each of the eight pictures after that, and no search in them.
    assert len(networks.located) == 2 + 8
    assert tracker.counts["searched"] == 1


def test_an_empty_picture_has_nobody() -> None:
    seen, tracker, networks = _run([draw(WIDTH, HEIGHT)] * 3)

    assert seen == [[], [], []]
    assert tracker.counts["without anybody"] == tracker.counts["searched"] == 3
    assert not networks.located
    assert not tracker.counts["found"]


def test_a_tile_is_looked_at_in_every_round_of_searches() -> None:
    """Search the tiles of an empty 4K picture in turn: 85 tiles, 24 in each picture."""
    late = Bar(3700, 2000, 181)
    pictures = [draw(3840, 2160)] + [draw(3840, 2160, late)] * 4

    seen, _, networks = _run(pictures)

    assert _tracks(seen)[-1] == [0]
    assert len(networks.searched) <= 96 + 4 * 24


def test_a_hint_is_enough_for_one_search() -> None:
    truth = Bar(2000, 1300, 101)
    hint = Hint((2030.0, 1270.0), 100.0, 60.0)

    seen, _, networks = _run([draw(3840, 2160, truth)], [hint], search_every=1000)

    _assert_joints(seen[0][0], truth)
    assert networks.searched[0] == (300, 300)


def test_a_hint_with_a_wide_margin_is_searched_all_over() -> None:
    truth = Bar(2000 + 250, 1300 - 220, 101)
    hint = Hint((2000.0, 1300.0), 100.0, 260.0)

    seen, _, networks = _run([draw(3840, 2160, truth)], [hint])

    _assert_joints(seen[0][0], truth)
    assert networks.searched[:9] == [(300, 300)] * 9


def test_a_sure_hint_does_without_the_person_detector() -> None:
    truth = Bar(480, 270, 241)
    tracker = PeopleTracker(_Shortsighted())

    (found,) = tracker.step(draw(WIDTH, HEIGHT, truth), hint=Hint((500.0, 250.0), 240.0, 60.0))

    _assert_joints(found, truth)


def test_the_actor_is_searched_at_once_where_the_hint_is_and_nobody_followed() -> None:
    bystander, actor = Bar(200, 270, 121), Bar(700, 270, 121)
    pictures = [draw(WIDTH, HEIGHT, bystander)] * 3 + [draw(WIDTH, HEIGHT, bystander, actor)]
    hints = [None, None, None, Hint((705.0, 265.0), 121.0, 30.0)]

    seen, _, _ = _run(pictures, hints, search_every=1000)

    assert _tracks(seen) == [[0], [0], [0], [0, 1]]
    _assert_joints(seen[3][1], actor)


def test_two_passes_are_made_from_regions_that_are_not_the_persons_own() -> None:
    """Use a hint that is 0.2 H off: the first pass exchanges left and right, the second must not."""
    truth = Bar(480, 270, 121)
    networks = BarNetworks()
    hint = Hint((500.0, 255.0), 121.0, 30.0)
    (found,) = PeopleTracker(networks).step(draw(WIDTH, HEIGHT, truth), hint=hint)

    _assert_joints(found, truth)
    assert len(networks.located) == 2


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


@pytest.mark.parametrize(("gap", "place"), [(15, 100), (60, 480)])
def test_far_away_or_much_later_is_somebody_new(gap: int, place: int) -> None:
    pictures = [draw(WIDTH, HEIGHT, Bar(480, 270, 121))] + [draw(WIDTH, HEIGHT)] * gap
    pictures += [draw(WIDTH, HEIGHT, Bar(place, 270, 121))] * 6

    seen, tracker, _ = _run(pictures)

    assert _tracks(seen)[-1] == [1]
    assert (tracker.counts["lost"], tracker.counts["found again"], tracker.counts["found"]) == (1, 0, 2)


def test_two_numbers_on_one_body_become_the_older() -> None:
    """Let number 0 disappear while its region also holds number 1."""
    first, second = Bar(530, 270, 121), Bar(470, 270, 131)
    pictures = [draw(WIDTH, HEIGHT, first)]
    pictures += [draw(WIDTH, HEIGHT, first, second)] * 100
    pictures += [draw(WIDTH, HEIGHT, AWAY, second)] * 8

    seen, tracker, _ = _run(pictures)

    # One pass from a region that cuts the other body is not yet on it: they meet in the next picture.
    assert _tracks(seen)[100] == [0, 1]
    assert _tracks(seen)[103:] == [[0]] * 6
    assert (tracker.counts["found"], tracker.counts["merged"], tracker.counts["lost"]) == (2, 1, 0)
    _assert_joints(seen[-1][0], second)


def test_no_more_people_than_asked_for_but_the_actor_always() -> None:
    people = [Bar(100 + 150 * k, 270, 121) for k in range(5)]
    pictures = [draw(WIDTH, HEIGHT, *people)] * 40
    hints = [None] * 39 + [Hint((703.0, 270.0), 121.0, 20.0)]

    seen, tracker, _ = _run(pictures, hints, most_people=2, search_every=5)

    assert max(len(people) for people in seen) == 2
    assert tracker.counts["beyond the most"] > 0
    assert any(abs(person.person.region.centre[0] - 700) < 1 for person in seen[-1])


@settings(max_examples=10, deadline=None)
@given(st.lists(st.tuples(st.integers(60, 900), st.booleans()), min_size=2, max_size=15))
def test_what_is_found_depends_on_the_pictures_alone(scenes: list[tuple[int, bool]]) -> None:
    """Compare two trackers that step in turn on the same networks: they agree to the bit."""
    networks = BarNetworks()
    trackers = [PeopleTracker(networks, search_every=3) for _ in range(2)]
    for x, shown in scenes:
        picture = draw(WIDTH, HEIGHT, Bar(x, 270, 121) if shown else AWAY, Bar(400, 300, 141))
        one, other = (tracker.step(picture, hint=None) for tracker in trackers)
        assert [person.track for person in one] == [person.track for person in other]
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a.person.xy, b.person.xy)
    assert trackers[0].counts == trackers[1].counts
