"""Places of the trees of a wood: at random, clear of the actor's way."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.simulation import scenario

_TRIES = 200  # places tried for each tree
_APART = 0.9  # crown radii between the trunks of two trees: crowns may mingle, trees do not coincide
_HEIGHT_SPREAD = 0.25  # a tree is up to this share lower or higher than the wood
_SLENDER, _STOUT = 0.21, 0.31  # crown radius of the tree's height


def plant(
    wood: scenario.Wood,
    rng: np.random.Generator,
    *,
    keep_clear: Float,
    standing: Sequence[scenario.Tree],
    walls: Sequence[scenario.Wall],
) -> list[scenario.Tree]:
    """Place a wood's trees at random, evenly over its circle.

    Args:
        wood: number and place of the trees.
        rng: decides the places and the sizes.
        keep_clear: [K, 2] m, points of the actor's way; no trunk's axis is nearer to one than `clear_m`.
        standing: trees that are there already; new ones keep apart from them and from each other.
        walls: new trees keep their trunks out of them.

    Raises:
        DataError: they do not fit.
    """
    trees = list(standing)
    for planted in range(wood.count):
        for _ in range(_TRIES):
            tree = _seedling(wood, rng)
            if _has_room(tree, wood.clear_m, keep_clear, trees, walls):
                trees.append(tree)
                break
        else:
            raise DataError(
                "world.wood",
                f"found room for {planted} of {wood.count} trees within {wood.radius_m:g} m of "
                f"{wood.centre} and {wood.clear_m:g} m off the actor's way",
                "take fewer or smaller trees, a larger radius_m or a smaller clear_m",
            )
    return trees[len(standing) :]


def _seedling(wood: scenario.Wood, rng: np.random.Generator) -> scenario.Tree:
    """Draw a tree anywhere in the wood's circle."""
    bearing, share, size, girth = rng.uniform(size=4).tolist()
    away = wood.radius_m * math.sqrt(share)  # as many trees on every square metre
    height = wood.height_m * (1 + _HEIGHT_SPREAD * (2 * size - 1))
    place = [
        wood.centre[0] + away * math.cos(2 * math.pi * bearing),
        wood.centre[1] + away * math.sin(2 * math.pi * bearing),
    ]
    radius = height * (_SLENDER + (_STOUT - _SLENDER) * girth)
    return scenario.Tree.model_construct(position=place, height_m=height, crown_radius_m=radius)


def _has_room(
    tree: scenario.Tree,
    clear_m: float,
    keep_clear: Float,
    trees: Sequence[scenario.Tree],
    walls: Sequence[scenario.Wall],
) -> bool:
    x, y = tree.position
    return (
        all(
            math.hypot(x - other.position[0], y - other.position[1])
            >= _APART * max(tree.crown_radius_m, other.crown_radius_m)
            for other in trees
        )
        and all(_away_from(wall, x, y) >= wall.thickness_m / 2 + 0.1 * tree.height_m for wall in walls)
        and bool((np.hypot(keep_clear[:, 0] - x, keep_clear[:, 1] - y) >= clear_m).all())
    )


def _away_from(wall: scenario.Wall, x: float, y: float) -> float:
    """Compute the distance from a place to a wall's line."""
    (ax, ay), (bx, by) = wall.start, wall.end
    square = (bx - ax) ** 2 + (by - ay) ** 2
    share = min(max(((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / square, 0), 1) if square else 0.0
    return math.hypot(x - ax - share * (bx - ax), y - ay - share * (by - ay))
