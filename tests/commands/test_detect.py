"""Stage `detect`: models of the user, spans, hints from the actor's log, calibrated confidences."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML

import pipelines.export
import pipelines.reporting.overlays
from pipelines.detect import detect
from pipelines.export import export
from pipelines.formats.skeletons.trc import FORMAT as TRC
from pipelines.formats.videos.video import VideoReader
from pipelines.ingest import ingest
from pipelines.keypoints.search import Hint, actor_hints, hint_sigma
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.report import report
from pipelines.reporting.overlays import FilmedCamera, views_of
from pipelines.session.description import read_description
from pipelines.session.errors import DataError
from pipelines.session.people import logged_actor
from pipelines.session.records import Trajectory
from pipelines.session.stages import StageRecord, locked
from pipelines.session.storage import read_json
from pipelines.session.tables import JOINT_ERRORS, figures_by_joint, motion_from, read_table, trajectory_from
from tests.commands.runner import content, ingested, measured, mocap, refused, succeeds
from tests.keypoints.spotted_flights import (
    CAMERAS,
    FPS,
    LENS,
    START_S,
    person_at,
    spot_detector,
    write_spotted_flight,
)
from tests.real_data import fetch_networks, real_data
from tests.synthetic.flights import write_flight
from tests.synthetic.logged_flights import pose_entry
from tests.synthetic.logs import write_log


def test_keypoints_of_the_users_model_become_a_skeleton(tmp_path: Path) -> None:
    frames = 12
    session = write_spotted_flight(tmp_path, frames).with_suffix(".session")
    succeeds("ingest", tmp_path / "flight.yaml")
    detector = spot_detector(tmp_path)
    succeeds("reconstruct", session, "--method", "robust", "--detector", detector)

    table = pd.read_parquet(session / "reconstruct" / "skeleton.parquet")
    assert (table["status"] == "ok").all()
    found = table[["x", "y", "z"]].to_numpy().reshape(frames, 17, 3)
    truth = person_at(np.arange(frames) / FPS)[:, np.arange(17) % 3]
    # 0.1 input pixels (tests/keypoints/test_onnx_pose.py), of 0.6 picture pixels, and as much again for the
    # video's quantisation; a pixel is 2 cm, and depth errs by 1 / sin(31 deg) = 1.9 times as much.
    assert np.linalg.norm(found - truth, axis=-1).max() < 0.1 * 0.6 * 2 * 0.02 * 1.9 * np.sqrt(3)

    stage = read_json(session / "detect" / "stage.json")
    assert str(tmp_path) not in json.dumps(stage)
    # The models may move, and the detector does not run again.
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for model in ("pose.onnx", "people.onnx"):
        shutil.move(tmp_path / model, moved / model)
    before = (session / "detect" / "stage.json").stat().st_ino
    succeeds(
        "reconstruct",
        session,
        "--method",
        "robust",
        "--detector",
        detector.replace(f"{tmp_path}/", f"{moved}/"),
    )
    assert (session / "detect" / "stage.json").stat().st_ino == before
    assert "pose.onnx: does not exist" in refused(
        "reconstruct", session, "--method", "robust", "--detector", detector
    )


def test_what_cannot_be_run_is_refused_in_one_line(tmp_path: Path) -> None:
    session = write_spotted_flight(tmp_path, 5).with_suffix(".session")
    succeeds("ingest", tmp_path / "flight.yaml")
    assert "write onnx:MODEL.onnx" in refused(
        "reconstruct", session, "--method", "robust", "--detector", "onnx"
    )
    assert "blazepose" in refused("reconstruct", session, "--method", "robust", "--detector", "magic")
    assert "takes nothing behind" in refused(
        "reconstruct", session, "--method", "robust", "--detector", "blazepose:x"
    )
    line = refused("reconstruct", session, "--detector", spot_detector(tmp_path).replace("=cpu", "=quantum"))
    assert "provider=quantum" in line
    text = tmp_path / "text.onnx"
    text.write_text("no model")
    assert "is no model" in refused(
        "reconstruct", session, "--method", "robust", "--detector", f"onnx:{text}"
    )


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
    with locked(session) as writable, pytest.raises(DataError, match="12 cannot be decoded"):
        detect(writable, detector=detector, force=True)


def test_a_span_without_pictures_to_look_at_is_refused(tmp_path: Path) -> None:
    flight = write_flight(tmp_path)
    session = ingested(flight)
    assert "--pictures" in refused("reconstruct", session, "--method", "robust", "--pictures", "1:")
    done = mocap("reconstruct", session, "--method", "robust", "--pictures", "::3")
    assert done.returncode == 0
    assert "--pictures" in done.stderr


FRAMES = 3
NOISE = {"white": {"position_m": 0.4, "rotation_deg": 2.0}, "bias": {"position_m": 0.3}}
DISTANCE_M = math.dist(CAMERAS["left"], (0.0, 0.0, 1.0))


class Flight:
    """A spotted flight whose settings can be changed, and its session."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.manifest = write_spotted_flight(folder, FRAMES)
        self.session = folder / "flight.session"
        self.settings: dict[str, Any] = YAML(typ="safe").load(self.manifest)

    def log_actor(self, point: str, height_m: float) -> None:
        """Log an actor who stands in the origin, where both cameras look at 1 m height."""
        stamps = [START_S * 10**9 + round(k * 1e9 / FPS) for k in range(FRAMES)]
        entries = [pose_entry("/actor", t, (0.0, 0.0, height_m)) for t in stamps]
        write_log(self.folder, "actor", "mcap-cdr", entries)
        self.settings["actor"] = {"file": "actor.mcap", "topic": "/actor", "point": point}

    def ingest(self) -> None:
        YAML(typ="safe").dump(self.settings, self.manifest)
        ingest(self.manifest, self.session)

    def hints(self) -> list[Hint | None]:
        self.ingest()
        stamps = START_S * 10**9 + np.round(np.arange(FRAMES) * 1e9 / FPS).astype(np.int64)
        description = read_description(self.session)
        actor = logged_actor(self.session, description)
        assert actor is not None
        track = trajectory_from(pd.read_parquet(self.session / "cameras" / "left" / "poses.parquet"))
        entry, between = description.cameras["left"], description.pose_interpolation
        return actor_hints(actor, "left", entry, track, between, stamps)

    def detected(self, detector: str) -> StageRecord:
        """The record of the stage, which is run where it has to be."""
        self.ingest()
        with locked(self.session) as writable:
            record = detect(writable, detector=detector)
        assert record is not None
        return record


