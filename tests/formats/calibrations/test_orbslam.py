"""ORB-SLAM's settings: a real file of version 2, and files of the versions by their public descriptions."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.formats.calibrations import calibration_files
from pipelines.geometry.cameras import project
from pipelines.session.errors import DataError
from pipelines.session.recognition import recognise
from pipelines.session.registries import CalibrationFormat
from tests.real_data import real_data

READER: CalibrationFormat = calibration_files.ORBSLAM

# After Examples/Stereo-Inertial/TUM-VI.yaml and Examples/Stereo/EuRoC.yaml of ORB-SLAM 3, with other numbers.
FISHEYE = Path(__file__).with_name("orbslam_fisheye.yaml").read_text(encoding="utf-8")


def write(folder: Path, text: str) -> Path:
    path = folder / "settings.yaml"
    path.write_text(text)
    return path


def test_the_real_file_projects_as_opencv_does() -> None:
    path = real_data("second/orbslam_aircap_basler.yaml")
    assert recognise(path, CalibrationFormat, "calibration") is READER
    stated = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    fx, fy, cx, cy, k1, k2, p1, p2 = (
        stated.getNode(f"Camera.{key}").real() for key in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    )
    [camera] = READER.read_calibration(path).values()
    lens = camera.intrinsics
    assert lens is not None
    assert (lens.width, lens.height, camera.size_stated) == (2040, 1086, True)
    points = np.array([[0.1, 0.2, 2.0], [-0.5, 0.3, 2.5]])
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array([k1, k2, p1, p2]))
    np.testing.assert_allclose(project(points, lens), expected[:, 0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("KannalaBrandt8", "Rectified", "Rectified"),
        ("Camera1.fy: 190.25", "Camera1.fy: 0", "190.5"),
        ("Camera.height: 510", "", "512"),
    ],
)
def test_faulty_settings_are_refused(tmp_path: Path, old: str, new: str, word: str) -> None:
    assert old in FISHEYE
    with pytest.raises(DataError, match=word):
        READER.read_calibration(write(tmp_path, FISHEYE.replace(old, new)))
