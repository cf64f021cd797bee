"""Maps with a known shape, and an actor who walks a straight line past them."""

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.planning.distance_field import DistanceField, distance_field
from pipelines.session.records import Occupancy

Int64 = NDArray[np.int64]
ORIGIN = np.array([-25.0, -30.0, 0.0])
SIZE_M = (80.0, 60.0, 30.0)


def voxel_centres(resolution_m: float) -> tuple[Float, Float, Float]:
    """Return east, north and up of the voxel centres, open grids."""
    x, y, z = (
        ORIGIN[a] + resolution_m * (np.arange(round(SIZE_M[a] / resolution_m)) + 0.5) for a in range(3)
    )
    return x[:, None, None], y[None, :, None], z[None, None, :]


def mound(height_m: float = 6.0, *, resolution_m: float = 0.5) -> DistanceField:
    """Make a Gaussian mound, sigma 7 x 3 m, beside the way along y = 0; no ground."""
    x, y, z = voxel_centres(resolution_m)
    return as_field(z < height_m * np.exp(-(((x - 30) / 7) ** 2) / 2 - ((y - 8) / 3) ** 2 / 2), resolution_m)


def wall(resolution_m: float = 0.5) -> DistanceField:
    """Make a wall 3 m thick and 6 m high, from x = 0 to x = 25 beside the way."""
    x, y, z = voxel_centres(resolution_m)
    return as_field((np.abs(y - 8) < 1.5) & (x > 0) & (x < 25) & (z < 6), resolution_m)


def trees(resolution_m: float = 0.5) -> DistanceField:
    """Make trunks and crowns on both sides of the way, none nearer than 5 m."""
    x, y, z = voxel_centres(resolution_m)
    occupied = np.zeros(np.broadcast_shapes(x.shape, y.shape, z.shape), dtype=np.bool_)
    for east, north in np.random.default_rng(5).uniform([0, 5], [45, 15], (12, 2)):
        side = -1 if int(east) % 2 else 1
        level = (x - east) ** 2 + (y - side * north) ** 2
        occupied |= (level < 0.3**2) & (z < 4)
        occupied |= level + (z - 5) ** 2 < 1.6**2
    return as_field(occupied, resolution_m)


def bare_ground(resolution_m: float = 0.5) -> DistanceField:
    """Make one layer of voxels, flat."""
    x, y, z = voxel_centres(resolution_m)
    return as_field(np.broadcast_to(z < resolution_m, (x.size, y.size, z.size)), resolution_m)


def as_field(occupied: NDArray[np.bool_], resolution_m: float) -> DistanceField:
    """Return the field of a grid at `ORIGIN`."""
    return distance_field(Occupancy(occupied.astype(np.float32), ORIGIN, resolution_m))


def walker(seconds: float, speed_mps: float = 1.2, rate_hz: float = 10.0) -> tuple[Int64, Float]:
    """Return stamps [T] and hips [T, 3] of an actor who walks east from the origin, hips at 1 m."""
    t_s = np.arange(0, seconds, 1 / rate_hz)
    return (t_s * 1e9).astype(np.int64), np.stack([speed_mps * t_s, 0 * t_s, 0 * t_s + 1.0], axis=1)


def occupied_share(field: DistanceField, camera: Float, actor: Float, *, start_m: float) -> Float:
    """Compute the occupied share of sight lines sample by sample, every half voxel at most."""
    camera, actor = np.broadcast_arrays(camera, actor)
    shares = np.zeros(camera.shape[:-1])
    occupied, side_m = field.grid.distance_m < 0, field.grid.resolution_m
    for place in np.ndindex(shares.shape):
        way = camera[place] - actor[place]
        length = float(np.linalg.norm(way))
        if length > start_m:
            count = int(np.ceil((length - start_m) / (side_m / 2) - 1e-9))
            along = start_m + (np.arange(count) + 0.5) * (length - start_m) / count
            points = actor[place] + along[:, None] * way / length
            index = np.floor((points - field.grid.origin) / side_m).astype(int)
            inside = ((index >= 0) & (index < occupied.shape)).all(axis=1)
            shares[place] = occupied[tuple(index[inside].T)].sum() / count
    return shares
