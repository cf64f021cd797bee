"""Calibration of confidences, as it was measured."""

import numpy as np
import pytest

from pipelines.keypoints.corrections import measured_for, read_calibration


@pytest.mark.parametrize("detector", ["blazepose", "blazepose-heavy"])
def test_keypoints_in_any_order_are_worth_the_same(detector: str) -> None:
    path = measured_for(detector)
    assert path is not None
    assert measured_for("onnx:somebody's") is None
    calibration = read_calibration(path)
    assert "tools/detector_errors.py" in calibration.origin
    joints = ("left_wrist", "nose", "right_hip")
    confidence = np.random.default_rng(4).uniform(0.0, 1.0, (50, 3))
    expected = calibration.probability(confidence, joints)
    order = np.random.default_rng(5).permutation(150)
    names = np.tile(np.array(joints), 50)
    assert np.array_equal(
        calibration.probabilities(confidence.ravel()[order], names[order]), expected.ravel()[order]
    )
    # Joints with high confidence are right more often than not, and the other way round.
    assert calibration.probability(np.array([[0.9]]), ("left_knee",))[0, 0] > 0.9
    assert calibration.probability(np.array([[0.2]]), ("left_knee",))[0, 0] < 0.5
