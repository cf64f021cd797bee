"""The cost map by hand, and the information of cameras by the ray model."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.planning.config import ErrorModel, PlannerConfig, PlannerTuning
from pipelines.planning.distance_field import distance_field
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


def test_error_of_two_cameras_as_in_closed_form() -> None:
    """Tr S = s^2 (1/2 + 2/sin^2 gamma) for equal cameras whose rays cross at gamma."""
    errors = ErrorModel(rotation_sigma_deg=0.8)
    offset = np.array([[10.0, 0.0, 0.0], [0.0, 10.0, 0.0]])
    for gamma in np.radians([30.0, 60.0, 90.0, 150.0]):
        offset[1] = 10 * np.array([np.cos(gamma), np.sin(gamma), 0.0])
        keypoint_m, placed = (
            np.interp(0.0, errors.tilts_deg, values)
            for values in (errors.keypoint_sigma_m, errors.placed_share)
        )
        s2 = keypoint_m**2 + (10 * np.radians(0.8)) ** 2 + errors.position_sigma_m**2
        error = predicted_error(ray_information(offset, errors).sum(axis=0))
        assert error**2 == pytest.approx(s2 / placed * (0.5 + 2 / np.sin(gamma) ** 2), rel=1e-9)


@given(st.integers(0, 10_000))
def test_closed_forms_equal_linear_algebra(seed: int) -> None:
    rng = np.random.default_rng(seed)
    information = ray_information(rng.uniform(2, 12, (3, 3)), CONFIG.tuning.errors).sum(axis=0) + np.eye(3)
    assert predicted_error(information) ** 2 == pytest.approx(np.trace(np.linalg.inv(information)))
    assert log_determinant(information) == pytest.approx(np.linalg.slogdet(information)[1])
