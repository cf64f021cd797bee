"""`mocap models`; no test here needs a network."""

import tarfile
from pathlib import Path

import pytest

from tests.commands.runner import refused, result_of, succeeds

FILES = ("pose_detection.tflite", "pose_landmark_full.tflite")
HEAVY = "pose_landmark_heavy.tflite"


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Set an empty cache of models, and no network for pip."""
    monkeypatch.setenv("MOCAP_MODELS", str(tmp_path / "cache"))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    return tmp_path / "cache"


def test_what_is_missing_is_listed_with_the_command_that_gets_it(empty_cache: Path) -> None:
    listed = succeeds("models")
    for file in (*FILES, HEAVY):
        assert file in listed
    for name in ("blazepose", "blazepose-heavy"):
        assert f"`mocap models fetch {name}`" in listed
    detectors = result_of("models")["detectors"]
    assert {d["name"]: d["files"] for d in detectors} == {
        "blazepose": dict.fromkeys(FILES),
        "blazepose-heavy": dict.fromkeys((FILES[0], HEAVY)),
    }


def test_what_is_there_is_listed_with_its_place(empty_cache: Path) -> None:
    (empty_cache / "blazepose").mkdir(parents=True)
    for file in FILES:
        (empty_cache / "blazepose" / file).touch()
    listed = succeeds("models")
    assert str(empty_cache / "blazepose" / FILES[0]) in listed
    assert [line.split()[3] for line in listed.splitlines() if line.endswith("missing")] == [HEAVY]


def test_fetching_without_a_network_says_what_to_do(empty_cache: Path) -> None:
    line = refused("models", "fetch", "blazepose")
    assert "could not be downloaded" in line
    assert "--from" in line


def test_heavy_without_npm_says_what_to_do(empty_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(empty_cache))
    line = refused("models", "fetch", "blazepose-heavy")
    for part in ("npm", "--from", HEAVY):
        assert part in line
    assert not empty_cache.exists()


def test_heavy_from_a_tarball_of_something_else_is_refused(empty_cache: Path, tmp_path: Path) -> None:
    tarball = tmp_path / "mediapipe-pose.tgz"
    tarball.write_text("not a tarball")
    assert "is no readable tarball" in refused("models", "fetch", "blazepose-heavy", "--from", tarball)
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / HEAVY).write_bytes(b"another network")
    with tarfile.open(tarball, "w:gz") as made:
        made.add(tmp_path / "package", "package")
    line = refused("models", "fetch", "blazepose-heavy", "--from", tarball)
    assert "of 27709200" in line
    assert not empty_cache.exists()


def test_fetching_an_unknown_name_lists_what_has_models(empty_cache: Path) -> None:
    line = refused("models", "fetch", "openpose2")
    assert "blazepose" in line
