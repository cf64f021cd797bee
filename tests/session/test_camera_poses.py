"""Use of logged covariances: which of them are accepted."""

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import quaternion_from_matrix
from pipelines.session.camera_poses import logged_covariance
from pipelines.session.records import Trajectory


def logged(covariance: Float) -> Trajectory:
    count = len(covariance)
    still = quaternion_from_matrix(np.tile(np.eye(3), (count, 1, 1)))
    return Trajectory(np.arange(count, dtype=np.int64), np.zeros((count, 3)), still, covariance)


def test_what_logs_write_for_unknown_is_not_taken_at_its_word() -> None:
    good = np.diag([0.01, 0.02, 0.03, 1e-4, 2e-4, 3e-4])
    good[0, 1] = good[1, 0] = 0.005
    silent, absurd, negative, tied = (good.copy() for _ in range(4))
    silent[:] = 0
    absurd[2, 2] = 1e6
    absurd[0, 2] = absurd[2, 0] = 3.0
    negative[3, 3] = -1
    tied[0, 1] = tied[1, 0] = 0.5  # a correlation of 35
    found = logged_covariance(logged(np.stack([good, silent, absurd, negative, tied])))
    assert found is not None
    np.testing.assert_array_equal(found[0], good)
    # A silent pose has the median level of the others, alike on all axes: 0.02 and 2e-4; the absurd axis
    # the mean of the other two.
    np.testing.assert_allclose(np.diag(found[1]), [0.02] * 3 + [2e-4] * 3, rtol=0.3)
    assert np.count_nonzero(found[1]) == 6
    np.testing.assert_allclose(np.diag(found[2]), [0.01, 0.02, 0.015, 1e-4, 2e-4, 3e-4])
    assert found[2][0, 2] == 0
    assert found[2][0, 1] == 0.005
    np.testing.assert_allclose(np.diag(found[3])[3:], [2.5e-4, 2e-4, 3e-4])
    np.testing.assert_array_equal(found[4], np.diag(np.diag(good)))
    assert logged_covariance(logged(np.zeros((4, 6, 6)))) is None
    no_turn = good.copy()
    no_turn[3:, 3:] = 0
    assert logged_covariance(logged(no_turn[None])) is None