@pytest.mark.parametrize(("point", "height_m"), [("hip", 1.0), ("feet", 0.05), ("head", 1.7)])
def test_the_hint_is_at_the_hips_whatever_point_was_logged(
    tmp_path: Path, point: str, height_m: float
) -> None:
    flight = Flight(tmp_path)
    flight.log_actor(point, height_m)

    hints = flight.hints()

    # The cameras look at the hips, 0.95 m above the feet and 0.7 m below the head.
    assert len(hints) == FRAMES
    for hint in hints:
        assert hint is not None
        assert hint.centre == pytest.approx((LENS.cx, LENS.cy), abs=1e-3)
        assert hint.height_px == pytest.approx(LENS.fx * 1.75 / DISTANCE_M, rel=1e-3)
    actor = logged_actor(flight.session, read_description(flight.session))
    assert actor is not None
    assert actor.hips_at(np.array([START_S * 10**9])) == pytest.approx(np.array([[0.0, 0.0, 1.0]]))


def test_logged_covariances_count_where_nothing_is_stated(tmp_path: Path) -> None:
    flight = Flight(tmp_path)
    flight.log_actor("hip", 1.0)
    flight.ingest()
    entry = read_description(flight.session).cameras["left"]
    sigmas = np.array([[0.2, 0.03], [0.5, 0.01]])
    covariance = np.stack([np.diag(np.repeat(sigma**2, 3)) for sigma in sigmas])
    trajectory = Trajectory(
        np.array([0, 1000]), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)), covariance
    )

    found = hint_sigma("left", entry, trajectory, np.array([-5, 0, 999, 1000, 2000]))

    # Of the pose before each picture, the first where there is none.
    at_pictures = sigmas[[0, 0, 0, 1, 1]]
    assert found[:, 0] == pytest.approx(np.hypot(1.0, at_pictures[:, 0]))
    assert found[:, 1] == pytest.approx(at_pictures[:, 1])
    stated = entry.model_copy(update={"pose_noise": NOISE})
    assert hint_sigma("left", stated, trajectory, np.array([0]))[0] == pytest.approx(
        [math.sqrt(1 + 0.4**2 + 0.3**2), math.radians(2)]
    )


def test_only_another_log_of_the_actor_has_the_keypoints_detected_anew(tmp_path: Path) -> None:
    flight, detector = Flight(tmp_path), spot_detector(tmp_path)
    camera = flight.settings["cameras"]["left"]
    first = flight.detected(detector)
    assert "hints_from" not in first.inputs, "nobody was logged"
    camera["pose_noise"] = NOISE
    assert flight.detected(detector) == first
    flight.log_actor("hip", 1.0)
    hinted = flight.detected(detector)
    assert hinted.inputs["log of the actor"] not in first.inputs.values()
    # Poses, calibrations and clocks move the hints; the keypoints stay those that were found with the first.
    camera["pose_noise"] = {"white": {"position_m": 0.4}}
    assert flight.detected(detector) == hinted
    camera["intrinsics"]["fx"] = 290.0
    assert flight.detected(detector) == hinted
    camera["clock"]["offset_s"] = 0.01
    later = flight.detected(detector)
    assert later.key != hinted.key
    assert later.inputs["hints_from"] == hinted.inputs["hints_from"]
    # Another log, or another point of the body that it follows, is another actor.
    flight.log_actor("hip", 1.2)
    higher = flight.detected(detector)
    flight.settings["actor"]["point"] = "feet"
    feet = flight.detected(detector)
    found_with = [record.inputs["hints_from"] for record in (hinted, higher, feet)]
    assert len(set(found_with)) == 3


