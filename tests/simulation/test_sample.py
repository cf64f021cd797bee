"""The sample flight in the repository: what its scenario makes, small, and as its README describes it."""

import json
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.logs.mcap_log import FORMAT as MCAP
from pipelines.formats.maps.voxel_grids import NPZ
from pipelines.formats.poses import TUM
from pipelines.formats.skeletons.joint_files import JOINTS_CSV
from pipelines.formats.videos.video import FORMAT as VIDEO
from pipelines.session.manifest import read_flight
from pipelines.simulate import example_scenario, simulate

SAMPLE_DATA = Path(__file__).parents[2] / "sample_data"
SAMPLE = SAMPLE_DATA / "mound_walk"
DRONES = ("drone1", "drone2")

EXACT_S, SAME_PATH_M = 1.0, 0.05
"""Drones fly in closed loop: where a last digit decides whether the local planner goes on for one more round,
they fly the same way some millimetres apart (7 on another processor), after the first plans."""


@pytest.fixture(scope="module")
def again(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the flight again, without its videos: logs and truth do not depend on them."""
    folder = tmp_path_factory.mktemp("sample") / "flight"
    simulate(example_scenario("mound_walk"), folder, video=False)
    return folder


def logged_poses(path: Path, topic: str) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Read stamps and poses [M, 8] of an odometry topic."""
    rows = []
    with MCAP.open_log([path]) as log:
        for message in log.messages([topic]):
            value = message.value
            pose, stamp = value.pose.pose, value.header.stamp
            place, turned = pose.position, pose.orientation
            seconds = (stamp.sec - 1_700_000_000) + stamp.nanosec / 1e9
            rows.append([seconds, place.x, place.y, place.z, turned.x, turned.y, turned.z, turned.w])
    return np.array(rows)


@pytest.mark.parametrize("name", DRONES)
def test_the_scenario_makes_the_logs_that_stand_in_the_repository(again: Path, name: str) -> None:
    """Bytes are equal on one kind of processor; another rounds sines differently in the last digit."""
    ours = logged_poses(again / f"{name}.mcap", f"/{name}/odometry")
    theirs = logged_poses(SAMPLE / f"{name}.mcap", f"/{name}/odometry")
    early = theirs[:, 0] < theirs[0, 0] + EXACT_S
    np.testing.assert_allclose(ours[early], theirs[early], rtol=0, atol=1e-6)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=SAME_PATH_M)
    assert (again / f"{name}_camera.yaml").read_text() == (SAMPLE / f"{name}_camera.yaml").read_text()


def test_the_scenario_makes_the_truth_that_stands_in_the_repository(again: Path) -> None:
    ours, theirs = (
        JOINTS_CSV.read_joints(folder / "truth" / "joints.csv", unit=None, axes=None)
        for folder in (again, SAMPLE)
    )
    assert ours.joints == theirs.joints
    assert ours.t_ns.tolist() == theirs.t_ns.tolist()
    np.testing.assert_allclose(ours.position, theirs.position, rtol=0, atol=2e-6)  # written to 1e-6
    for name in DRONES:
        mine, other = (TUM.read_trajectory(f / "truth" / f"{name}.tum") for f in (again, SAMPLE))
        early = other.t_ns < other.t_ns[0] + EXACT_S * 1e9
        np.testing.assert_allclose(mine.position[early], other.position[early], rtol=0, atol=2e-6)
        np.testing.assert_allclose(mine.position, other.position, rtol=0, atol=SAME_PATH_M)
    mapped, stored = (NPZ.read_map(folder / "site.npz") for folder in (again, SAMPLE))
    assert np.array_equal(mapped.probability, stored.probability, equal_nan=True)


def test_it_is_the_flight_of_its_scenario() -> None:
    assert (SAMPLE / "scenario.yaml").read_text() == example_scenario("mound_walk").read_text()
    flight = read_flight(SAMPLE / "flight.yaml")
    assert flight.name == "Mound walk"
    assert tuple(flight.cameras) == DRONES
    frames = json.loads((SAMPLE / "simulation.json").read_text())["frames"]
    for name in DRONES:
        index = VIDEO.index(SAMPLE / f"{name}.mp4")
        assert (index.count, index.width, index.height) == (frames[name], 1280, 720)
        assert index.span_s == pytest.approx(359 / 30, abs=1e-4)
        assert not index.dropped


@pytest.mark.parametrize("name", DRONES)
def test_pose_logs_err_as_stated(name: str) -> None:
    """White 0.02 m about a bias of 0.05 m per axis; the lever arm adds a millimetre or two of rotation."""
    log = logged_poses(SAMPLE / f"{name}.mcap", f"/{name}/odometry")
    truth = TUM.read_trajectory(SAMPLE / "truth" / f"{name}.tum")
    turned = truth.quaternion_xyzw  # of the camera, 0.11 m from the body's origin that is logged
    assert len(log) == len(turned)
    error = log[:, 1:4] - truth.position
    assert np.linalg.norm(error, axis=1).max() < 0.12 + 4 * (0.05 + 0.02) * np.sqrt(3)
    steps = np.diff(error, axis=0)
    # Differences of two draws of 0.02 m; 619 of them give 3 % of their sigma. The arm's swing is slow.
    assert steps.std(axis=0) == pytest.approx(0.02 * np.sqrt(2), rel=0.15)
