"""Woods keep clear of the actor, and say so when they cannot."""

import numpy as np
import pytest

from pipelines.session.errors import DataError
from pipelines.simulation import scenario
from pipelines.simulation.world import build_world
from tests.simulation.world.sites import NOBODY

WAY = np.stack([np.linspace(-20, 20, 400), np.zeros(400)], axis=1)


def spec(**wood: float) -> scenario.WorldSettings:
    return scenario.WorldSettings.model_validate(
        {
            "wood": wood,
            "walls": [{"start": [5.0, 5.0], "end": [5.0, 15.0]}],
            "trees": [{"position": [0.0, 9.0]}],
        }
    )


def test_no_tree_stands_where_it_must_not() -> None:
    world = build_world(spec(count=60, radius_m=25.0, clear_m=4.0), 5, keep_clear=WAY)
    place, radius = world.obstacles.trunks[:, :2], world.obstacles.crowns[:, 3]
    assert len(place) == 61
    assert place[0].tolist() == [0, 9], "the scenario's own trees come first and stay where they are"
    planted = place[1:]
    assert (np.hypot(*planted.T) <= 25).all()
    assert (np.linalg.norm(planted[:, None] - WAY, axis=-1) >= 4).all()
    apart = np.linalg.norm(place[:, None] - place, axis=-1) + 99 * np.eye(61)
    assert (apart >= 0.9 * np.maximum(radius[:, None], radius)).all()
    in_wall = (np.abs(planted[:, 0] - 5) < 0.15) & (planted[:, 1] > 5) & (planted[:, 1] < 15)
    assert not in_wall.any()
    heights = (world.obstacles.crowns[1:, 2] + world.obstacles.crowns[1:, 4]).tolist()
    assert all(4.5 <= height <= 7.5 for height in heights), "a quarter about 6 m, on level ground"


def test_a_wood_that_does_not_fit_is_one_clear_line() -> None:
    with pytest.raises(DataError, match=r"^world\.wood: .*\b0 of 3\b.*\b5 m\b.*\bclear_m$"):
        build_world(spec(count=3, radius_m=5.0, clear_m=6.0), 5, keep_clear=WAY)
    with pytest.raises(DataError, match=r"^world\.wood: .*\b\d+ of 500\b.*\b8 m\b"):
        build_world(spec(count=500, radius_m=8.0, clear_m=0.0), 5, keep_clear=NOBODY)
