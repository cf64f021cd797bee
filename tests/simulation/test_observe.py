"""Simulated instruments: exact without noise, and with it as noisy as they say."""

import cv2
import numpy as np
import pytest

from pipelines.geometry.cameras import camera_matrix
from pipelines.geometry.poses import invert, look_at, rotation_vector_from_quaternion
from pipelines.simulation.detector_errors import see
from pipelines.simulation.flying import orbit
from tests.synthetic.flights import LENS
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
