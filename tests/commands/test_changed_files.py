"""Files changed since they were ingested or written: every stage notices, and one command repairs it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pipelines import detect
from pipelines.export import export, load_recording
from pipelines.film import film
from pipelines.formats.videos.video import VideoReader
from pipelines.ingest import ingest
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.session.errors import DataError
from pipelines.session.progress import Silent
from pipelines.session.stages import COMMANDS
from pipelines.session.storage import read_json
from tests.commands.runner import content, ingested, refused, result_of, succeeds
from tests.commands.test_overlay import filmed_flight
from tests.keypoints.spotted_flights import spot_detector, write_pictures, write_spotted_flight
from tests.synthetic.flights import write_flight

FRAMES = 12


def mirror(video: Path) -> None:
    """Replace a video by its mirror image with the same frames and times."""
    with VideoReader(video) as reader:
        pictures = [np.ascontiguousarray(picture[:, ::-1]) for _, picture in reader.frames()]
    write_pictures(video, pictures)


@pytest.fixture(scope="module")
def detected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ingest and reconstruct a flight of two cameras with only videos: flight.session."""
    folder = tmp_path_factory.mktemp("detected")
    manifest = write_spotted_flight(folder, FRAMES)
    detector = spot_detector(folder)
    succeeds("ingest", manifest)
    succeeds("reconstruct", folder / "flight.session", "--method", "robust", "--detector", detector)
    return folder


@pytest.fixture
def flight(detected: Path, tmp_path: Path) -> Path:
    """Copy the flight, with the models of its detector."""
    return Path(shutil.copytree(detected, tmp_path / "copy", copy_function=shutil.copy2))


def again(flight: Path, *options: str) -> list[str | Path]:
    """Return the command that reconstructed the flight; models are identified by their content, not path."""
    method = () if "--method" in options else ("--method", "robust")
    return ["reconstruct", flight / "flight.session", "--detector", spot_detector(flight), *method, *options]


def stages_run(session: Path) -> list[str]:
    return [run["stage"] for run in read_json(session / "run.json")["runs"]]


def test_an_exchanged_video_is_refused_until_it_is_ingested_and_its_keypoints_go(
    flight: Path, tmp_path: Path
) -> None:
    session = flight / "flight.session"
    before = content(session)
    mirror(flight / "left.mp4")
    for options in ((), ("--force",), ("--method", "dlt")):
        line = refused(*again(flight, *options))
        assert str(flight / "left.mp4") in line
        assert COMMANDS["ingest"] in line
    assert content(session) == before
    # A flight that had the other video from the start gives the right result.
    fresh = tmp_path / "fresh"
    fresh.mkdir()
    for source in flight.iterdir():
        if source.is_file():
            shutil.copy2(source, fresh)
    described = result_of("info", session)["readings"][0]
    for folder in (fresh, flight):
        succeeds("ingest", folder / "flight.yaml")
    told = result_of("info", session)["readings"][0]
    assert told["detect"] != described["detect"], "its tables are those of before, its pictures are not"
    for folder in (fresh, flight):
        assert "written" in succeeds(*again(folder))
    assert content(session) == content(fresh / "flight.session")
    changed = "detect/left/keypoints.parquet"
    assert content(session)[changed] != before[changed]
    assert "unchanged" in succeeds(*again(flight))


def test_another_clock_keeps_the_keypoints_at_new_times(flight: Path, tmp_path: Path) -> None:
    session, manifest = flight / "flight.session", flight / "flight.yaml"
    before = content(session)
    keypoints = session / "detect" / "left" / "keypoints.parquet"
    found, counts = pd.read_parquet(keypoints), read_json(session / "detect" / "stage.json")["counts"]
    fresh = Path(shutil.copytree(flight, tmp_path / "fresh", copy_function=shutil.copy2))
    shutil.rmtree(fresh / "flight.session")
    stated = manifest.read_text()
    corrected = stated.replace("offset_s: 0", "offset_s: 0.004", 1)
    for folder in (flight, fresh):
        (folder / "flight.yaml").write_text(corrected)
        succeeds("ingest", folder / "flight.yaml")
    videos = [flight / "left.mp4", flight / "right.mp4"]
    for video in videos:
        video.rename(video.with_suffix(".away"))
    assert "written" in succeeds(*again(flight))  # nobody looks at a picture
    assert "unchanged" in succeeds(*again(flight))
    now = pd.read_parquet(keypoints)
    pd.testing.assert_frame_equal(now, found.assign(t_ns=found["t_ns"] + 4_000_000))
    assert read_json(session / "detect" / "stage.json")["counts"] == counts
    # Nobody was logged: no hint can have changed, and the keypoints are those of the corrected flight.
    succeeds(*again(fresh))
    assert content(session) == content(fresh / "flight.session")
    for video in videos:
        video.with_suffix(".away").rename(video)
    manifest.write_text(stated)
    succeeds("ingest", manifest)
    succeeds(*again(flight))
    assert content(session) == before


def test_a_session_copied_without_its_videos_finds_them_where_it_was_ingested(
    detected: Path, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(detected / "flight.session", tmp_path / "far" / "away" / "copy.session"))
    succeeds("reconstruct", copy, "--method", "robust", "--detector", spot_detector(detected), "--force")
    assert content(copy) == content(detected / "flight.session")


