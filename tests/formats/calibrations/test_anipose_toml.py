"""Calibrations of anipose, Pose2Sim and caliscope, on real files and against OpenCV's projection."""

import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.formats.calibrations import calibration_files
from pipelines.geometry.cameras import project
from pipelines.session.errors import DataError
from pipelines.session.registries import CalibrationFormat
from tests.real_data import real_data

READER: CalibrationFormat = calibration_files.ANIPOSE
POSE2SIM = "pose2sim_single/calibration/Calib_qualisys.toml"
TODAY = "second/caliscope_4cam_camera_array.toml"

CAMERA = """
[one]
size = [640, 480]
matrix = [[500, 0, 320], [0, 501, 240], [0, 0, 1]]
distortions = [0.1, 0, 0, 0, 0]
rotation = [0.0, 0.0, 1.5707963267948966]
translation = [1, 2, 3]
"""

AIRSIM = """{"SettingsVersion": 1.2, "SimMode": "Multirotor",
 "CameraDefaults": {"CaptureSettings": [{"ImageType": 5, "Width": 9}, {"ImageType": 0, "FOV_Degrees": 120}]},
 "Vehicles": {"D1": {"Cameras": {"front": {"CaptureSettings":
  [{"Width": 640, "Height": 480, "FOV_Degrees": 90}],
  "X": 0.5, "Y": 0.25, "Z": 0.125, "Pitch": -15}}}}}"""


def write(folder: Path, text: str) -> Path:
    path = folder / "calib.toml"
    path.write_text(text)
    return path


def _vector(rotation: list[object]) -> np.ndarray:
    """Return a rotation as Rodrigues' vector; today's caliscope writes a matrix."""
    stated = np.array(rotation, dtype=np.float64)
    return stated if stated.size == 3 else cv2.Rodrigues(stated)[0]


@pytest.mark.parametrize(
    "relative", [POSE2SIM, "calib/pose2sim_Calib_scene.toml", "calib/caliscope_base_config.toml", TODAY]
)
def test_real_cameras_project_as_opencv_does(relative: str) -> None:
    path = real_data(relative)
    assert READER.recognises(path)
    cameras = READER.read_calibration(path)
    assert len(cameras) == 4
    content = tomllib.loads(path.read_text())
    content |= {f"cam_{key}": table for key, table in content.get("cameras", {}).items()}
    tables = {t.get("name", k): t for k, t in content.items() if isinstance(t, dict)}
    # Points half a metre around one two metres ahead of the camera: all well inside the picture.
    ahead = np.array([[0, 0, 2.0], [0.5, -0.4, 2.0], [-0.3, 0.5, 2.5], [0.1, 0.2, 3.0]])
    for name, camera in cameras.items():
        assert camera.intrinsics is not None
        assert camera.position is not None
        assert camera.quaternion_xyzw is not None
        table = tables[name]
        world_from_camera = Rotation.from_quat(camera.quaternion_xyzw)
        world = world_from_camera.apply(ahead) + camera.position
        expected, _ = cv2.projectPoints(
            world,
            _vector(table["rotation"]),
            np.array(table["translation"]),
            np.array(table["matrix"]),
            np.array(table["distortions"]),
        )
        # Both compute in float64; pixels are of order 1e3.
        np.testing.assert_allclose(project(ahead, camera.intrinsics), expected[:, 0], rtol=0, atol=1e-9)


def test_uncalibrated_and_ignored_cameras_are_left_out() -> None:
    path = real_data("calib/caliscope_base_config.toml")
    assert list(READER.read_calibration(path)) == ["cam_1", "cam_2", "cam_3", "cam_4"]
    summary = READER.describe(path)
    assert summary["cameras"] == 4


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("[0, 0, 1]]", "[0, 0, 1]"),
        ("[[500,", "[[nan,"),
        ("[640, 480]", "[640]"),
        ("distortions", "distortion"),
        ("translation = [1, 2, 3]", "translation = [1, 2]"),
        ("[one]", "[other]\nname = 'one'\nsize=1\nmatrix=1\n[one]"),
    ],
)
def test_faulty_content_is_refused(tmp_path: Path, old: str, new: str) -> None:
    assert old in CAMERA
    with pytest.raises(DataError):
        READER.read_calibration(write(tmp_path, CAMERA.replace(old, new, 1)))


def test_settings_of_airsim_give_lenses_by_their_field_of_view(tmp_path: Path) -> None:
    path = tmp_path / "settings.json"
    path.write_text(AIRSIM, encoding="utf-8")
    cameras = calibration_files.AIRSIM.read_calibration(path)
    for name, width, height, focal_px in ("D1/front", 640, 480, 320), ("CameraDefaults", 256, 144, 73.9008):
        lens = cameras[name].intrinsics
        assert lens is not None
        found = lens.width, lens.height, 2 * lens.cx + 1, 2 * lens.cy + 1, lens.fx, lens.fy
        assert found == pytest.approx((width, height, width, height, focal_px, focal_px), rel=1e-6)
    assert "down_deg: 15, translation: [0.5, -0.25, -0.125]" in cameras["D1/front"].note
