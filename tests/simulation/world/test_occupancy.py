"""The map against what is solid, point by point."""

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.session.records import Occupancy
from tests.simulation.world.sites import TREES, WALLS, everything, site, solid


def points_within(occupancy: Occupancy, per_side: int) -> Float:
    """Return evenly spaced points inside every voxel [X, Y, Z, K, 3], from its walls to its middle."""
    inner = np.linspace(1e-6, 1 - 1e-6, per_side)
    place = np.stack(np.meshgrid(inner, inner, inner), axis=-1).reshape(-1, 3)
    index = np.moveaxis(np.indices(occupancy.probability.shape), 0, -1)
    points: Float = occupancy.origin + (index[..., None, :] + place) * occupancy.resolution_m
    return points


def test_level_ground_fills_the_voxels_below_it_alone() -> None:
    occupancy = site().occupancy(0.3, 2.0)
    # 20 m about the origin in voxels of 0.3 m: from -34 to 34; one layer below zero, seven up to 2.1 m.
    assert occupancy.probability.shape == (68, 68, 8)
    np.testing.assert_allclose(occupancy.origin, [-10.2, -10.2, -0.3], rtol=1e-15)
    assert (occupancy.probability[..., 0] == 1).all()
    assert (occupancy.probability[..., 1:] == 0).all()


def test_where_a_point_is_solid_its_voxel_is_occupied() -> None:
    world = everything()
    occupancy = world.occupancy(0.45, 6.0)
    inside = solid(world, points_within(occupancy, 5)).any(axis=-1)
    occupied = occupancy.probability == 1
    assert not (inside & ~occupied).any()
    assert inside.any()
    assert not inside.all()


def test_every_occupied_voxel_holds_a_solid_point() -> None:
    """Trees and walls are exact: voxels without a solid among 8 points show one among 64,000.

    A corner may reach in by less than the points' spacing: then a solid point lies within two spacings.
    """
    world = site(trees=TREES, walls=WALLS)
    occupancy = world.occupancy(0.2, 6.0)
    unseen = np.argwhere(
        (occupancy.probability == 1) & ~solid(world, points_within(occupancy, 2)).any(axis=-1)
    )
    assert len(unseen) > 20
    one = Occupancy(np.ones((1, 1, 1), dtype=np.float32), np.zeros(3), 0.2)
    fine = points_within(one, 40).reshape(-1, 3)
    slivers = 0
    for corner in occupancy.origin + unseen[:30] * 0.2:
        if not solid(world, corner + fine).any():
            slivers += 1
            edge = 0.1 + (fine - 0.1) * (1 + 4 / 39)
            assert solid(world, corner + edge).any()
    assert slivers <= 4


def test_the_ground_errs_to_occupied_by_a_twentieth_of_a_voxel() -> None:
    world = site(mounds=[{"centre": [1.0, 2.0], "sigma_m": [2.0, 0.8], "height_m": 2.0, "yaw_deg": 20.0}])
    occupancy = world.occupancy(0.25, 3.0)
    # The highest ground over each voxel's square, sampled 21 x 21: between samples it rises by slope * 9 mm.
    fine = np.linspace(0, 1, 21)
    index = np.moveaxis(np.indices(occupancy.probability.shape[:2]), 0, -1)
    place = np.stack(np.meshgrid(fine, fine), axis=-1).reshape(-1, 2)
    top = world.height(occupancy.origin[:2] + (index[..., None, :] + place) * 0.25).max(axis=-1)
    floor = occupancy.origin[2] + np.arange(occupancy.probability.shape[2]) * 0.25
    occupied = occupancy.probability == 1
    assert occupied[floor < top[..., None] - 1e-9].all()
    unseen = world.terrain.slope * 0.25 / 20 * np.sqrt(0.5)
    assert not occupied[floor > top[..., None] + 0.05 * 0.25 + unseen].any()
    assert (occupied.sum(axis=-1) >= 1).all(), "every column shows a planner its ground"
