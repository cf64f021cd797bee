"""The model files of `blazepose`: where they lie, and how they come out of the wheel that ships them.

The wheel is downloaded and opened, never installed: mediapipe 0.10.21 would force an old numpy on everything.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

from pipelines.session.errors import DataError
from pipelines.session.storage import as_data_error, sha256_of


@dataclass(frozen=True)
class ModelFile:
    """One file that a wheel ships."""

    member: str  # its path inside the wheel
    size: int  # bytes
    sha256: str

    @property
    def name(self) -> str:
        """The last part of its path."""
        return self.member.rpartition("/")[2]


@dataclass(frozen=True)
class WheelModels:
    """Model files that are taken out of one pinned wheel into the user's cache.

    The cache is ~/.cache/mocap/models (XDG_CACHE_HOME is respected), or the folder that MOCAP_MODELS names.
    """

    detector: str
    package: str
    version: str
    tags: tuple[str, str, str]  # Python, ABI and platform of the wheel to take; any machine can open it
    files: tuple[ModelFile, ...]

    @property
    def folder(self) -> Path:
        """Where the files are kept."""
        if chosen := os.environ.get("MOCAP_MODELS"):
            return Path(chosen).expanduser().absolute() / self.detector
        cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
        return Path(cache).expanduser() / "mocap" / "models" / self.detector

    def present(self) -> dict[str, Path | None]:
        """Every file by name: where it is, None where it is missing; the content is not looked at."""
        paths = {file.name: self.folder / file.name for file in self.files}
        return {name: path if path.is_file() else None for name, path in paths.items()}

    def verified(self) -> dict[str, Path]:
        """Every file by name, each proven to be the one expected.

        Raises:
            DataError: one is missing or has other content.
        """
        for file in self.files:
            path = self.folder / file.name
            if not path.is_file():
                raise DataError(path, "is missing", f"run `mocap models fetch {self.detector}`")
            if (found := sha256_of(path)) != file.sha256:
                raise DataError(
                    path,
                    f"is not the file that was expected (SHA-256 {found[:8]}..., not {file.sha256[:8]}...)",
                    f"run `mocap models fetch {self.detector}`",
                )
        return {file.name: self.folder / file.name for file in self.files}

    def fetch(self, source: Path | None = None) -> None:
        """Put the files that are missing or damaged into the cache; with all in place nothing is done.

        Args:
            source: the wheel, or a folder with the files anywhere inside, where they are here already;
                otherwise pip downloads the wheel.

        Raises:
            DataError: no network, or what was found is not what was expected.
        """
        wanted = [file for file in self.files if not self._is_good(file)]
        if not wanted:
            return
        if source is not None:
            self._take(wanted, source)
            return
        with tempfile.TemporaryDirectory(prefix="mocap-") as folder:
            self._take(wanted, self._download(Path(folder)))

    def _is_good(self, file: ModelFile) -> bool:
        path = self.folder / file.name
        return path.is_file() and sha256_of(path) == file.sha256

    def _download(self, folder: Path) -> Path:
        python, abi, platform = self.tags
        done = subprocess.run(  # noqa: S603  # our own arguments, no shell
            [
                *(sys.executable, "-m", "pip", "download", "--quiet", "--no-input", "--no-deps"),
                # Two attempts: without a network the user should not wait for a minute to be told so.
                *("--disable-pip-version-check", "--retries", "1", "--only-binary", ":all:"),
                *("--implementation", "cp", "--python-version", python, "--abi", abi),
                *("--platform", platform, "--dest", str(folder), f"{self.package}=={self.version}"),
            ],
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
        )
        wheels = sorted(folder.glob("*.whl"))
        if done.returncode == 0 and wheels:
            return wheels[0]
        reason = (done.stderr.strip().splitlines() or [f"pip exited with {done.returncode}"])[-1]
        raise DataError(
            self.detector,
            f"its model files could not be downloaded ({reason.removeprefix('ERROR: ')})",
            f"connect to the network, or run `mocap models fetch {self.detector} --from PATH` with the "
            f"{self.package} {self.version} wheel or a folder that holds "
            f"{' and '.join(file.name for file in self.files)}",
        )

    def _take(self, wanted: list[ModelFile], source: Path) -> None:
        try:
            contents = {file: _content(source, file) for file in wanted}
            self.folder.mkdir(parents=True, exist_ok=True)
            for file, content in contents.items():
                _write(self.folder / file.name, content)
        except OSError as error:
            raise as_data_error(error, source) from error


def _content(source: Path, file: ModelFile) -> bytes:
    """The content of a file, from a folder or out of a wheel, proven to be the one expected."""
    # One byte more than expected is enough to see that it is another file, however large that is.
    limit = file.size + 1
    if source.is_dir():
        path = next(iter(sorted(source.rglob(file.name))), None)
        if path is None:
            raise DataError(source, f"holds no {file.name}", "give the folder that does, or the wheel")
        with path.open("rb") as stream:
            content = stream.read(limit)
    else:
        path = source
        try:
            with zipfile.ZipFile(source) as wheel, wheel.open(file.member) as member:
                content = member.read(limit)
        except KeyError:
            raise DataError(source, f"holds no {file.member}", "give the wheel that does") from None
        except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError) as error:
            raise DataError(source, f"is no readable wheel ({error})", "download it again") from None
    if (found := hashlib.sha256(content).hexdigest()) != file.sha256:
        raise DataError(
            path,
            f"its {file.name} is not the one that was expected "
            f"(SHA-256 {found[:8]}..., not {file.sha256[:8]}...)",
            "give the one of the version that was asked for",
        )
    return content


def _write(path: Path, content: bytes) -> None:
    """Write a file so that whoever looks finds all of it or nothing, also while others write the same."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    partial = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
            os.fsync(stream.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


BLAZEPOSE_MODELS = WheelModels(
    detector="blazepose",
    package="mediapipe",
    version="0.10.21",  # the last one that ships models
    tags=("3.11", "cp311", "manylinux_2_28_x86_64"),
    files=(
        ModelFile(
            "mediapipe/modules/pose_detection/pose_detection.tflite",
            2_959_046,
            "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c",
        ),
        ModelFile(
            "mediapipe/modules/pose_landmark/pose_landmark_full.tflite",
            6_440_512,
            "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
        ),
    ),
)
