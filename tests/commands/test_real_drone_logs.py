"""Real logs of drones through `mocap init` and `mocap ingest`: counts and places are those of facts.json."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML

from pipelines.ingest import ingest
from tests.commands.runner import mocap
from tests.real_data import real_data

FRAMES = 8


def facts(name: str) -> dict[str, Any]:
    every: dict[str, Any] = json.loads(real_data("facts.json").read_text(encoding="utf-8"))
    told: dict[str, Any] = every[name]
    return told


def write_flight(folder: Path, name: str, start_s: float, pose: dict[str, Any], **camera: Any) -> Path:
    """Write a flight of one camera with poses from a real log, copied beside the manifest."""
    log = folder / Path(name).name
    shutil.copyfile(real_data(name), log)
    joints = [value for j in range(17) for value in (100 + j, 200, 0.9)]
    people = [{"image_id": k, "category_id": 1, "keypoints": joints, "score": 1.0} for k in range(FRAMES)]
    (folder / "keypoints.json").write_text(json.dumps(people), encoding="utf-8")
    stated = {
        "pose": {**pose, "file": log.name},
        "intrinsics": {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240},
        "frame_times": {"start": start_s, "fps": 30},
        "keypoints": "keypoints.json",
        **camera,
    }
    path = folder / "flight.yaml"
    with path.open("w", encoding="utf-8") as file:
        YAML(typ="safe", pure=True).dump({"schema": 1, "cameras": {"drone": stated}}, file)
    return path


def session_of(path: Path) -> dict[str, Any]:
    stored = path.with_suffix(".session") / "session.json"
    described: dict[str, Any] = json.loads(stored.read_text(encoding="utf-8"))
    return described


def poses_of(path: Path) -> pd.DataFrame:
    return pd.read_parquet(path.with_suffix(".session") / "cameras" / "drone" / "poses.parquet")


FIXED = {"gimbal": {"yaw_deg": 90, "pitch_deg": -30}}


def test_a_phantom_with_gimbal_angles_as_a_command(tmp_path: Path) -> None:
    name = "logs/dji_srt/p4_rtk.SRT"
    told = facts(name)
    path = write_flight(tmp_path, name, 10.0, {"file": ""})
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


@pytest.mark.parametrize(
    ("name", "start_s"),
    [
        ("MAVIC3.srt", 1640435280.0),
        ("air2s.srt", 1659879640.8),
        ("matrice_300.srt", 1655827600.0),
        ("old_format.SRT", 1501942320.0),
        ("broken_incomplete.SRT", 1499076905.0),
        ("mavic_2pro_new.SRT", 1569580090.0),
    ],
)
def test_subtitles_without_gimbal_angles(tmp_path: Path, name: str, start_s: float) -> None:
    told = facts(f"logs/dji_srt/{name}")
    pose: dict[str, Any] = {"file": "", **({"altitude": 40} if name == "mavic_2pro_new.SRT" else {})}
    path = write_flight(tmp_path, f"logs/dji_srt/{name}", start_s, pose, **FIXED)
    ingest(path, max_pose_gap_s=1.5)
    poses = session_of(path)["cameras"]["drone"]["poses"]
    assert poses["count"] + sum(poses["dropped"].values()) == told["blocks"]
    origin = session_of(path)["origin"]
    assert [origin["latitude_deg"], origin["longitude_deg"]] == told["lat_lon_first"]
    # The box in degrees, in metres: 111.2 km a degree of latitude, to half a per cent anywhere on Earth.
    low, high = told["lat_lon_bbox"]["min"], told["lat_lon_bbox"]["max"]
    assert np.ptp(poses_of(path)["y"]) == pytest.approx((high[0] - low[0]) * 111_200, rel=0.01, abs=0.5)


@pytest.mark.parametrize(
    ("name", "position", "topic"),
    [
        ("sample.ulg", "local", "vehicle_local_position:0"),
        ("sample_log_small.ulg", "local", "vehicle_local_position:0"),
        ("sample_log_small.ulg", "gps", "vehicle_gps_position:0"),
        ("sample_px4_events.ulg", "local", "vehicle_local_position:0"),
        ("sample_px4_events.ulg", "gps", "vehicle_gps_position:0"),
    ],
)
def test_px4(tmp_path: Path, name: str, position: str, topic: str) -> None:
    told = facts(f"logs/ulog/{name}")
    start_s = 1710773365.0 if "events" in name else told["start_us"] / 1e6 + 1
    pose = {"file": "", "position": position, "time": "boot"}
    path = write_flight(tmp_path, f"logs/ulog/{name}", start_s, pose, mount={"looks": "forward"})
    ingest(path)
    described = session_of(path)
    stored = described["cameras"]["drone"]["poses"]
    turned, placed = told["attitude_samples"], told["topics"][topic]
    lost = {cause: count for cause, count in stored["dropped"].items() if "without" not in cause}
    assert stored["count"] + sum(stored["dropped"].values()) - sum(lost.values()) == turned
    assert 0 <= sum(lost.values()) < placed
    if name == "sample.ulg":
        assert any(re.search(r"vehicle_local_position\b.*\b0\b", w) for w in described["warnings"])


def test_px4_at_gps_time_as_a_command(tmp_path: Path) -> None:
    name = "logs/ulog/sample_log_small.ulg"
    told = facts(name)
    first_s = told["gps_time_utc_usec_first_last"][0] / 1e6
    path = write_flight(
        tmp_path, name, first_s + 1, {"file": "", "position": "gps"}, mount={"looks": "forward"}
    )
    done = mocap("ingest", path)
    assert done.returncode == 0, done.stderr
    assert "its stamps are turned to UTC" in done.stderr
    clock = session_of(path)["cameras"]["drone"]["log_clock"]
    assert clock["events"] == told["gps_samples"]
    # The first attitude after the first fix: those come every 5 ms, with pauses.
    assert 0 <= poses_of(path)["t_ns"].iloc[0] / 1e9 - first_s < 0.05
