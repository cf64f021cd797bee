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

from pipelines.geometry.arrays import Float, Int64, Intrinsics, Picture
from pipelines.geometry.cameras import project
from pipelines.geometry.poses import invert, transform
from pipelines.session.camera_poses import poses_at, stated_noise
from pipelines.session.description import CameraEntry, Interpolation
from pipelines.session.people import LoggedActor
from pipelines.session.records import Trajectory
from pipelines.session.registries import KeypointNetworks, Region

# The actor lies within this many standard deviations of the log, but for 3 of 1,000 times.
_MARGIN_SIGMAS = 3.0
# This share of the range is small against a body and large against rounding.
_RANGE_STEP = 1e-4


@dataclass(frozen=True)
class Hint:
    """Place of the actor in a picture by the log."""

    centre: tuple[float, float]  # px
    height_px: float  # of the actor standing across the line of sight
    margin_px: float  # three sigma: how far from `centre` the actor may be
    tallest_px: float = (
        math.inf
    )  # of the same actor nearer by three sigma; inf where that is behind the camera


def project_actor(
    position_world: Float,
    world_from_camera: tuple[Float, Float],
    intrinsics: Intrinsics,
    *,
    sigma_m: float,
    sigma_rad: float,
    height_m: float = 1.75,
) -> Hint | None:
    """Project the actor's logged position into a camera's picture.

    `position_world` [3] m is hip or near it, `world_from_camera` the camera's pose at that time, `sigma_m`
    one sigma per axis of both positions together, `sigma_rad` that of the camera's rotation. The height in
    the picture is that of a body across the line of sight, for any tilt; sizes of regions are measured in it.
    Pixels are taken at the actor's place, with distortion and the stretch away from the axis. None where a
    number is missing (NaN), the actor is behind the camera or beyond the model's valid radius, or outside the
    picture by more than the margin.
    """
    actor = transform(invert(*world_from_camera), position_world)
    # project() expects depth to be comparable, and NaN fails every comparison.
    if not actor[2] > 0:
        return None
    distance = float(np.linalg.norm(actor))
    across = np.linalg.svd(actor[None, :])[2][1:]  # two unit vectors at right angles to the line of sight
    points = np.vstack([actor, actor + _RANGE_STEP * distance * across])
    pixels = project(points, intrinsics)
    if not np.isfinite(pixels).all():
        return None
    px_per_rad = float(np.sqrt(abs(np.linalg.det(pixels[1:] - pixels[0])))) / _RANGE_STEP
    nearest = distance - _MARGIN_SIGMAS * sigma_m
    margin = _MARGIN_SIGMAS * px_per_rad * float(np.hypot(sigma_m / distance, sigma_rad))
    x, y = float(pixels[0, 0]), float(pixels[0, 1])
    if not (-margin <= x <= intrinsics.width - 1 + margin and -margin <= y <= intrinsics.height - 1 + margin):
        return None
    tallest = px_per_rad * height_m / nearest if nearest > 0 else math.inf
    return Hint((x, y), px_per_rad * height_m / distance, margin, tallest)


ACTOR_SIGMA_M = 1.0
"""Standard deviation of the actor's logged position, used to distinguish people."""
UNKNOWN_SIGMA_RAD = float(np.radians(1.0))
"""Standard deviation of a camera's rotation if the user states none.

The position noise of such a camera counts as part of `ACTOR_SIGMA_M`.
"""


def actor_hints(
    actor: LoggedActor,
    name: str,
    entry: CameraEntry,
    trajectory: Trajectory,
    between: Interpolation,
    t_ns: Int64,
) -> list[Hint | None]:
    """Predict the logged actor's hips in pictures [T]; None where the log or the pose is missing."""
    position, quaternion = poses_at(trajectory, t_ns, between, static=entry.poses.static)
    sigma = hint_sigma(name, entry, trajectory, t_ns)
    intrinsics = entry.intrinsics
    return [
        project_actor(at, (centre, turned), intrinsics, sigma_m=float(off_m), sigma_rad=float(off_rad))
        if np.isfinite(at).all() and np.isfinite(centre).all()
        else None
        for at, centre, turned, (off_m, off_rad) in zip(
            actor.hips_at(t_ns), position, quaternion, sigma, strict=True
        )
    ]


def hint_sigma(name: str, entry: CameraEntry, trajectory: Trajectory, t_ns: Int64) -> Float:
    """Return the uncertainty [T, 2] (m, rad) of the logged actor as seen from a camera's logged pose."""
    stated = stated_noise(name, entry, trajectory).sigma
    if stated is None:
        at_pictures = np.tile((0.0, UNKNOWN_SIGMA_RAD), (len(t_ns), 1))
    else:
        before = np.searchsorted(trajectory.t_ns, t_ns, side="right") - 1
        at_pictures = stated[np.clip(before, 0, len(stated) - 1)]
    return np.column_stack([np.hypot(ACTOR_SIGMA_M, at_pictures[:, 0]), at_pictures[:, 1]])


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
    """List at most 3 x 3 squares of 3 body heights that cover a body with an uncertain centre."""
    count = min(max(math.ceil(margin_px / height_px), 1), 3)
    offsets = [2 * height_px * (i - (count - 1) / 2) for i in range(count)]
    squares = [
        square_about((centre[0] + dx, centre[1] + dy), CROP_PER_HEIGHT * height_px, width, height)
        for dy, dx in product(offsets, offsets)
    ]
    return list(dict.fromkeys(squares))


def find_in(networks: KeypointNetworks, picture: Picture, parts: Iterable[Tile]) -> list[FoundPerson]:
    """Find people in parts of a picture [H, W, 3] BGR, each once: whole bodies first, then by score."""
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
    """Test by their centres if two regions, which are much wider than people, are around one person."""
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
