"""The sample flight in the repository: reproducible, small, and as its README describes it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.alphapose import FORMAT as ALPHAPOSE
from pipelines.formats.joints_csv import FORMAT as JOINTS_CSV
from pipelines.formats.tum import FORMAT as TUM
from pipelines.session.manifest import read_flight
from pipelines.simulation.walk import COCO17

SAMPLE_DATA = Path(__file__).parents[2] / "sample_data"
COMMITTED = SAMPLE_DATA / "ring_walk"
START_NS = 1_700_000_000_000_000_000


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}


def test_the_script_writes_what_stands_in_the_repository(tmp_path: Path) -> None:
    for name in ("first", "second"):
        subprocess.run([sys.executable, SAMPLE_DATA / "make_sample.py", tmp_path / name], check=True)
    assert contents(tmp_path / "first") == contents(tmp_path / "second")
    assert contents(tmp_path / "first") == contents(COMMITTED)


def test_it_is_small() -> None:
    assert sum(map(len, contents(COMMITTED).values())) < 3_000_000


def test_the_manifest_is_valid_and_names_files_that_exist() -> None:
    flight = read_flight(COMMITTED / "flight.yaml")
    assert flight.name == "Ring walk"
    assert list(flight.cameras) == ["drone1", "drone2", "drone3"]
    assert [c.frame_times.start_ns - START_NS for c in flight.cameras.values() if c.frame_times] == [
        0,
        11_000_000,
        22_000_000,
    ]
    for camera in flight.cameras.values():
        assert camera.keypoints is not None
        assert (COMMITTED / camera.keypoints.path).exists()
        assert camera.pose.tum is not None
        assert (COMMITTED / camera.pose.tum).exists()


@pytest.mark.parametrize("name", ["drone1", "drone2", "drone3"])
def test_keypoints_are_as_described(name: str) -> None:
    seen = ALPHAPOSE.read_keypoints(COMMITTED / f"{name}_keypoints.json", skeleton=None, first_frame=0)
    assert seen.joints == COCO17
    actor = seen.person == 1
    assert seen.frame[actor].tolist() == list(range(360))
    # 6120 joints, 3 % missed: the standard error is 0.2 %.
    assert np.isnan(seen.xy[actor]).any(axis=-1).mean() == pytest.approx(0.03, abs=0.01)
    passing = seen.frame[~actor]
    # The second from 7 s on; the shutter of drone2 runs 11 ms late.
    assert passing.tolist() == (list(range(210, 240)) if name == "drone2" else [])


@pytest.mark.parametrize("name", ["drone1", "drone2", "drone3"])
def test_pose_logs_are_as_described(name: str) -> None:
    log = TUM.read_trajectory(COMMITTED / f"{name}_poses.tum")
    truth = TUM.read_trajectory(COMMITTED / f"{name}_true_poses.tum")
    since_s = (log.t_ns - START_NS) / 1e9
    assert since_s[0] < 0
    assert since_s[-1] > 12 + 0.022
    longest = np.diff(since_s).max()
    assert longest == pytest.approx(0.62 if name == "drone3" else 0.02, abs=1e-6)
    error = log.position - truth.position[np.isin(truth.t_ns, log.t_ns)]
    assert error.std(axis=0) == pytest.approx(0.02, rel=0.15)  # 650 rows: 3 % each
    assert np.abs(error.mean(axis=0)).max() < 4 * 0.05


def test_the_true_joints_are_those_of_the_first_camera() -> None:
    truth = JOINTS_CSV.read_joints(COMMITTED / "true_joints.csv", unit=None, axes=None)
    assert truth.joints == COCO17
    assert truth.position.shape == (360, 1, 17, 3)
    assert truth.t_ns[0] == START_NS
    assert (truth.t_ns[-1] - START_NS) / 1e9 == pytest.approx(359 / 30, abs=1e-9)
