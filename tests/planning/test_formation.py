"""Slots, their approach, and the view of the cameras."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.planning.formation import (
    FormationPath,
    formation_slots,
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
