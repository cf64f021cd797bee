"""A walking person in a ring of cameras, with exact image points, and functions that add errors."""

from dataclasses import replace

import numpy as np

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.triangulation import Views
from tests.synthetic.walk import walk

FOCAL = 1500.0
LEVELS = {"a": (0.1, 0.5), "b": (0.3, 1.0), "c": (0.5, 2.0)}  # m, deg per axis: METHODS 1.3


def ring(frames: int, cameras: int) -> tuple[Float, Views]:
    """Make the walk of the peers' table: 17 joints, a slowly turning 10 m ring at 15 deg, exact points."""
    t_s = np.arange(frames) / 30
    joints = walk(t_s, radius_m=15.0)
    actor = joints.mean(axis=1)
    spacing = 2 * np.pi / cameras if cameras > 2 else np.pi / 2
    yaw = spacing * np.arange(cameras) + 0.02 * t_s[:, None]
    tilt = np.radians(15)
    away = np.stack(
        [np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), np.full_like(yaw, np.sin(tilt))], axis=-1
    )
    position = actor[:, None] + 10 * away
    right = np.stack([-np.sin(yaw), np.cos(yaw), np.zeros_like(yaw)], axis=-1)
    rotation = np.stack([right, np.cross(-away, right), -away], axis=-1)
    n = frames * joints.shape[1]
    views = Views(
        rays=project(joints, position, rotation).reshape(n, cameras, 2),
        weight=np.ones((n, cameras)),
        pose_index=np.repeat(np.arange(frames), joints.shape[1]),
        position=position,
        rotation=rotation,
        focal=np.full(cameras, FOCAL),
        pixel_sigma=np.full(cameras, 2.0),
        pose_sigma=np.zeros((frames, cameras, 2)),
    )
    return joints.reshape(n, 3), views


def project(joints: Float, position: Float, rotation: Float) -> Float:
    """Project points [F, J, 3] to [F, J, C, 2]."""
    seen = np.einsum("fcij,fkci->fkcj", rotation, joints[:, :, None] - position[:, None])
    xy: Float = seen[..., :2] / seen[..., 2:]
    return xy


def turned(rotation: Float, vector: Float) -> Float:
    """Multiply the rotation by that of a rotation vector in the camera's frame (Rodrigues)."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector, -1, 0)
    o = np.zeros_like(x)
    K = np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*vector.shape[:-1], 3, 3)
    result: Float = rotation @ (
        np.eye(3) + np.sinc(angle / np.pi) * K + (1 - np.cos(angle)) / angle**2 * K @ K
    )
    return result


def with_pixel_noise(views: Views, rng: np.random.Generator, sigma_px: float = 2.0) -> Views:
    return replace(views, rays=views.rays + rng.normal(0, sigma_px / FOCAL, views.rays.shape))


def with_pose_noise(
    views: Views, rng: np.random.Generator, level: str, *, constant: bool, stated: bool
) -> Views:
    position_m, rotation_deg = LEVELS[level]
    rotation_rad = np.radians(rotation_deg)
    frames, cameras, _ = views.position.shape
    draws = rng.standard_normal((1 if constant else frames, cameras, 6))
    sigma = np.broadcast_to([position_m, rotation_rad], (frames, cameras, 2)) if stated else views.pose_sigma
    return replace(
        views,
        position=views.position + position_m * draws[..., :3],
        rotation=turned(views.rotation, rotation_rad * draws[..., 3:]),
        pose_sigma=sigma,
    )


def with_outliers(views: Views, rng: np.random.Generator, *, uniform: bool) -> tuple[Views, Bool]:
    """Add 5 % gross outliers and 5 % missing views; return also which views are good."""
    n, cameras = views.weight.shape
    bad = rng.random((n, cameras)) < 0.05
    missing = rng.random((n, cameras)) < 0.05
    offset = rng.uniform(100, 300, (n, cameras, 2)) * rng.choice([-1, 1], (n, cameras, 2)) / FOCAL
    anywhere = rng.uniform([-960, -540], [960, 540], (n, cameras, 2)) / FOCAL
    xy = np.where(bad[..., None], anywhere if uniform else views.rays + offset, views.rays)
    xy[missing] = np.nan
    return replace(views, rays=xy), ~bad & ~missing
