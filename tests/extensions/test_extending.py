"""The package of examples/extension beside mocap, found only by its entry points."""

import json
import os
import shutil
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.commands.runner import MOCAP

_PACKAGE = Path(__file__).parents[2] / "examples" / "extension"
_SAMPLE = Path(__file__).parents[2] / "sample_data" / "mound_walk"


@pytest.fixture(scope="module")
def outside(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder for the path, with the package's modules and the metadata that pip would write."""
    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(_PACKAGE / "outside", folder / "outside")
    metadata = folder / "outside-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: outside\nVersion: 1.0\n")
    groups = tomllib.loads((_PACKAGE / "pyproject.toml").read_text())["project"]["entry-points"]
    (metadata / "entry_points.txt").write_text(
        "".join(
            f"[{group}]\n{name} = {target}\n"
            for group, entries in groups.items()
            for name, target in entries.items()
        )
    )
    return folder


def _mocap(outside: Path, *arguments: str | Path) -> str:
    done = subprocess.run(
        [MOCAP, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={**os.environ, "PYTHONPATH": str(outside)},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def _true_poses() -> list[list[float]]:
    lines = (_SAMPLE / "truth" / "drone1.tum").read_text().splitlines()
    return [[float(word) for word in line.split()] for line in lines if not line.startswith("#")]


@pytest.fixture(scope="module")
def session(outside: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ingest the sample flight with poses of the first camera from a JSON-lines log."""
    folder = tmp_path_factory.mktemp("flight")
    rows = [
        {"t": t, "topic": "/pose", "p": position, "q": quaternion}
        for t, *position, qx, qy, qz, qw in _true_poses()
        for quaternion in [[qx, qy, qz, qw]]
    ]
    (folder / "d1.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (folder / "flight.yaml").write_text(
        f"""schema: 1
cameras:
  drone1:
    video: {_SAMPLE}/drone1.mp4
    frame_times: {{start: 1700000000.021}}
    intrinsics: {_SAMPLE}/drone1_camera.yaml
    pose: {{file: d1.jsonl, topic: /pose, of: camera}}
  drone2:
    video: {_SAMPLE}/drone2.mp4
    frame_times: {{start: 1700000000.03}}
    intrinsics: {_SAMPLE}/drone2_camera.yaml
    pose: {{file: {_SAMPLE}/truth/drone2.tum}}
map: {_SAMPLE}/site.npz
actor: {{file: {_SAMPLE}/drone1.mcap, topic: /actor}}
""",
        encoding="utf-8",
    )
    _mocap(outside, "ingest", folder / "flight.yaml", "-o", folder / "s.session")
    return folder / "s.session"


def test_a_format_is_read(outside: Path, session: Path) -> None:
    names = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    poses = pd.read_parquet(session / "cameras" / "drone1" / "poses.parquet")
    truth = np.array(_true_poses())
    np.testing.assert_allclose(poses[names], truth[:, 1:], atol=1e-9)  # quaternions are made unit again
    # A float of seconds since 1970 resolves 0.24 microseconds.
    np.testing.assert_allclose((poses["t_ns"] / 1e9).to_numpy(), truth[:, 0], rtol=0, atol=5e-7)
    found = json.loads(_mocap(outside, "info", "--json", session.parent / "d1.jsonl"))
    assert "/pose" in json.dumps(found)


def test_a_detector_and_a_noise_model_are_used_and_an_export_written(outside: Path, session: Path) -> None:
    noise = "sway:position_m=0.1,period_s=4"
    options = ("--detector", "still", "--pictures", "::30", "--pose-noise", noise, "-q", "--method", "robust")
    _mocap(outside, "reconstruct", session, *options)
    found = pd.read_parquet(session / "detect" / "drone1" / "keypoints.parquet")
    assert sorted(found["joint"].unique()) == ["left_hip", "right_hip"]
    # The region is the middle of the picture, 1280 x 720, and stays there.
    assert set(found.loc[found["joint"] == "left_hip", "x"]) == {650.0}
    settings = json.loads((session / "reconstruct" / "stage.json").read_text())["settings"]
    assert "sway" in json.dumps(settings)
    _mocap(outside, "export", session, "--to", "heights", "-o", session.parent / "out")
    heights = dict(line.split() for line in (session.parent / "out" / "heights.txt").read_text().splitlines())
    # Both drones keep the hip in the middle of their pictures; a person's is about a metre above the ground.
    assert 0.5 < float(heights["left_hip"]) < 1.5


def test_an_arm_is_compared(outside: Path, session: Path) -> None:
    _mocap(outside, "replan-compare", session, "--arms", "fixed,opposite", "--trials", "1", "-q")
    arms = {
        name: pd.read_parquet(session / "replan" / name / "trajectories.parquet")
        for name in ("fixed", "opposite")
    }
    turned = arms["opposite"]["formation_yaw_rad"] - arms["fixed"]["formation_yaw_rad"]
    # On the other side: half a turn apart once the formation has arrived.
    assert abs(abs(float(turned.iloc[-1])) - np.pi) < 1e-6
