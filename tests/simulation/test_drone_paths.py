"""Formations: the places of the cameras, and the person in their pictures."""

import numpy as np
import pytest

from pipelines.geometry.poses import matrix_from_quaternion
from pipelines.simulation.flying import orbit

T_S = np.linspace(0, 20, 41)
TARGET = np.stack([1.2 * T_S, 3.0 + 0 * T_S, 1.0 + 0 * T_S], axis=1)


@pytest.mark.parametrize(("cameras", "apart_deg"), [(1, None), (2, 90.0), (3, 120.0), (5, 72.0)])
def test_slots_of_the_formation(cameras: int, apart_deg: float | None) -> None:
    position, _ = orbit(T_S, TARGET, cameras=cameras, range_m=8.0, tilt_deg=20.0, yaw_deg=10.0)
    from_target = position - TARGET
    assert position.shape == (cameras, len(T_S), 3)
    assert np.linalg.norm(from_target, axis=-1) == pytest.approx(8.0)
    assert from_target[..., 2] == pytest.approx(8.0 * np.sin(np.radians(20.0)))
    yaw = np.unwrap(np.arctan2(from_target[..., 1], from_target[..., 0]))
    assert np.degrees(yaw[0]) == pytest.approx(10.0 + 4.0 * T_S)
    if apart_deg is not None:
        assert np.degrees(yaw[1] - yaw[0]) % 360 == pytest.approx(apart_deg)


def test_cameras_look_at_the_target_and_stand_upright() -> None:
    position, quaternion = orbit(T_S, TARGET, cameras=3, variation=1.0)
    right, down, forward = np.moveaxis(matrix_from_quaternion(quaternion), -1, 0)
    towards = (TARGET - position) / np.linalg.norm(TARGET - position, axis=-1, keepdims=True)
    assert forward == pytest.approx(towards, abs=1e-12)
    assert right[..., 2] == pytest.approx(0.0, abs=1e-12)
    assert (down[..., 2] < 0).all()
    assert np.linalg.norm(quaternion, axis=-1) == pytest.approx(1.0)
