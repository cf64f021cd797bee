"""Drawn surfaces against the solids."""

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.simulation.raster import TriangleSurface
from tests.simulation.world.sites import everything, site


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


def test_crowns_look_as_large_as_they_are() -> None:
    """Outlines from all sides: in at least 85 of 100 directions of a picture's plane within a fifth of 1."""
    world = site(wood={"count": 12, "radius_m": 30.0})
    crowns = world.surfaces()[2]
    each = len(crowns.vertices) // 12
    for k, crown in enumerate(world.obstacles.crowns):
        unit = (crowns.vertices[k * each : (k + 1) * each] - crown[:3]) / crown[[3, 3, 4]]
        radius = np.linalg.norm(unit, axis=1)
        assert radius.min() > 0.65
        assert radius.max() < 1.3
        bearing = np.linspace(0, 2 * np.pi, 100, endpoint=False)
        for plane in ([0, 1], [0, 2], [1, 2]):
            flat = unit[:, plane]
            angle = np.arctan2(flat[:, 1], flat[:, 0])
            near = np.abs(np.angle(np.exp(1j * (angle - bearing[:, None])))) < 0.1
            outline = np.where(near, np.hypot(*flat.T), 0).max(axis=1)
            assert (np.abs(outline - 1) < 0.2).mean() > 0.85
            assert abs(outline.mean() - 1) < 0.1
