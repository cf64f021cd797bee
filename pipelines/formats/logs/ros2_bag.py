"""Reader of ROS 2 bags: folders of sqlite3 or MCAP files with or without metadata.yaml, and sqlite3 files.

rosbags decodes the messages. But its reader needs a correct metadata.yaml and files that can be
read to their end. So this module reads the files itself.
"""

from __future__ import annotations

import re
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any

from pipelines.formats.logs.mcap_log import open_mcap
from pipelines.formats.logs.recordings import (
    TRUNCATED,
    LogPart,
    OpenLog,
    describe_log,
    open_file,
    open_parts,
)
from pipelines.formats.logs.ros2_sqlite3 import MAGIC, Sqlite3Part, has_bag_tables
from pipelines.session.errors import DataError
from pipelines.session.storage import is_special
from pipelines.session.yaml_files import plain_yaml

_INFORMATION = "rosbag2_bagfile_information"
_METADATA_LIMIT = 16 << 20  # bytes of a metadata.yaml
_SUFFIXES = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")


class Ros2Bag:
    """Reader of ROS 2 bags. A folder is one recording; its files are merged in the order of receipt."""

    name = "ros2"
    title = "ROS 2 bag"
    suffixes: tuple[str, ...] = (".db3",)

    def recognises(self, path: Path) -> bool:
        """Return True for a bag's folder, with or without metadata.yaml, or sqlite3 with a bag's tables."""
        try:
            if path.is_dir():
                return _states_a_bag(path / "metadata.yaml") or _is_one_bag(_storage_files(path))
            if is_special(path):
                return False
            with path.open("rb") as file:
                head = file.read(len(MAGIC))
        except OSError:
            return False
        if head != MAGIC:
            return not head and path.suffix.lower() in self.suffixes
        return has_bag_tables(path)

    def describe(self, path: Path) -> dict[str, object]:
        """Describe messages, times, storage, topics, losses, and differences from metadata.yaml."""
        with self.open_log([path]) as log:
            facts = describe_log(log)
        stated = _contents(path).stated
        if stated and facts["messages"] and stated.times != {key: facts[key] for key in stated.times}:
            facts["metadata.yaml states"] = stated.times
        return facts

    def open_log(self, paths: Sequence[Path]) -> OpenLog:
        """Open a bag's folder, or its files.

        Raises:
            DataError: no file can be read, or all are without content.
        """
        contents = [_contents(path) for path in paths]
        parts, lost = open_parts([file for c in contents for file in c.files], _open_part)
        lost = sum((c.lost for c in contents), lost)
        stated = [c.stated.messages for c in contents if c.stated]
        found = sum(len(part.table.stamp_ns) for part in parts)
        if len(stated) == len(contents) and found < sum(stated):
            lost["messages that metadata.yaml counts and the files lack"] = sum(stated) - found
        return OpenLog(parts, lost)


@dataclass(frozen=True)
class _Metadata:
    """Content of metadata.yaml about the whole bag."""

    files: list[str]
    messages: int
    times: dict[str, object]  # first_ns and span_s


@dataclass(frozen=True)
class _Contents:
    files: list[Path]
    lost: Counter[str]
    stated: _Metadata | None = None


def _open_part(path: Path) -> LogPart:
    if path.suffix.lower() == ".zstd":
        return _open_compressed(path)
    file, size = open_file(path)
    with file:
        head = file.read(len(MAGIC))
    return Sqlite3Part(path, path, size) if head == MAGIC else open_mcap(path)


def _open_compressed(path: Path) -> LogPart:
    """Open a file of a bag in compression mode `file`, by way of a temporary file."""
    from backports.zstd import ZstdError, ZstdFile

    source, _ = open_file(path)
    with TemporaryDirectory() as folder, source:
        inflated = Path(folder) / path.stem
        whole = True
        with inflated.open("wb") as target:
            try:
                with ZstdFile(source) as content:
                    shutil.copyfileobj(content, target)
            except (ZstdError, EOFError):
                whole = False
        # The folder is deleted while the part is open, which keeps its file by the handle.
        part = _open_part(inflated)
    part.path = path
    part.file_size = path.stat().st_size
    part.storage.append("zstd files")
    if not whole:
        part.lost[TRUNCATED] += 1
    return part


def _contents(path: Path) -> _Contents:
    """Return the files of a bag's folder, in order, with its metadata.yaml; a file stands for itself."""
    if not path.is_dir():
        return _Contents([path], Counter())
    lost: Counter[str] = Counter()
    stated = None
    if (path / "metadata.yaml").exists():
        try:
            stated = _read_metadata(path / "metadata.yaml")
        except ValueError:
            lost["metadata.yaml cannot be read"] = 1
    files = [path / PurePath(name).name for name in (stated.files if stated else [])]
    if missing := sum(not file.is_file() for file in files):
        lost["files of the bag that are missing"] = missing
    files = [file for file in files if file.is_file()] or _storage_files(path)
    if not files:
        raise DataError(path, "is a bag without its .db3 or .mcap files", "copy the whole folder again")
    return _Contents(files, lost, stated)


def _read_metadata(path: Path) -> _Metadata:
    """Read metadata.yaml; ValueError if a required value is missing or invalid."""
    try:
        with path.open(encoding="utf-8") as file:
            content: Any = plain_yaml(path, file.read(_METADATA_LIMIT))
        information = content[_INFORMATION]
        return _Metadata(
            files=[str(name) for name in information["relative_file_paths"]],
            messages=int(information["message_count"]),
            times={
                "first_ns": int(information["starting_time"]["nanoseconds_since_epoch"]),
                "span_s": int(information["duration"]["nanoseconds"]) / 1e9,
            },
        )
    except (DataError, OSError, KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise ValueError(str(error)) from error


def _states_a_bag(metadata: Path) -> bool:
    if not metadata.is_file():
        return False
    with metadata.open("rb") as file:
        return _INFORMATION.encode() in file.read(4096)


def _storage_files(folder: Path) -> list[Path]:
    """Return the files that may belong to a bag, by the number at the end of their names."""
    files = [f for f in folder.iterdir() if f.is_file() and f.name.lower().endswith(_SUFFIXES)]
    return sorted(files, key=lambda file: (_numbered(file) or ("", 0), file.name))


def _is_one_bag(files: Sequence[Path]) -> bool:
    """Return True if files are named like parts of one bag: NAME_0, NAME_1, ... or FOLDER_n, or one file.

    The logs of several drones in one folder, each a file, must not pass for one recording.
    """
    if len(files) == 1:
        return True
    numbered = [_numbered(file) for file in files]
    stems = {entry[0] if entry else "" for entry in numbered}
    if len(stems) != 1 or None in numbered:
        return False
    numbers = sorted(entry[1] for entry in numbered if entry)
    return numbers == list(range(len(numbers))) or stems == {files[0].parent.name}


def _numbered(file: Path) -> tuple[str, int] | None:
    match = re.fullmatch(r"(.*)_(\d{1,9})\.(db3|mcap)(\.zstd)?", file.name, re.IGNORECASE)
    return (match[1], int(match[2])) if match else None


FORMAT = Ros2Bag()
