"""Flights with poses, intrinsics and pictures in logs: every container, and effects of damage."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML

from pipelines.formats.logs.recordings import TRUNCATED
from pipelines.geometry.poses import conjugate, multiply
from pipelines.session.storage import read_json
from tests.commands.runner import content, measured, mocap, refused, succeeds
from tests.commands.test_init import tables
from tests.real_data import facts, real_data
from tests.synthetic.logged_flights import write_logged_flight
from tests.synthetic.logs import CONTAINERS, Container, cut


def ingested(folder: Path) -> tuple[Path, dict[str, Any]]:
    succeeds("ingest", folder / "flight.yaml")
    session = folder / "flight.session"
    return session, read_json(session / "session.json")


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


FRAMES = 20


def write_flight(
    folder: Path, pose: dict[str, Any], start_s: float, *, mounted: bool = False, **parts: Any
) -> Path:
    """Write a flight of one camera with poses from a real log, and keypoints that are always present."""
    people = [
        {
            "image_id": k,
            "category_id": 1,
            "keypoints": [*(v for j in range(17) for v in (100 + j, 200 + k, 0.9))],
            "score": 1.0,
        }
        for k in range(FRAMES)
    ]
    (folder / "keypoints.json").write_text(json.dumps(people), encoding="utf-8")
    camera = {
        "pose": pose,
        "intrinsics": {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240},
        "frame_times": {"start": start_s, "fps": 10},
        "keypoints": "keypoints.json",
    }
    if mounted or pose.get("of") == "body":
        camera["mount"] = {"looks": "forward"}
    path = folder / "flight.yaml"
    with path.open("w", encoding="utf-8") as file:
        YAML(typ="safe", pure=True).dump({"schema": 1, "cameras": {"husky": camera}, **parts}, file)
    return path


def copied(folder: Path, name: str) -> str:
    """Copy a log beside the manifest; return its name."""
    return Path(shutil.copy(real_data(name), folder)).name


def poses_of(path: Path) -> pd.DataFrame:
    return pd.read_parquet(path.with_suffix(".session") / "cameras" / "husky" / "poses.parquet")


def session_of(path: Path) -> dict[str, Any]:
    return read_json(path.with_suffix(".session") / "session.json")


def test_odometry_of_a_real_robot(tmp_path: Path) -> None:
    name = "logs/ros1/husky_gps_imu_odom.bag"
    expected = facts(name)["topics"]["/husky_velocity_controller/odom"]
    first_s, last_s = expected["header_stamp_range"]
    path = write_flight(tmp_path, {"file": str(real_data(name)), "of": "body"}, start_s=first_s + 10)
    done = mocap("ingest", path)
    assert done.returncode == 0, done.stderr
    assert " /husky_velocity_controller/odom, " in done.stderr
    poses = poses_of(path)
    assert len(poses) == expected["count"]
    assert session_of(path)["cameras"]["husky"]["poses"]["dropped"] == {}
    # Stated with six decimals, stamps as doubles of seconds since the epoch.
    position = poses[["x", "y", "z"]].to_numpy()
    assert position.min(axis=0) == pytest.approx(expected["position_bbox"]["min"], abs=1e-6)
    assert position.max(axis=0) == pytest.approx(expected["position_bbox"]["max"], abs=1e-6)
    assert poses["t_ns"].iloc[[0, -1]].to_numpy() / 1e9 == pytest.approx([first_s, last_s], abs=1e-6)
    assert np.linalg.norm(np.diff(position, axis=0), axis=1).sum() == pytest.approx(
        expected["path_length"], abs=1e-3
    )


def test_a_phantom_with_gimbal_angles_as_a_command(tmp_path: Path) -> None:
    name = "logs/dji_srt/p4_rtk.SRT"
    told = facts(name)
    path = write_flight(tmp_path, {"file": copied(tmp_path, name)}, 10.0)
    done = mocap("ingest", path, "--max-pose-gap", "1.5")
    assert done.returncode == 0, done.stderr
    latitude, longitude = told["lat_lon_first"]
    assert f"world origin: {latitude:.7f}, {longitude:.7f}, 0.00 m (p4_rtk.SRT)" in done.stdout
    assert "shows no clock" in done.stderr
    poses = poses_of(path)
    assert len(poses) == told["positions"]
    assert poses["z"].min() == pytest.approx(told["H_m"]["min"], abs=0.04)  # the Earth falls away on 700 m
    # D is the drone's own distance from its take-off, from its unrounded positions.
    flown = np.hypot(*(poses[axis].iloc[-1] - poses[axis].iloc[0] for axis in ("x", "y")))
    assert flown == pytest.approx(660, abs=5)
