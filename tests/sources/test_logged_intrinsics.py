"""Camera infos of a log: those that are not calibrated, that change, and that are binned."""

from pathlib import Path

import pytest

from pipelines.geometry.arrays import Intrinsics
from pipelines.session.errors import DataError
from pipelines.session.manifest import Manifest
from pipelines.sources.logs import FlightLogs
from tests.synthetic.logs import Entry, write_log


def read(folder: Path, focal_px: list[float], binning: int = 0) -> tuple[Intrinsics, list[str]]:
    """Write a log of 640 x 480 px with these focal lengths, one a message; 0 is not calibrated."""
    entries = []
    for k, f in enumerate(focal_px):
        matrix = [f, 0.0, 319.5, 0.0, f, 239.5, 0.0, 0.0, 1.0] if f else [0.0] * 9
        fields = {
            "header": {"stamp": k + 1, "frame_id": "c"},
            "width": 640 * max(binning, 1),
            "height": 480 * max(binning, 1),
            "distortion_model": "none",
            "K": matrix,
            "binning_x": binning,
            "binning_y": binning,
        }
        entries.append(Entry("/camera_info", "sensor_msgs/msg/CameraInfo", k + 1, fields))
    log = write_log(folder, "log", "ros1", entries)
    stated = {"schema": 1, "cameras": {"c": {"pose": "x", "intrinsics": log.name, "keypoints": "y"}}}
    notes: list[str] = []
    with FlightLogs(Manifest.model_validate(stated), folder, notes.append) as logs:
        return logs.intrinsics(log.name, "/camera_info"), notes


@pytest.mark.parametrize("zeros", [0, 1, 5])
def test_messages_before_the_calibration_are_left_out(tmp_path: Path, zeros: int) -> None:
    lens, notes = read(tmp_path, [0.0] * zeros + [500.0] * 3)
    assert lens == Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)
    assert notes == []


@pytest.mark.parametrize("focal_px", [[0.0, 0.0], [500.0, 0.0, 510.0]])
def test_no_calibration_and_two_are_refused(tmp_path: Path, focal_px: list[float]) -> None:
    with pytest.raises(DataError) as caught:
        read(tmp_path, focal_px)
    assert caught.value.code == "no-intrinsics"


@pytest.mark.parametrize("binning", [2, 4])
def test_a_binned_calibration_is_noted(tmp_path: Path, binning: int) -> None:
    lens, notes = read(tmp_path, [500.0] * 2, binning)
    assert lens == Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5)
    assert ["640 x 480" in note for note in notes] == [True]
