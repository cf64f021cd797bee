"""The visible ground: coarse where it is level, fine on mounds, out to the horizon."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.simulation import scenario
from pipelines.simulation.surfaces import Surface
from pipelines.simulation.world.terrain import Terrain

Int64 = NDArray[np.int64]

_FAR_M = 2000.0  # beyond, the horizon is less than two pixels away for a drone at 5 m
_CELLS = 16  # along the ground's square, at least
_GROWTH = 0.5  # cells outside are at most half as wide as their distance from it
_FLATNESS_M = 0.02  # largest distance of triangles from the ground
_FINEST = 17  # halvings of the whole: cells of 3 to 6 cm, however steep a mound
_GRASS = (0.115, 0.15, 0.055)  # mean reflectance of a meadow; the texture of the ground varies it


def ground_surface(ground: scenario.Ground, terrain: Terrain) -> Surface:
    """Triangulate the corners of a quadtree, whose cells are halved until the ground in them is flat.

    A linear triangle within a circle of radius r errs by at most curvature r^2 / 2 (r = side / sqrt 2).
    """
    from scipy.spatial import Delaunay

    cell_m = ground.size_m / _CELLS
    whole_m = cell_m * 2 ** math.ceil(math.log2(2 * max(_FAR_M, 3 * ground.size_m) / cell_m))
    corners, finest_m = _corners(ground, terrain, whole_m)
    local = corners * finest_m - whole_m / 2
    faces = Delaunay(local).simplices.astype(np.int32)  # counterclockwise in the plane
    xy = local + np.array(ground.centre)
    a, b, c = xy[faces[:, 0]], xy[faces[:, 1]], xy[faces[:, 2]]
    turn = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    faces[turn < 0] = faces[turn < 0][:, ::-1]
    vertices = np.concatenate([xy, terrain.height(xy)[:, None]], axis=1)
    colour = np.tile(np.array(_GRASS, np.float32), (len(vertices), 1))
    return Surface(vertices, faces, colour, smooth=True, ground=True)


def _corners(ground: scenario.Ground, terrain: Terrain, whole_m: float) -> tuple[Int64, float]:
    """Return the cells' corners [V, 2], in units of the finest cell's side, and that side in metres."""
    finest_m = whole_m / 2**_FINEST
    cells, side = np.zeros((1, 2), dtype=np.int64), 2**_FINEST
    found = []
    while len(cells):
        centre = (cells + side / 2) * finest_m - whole_m / 2
        split = _too_wide(centre, side * finest_m, ground, terrain) & (side > 1)
        steps = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
        found.append((cells[~split][:, None] + steps * side).reshape(-1, 2))
        side //= 2
        cells = (cells[split][:, None] + steps * side).reshape(-1, 2)
    return np.unique(np.concatenate(found), axis=0), finest_m


def _too_wide(centre: Float, side_m: float, ground: scenario.Ground, terrain: Terrain) -> NDArray[np.bool_]:
    """Find the cells [N] to be halved; centres [N, 2] are relative to the ground's middle."""
    outside = np.abs(centre).max(axis=1) - side_m / 2 - ground.size_m / 2
    allowed = np.maximum(1.001 * ground.size_m / _CELLS, _GROWTH * outside)
    # Triangles join corners of neighbouring cells, too: look a cell further.
    curvature = terrain.curvature_within(centre + np.array(ground.centre), side_m * 1.5)
    wide: NDArray[np.bool_] = (side_m > allowed) | (curvature * side_m**2 / 4 > _FLATNESS_M)
    return wide
