"""Fetching model files out of a wheel: with pip itself, but from a folder instead of a network."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path

import pytest

from pipelines.keypoints.blazepose_models import BLAZEPOSE_MODELS, ModelFile, WheelModels
from pipelines.session.errors import DataError

TAGS = ("3.11", "cp311", "manylinux_2_28_x86_64")  # as pinned: not what this machine needs to be
WHEEL = "mocap_test_models-1.2-cp311-cp311-manylinux_2_28_x86_64.whl"
CONTENT = {"pose/first.tflite": b"first network" * 100, "pose/second.tflite": b"second network" * 200}


def models(**changed: bytes) -> WheelModels:
    """The models of the test's own wheel; `changed` where other content is expected than it has."""
    files = [
        ModelFile(member, len(content), hashlib.sha256(changed.get(member[5:-7], content)).hexdigest())
        for member, content in CONTENT.items()
    ]
    return WheelModels("testpose", "mocap_test_models", "1.2", TAGS, tuple(files))


@pytest.fixture
def shelf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where pip looks instead of the network; the cache is a temporary folder as well."""
    folder = tmp_path / "shelf"
    folder.mkdir()
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(folder))
    monkeypatch.setenv("MOCAP_MODELS", str(tmp_path / "cache"))
    return folder


def write_wheel(folder: Path, content: dict[str, bytes] = CONTENT) -> Path:
    path = folder / WHEEL
    info = "mocap_test_models-1.2.dist-info"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as wheel:
        for member, data in content.items():
            wheel.writestr(member, data)
        wheel.writestr(
            f"{info}/METADATA",
            # pip must neither want this Python nor follow what it depends on.
            "Metadata-Version: 2.1\nName: mocap-test-models\nVersion: 1.2\n"
            "Requires-Python: ==3.11.*\nRequires-Dist: there-is-no-such-package\n",
        )
        wheel.writestr(f"{info}/WHEEL", f"Wheel-Version: 1.0\nRoot-Is-Purelib: false\nTag: {WHEEL[24:-4]}\n")
        wheel.writestr(f"{info}/RECORD", "")
    return path


def test_files_come_out_of_the_wheel_that_pip_downloads(shelf: Path, tmp_path: Path) -> None:
    write_wheel(shelf)
    wanted = models()
    assert wanted.present() == {"first.tflite": None, "second.tflite": None}
    wanted.fetch()
    folder = tmp_path / "cache" / "testpose"
    assert wanted.verified() == {name: folder / name for name in ("first.tflite", "second.tflite")}
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {
        member[5:]: content for member, content in CONTENT.items()
    }


def test_what_is_there_is_not_fetched_again_and_what_is_damaged_is(shelf: Path) -> None:
    wheel = write_wheel(shelf)
    wanted = models()
    wanted.fetch()
    wheel.unlink()
    wanted.fetch()  # nothing to do, so that no network is needed
    first = wanted.folder / "first.tflite"
    first.write_bytes(b"cut")
    with pytest.raises(DataError, match=r"first\.tflite: is not the file that was expected.*fetch testpose"):
        wanted.verified()
    write_wheel(shelf)
    wanted.fetch()
    assert wanted.verified()["first.tflite"] == first


def test_without_a_network_one_line_says_what_to_do(shelf: Path) -> None:
    with pytest.raises(DataError) as refusal:
        models().fetch()
    line = str(refusal.value)
    assert "\n" not in line
    assert "mocap_test_models==1.2" in line  # pip's own reason
    assert "--from" in line
    assert "first.tflite and second.tflite" in line
    with pytest.raises(DataError, match="is missing; run `mocap models fetch testpose`"):
        models().verified()


def test_files_that_are_here_already_need_no_pip(shelf: Path, tmp_path: Path) -> None:
    models().fetch(write_wheel(tmp_path))
    for path in models().verified().values():
        path.rename(tmp_path / path.name)
    models().fetch(tmp_path)
    assert None not in models().present().values()


def test_other_content_is_refused_and_not_kept(shelf: Path, tmp_path: Path) -> None:
    wheel = write_wheel(tmp_path)
    with pytest.raises(DataError, match=r"second\.tflite is not the one that was expected \(SHA-256"):
        models(second=b"something else").fetch(wheel)
    assert models().present() == {"first.tflite": None, "second.tflite": None}


def test_damaged_and_wrong_sources_are_named(shelf: Path, tmp_path: Path) -> None:
    whole = write_wheel(tmp_path).read_bytes()
    for name, content in {"text.whl": b"no wheel", "cut.whl": whole[: len(whole) // 2]}.items():
        source = tmp_path / name
        source.write_bytes(content)
        with pytest.raises(DataError, match=rf"{name}: is no readable wheel"):
            models().fetch(source)
    other = write_wheel(tmp_path, {"pose/first.tflite": CONTENT["pose/first.tflite"]})
    with pytest.raises(DataError, match=r"holds no pose/second\.tflite"):
        models().fetch(other)
    with pytest.raises(DataError, match=r"holds no first\.tflite"):
        models().fetch(shelf)


def test_a_bomb_is_not_unpacked(shelf: Path, tmp_path: Path) -> None:
    """A member far larger than the file that is expected: only a byte more than that is read."""
    bomb = write_wheel(tmp_path, {**CONTENT, "pose/first.tflite": bytes(200_000_000)})
    with pytest.raises(DataError, match="is not the one that was expected"):
        models().fetch(bomb)


def test_the_cache_is_where_the_user_keeps_caches(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("MOCAP_MODELS", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert BLAZEPOSE_MODELS.folder == tmp_path / "mocap" / "models" / "blazepose"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert BLAZEPOSE_MODELS.folder == tmp_path / ".cache" / "mocap" / "models" / "blazepose"
