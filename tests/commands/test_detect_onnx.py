"""The user's own model through the commands: spans, errors, and a kill in the middle."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pipelines.session.registries import need
from pipelines.session.storage import read_json
from tests.commands.runner import refused, succeeds
from tests.keypoints.spotted_flights import FPS, person_at, spot_detector, write_spotted_flight


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
    text = tmp_path / "text.onnx"
    text.write_text("no model")
    assert "is no model" in refused(
        "reconstruct", session, "--method", "robust", "--detector", f"onnx:{text}"
    )


def test_another_provider_detects_anew_and_one_that_is_not_there_is_refused(tmp_path: Path) -> None:
    session = write_spotted_flight(tmp_path, 5).with_suffix(".session")
    succeeds("ingest", tmp_path / "flight.yaml")
    detector = spot_detector(tmp_path).removesuffix(",provider=cpu")
    reconstruct = ("reconstruct", session, "--detector")
    line = refused(*reconstruct, f"{detector},provider=QuantumExecutionProvider")
    assert "provider=quantum" in line
    assert "cpu" in line
    assert not (session / "detect").exists()
    succeeds(*reconstruct, detector)
    assert "unchanged" in succeeds(*reconstruct, f"{detector},provider=CPUExecutionProvider")
    assert provider(session) == "cpu"
    onnxruntime = need("onnxruntime", "onnx")
    others = [name for name in onnxruntime.get_available_providers() if name != "CPUExecutionProvider"]
    if not others:
        pytest.skip("this ONNX Runtime has no other provider")
    succeeds(*reconstruct, f"{detector},provider={others[0]}")
    assert provider(session) == others[0].removesuffix("ExecutionProvider").lower()


def provider(session: Path) -> str:
    """Return the provider that the stage says ran the models."""
    stage = read_json(session / "detect" / "stage.json")
    stated = dict(option.split("=", 1) for option in stage["settings"]["detector"][len("onnx:") :].split(","))
    return str(stated["provider"])
