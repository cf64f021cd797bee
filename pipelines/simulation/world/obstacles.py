"""Trees and walls as exact solids that stand on the ground."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.simulation import scenario
from pipelines.simulation.world.terrain import Terrain

_CROWN_SHARE = 0.62  # of a tree's height
_TRUNK_SHARE = 0.03  # its radius, of the tree's height
_MOST_BURIED_M = 50.0


@dataclass(frozen=True)
class Obstacles:
    """Solids on the ground, as rows of numbers that `kernels` explains. Tree k has trunk and crown k."""

    trunks: Float  # [T, 5]
    crowns: Float  # [T, 5]
    slabs: Float  # [W, 8]


def erect(terrain: Terrain, trees: Sequence[scenario.Tree], walls: Sequence[scenario.Wall]) -> Obstacles:
    """Stand trees and walls on the ground.

    A tree's crown is the upper 62 % of its height; its trunk, 3 % of the height in radius, ends in the
    crown's middle. A wall is level on top, `height_m` above the highest ground under its line, so that it
    is nowhere lower. Both reach below the lowest ground that they stand on.

    Raises:
        DataError: a wall begins where it ends.
    """
    return Obstacles(
        np.array([_trunk(terrain, tree) for tree in trees]).reshape(-1, 5),
        np.array([_crown(terrain, tree) for tree in trees]).reshape(-1, 5),
        np.array([_slab(terrain, k, wall) for k, wall in enumerate(walls)]).reshape(-1, 8),
    )


def _foot(terrain: Terrain, tree: scenario.Tree) -> float:
    return float(terrain.height(np.array(tree.position)))


def _trunk(terrain: Terrain, tree: scenario.Tree) -> tuple[float, ...]:
    foot, radius = _foot(terrain, tree), min(_TRUNK_SHARE * tree.height_m, tree.crown_radius_m)
    buried = min(0.1 + radius * terrain.slope, _MOST_BURIED_M)
    return (*tree.position, foot - buried, foot + (1 - _CROWN_SHARE / 2) * tree.height_m, radius)


def _crown(terrain: Terrain, tree: scenario.Tree) -> tuple[float, ...]:
    upright = _CROWN_SHARE / 2 * tree.height_m
    centre = _foot(terrain, tree) + tree.height_m - upright
    return (*tree.position, centre, tree.crown_radius_m, upright)


def _slab(terrain: Terrain, k: int, wall: scenario.Wall) -> tuple[float, ...]:
    start, end = np.array(wall.start), np.array(wall.end)
    length = math.hypot(*(end - start))
    if length == 0:
        raise DataError(f"world.walls[{k}]", f"begins where it ends, at {wall.start}", "give it a length")
    along = (end - start) / length
    across = np.array([-along[1], along[0]]) * wall.thickness_m / 2
    steps = min(2 + math.ceil(length / 0.1), 20_000)
    line = start + np.linspace(0, length, steps)[:, None] * along
    under = terrain.height(line[:, None] + np.array([[-1.0], [0.0], [1.0]]) * across)
    # Between samples the ground falls by no more than its slope allows.
    unseen = terrain.slope * math.hypot(length / (steps - 1) / 2, wall.thickness_m / 4)
    low = under.min() - 0.1 - min(unseen, _MOST_BURIED_M)
    middle = (start + end) / 2
    return (*middle, *along, length / 2, wall.thickness_m / 2, low, under[:, 1].max() + wall.height_m)
