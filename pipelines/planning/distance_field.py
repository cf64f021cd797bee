"""Signed distance to the nearest obstacle, and its gradient."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.planning.field_kernels import BRICK, Grid, Sight, fill_bricks, sample
from pipelines.session.records import Occupancy

Unknown = Literal["free", "occupied"]

OCCUPIED = 0.5  # probability from which a voxel is an obstacle
_NOWHERE_M = 1e3  # distance everywhere in a map without obstacles


@dataclass(frozen=True)
class DistanceField:
    """Signed distances to the surface of occupied space: positive outside, negative inside.

    Values belong to voxel centres and are trilinear between them. Beyond the outermost centres they are
    those of the nearest point of the grid: space outside the map is as free as its border.
    """

    grid: Grid
    from_ns: int = 0  # the time from which the map holds

    @cached_property
    def sight(self) -> Sight:
        """Field for the sight lines of the cost map; made at first use, one byte per voxel."""
        wide, deep, high = self.grid.distance_m.shape
        bricks = np.zeros((-(-wide // BRICK), -(-deep // BRICK), -(-high // BRICK), BRICK**3), np.uint8)
        fill_bricks(self.grid, bricks)
        return Sight(bricks, (wide, deep, high))

    @property
    def has_obstacles(self) -> bool:
        """True if anything is occupied."""
        return bool((self.grid.distance_m < 0.0).any())

    def covers(self, points: Float) -> NDArray[np.bool_]:
        """Test which points [..., 3] lie in the grid's box."""
        grid = self.grid
        place = (points - grid.origin) / grid.resolution_m
        inside = (place >= 0) & (place < np.array(grid.distance_m.shape))
        return np.asarray(inside.all(axis=-1), dtype=np.bool_)

    def sample(self, points: Float) -> tuple[Float, Float]:
        """Interpolate distances [...] and their gradients [..., 3] at points [..., 3], metres, world.

        The gradient is the exact derivative of the trilinear value, zero along axes on which the point
        is outside the grid. Points must be finite.
        """
        flat = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        distance, gradient = np.empty(len(flat)), np.empty_like(flat)
        sample(self.grid, flat, distance, gradient)
        return distance.reshape(points.shape[:-1]), gradient.reshape(points.shape)


def distance_field(occupancy: Occupancy, *, unknown: Unknown = "free") -> DistanceField:
    """Compute the distance field of a voxel map.

    M = d_free - res/2 outside and -(d_occ - res/2) inside, with the exact Euclidean distances between voxel
    centres (scipy): the surface lies on the faces between free and occupied voxels. Without the half
    voxel it would jump by two voxels there.

    Args:
        occupancy: probabilities, from 0.5 occupied, NaN unknown.
        unknown: the state of unknown voxels, free or occupied.

    Returns:
        The field; where a map has no obstacle at all, 1 km everywhere.
    """
    from scipy.ndimage import distance_transform_edt

    with np.errstate(invalid="ignore"):
        occupied = occupancy.probability >= OCCUPIED
    if unknown == "occupied":
        occupied |= np.isnan(occupancy.probability)
    half = occupancy.resolution_m / 2
    if not occupied.any():
        distance = np.full(occupied.shape, _NOWHERE_M, dtype=np.float32)
    elif occupied.all():
        distance = np.full(occupied.shape, -_NOWHERE_M, dtype=np.float32)
    else:
        free_m = distance_transform_edt(~occupied, sampling=occupancy.resolution_m)
        distance = (free_m - half).astype(np.float32)
        del free_m  # the largest arrays of the program: not two at a time
        inside_m = distance_transform_edt(occupied, sampling=occupancy.resolution_m)
        np.copyto(distance, (half - inside_m).astype(np.float32), where=occupied)
    # Interpolation needs two centres along each axis; beyond the border the field is constant anyway.
    for axis in range(3):
        if distance.shape[axis] == 1:
            distance = np.repeat(distance, 2, axis=axis)
    distance = np.ascontiguousarray(distance)
    origin = np.array(occupancy.origin, dtype=np.float64)
    return DistanceField(Grid(distance, origin, float(occupancy.resolution_m)), occupancy.from_ns)


def open_space() -> DistanceField:
    """Return the field of a world without known obstacles."""
    return DistanceField(Grid(np.full((2, 2, 2), _NOWHERE_M, dtype=np.float32), np.zeros(3), 1.0))
