"""Tiles of large pictures: their cover, and detection of each person exactly once."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.keypoints.search import Tile, find_in, tiles
from tests.keypoints.bars import Bar, BarNetworks, draw


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
