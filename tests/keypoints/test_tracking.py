"""Tracking of people through pictures in which their places are known."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.arrays import Intrinsics, Picture
from pipelines.keypoints.corrections import measured_for, read_calibration
from pipelines.keypoints.search import Hint, Tile, find_in, project_actor, tiles
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


@pytest.mark.parametrize(("gap", "lost"), [(1, 0), (5, 0), (15, 1)])
def test_who_is_seen_again_at_the_place_is_the_same_person(gap: int, lost: int) -> None:
    again = Bar(480 + 40 * lost, 270 + 10 * lost, 121)
    shown = [Bar(480, 270, 121)] * 2 + [AWAY] * gap + [again] * 6
    seen, tracker, _ = _run(draw(WIDTH, HEIGHT, bar) for bar in shown)
    assert _tracks(seen)[2:] == [[]] * gap + [[0]] * 6 or lost
    assert _tracks(seen)[-1] == [0]
    assert (tracker.counts["lost"], tracker.counts["found again"], tracker.counts["found"]) == (lost, lost, 1)
    _assert_joints(seen[-1][0], again)


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
        found = super().locate(picture, regions)
        return [replace(one, confidence=np.full(5, 0.45 if one.region.side < 100 else 0.9)) for one in found]


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
        found, own = super().locate(picture, regions), np.full(5, self.confidence)
        return [replace(one, presence=min(one.presence, self.presence), confidence=own) for one in found]


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


@dataclass
class _Turning(BarNetworks):
    """Networks that recover two fifths of a person's turn against the region, and fail beyond 45 degrees."""

    turn_rad: float = 0.0
    person_confidence: float = 0.55

    def locate(self, picture: Picture, regions: Sequence[Region]) -> list[Person]:
        found = super().locate(picture, regions)
        left = [math.remainder(self.turn_rad - region.angle_rad, math.tau) for region in regions]
        known = [(0.9, 0.6) if abs(rad) < math.pi / 4 else (0.5, 1.0) for rad in left]
        turned = [self.turn_rad - rad * share for rad, (_, share) in zip(left, known, strict=True)]
        return [
            replace(one, confidence=np.full(5, sure), region=replace(one.region, angle_rad=turn))
            for one, (sure, _), turn in zip(found, known, turned, strict=True)
        ]


@pytest.mark.parametrize("turns_deg", [[20.0] * 40, [0.0] * 6 + [180.0] + [0.0] * 6])
def test_who_turns_over_is_followed(turns_deg: list[float]) -> None:
    """Turn by 20 degrees in each picture, by which regions would stay 50 degrees behind, or at once."""
    picture, tracker = draw(WIDTH, HEIGHT, Bar(500, 270, 121)), PeopleTracker(networks := _Turning())
    for turn_deg in turns_deg:
        networks.turn_rad += math.radians(turn_deg)
        assert tracker.step(picture, hints=[])[0].person.confidence.min() == 0.9
    assert tracker.counts["turned"] == (0.0 in turns_deg)


@dataclass
class _Beside(BarNetworks):
    """Networks that take whoever is in a turned region for the one beside."""

    person_confidence: float = 0.55

    def locate(self, picture: Picture, regions: Sequence[Region]) -> list[Person]:
        beside = [replace(each, centre=(700.0, 270.0)) if each.angle_rad else each for each in regions]
        found = super().locate(picture, beside)
        return [replace(one, confidence=np.full(5, 0.9 if one.xy[0, 0] > 600 else 0.6)) for one in found]


def test_nobody_is_taken_for_the_person_beside() -> None:
    picture = draw(WIDTH, HEIGHT, Bar(500, 270, 121), Bar(700, 270, 121))
    tracker = PeopleTracker(_Beside())
    assert _tracks([tracker.step(picture, hints=[]) for _ in range(12)]) == [[0, 1]] * 12
    assert not tracker.counts["turned"]


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


CAMERA = Intrinsics(width=1280, height=720, fx=800.0, fy=800.0, cx=639.5, cy=359.5)
# At the origin, looking along the world's x: camera x is the world's -y, camera y its -z.
POSE = (np.zeros(3), np.array([-0.5, 0.5, -0.5, 0.5]))


def _hint(x: float, y: float, z: float, sigma_m: float = 0.0, sigma_rad: float = 0.0) -> Hint | None:
    return project_actor(np.array([x, y, z]), POSE, CAMERA, sigma_m=sigma_m, sigma_rad=sigma_rad)


