"""Long flights are reconstructed in segments; here segments of two seconds stand for those of minutes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pipelines import report, segmented
from pipelines.attempt import Source
from pipelines.check import check
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.reconstruction import segments
from pipelines.reconstruction.observations import Camera
from pipelines.report import content_of
from pipelines.reporting.summary import summarise
from pipelines.session.camera_poses import poses_at
from pipelines.session.description import Doubt
from pipelines.session.errors import DataError, NoViewsError
from pipelines.session.progress import Silent
from pipelines.session.tables import Span, trajectory_from
from tests.commands.runner import refused, succeeds
from tests.synthetic.flights import SyntheticFlight, film_at, write_flight

TABLES = ("skeleton", "angles", "gait", "cameras")


@pytest.fixture
def short_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make segments of two seconds that overlap by one."""
    monkeypatch.setattr(segments, "LENGTH_S", 2.0)
    monkeypatch.setattr(segments, "OVERLAP_S", 1.0)
    monkeypatch.setattr(segments, "_BLENDED_NS", 600_000_000)


def ingested(flight: SyntheticFlight) -> Path:
    session = flight.manifest.with_suffix(".session")
    succeeds("ingest", flight.manifest, "-o", session)
    return session


def metrics_of(session: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((session / "reconstruct" / "metrics.json").read_text())
    return found


def files_of(session: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((session / "reconstruct").iterdir())}


def test_segments_give_the_flight_with_any_number_of_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short_segments: None
) -> None:
    flight = write_flight(tmp_path, cameras=3, seconds=6.0)
    session = ingested(flight)
    apart = tmp_path / "apart.session"
    shutil.copytree(session, apart)
    reconstruct(session, workers=1)
    reconstruct(apart, workers=2)
    assert files_of(session) == files_of(apart)
    divided = metrics_of(session)
    skeleton = pd.read_parquet(session / "reconstruct" / "skeleton.parquet")
    cameras = pd.read_parquet(session / "reconstruct" / "cameras.parquet")

    monkeypatch.setattr(segments, "LENGTH_S", 60.0)
    reconstruct(apart)
    whole = metrics_of(apart)
    assert len(divided["segments"]) == 3
    assert "segments" not in whole
    assert [list(skeleton[name]) for name in ("t_ns", "person", "joint")] == [
        list(pd.read_parquet(apart / "reconstruct" / "skeleton.parquet")[name])
        for name in ("t_ns", "person", "joint")
    ]
    assert len(cameras) == len(flight.t_ns) * 3
    assert divided["status_counts"]["all"] == whole["status_counts"]["all"]
    assert divided["joint_frames"] == whole["joint_frames"]
    # Constant errors of poses are estimated from a third of the pictures, the body's motion as before.
    assert divided["root_mpjpe_mm"] < 1.15 * whole["root_mpjpe_mm"]
    assert divided["mpjpe_mm"] < 1.5 * whole["mpjpe_mm"]
    # The figures are those of the joined skeleton, up to the stretches about two seams.
    apart_m = skeleton[["x", "y", "z"]].to_numpy().reshape(-1, 17, 3) - flight.position
    assert divided["mpjpe_mm"] == pytest.approx(1e3 * np.nanmean(np.linalg.norm(apart_m, axis=2)), rel=0.05)


def test_a_long_flight_goes_on_with_the_segments_that_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short_segments: None
) -> None:
    session = ingested(write_flight(tmp_path, seconds=6.0))
    done: list[int] = []
    work = segmented.reconstruct_segment

    def counted(order: Any) -> dict[str, bytes]:
        done.append(order.segment.number)
        return work(order)

    def killed(order: Any) -> dict[str, bytes]:
        if order.segment.number == 2:
            raise DataError("the power", "failed")
        return counted(order)

    monkeypatch.setattr(segmented, "reconstruct_segment", killed)
    with pytest.raises(DataError, match="failed"):
        reconstruct(session, ReconstructSettings(method="robust"), workers=1)
    monkeypatch.setattr(segmented, "reconstruct_segment", counted)
    reconstruct(session, ReconstructSettings(method="robust"), workers=1)
    assert done == [0, 1, 2]
    assert reconstruct(session, ReconstructSettings(method="robust"), workers=1).skipped


def test_the_person_stays_the_same_where_another_walks_through(tmp_path: Path, short_segments: None) -> None:
    flight = write_flight(tmp_path, cameras=3, seconds=4.0, bystander=True)
    session = ingested(flight)
    reconstruct(session, ReconstructSettings(method="robust", people=2), workers=1)
    skeleton = pd.read_parquet(session / "reconstruct" / "skeleton.parquet")
    assert len(skeleton) == 2 * len(flight.t_ns) * 17
    for person in range(2):
        own = skeleton[skeleton["person"] == person][["x", "y", "z"]].to_numpy().reshape(-1, 17, 3)
        middle = np.nanmedian(own, axis=1)
        # Steps of a walk are some centimetres; two people are metres apart.
        assert np.nanmax(np.linalg.norm(np.diff(middle, axis=0), axis=1)) < 0.5


