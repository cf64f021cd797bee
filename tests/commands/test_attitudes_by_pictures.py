"""Flights whose logs have places alone: the film says how the cameras turned."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pipelines.formats.poses import TUM, write_tum
from pipelines.formats.videos.video import VideoReader
from pipelines.geometry.poses import (
    conjugate,
    interpolate_poses,
    multiply,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from pipelines.session.storage import read_json
from pipelines.session.tables import read_poses
from pipelines.session.yaml_files import plain_yaml
from tests.commands.runner import mocap, succeeds

SAMPLE = Path(__file__).parents[2] / "sample_data" / "mound_walk"


def without_attitudes(folder: Path, cameras: list[str], *, sigma_m: float) -> dict[str, Any]:
    """Copy the sample with places alone, off by white errors, in a flight.yaml without attitudes."""
    shutil.copytree(SAMPLE, folder)
    path = folder / "flight.yaml"
    stated: Any = plain_yaml(path, path.read_text(encoding="utf-8"))
    rng = np.random.default_rng(5)
    for name in cameras:
        true = TUM.read_trajectory(folder / "truth" / f"{name}.tum")
        places = true.position + rng.normal(0, sigma_m, true.position.shape)
        rows = [f"{t},{x:.4f},{y:.4f},{z:.4f}" for t, (x, y, z) in zip(true.t_ns, places, strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(["t_ns,x,y,z", *rows]), encoding="utf-8")
        camera = stated["cameras"][name]
        del camera["mount"], camera["gimbal"]
        camera["pose"] = {"file": f"{name}.csv", "attitude": "pictures"}
        camera["pose_noise"] = {"white": {"position_m": sigma_m}, "bias": {"position_m": 0.05}}
    stated["cameras"] = {name: stated["cameras"][name] for name in cameras}
    stated["truth"]["poses"] = {name: stated["truth"]["poses"][name] for name in cameras}
    return dict(stated)


def save(stated: dict[str, Any], manifest: Path) -> None:
    """Write a flight.yaml; JSON is YAML."""
    manifest.write_text(json.dumps(stated), encoding="utf-8")


def attitude_error_deg(session: Path, folder: Path, camera: str) -> float:
    """Return the RMS angle between the attitudes of pictures in a session and the truth, deg."""
    poses = read_poses(session / "cameras" / camera / "poses.parquet")
    true = TUM.read_trajectory(folder / "truth" / f"{camera}.tum")
    logged = true.t_ns, true.position, true.quaternion_xyzw
    there = interpolate_poses(*logged, poses.t_ns, max_gap_ns=10**9, max_extrapolation_ns=10**8)[1]
    off = rotation_vector_from_quaternion(multiply(conjugate(there), poses.quaternion_xyzw))
    return float(np.degrees(np.sqrt(np.square(off).sum(axis=1).mean())))


@pytest.mark.slow
def test_pictures_say_how_a_camera_turned(tmp_path: Path) -> None:
    """Twenty pictures of the sample, 0.3 s apart, in a folder: 0.3 deg; kept until the pictures change."""
    folder = tmp_path / "flight"
    stated = without_attitudes(folder, ["drone1"], sigma_m=0.01)
    (folder / "film").mkdir()
    with VideoReader(folder / "drone1.mp4") as film:
        for number in range(20):
            picture = film.read(9 * number)
            assert picture is not None
            cv2.imwrite(str(folder / "film" / f"{number:03d}.png"), picture)
    camera = stated["cameras"]["drone1"]
    start = camera["frame_times"]["start"]
    camera |= {"video": "film", "frame_times": {"start": start, "fps": "10/3"}}
    manifest = folder / "flight.yaml"

    def ingested() -> Path:
        save(stated, manifest)
        succeeds("ingest", manifest)
        return folder / "flight.session"

    session = ingested()
    assert (off_deg := attitude_error_deg(session, folder, "drone1")) < 0.3
    entry = read_json(session / "session.json")["cameras"]["drone1"]
    found = entry["picture_map"]
    assert found["mapped"] == 20
    # The errors that are said are those that are made, and are the noise of the poses.
    assert off_deg < 3 * np.sqrt(3) * np.hypot(found["common_sigma_deg"], found["picture_sigma_deg"])
    assert entry["pose_noise"]["bias"] == {
        "position_m": 0.05,
        "rotation_deg": pytest.approx(found["common_sigma_deg"], abs=1e-4),
    }
    assert entry["pose_noise"]["white"]["position_m"] == 0.01

    # Other noise lays the same map: nothing is mapped again, as the same bytes show.
    kept = (session / "cameras" / "drone1" / "picture_map.parquet").read_bytes()
    camera["pose_noise"]["white"]["position_m"] = 0.02
    assert (ingested() / "cameras" / "drone1" / "picture_map.parquet").read_bytes() == kept
    # A log whose attitudes are wrong by 20 deg serves as well: its places alone are used.
    true = TUM.read_trajectory(folder / "truth" / "drone1.tum")
    wrong = quaternion_from_rotation_vector(np.radians([20.0, 0.0, 0.0]))
    write_tum(folder / "wrong.tum", replace(true, quaternion_xyzw=multiply(true.quaternion_xyzw, wrong)))
    places, camera["pose"] = camera["pose"], {"file": "wrong.tum", "attitude": "pictures"}
    assert attitude_error_deg(ingested(), folder, "drone1") < 0.3
    entry = read_json(session / "session.json")["cameras"]["drone1"]
    assert entry["picture_map"]["unlike_log"] == 20
    camera["pose"] = places

    # A camera that stands, with a log that does not, is refused.
    for number in range(1, 20):
        shutil.copyfile(folder / "film" / "000.png", folder / "film" / f"{number:03d}.png")
    save(stated, manifest)
    assert mocap("ingest", manifest).code == "no-attitude"
    camera["mount"] = {"looks": "forward"}
    save(stated, manifest)
    assert mocap("ingest", manifest).code == "bad-value"


@pytest.mark.long
def test_the_sample_without_attitudes_is_as_good_as_with_them(tmp_path: Path) -> None:
    """Root-relative errors are at most 1.05 times those of the logged attitudes."""
    folder = tmp_path / "flight"
    stated = without_attitudes(folder, ["drone1", "drone2"], sigma_m=0.02)
    figures = {}
    for name, session in (("logged", SAMPLE / "flight.yaml"), ("pictures", folder / "flight.yaml")):
        if name == "pictures":
            save(stated, session)
        succeeds("ingest", session, "-o", tmp_path / f"{name}.session")
        succeeds("reconstruct", tmp_path / f"{name}.session", "--workers", "2")
        metrics = tmp_path / f"{name}.session" / "reconstruct" / "metrics.json"
        figures[name] = read_json(metrics)["root_mpjpe_mm"]
    assert figures["pictures"] < 1.05 * figures["logged"]
    for camera in ("drone1", "drone2"):
        assert attitude_error_deg(tmp_path / "pictures.session", folder, camera) < 0.3
