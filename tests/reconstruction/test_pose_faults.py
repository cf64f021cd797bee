"""Faults of one camera's poses: what is fitted to exact rays is the fault that was made."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import look_at, matrix_from_quaternion
from pipelines.reconstruction.doubts.diagnosis import GAIN
from pipelines.reconstruction.doubts.faults import fit, undone
from pipelines.reconstruction.doubts.kernels import joints_of, normal_equations
from pipelines.reconstruction.doubts.scene import JOINTS, MOMENTS, Sampled, SceneOfMoments
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


def scene(cameras: int) -> SceneOfMoments:
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
    return SceneOfMoments(rays, position, rotation, np.full(cameras, 760.0), sigma, np.full(cameras, 140.0))


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


def test_joints_are_where_exact_rays_meet() -> None:
    exact = scene(3)
    rays = exact.rays.copy()
    rays[1:, 0, 0] = np.nan  # one view
    angle2, place2 = np.full(3, 1e-4), np.full(3, 1e-2)
    joints, chi2, views, in_front, *_ = joints_of(rays, exact.rotation, exact.position, angle2, place2)
    assert np.isnan(joints[0, 0]).all()
    assert views[0, 0] == 1
    np.testing.assert_allclose(joints[1:], people()[1:], atol=1e-9)
    assert chi2[1:].max() < 1e-12
    assert in_front[1:].all()


@pytest.mark.parametrize("name", ["north", "focal"])
def test_normal_equations_are_those_of_the_rays(name: str) -> None:
    """Compare with numerical derivatives of (X - p) / depth - ray; a dense inverse eliminates the joints."""
    draw = np.random.default_rng(2)
    cameras, times, count, step = 2, 2, 3, 1e-6
    exact = scene(cameras)
    joints = people()[:times, :count] + draw.normal(scale=0.05, size=(times, count, 3))
    position = exact.position[:, :times]
    local = np.concatenate([exact.rays[:, :times, :count], np.ones((cameras, times, count, 1))], axis=-1)
    ray = np.einsum("ctij,ctkj->ctki", exact.rotation[:, :times], local)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    weight = draw.uniform(1, 2, size=(cameras, times, count))
    axis = exact.rotation[1, :times, :, 2]
    basis = np.zeros((times, 6, 1))
    basis[:, 0, 0], basis[:, 1, 0], basis[:, 5, 0] = -position[1, :, 1], position[1, :, 0], 1.0

    def missed(unknown: Float) -> Float:
        errors, number = unknown[: 6 * cameras].reshape(cameras, 6), unknown[6 * cameras]
        moved = joints + unknown[6 * cameras + 1 :].reshape(joints.shape)
        turned = ray.copy()
        if name == "focal":  # the ray's part across the axis shrinks as the focal length grows
            along = (ray[1] * axis[:, None]).sum(axis=-1, keepdims=True)
            longer = ray[1] + number * along * (axis[:, None] - along * ray[1])
            turned[1] = longer
        changes = np.repeat(errors[:, None], times, axis=1)
        if name == "north":
            changes[1] += number * basis[..., 0]
        turned = turned + np.cross(changes[:, :, None, 3:], ray)
        from_camera = moved[None] - (position + changes[..., :3])[:, :, None]
        depth = (from_camera * turned).sum(axis=-1, keepdims=True) / (turned**2).sum(axis=-1, keepdims=True)
        found: Float = from_camera / depth - turned
        return found

    size = 6 * cameras + 1
    start = np.zeros(size + joints.size)
    root = np.sqrt(weight)[..., None]
    design = np.stack(
        [
            (root * (missed(start + step * unit) - missed(start - step * unit))).ravel() / (2 * step)
            for unit in np.eye(start.size)
        ],
        axis=1,
    )
    normal, at = design.T @ design, design.T @ (root * missed(start)).ravel()
    eliminated = normal[:size, size:] @ np.linalg.inv(normal[size:, size:])
    expected = normal[:size, :size] - eliminated @ normal[size:, :size]
    found, right = normal_equations(
        ray,
        missed(start),
        ((joints[None] - position[:, :, None]) * ray).sum(axis=-1),
        weight,
        np.zeros((times, count)),
        np.zeros((times, count, 3)),
        1,
        basis,
        axis if name == "focal" else np.zeros((0, 3)),
    )
    scale = np.abs(normal[:size, :size]).max()
    np.testing.assert_allclose(found, expected, atol=1e-6 * scale)
    np.testing.assert_allclose(right, at[:size] - eliminated @ at[size:], atol=1e-6 * np.abs(at).max())


def test_the_way_of_the_logged_actor_tells_whose_north_is_wrong() -> None:
    right, turn = scene(2), np.radians(20)
    hips = people()[:, [JOINTS.index("left_hip"), JOINTS.index("right_hip")]]
    flight = cast(Sampled, type("", (), {"hips": hips.mean(axis=1)})())
    wrong = undone(right, "north", 0, np.zeros(3), -turn)
    first, second = (fit(flight, wrong, "north", index, start) for index, start in ((0, turn), (1, -turn)))
    # The other's north turns the way about zero: three of its places, of 0.3 m each, are as many metres off.
    off = 2 * np.sin(turn / 2) * np.linalg.norm(hips.mean(axis=1)[:, :2], axis=1)
    assert second.cost - first.cost > 0.5 * 3 * float((off**2).mean()) / 0.3**2
