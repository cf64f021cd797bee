"""Slots, their approach, and the view of the cameras."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.geometry.poses import look_at, matrix_from_quaternion
from pipelines.planning.formation import (
    FormationPath,
    formation_slots,
    slot_of,
    slot_offsets,
    wrapped,
    yaw_set,
)

RATES = np.array([np.radians(22.5), np.radians(5.0), 1.0])


@pytest.mark.parametrize(("drones", "apart_deg"), [(1, 0), (2, 90), (3, 120), (4, 90), (5, 72)])
def test_slots_are_evenly_spaced_but_for_two(drones: int, apart_deg: float) -> None:
    slots = formation_slots(np.array([0.3, 1.0]), drones, tilt_rad=0.25, range_m=10.0)
    assert slots.shape == (2, drones, 3)
    assert np.degrees(np.diff(slots[..., 0], axis=1)) == pytest.approx(np.full((2, drones - 1), apart_deg))
    offsets = slot_offsets(slots)
    assert np.linalg.norm(offsets, axis=-1) == pytest.approx(np.full((2, drones), 10.0))
    assert offsets[..., 2] == pytest.approx(np.full((2, drones), 10 * np.sin(0.25)))


@given(st.floats(-3.14, 3.14), st.floats(-1.5, 1.5), st.floats(0.1, 100))
def test_a_slot_is_found_again_from_its_offset(yaw: float, tilt: float, distance: float) -> None:
    slot = np.array([yaw, tilt, distance])
    assert slot_of(slot_offsets(slot)) == pytest.approx(slot, abs=1e-9)


@given(st.integers(1, 72), st.floats(-10, 10))
def test_yaws_are_equidistant_and_hold_the_start(yaws: int, start: float) -> None:
    cells = yaw_set(yaws, start)
    assert (cells >= -np.pi).all()
    assert (cells < np.pi).all()
    assert np.abs(wrapped(cells - start)).min() < 1e-9
    gaps = np.diff(np.append(cells, cells[0] + 2 * np.pi))
    assert gaps == pytest.approx(np.full(yaws, 2 * np.pi / yaws))


def test_knots_are_approached_at_the_full_rate_and_then_waited_for() -> None:
    slots = np.array([[[0.0, 0.2, 10.0]], [[np.radians(20), 0.2, 9.0]], [[np.radians(65), 0.2, 9.0]]])
    path = FormationPath(np.array([5.0, 7.0, 9.0]), slots, RATES)
    found = path.at(np.array([4.0, 5.0, 5.4, 6.5, 8.0, 9.0, 20.0]))[:, 0]
    assert np.degrees(found[:, 0]) == pytest.approx([0, 0, 9, 20, 42.5, 65, 65])
    assert found[:, 2] == pytest.approx([10, 10, 9.6, 9, 9, 9, 9])


def test_cameras_look_at_the_target_and_stand_upright() -> None:
    rng = np.random.default_rng(1)
    camera, target = rng.normal(size=(50, 3)) * 10, rng.normal(size=(50, 3))
    right, down, forward = np.moveaxis(matrix_from_quaternion(look_at(camera, target)), -1, 0)
    towards = (target - camera) / np.linalg.norm(target - camera, axis=-1, keepdims=True)
    assert forward == pytest.approx(towards, abs=1e-12)
    assert right[:, 2] == pytest.approx(np.zeros(50), abs=1e-12)
    assert (down[:, 2] < 0).all()
