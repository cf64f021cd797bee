"""Ingest: it opens each log once, needs bounded memory, and takes sizes from the pictures."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.formats.logs.recordings import OpenLog
from pipelines.formats.logs.trajectories import LogFile
from pipelines.geometry.cameras import camera_matrix
from pipelines.ingest import ingest
from pipelines.session.description import read_description
from pipelines.session.errors import DataError
from pipelines.session.manifest import read_flight
from pipelines.sources.logs import FlightLogs
from tests.commands.runner import ingested as session_of
from tests.commands.runner import refused
from tests.synthetic.flights import LENS, write_flight
from tests.synthetic.logged_flights import write_logged_flight
from tests.synthetic.logs import Entry, write_log
from tests.synthetic.recorder_logs import CONTAINERS, RECORDER, in_a_process, ingested, timed, write


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[OpenLog]:
    """Record the MCAP logs that are opened."""
    logs: list[OpenLog] = []
    open_log = LogFile.open_log

    def remembered(self: LogFile, paths: Sequence[Path]) -> OpenLog:
        logs.append(open_log(self, paths))
        return logs[-1]

    monkeypatch.setattr(LogFile, "open_log", remembered)
    return logs


def all_closed(logs: list[OpenLog]) -> bool:
    return all(part.file.closed for log in logs for part in log.parts)  # type: ignore[attr-defined]


def test_each_log_is_opened_once(tmp_path: Path, opened: list[OpenLog]) -> None:
    flight = write_logged_flight(tmp_path, "mcap-cdr")
    flight.settings["actor"] = {"file": flight.settings["cameras"]["drone1"]["pose"]["file"]}
    flight.settings["actor"]["topic"] = "/drone1/odometry"
    flight.save()
    ingest(flight.manifest)
    assert len(opened) == 2
    assert all_closed(opened)


def test_nothing_is_opened_where_nothing_changed(tmp_path: Path, opened: list[OpenLog]) -> None:
    flight = write_logged_flight(tmp_path, "mcap-cdr")
    ingest(flight.manifest)
    opened.clear()
    assert ingest(flight.manifest).skipped
    assert not opened


def test_logs_are_closed_after_a_fault(tmp_path: Path, opened: list[OpenLog]) -> None:
    flight = write_logged_flight(tmp_path, "mcap-cdr")
    flight.settings["cameras"]["drone2"]["pose"]["topic"] = "/nothing"
    flight.save()
    with pytest.raises(DataError, match=r"topic /nothing; .*/drone"):
        ingest(flight.manifest)
    assert opened
    assert all_closed(opened)
    assert not flight.manifest.with_suffix(".session").exists()


def test_losses_count_for_the_topic_that_lost_them(tmp_path: Path) -> None:
    """Check that losses of one topic are not counted for the next, although the log stays open."""
    flight = write_logged_flight(tmp_path, "ros1")
    stamp_ns = 1_700_000_000_000_000_000
    header = {"stamp": stamp_ns}
    pose = {"header": header, "pose": {"orientation": {"w": 1.0}}}
    picture = {"header": header, "data": np.array([255, 216, 255], np.uint8)}
    path = write_log(
        tmp_path,
        "lost",
        "ros1",
        [
            Entry("/pose", "geometry_msgs/msg/PoseStamped", stamp_ns, pose),
            Entry("/picture", "sensor_msgs/msg/CompressedImage", stamp_ns, picture),
        ],
    )
    whole = path.read_bytes()
    # The stated length of the picture's data is twice the real one.
    broken = whole.replace(b"\x03\0\0\0\xff\xd8\xff", b"\x06\0\0\0\xff\xd8\xff")
    assert broken != whole
    path.write_bytes(broken)
    with FlightLogs(read_flight(flight.manifest), tmp_path, lambda _: None) as logs:
        for _ in range(2):
            with pytest.raises(DataError, match=r"/picture .*topic"):
                logs.frames(path.name, "/picture")
            trajectory = logs.trajectory(path.name, "/pose", None, None, max_gap_ns=10**9)
            assert trajectory.dropped == {}


@pytest.mark.slow
@pytest.mark.parametrize("container", CONTAINERS)
def test_memory_is_bounded(tmp_path: Path, container: str) -> None:
    """Check that 60 MB more of pictures, which ingest does not keep, cost less than a quarter of that."""
    tiny, small, large = (
        write(tmp_path / str(megabytes), container, RECORDER, 200_000, megabytes) for megabytes in (1, 20, 80)
    )
    peaks = [in_a_process(timed, ingested, tiny, log)["peak_mb"] for log in (small, large)]
    assert max(peaks) < 400
    assert peaks[1] - peaks[0] < 15


SIZE = [LENS.width, LENS.height]


def _store(path: Path, matrix: np.ndarray) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", matrix)
    storage.write("distortion_coefficients", np.array([LENS.distortion or [0.0] * 5]))
    storage.release()


def test_a_calibration_without_a_size_takes_that_of_the_pictures(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, clean=True, seconds=0.2)
    camera = flight.settings["cameras"]["drone1"]
    _store(tmp_path / "camera.yaml", camera_matrix(LENS))
    camera["intrinsics"] = {"file": "camera.yaml"}
    flight.save()
    refused("ingest", flight.manifest)  # neither the calibration nor the keypoints have a size
    camera["keypoints"]["image_size"] = SIZE
    flight.save()
    session = session_of(flight)
    lenses = [read_description(session).cameras[name].intrinsics for name in ("drone1", "drone2")]
    assert (lenses[0].width, lenses[0].height, lenses[0].fx) == (*SIZE, LENS.fx)
    assert lenses[1].width == lenses[0].width

    half = np.diag([0.5, 0.5, 1.0]) @ camera_matrix(LENS)  # of pictures half as large
    _store(tmp_path / "camera.yaml", half)
    assert f"{SIZE[0]} x {SIZE[1]}" in refused("ingest", flight.manifest, "--overwrite")
