"""Simulated worlds against their closed forms: ground, solids, occupancy, plants and looks."""

from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.records import Occupancy
from pipelines.simulation import scenario
from pipelines.simulation.raster import TriangleSurface
from pipelines.simulation.world import GRAZE_M, build_world
from tests.simulation.world.sites import MOUNDS, NOBODY, TREES, WALLS, everything, site, solid


def closed_form(xy: Float) -> Float:
    """Compute h exp(-d' S^-1 d / 2) with S = R diag(sigma^2) R', mound by mound."""
    total = np.zeros(xy.shape[:-1])
    for mound in map(scenario.Mound.model_validate, MOUNDS):
        yaw = np.radians(mound.yaw_deg)
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        spread = np.linalg.inv(turn @ np.diag(np.square(mound.sigma_m)) @ turn.T)
        away = xy - np.array(mound.centre)
        total += mound.height_m * np.exp(-np.einsum("...i,ij,...j->...", away, spread, away) / 2)
    return total


def scattered(count: int) -> Float:
    return np.random.default_rng(5).uniform(-12, 12, (count, 2))


def test_heights_are_those_of_the_formula() -> None:
    world, xy = everything(), scattered(400).reshape(20, 20, 2)
    assert world.height(xy).shape == (20, 20)
    np.testing.assert_allclose(
        world.height(xy), closed_form(xy), rtol=0, atol=1e-13
    )  # sums of two numbers < 3
    assert world.height(np.array([1e6, -1e6])) == 0.0, "defined everywhere"
    assert np.array_equal(site().height(xy), np.zeros((20, 20)))


def test_no_place_is_steeper_or_more_curved_than_stated() -> None:
    terrain, step = everything().terrain, 1e-3
    axis = np.linspace(-12, 12, 121)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    east, north = step * np.eye(2)

    def height(*by: Float) -> Float:
        return terrain.height(xy + sum(by, np.zeros(2)))

    slopes = [(height(way) - height(-way)) / (2 * step) for way in (east, north)]
    steepest = np.hypot(*slopes).max()
    # The bounds add up what the mounds reach at different places, so they are not met, but of their size.
    assert 0.6 * terrain.slope < steepest <= terrain.slope
    (ee, nn) = ((height(way) + height(-way) - 2 * height()) / step**2 for way in (east, north))
    en = (height(east, north) + height(-east, -north) - height(east, -north) - height(-east, north)) / (
        4 * step**2
    )
    hessian = np.stack([np.stack([ee, en], axis=-1), np.stack([en, nn], axis=-1)], axis=-1)
    curved = np.linalg.norm(hessian, ord=2, axis=(-2, -1))
    assert 0.6 * terrain.curvature < curved.max() <= terrain.curvature
    for radius in (0.3, 2.0):
        centre = np.random.default_rng(2).uniform(-10, 10, (40, 2))
        bound = terrain.curvature_within(centre, radius)
        within = np.linalg.norm(xy - centre[:, None], axis=-1) <= radius
        assert all(curved[near].max() <= limit + 1e-5 for near, limit in zip(within, bound, strict=True))


def within_faces(surface: TriangleSurface, per_face: int) -> Float:
    """Draw random points of every triangle [F, K, 3]."""
    shares = np.random.default_rng(4).dirichlet([1, 1, 1], (len(surface.faces), per_face))
    points: Float = np.einsum("fkc,fcd->fkd", shares, surface.vertices[surface.faces])
    return points


def face_normals(surface: TriangleSurface) -> Float:
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    normals: Float = np.cross(b - a, c - a)
    return normals


def test_every_surface_is_fit_to_be_rendered() -> None:
    ground, *others = everything().surfaces()
    assert ground.ground
    assert not any(surface.ground for surface in others)
    for surface in (ground, *others):
        assert surface.faces.dtype == np.int32
        assert surface.colour.dtype == np.float32
        assert surface.colour.shape == surface.vertices.shape
        assert np.isfinite(surface.vertices).all()
        assert ((surface.colour >= 0) & (surface.colour <= 1)).all()
        assert np.array_equal(np.unique(surface.faces), np.arange(len(surface.vertices))), "no corner unused"
        assert (np.linalg.norm(face_normals(surface), axis=1) > 0).all()


def test_the_ground_follows_its_height_and_has_no_hole() -> None:
    world = everything()
    ground = world.surfaces()[0]
    points = within_faces(ground, 6)
    np.testing.assert_allclose(points[..., 2], world.height(points[..., :2]), rtol=0, atol=0.02)
    areas = face_normals(ground)[:, 2] / 2
    assert (areas > 0).all(), "seen from above, none is turned over"
    extent = np.ptp(ground.vertices[:, :2], axis=0)
    assert (extent > 4000).all()
    assert areas.sum() == pytest.approx(extent.prod(), rel=1e-9), "the triangles cover the whole square once"


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


WAY = np.stack([np.linspace(-20, 20, 400), np.zeros(400)], axis=1)


