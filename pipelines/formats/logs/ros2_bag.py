"""Reader of ROS 2 bags: folders of sqlite3 or MCAP files with or without metadata.yaml, and sqlite3 files.

rosbags decodes the messages; its reader needs a correct metadata.yaml and whole files. From a damaged
database, all rows on readable pages are read. APSW reads a long message without keeping its pages in memory.
"""

from __future__ import annotations

import re
import shutil
from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any

import apsw
import numpy as np

from pipelines.formats.logs.mcap_log import McapPart
from pipelines.formats.logs.message_decoders import Schema, ros2_name
from pipelines.formats.logs.recordings import (
    CHUNK_LIMIT,
    DAMAGED,
    RECORD_AGAIN,
    TRUNCATED,
    Channel,
    LogPart,
    MessageTable,
    OpenLog,
    begins_like,
    inflated_limit,
    open_file,
)
from pipelines.formats.logs.trajectories import open_recording
from pipelines.geometry.arrays import Int64
from pipelines.session.errors import DataError
from pipelines.session.storage import damaged, on_disk
from pipelines.session.yaml_files import plain_yaml

# Causes of losses.
NOT_IN_FILES = "messages that metadata.yaml counts and the files lack"
BAD_METADATA = "metadata.yaml cannot be read"
MISSING_FILES = "files of the bag that are missing"
GAPS = "gaps in the table of messages"

_MAGIC = b"SQLite format 3\0"

# No recording has so many rows, so the search behind damage ends here.
_LARGEST_ROWID = 1 << 48
# So many rows are listed at a time.
_BATCH = 4096
# A row takes at least its length, its number and a header of four bytes.
_SMALLEST_ROW = 6
# A damaged file must not keep the reader busy for ever.
_MOST_ATTEMPTS = 10_000
_UNREADABLE = (apsw.Error, UnicodeDecodeError)  # text in a damaged file may be invalid UTF-8
_WRONG_TYPES = (KeyError, TypeError, AttributeError, RecursionError, OverflowError)  # in metadata.yaml

_INFORMATION = "rosbag2_bagfile_information"
# The parser of YAML is slow, and metadata of real bags is far smaller.
_METADATA_LIMIT = 2 << 20
_VIEWS = (
    "SELECT count(*) FROM sqlite_master WHERE name IN ('messages', 'topics') AND sql NOT LIKE 'CREATE TABLE%'"
)
# A compressed file is copied in pieces of this many bytes.
_COPIED = 1 << 20
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
            return begins_like(path, _MAGIC, self.suffixes) and _has_bag_tables(path)
        except OSError:
            return False

    def describe(self, path: Path) -> dict[str, object]:
        """Describe messages, times, storage, topics, and losses."""
        with self.open_log([path]) as log:
            return log.describe()

    def open_log(self, paths: Sequence[Path]) -> OpenLog:
        """Open a bag's folder, or its files."""
        contents = [_contents(path) for path in paths]
        log = open_recording([file for c in contents for file in c.files], _open_part)
        log.lost += sum((c.lost for c in contents), Counter())
        stated = [c.messages for c in contents if c.messages is not None]
        found = sum(len(part.table.stamp_ns) for part in log.parts)
        if len(stated) == len(contents) and found < sum(stated):
            log.lost[NOT_IN_FILES] = sum(stated) - found
        return log


@dataclass(frozen=True)
class _BagFiles:
    """Files of a bag, with what metadata.yaml states of it."""

    files: list[Path]
    lost: Counter[str]
    messages: int | None = None


def _open_part(path: Path) -> LogPart:
    if path.suffix.lower() == ".zstd":
        return _open_compressed(path)
    file, size = open_file(path)
    with file:
        head = file.read(len(_MAGIC))
    if head != _MAGIC:
        return McapPart(path)
    if not _write_ahead_log(path):
        return Sqlite3Part(path, path, size)
    with TemporaryDirectory() as folder:
        # The folder is deleted while the part is open, which keeps its file by the handle.
        merged = _merged(path, Path(folder))
        return Sqlite3Part(path, merged, merged.stat().st_size)


def _write_ahead_log(path: Path) -> Path | None:
    """Return the log with the last messages of a recorder that lost its power; None without any."""
    log = path.with_name(path.name + "-wal")
    return log if log.is_file() and log.stat().st_size else None


