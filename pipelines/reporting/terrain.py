"""The terrain around a flight, from its voxel map: heights for the top view, points for the 3D viewer."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Int64
from pipelines.session.records import Occupancy

LOWEST_M = 0.5
"""Least height above the ground of an obstacle; everything lower is ground."""
MOST_SURFACE_POINTS = 3000
_MOST_CELLS = 120  # of the top view, along its longer side
_GROUND_PERCENTILE = 5.0


@dataclass(frozen=True)
class Terrain:
    """The part of a map around a flight; nothing in it is occupied where the map ends."""

    occupied: NDArray[np.bool_]  # [X, Y, Z]
    corner: Float  # [3] m, of voxel (0, 0, 0), world
    resolution_m: float
    ground_m: float  # the level that 5 % of the columns do not reach, world


@dataclass(frozen=True)
class Heights:
    """Height of the highest occupied voxel of each column above the ground."""

    east_m: Float  # [X] middles of the cells, world
    north_m: Float  # [Y]
    above_m: Float  # [X, Y], 0 where nothing is occupied


@dataclass(frozen=True)
class Surface:
    """The surface of everything that rises above the ground, thinned out."""

    points: Float  # [N, 3] m, world: middles of cubes
    cube_m: float  # their side
    voxels: int  # number of surface voxels that they represent


def terrain_around(occupancy: Occupancy, low: Float, high: Float) -> Terrain | None:
    """Cut the columns of a map within a box seen from above; None where nothing in them is occupied.

    Args:
        occupancy: the map; 0.5 and above is occupied, unknown voxels are not.
        low: [2] m, the box's corner in the south-west, world.
        high: [2] m, in the north-east.
    """
    shape = np.array(occupancy.probability.shape[:2])
    first, last = (
        np.clip(cells, 0, shape).astype(int)
        for cells in (
            np.floor((low - occupancy.origin[:2]) / occupancy.resolution_m),
            np.ceil((high - occupancy.origin[:2]) / occupancy.resolution_m),
        )
    )
    part = occupancy.probability[first[0] : last[0], first[1] : last[1]]
    with np.errstate(invalid="ignore"):
        occupied = part >= 0.5
    columns = occupied.any(axis=2)
    if not columns.any():
        return None
    corner = occupancy.origin + occupancy.resolution_m * np.array([*first, 0])
    tops = _tops(occupied)[columns]
    lowest = float(np.percentile(tops, _GROUND_PERCENTILE, method="lower"))
    return Terrain(
        occupied=occupied,
        corner=corner,
        resolution_m=occupancy.resolution_m,
        ground_m=float(corner[2]) + occupancy.resolution_m * lowest,
    )


def heights(terrain: Terrain) -> Heights:
    """Compute heights on at most 120 cells along the longer side: each that of its highest column."""
    tops = _tops(terrain.occupied)
    above_m = terrain.corner[2] + terrain.resolution_m * tops - terrain.ground_m
    above_m = np.where(terrain.occupied.any(axis=2), np.maximum(above_m, 0.0), 0.0)
    step = -(-max(above_m.shape) // _MOST_CELLS)
    east, north = (np.arange(0, side, step) for side in above_m.shape)
    highest = np.maximum.reduceat(np.maximum.reduceat(above_m, east, axis=0), north, axis=1)
    middle = terrain.corner[:2] + terrain.resolution_m * step / 2
    return Heights(
        east_m=middle[0] + terrain.resolution_m * east,
        north_m=middle[1] + terrain.resolution_m * north,
        above_m=highest,
    )


def surface(terrain: Terrain, most: int = MOST_SURFACE_POINTS) -> Surface:
    """Return the occupied voxels with a free neighbour, as far as they rise `LOWEST_M` above the ground.

    They are grouped in cubes of whole voxels, the smallest with which at most `most` cubes are occupied.
    """
    occupied = np.pad(terrain.occupied, 1)
    inner = occupied[1:-1, 1:-1, 1:-1].copy()
    for axis in range(3):
        for side in (slice(None, -2), slice(2, None)):
            inner &= occupied[tuple(side if a == axis else slice(1, -1) for a in range(3))]
    voxels = np.argwhere(terrain.occupied & ~inner)
    top_m = terrain.corner[2] + terrain.resolution_m * (voxels[:, 2] + 1)
    voxels = voxels[top_m > terrain.ground_m + LOWEST_M - 1e-9 * terrain.resolution_m]
    gathered = 1
    cubes: Int64 = voxels
    while len(cubes) > most:
        gathered += 1
        cubes = np.unique(voxels // gathered, axis=0)
    return Surface(
        points=terrain.corner + terrain.resolution_m * gathered * (cubes + 0.5),
        cube_m=terrain.resolution_m * gathered,
        voxels=len(voxels),
    )


def _tops(occupied: NDArray[np.bool_]) -> Int64:
    """Count the voxels from the grid's floor to the top of each column's highest occupied one, [X, Y]."""
    tops: Int64 = occupied.shape[2] - occupied[:, :, ::-1].argmax(axis=2).astype(np.int64)
    return tops