def spec(**wood: float) -> scenario.WorldSettings:
    return scenario.WorldSettings.model_validate(
        {
            "wood": wood,
            "walls": [{"start": [5.0, 5.0], "end": [5.0, 15.0]}],
            "trees": [{"position": [0.0, 9.0]}],
        }
    )


def test_no_tree_stands_where_it_must_not() -> None:
    world = build_world(spec(count=60, radius_m=25.0, clear_m=4.0), 5, keep_clear=WAY)
    place, radius = world.obstacles.trunks[:, :2], world.obstacles.crowns[:, 3]
    assert len(place) == 61
    assert place[0].tolist() == [0, 9], "the scenario's own trees come first and stay where they are"
    planted = place[1:]
    assert (np.hypot(*planted.T) <= 25).all()
    assert (np.linalg.norm(planted[:, None] - WAY, axis=-1) >= 4).all()
    apart = np.linalg.norm(place[:, None] - place, axis=-1) + 99 * np.eye(61)
    assert (apart >= 0.9 * np.maximum(radius[:, None], radius)).all()
    in_wall = (np.abs(planted[:, 0] - 5) < 0.15) & (planted[:, 1] > 5) & (planted[:, 1] < 15)
    assert not in_wall.any()
    heights = (world.obstacles.crowns[1:, 2] + world.obstacles.crowns[1:, 4]).tolist()
    assert all(4.5 <= height <= 7.5 for height in heights), "a quarter about 6 m, on level ground"


def test_a_wood_that_does_not_fit_is_one_clear_line() -> None:
    with pytest.raises(DataError, match=r"^world\.wood: .*\b0 of 3\b.*\b5 m\b.*\bclear_m$"):
        build_world(spec(count=3, radius_m=5.0, clear_m=6.0), 5, keep_clear=WAY)
    with pytest.raises(DataError, match=r"^world\.wood: .*\b\d+ of 500\b.*\b8 m\b"):
        build_world(spec(count=500, radius_m=8.0, clear_m=0.0), 5, keep_clear=NOBODY)


# Along x from -2 to 2, y from -0.25 to 0.25, up to 1.5.
WALL = {"start": [-2.0, 0.0], "end": [2.0, 0.0], "height_m": 1.5, "thickness_m": 0.5}
TINY = 1e-9


def blocked(world_parts: Mapping[str, object], eye: list[float], target: list[float]) -> bool:
    world = site(**world_parts)
    one, other = (bool(world.hidden(np.array(a), np.array(b))) for a, b in ((eye, target), (target, eye)))
    assert one == other, "a line of sight has no direction"
    return one


def test_lines_that_graze_a_mound() -> None:
    """Level lines over the top of a mound 2 m high: hidden below 2 m - 2 GRAZE, seen above 2 m - GRAZE."""
    mound = {"mounds": [{"centre": [0.3, 0.0], "sigma_m": [2.0, 3.0], "height_m": 2.0}]}
    for height, hides in ((2 - 2 * GRAZE_M - TINY, True), (2 - GRAZE_M + TINY, False), (2 + TINY, False)):
        for bearing in np.linspace(0, np.pi, 8):
            for reach in (7.0, 40.0):
                x, y = reach * np.cos(bearing), reach * np.sin(bearing)
                assert blocked(mound, [0.3 + x, y, height], [0.3 - 1.3 * x, -1.3 * y, height]) == hides


def test_what_lies_on_the_ground_is_seen() -> None:
    """From 30 m straight above a mound, and not three times the grazing depth within it."""
    world = site(mounds=[{"centre": [-5.0, 1.0], "sigma_m": [2.0, 2.0], "height_m": 0.8}])
    xy = np.array([-5.0, 1.0]) + np.random.default_rng(1).uniform(-4, 4, (500, 2))
    feet = np.concatenate([xy, world.height(xy)[:, None]], axis=1)
    eye = np.array([-5.0, 1.0, 30.0])
    assert not world.hidden(eye, feet).any()
    assert world.hidden(eye, feet - np.array([0, 0, 3 * GRAZE_M])).all()


coordinates = st.tuples(*[st.floats(-9, 9)] * 2, st.floats(0.02, 6))


@settings(deadline=None, max_examples=60)
@given(coordinates, coordinates)
def test_hidden_agrees_with_marching_through_what_is_solid(
    eye: tuple[float, float, float], target: tuple[float, float, float]
) -> None:
    """A solid sample hides (deeper than the ground's tolerance), and what hides shows itself in samples.

    Samples are 1 mm apart. A line that is hidden without a solid sample touches a shape for less than that:
    then one in a bundle moved by 2 cm must be solid, since every solid here is wider than that.
    """
    world = everything()
    line = np.array(eye) + np.linspace(0, 1, 20_000)[:, None] * (np.array(target) - eye)
    hidden = bool(world.hidden(np.array(eye), np.array(target)))
    if (solid(world, line) & solid(world, line + np.array([0, 0, 2 * GRAZE_M + TINY]))).any():
        assert hidden
    if hidden:
        nudges = 0.02 * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        assert any(solid(world, line + nudge).any() for nudge in nudges)
