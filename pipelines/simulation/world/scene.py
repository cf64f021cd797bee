"""A world that was built: one truth for pictures, occlusion and maps."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.session.records import Occupancy
from pipelines.simulation import scenario
from pipelines.simulation.surfaces import TriangleSurface
from pipelines.simulation.world import kernels
from pipelines.simulation.world.solids import (
    MoundedGround,
    Obstacles,
    erect,
    ground_surface,
    plant,
    raise_mounds,
    tree_surfaces,
    wall_surfaces,
)


@dataclass(frozen=True)
class World:
    """The surroundings: ground with mounds, trees, walls. The ground goes on beyond its square."""

    ground: scenario.GroundSquare
    terrain: MoundedGround
    obstacles: Obstacles
    seed: int

    def height(self, xy: Float) -> Float:
        """Compute the height of the ground [...], m, at points [..., 2]."""
        return self.terrain.height(xy)

    def normal(self, xy: Float) -> Float:
        """Compute unit normals [..., 3] of the ground, pointing up, at points [..., 2]."""
        return self.terrain.normal(xy)

    def surfaces(self) -> list[TriangleSurface]:
        """Return the visible surfaces: the ground out to the horizon, then trunks, crowns and walls if any.

        The ground is within 2 cm of `height`, trunks within 4 % of their radius, walls exact. Crowns are
        ragged: leaves end up to a fifth beyond or three tenths short of the ellipsoid of `solid` and
        `hidden`. From any side, the two outlines share about nine tenths of their union.
        """
        return [
            ground_surface(self.ground, self.terrain),
            *tree_surfaces(self.obstacles, self.seed),
            *wall_surfaces(self.obstacles, self.seed),
        ]

    def solid(self, points: Float) -> Bool:
        """Test if points [..., 3] are below the ground or inside a trunk, crown or wall; False for NaN."""
        rows = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        out = np.empty(len(rows), dtype=np.bool_)
        solids = self.obstacles
        kernels.inside(rows, self.terrain.mounds, solids.trunks, solids.crowns, solids.slabs, out)
        return out.reshape(np.shape(points)[:-1])

    def hidden(self, eye: Float, target: Float) -> Bool:
        """Test if something solid stands between eyes and targets, [..., 3] each, broadcast.

        Exact for trunks, crowns and walls. The ground hides every line that dips more than 2 mm into it and
        none that dips less than 1 mm, so that points on the ground can be seen. Points inside a solid are
        hidden, and from there everything is hidden; False for NaN.
        """
        eyes, targets = np.broadcast_arrays(eye, target)
        starts, ends = (
            np.ascontiguousarray(part, dtype=np.float64).reshape(-1, 3) for part in (eyes, targets)
        )
        out = np.empty(len(ends), dtype=np.bool_)
        ground, solids = self.terrain, self.obstacles
        kernels.hidden(
            starts,
            ends,
            ground.mounds,
            ground.slope,
            ground.curvature,
            solids.trunks,
            solids.crowns,
            solids.slabs,
            out,
        )
        return out.reshape(eyes.shape[:-1])

    def occupancy(self, resolution_m: float, height_m: float) -> Occupancy:
        """Map the ground's square: 1 where a solid reaches into a voxel, else 0; see `map_world`."""
        return map_world(
            self.ground, self.terrain, self.obstacles, resolution_m=resolution_m, height_m=height_m
        )


def build_world(spec: scenario.WorldSettings, seed: int, *, keep_clear: Float) -> World:
    """Raise the mounds, plant the wood, stand trees and walls on the ground.

    `keep_clear` [K, 2] m are points of the actor's way, which the wood keeps clear of. Trees with a place
    in the scenario stand at that place.

    Raises:
        DataError: the wood does not fit, or a wall has no length.
    """
    terrain = raise_mounds(spec.mounds)
    trees = list(spec.trees)
    if spec.wood is not None:
        rng = np.random.default_rng([seed, _WOOD])
        trees += plant(spec.wood, rng, keep_clear=keep_clear, standing=trees, walls=spec.walls)
    return World(spec.ground, terrain, erect(terrain, trees, spec.walls), seed)


_WOOD = 1  # keeps the wood's random numbers apart from those of looks


_TOUCH_M = 1e-9  # level ground on the border between two voxels fills the lower one alone
_FINE_ENOUGH = 0.05  # of a voxel: allowed rise of the ground between samples
_MOST_SAMPLES = 16  # along a voxel


def map_world(
    ground: scenario.GroundSquare,
    terrain: MoundedGround,
    obstacles: Obstacles,
    *,
    resolution_m: float,
    height_m: float,
) -> Occupancy:
    """Return voxels over the ground's square: 1 occupied, 0 free.

    They reach from one voxel below z = 0 up to `height_m`.

    A voxel is occupied if the inside of a solid and of the voxel have a point in common. The test is exact
    for trunks, crowns and slabs. Over mounds it errs towards occupied: a voxel counts as soon as the ground
    could reach into it, by the sampled heights and the curvature. This is at most 5 % of a voxel too early,
    unless a mound is narrower than a tenth of a voxel. Voxels lie on multiples of `resolution_m`.
    """
    half = ground.size_m / 2
    middle = np.array(ground.centre)
    first = np.floor((middle - half) / resolution_m + _TOUCH_M).astype(np.int64)
    end = np.ceil((middle + half) / resolution_m - _TOUCH_M).astype(np.int64)
    low = np.array([*first, -1], dtype=np.int64)
    shape = (*(end - first).tolist(), 1 + math.ceil(height_m / resolution_m - _TOUCH_M))
    grid = _filled_ground(terrain, low, shape, resolution_m)
    kernels.mark_trees(grid, low, resolution_m, obstacles.trunks, obstacles.crowns)
    kernels.mark_slabs(grid, low, resolution_m, obstacles.slabs)
    origin = low.astype(np.float64) * resolution_m
    return Occupancy(grid.astype(np.float32), origin, resolution_m)


def _filled_ground(
    terrain: MoundedGround, low: NDArray[np.int64], shape: tuple[int, int, int], side_m: float
) -> Bool:
    # Between the corners of a square of side s a surface rises above them by at most curvature s^2 / 4:
    # linear interpolation errs by curvature r^2 / 2 within the circle of radius r = s / sqrt(2) around it.
    samples = math.ceil(math.sqrt(terrain.curvature * side_m / 4 / _FINE_ENOUGH))
    samples = min(max(samples, 1), _MOST_SAMPLES)
    margin = terrain.curvature * (side_m / samples) ** 2 / 4
    floor = (low[2] + np.arange(shape[2])) * side_m
    y = low[1] * side_m + np.arange(shape[1] * samples + 1) * (side_m / samples)
    grid = np.empty(shape, dtype=np.bool_)
    for i in range(shape[0]):
        x = (low[0] + i) * side_m + np.arange(samples + 1) * (side_m / samples)
        height = terrain.height(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)).max(axis=0)
        columns = [height[k : k + shape[1] * samples : samples] for k in range(samples + 1)]
        top = np.maximum.reduce(columns) + margin
        grid[i] = floor < top[:, None] - _TOUCH_M
    return grid
