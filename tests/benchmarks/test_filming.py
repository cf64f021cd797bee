"""View quality of groups, against the published evaluation of five planners, and against closed forms."""

import numpy as np
import pytest

from benchmarks.filming import (
    PLANNERS,
    SCENES,
    VIEW_RAD,
    Scene,
    folder,
    planned,
    published_of,
    quality,
    scene_of,
    solution_of,
)
from pipelines.planning.scores import coverage, view_quality


@pytest.mark.parametrize("name", SCENES)
def test_published_view_quality_is_reproduced(name: str) -> None:
    scenes = folder()
    if scenes is None:
        pytest.skip("MOCAP_REAL_DATA has no hughes_filming")
    scene, published = scene_of(scenes, name), published_of(scenes, name)

    for planner in PLANNERS:
        ours = quality(scene, solution_of(scenes, name, planner))
        assert ours == pytest.approx(published[planner], rel=1e-9)


def test_a_side_seen_straight_on_has_its_closed_form() -> None:
    apothem_m, away_m = 0.484, 6.0
    camera = np.array([apothem_m + away_m, 0.0, 0.0])

    found = coverage(camera, np.array(np.pi), np.zeros((1, 3)), np.zeros(1), fov_rad=np.pi / 2)
    behind = coverage(camera, np.array(0.0), np.zeros((1, 3)), np.zeros(1), fov_rad=np.pi / 2)

    assert found[0, 5] == pytest.approx(1 / away_m**2)  # the sixth side looks along x, as the person does
    assert found[0, 2] == 0.0  # it looks away
    assert not behind.any()


def test_a_second_view_of_the_same_face_adds_less() -> None:
    covered = np.zeros((1, 7))
    covered[0, 0] = 0.01

    once, twice = (view_quality(covered * views, np.array([2.0])) for views in (1, 2))

    side_m2 = 2 * 0.484 * np.tan(np.pi / 6) * 1.8
    assert once == pytest.approx(2.0 * side_m2 * 0.1)
    assert twice == pytest.approx(np.sqrt(2) * once)


def test_the_plan_keeps_the_limits_and_beats_standing_still() -> None:
    people = np.broadcast_to([[4.2, 4.3, 0.0], [6.2, 4.3, 0.0]], (6, 2, 3))
    scene = Scene(people, np.zeros((6, 2)), np.ones((6, 2)), (9, 9), VIEW_RAD)
    starts = np.array([[1.0, 1.0, 4.0], [9.0, 9.0, 0.0]])  # both look away

    paths = planned(scene, starts)

    assert paths[:, 0] == pytest.approx(starts)
    assert np.abs(np.diff(paths[..., :2], axis=1)).max() <= 2
    turned = np.diff(paths[..., 2], axis=1) % 8
    assert set(turned.ravel()) <= {0.0, 1.0, 7.0}
    assert paths[..., :2].min() >= 1
    assert paths[..., :2].max() <= 9
    still = np.repeat(starts[:, None], 6, axis=1)
    assert quality(scene, paths).sum() > quality(scene, still).sum()
