"""Hidden: against shapes worked out on paper, and against marching through what is solid."""

from collections.abc import Mapping

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.simulation.world import GRAZE_M
from tests.simulation.world.sites import everything, site, solid

# Along x from -2 to 2, y from -0.25 to 0.25, up to 1.5.
WALL = {"start": [-2.0, 0.0], "end": [2.0, 0.0], "height_m": 1.5, "thickness_m": 0.5}
TINY = 1e-9


def blocked(world_parts: Mapping[str, object], eye: list[float], target: list[float]) -> bool:
    world = site(**world_parts)
    one, other = (bool(world.hidden(np.array(a), np.array(b))) for a, b in ((eye, target), (target, eye)))
    assert one == other, "a line of sight has no direction"
    return one


def test_lines_that_graze_a_mound() -> None:
    """Level lines over the top of a mound 2 m high: hidden below 2 m - 2 GRAZE, seen above 2 m - GRAZE."""
    mound = {"mounds": [{"centre": [0.3, 0.0], "sigma_m": [2.0, 3.0], "height_m": 2.0}]}
    for height, hides in (
        (2 - 2 * GRAZE_M - TINY, True),
        (2 - GRAZE_M + TINY, False),
        (2 + TINY, False),
    ):
        for bearing in np.linspace(0, np.pi, 8):
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


@settings(deadline=None, max_examples=60)
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
    if (solid(world, line) & solid(world, line + np.array([0, 0, 2 * GRAZE_M + TINY]))).any():
        assert hidden
    if hidden:
        nudges = 0.02 * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        assert any(solid(world, line + nudge).any() for nudge in nudges)


def test_shapes_broadcast_and_nothing_missing_is_hidden() -> None:
    world = site(walls=[WALL])
    eyes = np.array([[0.0, -9.0, 1.0], [0.0, 9.0, 1.0]])
    targets = np.array([[0.0, 1.0, 1.0], [0.0, np.nan, 1.0], [0.0, -1.0, 1.0]])
    expected = [[True, False, False], [False, False, True]]
    assert world.hidden(eyes[:, None], targets).tolist() == expected
