"""Flights that several benchmarks share: the sample, the real recording, and scenarios of several people."""

import os
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "sample_data" / "mound_walk"
REAL_DATA = Path(os.environ.get("MOCAP_REAL_DATA", ROOT.parent / "shared" / "data"))
REAL = REAL_DATA / "pose2sim_single"
"""Pose2Sim's demo: a walk filmed by four still cameras, which is not part of this repository."""
CAMERAS = ("cam01", "cam02", "cam03", "cam04")
PEER = REAL / "pose-3d" / "single_0-99.trc"
"""The skeleton that Pose2Sim 0.10.49 made of OpenPose's keypoints."""


def real_flight(folder: Path, calibration: str = "Calib_qualisys.toml", frame_times: str = "") -> Path:
    """Write a flight.yaml of the real recording: its videos and its calibration, no keypoints."""
    file = REAL / "calibration" / calibration
    times = f", frame_times: {frame_times}" if frame_times else ""
    lines = ["schema: 1", "name: Walk", "cameras:"]
    for name in CAMERAS:
        video = REAL / "videos" / f"{name}.mp4"
        lines.append(f"  {name}: {{video: {video}, pose: {{file: {file}}}, intrinsics: {file}{times}}}")
    path = folder / "flight.yaml"
    write_anew(path, "\n".join(lines))
    return path


def write_anew(path: Path, text: str) -> None:
    """Write a file unless it holds this text already, so that ingest finds it unchanged."""
    if not holds(path, text):
        path.write_text(text + "\n", encoding="utf-8")


def holds(path: Path, text: str) -> bool:
    """Test if a file holds a text and a line end."""
    return path.exists() and path.read_text(encoding="utf-8") == text + "\n"


def walker(x: float, y: float, heading_deg: float, *motion: dict[str, Any]) -> dict[str, Any]:
    """Return a person of a scenario who starts at a place and walks, if nothing else is stated."""
    return {
        "start": [x, y],
        "heading_deg": heading_deg,
        "motion": list(motion) or [{"walk": {"distance_m": 7, "speed_mps": 1.2}}],
        "estimate_sigma_m": 0.2,
    }


def scenario_of(people: dict[str, dict[str, Any]], seed: int) -> dict[str, Any]:
    """Return a scenario: three drones with GPS of 0.1 m circle the first person for 6 s."""
    return {
        "schema": 1,
        "name": "People",
        "seed": seed,
        "duration_s": 6,
        "actors": people,
        "world": {"ground": {"size_m": 60}},
        "drones": {
            "count": 3,
            "formation": {"radius_m": 10, "tilt_deg": 25, "yaw_deg": 40 * seed, "yaw_rate_deg_per_s": 6},
            "camera": {"rate_hz": 15},
            "pose_noise": {
                "white": {"position_m": 0.02, "rotation_deg": 0.2},
                "bias": {"position_m": 0.1, "rotation_deg": 0.3},
            },
        },
    }
