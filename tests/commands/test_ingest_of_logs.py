"""Ingest of logs: it opens each log once, always closes it, and needs no more memory for a longer one."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.logs.mcap_log import McapLog
from pipelines.formats.logs.recordings import OpenLog
from pipelines.ingest import ingest
from pipelines.session.errors import DataError
from pipelines.session.manifest import read_flight
from pipelines.session.records import Trajectory
from pipelines.sources.logs import FlightLogs
from pipelines.sources.world import doubts_of_stillness
from tests.synthetic.logged_flights import write_logged_flight
from tests.synthetic.logs import Entry, write_log
from tests.synthetic.recorder_logs import CONTAINERS, RECORDER, in_a_process, ingested, timed, write


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[OpenLog]:
    """Record the MCAP logs that are opened."""
    logs: list[OpenLog] = []
    open_log = McapLog.open_log

    def remembered(self: McapLog, paths: Sequence[Path]) -> OpenLog:
        logs.append(open_log(self, paths))
        return logs[-1]

    monkeypatch.setattr(McapLog, "open_log", remembered)
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


def test_a_frozen_estimator_is_distinguished_from_a_camera_at_rest() -> None:
    """Use 100 Hz for ten seconds; x stands still from 2 to 4.5 s and, too short to count, from 6 to 6.9 s."""
    k = np.arange(1000)
    x = np.where(k < 200, k, np.where(k < 451, 200, np.where(k < 600, k, np.where(k < 691, 600, k)))) / 100.0
    position = np.stack([x, np.zeros(1000), np.full(1000, 5.0)], axis=1)
    turn = np.tile([0.0, 0.0, 0.0, 1.0], (1000, 1))
    t_ns = 1_700_000_000_000_000_000 + 10_000_000 * k
    (doubt,) = doubts_of_stillness(Trajectory(t_ns, position, turn))
    assert re.search(r" 1 .* 2\.5 s \(251 .* 2\.00 s\)", doubt)
    turning = turn + np.stack([k * 1e-9, 0 * k, 0 * k, 0 * k], axis=1)  # a gimbal turns on
    assert doubts_of_stillness(Trajectory(t_ns, position, turning)) == []
    assert doubts_of_stillness(Trajectory(t_ns, np.ones((1000, 3)), turn)) == []  # at rest throughout
    assert doubts_of_stillness(Trajectory(t_ns[::99], position[::99], turn[::99])) == []  # three messages


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
