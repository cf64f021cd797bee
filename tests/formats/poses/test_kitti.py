"""KITTI's trajectories, written by numpy after the data set's description (poses by rows, times beside)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.formats import poses as trajectory_files
from pipelines.geometry.arrays import Float
from pipelines.session.recognition import recognise
from pipelines.session.registries import TrajectoryFormat
from tests.formats.refusals import refuses

READER: TrajectoryFormat = trajectory_files.KITTI
TIMES = np.arange(5) / 10


def matrices() -> Float:
    """A camera that drives ahead (z) and turns to the right (about y, down)."""
    turned = Rotation.from_rotvec([[0, 0.1 * k, 0] for k in range(5)]).as_matrix()
    places = np.array([[0.5 * k, 0.25, 2.0 * k] for k in range(5)])
    return np.concatenate([turned, places[:, :, None]], axis=2)


def write(folder: Path, rows: Float | None = None, times: str = "times.txt") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "00.txt"
    np.savetxt(path, (matrices() if rows is None else rows).reshape(-1, 12), fmt="%.12e")
    (folder / times).parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(folder / times, TIMES, fmt="%.6e")
    return path


@pytest.mark.parametrize("times", ["times.txt", "00_times.txt", "../sequences/00/times.txt"])
def test_poses_stand_upright_and_have_their_times(tmp_path: Path, times: str) -> None:
    path = write(tmp_path / "poses", times=times)
    assert recognise(path, TrajectoryFormat, "trajectory") is READER
    assert not trajectory_files.TUM.recognises(path)
    poses = READER.read_trajectory(path)
    assert poses.t_ns.tolist() == [100_000_000 * k for k in range(5)]
    expected = np.array([[0.5 * k, 2.0 * k, -0.25] for k in range(5)])  # right, ahead, up
    np.testing.assert_allclose(poses.position, expected, rtol=0, atol=1e-9)
    ahead = Rotation.from_quat(poses.quaternion_xyzw).apply([0, 0, 1])  # the optical axis
    turn = 0.1 * np.arange(5)
    np.testing.assert_allclose(ahead, np.stack([np.sin(turn), np.cos(turn), 0 * turn], 1), atol=1e-9)
    down = Rotation.from_quat(poses.quaternion_xyzw).apply([0, 1, 0])
    np.testing.assert_allclose(down, np.tile([0, 0, -1], (5, 1)), atol=1e-9)


def test_too_few_times_or_none_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path)
    (tmp_path / "times.txt").write_text("0.0\n0.1\n")
    with refuses(tmp_path / "times.txt", 2, 5):
        READER.read_trajectory(path)
    (tmp_path / "times.txt").unlink()
    with refuses(path, "times.txt"):
        READER.read_trajectory(path)
