"""Pictures of people drawn as bars, and fake networks that read them from the pixels, with known truth.

A person is an upright bar of H x 0.4 H in a colour of their own. The networks have the limits that were
measured on the real ones: the person detector sees bodies between a quarter and nine tenths of the
picture's longer side, joints come from a region of about 1.25 H, and one pass from a region that is not
centred confuses left and right.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pipelines.geometry.arrays import Float, Picture
from pipelines.session.registries import Person, Region

JOINTS = ("head", "foot", "left_hand", "right_hand", "hip")
WIDTH_PER_HEIGHT = 0.4


@dataclass(frozen=True)
class Bar:
    """Bar of one person; with odd sizes in pixels the centre is a pixel's centre."""

    x: float
    y: float
    height: float

    @property
    def box(self) -> tuple[int, int, int, int]:
        """Bounds of the bar: first and last column, first and last row."""
        half, half_width = self.height / 2, self.height * WIDTH_PER_HEIGHT / 2
        return (
            round(self.x - half_width),
            round(self.x + half_width),
            round(self.y - half),
            round(self.y + half),
        )

    def joints(self) -> Float:
        """Compute the joints [5, 2] px."""
        return _joints(*self.box)


def draw(width: int, height: int, *people: Bar) -> Picture:
    """Draw a picture of people; the colour is the place in the order, later ones are in front."""
    picture = np.zeros((height, width, 3), np.uint8)
    for colour, person in enumerate(people, start=1):
        left, right, top, bottom = person.box
        picture[max(top, 0) : bottom + 1, max(left, 0) : right + 1] = colour
    return picture


@dataclass
class BarNetworks:
    """Fake detector that records the pictures and regions it receives."""

    joints: tuple[str, ...] = JOINTS
    searched: list[tuple[int, int]] = field(default_factory=list)  # width, height
    located: list[Region] = field(default_factory=list)

    def find_people(self, picture: Picture) -> list[tuple[Region, float]]:
        """Find all people of a suitable size, whole or cut at the border."""
        height, width = picture.shape[:2]
        self.searched.append((width, height))
        found = []
        for box in _boxes(picture).values():
            size = (box[3] - box[2] + 1) / max(width, height)
            if 0.25 <= size <= 0.9:
                found.append((_region(box, (0, 0)), 1 - abs(size - 1 / 3)))
        return sorted(found, key=lambda candidate: -candidate[1])

    def locate(self, picture: Picture, regions: Sequence[Region]) -> list[Person]:
        """Locate the person who fills most of each region."""
        self.located += regions
        return [_look(picture, region) for region in regions]


def _look(picture: Picture, region: Region) -> Person:
    first = np.maximum(np.round(np.array(region.centre) - region.side / 2).astype(int), 0)
    last = np.maximum(np.round(np.array(region.centre) + region.side / 2).astype(int), 0)
    part = picture[first[1] : last[1], first[0] : last[0]]
    areas = np.bincount(part[..., 0].ravel(), minlength=2)
    areas[0] = 0
    colour = int(areas.argmax())
    # A whole body covers 0.4 / 1.25^2 = 0.26 of its region, and 0.12 of one of 1.8 H.
    if areas[colour] < 0.12 * region.side**2:
        return Person(np.full((5, 2), np.nan), np.zeros(5), 0.0, region)
    box = _boxes(part)[colour]
    xy = _joints(*box) + first
    own = _region(box, (int(first[0]), int(first[1])))
    if np.hypot(*np.subtract(own.centre, region.centre)) > 0.05 * own.side:
        xy[[2, 3]] = xy[[3, 2]]
    return Person(xy, np.ones(5), 1.0, own)


def _boxes(picture: Picture) -> dict[int, tuple[int, int, int, int]]:
    colours = picture[..., 0]
    boxes = {}
    for colour in np.flatnonzero(np.bincount(colours.ravel(), minlength=1)):
        if colour:
            rows = np.flatnonzero((colours == colour).any(axis=1))
            columns = np.flatnonzero((colours == colour).any(axis=0))
            boxes[int(colour)] = (int(columns[0]), int(columns[-1]), int(rows[0]), int(rows[-1]))
    return boxes


def _region(box: tuple[int, int, int, int], origin: tuple[int, int]) -> Region:
    left, right, top, bottom = box
    return Region(((left + right) / 2 + origin[0], (top + bottom) / 2 + origin[1]), 1.25 * (bottom - top + 1))


def _joints(left: int, right: int, top: int, bottom: int) -> Float:
    x, y = (left + right) / 2, (top + bottom) / 2
    return np.array([[x, top], [x, bottom], [right, y], [left, y], [x, y]], dtype=np.float64)
