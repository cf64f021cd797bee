"""Calibration of confidences with known probabilities."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import isotonic_regression

from pipelines.geometry.arrays import Float
from pipelines.keypoints.calibration import (
    fit,
    isotonic,
    measured_for,
    read_calibration,
)
from pipelines.session.errors import DataError
from pipelines.session.people import get_skeleton

COCO17 = get_skeleton("coco17").joints
WRISTS = [joint.endswith("wrist") for joint in COCO17]


def worth(confidence: Float) -> Float:
    """Compute the true probability of joints other than wrists; wrists have half of it."""
    probability: Float = confidence**2
    return probability


def measured(count: int, seed: int = 0) -> tuple[Float, np.ndarray[tuple[int, int], np.dtype[np.bool_]]]:
    rng = np.random.default_rng(seed)
    confidence = rng.uniform(0.05, 1.0, (count, 17))
    truth = worth(confidence) * np.where(WRISTS, 0.5, 1.0)
    return confidence, rng.random(confidence.shape) < truth


def test_the_probability_is_found_for_each_group() -> None:
    calibration = fit(*measured(20_000), COCO17, groups=["wrist", "ankle"], origin="a test", good="near")
    confidence = np.tile(np.linspace(0.1, 0.95, 50)[:, None], (1, 17))
    found = calibration.probability(confidence, COCO17)
    wrists = np.array(WRISTS)
    # Isotonic regression errs by about (slope sigma^2 / n')^(1/3), n' keypoints per unit of confidence
    # (Brunk 1970, whose limit has a deviation of about 0.52 of (4 slope sigma^2 / n')^(1/3)): with a slope
    # of 2, a variance of 0.25 and 40 000 keypoints of the wrists 0.0190; four of these over all points.
    spread = 0.52 * (4 * 2 * 0.25 / (2 * 20_000 / 0.95)) ** (1 / 3)
    ankles = np.array([joint.endswith("ankle") for joint in COCO17])
    np.testing.assert_allclose(found[:, wrists], worth(confidence[:, wrists]) / 2, atol=4 * spread)
    np.testing.assert_allclose(found[:, ankles], worth(confidence[:, ankles]), atol=4 * spread)
    assert (np.diff(found, axis=0) >= 0).all()


@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(0.1, 10)), min_size=1, max_size=40))
def test_pooling_is_the_nearest_sequence_that_does_not_fall(pairs: list[tuple[float, float]]) -> None:
    values, weight = (np.array(column) for column in zip(*pairs, strict=True))
    firsts, blocks = isotonic(values, weight)
    lengths = np.diff(np.append(firsts, len(values)))
    reference = isotonic_regression(values, weights=weight).x
    np.testing.assert_allclose(np.repeat(blocks, lengths), reference, atol=1e-12)


@pytest.mark.parametrize(
    "text", ["", "# a\n# b\njoints\n", "# a\n# b\njoints,confidence,probability,count\n*,a,0,1\n"]
)
def test_what_is_no_calibration_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "calibration.csv"
    path.write_text(text)
    with pytest.raises(DataError, match="is no calibration"):
        read_calibration(path)


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
