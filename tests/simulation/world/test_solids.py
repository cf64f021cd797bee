"""Inside and hidden: against shapes worked out on paper, and against marching through `solid`."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.simulation.world.kernels import GRAZE_M
from tests.simulation.world.sites import everything, site

# Height 10: the crown is 6.2 high about z = 6.9, the trunk 0.3 in radius and ends there.
TREE = {"position": [1.0, 2.0], "height_m": 10.0, "crown_radius_m": 2.0}
# Along x from -2 to 2, y from -0.25 to 0.25, up to 1.5.
WALL = {"start": [-2.0, 0.0], "end": [2.0, 0.0], "height_m": 1.5, "thickness_m": 0.5}
TINY = 1e-9


def blocked(world_parts: Mapping[str, object], eye: list[float], target: list[float]) -> bool:
    world = site(**world_parts)
    one, other = (bool(world.hidden(np.array(a), np.array(b))) for a, b in ((eye, target), (target, eye)))
    assert one == other, "a line of sight has no direction"
    return one


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ([1.0, 2.0, 3.8 + TINY], True),  # the crown's lowest point, still in the trunk
        ([1.0 + 0.3 - TINY, 2.0, 1.0], True),
        ([1.0 + 0.3 + TINY, 2.0, 1.0], False),
        ([1.0, 4.0 - TINY, 6.9], True),
        ([1.0, 4.0 + TINY, 6.9], False),
        ([1.0, 2.0, 10.0 - TINY], True),
        ([1.0, 2.0, 10.0 + TINY], False),
        ([9.0, 9.0, -TINY], True),
        ([9.0, 9.0, TINY], False),
        ([np.nan, 2.0, 1.0], False),
    ],
)
def test_what_is_inside_of_a_tree(point: list[float], expected: bool) -> None:
    assert site(trees=[TREE]).solid(np.array(point)) == expected


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ([2 - TINY, 0.0, 1.0], True),
        ([2 + TINY, 0.0, 1.0], False),
        ([0.0, 0.25 - TINY, 1.0], True),
        ([0.0, -0.25 - TINY, 1.0], False),
        ([0.0, 0.0, 1.5 - TINY], True),
        ([0.0, 0.0, 1.5 + TINY], False),
    ],
)
def test_what_is_inside_of_a_wall(point: list[float], expected: bool) -> None:
    assert site(walls=[WALL]).solid(np.array(point)) == expected


@pytest.mark.parametrize("side", [-1, 1])
def test_lines_that_graze_a_tree(side: int) -> None:
    for away, hides in ((0.3 - TINY, True), (0.3 + TINY, False)):  # the trunk, at a height below the crown
        y = 2 + side * away
        assert blocked({"trees": [TREE]}, [-9, y, 2.0], [9, y, 2.0]) == hides
    for away, hides in ((2 - TINY, True), (2 + TINY, False)):  # the crown at its widest
        assert blocked({"trees": [TREE]}, [-9, 2 + side * away, 6.9], [9, 2 + side * away, 6.9]) == hides
    for height, hides in ((10 - TINY, True), (10 + TINY, False)):  # and over its top
        assert blocked({"trees": [TREE]}, [-9, 2, height], [9, 2, height]) == hides


def test_lines_that_end_before_a_tree_or_stand_beside_it() -> None:
    assert blocked({"trees": [TREE]}, [-9, 2, 2], [1 - 0.3 + TINY, 2, 2])
    assert not blocked({"trees": [TREE]}, [-9, 2, 2], [1 - 0.3 - TINY, 2, 2])
    assert blocked({"trees": [TREE]}, [1.1, 2, 20], [1.1, 2, 1]), "straight down into the crown"
    assert not blocked({"trees": [TREE]}, [3.1, 2, 20], [3.1, 2, 1]), "straight down beside it"
    assert not blocked({"trees": [TREE]}, [5, 2, 3], [5, 2, 3]), "no way at all"
    assert blocked({"trees": [TREE]}, [1, 2, 7], [1, 2, 7]), "no way at all, within leaves"


def test_lines_that_graze_a_wall() -> None:
    for height, hides in ((1.5 - TINY, True), (1.5 + TINY, False), (1.5, False)):
        assert blocked({"walls": [WALL]}, [0, -9, height], [0, 9, height]) == hides
    for x, hides in ((2 - TINY, True), (2 + TINY, False), (2.0, False)):
        assert blocked({"walls": [WALL]}, [x, -9, 1], [x, 9, 1]) == hides
    # Down over the far edge (0.25, 1.5), 1 in 2: it enters through the top if it is any lower.
    for lift, hides in ((-1e-6, True), (1e-6, False)):
        assert blocked({"walls": [WALL]}, [0, -3.75, 3.5 + lift], [0, 2.25, 0.5 + lift]) == hides


def test_lines_that_graze_a_mound() -> None:
    """Level lines over the top of a mound 2 m high: hidden below 2 m - 2 GRAZE, seen above 2 m - GRAZE."""
    mound = {"mounds": [{"centre": [0.3, 0.0], "sigma_m": [2.0, 3.0], "height_m": 2.0}]}
    for height, hides in (
        (2 - 2 * GRAZE_M - TINY, True),
        (2 - GRAZE_M + TINY, False),
        (2 + TINY, False),
    ):
        for bearing in np.linspace(0, np.pi, 30):
            for reach in (7.0, 40.0):
                x, y = reach * np.cos(bearing), reach * np.sin(bearing)
                assert blocked(mound, [0.3 + x, y, height], [0.3 - 1.3 * x, -1.3 * y, height]) == hides


def test_what_lies_on_the_ground_is_seen() -> None:
    """From 30 m straight above a mound, and not three times the grazing depth within it."""
    world = site(mounds=[{"centre": [-5.0, 1.0], "sigma_m": [2.0, 2.0], "height_m": 0.8}])
    xy = np.array([-5.0, 1.0]) + np.random.default_rng(1).uniform(-4, 4, (500, 2))
    feet = np.concatenate([xy, world.height(xy)[:, None]], axis=1)
    eye = np.array([-5.0, 1.0, 30.0])
    assert not world.hidden(eye, feet).any()
    assert world.hidden(eye, feet - np.array([0, 0, 3 * GRAZE_M])).all()


coordinates = st.tuples(*[st.floats(-9, 9)] * 2, st.floats(0.02, 6))


@settings(deadline=None, max_examples=300)
@given(coordinates, coordinates)
def test_hidden_agrees_with_marching_through_what_is_solid(
    eye: tuple[float, float, float], target: tuple[float, float, float]
) -> None:
    """A solid sample hides (deeper than the ground's tolerance), and what hides shows itself in samples.

    Samples are 1 mm apart. A line that is hidden without a solid sample touches a shape for less than that:
    then one in a bundle moved by 2 cm must be solid, since every solid here is wider than that.
    """
    world = everything()
    line = np.array(eye) + np.linspace(0, 1, 20_000)[:, None] * (np.array(target) - eye)
    hidden = bool(world.hidden(np.array(eye), np.array(target)))
    if (world.solid(line) & world.solid(line + np.array([0, 0, 2 * GRAZE_M + TINY]))).any():
        assert hidden
    if hidden:
        nudges = 0.02 * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        assert any(world.solid(line + nudge).any() for nudge in nudges)


def test_shapes_broadcast_and_nothing_missing_is_hidden() -> None:
    world = site(walls=[WALL])
    eyes = np.array([[0.0, -9.0, 1.0], [0.0, 9.0, 1.0]])
    targets = np.array([[0.0, 1.0, 1.0], [0.0, np.nan, 1.0], [0.0, -1.0, 1.0]])
    expected = [[True, False, False], [False, False, True]]
    assert world.hidden(eyes[:, None], targets).tolist() == expected
    assert world.solid(np.zeros((0, 3))).shape == (0,)


def test_a_flight_through_a_wood_takes_a_fraction_of_a_second() -> None:
    """2 drones, 900 frames, 17 joints, 20 trees, a mound: about 0.02 s on an idle core."""
    rng = np.random.default_rng(0)
    mound = {"centre": [6.0, 0.0], "sigma_m": [2.0, 1.0], "height_m": 1.0}
    world = site(wood={"count": 20, "radius_m": 30.0}, mounds=[mound])
    bearing = np.linspace(0, 9, 1800)
    eye = np.stack([10 * np.cos(bearing), 10 * np.sin(bearing), np.full(1800, 3.0)], axis=1)
    target = rng.normal([0, 0, 1], 0.3, (1800, 17, 3))
    world.hidden(eye[:1], target[:1, 0])
    began = time.process_time()
    hidden = world.hidden(eye[:, None], target)
    assert time.process_time() - began < 0.5
    assert 0.005 < hidden.mean() < 0.5
