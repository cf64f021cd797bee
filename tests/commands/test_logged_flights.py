"""Flights with poses, intrinsics and pictures in logs: every container, and effects of damage."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pipelines.formats.logs.recordings import TRUNCATED
from pipelines.geometry.poses import conjugate, multiply
from pipelines.session.storage import read_json
from tests.commands.runner import content, measured, mocap, refused, succeeds
from tests.synthetic.logged_flights import write_logged_flight
from tests.synthetic.logs import CONTAINERS, Container, cut


def ingested(folder: Path) -> tuple[Path, dict[str, Any]]:
    succeeds("ingest", folder / "flight.yaml")
    session = folder / "flight.session"
    return session, read_json(session / "session.json")


def tables(session: Path) -> dict[str, str]:
    """Hash the tables of the session, without session.json, which names the logs."""
    return {name: digest for name, digest in content(session).items() if name.endswith(".parquet")}


def test_every_container_gives_the_same_session(tmp_path: Path) -> None:
    sessions, described = [], []
    for container in CONTAINERS:
        write_logged_flight(tmp_path / container, container)
        session, description = ingested(tmp_path / container)
        sessions.append(tables(session))
        del description["sources"], description["warnings"]
        for camera in description["cameras"].values():
            del camera["poses"]["source"], camera["media"]
        described.append(description)
    assert len(sessions) >= 4
    assert sessions[0]
    assert all(session == sessions[0] for session in sessions)
    assert all(description == described[0] for description in described)


@pytest.mark.parametrize("container", ["ros1", "ros2-mcap"])
def test_poses_of_the_body_become_those_of_the_camera(tmp_path: Path, container: Container) -> None:
    flight = write_logged_flight(tmp_path, container)
    session, description = ingested(tmp_path)
    for k, name in enumerate(flight.cameras):
        poses = pd.read_parquet(session / "cameras" / name / "poses.parquet")
        assert list(poses["t_ns"]) == list(flight.t_ns)
        # Doubles all the way: a few roundings of numbers of 10 m.
        assert np.abs(poses[["x", "y", "z"]].to_numpy() - flight.camera_position[k]).max() < 1e-9
        logged = poses[["qx", "qy", "qz", "qw"]].to_numpy()
        apart = multiply(conjugate(flight.camera_quaternion[k]), logged)[:, :3]
        assert np.abs(apart).max() < 1e-9
        # The lever arm of 0.11 m turns 0.01 rad of the body into 1.1 mm of the camera: next to nothing.
        assert np.sqrt(poses["c22"].to_numpy()) == pytest.approx(0.3, abs=0.001)
        intrinsics = description["cameras"][name]["intrinsics"]
        assert (intrinsics["width"], intrinsics["fx"]) == (1280, 762.0)
    result = measured(session)
    assert result["mpjpe_mm"] < 0.5


def test_strict_refuses_what_is_salvaged_otherwise(tmp_path: Path) -> None:
    flight = write_logged_flight(tmp_path, "ros1")
    succeeds("ingest", flight.manifest, "--strict")
    log = tmp_path / flight.settings["cameras"]["drone1"]["pose"]["file"]
    log.write_bytes(log.read_bytes()[:-2000])
    line = refused("ingest", flight.manifest, "--strict")
    assert re.search(r"flight\.yaml: .*--strict .*\(cameras.drone1.", line)
    assert f"1 {TRUNCATED}" in line
    kept = read_json(tmp_path / "flight.session" / "session.json")
    assert kept["cameras"]["drone1"]["poses"]["dropped"] == {}  # the session is the one from before
    _, description = ingested(tmp_path)
    assert description["cameras"]["drone1"]["poses"]["dropped"]
    assert line == refused("ingest", flight.manifest, "--strict")  # though there is nothing left to do


@pytest.mark.parametrize("container", ["ros1", "mcap-cdr"])
def test_truncated_log_is_salvaged_and_the_loss_is_said(tmp_path: Path, container: Container) -> None:
    flight = write_logged_flight(tmp_path, container, seconds=3.0)
    (log,) = [path for path in (tmp_path / "logs").iterdir() if path.name.startswith("drone2")]
    cut(log, 0.4)
    done = mocap("ingest", flight.manifest)
    assert done.returncode == 0, done.stderr
    lost = [line for line in done.stderr.splitlines() if "drone2" in line and "dropped" in line]
    assert lost, done.stderr
    stored = read_json(tmp_path / "flight.session" / "session.json")
    poses = stored["cameras"]["drone2"]["poses"]
    assert 0 < poses["count"] < len(flight.t_ns)
    assert poses["dropped"]
    assert stored["cameras"]["drone1"]["poses"]["dropped"] == {}


def test_clock_that_jumps_in_flight_is_said_and_the_rest_is_used(tmp_path: Path) -> None:
    flight = write_logged_flight(tmp_path, "mcap-cdr", seconds=2.0, jump_s=-30.0)
    done = mocap("ingest", flight.manifest)
    assert done.returncode == 0, done.stderr
    assert re.search(r"\bclock\b.* -30 s .*; header ", done.stderr)
    stored = read_json(tmp_path / "flight.session" / "session.json")
    # What was stamped before the jump's landing cannot be put into an order: it is counted.
    lost = stored["cameras"]["drone1"]["poses"]["dropped"]
    assert sum(lost.values()) + stored["cameras"]["drone1"]["poses"]["count"] == len(flight.t_ns)
    assert lost


def test_keypoints_beyond_the_pictures_are_counted(tmp_path: Path) -> None:
    flight = write_logged_flight(tmp_path, "mcap-cdr")
    camera = flight.settings["cameras"]["drone1"]
    keypoints = tmp_path / camera["keypoints"]["file"]
    people = json.loads(keypoints.read_text(encoding="utf-8"))
    beyond = [{**person, "image_id": f"{100 + k:06d}.jpg"} for k, person in enumerate(people[:3])]
    keypoints.write_text(json.dumps(people + beyond), encoding="utf-8")
    done = mocap("ingest", flight.manifest)
    assert done.returncode == 0, done.stderr
    assert "drone1: keypoints dropped: 3 " in done.stderr


def test_moved_flight_is_the_same_flight(tmp_path: Path) -> None:
    write_logged_flight(tmp_path / "here", "ros2-mcap")
    session, _ = ingested(tmp_path / "here")
    shutil.copytree(tmp_path / "here", tmp_path / "there")
    moved = tmp_path / "there" / "flight.yaml"
    assert "unchanged" in succeeds("ingest", moved)
    assert content(moved.with_suffix(".session")) == content(session)


def test_logged_pictures_of_another_size_are_distinguished_from_those_of_the_calibration(
    tmp_path: Path,
) -> None:
    flight = write_logged_flight(tmp_path / "shape", "ros2-mcap", picture_size=(640, 400))
    line = refused("ingest", flight.manifest)
    assert "cameras.drone1.intrinsics" in line
    assert re.search(r"\b640 x 400, .* 1280 x 720\b", line)

    flight = write_logged_flight(tmp_path / "half", "ros2-mcap", picture_size=(640, 360))
    for name in flight.cameras:
        del flight.settings["cameras"][name]["keypoints"]  # they are of the whole size
    flight.save()
    _, description = ingested(tmp_path / "half")
    lens = description["cameras"]["drone1"]["intrinsics"]
    assert (lens["width"], lens["height"], lens["fx"], lens["cy"]) == (640, 360, 381.0, 178.75)
    assert any(re.search("drone1: .* 640 x 360", line) for line in description["warnings"])
