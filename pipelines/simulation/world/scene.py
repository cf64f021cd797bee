"""A world that was built: one truth for pictures, occlusion and maps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.session.records import Occupancy
from pipelines.simulation import scenario
from pipelines.simulation.surfaces import Surface
from pipelines.simulation.world import kernels
from pipelines.simulation.world.ground_surface import ground_surface
from pipelines.simulation.world.obstacle_surfaces import tree_surfaces, wall_surfaces
from pipelines.simulation.world.obstacles import Obstacles, erect
from pipelines.simulation.world.occupancy import map_world
from pipelines.simulation.world.planting import plant
from pipelines.simulation.world.terrain import Terrain, raise_mounds

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class World:
    """What stands around: ground with mounds, trees, walls. The ground is there beyond its square, too."""

    ground: scenario.Ground
    terrain: Terrain
    obstacles: Obstacles
    seed: int

    def height(self, xy: Float) -> Float:
        """Height of the ground [...], m, at points [..., 2]."""
        return self.terrain.height(xy)

    def normal(self, xy: Float) -> Float:
        """Unit normals [..., 3] of the ground, pointing up, at points [..., 2]."""
        return self.terrain.normal(xy)

    def surfaces(self) -> list[Surface]:
        """What is to be seen: the ground out to the horizon, then trunks, crowns and walls if there are any.

        The ground is within 2 cm of `height`, trunks within 4 % of their radius, walls exact. Crowns are
        ragged, with leaves up to a fifth beyond or three tenths short of the ellipsoid that `solid` and
        `hidden` know; seen from anywhere, about nine tenths of both outlines' union is common to both.
        """
        return [
            ground_surface(self.ground, self.terrain),
            *tree_surfaces(self.obstacles, self.seed),
            *wall_surfaces(self.obstacles, self.seed),
        ]

    def solid(self, points: Float) -> Bool:
        """Whether points [..., 3] are below the ground or inside a trunk, crown or wall; NaN is not."""
        rows = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        out = np.empty(len(rows), dtype=np.bool_)
        solids = self.obstacles
        kernels.inside(rows, self.terrain.mounds, solids.trunks, solids.crowns, solids.slabs, out)
        return out.reshape(np.shape(points)[:-1])

    def hidden(self, eye: Float, target: Float) -> Bool:
        """Whether something solid stands between eyes and targets, [..., 3] each, broadcast.

        Exact for trunks, crowns and walls. The ground hides every line that dips more than 2 mm into it and
        none that dips less than 1 mm, so that what lies on the ground can be seen. What is inside of a
        solid is hidden, and so is everything from there; NaN is not.
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
        """The map of the ground's square: 1 where a solid reaches into a voxel, else 0; see `map_world`."""
        return map_world(
            self.ground, self.terrain, self.obstacles, resolution_m=resolution_m, height_m=height_m
        )


def build_world(spec: scenario.World, seed: int, *, keep_clear: Float) -> World:
    """Raise the mounds, plant the wood, stand trees and walls on the ground.

    Args:
        spec: what there is.
        seed: of the wood and of how things look.
        keep_clear: [K, 2] m, points of the actor's way, which the wood keeps clear of. Trees that the
            scenario places itself stand where it says.

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
