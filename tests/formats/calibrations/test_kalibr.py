"""Kalibr camera chains: a real one, and faulty ones."""

from pathlib import Path

import pytest

from pipelines.formats.calibrations import calibration_files
from pipelines.session.errors import DataError
from pipelines.session.registries import FORMATS, CalibrationFormat
from tests.real_data import real_data

READER: CalibrationFormat = calibration_files.KALIBR
CAMERA = {
    "camera_model": "pinhole",
    "intrinsics": "[460.0, 458.5, 366.25, 248.5]",
    "distortion_model": "radtan",
    "distortion_coeffs": "[-0.28, 0.07, 0.0002, -0.0003]",
    "resolution": "[752, 480]",
    "T_cam_imu": "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]",
    "rostopic": "/cam0/image_raw",
}


def chain(path: Path, **keys: str | None) -> Path:
    """Write a chain of one camera with some keys changed; None leaves one out."""
    lines = [f"  {key}: {value}" for key, value in {**CAMERA, **keys}.items() if value is not None]
    path.write_text("\n".join(["cam0:", *lines, ""]))
    return path


def test_a_real_chain() -> None:
    path = real_data("calib/kalibr_euroc_voxblox_T_cam_imu.yaml")
    assert [format_.name for format_ in FORMATS.all() if format_.recognises(path)] == ["kalibr"]
    cameras = READER.read_calibration(path)
    assert list(cameras) == ["cam0", "cam1"]
    lens = cameras["cam1"].intrinsics
    assert lens is not None
    assert (lens.width, lens.height, lens.model) == (752, 480, "fisheye")
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (
        459.6820431465863,
        458.37659300282706,
        380.01198798196646,
        255.55347731935623,
    )
    assert lens.distortion[3] == -0.010717188529046507
    assert cameras["cam0"].position is None, "T_cam_imu is no pose in the world"
    assert "752 x 480 px" in str(READER.describe(path)["cam0"])


@pytest.mark.parametrize(
    "keys",
    [
        {"camera_model": "omni"},
        {"distortion_model": "[1]"},
        {"intrinsics": "[460, true, 366, 248]"},
        {"distortion_coeffs": "[.nan, 0, 0, 0]"},
        {"rostopic": "[1, 2"},
        {"rostopic": "x" * (1 << 20)},
    ],
)
def test_faulty_content_is_refused(tmp_path: Path, keys: dict[str, str | None]) -> None:
    with pytest.raises(DataError) as caught:
        READER.read_calibration(chain(tmp_path / "c.yaml", **keys))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


def test_the_offset_of_its_clock_is_named(tmp_path: Path) -> None:
    cameras = READER.read_calibration(chain(tmp_path / "chain.yaml", timeshift_cam_imu="0.0123"))
    assert all("0.0123 s" in camera.note for camera in cameras.values())
