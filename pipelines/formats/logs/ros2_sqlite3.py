"""Reader of the files of ROS 2 bags that are sqlite3 databases.

From a damaged or shortened file, all rows on readable pages are read. rosbags reads these files
with APSW too. APSW's SQLite reads a long message from the disk without keeping the pages in memory.
"""

from __future__ import annotations

import json
from array import array
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path

import apsw
import numpy as np
from numpy.typing import NDArray

from pipelines.formats.logs.message_decoders import Schema, ros2_name
from pipelines.formats.logs.recordings import (
    DAMAGED,
    TRUNCATED,
    Channel,
    LogPart,
    MessageTable,
    UnlikeError,
    joined_heads,
    require_content,
)
from pipelines.session.errors import DataError
from pipelines.session.records import Int64

MAGIC = b"SQLite format 3\0"

_LARGEST_ROWID = 1 << 48
_BATCH = 4096  # rows at a time
_LISTED = 1 << 14  # rows that are listed at a time
_SMALLEST_ROW = 6  # smallest size of a row in a file, in bytes: length, number, a header of four
_MOST_ATTEMPTS = 10_000  # attempts to continue after damage
_UNREADABLE = (apsw.Error, UnicodeDecodeError)  # text in a damaged file may be invalid UTF-8


class Sqlite3Part(LogPart):
    """sqlite3 file; its table `messages` is read row by row, so that damage costs only the rows it hits."""

    def __init__(self, path: Path, database: Path, file_size: int) -> None:
        super().__init__(path, file_size)
        self.storage = ["sqlite3"]
        self.database = _connect(database)
        try:
            self._read_topics()
            self.take(self._list_messages())
            self._check_length(database)
            self._count_unmerged()
            require_content(self)
        except _UNREADABLE as error:
            self.close()
            raise DataError(
                path, f"cannot be read by sqlite3 ({error})", "try `sqlite3 FILE .recover`, or copy it again"
            ) from None
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the database."""
        self.database.close()

    def read(self, rows: Int64) -> Iterator[tuple[int, bytes]]:
        """Yield the bytes of messages: by one query if they are in the order of receipt, else one by one."""
        places = self.table.place[rows].tolist()
        done = 0
        if places and np.all(np.diff(places) > 0):
            for k, data in self._in_one_query(rows, places):
                yield k, data
                done = k + 1
        for k in range(done, len(places)):
            message = self._message(places[k])
            if message is None:
                self.lose(int(rows[k]), DAMAGED)
            else:
                yield k, message

    def read_alike(self, rows: Int64) -> Iterator[tuple[Int64, NDArray[np.uint8]]]:
        """Join the rows of one query; if a row cannot be read, the messages count as unlike."""
        if not len(rows):
            return
        places = self.table.place[rows]
        length = int(self.table.size[rows[0]])
        try:
            found = self._query(rows, places.tolist())
            for start in range(0, len(rows), _BATCH):
                batch = list(islice(found, min(_BATCH, len(rows) - start)))
                found_places, data = zip(*batch, strict=True) if batch else ((), ())
                if not np.array_equal(found_places, places[start : start + _BATCH]):
                    raise UnlikeError
                if set(map(type, data)) != {bytes} or set(map(len, data)) != {length} or not length:
                    raise UnlikeError
                joined = np.frombuffer(b"".join(data), np.uint8)
                yield rows[start : start + _BATCH], joined.reshape(-1, length)
        except _UNREADABLE as error:
            raise UnlikeError from error

    def read_heads(self, rows: Int64, length: int) -> Iterator[tuple[Int64, Int64, NDArray[np.uint8]]]:
        """Read by queries that name the rows; after the first damage read one by one."""
        # sqlite still reads the messages to their ends, so that damage after a head is found.
        query = (
            "SELECT messages.rowid, length(data), substr(data, 1, ?) "
            "FROM json_each(?) AS wanted CROSS JOIN messages ON messages.rowid = wanted.value"
        )
        done = 0
        try:
            while done < len(rows):
                batch = rows[done : done + _BATCH]
                places = self.table.place[batch].tolist()
                found = self.database.execute(query, (length, json.dumps(places))).fetchall()
                found_places, sizes, heads = zip(*found, strict=True) if found else ((), (), ())
                if found_places != tuple(places) or set(map(type, heads)) != {bytes}:
                    break
                yield batch, np.array(sizes, np.int64), joined_heads(heads, length)
                done += len(batch)
        except _UNREADABLE:
            pass
        yield from super().read_heads(rows[done:], length)

    def _query(self, rows: Int64, places: Sequence[int]) -> apsw.Cursor:
        """Query the rows from the first place to the last, of the topics of some messages."""
        query = (
            "SELECT rowid, data FROM messages WHERE rowid BETWEEN ? AND ? "
            "AND topic_id IN (SELECT value FROM json_each(?)) ORDER BY rowid"
        )
        topics = json.dumps(np.unique(self.table.channel[rows]).tolist())
        return self.database.execute(query, (places[0], places[-1], topics))

    def _in_one_query(self, rows: Int64, places: Sequence[int]) -> Iterator[tuple[int, bytes]]:
        """Yield the messages up to the first damaged one."""
        try:
            found = self._query(rows, places)
            for k, (place, (found_place, data)) in enumerate(zip(places, found, strict=False)):
                if found_place != place or not isinstance(data, bytes):
                    return
                yield k, data
        except _UNREADABLE:
            return

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
            "ifnull(CAST(timestamp AS INTEGER), 0) AS stamp, ifnull(length(data), 0) AS size "
            "FROM messages WHERE rowid > ? ORDER BY rowid"
        )
        numbers = array("q")
        # Pages of a damaged file can form a loop and give rows without end.
        most = 4 * (self.file_size // _SMALLEST_ROW)
        whole = self._take_joined(query, numbers, most)
        attempts = 0
        last, step = numbers[-4] if numbers else -1, 1
        while not whole and last < _LARGEST_ROWID and attempts < _MOST_ATTEMPTS:
            attempts += 1
            begin = len(numbers)
            whole = self._take_rows(query, last, numbers, most)
            if len(numbers) > begin:
                last, step = numbers[-4], 1
            if not whole:
                # A page is missing or damaged: continue after it, in growing steps.
                self.lost["gaps in the table of messages"] += step == 1
                last, step = last + step, 2 * step
        rows = np.array(numbers, np.int64).reshape(-1, 4)
        return MessageTable(rows[:, 1], rows[:, 2], np.zeros(len(rows), np.int64), rows[:, 0], rows[:, 3])

    def _take_joined(self, query: str, numbers: array[int], most: int) -> bool:
        """Append rows like `_take_rows`, in half its time, up to any damage; return True if that was all.

        sqlite joins each column of many rows to one text, which is less work than an object for each number.
        """
        columns = (
            "count(*), group_concat(place), group_concat(topic), group_concat(stamp), group_concat(size)"
        )
        joined = f"SELECT {columns} FROM ({query} LIMIT {_LISTED})"  # noqa: S608  # of constants
        last = -1
        while len(numbers) < most:
            try:
                ((count, *texts),) = self.database.execute(joined, (last,)).fetchall()
            except _UNREADABLE:
                return False
            if not count:
                return True
            rows = np.stack([np.fromstring(str(text), np.int64, sep=",") for text in texts], axis=1)
            if len(rows) != count or (np.diff(rows[:, 0], prepend=last) <= 0).any():
                return False
            numbers.frombytes(rows.tobytes())
            if count < _LISTED:
                return True
            last = int(rows[-1, 0])
        return False

    def _take_rows(self, query: str, last: int, numbers: array[int], most: int) -> bool:
        """Append rows of four numbers; the first must rise from `last` on. Return True if that was all."""
        try:
            found = self.database.execute(query, (last,))
            while len(numbers) < most:
                begin = len(numbers)
                try:
                    # Rows that were read before an error stay.
                    numbers.extend(chain.from_iterable(islice(found, _BATCH)))
                finally:
                    risen = np.diff(np.array(numbers[begin::4], np.int64), prepend=last) > 0
                    taken = len(risen) if risen.all() else int(np.argmin(risen))
                    del numbers[begin + 4 * taken :]
                if taken < len(risen):
                    return False
                if not taken:
                    return True
                last = numbers[-4]
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

    def _count_unmerged(self) -> None:
        log = self.path.with_name(self.path.name + "-wal")
        if log.is_file() and (size := log.stat().st_size):
            self.lost["bytes of its write-ahead log, not merged"] += size


def _connect(path: Path) -> apsw.Connection:
    # Immutable: sqlite neither locks the user's file nor writes beside it.
    flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
    database = apsw.Connection(f"{path.resolve().as_uri()}?immutable=1", flags=flags)
    # The file stays read only, but now sqlite also opens a file shorter than its header states.
    database.execute("PRAGMA writable_schema = ON")
    return database


def has_bag_tables(path: Path) -> bool:
    """Return True if a sqlite3 file has the tables of a bag; if it is unreadable, judge by its suffix."""
    query = "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ('messages', 'topics')"
    database = _connect(path)
    try:
        return database.execute(query).fetchall() == [(2,)]
    except _UNREADABLE:
        return path.suffix.lower() == ".db3"
    finally:
        database.close()
