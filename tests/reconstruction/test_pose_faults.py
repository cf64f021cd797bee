"""Faults of one camera's poses: what is fitted to exact rays is the fault that was made."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import look_at, matrix_from_quaternion
from pipelines.reconstruction.doubts.alternatives import NUMBERS, changed
from pipelines.reconstruction.doubts.scene import (
    JOINTS,
    MOMENTS,
    STATURE_M,
    SceneOfMoments,
    stature_m,
)
from pipelines.reconstruction.doubts.score import fit, solve

SIGMA = np.array([0.1, np.radians(0.5), 0.02, np.radians(0.1), 0.02, np.radians(0.1)])


def people() -> Float:
    """Return joints [T, J, 3] of somebody of usual stature who wanders about."""
    draw = np.random.default_rng(1)
    joints = np.tile(draw.normal(scale=[0.3, 0.3, 0.6], size=(1, len(JOINTS), 3)), (MOMENTS, 1, 1))
    joints = joints * STATURE_M / stature_m(joints) + [0, 0, 1]
    along = np.linspace(-2, 2, MOMENTS)
    return joints + np.stack([along, 0.5 * np.sin(along), 0 * along], axis=1)[:, None]


def scene(cameras: int) -> SceneOfMoments:
    """Look at them from drones that hover 9 m away."""
    joints = people()
    yaw = np.radians(20 + 110.0 * np.arange(cameras))
    place = np.stack([9 * np.cos(yaw), 9 * np.sin(yaw), np.full(cameras, 4.0)], axis=1)
    position = np.repeat(place[:, None], MOMENTS, axis=1)
    towards = np.broadcast_to(joints.mean(axis=1), position.shape)
    rotation = matrix_from_quaternion(look_at(position, towards))
    local = np.einsum("ctji,ctkj->ctki", rotation, joints[None] - position[:, :, None])
    t_ns = 100_000_000 * np.arange(MOMENTS)
    return SceneOfMoments(
        t_ns=t_ns,
        first=np.arange(MOMENTS)[::2],
        second=np.arange(MOMENTS)[1::2],
        hips=None,
        ground=None,
        rays=local[..., :2] / local[..., 2:],
        position=position,
        rotation=rotation,
        focal_px=np.full(cameras, 760.0),
        sigma=np.repeat(SIGMA[None], cameras, axis=0),
        person_px=np.full(cameras, 140.0),
        unposed=np.zeros(cameras),
        stated_ns=np.tile(t_ns, (cameras, 1)),
    )


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
    right, turn = scene(3), np.radians([turn_deg])
    # The wrong log is the one from which the numbers lead back to the right one.
    moved = changed(right, "shift", [1], -np.array(shift)) if any(shift) else right
    wrong = moved if name == "shift" else changed(moved, {"zero": "north"}.get(name, name), [1], -turn)
    number = np.array([*shift, *turn])[4 - NUMBERS[name] :] if NUMBERS[name] != 3 else np.array(shift)
    found = fit(lambda numbers: changed(wrong, name, [1], numbers), np.zeros(NUMBERS[name]))
    # Exact rays leave no cost, up to the iterations' end (a change of the cost by 0.05).
    assert found.cost < 0.1
    np.testing.assert_allclose(found.numbers, number, atol=0.05 if any(shift) else np.radians(0.2))


def test_a_right_scene_costs_nothing_and_a_wrong_one_does() -> None:
    right = scene(3)
    assert fit(lambda _: right).cost < 0.1
    wrong = changed(right, "heading", [0], np.radians([8]))
    # 8 deg are 16 standard deviations of the error that is stated.
    turned = fit(lambda numbers: changed(wrong, "heading", [0], numbers), np.zeros(1))
    assert fit(lambda _: wrong).cost - turned.cost > 16


def test_joints_are_where_exact_rays_meet() -> None:
    exact = scene(3)
    rays = exact.rays.copy()
    rays[1:, 0, 0] = np.nan  # one view
    solved = solve(replace(exact, rays=rays))
    joints, chi2, views, in_front = solved.joints, solved.chi2, solved.views, solved.in_front
    assert np.isnan(joints[0, 0]).all()
    assert views[0, 0] == 1
    np.testing.assert_allclose(joints[1:], people()[1:], atol=1e-6)
    assert chi2[1:].max() < 1e-12
    assert in_front[1:].all()
