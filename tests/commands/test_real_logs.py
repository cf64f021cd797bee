"""Real logs, maps and calibrations, ingested by commands: the session agrees with facts.json."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML

from pipelines.session.storage import read_json
from tests.commands.runner import mocap, refused, succeeds
from tests.real_data import real_data

FRAMES = 20


def facts(name: str) -> dict[str, Any]:
    every: dict[str, Any] = json.loads(real_data("facts.json").read_text(encoding="utf-8"))
    expected: dict[str, Any] = every[name]
    return expected


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


def test_calibration_and_pictures_of_a_real_json_log(tmp_path: Path) -> None:
    name = "logs/mcap/json_camera_calibration_images.mcap"
    log = str(real_data(name))
    expected = facts(name)["topics"]["/image/compressed"]
    (tmp_path / "still.toml").write_text(
        '[camera]\nname = "camera"\nsize = [640, 480]\nmatrix = [[800, 0, 320], [0, 800, 240], [0, 0, 1]]\n'
        "distortions = [0, 0, 0, 0]\nrotation = [0, 0, 0]\ntranslation = [0, 0, 0]\n",
        encoding="utf-8",
    )
    path = tmp_path / "flight.yaml"
    path.write_text(
        f"schema: 1\nlogs:\n  json: {{file: {log}, stamps: receive}}\n"
        "cameras:\n  camera:\n    video: {file: json}\n    pose: {file: still.toml}\n"
        f"    intrinsics: {{file: {log}, topic: /camera_calibration}}\n",
        encoding="utf-8",
    )
    # Its calibration is an example that does not belong to its pictures.
    assert re.search(r"\b520 x 360, .* 640 x 480\b", refused("ingest", path))
    text = path.read_text(encoding="utf-8")
    logged = f"{{file: {log}, topic: /camera_calibration}}"
    inline = "{width: 520, height: 360, fx: 800, fy: 800, cx: 260, cy: 180, distortion: [-0.2, 0.1, 0, 0]}"
    path.write_text(text.replace(logged, inline), encoding="utf-8")
    succeeds("ingest", path)
    camera = session_of(path)["cameras"]["camera"]
    assert camera["frames"]["count"] == expected["count"]
    assert camera["frames"]["first_t_ns"] == facts(name)["start_ns"]
    # Its header stamps stand still: one picture can be expected from the others by them.
    path.write_text(path.read_text(encoding="utf-8").replace("stamps: receive", "stamps: header"), "utf-8")
    done = mocap("ingest", path)
    assert re.search(r"\b9 picture", done.stderr)
    path.write_text(text.replace("/camera_calibration", "/camera_calibration/custom"), encoding="utf-8")
    assert "CylinderCameraModel" in refused("ingest", path)


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


def test_px4_at_gps_time_as_a_command(tmp_path: Path) -> None:
    name = "logs/ulog/sample_log_small.ulg"
    told = facts(name)
    first_s = told["gps_time_utc_usec_first_last"][0] / 1e6
    pose = {"file": copied(tmp_path, name), "position": "gps"}
    path = write_flight(tmp_path, pose, first_s + 1, mounted=True)
    done = mocap("ingest", path)
    assert done.returncode == 0, done.stderr
    assert "its stamps are turned to UTC" in done.stderr
    clock = session_of(path)["cameras"]["husky"]["log_clock"]
    assert clock["events"] == told["gps_samples"]
    # The first attitude after the first fix: those come every 5 ms, with pauses.
    assert 0 <= poses_of(path)["t_ns"].iloc[0] / 1e9 - first_s < 0.05
