"""Visible surface of a voxel map: its occupied voxels that have a neighbour which is not occupied."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.session.records import Int64, Occupancy

MOST_CUBES = 1_000_000
_SLAB = 16  # layers that are searched together


@dataclass(frozen=True)
class MapSurface:
    """N cubes that cover the surface."""

    middle: Float  # [N, 3] m, world
    cube_m: float  # their side
    voxels: int  # of the map's surface


def surface_of(occupancy: Occupancy, most: int = MOST_CUBES) -> MapSurface:
    """Find the surface of a map, in cubes of as few whole voxels as give at most `most` cubes.

    Voxels beyond the map's box and unknown voxels count as not occupied.
    """
    layers = occupancy.probability.shape[0]
    found: list[Int64] = []
    for first in range(0, layers, _SLAB):
        last = min(first + _SLAB, layers)
        low, high = max(first - 1, 0), min(last + 1, layers)
        with np.errstate(invalid="ignore"):
            part = occupancy.probability[low:high] >= 0.5
        padding = ((int(first == 0), int(last == layers)), (1, 1), (1, 1))
        part = np.pad(part, padding)
        inner = part[1:-1, 1:-1, 1:-1].copy()
        for axis in range(3):
            for side in (slice(None, -2), slice(2, None)):
                inner &= part[tuple(side if a == axis else slice(1, -1) for a in range(3))]
        here = np.argwhere(part[1:-1, 1:-1, 1:-1] & ~inner)
        found.append(here.astype(np.int64) + np.array([first, 0, 0]))
    voxels = np.concatenate(found)
    gathered, cubes = 1, voxels
    while len(cubes) > most:
        gathered += 1
        cubes = np.unique(voxels // gathered, axis=0)
    cube_m = occupancy.resolution_m * gathered
    return MapSurface(occupancy.origin + cube_m * (cubes + 0.5), cube_m, len(voxels))
