"""Distances to known surfaces, and gradients that are the derivative of the interpolated value."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.planning.distance_field import (
    distance_field,
    in_turn,
    visible,
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


def test_cameras_see_through_what_drones_avoid() -> None:
    """Look down through the unknown at a place above the slab: clearance as if occupied, sight as if free."""
    camera, actor = np.array([[0.0, 0.0, 3.8]]), np.array([[0.0, 0.0, 1.3]])
    fields = {
        word: distance_field(slab(unknown_above=True), unknown=word)
        for word in ("free", "occupied", "avoided")
    }
    clearance_m = {word: float(field.sample(camera)[0][0]) for word, field in fields.items()}
    assert clearance_m["avoided"] == clearance_m["occupied"] < 0 < clearance_m["free"]
    seen = {word: bool(visible(field, camera, actor, start_m=0.0)[0]) for word, field in fields.items()}
    assert seen == {"free": True, "occupied": False, "avoided": True}
    np.testing.assert_array_equal(fields["avoided"].sight.bricks, fields["free"].sight.bricks)


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
