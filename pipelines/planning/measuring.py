"""Simulated measurements of a skeleton by cameras on given paths: seen, detected, logged, triangulated.

The visibility of joints is exact, by field of view and map. The errors of the detector and of the logged
poses are random, with the same seeds for every arm of a comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Float32, Int64
from pipelines.geometry.cameras import Intrinsics, project, undistort
from pipelines.geometry.noise import NoiseModel, disturb, sum_sigma
from pipelines.geometry.poses import invert, matrix_from_quaternion, rates, transform
from pipelines.geometry.triangulation import Views, locate
from pipelines.planning.distance_field import DistanceField, visible

PIXEL_SIGMA = 3.0
"""Standard deviation of a good keypoint for triangulation, px: the first value in `mocap reconstruct`."""
MIN_CONFIDENCE = 0.3
"""Least confidence of keypoints that are used, as in `mocap reconstruct`."""


class Detect(Protocol):
    """Function that simulates a keypoint detector on one camera's pictures."""

    def __call__(
        self,
        pixels: Float,
        free: Bool,
        camera: Float,
        target: Float,
        focal_px: float,
        rng: np.random.Generator,
    ) -> tuple[Float, Float]:
        """Return keypoints [T, J, 2] px (NaN: missed) and confidences [T, J].

        Args:
            pixels: [T, J, 2] exact, NaN outside the picture.
            free: [T, J] True where nothing hides the joint.
            camera: [T, 3] m, world.
            target: [T, 3] m, world, the person's middle.
            focal_px: of the camera.
            rng: draws as many numbers for any visibility.
        """


@dataclass(frozen=True)
class CameraPaths:
    """Cameras N on their paths at the times T of their pictures, and the filmed person."""

    t_ns: Int64  # [T]
    position: Float  # [N, T, 3] m, world
    quaternion_xyzw: Float  # [N, T, 4] world_from_camera
    known: Bool  # [N, T] True where the camera has a pose; other pictures are not used
    intrinsics: Sequence[Intrinsics]
    noise: Sequence[Sequence[NoiseModel]]
    joints: Float  # [T, J, 3] m, world; NaN where unknown
    middle: Float  # [T, 3] m, world, of the person


@dataclass(frozen=True)
class Measured:
    """Result of the simulated measurements."""

    error_m: Float32  # [trials, T, J]; NaN where the joint was not measured or the truth is unknown
    first: Float  # [T, J, 3] the measured joints of the first trial
    seen_share: float  # of known joints and cameras: in the picture and not hidden
    joint_frames: int  # with a truth
    pixels: Float  # [N, T, J, 2] px of the joints in the pictures; NaN outside, or where unknown
    free: Bool  # [N, T, J] True where nothing stands between camera and joint


def measure(
    paths: CameraPaths, field: DistanceField, detect: Detect, *, start_m: float, trials: int, seed: int
) -> Measured:
    """Measure a skeleton in several trials.

    Args:
        paths: cameras and person.
        field: the distance field of the obstacles.
        detect: the detector.
        start_m: the end of sight lines next to the joint that is left out: maps contain the person.
        trials: independent draws of all noise.
        seed: of the random numbers. Trial k of camera i has the same numbers for any other path.
    """
    joints = paths.joints
    cameras, times, count = len(paths.position), *joints.shape[:2]
    pixels = np.stack([_pixels(paths, i) for i in range(cameras)])
    known = np.isfinite(joints[..., 0])
    standing_in = np.where(known[..., None], joints, paths.middle[:, None])
    free = visible(field, paths.position[:, :, None], standing_in, start_m=start_m)
    sigma = np.stack([_pose_sigma(paths, i) for i in range(cameras)], axis=1)
    error = np.full((trials, times, count), np.nan, dtype=np.float32)
    first = np.full(joints.shape, np.nan)
    for trial in range(trials):
        rays = np.empty((times, count, cameras, 2))
        weight = np.empty((times, count, cameras))
        logged_position, logged_rotation = np.empty((times, cameras, 3)), np.empty((times, cameras, 3, 3))
        for i, lens in enumerate(paths.intrinsics):
            rng = np.random.default_rng([seed, trial, i])
            path = paths.position[i]
            logged_position[:, i], turned = disturb(
                paths.noise[i], paths.t_ns, path, paths.quaternion_xyzw[i], rng
            )
            logged_rotation[:, i] = matrix_from_quaternion(turned)
            xy, confidence = detect(pixels[i], free[i], path, paths.middle, _focal(lens), rng)
            rays[:, :, i] = undistort(xy, lens)
            weight[:, :, i] = np.where(confidence >= MIN_CONFIDENCE, confidence, 0.0)
        views = Views(
            xy=rays.reshape(-1, cameras, 2),
            weight=weight.reshape(-1, cameras),
            pose_index=np.repeat(np.arange(times), count),
            position=logged_position,
            rotation=logged_rotation,
            focal=np.array([_focal(lens) for lens in paths.intrinsics]),
            pixel_sigma=np.full(cameras, PIXEL_SIGMA),
            pose_sigma=sigma,
        )
        points = locate(views, method="robust").points.reshape(joints.shape)
        points[~known] = np.nan
        error[trial] = np.sqrt(np.sum((points - joints) ** 2, axis=-1))
        if trial == 0:
            first = points
    seen = np.isfinite(pixels[..., 0]) & free
    total = cameras * int(known.sum())
    seen_share = float((seen & known).sum() / total) if total else 0.0
    return Measured(error, first, seen_share, int(known.sum()), pixels, free)


def _pixels(paths: CameraPaths, i: int) -> Float:
    """Compute the exact pixels [T, J, 2] of one camera; NaN outside its picture and where it has no pose."""
    lens = paths.intrinsics[i]
    camera_from_world = invert(paths.position[i, :, None], paths.quaternion_xyzw[i, :, None])
    pixels = project(transform(camera_from_world, paths.joints), lens)
    inside = (pixels >= -0.5) & (pixels <= np.array([lens.width, lens.height]) - 0.5)
    return np.where(inside.all(axis=-1, keepdims=True) & paths.known[i, :, None, None], pixels, np.nan)


def _pose_sigma(paths: CameraPaths, i: int) -> Float:
    """Compute the sigmas [T, 2] per axis (m, rad) of one camera's poses for triangulation."""
    path, turned = paths.position[i], paths.quaternion_xyzw[i]
    elapsed_s = (paths.t_ns - paths.t_ns[0]) / 1e9
    return sum_sigma(paths.noise[i], elapsed_s, *rates(paths.t_ns, path, turned))


def _focal(lens: Intrinsics) -> float:
    return (lens.fx + lens.fy) / 2
