"""Faults of one camera's poses: what is fitted to exact rays is the fault that was made."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import look_at, matrix_from_quaternion
from pipelines.reconstruction.doubts.diagnosis import GAIN
from pipelines.reconstruction.doubts.faults import fit, undone
from pipelines.reconstruction.doubts.scene import JOINTS, MOMENTS, Sampled, Scene
from pipelines.reconstruction.doubts.score import STATURE_M, stature_m

WITHOUT_ACTOR = cast(Sampled, type("", (), {"hips": None})())
SIGMA = np.array([0.1, np.radians(0.5), 0.02, np.radians(0.1), 0.02, np.radians(0.1)])


def people() -> Float:
    """Return joints [T, J, 3] of somebody of usual stature who wanders about."""
    draw = np.random.default_rng(1)
    joints = np.tile(draw.normal(scale=[0.3, 0.3, 0.6], size=(1, len(JOINTS), 3)), (MOMENTS, 1, 1))
    joints = joints * STATURE_M / stature_m(joints) + [0, 0, 1]
    along = np.linspace(-2, 2, MOMENTS)
    return joints + np.stack([along, 0.5 * np.sin(along), 0 * along], axis=1)[:, None]


def scene(cameras: int) -> Scene:
    """Look at them from drones that hover 9 m away."""
    joints = people()
    yaw = np.radians(20 + 110.0 * np.arange(cameras))
    place = np.stack([9 * np.cos(yaw), 9 * np.sin(yaw), np.full(cameras, 4.0)], axis=1)
    position = np.repeat(place[:, None], MOMENTS, axis=1)
    towards = np.broadcast_to(joints.mean(axis=1), position.shape)
    rotation = matrix_from_quaternion(look_at(position, towards))
    local = np.einsum("ctji,ctkj->ctki", rotation, joints[None] - position[:, :, None])
    rays = local[..., :2] / local[..., 2:]
    sigma = np.repeat(SIGMA[None], cameras, axis=0)
    return Scene(rays, position, rotation, np.full(cameras, 760.0), sigma, np.full(cameras, 140.0))


@pytest.mark.parametrize(
    ("name", "shift", "turn_deg"),
    [
        ("shift", [2.4, -1.8, 0.3], 0),
        ("heading", [0, 0, 0], 8),
        ("north", [0, 0, 0], -20),
        ("zero", [-1.0, 2.0, 0.0], 15),
        ("pitch", [0, 0, 0], -6),
        ("roll", [0, 0, 0], 10),
    ],
)
def test_a_fault_is_found_exactly(name: str, shift: list[float], turn_deg: float) -> None:
    right = scene(3)
    # The wrong log is the one from which undoing the fault leads back to the right one.
    turn = np.radians(turn_deg)
    unturned = undone(right, name, 1, np.zeros(3), -turn)
    back = np.zeros(3)
    if any(shift):
        moved = undone(right, "shift", 1, -np.array(shift), 0.0)
        unturned = undone(moved, name, 1, back, -turn)
    found = fit(WITHOUT_ACTOR, unturned, name, 1)
    # Exact rays leave no cost, up to the iterations' end (a change of the cost by 0.05).
    assert found.cost < 0.1
    assert found.turn_deg == pytest.approx(turn_deg, abs=0.2)
    np.testing.assert_allclose(found.shift, shift, atol=0.05)


def test_a_right_scene_costs_nothing_and_a_wrong_one_does() -> None:
    right = scene(3)
    assert fit(WITHOUT_ACTOR, right, "none", 0).cost < 0.1
    wrong: Any = undone(right, "heading", 0, np.zeros(3), np.radians(8))
    # 8 deg are 16 standard deviations of the error that is stated.
    assert fit(WITHOUT_ACTOR, wrong, "none", 0).cost - fit(WITHOUT_ACTOR, wrong, "heading", 0).cost > GAIN
