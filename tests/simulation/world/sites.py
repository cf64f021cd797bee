"""Worlds with a bit of everything, for tests."""

import numpy as np

from pipelines.geometry.arrays import Bool, Float
from pipelines.simulation import scenario
from pipelines.simulation.world import World, build_world

NOBODY: Float = np.zeros((0, 2))

MOUNDS = [
    {"centre": [4.0, 3.0], "sigma_m": [3.0, 1.5], "height_m": 2.0, "yaw_deg": 30.0},
    {"centre": [-5.0, 1.0], "sigma_m": [2.0, 2.0], "height_m": 0.8},
]
TREES = [
    {"position": [0.0, 5.0], "height_m": 5.0, "crown_radius_m": 1.2},
    {"position": [4.5, 2.0], "height_m": 3.0, "crown_radius_m": 0.9},
]
WALLS = [
    {"start": [-6.0, -3.0], "end": [-1.0, -5.0], "height_m": 2.0},
    {"start": [3.0, -2.0], "end": [3.0, 4.0], "height_m": 1.0, "thickness_m": 0.5},
]


def site(**parts: object) -> World:
    """Build a world of the named parts, on a ground of 20 m."""
    spec = scenario.WorldSettings.model_validate({"ground": {"size_m": 20.0}, **parts})
    return build_world(spec, 3, keep_clear=NOBODY)


def everything() -> World:
    """Build two mounds that overlap, two trees, two walls."""
    return site(mounds=MOUNDS, trees=TREES, walls=WALLS)


def solid(world: World, points: Float) -> Bool:
    """Test if points [..., 3] are below the ground or inside of a trunk, crown or wall."""
    x, y, z = np.moveaxis(np.asarray(points), -1, 0)
    inside = z < world.height(np.stack([x, y], axis=-1))
    for (east, north, low, high, radius), crown in zip(
        world.obstacles.trunks, world.obstacles.crowns, strict=True
    ):
        inside = inside | (np.hypot(x - east, y - north) < radius) & (low < z) & (z < high)
        inside |= (((points - crown[:3]) / crown[[3, 3, 4]]) ** 2).sum(axis=-1) < 1
    for east, north, cos, sin, length, thickness, low, high in world.obstacles.slabs:
        along, across = cos * (x - east) + sin * (y - north), cos * (y - north) - sin * (x - east)
        inside |= (abs(along) < length) & (abs(across) < thickness) & (low < z) & (z < high)
    return np.asarray(inside)