def test_keypoints_of_little_worth_are_used_and_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The calibrated confidence of wrists is always 0.1, below the least confidence; that of others is 0.9.
    measured = tmp_path / "measured.csv"
    head = "# made by: a test\n# probability that a joint is near\njoints,confidence,probability,count\n"
    measured.write_text(f"{head}*,0.5,0.9,100\nwrist,0.5,0.1,100\n", encoding="utf-8")
    for place in ("pipelines.keypoints.corrections", "pipelines.reconstruct"):
        monkeypatch.setattr(f"{place}.measured_for", lambda _: measured)
    session = tmp_path / "flight.session"
    ingest(write_spotted_flight(tmp_path, 6), session)
    reconstruct(session, ReconstructSettings(detector=spot_detector(tmp_path)))
    stored = read_table(session / "reconstruct" / "joint_errors.parquet", JOINT_ERRORS)
    for joint in ("left_wrist", "left_elbow"):
        assert figures_by_joint(stored)[joint]["reconstructed_share"] == 1

    drawn: list[FilmedCamera] = []

    def watched(camera: FilmedCamera, *others: object) -> object:
        drawn.append(camera)
        return views_of(camera, *others)  # type: ignore[arg-type]

    for module in (pipelines.export, pipelines.reporting.overlays):
        monkeypatch.setattr(module, "views_of", watched)
        drawn.clear()
        if module is pipelines.export:
            export(session, ["overlay"])
        else:
            report(session)
        assert {camera.name for camera in drawn} == set(CAMERAS)
        for camera in drawn:
            joints = set(camera.keypoints["joint"])
            assert {"left_elbow", "left_wrist", "right_wrist"} <= joints


EVERY = 20


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """Make a flight of four videos with their calibration, without keypoints."""
    fetch_networks("blazepose")
    recording = real_data("pose2sim_single")
    shutil.copytree(recording / "videos", tmp_path / "videos")
    calibration = recording / "calibration" / "Calib_qualisys.toml"
    lines = ["schema: 1", "name: Detected", "cameras:"]
    for name in ("cam01", "cam02", "cam03", "cam04"):
        where = f"pose: {{file: {calibration}}}, intrinsics: {calibration}"
        lines.append(f"  {name}: {{video: videos/{name}.mp4, {where}}}")
    path = tmp_path / "flight.yaml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    succeeds("ingest", path)
    return path


@pytest.mark.slow
def test_detector_and_triangulation_agree_with_the_peers_skeleton(flight: Path) -> None:
    session = flight.with_suffix(".session")
    result = measured(session, "--pictures", f"::{EVERY}")
    assert result["reconstructed_share"] > 0.95
    peer = TRC.read_joints(real_data("pose2sim_single/pose-3d/single_0-99.trc"), unit=None, axes=None)
    ours = motion_from(pd.read_parquet(session / "reconstruct" / "skeleton.parquet"), peer.joints)
    apart_mm = 1e3 * np.linalg.norm(ours.position - peer.position[::EVERY], axis=-1)
    # Two detectors do not mean the same places by hips and shoulders: some centimetres, never a limb.
    assert np.nanmedian(apart_mm) < 60
    assert np.isfinite(apart_mm[..., peer.joints.index("left_knee")]).mean() > 0.9

    # Not the detector's again: its keypoints are kept while pictures and settings are the same.
    (flight.parent / "videos" / "cam01.mp4").unlink()
    succeeds("reconstruct", session, "--pictures", f"::{EVERY}", "--method", "dlt")
    assert "cam01.mp4" in refused(
        "reconstruct", session, "--method", "robust", "--pictures", f"::{2 * EVERY}"
    )


@pytest.mark.long
def test_keypoints_do_not_depend_on_workers(flight: Path) -> None:
    session = flight.with_suffix(".session")
    results = []
    for workers in ("1", "2"):
        shutil.rmtree(session / "detect", ignore_errors=True)
        succeeds(
            "reconstruct",
            session,
            "--method",
            "robust",
            "--pictures",
            "::50",
            "--workers",
            workers,
            "--force",
        )
        results.append(content(session))
    assert results[0] == results[1]