def test_a_clock_is_that_of_the_whole_flight(tmp_path: Path, short_segments: None) -> None:
    flight = write_flight(tmp_path, cameras=3, seconds=4.0)
    # Stamped 130 ms too early, and nobody says so.
    flight.settings["cameras"]["drone2"]["clock"] = {"offset_s": -0.13, "sigma_s": 0.2}
    flight.save()
    session = ingested(flight)
    reconstruct(session, workers=1)
    metrics = metrics_of(session)
    assert metrics["clock_offsets_s"]["drone2"] == pytest.approx(0.13, abs=0.02)
    assert 0 < metrics["clock_offset_sigmas_s"]["drone2"] < 0.1
    assert "drone2" in metrics["method_used"]["clocks"]
    cameras = pd.read_parquet(session / "reconstruct" / "cameras.parquet")
    own = cameras[cameras["camera"] == "drone2"]["t_ns"].to_numpy()
    assert len(np.unique(own - flight.t_ns[: len(own)])) == 1


def test_segments_with_the_pictures_of_one_camera_are_open_and_said(
    tmp_path: Path, short_segments: None
) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=10.0, clean=True)
    film_at(flight, "drone2", flight.t_ns[:100])
    flight.save()
    session = ingested(flight)
    result = reconstruct(session, ReconstructSettings(method="robust"), workers=1)
    skeleton = pd.read_parquet(session / "reconstruct" / "skeleton.parquet")
    angles = pd.read_parquet(session / "reconstruct" / "angles.parquet")
    assert len(skeleton) == len(flight.t_ns) * 17
    assert np.array_equal(np.unique(angles["t_ns"]), flight.t_ns)
    late = skeleton[skeleton["t_ns"] > flight.t_ns[0] + 8_500_000_000]
    assert set(late["status"]) == {"few_views"}
    assert result.metrics["status_counts"]["all"] == len(skeleton)
    assert any("nothing could be reconstructed" in line for line in result.record.warnings)
    assert "one camera" in result.metrics["segments"][-1]["used"]


def test_a_doubted_long_flight_is_refused_when_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short_segments: None
) -> None:
    session = ingested(write_flight(tmp_path, seconds=4.5))
    monkeypatch.setattr(Source, "doubts", lambda *_: [a_doubt()])
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    assert "is doubted: it is late (clock)" in refused(
        "reconstruct", session, "--method", "robust", "--strict", "--workers", "1"
    )
    result = reconstruct(session, ReconstructSettings(method="robust"), workers=1, progress=Silent())
    assert [doubt["code"] for doubt in result.metrics["doubts"]] == ["clock"]


def test_a_long_flight_is_checked_in_segments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short_segments: None
) -> None:
    flight = write_flight(tmp_path, seconds=6.0)
    session = ingested(flight)
    spans = []

    def doubts_of(_folder: Path, _of: object, cameras: list[Camera], **_: object) -> list[Doubt]:
        spans.append(cameras[0].frame_t_ns[[0, -1]])
        code = "poses" if len(spans) == 1 else "clock"
        return [a_doubt().model_copy(update={"code": code})]

    monkeypatch.setattr("pipelines.check.doubts_of", doubts_of)
    checked = check(session)
    assert len(spans) == 3
    assert [np.ptp(span) > 5.9e9 for span in spans] == [False, True, False]  # with a second on either side
    assert (spans[0][0], spans[-1][1]) == (flight.t_ns[0], flight.t_ns[-1])
    assert [doubt.code for doubt in checked.doubts] == ["clock"]
    assert "1 of 3 segments" in checked.warnings[-1]
    monkeypatch.setattr(segments, "LENGTH_S", 60.0)
    check(session)
    assert len(spans) == 4


def test_a_long_flight_without_a_segment_that_two_cameras_see_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short_segments: None
) -> None:
    session = ingested(write_flight(tmp_path, seconds=6.0))
    spans = []

    def load_cameras(*_: object, span_ns: Span, **__: object) -> None:
        spans.append(span_ns)
        raise NoViewsError("the cameras", "have no pose at any picture", "check clocks and pose logs")

    monkeypatch.setattr("pipelines.check.load_cameras", load_cameras)
    with pytest.raises(NoViewsError):
        check(session)
    assert len(spans) == 3


def test_the_page_of_a_long_flight_is_drawn_from_some_of_its_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = write_flight(tmp_path, seconds=2.0)
    session = ingested(flight)
    reconstruct(session, ReconstructSettings(method="robust"), workers=1)
    whole = content_of(session)
    monkeypatch.setattr(report, "MAX_ROWS", 20 * 17)
    some = content_of(session)
    assert (whole.every, some.every) == (1, 3)
    assert whole.skeleton is not None
    assert some.skeleton is not None
    assert np.array_equal(np.unique(some.skeleton["t_ns"]), flight.t_ns[::3])
    shown = whole.skeleton["t_ns"].isin(flight.t_ns[::3])
    pd.testing.assert_frame_equal(some.skeleton, whole.skeleton[shown].reset_index(drop=True))
    assert summarise(some).counts == summarise(whole).counts
    for name in flight.cameras:
        frames = some.frames[name]["t_ns"].to_numpy()
        assert set(frames) == {*flight.t_ns[::3].tolist(), int(flight.t_ns[-1])}
        assert set(some.keypoints[name]["frame"]) <= set(some.frames[name]["frame"])
        assert len(some.poses[name]) < len(whole.poses[name]) / 2
        # A pose at one of these times lies between the same two logged ones.
        between = whole.session.pose_interpolation
        found = [poses_at(trajectory_from(of.poses[name]), flight.t_ns[::3], between) for of in (some, whole)]
        assert np.array_equal(found[0][0], found[1][0])
    succeeds("report", session)
    page = (session / "report" / "index.html").read_text(encoding="utf-8")
    assert "one in 3 of its times" in " ".join(page.split())


def a_doubt() -> Doubt:
    return Doubt(code="clock", cameras=["drone1"], what="it is late", evidence={}, remedy="mend it")
