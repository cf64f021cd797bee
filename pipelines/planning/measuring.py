"""What cameras on given paths would have measured of a skeleton: seen, detected, logged, triangulated.

Simulated: which joints are visible is exact, by field of view and map; what a detector makes of them and
what the log makes of the poses is drawn, from the same seeds for every arm of a comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.cameras import Intrinsics, project, undistort
from pipelines.geometry.noise import NoiseModel, disturb, sum_sigma
from pipelines.geometry.poses import invert, matrix_from_quaternion, rates, transform
from pipelines.geometry.triangulation import Views, locate
from pipelines.planning.distance_field import DistanceField
from pipelines.planning.sight import visible

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

PIXEL_SIGMA = 3.0
"""Standard deviation of a good keypoint that triangulation is told: what `mocap reconstruct` begins with."""
MIN_CONFIDENCE = 0.3
"""Keypoints below are not used, likewise."""


class Detect(Protocol):
    """What a keypoint detector makes of one camera's pictures."""

    def __call__(
        self,
        pixels: Float,
        free: Bool,
        camera: Float,
        target: Float,
        focal_px: float,
        rng: np.random.Generator,
    ) -> tuple[Float, Float]:
        """Keypoints [T, J, 2] px (NaN: missed) and confidences [T, J].

        Args:
            pixels: [T, J, 2] exact, NaN outside the picture.
            free: [T, J] nothing hides the joint.
            camera: [T, 3] m, world.
            target: [T, 3] m, world, the person's middle.
            focal_px: of the camera.
            rng: draws as many numbers whatever is seen.
        """


@dataclass(frozen=True)
class Filming:
    """Cameras N on their paths at the times T of their pictures, and who they film."""

    t_ns: Int64  # [T]
    position: Float  # [N, T, 3] m, world
    quaternion_xyzw: Float  # [N, T, 4] world_from_camera
    known: Bool  # [N, T] whether the camera has a pose then; without one its picture is of no use
    intrinsics: Sequence[Intrinsics]
    noise: Sequence[Sequence[NoiseModel]]
    joints: Float  # [T, J, 3] m, world; NaN where nobody knows
    middle: Float  # [T, 3] m, world, of the person


@dataclass(frozen=True)
class Measured:
    """What was made of it."""

    error_m: Float32  # [trials, T, J]; NaN where the joint was not measured or nobody knows the truth
    first: Float  # [T, J, 3] the measured joints of the first trial
    seen_share: float  # of known joints and cameras: in the picture and not hidden
    joint_frames: int  # with a truth
    pixels: Float  # [N, T, J, 2] where the joints are in the pictures; NaN outside, or where nobody knows
    free: Bool  # [N, T, J] nothing stands between camera and joint


def film(
    filming: Filming, field: DistanceField, detect: Detect, *, start_m: float, trials: int, seed: int
) -> Measured:
    """Measure a skeleton, several times over.

    Args:
        filming: cameras and person.
        field: what stands in the way.
        detect: the detector.
        start_m: the end of sight lines next to the joint that is left out: maps contain the person.
        trials: independent draws of all noise.
        seed: where they come from. Trial k of camera i has the same numbers for any other path.
    """
    joints = filming.joints
    cameras, times, count = len(filming.position), *joints.shape[:2]
    pixels = np.stack([_pixels(filming, i) for i in range(cameras)])
    known = np.isfinite(joints[..., 0])
    standing_in = np.where(known[..., None], joints, filming.middle[:, None])
    free = visible(field, filming.position[:, :, None], standing_in, start_m=start_m)
    sigma = np.stack([_pose_sigma(filming, i) for i in range(cameras)], axis=1)
    error = np.full((trials, times, count), np.nan, dtype=np.float32)
    first = np.full(joints.shape, np.nan)
    for trial in range(trials):
        rays = np.empty((times, count, cameras, 2))
        weight = np.empty((times, count, cameras))
        logged_position, logged_rotation = np.empty((times, cameras, 3)), np.empty((times, cameras, 3, 3))
        for i, lens in enumerate(filming.intrinsics):
            rng = np.random.default_rng([seed, trial, i])
            path = filming.position[i]
            logged_position[:, i], turned = disturb(
                filming.noise[i], filming.t_ns, path, filming.quaternion_xyzw[i], rng
            )
            logged_rotation[:, i] = matrix_from_quaternion(turned)
            xy, confidence = detect(pixels[i], free[i], path, filming.middle, _focal(lens), rng)
            rays[:, :, i] = undistort(xy, lens)
            weight[:, :, i] = np.where(confidence >= MIN_CONFIDENCE, confidence, 0.0)
        views = Views(
            xy=rays.reshape(-1, cameras, 2),
            weight=weight.reshape(-1, cameras),
            pose_index=np.repeat(np.arange(times), count),
            position=logged_position,
            rotation=logged_rotation,
            focal=np.array([_focal(lens) for lens in filming.intrinsics]),
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


def _pixels(filming: Filming, i: int) -> Float:
    """Exact pixels [T, J, 2] of one camera; NaN outside its picture and where it has no pose."""
    lens = filming.intrinsics[i]
    camera_from_world = invert(filming.position[i, :, None], filming.quaternion_xyzw[i, :, None])
    pixels = project(transform(camera_from_world, filming.joints), lens)
    inside = (pixels >= -0.5) & (pixels <= np.array([lens.width, lens.height]) - 0.5)
    return np.where(inside.all(axis=-1, keepdims=True) & filming.known[i, :, None, None], pixels, np.nan)


def _pose_sigma(filming: Filming, i: int) -> Float:
    """[T, 2] per axis (m, rad), what triangulation is told of one camera's poses."""
    path, turned = filming.position[i], filming.quaternion_xyzw[i]
    elapsed_s = (filming.t_ns - filming.t_ns[0]) / 1e9
    return sum_sigma(filming.noise[i], elapsed_s, *rates(filming.t_ns, path, turned))


def _focal(lens: Intrinsics) -> float:
    return (lens.fx + lens.fy) / 2
