"""A comparison in numbers: the tracks of every arm, the rows of the tables, the map around."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.reporting.arms import (
    MapAround,
    Replan,
    heights,
    map_around,
    summarise_replan,
    surface,
)
from pipelines.session.records import Occupancy

from .comparisons import (
    BLOCK,
    RANGE_M,
    actor,
    make_comparison,
    make_map,
    positions,
    seconds,
    tilt_deg,
    yaw_deg,
)
from .conftest import START_NS
from .reading import plain

ARMS = ("adaptive", "fixed", "flown")


@pytest.fixture(scope="module")
def compared() -> Replan:
    return summarise_replan(make_comparison(), START_NS, 2)


def test_tracks_are_those_of_the_tables(compared: Replan) -> None:
    assert [arm.name for arm in compared.arms] == list(ARMS)
    assert [arm.simulated for arm in compared.arms] == [True, True, False]
    # The session's two cameras have the first two colours.
    assert [arm.colour for arm in compared.arms] == [2, 3, 4]
    for arm in compared.arms:
        np.testing.assert_allclose(arm.t_s, seconds(), atol=1e-9)
        np.testing.assert_allclose(arm.actor, actor(), atol=1e-12)
        for k in range(2):
            np.testing.assert_allclose(arm.position[k], positions(arm.name, k), atol=1e-12)
            np.testing.assert_allclose(arm.tilt_deg[k], tilt_deg(arm.name), atol=1e-9)
        np.testing.assert_allclose(arm.range_m, RANGE_M, atol=1e-9)
        np.testing.assert_allclose(arm.yaw_deg, yaw_deg(arm.name), atol=1e-9)
    fixed = compared.arms[1]
    # From 2 s until 4 s at 50 Hz, drone1 alone.
    assert (~fixed.visible).sum(axis=1).tolist() == [100, 0]
    assert np.isnan(fixed.predicted_error_m).sum() == 100


def test_the_tables_hold_what_the_metrics_hold(compared: Replan) -> None:
    arms, differences = compared.tables
    cells = [" ".join(cell) if isinstance(cell, tuple) else str(cell) for cell in arms.rows[0]]
    assert " ".join(plain(cell) for cell in cells) == (
        "adaptive simulated 2 10.0 17.2 23.5 88 12.8 −0.2 14.1 12.5 % 1.2 s blind"
        " 75.0 68.8 to 81.2 61.0 58.5 to 63.5 87.5 81.2 to 93.8 collision 3"
    )
    assert "95\u202f%" in arms.caption
    assert differences.rows[0][1] == ("−5.00", "−5.50 to −4.50")
    assert differences.rows[0][3:] == [("+6.25", "3.12 to 9.38"), ("+1.50", "1.25 to 1.75"), ("–", "")]


def test_several_people_have_rows_of_their_own() -> None:
    content = make_comparison()
    anna = {"occluded_share": 0.25, "blind_s": 1.5, "pck150": {"mean": 0.5}, "view_quality": 0.6249}
    metrics: dict[str, object] = {
        "arms": {"adaptive": {"by_person": {"anna": anna, "ben": {}}}, "fixed": {}},
        "equal_ranges": [{"arms": ["fixed", "adaptive"]}],
    }
    _, people = summarise_replan(replace(content, metrics=metrics), START_NS, 2).tables
    assert people.rows[0][:2] == ["adaptive", "anna"]
    assert (people.rows[0][3], people.rows[0][-1]) == (("50.0", ""), "0.625")
    assert people.rows[1][4] == ("–", "")


# --- the map ---


def _around(occupancy: Occupancy, low: tuple[float, float], high: tuple[float, float]) -> MapAround:
    found = map_around(occupancy, np.array(low), np.array(high))
    assert found is not None
    return found


def test_heights_count_from_the_ground() -> None:
    terrain = _around(make_map(), (-100.0, -100.0), (100.0, 100.0))
    assert terrain.ground_m == 0.5  # the top of the lowest layer
    found = heights(terrain)
    assert found.above_m.shape == (80, 100)
    assert found.above_m[BLOCK[:2]].min() == 4.5
    assert found.above_m.sum() == 8 * 6 * 4.5
    # The middle of the block's first column: 20.5 voxels from -20 m and 50.5 from -25 m.
    assert (found.east_m[20], found.north_m[50]) == (-9.75, 0.25)


def test_the_surface_is_the_shell_of_what_rises() -> None:
    terrain = _around(make_map(), (-100.0, -100.0), (100.0, 100.0))
    found = surface(terrain)
    # Layer 0 is ground. Of 8 x 6 columns eight layers show their 24 edge voxels, the last one all 48.
    assert found.voxels == len(found.points) == 8 * 24 + 48
    assert found.cube_m == 0.5
    assert found.points.min(axis=0).tolist() == [-9.75, 0.25, 0.75]
    assert found.points.max(axis=0).tolist() == [-6.25, 2.75, 4.75]
    thin = surface(terrain, most=100)
    assert thin.voxels == 240
    assert len(thin.points) <= 100
    assert thin.cube_m == 1.0
    # Every voxel lies in one of the cubes.
    offset = np.abs(found.points[:, None] - thin.points[None]).max(axis=-1)
    assert (offset.min(axis=1) < thin.cube_m / 2).all()
