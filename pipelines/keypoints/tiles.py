"""Search for people who are small in a large picture: the person detector runs on squares cut from it.

The detector shrinks a picture to a few hundred pixels. It finds bodies of about a third of the picture's
size, and almost none of a tenth (measured with BlazePose: all in a square of 3 body heights, none on full
frames).
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from pipelines.geometry.arrays import Picture
from pipelines.session.registries import KeypointNetworks, Region


class FoundPerson(NamedTuple):
    """A person that the person detector found, in pixels of the whole picture."""

    region: Region
    score: float
    cut: bool  # by a tile's border inside the picture: the centre is only a guess


CROP_PER_HEIGHT = 3.0
"""Side of the square in which the person detector finds a body, in body heights."""

SIDE_PER_HEIGHT = 1.25
"""Side of the region that joints come from: 1.1 to 1.4 are as good, 1.8 is bad (measured with BlazePose)."""

_SHARES = (1.0, 0.5, 0.25)  # sides of the tiles, as shares of the picture's short side
# A body of the size that is found is whole in one of the tiles with this overlap.
_OVERLAP = 1 / CROP_PER_HEIGHT
# Smaller tiles would be enlarged for the person detector, which shows nothing new.
_MIN_TILE_PX = 150
# Centres nearer than this share of a region's side are one person.
_SAME_PERSON_SHARE = 0.2


@dataclass(frozen=True)
class Tile:
    """A rectangle of whole pixels inside a picture."""

    left: int
    top: int
    width: int
    height: int

    def cut(self, picture: Picture) -> Picture:
        """Cut the tile from a picture [H, W, 3], without a copy."""
        return picture[self.top : self.top + self.height, self.left : self.left + self.width]


def tiles(width: int, height: int) -> list[Tile]:
    """List tiles, coarse to fine: the picture, then squares of its short side, of half and a quarter of it.

    Neighbours overlap by a third or more, and together they cover the picture: 85 tiles at 16:9. Sizes
    below 150 px are left out, as bodies in them have too few pixels for joints.
    """
    short = min(width, height)
    cover = [Tile(0, 0, width, height)]
    for share in _SHARES:
        side = round(short * share)
        if side < _MIN_TILE_PX:
            break
        cover += [
            Tile(left, top, side, side) for top, left in product(_starts(height, side), _starts(width, side))
        ]
    return list(dict.fromkeys(cover))


def square_about(centre: tuple[float, float], side: float, width: int, height: int) -> Tile:
    """Place a square around a point; shift it into the picture, and cut it if it is larger than that."""
    across, down = (max(1, min(round(side), size)) for size in (width, height))
    left = min(max(round(centre[0] - across / 2), 0), width - across)
    top = min(max(round(centre[1] - down / 2), 0), height - down)
    return Tile(left, top, across, down)


def squares_about(
    centre: tuple[float, float], height_px: float, margin_px: float, width: int, height: int
) -> list[Tile]:
    """List squares of 3 body heights that cover a body with an uncertain centre; at most 3 x 3.

    A square holds whole bodies whose centres are within one height of its own.
    """
    count = min(max(math.ceil(margin_px / height_px), 1), 3)
    offsets = [2 * height_px * (i - (count - 1) / 2) for i in range(count)]
    squares = [
        square_about((centre[0] + dx, centre[1] + dy), CROP_PER_HEIGHT * height_px, width, height)
        for dy, dx in product(offsets, offsets)
    ]
    return list(dict.fromkeys(squares))


def find_in(networks: KeypointNetworks, picture: Picture, parts: Iterable[Tile]) -> list[FoundPerson]:
    """Find people in parts of a picture, each person once.

    Args:
        picture: [H, W, 3] BGR.

    Returns:
        Whole bodies before those that a tile's border cuts, then by score; of several at one place (in
        overlapping tiles) the first of these.
    """
    found = [
        FoundPerson(_moved(region, part), score, _is_cut(region, part, picture))
        for part in parts
        for region, score in networks.find_people(part.cut(picture))
    ]
    kept: list[FoundPerson] = []
    for candidate in sorted(found, key=lambda each: (each.cut, -each.score)):
        if not any(same_place(candidate.region, other.region) for other in kept):
            kept.append(candidate)
    return kept


def same_place(a: Region, b: Region) -> bool:
    """Test if two regions are around one person.

    The test uses centres and not overlap: regions are much wider than people, so the regions of two people
    side by side overlap by more than half.
    """
    return math.dist(a.centre, b.centre) < _SAME_PERSON_SHARE * max(a.side, b.side)


def _starts(length: int, side: int) -> list[int]:
    count = math.ceil((length - side) / (side * (1 - _OVERLAP))) + 1
    return [round(start) for start in np.linspace(0, length - side, count)]


def _moved(region: Region, part: Tile) -> Region:
    x, y = region.centre
    return Region((x + part.left, y + part.top), region.side, region.angle_rad)


def _is_cut(region: Region, part: Tile, picture: Picture) -> bool:
    """Test if a tile's border inside the picture cuts a body; its centre is then only a guess."""
    reach = region.side / SIDE_PER_HEIGHT / 2
    for start, length, size, centre in (
        (part.left, part.width, picture.shape[1], region.centre[0]),
        (part.top, part.height, picture.shape[0], region.centre[1]),
    ):
        if (start > 0 and centre - reach < 0) or (start + length < size and centre + reach >= length - 1):
            return True
    return False
