"""TUM trajectories: rows that are read, dropped and counted, and files that are refused."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given

from pipelines.formats import poses as trajectory_files
from pipelines.session.records import Trajectory
from pipelines.session.registries import Export, TrajectoryFormat
from tests.formats.exported import flown, recording
from tests.formats.trajectories import trajectories
from tests.real_data import real_data

READER: TrajectoryFormat = trajectory_files.TUM
WRITER: Export = trajectory_files.TUM_EXPORT
IDENTITY = "0 0 0 1"


def write(folder: Path, text: str, name: str = "poses.tum") -> Path:
    path = folder / name
    path.write_bytes(text.encode())
    return path


def rows(*lines: str) -> str:
    return "\n".join(lines) + "\n"


def test_values_and_exact_stamps(tmp_path: Path) -> None:
    path = write(
        tmp_path, rows("1700000000.123456789 1 -2.5 3e2 0 0 0.6 0.8", f"1700000000.2 0 0 0 {IDENTITY}")
    )
    poses = READER.read_trajectory(path)
    assert poses.t_ns.tolist() == [1700000000123456789, 1700000000200000000]
    assert poses.position[0].tolist() == [1, -2.5, 300]
    np.testing.assert_allclose(poses.quaternion_xyzw[0], [0, 0, 0.6, 0.8], atol=1e-16)
    assert poses.dropped == {}
    assert poses.covariance is None


@pytest.mark.parametrize(
    "header",
    [
        "# timestamp tx ty tz qw qx qy qz",
        "# format: timestamp [s] tx [m] ty [m] tz [m] qw qx qy qz (body in world)",
        "# t x y z w x y z",
        "timestamp,tx,ty,tz,qw,qx,qy,qz",
        "# made by SLAM\n# timestamp(s) p_x p_y p_z q_w q_x q_y q_z\n# 2 poses",
    ],
)
def test_a_header_states_the_order_of_the_quaternion(tmp_path: Path, header: str) -> None:
    # 90 deg about x: w = x = sqrt(1/2). In the order x y z w it would have another axis and angle.
    half = "0.7071067811865476"
    text = rows(header, f"1 10 20 30 {half} {half} 0 0", f"2 10 20 30 {half} {half} 0 0")
    poses = READER.read_trajectory(write(tmp_path, text))
    assert poses.t_ns.tolist() == [10**9, 2 * 10**9]
    assert poses.position.tolist() == [[10, 20, 30]] * 2
    np.testing.assert_allclose(poses.quaternion_xyzw, [[0.5**0.5, 0, 0, 0.5**0.5]] * 2, atol=1e-16)
    assert poses.dropped == {}
    path = tmp_path / "poses.tum"
    assert READER.recognises(path) == ("," not in header)  # `csv` reads a CSV with a header


def test_rows_are_dropped_by_cause(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        rows(
            f"1 0 0 0 {IDENTITY}",
            f"nan 0 0 0 {IDENTITY}",
            f"2 nan 0 0 {IDENTITY}",
            "99 0 0 inf 0 0 0 1",  # its stamp must not put the rows below out of order
            "3 0 0 0 0 0 0 0",
            "4 0 0 0 0 0 0 1.2",
            "4 0 0 0 0 0 0 1e200",
            "5 0 0 0 0 0 0 1.09",
            f"5.000 0 0 7 {IDENTITY}",
            f"5.5 0 0 0 {IDENTITY}",
            f"4.5 0 0 0 {IDENTITY}",
            f"6 0 0 0 {IDENTITY}",
            "7 0 0",
        ),
    )
    poses = READER.read_trajectory(path)
    assert poses.t_ns.tolist() == [10**9, 5 * 10**9, 55 * 10**8, 6 * 10**9]
    assert poses.dropped.pop("not finite") == 4
    assert list(poses.dropped.values()) == [1] * 5  # cut line, no quaternion, no unit, twice, out of order
    np.testing.assert_array_equal(np.linalg.norm(poses.quaternion_xyzw, axis=1), 1)
    assert poses.position[1, 2] == 0, "of two rows with one stamp the first is kept"


def test_recognises_by_content(tmp_path: Path) -> None:
    assert READER.recognises(write(tmp_path, f"1 0 0 0 {IDENTITY}\n", "a.txt"))
    assert READER.recognises(write(tmp_path, "1,0,0,0,0,0,0,1\n", "b.csv"))
    assert not READER.recognises(write(tmp_path, "t,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n", "c.csv"))
    assert not READER.recognises(write(tmp_path, "1 0 0 0\n", "d.txt"))
    assert not READER.recognises(write(tmp_path, "", "e.txt"))
    assert not READER.recognises(tmp_path)
    for other in ("logs/csv/px4_ekf_iris_gps.csv", "calib/colmap_maupertuis_txt/images.txt"):
        assert not READER.recognises(real_data(other))


@given(trajectory=trajectories())
def test_writing_and_reading_gives_the_same(
    tmp_path_factory: pytest.TempPathFactory, trajectory: Trajectory
) -> None:
    path = tmp_path_factory.mktemp("tum") / "poses.tum"
    trajectory_files.write_tum(path, trajectory)
    back = READER.read_trajectory(path)
    np.testing.assert_array_equal(back.t_ns, trajectory.t_ns)
    np.testing.assert_array_equal(back.position, trajectory.position)
    # Reading normalises again, which moves the last bit at most.
    np.testing.assert_allclose(back.quaternion_xyzw, trajectory.quaternion_xyzw, rtol=0, atol=4e-16)
    assert back.dropped == {}


def test_cameras_and_joints_as_evo_reads_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))  # evo writes its settings there on import
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file_interface = pytest.importorskip("evo.tools.file_interface")
    walked = recording()
    motion = walked.motion
    assert motion is not None
    better = replace(flown(), position=flown().position + 0.1)
    (tmp_path / "out").mkdir()
    paths = {
        path.stem.removeprefix("Mound_walk_"): path
        for path in WRITER.write(replace(walked, refined={"cam-1": better}), tmp_path / "out")
    }
    assert set(paths) == {"cam-1", "cam-1_refined", *motion.joints}
    for name, track in (("cam-1", flown()), ("cam-1_refined", better)):
        read = file_interface.read_tum_trajectory_file(str(paths[name]))
        np.testing.assert_array_equal(read.positions_xyz, track.position)
        np.testing.assert_array_equal(read.orientations_quat_wxyz[:, [1, 2, 3, 0]], track.quaternion_xyzw)
        # evo keeps seconds as float64: steps of a quarter of a microsecond so far from 1970.
        np.testing.assert_allclose(read.timestamps, track.t_ns / 1e9, rtol=0, atol=2.5e-7)
    wrist = motion.position[:, 0, motion.joints.index("left_wrist")]
    read = file_interface.read_tum_trajectory_file(str(paths["left_wrist"]))
    np.testing.assert_array_equal(read.positions_xyz, np.delete(wrist, 7, axis=0))
    assert (read.orientations_quat_wxyz == [1, 0, 0, 0]).all()


def test_vins_writes_w_first(tmp_path: Path) -> None:
    """VINS-Fusion's vio_loop.csv by its name, VINS-Mono's rows by their nanoseconds and last comma."""
    turned = [0.5, 0.1, 0.7, 0.5]  # w x y z
    numbers = " ".join(map(str, [1.5, -2.0, 3.0, *turned]))
    for suffix in (".csv", ".txt"):
        (tmp_path / f"vio_loop{suffix}").write_text(f"1700000000.25 {numbers}\n1700000001.25 {numbers}\n")
    mono = f"1700000000250000000,{numbers.replace(' ', ',')},0.1,0.2,0.3,\n"
    both = mono + mono.replace("000250", "001250")
    (tmp_path / "vins.csv").write_text(both)
    (tmp_path / "vins_result_loop.csv").write_text(both.replace("0.1,0.2,0.3,", ""))
    for name in ("vio_loop.csv", "vio_loop.txt", "vins.csv", "vins_result_loop.csv"):
        assert READER.recognises(tmp_path / name)
        found = READER.read_trajectory(tmp_path / name)
        assert found.t_ns.tolist() == [1_700_000_000_250_000_000, 1_700_000_001_250_000_000]
        np.testing.assert_allclose(found.position[0], [1.5, -2.0, 3.0])
        np.testing.assert_allclose(found.quaternion_xyzw[0], np.array([0.1, 0.7, 0.5, 0.5]))
        assert READER.describe(tmp_path / name)["quaternion"] == "qw qx qy qz"
    (tmp_path / "vio.csv").write_text(f"1700000000.25 {numbers}\n")
    np.testing.assert_allclose(READER.read_trajectory(tmp_path / "vio.csv").quaternion_xyzw[0], turned)
