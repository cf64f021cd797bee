"""ROS camera calibrations: real files of both forms, and faulty ones."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.formats.calibrations import calibration_files
from pipelines.geometry.arrays import Intrinsics
from pipelines.geometry.cameras import project
from pipelines.session.registries import FORMATS, CalibrationFormat
from tests.raising import refused
from tests.real_data import real_data

READER: CalibrationFormat = calibration_files.CAMERA_INFO
MATRIX = np.array([[800.0, 0, 330.5], [0, 790.0, 241.25], [0, 0, 1]])
POINTS = np.array([[0.1, 0.2, 2.0], [-0.5, 0.3, 2.5]])

KEYS = {
    "image_width": "640",
    "image_height": "480",
    "camera_name": "left",
    "camera_matrix": "{rows: 3, cols: 3, data: [800, 0, 330.5, 0, 790, 241.25, 0, 0, 1]}",
    "distortion_model": "plumb_bob",
    "distortion_coefficients": "{rows: 1, cols: 5, data: [-0.21, 0.08, 0.001, -0.002, 0.01]}",
    "rectification_matrix": "{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}",
}
INI = """# Camera intrinsics
[image]
width
640
height
480
[left]
camera matrix
800.0 0.0 330.5
0.0 790.0 241.25
0.0 0.0 1.0
distortion
-0.21 0.08 0.001 -0.002 0.01
rectification
1 0 0
0 1 0
0 0 1
"""


def stored(path: Path, **keys: str | None) -> Path:
    """Write a calibration with some keys changed; None leaves one out."""
    lines = [f"{key}: {value}" for key, value in {**KEYS, **keys}.items() if value is not None]
    path.write_text("\n".join([*lines, ""]))
    return path


def only(path: Path, name: str) -> Intrinsics:
    cameras = READER.read_calibration(path)
    assert list(cameras) == [name]
    assert cameras[name].position is None
    lens = cameras[name].intrinsics
    assert lens is not None
    return lens


def test_the_real_yaml() -> None:
    path = real_data("calib/ros_camera_info_manager_test.yaml")
    assert [format_.name for format_ in FORMATS.all() if format_.recognises(path)] == ["camera_info"]
    assert only(path, "08144361026320a0") == Intrinsics(
        640, 480, 1168.68, 1169.01, 295.015, 252.247, "radtan", (-1.04482, 1.59252, -0.0196308, 0.0287906, 0)
    )
    assert "640 x 480 px" in str(READER.describe(path))


def test_the_real_ini() -> None:
    path = real_data("calib/ros_calib5.ini")
    assert [format_.name for format_ in FORMATS.all() if format_.recognises(path)] == ["camera_info"]
    assert only(path, "mono_left") == Intrinsics(
        640,
        480,
        369.344588,
        367.154330,
        320.739078,
        203.592450,
        "radtan",
        (0.189544, -0.018229, -0.000630, 0.000054, -0.000212),
    )


@pytest.mark.parametrize("suffix", [".yaml", ".yml", ".ini", ".txt"])
def test_both_forms_project_as_opencv_does(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"ost{suffix}"
    stored(path) if suffix.startswith(".y") else path.write_text(INI)
    assert [format_.name for format_ in FORMATS.all() if format_.recognises(path)] == ["camera_info"]
    coefficients = np.array([-0.21, 0.08, 0.001, -0.002, 0.01])
    expected, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), MATRIX, coefficients)
    np.testing.assert_allclose(project(POINTS, only(path, "left")), expected[:, 0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("code", "keys"),
    [
        ("data", {"distortion_model": "ftheta"}),
        ("missing-column", {"image_width": None}),
        ("bad-value", {"image_width": "wide"}),
        ("damaged", {"image_width": "0"}),
        ("damaged", {"camera_matrix": "{rows: 3, cols: 3, data: [1, 2, 3]}"}),
        ("damaged", {"distortion_coefficients": "{rows: true, cols: 5, data: [0, 0, 0, 0, 0]}"}),
        ("data", {"camera_matrix": "{rows: 3, cols: 3, data: [0, 0, 0, 0, 0, 0, 0, 0, 0]}"}),
        ("damaged", {"distortion_coefficients": "{rows: 900000000000, cols: 5, data: [0, 0, 0, 0, 0]}"}),
    ],
)
def test_faulty_content_is_refused(tmp_path: Path, code: str, keys: dict[str, str | None]) -> None:
    path = stored(tmp_path / "c.yaml", **keys)
    with refused(code, path):
        READER.read_calibration(path)
