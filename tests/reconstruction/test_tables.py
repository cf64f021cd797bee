"""Tables of a reconstruction: pictures without a pose have no row."""

from dataclasses import replace

import numpy as np

from pipelines.reconstruction.results import camera_poses_table
from pipelines.session.description import Interpolation
from pipelines.session.records import Trajectory
from tests.reconstruction.test_trials import camera

SECOND_NS = 1_000_000_000


def test_poses_are_not_made_up_in_pauses_of_the_log() -> None:
    """Log poses at 0, 1, 2, 12 and 13 s; of the pictures every second, those in the pause have no pose."""
    logged_s = np.array([0, 1, 2, 12, 13])
    position = np.stack([logged_s, 0 * logged_s, 0 * logged_s], axis=1).astype(np.float64)
    log = Trajectory(logged_s * SECOND_NS, position, np.tile([0.0, 0, 0, 1], (5, 1)))
    pictures_s = np.arange(16)
    drone = replace(
        camera("drone"),
        trajectory=log,
        frame_t_ns=pictures_s * SECOND_NS,
        frame_number=pictures_s,
        follows=np.ones(16, dtype=np.bool_),
    )
    table = camera_poses_table([drone], Interpolation(max_gap_s=1.5, max_extrapolation_s=0.0))
    np.testing.assert_array_equal(table["t_ns"], np.array([0, 1, 2, 12, 13]) * SECOND_NS)
    np.testing.assert_allclose(table["x"], [0, 1, 2, 12, 13])

    still = replace(
        drone,
        static=True,
        trajectory=Trajectory(log.t_ns[:1], position[:1], log.quaternion_xyzw[:1]),
    )
    assert len(camera_poses_table([still], Interpolation(max_gap_s=1.5, max_extrapolation_s=0.0))) == 16
