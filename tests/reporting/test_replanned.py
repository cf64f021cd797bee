"""A comparison of planners in numbers, and the data of the 3D view."""

import base64
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipelines.reporting import viewer
from pipelines.reporting.arms import MapAround, Replan, heights, map_around, raised_surface, summarise_replan
from pipelines.reporting.content import SessionContent
from pipelines.reporting.summary import summarise
from pipelines.reporting.viewer import ViewerScene, make_scene
from pipelines.session.records import Occupancy

from .comparisons import (
    BLOCK,
    DRONES,
    RANGE_M,
    TIMES,
    actor,
    make_comparison,
    make_map,
    positions,
    seconds,
    tilt_deg,
    yaw_deg,
)
from .conftest import (
    CAMERAS,
    FRAMES,
    JOINTS,
    OFFSET_M,
    START_NS,
    described,
    make_poses,
    make_session,
    make_skeleton,
    make_truth,
    statuses,
    true_positions,
)
from .reading import numbers, plain

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
    found = raised_surface(terrain)
    # Layer 0 is ground. Of 8 x 6 columns eight layers show their 24 edge voxels, the last one all 48.
    assert found.voxels == len(found.middle) == 8 * 24 + 48
    assert found.cube_m == 0.5
    assert found.middle.min(axis=0).tolist() == [-9.75, 0.25, 0.75]
    assert found.middle.max(axis=0).tolist() == [-6.25, 2.75, 4.75]
    thin = raised_surface(terrain, most=100)
    assert thin.voxels == 240
    assert len(thin.middle) <= 100
    assert thin.cube_m == 1.0
    # Every voxel lies in one of the cubes.
    offset = np.abs(found.middle[:, None] - thin.middle[None]).max(axis=-1)
    assert (offset.min(axis=1) < thin.cube_m / 2).all()


# Half a millimetre of the middle and half of the joint, and double precision.
ROUNDING_M = 0.001001


def _scene(content: SessionContent) -> ViewerScene:
    scene = make_scene(summarise(content), content.poses)
    assert scene is not None
    return scene


def _numbers(text: Any, kind: type[np.int16 | np.int32], columns: int) -> np.ndarray:
    """Decode numbers as the page does, [N, columns]; NaN where one is missing."""
    raw = np.frombuffer(base64.b64decode(text), dtype=np.dtype(kind).newbyteorder("<"))
    values = raw.astype(np.float64).reshape(-1, columns)
    missing = values == np.iinfo(kind).min
    assert (missing.all(axis=1) == missing.any(axis=1)).all()
    return np.where(missing, np.nan, values)


def _joints(scene: ViewerScene, which: str = "joint") -> np.ndarray:
    """Decode the positions [T, P, J, 3] in the world, without the scene's origin."""
    body: Any = scene.data["body"]
    middle = _numbers(body["middle"], np.int32, 3) / 1000
    people, joints = body["people"], len(body["joints"])
    offset = _numbers(body[which], np.int16, 3).reshape(-1, people, joints, 3) / 1000
    return middle.reshape(-1, people, 1, 3) + offset


def _origin(scene: ViewerScene, content: SessionContent) -> np.ndarray:
    """Compute the scene's origin from the camera that stands still."""
    cameras: Any = scene.data["cameras"]
    mast = _numbers(cameras[CAMERAS.index("mast")]["position"], np.int32, 3) / 1000
    origin: np.ndarray = content.poses["mast"][["x", "y", "z"]].to_numpy()[0] - mast[0]
    return origin


def test_skeleton_and_truth_come_back_to_the_millimetre(content: SessionContent) -> None:
    scene = _scene(content)
    origin = _origin(scene, content)
    t_s = _numbers(scene.data["t"], np.int32, 1)[:, 0] / 1e4
    assert t_s == pytest.approx(np.arange(FRAMES) / 30, abs=1e-4)
    true = true_positions(np.arange(FRAMES) / 30)
    measured = _joints(scene)[:, 0]
    # Every joint that was not measured is missing, and no other.
    assert np.array_equal(np.isfinite(measured[..., 0]), statuses(FRAMES) == "ok")
    assert np.nanmax(np.abs(measured + origin - true - OFFSET_M)) < ROUNDING_M
    assert np.nanmax(np.abs(_joints(scene, "truth")[:, 0] + origin - true)) < ROUNDING_M