def test_an_actor_ahead_is_in_the_middle_and_as_tall_as_the_range_says() -> None:
    hint = _hint(10, 0, 0, sigma_m=0.3, sigma_rad=math.radians(1))
    assert hint is not None
    assert hint.centre == pytest.approx((639.5, 359.5))
    assert hint.height_px == pytest.approx(800 * 1.75 / 10, rel=1e-3)
    assert hint.margin_px == pytest.approx(3 * 800 * math.hypot(0.03, math.radians(1)), rel=1e-3)


@pytest.mark.parametrize("place", [(-10, 0, 0), (0, 1, 0), (10, 9, 0), (10, 0, -6), (10, math.nan, 0)])
def test_no_hint_behind_beside_outside_or_unknown(place: tuple[float, float, float]) -> None:
    assert _hint(*place) is None
    # 40 px beyond the left border; the margin is 3 x 800 x 0.2 / 10 = 48 px there or more.
    assert _hint(10, (639.5 + 40) / 80, 0, sigma_m=0.1) is None
    assert _hint(10, (639.5 + 40) / 80, 0, sigma_m=0.25) is not None


def _holds(tile: Tile, x: float, y: float, size: float) -> bool:
    """Test if a square of that size around a place is whole in the tile, up to a pixel of rounding."""
    across = tile.left - 1 <= x - size / 2 and x + size / 2 <= tile.left + tile.width + 1
    return across and tile.top - 1 <= y - size / 2 and y + size / 2 <= tile.top + tile.height + 1


@given(
    width=st.integers(640, 4096),
    height=st.integers(640, 4096),
    share=st.sampled_from([1.0, 0.5, 0.25]),
    place=st.tuples(st.floats(0, 1), st.floats(0, 1)),
)
def test_a_body_of_a_third_of_a_tile_is_whole_in_one(
    width: int, height: int, share: float, place: tuple[float, float]
) -> None:
    side = round(min(width, height) * share)
    body = side / 3
    x = body / 2 + place[0] * (width - body)
    y = body / 2 + place[1] * (height - body)
    assert any(_holds(tile, x, y, body) for tile in tiles(width, height) if tile.width == tile.height == side)


def test_people_are_found_once_and_in_the_pixels_of_the_whole_picture() -> None:
    people = [Bar(700, 500, 121), Bar(760, 505, 121), Bar(1500, 300, 201)]
    picture = draw(1920, 1080, *people)

    found = find_in(BarNetworks(), picture, tiles(1920, 1080))

    # Those cut off by a tile's border may remain as further candidates: none elsewhere than on a body.
    for person in people:
        assert np.min([np.hypot(r.centre[0] - person.x, r.centre[1] - person.y) for r, *_ in found]) <= 0.5
    places = np.array([each.region.centre for each in found])
    apart = np.linalg.norm(places[:, None] - places, axis=2)[np.triu_indices(len(places), 1)]
    # 0.2 of a region's side of 1.25 heights: cut bodies of 121 px have smaller regions.
    assert apart.min() >= 0.2 * 1.25 * 121 * 0.25


@settings(max_examples=20)
@given(x=st.integers(40, 920), y=st.integers(40, 500))
def test_small_people_are_found_by_tiles_and_not_in_the_whole(x: int, y: int) -> None:
    picture = draw(960, 540, Bar(x, y, 71))
    assert not find_in(BarNetworks(), picture, tiles(960, 540)[:1])
    best = find_in(BarNetworks(), picture, tiles(960, 540))[0]
    assert best.region.centre == pytest.approx((x, y), abs=0.5)


@pytest.mark.parametrize("detector", ["blazepose", "blazepose-heavy"])
def test_keypoints_in_any_order_are_worth_the_same(detector: str) -> None:
    path = measured_for(detector)
    assert path is not None
    assert measured_for("onnx:somebody's") is None
    calibration = read_calibration(path)
    joints = ("left_wrist", "nose", "right_hip")
    confidence = np.random.default_rng(4).uniform(0.0, 1.0, (50, 3))
    expected = calibration.probability(confidence, joints)
    order = np.random.default_rng(5).permutation(150)
    names = np.tile(np.array(joints), 50)
    assert np.array_equal(
        calibration.probabilities(confidence.ravel()[order], names[order]), expected.ravel()[order]
    )
    # Joints with high confidence are right more often than not, and the other way round.
    assert calibration.probability(np.array([[0.9]]), ("left_knee",))[0, 0] > 0.9
    assert calibration.probability(np.array([[0.2]]), ("left_knee",))[0, 0] < 0.5
