"""3D joints as a long CSV, the csv export, and resampling of times to frames."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given

from pipelines.formats import poses as trajectory_files
from pipelines.formats.skeletons import joint_files
from pipelines.formats.skeletons.joint_files import at_even_times
from pipelines.session.errors import DataError
from pipelines.session.recognition import recognise
from pipelines.session.records import JointMotion, Recording, Trajectory
from pipelines.session.registries import FORMATS, Export, JointFormat
from tests.formats.exported import START_NS, Listener
from tests.formats.motions import motions
from tests.raising import refused

READER: JointFormat = joint_files.JOINTS_CSV
WRITER: Export = joint_files.CSV_EXPORT


def write(folder: Path, text: str) -> Path:
    path = folder / "joints.csv"
    path.write_text(text)
    return path


def read(path: Path, unit: str | None = None, axes: str | None = None) -> JointMotion:
    return READER.read_joints(path, unit=unit, axes=axes)


def test_rows_in_any_order_become_dense(tmp_path: Path) -> None:
    path = write(
        tmp_path, "t_ns,person,joint,x,y,z\n20,7,nose,1,2,3\n10,3,hip,4,5,6\n10,7,nose,7,8,9\n20,3,nose,,,\n"
    )
    assert [each.name for each in FORMATS.all() if each.recognises(path)] == ["joints_csv"]
    motion = read(path)
    assert motion.t_ns.tolist() == [10, 20]
    assert motion.joints == ("nose", "hip")
    assert motion.position.shape == (2, 2, 2, 3), "persons 3 and 7 are the first and the second"
    assert motion.position[0, 0, 1].tolist() == [4, 5, 6]
    assert motion.position[1, 1, 0].tolist() == [1, 2, 3]
    assert np.isnan(motion.position[1, 0]).all()
    assert np.count_nonzero(np.isfinite(motion.position)) == 9


def test_seconds_units_and_axes(tmp_path: Path) -> None:
    path = write(tmp_path, "time,joint,x,y,z\n1700000000.123456789,nose,1000,2000,3000\n")
    assert read(path).t_ns.tolist() == [1700000000123456789]
    assert read(path, unit="mm").position[0, 0, 0].tolist() == [1, 2, 3]
    # y up: world x is the file's z, world y its x, world z its y.
    assert read(path, unit="mm", axes="y-up").position[0, 0, 0].tolist() == [3, 1, 2]


@pytest.mark.parametrize(
    "text",
    [
        "t_ns,x,y,z\n1,2,3,4\n",
        "t_ns,joint,x,y,z\n1,,1,2,3\n",
        "t_ns,joint,x,y,z\n1,nose,1,2,3\n1,nose,1,2,3\n",
        "t_ns,joint,x,y,z\n1,nose,1,2,3\n2,nose,1,",
        "t_ns,joint,x,y,z\n1,nose,1,b,3\n2,nose,1,2,3\n",
        "t_ns,person,joint,x,y,z\n1,,nose,1,2,3\n",
    ],
)
def test_faulty_content_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(DataError):
        read(write(tmp_path, text))


@given(motion=motions())
def test_writing_and_reading_gives_the_same(
    tmp_path_factory: pytest.TempPathFactory, motion: JointMotion
) -> None:
    path = tmp_path_factory.mktemp("joints") / "joints.csv"
    joint_files.write_joints(path, motion)
    assert READER.recognises(path)
    assert not trajectory_files.POSE_CSV.recognises(path)
    back = read(path)
    assert back.joints == motion.joints
    np.testing.assert_array_equal(back.t_ns, motion.t_ns)
    np.testing.assert_array_equal(back.position, motion.position)
    table = pd.read_csv(path)
    assert motion.status is not None
    assert motion.reprojection_px is not None
    assert table["status"].tolist() == motion.status.ravel().tolist()
    np.testing.assert_allclose(table["reprojection_px"], motion.reprojection_px.ravel(), rtol=1e-14)


def test_export_writes_skeleton_and_cameras(tmp_path: Path) -> None:
    motion = JointMotion(np.array([0, 1]), ("nose",), np.zeros((2, 1, 1, 3)))
    poses = Trajectory(np.array([5]), np.ones((1, 3)), np.array([[0.0, 0, 0, 1]]))
    paths = WRITER.write(Recording("walk", motion, {"d1": poses}), tmp_path)
    assert [path.stem for path in paths] == ["walk", "walk_d1"]
    np.testing.assert_array_equal(read(paths[0]).position, motion.position)
    np.testing.assert_array_equal(
        trajectory_files.POSE_CSV.read_trajectory(paths[1]).position, poses.position
    )
    with refused("data", "walk", "reconstruct"):
        WRITER.write(Recording("walk", None, {}), tmp_path)


def test_a_row_for_each_time_as_freemocap_writes_them(tmp_path: Path) -> None:
    names = ("nose", "left_shoulder", "mouth_left", "right_hip", "body_com")
    head = ",".join(f"{name}_{axis}" for name in names for axis in "xyz")
    rows = [f"{t},{t},{','.join(str(100 * k + t) for k in range(15))}" for t in (0, 1)]
    path = tmp_path / "by_frame.csv"
    path.write_text("\n".join([f"frame,timestamp,{head}", *rows]) + "\n")
    reader = recognise(path, JointFormat, "joint file")
    motion = reader.read_joints(path, unit="mm", axes=None)
    assert motion.joints == ("nose", "left_shoulder", "left_mouth", "right_hip", "body_com")
    assert motion.t_ns.tolist() == [0, 10**9]
    np.testing.assert_allclose(motion.position[1, 0, 1], [0.301, 0.401, 0.501])
    path.write_text("\n".join([f"sync_index,{head}", *(row.partition(",")[2] for row in rows)]) + "\n")
    frames = reader.read_joints(path, unit="mm", axes=None)
    assert (frames.t_ns.tolist(), frames.timed) == ([0, 10**9], False)
    np.testing.assert_array_equal(frames.position, motion.position)
    blank = [f",,{row.partition(',')[2].partition(',')[2]}" for row in rows]
    path.write_text("\n".join([f"timestamp,timestamp_by_camera,body_{head.replace(',', ',body_')}", *blank]))
    frames = reader.read_joints(path, unit="mm", axes=None)
    assert (frames.joints, frames.timed) == (
        ("nose", "left_shoulder", "left_mouth", "right_hip", "body_body_com"),
        False,
    )
    np.testing.assert_array_equal(frames.position, motion.position)
    kinds = ("a_body,3d_xyz", "a_body,rigid_3d_xyz", "a_face,3d_xyz")
    tidy = [f"{t},,{kind},left_{j},{t},2,7" for t in (0, 1) for kind in kinds for j in ("hip", "knee")]
    path.write_text("\n".join(["frame,timestamp,model,trajectory,keypoint,x,y,z", *tidy]))
    frames = reader.read_joints(path, unit=None, axes=None)
    assert (frames.joints, frames.timed, frames.t_ns.tolist()) == (
        ("left_hip", "left_knee"),
        False,
        [0, 10**9],
    )
    np.testing.assert_allclose(frames.position[1, 0], [[0.001, 0.002, 0.007]] * 2)


@pytest.mark.parametrize(
    ("tracker", "numbered"),
    [
        ("POSE", {0: "nose", 24: "right_hip", 31: "left_big_toe"}),
        ("SIMPLE_HOLISTIC", {11: "left_shoulder", 100: "right_wrist", 101: None, 504: None}),
        ("RTMPose-m Halpe26", {0: "nose", 19: "hip", 20: "left_big_toe"}),
    ],
)
def test_numbered_points_of_caliscope(tmp_path: Path, tracker: str, numbered: dict[int, str | None]) -> None:
    rows = [f"{frame},{point},{point},{frame},2,\n" for frame in (3, 4) for point in numbered]
    path = tmp_path / f"xyz_{tracker}.csv"
    path.write_text("sync_index,point_id,x_coord,y_coord,z_coord,frame_time\n" + "".join(rows))
    assert [each.name for each in FORMATS.all() if each.recognises(path)] == ["joints_csv"]
    motion = read(path)
    assert (motion.joints, motion.timed) == (tuple(filter(None, numbered.values())), False)
    assert motion.t_ns.tolist() == [3 * 10**9, 4 * 10**9]
    assert motion.position[1, 0, 0].tolist() == [min(numbered), 4, 2]
    path.write_text(path.read_text().replace("sync", " Sync").replace("coord", "coord (mm)"))
    np.testing.assert_allclose(read(path).position, motion.position / 1000)
    unknown = path.rename(tmp_path / "xyz_CHARUCO.csv")
    with refused("no-such-name", unknown, "xyz_CHARUCO_labelled.csv"):
        read(unknown)
    np.save(tmp_path / "skeleton_3d.npy", np.zeros((4, 33, 3)))
    with refused("wrong-kind", tmp_path / "skeleton_3d.npy", "NumPy"):
        recognise(tmp_path / "skeleton_3d.npy", JointFormat, "joint file")


def moving(t_ns: np.ndarray) -> JointMotion:
    """Make a point that moves at 1 m/s along x."""
    position = np.zeros((len(t_ns), 1, 1, 3))
    position[:, 0, 0, 0] = (t_ns - START_NS) / 1e9
    return JointMotion(t_ns, ("nose",), position)


def test_stamps_of_whole_milliseconds_are_kept_with_a_note() -> None:
    exact = np.arange(301) * 1e9 / 30
    t_ns = START_NS + np.rint(exact / 1e6).astype(np.int64) * 1_000_000
    listener = Listener()
    even = at_even_times("x", moving(t_ns), listener)
    assert even.rate_hz == pytest.approx(30, rel=1e-9)
    np.testing.assert_array_equal(even.motion.position, moving(t_ns).position)
    assert np.abs(even.motion.t_ns - START_NS - exact).max() <= 1
    assert len(listener.notes) == 1
    assert "0.333 ms" in listener.notes[0]


def test_uneven_stamps_are_interpolated_never_beside_a_missing_one() -> None:
    t_ns = START_NS + np.array([0, 30, 70, 100, 130, 170, 200]) * 1_000_000
    motion = moving(t_ns)
    motion.position[3] = np.nan
    listener = Listener()
    even = at_even_times("x", motion, listener)
    assert even.rate_hz == pytest.approx(30)
    x = even.motion.position[:, 0, 0, 0]
    missing = [3]  # at 100 ms exactly; `beside` finds the frames between two samples, one of them missing
    expected = np.arange(7) / 30
    known = np.isfinite(x)
    np.testing.assert_allclose(x[known], expected[known], atol=1e-9)
    assert np.flatnonzero(~known).tolist() == sorted({*missing, *(k for k in range(7) if beside(t_ns, k))})
    assert "30 Hz" in listener.notes[0]


def beside(t_ns: np.ndarray, frame: int) -> bool:
    """Return True if the missing sample is one of the two around a frame."""
    at = (t_ns[0] + t_ns[-1] * 0) + round(frame * 200_000_000 / 6)
    after = int(np.searchsorted(t_ns, at))
    return bool(t_ns[after] != at) and 3 in (after - 1, after)
