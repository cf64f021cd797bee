"""The bound of `benchmarks.angles`: keypoints at their true distances from the cameras."""

from __future__ import annotations

import numpy as np

from benchmarks.angles import at_true_depths
from pipelines.geometry.triangulation import STATUS, Triangulation, Views
from pipelines.reconstruction.observations import Observations

WEST, SOUTH = np.array([-10.0, 0.0, 1.0]), np.array([0.0, -8.0, 1.0])
EAST_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # world_from_camera
NORTH_AHEAD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def test_each_view_moves_a_joint_across_its_line_of_sight_and_views_are_averaged_by_weight() -> None:
    true = np.array([[[0.5, 0.2, 1.4]]])
    # The camera in the west errs by 3 cm to the south and 2 cm up, the one in the south by 5 cm to the east.
    seen = (true[0, 0] + (0, -0.03, 0.02), true[0, 0] + (0.05, 0, 0))
    places, turns = np.stack([WEST, SOUTH]), np.stack([EAST_AHEAD, NORTH_AHEAD])
    away = [turns[c].T @ (seen[c] - places[c]) for c in range(2)]
    rays = np.array([each[:2] / each[2] for each in away])
    weight = np.array([1.0, 0.25])
    views = Views(
        rays[None],
        weight[None],
        np.zeros(1, np.int64),
        places[None],
        turns[None],
        np.full(2, 800.0),
        np.ones(2),
        np.zeros((1, 2, 2)),
    )
    observations = Observations(
        np.zeros(1, np.int64),
        ("nose",),
        rays[None, None, None],
        weight[None, None, None],
        places[None],
        turns[None],
        None,
    )
    result = Triangulation(
        points=np.zeros((1, 3)),
        covariance=np.zeros((1, 3, 3)),
        inlier=np.ones((1, 2), np.bool_),
        status=np.full(1, STATUS.index("ok"), np.int8),
        views=np.full(1, 2, np.int8),
        residual_px=np.zeros((1, 2)),
    )
    found = at_true_depths(views, result, observations, ("nose",), true)
    expected = true[0, 0] + (1.0 * np.array([0, -0.03, 0.02]) + 0.25 * np.array([0.05, 0, 0])) / 1.25
    np.testing.assert_allclose(found[0, 0], expected, atol=1e-12)
    assert np.isnan(at_true_depths(views, result, observations, ("neck",), true)).all()
