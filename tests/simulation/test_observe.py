"""Simulated instruments: exact without noise, and with it as noisy as they say."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipelines.geometry.cameras import camera_matrix
from pipelines.geometry.poses import invert, look_at, rotation_vector_from_quaternion
from pipelines.simulation.detector_errors import see
from pipelines.simulation.flying import orbit
from tests.synthetic.flights import LENS
from tests.synthetic.keypoints import KeypointNoise, detect
from tests.synthetic.walk import walk

T_S = np.linspace(0, 5, 7)
TARGET = np.stack([1.2 * T_S, 0 * T_S, 1.0 + 0 * T_S], axis=1)


def test_pixels_agree_with_opencv() -> None:
    joints = walk(T_S)
    position, quaternion = orbit(T_S, TARGET, cameras=2)
    pixels = see(joints, position[1], quaternion[1], LENS)
    for k in range(len(T_S)):
        translation, rotation = invert(position[1, k], quaternion[1, k])
        expected, _ = cv2.projectPoints(
            joints[k],
            rotation_vector_from_quaternion(rotation),
            translation,
            camera_matrix(LENS),
            np.array(LENS.distortion),
        )
        assert pixels[k] == pytest.approx(expected[:, 0], abs=1e-6)


def test_nothing_is_seen_behind_the_camera_or_beside_the_picture() -> None:
    quaternion = look_at(np.zeros((1, 3)), np.array([[5.0, 0.0, 0.0]]))
    # 5 m ahead, 5 m behind, and 80 degrees to the left, where 40 would be the border.
    points = np.array([[[5.0, 0.0, 0.0], [-5.0, 0.0, 0.0], [5.0, 28.0, 0.0]]])
    pixels = see(points, np.zeros((1, 3)), quaternion, LENS)
    assert pixels[0, 0] == pytest.approx([LENS.cx, LENS.cy])
    assert np.isnan(pixels[0, 1:]).all()


def test_a_detector_errs_as_it_says() -> None:
    """40,000 joints: the standard error of a sigma is 1/sqrt(2 n) = 0.35 %, of a share sqrt(p/n) = 0.07 %."""
    pixels = np.full((2000, 20, 2), 500.0)
    noise = KeypointNoise(pixel_px=3.0, missed_share=0.05, outlier_share=0.02)
    xy, confidence = detect(pixels, noise, np.random.default_rng(2))
    missed = np.isnan(xy).any(axis=-1)
    assert missed.mean() == pytest.approx(0.05, abs=0.005)
    assert (np.isnan(xy).all(axis=-1) == missed).all()
    assert ((confidence == 0) == missed).all()
    far = np.linalg.norm(xy[~missed] - 500.0, axis=-1)
    outlier = far > 25  # beyond 8 sigma of the white noise
    assert outlier.mean() == pytest.approx(0.02, abs=0.004)
    assert far[outlier].min() >= 30
    assert far[outlier].max() <= 150
    assert (xy[~missed][~outlier] - 500.0).std() == pytest.approx(3.0, rel=0.015)
