"""Stage `detect` on a span of the flight, called as the stages above call it."""

from pathlib import Path

import pandas as pd
import pytest

from pipelines.detect import detect
from pipelines.formats.videos.video import VideoReader
from pipelines.ingest import ingest
from pipelines.session.errors import DataError
from pipelines.session.stages import StageRecord, locked
from tests.commands.runner import ingested, mocap, refused
from tests.keypoints.spotted_flights import CAMERAS, FPS, spot_detector, write_spotted_flight
from tests.synthetic.flights import write_flight


def test_only_the_pictures_of_the_span_are_looked_at(tmp_path: Path) -> None:
    session = tmp_path / "flight.session"
    ingest(write_spotted_flight(tmp_path, 40), session)
    detector = spot_detector(tmp_path)

    def run(start_s: float | None, end_s: float | None, every: int = 1) -> StageRecord:
        with locked(session) as writable:
            record = detect(writable, detector=detector, start_s=start_s, end_s=end_s, every=every)
        assert record is not None
        return record

    def frames(camera: str) -> list[int]:
        table = pd.read_parquet(session / "detect" / camera / "keypoints.parquet")
        return sorted({int(frame) for frame in table["frame"]})

    # Frame k is at k / 30 s: from the 10th on, and before the 20th.
    record = run(10 / FPS, 20 / FPS)
    assert all(frames(camera) == list(range(10, 20)) for camera in CAMERAS)
    assert record.counts["rows"] == {name: [10, 20] for name in CAMERAS}
    assert record.counts["cameras"]["left"]["frames"] == 10
    # Every fourth of the flight, not of the span: the same pictures as without one.
    record = run(10 / FPS, None, every=4)
    assert frames("left") == [12, 16, 20, 24, 28, 32, 36]
    assert record.counts["rows"]["left"] == [12, 40]
    assert run(None, 20 / FPS).key != run(None, None).key
    with pytest.raises(DataError, match="no picture lies in the flight from 9 s on"):
        run(9.0, None)


def test_pictures_that_cannot_be_decoded_are_spoken_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = tmp_path / "flight.session"
    ingest(write_spotted_flight(tmp_path, 6), session)
    detector, read = spot_detector(tmp_path), VideoReader.read
    damaged = {2, 3}
    monkeypatch.setattr(
        VideoReader, "read", lambda self, number: None if number in damaged else read(self, number)
    )
    with locked(session) as writable:
        record = detect(writable, detector=detector)
    assert record is not None
    assert record.warnings == [f"{name}: 2 of 6 pictures cannot be decoded" for name in CAMERAS]
    damaged |= set(range(6))
    with locked(session) as writable, pytest.raises(DataError, match="12 of 12 cannot be decoded"):
        detect(writable, detector=detector, force=True)


def test_a_span_without_pictures_to_look_at_is_refused(tmp_path: Path) -> None:
    flight = write_flight(tmp_path)
    session = ingested(flight)
    assert "--pictures" in refused("reconstruct", session, "--method", "robust", "--pictures", "1:")
    done = mocap("reconstruct", session, "--method", "robust", "--pictures", "::3")
    assert done.returncode == 0
    assert "--pictures" in done.stderr