def _merged(path: Path, folder: Path) -> Path:
    """Merge a database with its write-ahead log into a copy in another folder."""
    copy = folder / path.name
    log = _write_ahead_log(path)
    with on_disk(path):
        shutil.copyfile(path, copy)
        if log is not None:
            shutil.copyfile(log, copy.with_name(log.name))
    with suppress(*_UNREADABLE):  # of a damaged log; what the database holds is read
        database = apsw.Connection(str(copy))
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        database.close()
    return copy


def _open_compressed(path: Path) -> LogPart:
    """Open a file of a bag in compression mode `file`, by way of a temporary file."""
    from backports.zstd import ZstdError, ZstdFile

    source, _ = open_file(path)
    with TemporaryDirectory() as folder, source:
        inflated = Path(folder) / path.stem
        whole = True
        most = inflated_limit(path.stat().st_size)
        with inflated.open("wb") as target:
            try:
                with ZstdFile(source) as content:
                    while part_of := content.read(_COPIED):
                        target.write(part_of)
                        if target.tell() > most:
                            problem = f"inflates to more than {most} bytes"
                            raise DataError(path, problem, RECORD_AGAIN, code="too-large")
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


def _contents(path: Path) -> _BagFiles:
    """Return the files of a bag's folder, in order, with its metadata.yaml; a file stands for itself."""
    if not path.is_dir():
        return _BagFiles([path], Counter())
    found = _BagFiles([], Counter())
    if (path / "metadata.yaml").exists():
        try:
            found = _read_metadata(path)
        except (DataError, OSError, ValueError, *_WRONG_TYPES):
            found.lost[BAD_METADATA] = 1
    if missing := sum(not file.is_file() for file in found.files):
        found.lost[MISSING_FILES] = missing
    files = [file for file in found.files if file.is_file()] or _storage_files(path)
    if not files:
        raise damaged(path, "is a bag without its .db3 or .mcap files")
    return replace(found, files=files)


def _read_metadata(folder: Path) -> _BagFiles:
    """Read metadata.yaml; names of files cannot lead out of the bag."""
    path = folder / "metadata.yaml"
    with path.open(encoding="utf-8") as file:
        content: Any = plain_yaml(path, file.read(_METADATA_LIMIT))
    information = content[_INFORMATION]
    files = [folder / PurePath(str(name)).name for name in information["relative_file_paths"]]
    return _BagFiles(files, Counter(), int(information["message_count"]))


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
    """Return True if files are named like parts of one bag: NAME_0, NAME_1, ... or FOLDER_n, or one file."""
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