class Meddler(Silent):
    """Progress that calls a function at a step."""

    def __init__(self, step: int, what: Callable[[], None]) -> None:
        self._left, self._what = step, what

    def advance(self, steps: int = 1) -> None:
        self._left -= steps
        if -steps < self._left <= 0:
            self._what()


@pytest.mark.parametrize(("steps", "name"), [(FRAMES + 3, "right.mp4"), (2 * FRAMES + 3, "left.mp4")])
def test_nothing_is_kept_of_a_video_that_is_exchanged_while_it_is_looked_at(
    flight: Path, steps: int, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(detect, "BLOCK", FRAMES // 2)
    session, video = flight / "flight.session", flight / name
    settings = ReconstructSettings(detector=spot_detector(flight))
    reconstruct(session, settings)
    expected = content(session)
    assert any(file.startswith("background/left/") for file in expected), "the camera that moves is followed"
    shutil.copy2(video, flight / "kept.mp4")
    for stage in ("detect", "background"):
        shutil.rmtree(session / stage)
    with pytest.raises(DataError, match=video.name):
        reconstruct(session, settings, progress=Meddler(steps, lambda: mirror(video)))
    shutil.copy2(flight / "kept.mp4", video)
    reconstruct(session, settings)
    assert content(session) == expected


def exchange(session: Path) -> None:
    mirror(session.parent / "drone1.mp4")


@pytest.mark.parametrize(
    "command",
    [
        ("report", "--force", "--figures", "figures"),
        ("export", "--to", "mcap", "-o", "exported"),
        ("reconstruct", "--force"),
    ],
)
def test_every_command_that_reads_pictures_refuses_others(
    filmed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    session = copied(filmed, tmp_path)
    before = content(session)
    exchange(session)
    line = refused(command[0], session, *command[1:])
    assert str(session.parent / "drone1.mp4") in line
    assert COMMANDS["ingest"] in line
    assert content(session) == before
    assert not (tmp_path / "figures").exists()
    assert not (tmp_path / "exported").exists()
    # What reads no pictures goes on.
    assert "unchanged" in succeeds("reconstruct", session, "--method", "robust")
    assert "written" in succeeds("export", session, "--to", "csv", "-o", tmp_path / "csv")


def test_a_source_that_is_written_while_it_is_ingested_is_refused(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, seconds=0.4)
    log = tmp_path / "drone2.tum"
    session = tmp_path / "flight.session"

    def add_a_pose() -> None:
        lines = log.read_text().splitlines()
        stamp, rest = lines[-1].split(" ", 1)
        log.write_text("\n".join([*lines, f"{float(stamp) + 1:.3f} {rest}", ""]))

    hashed = 2 + 3 * len(flight.cameras)  # calibrations are inline: keypoints, poses and true ones, joints
    with pytest.raises(DataError) as caught:
        ingest(flight.manifest, session, progress=Meddler(hashed, add_a_pose))
    assert caught.value.source == log
    assert COMMANDS["ingest"] in caught.value.remedy
    assert not session.exists()
    assert not ingest(flight.manifest, session).skipped


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a reconstructed session with imported keypoints, and videos beside it."""
    folder = tmp_path_factory.mktemp("filmed")
    flight = filmed_flight(folder)
    succeeds("ingest", flight.manifest)
    succeeds("reconstruct", folder / "flight.session", "--method", "robust")
    return folder


def copied(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy", copy_function=shutil.copy2)) / "flight.session"


def shift(table: Path) -> None:
    """Move everything in a table by half a metre."""
    frame = pd.read_parquet(table)
    frame["x"] += 0.5
    frame.to_parquet(table, index=False)


def test_a_changed_replay_is_neither_shown_nor_filmed(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, seconds=1.5, clean=True)
    session = ingested(flight)
    succeeds("reconstruct", session, "--method", "robust")
    compare = ("replan-compare", session, "--arms", "fixed", "--trials", "1")
    succeeds(*compare)
    before = content(session)
    shift(session / "replan" / "fixed" / "trajectories.parquet")
    assert COMMANDS["replan"] in refused("report", session)
    with pytest.raises(DataError, match=COMMANDS["replan"]) as caught:
        film(session)
    assert caught.value.source == session / "replan" / "fixed" / "trajectories.parquet"
    assert "written" in succeeds(*compare)
    assert content(session) == before
    # Here the reconstruction is where the actor was.
    shift(session / "reconstruct" / "skeleton.parquet")
    assert "skeleton.parquet" in refused(*compare)


def test_tables_that_no_stage_wrote_are_not_read(filmed: Path, tmp_path: Path) -> None:
    session = copied(filmed, tmp_path)
    poses = pd.read_parquet(session / "cameras" / "drone1" / "poses.parquet").assign(camera="drone1")
    poses.to_parquet(session / "reconstruct" / "cameras.parquet", index=False)
    (session / "map").mkdir()
    (session / "map" / "index.json").write_text("[]")
    recording = load_recording(session)
    assert recording.refined == {}
    assert list(recording.maps()) == []
    export(session, ["mcap"], tmp_path / "exported", pictures_hz=0)


def test_force_makes_all_that_the_command_makes(flight: Path) -> None:
    session = flight / "flight.session"
    before = content(session)
    assert "written" in succeeds(*again(flight, "--force"))
    assert stages_run(session) == ["ingest", *["detect", "reconstruct"] * 2]
    assert content(session) == before
