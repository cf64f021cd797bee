"""Distances to known surfaces, and gradients that are the derivative of the interpolated value."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from pipelines.planning.config import Zone
from pipelines.planning.distance_field import (
    distance_field,
    in_turn,
    visible,
    zone_distances,
    zone_edges,
)
from pipelines.session.records import Occupancy

RES = 0.25


def slab(*, unknown_above: bool = False) -> Occupancy:
    """Make a box of 4 m, occupied up to z = 1; the rest is free, or unknown."""
    probability = np.full((16, 16, 16), np.nan if unknown_above else 0.0, dtype=np.float32)
    probability[:, :, :4] = 0.5  # exactly the threshold
    probability[:, :, 4:8] = 0.49
    return Occupancy(probability, np.array([-2.0, -2.0, 0.0]), RES, from_ns=7)


@given(
    st.floats(-5, 5),
    st.floats(-5, 5),
    st.floats(RES / 2, 4 - RES / 2),
)
def test_a_flat_surface_is_exact(x: float, y: float, z: float) -> None:
    """Plus and minus half a voxel put the surface at z = 1 on both sides, linear between all centres."""
    distance, gradient = distance_field(slab()).sample(np.array([x, y, z]))
    assert distance == pytest.approx(z - 1.0, abs=1e-5)  # float32
    if abs((z / RES - 0.5) % 1) > 1e-6:
        assert gradient == pytest.approx([0, 0, 1], abs=1e-5)


def test_gradient_is_the_derivative_of_the_interpolated_value() -> None:
    """On random fields, inside cells: central differences of a polynomial of degree 3 are off by h^2."""
    rng = np.random.default_rng(2)
    occupied = rng.random((12, 9, 10)) < 0.1
    field = distance_field(Occupancy(occupied.astype(np.float32), np.zeros(3), RES))
    points = (rng.integers(1, 7, (300, 3)) + rng.uniform(0.51, 1.49, (300, 3))) * RES
    h = 1e-5
    _, gradient = field.sample(points)
    for axis, step in enumerate(h * np.eye(3)):
        numeric = (field.sample(points + step)[0] - field.sample(points - step)[0]) / (2 * h)
        assert np.abs(gradient[:, axis] - numeric).max() < 1e-8


def test_unknown_is_free_or_occupied_as_asked() -> None:
    point = np.array([0.0, 0.0, 3.0])
    assert distance_field(slab(unknown_above=True)).sample(point)[0] == pytest.approx(2.0, abs=1e-5)
    blocked = distance_field(slab(unknown_above=True), unknown="occupied")
    assert blocked.sample(point)[0] == pytest.approx(-1.0, abs=1e-5)
    assert blocked.from_ns == 7


YARD = Zone(((0.0, 0.0), (6.0, 0.0), (6.0, 2.0), (2.0, 2.0), (2.0, 6.0), (0.0, 6.0)), -1.0, 3.0)  # an L
MAST = Zone(((20.0, 0.0), (21.0, 0.0), (21.0, 1.0), (20.0, 1.0)))  # without a top


def test_zones_are_as_far_as_their_nearest_point() -> None:
    """Distances from outside equal those to a dense sample of the L; inside, to the nearest wall or lid."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -2, -2], [8, 8, 4], (300, 3))
    spaced = [np.linspace(*ends, 61) for ends in ((0, 6), (0, 6), (-1, 3))]
    solid = np.stack(np.meshgrid(*spaced, indexing="ij"), axis=-1).reshape(-1, 3)
    solid = solid[(solid[:, 0] <= 2) | (solid[:, 1] <= 2)]
    found = zone_distances(zone_edges([YARD]), points)
    outside = found > 0
    sampled = np.asarray(cKDTree(solid).query(points)[0])
    assert 50 < outside.sum() < 280
    assert found[outside] == pytest.approx(sampled[outside], abs=0.1 * np.sqrt(3) / 2)
    assert (sampled[~outside] < 0.1).all()
    assert zone_distances(zone_edges([YARD]), np.array([1.0, 4.5, 0.5])) == pytest.approx(-1.0)
    assert zone_distances(zone_edges([YARD]), np.array([1.0, 1.0, 2.8])) == pytest.approx(-0.2)
    assert zone_distances(zone_edges([YARD, MAST]), np.array([22.0, 0.5, 900.0])) == pytest.approx(1.0)
    assert zone_distances(zone_edges([]), np.zeros((2, 3))).min() == np.inf


def test_zones_bar_drones_but_not_sight() -> None:
    free = distance_field(slab())
    zones = zone_edges([Zone(((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)), 2.0, 3.0)])
    field = free.barring(zones)
    points = np.random.default_rng(1).uniform([-1.9, -1.9, 1.6], [1.9, 1.9, 3.8], (200, 3))
    barred, gradient = field.sample(points)
    assert (barred == np.minimum(free.sample(points)[0], zone_distances(zones, points))).all()
    assert (barred < 0).any()
    step = 1e-5
    for axis in range(3):
        ahead, behind = points.copy(), points.copy()
        ahead[:, axis] += step
        behind[:, axis] -= step
        slope = (field.sample(ahead)[0] - field.sample(behind)[0]) / (2 * step)
        assert np.mean(np.abs(slope - gradient[:, axis]) < 1e-3) > 0.97  # but for edges between faces
    camera, actor = np.array([1.8, 0.0, 2.5]), np.array([-1.8, 0.0, 2.5])  # right through the zone
    assert visible(field, camera, actor, start_m=0.0)
    assert field.barring(zone_edges([])).sample(points)[0] == pytest.approx(free.sample(points)[0])


def test_each_map_holds_from_its_own_time_on() -> None:
    t_ns = np.arange(10, dtype=np.int64)
    first, second = (
        distance_field(Occupancy(slab().probability, np.zeros(3), RES, from_ns=n)) for n in (3, 6)
    )
    assert [(rows, field) for rows, field in in_turn([first, second], t_ns)][1:] == [
        (slice(3, 6), first),
        (slice(6, 10), second),
    ]
    assert not in_turn([first, second], t_ns)[0][1].has_obstacles
    assert [rows for rows, _ in in_turn([first, second], t_ns[4:])] == [slice(0, 2), slice(2, 6)]
    assert [rows for rows, _ in in_turn([first, second], t_ns[:2])] == [slice(0, 2)]
    assert [rows for rows, _ in in_turn([], t_ns)] == [slice(0, 10)]