class Sqlite3Part(LogPart):
    """sqlite3 file; its table `messages` is read row by row, so that damage costs only the rows it hits."""

    def __init__(self, path: Path, database: Path, file_size: int) -> None:
        super().__init__(path, file_size)
        self.storage = ["sqlite3"]
        self.database = _connect(database)
        self.database.limit(apsw.SQLITE_LIMIT_LENGTH, CHUNK_LIMIT)
        try:
            self._refuse_views(path)
            self._read_topics()
            self.take(self._list_messages())
            self._check_length(database)
            self.require_content()
        except _UNREADABLE as error:
            self.close()
            remedy = "try `sqlite3 FILE .recover`, or copy it again"
            raise DataError(path, f"cannot be read by sqlite3 ({error})", remedy, code="damaged") from None
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the database."""
        self.database.close()

    def read(self, rows: Int64) -> Iterator[tuple[int, bytes]]:
        """Yield the bytes of messages, row by row."""
        for k, place in enumerate(self.table.place[rows].tolist()):
            message = self._message(place)
            if message is None:
                self.lose(rows[k : k + 1], DAMAGED)
            else:
                yield k, message

    def _refuse_views(self, path: Path) -> None:
        """Refuse a bag whose messages or topics are computed: a view can go on without end."""
        try:
            ((views,),) = self.database.execute(_VIEWS).fetchall()
        except _UNREADABLE:  # the list of tables is damaged
            return
        if views:
            raise DataError(path, "has a view in place of a table", "give the bag that was recorded")

    def _message(self, place: int) -> bytes | None:
        try:
            row = self.database.execute("SELECT data FROM messages WHERE rowid = ?", (place,)).fetchone()
        except _UNREADABLE:
            return None
        return row[0] if row and isinstance(row[0], bytes) else None

    def _read_topics(self) -> None:
        definitions = self._definitions()
        query = "SELECT CAST(id AS INTEGER), name, type, serialization_format FROM topics"
        for number, name, type_, encoding in self.database.execute(query):
            type_name = ros2_name(str(type_))
            schema = Schema(type_name, str(encoding), *definitions.get(type_name, ()))
            self.channels[number] = Channel(str(name), schema)

    def _definitions(self) -> dict[str, tuple[str, bytes]]:
        """Read the definitions of types, which bags have since ROS 2 Iron; empty without them."""
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        try:
            return {
                ros2_name(str(type_)): (str(encoding), str(text).encode())
                for type_, encoding, text in self.database.execute(query)
                if text
            }
        except _UNREADABLE:
            return {}

    def _list_messages(self) -> MessageTable:
        # A row without a stamp gets an unused topic number, so that it counts as one of an unknown topic.
        query = (
            "SELECT rowid AS place, CASE typeof(timestamp) WHEN 'integer' "
            "THEN ifnull(CAST(topic_id AS INTEGER), -1) ELSE -1 END AS topic, "
            "ifnull(CAST(timestamp AS INTEGER), 0) AS stamp "
            "FROM messages WHERE rowid > ? ORDER BY rowid"
        )
        numbers = array("q")
        # Pages of a damaged file can form a loop and give rows without end.
        most = 3 * (self.file_size // _SMALLEST_ROW)
        whole, attempts, last, step = False, 0, -1, 1
        while not whole and last < _LARGEST_ROWID and attempts < _MOST_ATTEMPTS:
            attempts += 1
            begin = len(numbers)
            whole = self._take_rows(query, last, numbers, most)
            if len(numbers) > begin:
                last, step = numbers[-3], 1
            if not whole:
                # A page is missing or damaged: continue after it, in growing steps.
                self.lost[GAPS] += step == 1
                last, step = last + step, 2 * step
        rows = np.array(numbers, np.int64).reshape(-1, 3)
        return MessageTable(rows[:, 1], rows[:, 2], np.zeros(len(rows), np.int64), rows[:, 0])

    def _take_rows(self, query: str, last: int, numbers: array[int], most: int) -> bool:
        """Append rows of three numbers; the first must rise from `last` on. Return True if that was all."""
        try:
            found = self.database.execute(query, (last,))
            while len(numbers) < most:
                begin = len(numbers)
                try:
                    # Rows that were read before an error stay.
                    numbers.extend(chain.from_iterable(islice(found, _BATCH)))
                finally:
                    risen = np.diff(np.array(numbers[begin::3], np.int64), prepend=last) > 0
                    taken = len(risen) if risen.all() else int(np.argmin(risen))
                    del numbers[begin + 3 * taken :]
                if taken < len(risen):
                    return False
                if not taken:
                    return True
                last = numbers[-3]
        except _UNREADABLE:
            pass
        return False

    def _check_length(self, database: Path) -> None:
        """Compare the file's size with that in its header (sqlite.org/fileformat2.html, section 1.3)."""
        with database.open("rb") as file:
            header = file.read(100)
        page_size = int.from_bytes(header[16:18], "big")
        pages = int.from_bytes(header[28:32], "big")
        if pages * (65536 if page_size == 1 else page_size) > self.file_size:
            self.lost[TRUNCATED] = 1


def _connect(path: Path) -> apsw.Connection:
    # Immutable: sqlite neither locks the user's file nor writes beside it.
    flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
    database = apsw.Connection(f"{path.resolve().as_uri()}?immutable=1", flags=flags)
    # The file stays read only, but now sqlite also opens a file shorter than its header states.
    database.execute("PRAGMA writable_schema = ON")
    return database


def _has_bag_tables(path: Path) -> bool:
    """Return True if a sqlite3 file has the tables of a bag; if it is unreadable, judge by its suffix."""
    if _write_ahead_log(path) or not path.stat().st_size:
        return path.suffix.lower() == ".db3"
    query = "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ('messages', 'topics')"
    database = _connect(path)
    try:
        return database.execute(query).fetchall() == [(2,)]
    except _UNREADABLE:
        return path.suffix.lower() == ".db3"
    finally:
        database.close()


FORMAT = Ros2Bag()
