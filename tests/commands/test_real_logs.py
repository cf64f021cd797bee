"""Real logs, maps and calibrations, ingested by commands: the session agrees with facts.json."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML

from tests.commands.runner import mocap, refused, succeeds
from tests.real_data import real_data

FRAMES = 20


def facts(name: str) -> dict[str, Any]:
    every: dict[str, Any] = json.loads(real_data("facts.json").read_text(encoding="utf-8"))
    expected: dict[str, Any] = every[name]
    return expected


def write_flight(folder: Path, pose: dict[str, Any], start_s: float, **parts: Any) -> Path:
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
        "mount": {"looks": "forward"},
        "intrinsics": {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240},
        "frame_times": {"start": start_s, "fps": 10},
        "keypoints": "keypoints.json",
    }
    if pose.get("of") != "body":
        del camera["mount"]
    path = folder / "flight.yaml"
    with path.open("w", encoding="utf-8") as file:
        YAML(typ="safe", pure=True).dump({"schema": 1, "cameras": {"husky": camera}, **parts}, file)
    return path


def session_of(path: Path) -> dict[str, Any]:
    stored: dict[str, Any] = json.loads(
        (path.with_suffix(".session") / "session.json").read_text(encoding="utf-8")
    )
    return stored


def test_odometry_of_a_real_robot(tmp_path: Path) -> None:
    name = "logs/ros1/husky_gps_imu_odom.bag"
    expected = facts(name)["topics"]["/husky_velocity_controller/odom"]
    first_s, last_s = expected["header_stamp_range"]
    path = write_flight(tmp_path, {"file": str(real_data(name)), "of": "body"}, start_s=first_s + 10)
    done = mocap("ingest", path)
    assert done.returncode == 0, done.stderr
    assert " /husky_velocity_controller/odom, " in done.stderr
    poses = pd.read_parquet(tmp_path / "flight.session" / "cameras" / "husky" / "poses.parquet")
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


def test_a_chain_of_transforms(tmp_path: Path) -> None:
    name = "logs/ros1/foxglove_example.bag"
    expected = facts(name)
    pose = {"file": str(real_data(name)), "parent": "world", "child": "turtle1", "of": "body"}
    path = write_flight(tmp_path, pose, start_s=expected["start_ns"] / 1e9 + 5)
    succeeds("ingest", path)
    poses = pd.read_parquet(tmp_path / "flight.session" / "cameras" / "husky" / "poses.parquet")
    # Two turtles, one transform each, in every other message of /tf.
    assert len(poses) == expected["topics"]["/tf"]["count"] / 2


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


@pytest.mark.parametrize(
    "name",
    [
        "logs/ros1/husky_gps_imu_odom.bag",
        "logs/ros1/foxglove_example-bz2.bag",
        "logs/ros2/rosbag2_wbag_sqlite3",
        "logs/ros2/rosbag2_wbag_mcap",
        "logs/mcap/edge_publish_vs_log_time.mcap",
    ],
)
def test_info_of_real_logs(name: str) -> None:
    expected = facts(name)
    (reading,) = json.loads(succeeds("info", real_data(name), "--json"))["readings"]
    assert reading["messages"] == expected["messages"]
    # The public reader trusts metadata.yaml; if that is wrong, the reading has both values.
    stated = reading.get("metadata.yaml states", reading)
    assert stated["first_ns"] == expected["start_ns"]
    assert {topic: seen["messages"] for topic, seen in reading["topics"].items()} == {
        topic: seen["count"] for topic, seen in expected["topics"].items()
    }
