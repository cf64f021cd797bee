"""OpenCV FileStorage calibrations, written by OpenCV itself."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.formats.calibrations import calibration_files
from pipelines.geometry.cameras import project
from pipelines.session.errors import DataError
from pipelines.session.recognition import recognise
from pipelines.session.records import CalibratedCamera
from pipelines.session.registries import CalibrationFormat

READER: CalibrationFormat = calibration_files.OPENCV
K = np.array([[800.0, 0, 330.5], [0, 790.0, 241.25], [0, 0, 1]])
D = np.array([[-0.21, 0.08, 0.001, -0.002, 0.01]])


def store(path: Path, **values: object) -> Path:
    """Write a calibration as OpenCV's own tools do; None leaves a key out."""
    content: dict[str, object] = {
        "calibration_time": "now",
        "image_width": 640,
        "image_height": 480,
        "camera_matrix": K,
        "distortion_coefficients": D,
        **values,
    }
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in content.items():
        if value is not None:
            storage.write(key, value)
    storage.release()
    return path


def only(path: Path) -> CalibratedCamera:
    cameras = READER.read_calibration(path)
    assert list(cameras) == ["camera"]
    return cameras["camera"]


@pytest.mark.parametrize("suffix", [".yaml", ".yml", ".xml"])
def test_it_projects_as_opencv_does(tmp_path: Path, suffix: str) -> None:
    path = store(tmp_path / f"calib{suffix}")
    assert READER.recognises(path)
    camera = only(path)
    assert camera.position is None
    assert camera.intrinsics is not None
    assert (camera.intrinsics.width, camera.intrinsics.height) == (640, 480)
    points = np.array([[0.1, 0.2, 2.0], [-0.5, 0.3, 2.5]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)
    np.testing.assert_allclose(project(points, camera.intrinsics), expected[:, 0], rtol=0, atol=1e-9)
    assert "640 x 480 px" in str(READER.describe(path)["camera"])


@pytest.mark.parametrize("as_vector", [True, False])
def test_pose(tmp_path: Path, as_vector: bool) -> None:
    rvec, tvec = np.array([[0.3], [-0.8], [1.1]]), np.array([[0.5], [-1.5], [4.0]])
    matrix = cv2.Rodrigues(rvec)[0]
    given = {"rvec": rvec, "tvec": tvec} if as_vector else {"R": matrix, "T": tvec}
    camera = only(store(tmp_path / "c.yml", **given))
    assert camera.position is not None
    np.testing.assert_allclose(camera.position, (-matrix.T @ tvec).ravel(), atol=1e-12)


@pytest.mark.parametrize(
    "values",
    [
        {"image_width": None},
        {"camera_matrix": 3.0},
        {"camera_matrix": np.eye(2)},
        {"camera_matrix": np.zeros((3, 3))},
        {"R": 2 * np.eye(3), "T": np.zeros((3, 1))},
        {"fisheye_model": 1},
    ],
)
def test_faulty_content_is_refused(tmp_path: Path, values: dict[str, object]) -> None:
    with pytest.raises(DataError):
        READER.read_calibration(store(tmp_path / "c.yml", **values))


EASYMOCAP_MATRIX, EASYMOCAP_PLACE = (
    np.array([[900.0, 0, 640], [0, 901, 360], [0, 0, 1]]),
    [[0.1], [0.2], [3.0]],
)
EASYMOCAP_TURNS = {f"0{k}": np.array([[0.1 * k], [-0.2], [0.3]]) for k in (1, 2)}


def write_easymocap(folder: Path) -> None:
    for name in ("intri", "extri"):
        storage = cv2.FileStorage(str(folder / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
        storage.startWriteStruct("names", cv2.FileNode_SEQ)
        for camera in EASYMOCAP_TURNS:
            storage.write("", camera)
        storage.endWriteStruct()
        for camera, turn in EASYMOCAP_TURNS.items():
            if name == "intri":
                storage.write(f"K_{camera}", EASYMOCAP_MATRIX)
                storage.write(f"dist_{camera}", np.zeros((5, 1)))
            else:
                storage.write(f"R_{camera}", turn)
                storage.write(f"Rot_{camera}", cv2.Rodrigues(turn)[0])
                storage.write(f"T_{camera}", np.array(EASYMOCAP_PLACE))
        storage.release()


def test_easymocap_has_its_poses_in_a_file_beside(tmp_path: Path) -> None:
    write_easymocap(tmp_path)
    for name in ("intri", "extri"):
        path = tmp_path / f"{name}.yml"
        assert recognise(path, CalibrationFormat, "calibration").name == "easymocap"
        cameras = recognise(path, CalibrationFormat, "calibration").read_calibration(path)
        assert list(cameras) == ["01", "02"]
        expected = -cv2.Rodrigues(EASYMOCAP_TURNS["02"])[0].T @ EASYMOCAP_PLACE
        assert cameras["02"].position is not None
        np.testing.assert_allclose(cameras["02"].position, expected[:, 0], atol=1e-12)
        lens = cameras["02"].intrinsics
        assert lens is not None
        assert (lens.fx, lens.cy, cameras["02"].size_stated) == (900.0, 360.0, False)
