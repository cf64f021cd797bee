"""The cost map by hand, distance fields, formations, and the information of cameras by the ray model."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt

from pipelines.planning.config import ErrorModel, PlannerConfig, PlannerTuning
from pipelines.planning.distance_field import distance_field, in_turn, visible
from pipelines.planning.formation import cost_map, costs_of_slots, formation_slots, slot_offsets
from pipelines.planning.scores import log_determinant, predicted_error, ray_information
from pipelines.session.records import Occupancy
from tests.planning.worlds import occupied_share

CONFIG = PlannerConfig(w_obs=2.0, w_occ=3.0)


@given(st.integers(0, 10_000), st.sampled_from([0.002, 0.02, 0.4]), st.sampled_from([0.3, 3.0]))
def test_what_the_ends_of_a_line_tell_changes_no_cost(seed: int, share: float, eps_m: float) -> None:
    """As each slot and each line by itself: few obstacles and many, actors within and outside the map."""
    rng = np.random.default_rng(seed)
    occupied = (rng.random((20, 30, 10)) < share).astype(np.float32)
    field = distance_field(Occupancy(occupied, np.array([-5.0, 0.0, 0.0]), 0.5))
    tuning = PlannerTuning(eps_obs_m=eps_m, sight_start_m=float(rng.choice([0.0, 1.5])))
    config = replace(CONFIG, tuning=tuning)
    actor = rng.uniform([-15, -10, -3], [15, 25, 8], (6, 3))
    offsets = slot_offsets(formation_slots(rng.uniform(-3, 3, 7), 3, tilt_rad=0.2, range_m=6.0))
    costs = costs_of_slots(field, actor, offsets, config)
    cameras = actor[:, None, None] + offsets
    distance, _ = field.sample(cameras)
    assert costs.obstacle == pytest.approx(np.clip(1 - distance / eps_m, 0, 1), abs=1e-12)
    expected = occupied_share(field, cameras, actor[:, None, None], start_m=config.tuning.sight_start_m)
    # One sample, of 18 or more, on the face between two voxels may be rounded to the other side.
    assert np.abs(costs.occluded - expected).max() < 1 / 18 + 1e-9
    assert (costs.occluded == expected).mean() > 0.95
    total = (2 * costs.obstacle + 3 * costs.occluded).sum(axis=2)
    assert cost_map(costs, CONFIG) == pytest.approx(total, abs=1e-12)


@pytest.mark.parametrize("gamma", np.radians([30.0, 60.0, 90.0, 150.0]))
def test_error_of_two_cameras_as_in_closed_form(gamma: float) -> None:
    """Tr S = s^2 (1/2 + 2/sin^2 gamma) for equal cameras whose rays cross at gamma."""
    errors = ErrorModel(rotation_sigma_deg=0.8)
    level = (
        np.interp(0.0, errors.tilts_deg, each) for each in (errors.keypoint_sigma_m, errors.placed_share)
    )
    keypoint_m, placed = level
    s2 = keypoint_m**2 + (10 * np.radians(0.8)) ** 2 + errors.position_sigma_m**2
    offset = 10 * np.array([[1.0, 0.0, 0.0], [np.cos(gamma), np.sin(gamma), 0.0]])
    error = predicted_error(ray_information(offset, errors).sum(axis=0))
    assert error**2 == pytest.approx(s2 / placed * (0.5 + 2 / np.sin(gamma) ** 2), rel=1e-9)


@given(st.integers(0, 10_000))
def test_closed_forms_equal_linear_algebra(seed: int) -> None:
    rng = np.random.default_rng(seed)
    information = ray_information(rng.uniform(2, 12, (3, 3)), CONFIG.tuning.errors).sum(axis=0) + np.eye(3)
    assert predicted_error(information) ** 2 == pytest.approx(np.trace(np.linalg.inv(information)))
    assert log_determinant(information) == pytest.approx(np.linalg.slogdet(information)[1])


RES = 0.25


def slab(*, unknown_above: bool = False) -> Occupancy:
    """Make a box of 4 m, occupied up to z = 1; the rest is free, or unknown."""
    probability = np.full((16, 16, 16), np.nan if unknown_above else 0.0, dtype=np.float32)
    probability[:, :, :4] = 0.5  # exactly the threshold
    probability[:, :, 4:8] = 0.49
    return Occupancy(probability, np.array([-2.0, -2.0, 0.0]), RES, from_ns=7)


@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(RES / 2, 4 - RES / 2))
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


@given(st.integers(0, 10_000), st.sampled_from([0.01, 0.5, 0.99]))
def test_distances_are_those_of_scipy(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    occupied = rng.random(rng.integers(2, 15, 3)) < share
    occupied[0, 0, 0], occupied[1, 1, 1] = True, False
    expected = distance_transform_edt(~occupied) - distance_transform_edt(occupied)
    expected = RES * (expected - np.sign(expected) / 2)
    field = distance_field(Occupancy(occupied.astype(np.float32), np.zeros(3), RES))
    np.testing.assert_allclose(field.grid.distance_m, expected, rtol=1e-6)


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
    t_ns, one = np.arange(10, dtype=np.int64), slab()
    first, second = (distance_field(Occupancy(one.probability, np.zeros(3), RES, from_ns=n)) for n in (3, 6))
    before, *after = in_turn([first, second], t_ns)
    assert not before[1].has_obstacles
    assert after == [(slice(3, 6), first), (slice(6, 10), second)]
    assert [rows for rows, _ in in_turn([first, second], t_ns[4:])] == [slice(0, 2), slice(2, 6)]


RATES = np.array([np.radians(22.5), np.radians(5.0), 1.0])


@pytest.mark.parametrize(("drones", "apart_deg"), [(1, 0), (2, 90), (3, 120), (4, 90), (5, 72)])
def test_slots_are_evenly_spaced_but_for_two(drones: int, apart_deg: float) -> None:
    slots = formation_slots(np.array([0.3, 1.0]), drones, tilt_rad=0.25, range_m=10.0)
    assert slots.shape == (2, drones, 3)
    assert np.degrees(np.diff(slots[..., 0], axis=1)) == pytest.approx(np.full((2, drones - 1), apart_deg))
    offsets = slot_offsets(slots)
    assert np.linalg.norm(offsets, axis=-1) == pytest.approx(np.full((2, drones), 10.0))
    assert offsets[..., 2] == pytest.approx(np.full((2, drones), 10 * np.sin(0.25)))
