"""`mocap models`, as users run it; no test here needs a network."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.commands.runner import refused, succeeds

FILES = ("pose_detection.tflite", "pose_landmark_full.tflite")


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No models in the cache, and no network for pip."""
    monkeypatch.setenv("MOCAP_MODELS", str(tmp_path / "cache"))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    return tmp_path / "cache"


def test_what_is_missing_is_listed_with_the_command_that_gets_it(empty_cache: Path) -> None:
    listed = succeeds("models")
    for file in FILES:
        assert file in listed
    assert "mocap models fetch blazepose" in listed
    detectors = json.loads(succeeds("models", "--json"))["detectors"]
    assert {"blazepose": dict.fromkeys(FILES)} == {
        d["name"]: d["files"] for d in detectors if d["name"] == "blazepose"
    }


def test_list_is_the_same_as_no_subcommand(empty_cache: Path) -> None:
    assert succeeds("models", "list") == succeeds("models")
    assert succeeds("models", "list", "--json") == succeeds("models", "--json")
    assert succeeds("models", "--json", "list") == succeeds("models", "--json")
    assert "list" in succeeds("models", "--help")


def test_what_is_there_is_listed_with_its_place(empty_cache: Path) -> None:
    (empty_cache / "blazepose").mkdir(parents=True)
    for file in FILES:
        (empty_cache / "blazepose" / file).touch()
    listed = succeeds("models")
    assert str(empty_cache / "blazepose" / FILES[0]) in listed
    assert "missing" not in listed


def test_fetching_without_a_network_says_what_to_do(empty_cache: Path) -> None:
    line = refused("models", "fetch", "blazepose")
    assert "could not be downloaded" in line
    assert "--from" in line


def test_fetching_from_a_file_that_is_no_wheel_is_refused(empty_cache: Path, tmp_path: Path) -> None:
    text = tmp_path / "mediapipe.whl"
    text.write_text("not a wheel")
    assert "is no readable wheel" in refused("models", "fetch", "blazepose", "--from", text)


def test_fetching_an_unknown_detector_lists_those_there_are(empty_cache: Path) -> None:
    assert "blazepose" in refused("models", "fetch", "openpose2")