def test_cameras_are_where_their_poses_say_and_nowhere_in_a_gap(content: SessionContent) -> None:
    scene = _scene(content)
    cameras: Any = scene.data["cameras"]
    assert [camera["name"] for camera in cameras] == list(CAMERAS)
    t_ns = START_NS + np.round(np.arange(FRAMES) / 30 * 1e9).astype(np.int64)
    table = content.poses["drone2"]
    position = _numbers(cameras[1]["position"], np.int32, 3) / 1000 + _origin(scene, content)
    rotation = _numbers(cameras[1]["rotation"], np.int16, 4)
    hole = table["t_ns"].to_numpy()[:-1][np.diff(table["t_ns"]) > 500_000_000][0]
    inside = (t_ns > hole) & (t_ns < hole + round(0.06 * 20 * 1e9) - 1)
    assert np.array_equal(np.isnan(position[:, 0]), inside)
    # Linear between poses 20 ms apart: an acceleration below 2 m/s^2 errs by 0.1 mm.
    for k, axis in enumerate("xyz"):
        expected = np.interp(t_ns - START_NS, table["t_ns"] - START_NS, table[axis])
        assert np.nanmax(np.abs(position[:, k] - expected)) < ROUNDING_M
    assert np.linalg.norm(rotation[~inside], axis=1) == pytest.approx(32767, rel=1e-4)
    assert cameras[0]["corners"] == pytest.approx(
        [-960 / 1400, 960 / 1400, -540 / 1400, 540 / 1400], abs=1e-4
    )


def test_long_flight_is_thinned_and_says_so(content: SessionContent, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer, "MAX_BYTES", 1_500_000)
    frames = 6000
    long_flight = replace(
        content,
        session=described(make_session(frames)),
        skeleton=make_skeleton(frames),
        truth=make_truth(frames),
        poses=make_poses(frames),
    )
    scene = _scene(long_flight)
    joints = _joints(scene)
    # Per time: 17 joints of 12 numbers of 2 bytes, a middle and a height of 16, three cameras of 20 each.
    every = -(-frames * (17 * 12 * 2 + 16 + 60) // 1_500_000)
    assert len(joints) == frames // every
    assert [numbers(note) for note in scene.notes] == [[2, 6000]]
    expected = true_positions(np.arange(0, frames, every) / 30)[:, JOINTS.index("left_hip")]
    hip = joints[:, 0, JOINTS.index("left_hip")] + _origin(scene, long_flight)
    assert np.nanmax(np.abs(hip - expected - OFFSET_M)) < ROUNDING_M


def test_a_joint_gone_far_astray_is_left_out_and_counted(content: SessionContent) -> None:
    assert content.skeleton is not None
    far = content.skeleton.copy()
    astray = (far["joint"] == "nose") & (far["status"] == "ok")
    first = far.index[astray][:3]
    far.loc[first, "x"] += 40.0
    scene = _scene(replace(content, skeleton=far))
    lost = np.isfinite(_joints(_scene(content))[..., 0]) & np.isnan(_joints(scene)[..., 0])
    assert lost.sum() == 3
    assert lost[..., JOINTS.index("nose")].sum() == 3
    assert [numbers(note) for note in scene.notes] == [[3, 33]]


def test_simulated_arms_bring_their_cameras_and_the_map(content: SessionContent) -> None:
    summary = summarise(content)
    replan = summarise_replan(make_comparison(), START_NS, len(CAMERAS))
    scene = make_scene(summary, content.poses, replan)
    assert scene is not None
    assert scene.arms == ("adaptive", "fixed")  # what was flown is there as the session's own cameras
    cameras: Any = scene.data["cameras"]
    assert [camera["name"] for camera in cameras] == [*CAMERAS, *DRONES, *DRONES]
    assert [camera.get("arm") for camera in cameras] == [None] * 3 + [0, 0, 1, 1]
    assert [camera.get("colour") for camera in cameras] == [None] * 3 + [3, 3, 4, 4]
    origin = _origin(scene, content)
    t_s = np.arange(FRAMES) / 30
    for arm, k in ((0, 0), (0, 1), (1, 0), (1, 1)):
        found = _numbers(cameras[3 + 2 * arm + k]["position"], np.int32, 3) / 1000 + origin
        wanted = positions(scene.arms[arm], k)
        stored_s = np.arange(TIMES) / 50
        expected = np.stack([np.interp(t_s, stored_s, wanted[:, axis]) for axis in range(3)], axis=-1)
        inside = t_s <= stored_s[-1]
        np.testing.assert_allclose(found[inside], expected[inside], atol=ROUNDING_M)
        assert np.isnan(found[t_s > stored_s[-1] + 0.1]).all()  # the comparison ends, the session goes on
    drawn: Any = scene.data["surface"]
    points = _numbers(drawn["points"], np.int32, 3) / 1000 + origin
    assert len(points) == 240
    np.testing.assert_allclose(points.max(axis=0), [-6.25, 2.75, 4.75], atol=ROUNDING_M)
