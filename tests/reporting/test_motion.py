from dataclasses import replace

import numpy as np
import pytest

from pipelines.geometry.triangulation import STATUS
from pipelines.reporting.content import errors_mm, motion_from_skeleton, share_inside_95
from pipelines.reporting.summary import truth_at

from .conftest import FRAMES, JOINTS, OFFSET_M, make_skeleton, make_truth, statuses


def test_error_is_the_offset_wherever_the_joint_was_measured() -> None:
    motion = motion_from_skeleton(make_skeleton())
    error = errors_mm(motion, truth_at(make_truth(), motion))
    measured = statuses(FRAMES) == "ok"
    assert np.array_equal(np.isfinite(error[:, 0]), measured)
    # sqrt(20^2 + 10^2) mm, to the rounding of metres at a distance of some metres.
    np.testing.assert_allclose(error[:, 0][measured], 1000 * np.linalg.norm(OFFSET_M), atol=1e-9)


def test_truth_is_interpolated_but_not_beside_a_hole_nor_outside() -> None:
    motion = motion_from_skeleton(make_skeleton(20))
    truth = make_truth(20)
    # Every second stamp: those between are the mean of their neighbours, a straight line in time.
    stamps = motion.t_ns
    coarse = truth[truth["t_ns"].isin(stamps[::2])]
    between = truth_at(coarse, motion)
    dense = truth_at(truth, motion)
    np.testing.assert_allclose(between[1], (dense[0] + dense[2]) / 2, atol=1e-9)
    assert np.isnan(between[-1]).all()  # after the last stamp
    # Without the stamp 6 the hole is two usual steps of two.
    holed = coarse[coarse["t_ns"] != stamps[6]]
    assert np.flatnonzero(np.isnan(truth_at(holed, motion)).all(axis=(1, 2, 3))).tolist() == [5, 6, 7, 19]
    # A joint that is missing at one stamp is missing on both sides of it.
    nose = coarse[~((coarse["joint"] == "nose") & (coarse["t_ns"] == stamps[6]))]
    result = truth_at(nose, motion)[:, 0, JOINTS.index("nose"), 0]
    assert np.array_equal(np.isnan(result), np.isin(np.arange(20), [5, 6, 7, 19]))


def test_a_calibrated_covariance_holds_95_percent_of_the_truth() -> None:
    motion = motion_from_skeleton(make_skeleton(400))
    rng = np.random.default_rng(7)
    factor = np.array([[0.03, 0.0, 0.0], [0.01, 0.02, 0.0], [-0.02, 0.005, 0.05]])
    covariance = (factor @ factor.T)[np.triu_indices(3)]
    motion = replace(
        motion,
        status=np.full(motion.status.shape, STATUS.index("ok"), dtype=np.int8),
        position=np.zeros(motion.position.shape),
        covariance=np.broadcast_to(covariance, motion.covariance.shape),
    )
    truth = rng.standard_normal(motion.position.shape) @ factor.T
    share = share_inside_95(motion, truth)
    # 6 800 draws: the standard deviation of the share is sqrt(.95 * .05 / 6800) = 0.0026; 4 of them.
    assert share == pytest.approx(0.95, abs=0.011)
