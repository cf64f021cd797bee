"""Recordings: files that each list their messages; topics, order of receipt over all files, and losses.

A part (one file) knows the position of every message before any is read. So messages come in order without
being kept in memory, and every loss has a cause and a count. ROS 1 bags and MCAP are files of chunks: they
are walked from record to record, without their summary, so the same code reads a file that ends early.
"""

from __future__ import annotations

import heapq
import zlib
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import IO

import numpy as np

from pipelines.formats.common.files import first_bytes
from pipelines.formats.logs.message_decoders import Schema, decoder, inflate
from pipelines.geometry.arrays import Bool, Int64
from pipelines.session.errors import DataError
from pipelines.session.recognition import describe_lfs_pointer
from pipelines.session.records import Message, Topic
from pipelines.session.storage import damaged, on_disk, refuse_special

# Causes of losses, as sessions and `mocap info` state them.
UNDEFINED = "messages without a usable definition"
UNDECODABLE = "messages that cannot be decoded"
DAMAGED = "messages in damaged blocks"
MISPLACED = "messages that are not where the index says"
UNNAMED = "messages of unknown topics"
TRUNCATED = "file truncated"
UNCLOSED = "recording not closed"
TAIL = "bytes after the last complete record"
UNREADABLE_FILES = "files that cannot be read"
UNINDEXED = "damaged blocks without an index"
NOT_FOUND = "messages stated but not found"

# No recorder writes larger chunks, so a larger size in a header is damage.
CHUNK_LIMIT = 1 << 28
RECORD_AGAIN = "no recorder writes this; copy it again from the drone"
# The places of so many messages are Python integers at a time, which takes 10 MB.
_BATCH = 1 << 16
# A type takes a millisecond to understand, and PX4 has 250.
_MOST_TYPES = 2000
# Chunks that overlap in time are kept up to this many bytes.
_CACHE = 64 << 20
# Even an empty chunk counts as so many bytes.
_CACHED_CHUNK = 1 << 16
# A small file may inflate to anything. Logs compress to a tenth, black pictures to a hundredth. The stamps of
# messages differ, so that a message takes a byte at the least.
_INFLATED = 1 << 30  # bytes of all chunks in any file
_MOST_EXPANSION = 100  # bytes for one in the file
_RECORDS = 100_000  # in the chunks of any file; one more for each of its bytes
# Some recorders leave indices of chunks out, and some write an index of no message for each channel.
_BARE = 10_000  # such chunks and indices in any file; one more for each 256 bytes
_BARE_SIZE = 256


@dataclass(frozen=True)
class Channel:
    """Topic as one file names it, with the schema of its messages."""

    topic: str
    schema: Schema

    @property
    def key(self) -> tuple[str, str, str]:
        """Name, type and encoding, by which channels of several files are one topic."""
        return self.topic, self.schema.type, self.schema.encoding


@dataclass(frozen=True)
class MessageTable:
    """Positions of the messages of a file, in the order of the file; all arrays are [M]."""

    channel: Int64
    stamp_ns: Int64  # of receipt
    block: Int64  # block that must be read as a whole; 0 if there are no blocks
    place: Int64  # within the block

    def rows(self, which: Int64 | Bool) -> MessageTable:
        """Return some rows."""
        return MessageTable(self.channel[which], self.stamp_ns[which], self.block[which], self.place[which])


class LogPart(ABC):
    """Open file of a log."""

    def __init__(self, path: Path, file_size: int) -> None:
        self.path = path
        self.file_size = file_size
        self.channels: dict[int, Channel] = {}
        self.storage: list[str] = []  # kinds of storage, for `mocap info`
        self.lost: Counter[str] = Counter()  # losses of the file as a whole
        none = np.zeros(0, np.int64)
        self.table = MessageTable(none, none, none, none)
        self.received_ns = none  # [M] stamps of receipt, without steps of the recorder's clock
        self._fates: dict[int, str] = {}  # cause of loss, by row of the table
        self._rows: dict[int, Int64] = {}  # of each channel, in the order of the file

    @abstractmethod
    def close(self) -> None:
        """Close the file."""

    @abstractmethod
    def read(self, rows: Int64) -> Iterator[tuple[int, memoryview | bytes]]:
        """Yield the bytes of messages, by rows of the table; pass unreadable rows to `lose`."""

    def take(self, table: MessageTable) -> None:
        """Keep the table of found messages, without those of undefined channels, which are counted."""
        types = len({channel.schema for channel in self.channels.values()})
        if types > _MOST_TYPES:
            raise damaged(self.path, f"defines {types} types of messages")
        named = np.isin(table.channel, list(self.channels))
        if strangers := int(np.count_nonzero(~named)):
            self.lost[UNNAMED] += strangers
            table = table.rows(named)
        self.table, self.received_ns = table, table.stamp_ns
        by_channel = np.argsort(table.channel, kind="stable")
        numbers, first = np.unique(table.channel[by_channel], return_index=True)
        rows = np.split(by_channel.astype(np.int64), first[1:]) if len(numbers) else []
        self._rows = dict(zip(numbers.tolist(), rows, strict=True))

    def require_content(self) -> None:
        """Refuse a damaged file without any readable message; an undamaged file may be empty."""
        if self.lost and not len(self.table.stamp_ns):
            causes = ", ".join(f"{cause}: {count}" for cause, count in sorted(self.lost.items()))
            raise damaged(self.path, f"holds no message that can be read ({causes})")

    def lose(self, rows: Int64, cause: str) -> None:
        """Note why messages could not be read; a second reading counts them once only."""
        self._fates |= dict.fromkeys(rows.tolist(), cause)

    def forget(self) -> None:
        """Forget the losses of the readings so far; those of the file as a whole stay."""
        self._fates.clear()

    @property
    def dropped(self) -> Counter[str]:
        """All losses so far, by cause."""
        return self.lost + Counter(self._fates.values())

    def rows_of(self, channels: Collection[int]) -> Int64:
        """Return the rows of some channels, in the order of receipt; equal stamps keep the file's order."""
        found = [rows for channel in dict.fromkeys(channels) if (rows := self._rows.get(channel)) is not None]
        rows = np.sort(np.concatenate([np.zeros(0, np.int64), *found]))
        return rows[np.argsort(self.received_ns[rows], kind="stable")]


# --- files of chunks -----------------------------------------------------------------------------------


@dataclass
class Chunk:
    """Position of a chunk's content in the file, and the positions of its messages by the index."""

    offset: int
    length: int  # bytes in the file
    compression: str
    size: int  # bytes once decompressed
    crc: int = 0  # 0: the file has none
    cut: bool = False  # the file ends within this chunk
    index: list[Int64] = field(default_factory=list)  # a channel's [n, 3] each: channel, stamp, place


@dataclass(frozen=True)
class Content:
    """Records found in a chunk."""

    channels: dict[int, Channel]
    index: list[tuple[int, int, int]]  # channel, stamp, place
    end: int  # of the last complete record


class ChunkedPart(LogPart):
    """File of chunks. A format walks its records, searches chunks and finds a message's bytes."""

    def __init__(self, path: Path) -> None:
        self.file, file_size = open_file(path)
        super().__init__(path, file_size)
        self.chunks: list[Chunk] = []
        self.messages_stated = 0  # by the file's summary
        self._bare = 0  # chunks without an index, other than the last, and indices of no message
        self._cache: dict[int, memoryview | None] = {}
        self._cached = 0
        self._records_left = _RECORDS + file_size
        try:
            end, closed = self.walk()
            self._note_end(end, closed)
            self._refuse_bombs()
            self._look_into_chunks(closed)
            self.take(self._table())
            found = len(self.table.stamp_ns) + self.lost[UNNAMED]
            self.lost += Counter({NOT_FOUND: self.messages_stated - found})
            self.require_content()
        except BaseException:
            self.file.close()
            raise

    @abstractmethod
    def walk(self) -> tuple[int, bool]:
        """Find chunks, index and channels; return the end of the last complete record, and True if closed."""

    @abstractmethod
    def look(self, content: memoryview) -> Content:
        """Find the records of a chunk."""

    @abstractmethod
    def payload(self, content: memoryview, place: int, channel: int, stamp_ns: int) -> memoryview:
        """Return the bytes of the message at the index's place; ValueError if it is not there."""

    def take_chunk(self, chunk: Chunk) -> None:
        """Add the next chunk of the file."""
        self._count_bare(bare=bool(self.chunks) and not self.chunks[-1].index)
        self.chunks.append(chunk)
        if (kind := chunk.compression or "uncompressed") not in self.storage:
            self.storage.append(kind)

    def take_index(self, rows: Int64) -> None:
        """Add an index [n, 3] of channel, stamp and place to the last chunk."""
        self._count_bare(bare=not len(rows))
        self.chunks[-1].index.append(rows)

    def count_record(self) -> None:
        """Count a record that was found in a chunk."""
        self._records_left -= 1
        if self._records_left < 0:
            problem = "inflates to more messages than it has bytes"
            raise DataError(self.path, problem, RECORD_AGAIN, code="too-large")

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    def forget(self) -> None:
        """Forget the losses, and free the chunks of the last reading."""
        super().forget()
        self._cache.clear()
        self._cached = 0

    def read(self, rows: Int64) -> Iterator[tuple[int, memoryview]]:
        """Yield the bytes of messages, as views into their chunk."""
        table = self.table.rows(rows)
        places = (table.block, table.place, table.channel, table.stamp_ns)
        last_of_block = dict(zip(table.block.tolist(), range(len(rows)), strict=True))
        for k, (block, place, channel, stamp_ns) in enumerate(
            zip(*(column.tolist() for column in places), strict=True)
        ):
            content = self._content(block)
            if last_of_block[block] == k:
                self._drop(block)
            try:
                data = None if content is None else self.payload(content, place, channel, stamp_ns)
            except ValueError:
                self.lose(rows[k : k + 1], MISPLACED)
                continue
            if data is None:
                self.lose(rows[k : k + 1], DAMAGED)
            else:
                yield k, data

    def bytes_at(self, offset: int, length: int) -> bytes:
        """Read bytes of the file; fewer at its end."""
        self.file.seek(offset)
        return self.file.read(max(0, min(length, self.file_size - offset)))

    def _count_bare(self, *, bare: bool) -> None:
        self._bare += bare
        if self._bare > max(_BARE, self.file_size // _BARE_SIZE):
            problem = f"holds {self._bare} chunks without an index or empty indices in {self.file_size} bytes"
            raise damaged(self.path, problem)

    def _note_end(self, end: int, closed: bool) -> None:
        if not closed:
            self.lost[TRUNCATED if end < self.file_size else UNCLOSED] += 1
        cut_chunk = bool(self.chunks) and self.chunks[-1].cut
        if end < self.file_size and not cut_chunk:
            self.lost[TAIL] += self.file_size - end

    def _look_into_chunks(self, closed: bool) -> None:
        for number, chunk in enumerate(self.chunks):
            # The index of the last chunk may be incomplete.
            unindexed = not chunk.index or (not closed and chunk is self.chunks[-1])
            mentioned = {int(rows[0, 0]) for rows in chunk.index if len(rows)}
            if not unindexed and mentioned <= self.channels.keys():
                continue
            content = self._content(number)
            if content is None:
                self.lost += Counter({UNINDEXED: int(unindexed)})
                continue
            found = self.look(content)
            self.channels = found.channels | self.channels
            if unindexed:
                chunk.index = [np.array(found.index, np.int64).reshape(-1, 3)]
                self.lost += Counter({TAIL: len(content) - found.end})

    def _content(self, number: int) -> memoryview | None:
        if number not in self._cache:
            content = self._cache[number] = self._inflated(self.chunks[number])
            self._cached += len(content or b"") + _CACHED_CHUNK
            while len(self._cache) > 1 and self._cached > _CACHE:
                self._drop(next(iter(self._cache)))
        return self._cache[number]

    def _drop(self, number: int) -> None:
        self._cached -= len(self._cache.pop(number) or b"") + _CACHED_CHUNK

    def _refuse_bombs(self) -> None:
        """Refuse a file whose chunks inflate beyond reason; none is inflated to more than it states."""
        sizes = [chunk.size for chunk in self.chunks if chunk.size <= CHUNK_LIMIT]
        if sum(sizes) > inflated_limit(self.file_size):
            raise damaged(self.path, f"inflates from {self.file_size} to {sum(sizes)} bytes")

    def _inflated(self, chunk: Chunk) -> memoryview | None:
        if max(chunk.size, chunk.length) > CHUNK_LIMIT:
            return None
        try:
            data = self.bytes_at(chunk.offset, chunk.length)
            content, complete = inflate(data, chunk.compression, chunk.size)
        except ValueError:
            return None
        if not chunk.cut and not (complete and len(content) == chunk.size):
            return None
        if chunk.crc and not chunk.cut and zlib.crc32(content) != chunk.crc:
            return None
        return memoryview(content)

    def _table(self) -> MessageTable:
        blocks = [np.full(sum(map(len, c.index)), n, np.int64) for n, c in enumerate(self.chunks)]
        block = np.concatenate([*blocks, np.zeros(0, np.int64)])
        rows = np.concatenate([*(part for c in self.chunks for part in c.index), np.zeros((0, 3), np.int64)])
        order = np.lexsort((rows[:, 2], block))
        rows = rows[order]
        return MessageTable(rows[:, 0], rows[:, 1], block[order], rows[:, 2])


def inflated_limit(file_size: int) -> int:
    """Return the most bytes to which a compressed log may inflate."""
    return max(_INFLATED, _MOST_EXPANSION * file_size)


# --- logs of one file or several --------------------------------------------------------------------------


class OpenLog(AbstractContextManager["OpenLog"]):
    """Open log of one or more parts."""

    def __init__(self, parts: Sequence[LogPart], lost: Counter[str]) -> None:
        self.parts = parts
        self.notes: list[str] = []  # on steps of the recorder's clock
        self.lost = lost
        # Numbers of the channels of a topic in each part, found once: a log may hold 60,000 topics.
        self._channels: dict[tuple[str, str, str], dict[int, list[int]]] = {}
        for place, part in enumerate(parts):
            for number, channel in part.channels.items():
                self._channels.setdefault(channel.key, {}).setdefault(place, []).append(number)
        self._topics = self._summaries()

    def __exit__(self, *exception: object) -> None:
        for part in self.parts:
            part.close()

    @property
    def topics(self) -> Sequence[Topic]:
        """Channels, by name; a name whose messages are of two types is there twice."""
        return list(self._topics.values())

    @property
    def dropped(self) -> dict[str, int]:
        """Losses so far, counted by cause: of the files, then of the messages asked for."""
        total = sum((part.dropped for part in self.parts), Counter(self.lost))
        return dict(sorted(total.items()))

    def forget(self) -> None:
        """Forget the losses of the readings so far, so that `dropped` describes the next one alone."""
        for part in self.parts:
            part.forget()

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Yield the messages of some topics in the order of their receipt."""
        streams = [self.messages_of(part, topics) for part in self.parts]
        return streams[0] if len(streams) == 1 else heapq.merge(*streams, key=attrgetter("receive_ns"))

    def describe(self) -> dict[str, object]:
        """Describe files, messages, times and storage of a log, each topic, and losses by cause."""
        topics = self.topics
        first = min((t.first_ns for t in topics if t.first_ns is not None), default=None)
        last = max((t.last_ns for t in topics if t.last_ns is not None), default=None)
        facts: dict[str, object] = {
            "files": len(self.parts),
            "storage": sorted({word for part in self.parts for word in part.storage}),
            "size_bytes": sum(part.file_size for part in self.parts),
            "messages": sum(topic.count for topic in topics),
        }
        if first is not None and last is not None:
            facts |= {"first_ns": first, "last_ns": last, "span_s": (last - first) / 1e9}
        named = Counter(topic.name for topic in topics)
        facts["topics"] = {
            topic.name if named[topic.name] == 1 else f"{topic.name} ({topic.type})": self._described(topic)
            for topic in topics
        }
        facts |= {"notes": self.notes} if self.notes else {}
        return facts | {f"dropped: {cause}": count for cause, count in self.dropped.items()}

    def _described(self, topic: Topic) -> dict[str, object]:
        facts: dict[str, object] = {"type": topic.type, "encoding": topic.encoding, "messages": topic.count}
        channels = self._channels[(topic.name, topic.type, topic.encoding)]
        if topic.first_ns is not None and topic.last_ns is not None:
            span_ns = topic.last_ns - topic.first_ns
            facts |= {"first_ns": topic.first_ns, "last_ns": topic.last_ns}
            if span_ns:
                parts = [(self.parts[place], own) for place, own in channels.items()]
                stamps = np.sort(np.concatenate([part.received_ns[part.rows_of(own)] for part, own in parts]))
                facts["rate_hz"] = round((topic.count - 1) / span_ns * 1e9, 3)
                facts["longest_gap_s"] = round(int(np.diff(stamps).max()) / 1e9, 6)
        for schema in {self.parts[k].channels[n].schema: None for k, own in channels.items() for n in own}:
            try:
                decoder(schema)
            except ValueError as error:
                facts["cannot be decoded"] = str(error)
                break
        return facts

    def take_out(self, part: LogPart, row: int, step_ns: int) -> None:
        """Take a step of the recorder's clock out of the stamps of receipt, from a row of a part on."""
        part.received_ns = part.received_ns.copy()
        part.received_ns[row:] -= step_ns
        for later in self.parts[self.parts.index(part) + 1 :]:
            later.received_ns = later.received_ns - step_ns
        self._topics = self._summaries()

    def messages_of(self, part: LogPart, topics: Collection[str]) -> Iterator[Message]:
        """Yield the messages of some topics in one part, in the order of their receipt."""
        decoders, wanted = {}, frozenset(topics)
        for number, channel in part.channels.items():
            if channel.topic in wanted:
                try:
                    decoders[number] = decoder(channel.schema), self._topics[channel.key]
                except ValueError:
                    part.lose(part.rows_of([number]), UNDEFINED)
        rows = part.rows_of(decoders)
        for start in range(0, len(rows), _BATCH):
            batch = rows[start : start + _BATCH]
            stamps = part.received_ns[batch].tolist()
            channels = part.table.channel[batch].tolist()
            for k, data in part.read(batch):
                decode, topic = decoders[channels[k]]
                try:
                    value = decode(data)
                except ValueError:
                    part.lose(batch[k : k + 1], UNDECODABLE)
                    continue
                yield Message(topic, stamps[k], value)

    def _summaries(self) -> dict[tuple[str, str, str], Topic]:
        """Count the messages of all topics, and find their first and last stamps, in one pass."""
        none = np.iinfo(np.int64)
        spans = dict.fromkeys(sorted(self._channels), (0, none.max, none.min))
        for part in self.parts:
            order = np.argsort(part.table.channel, kind="stable")
            numbers, begins = np.unique(part.table.channel[order], return_index=True)
            if not len(numbers):
                continue
            received_ns = part.received_ns[order]
            columns = (
                numbers,
                np.diff(begins, append=len(order)),
                np.minimum.reduceat(received_ns, begins),
                np.maximum.reduceat(received_ns, begins),
            )
            for number, count, first, last in zip(*(column.tolist() for column in columns), strict=True):
                before = spans[part.channels[number].key]
                spans[part.channels[number].key] = (
                    before[0] + count,
                    min(before[1], first),
                    max(before[2], last),
                )
        return {
            (name, type_, encoding): Topic(
                name, type_, encoding, count, first if count else None, last if count else None
            )
            for (name, type_, encoding), (count, first, last) in spans.items()
        }


def begins_like(path: Path, magic: bytes, suffixes: Collection[str]) -> bool:
    """Return True if a file begins with some bytes, or is empty and named like such a file."""
    head = first_bytes(path, len(magic))
    return head == magic or (not head and path.is_file() and path.suffix.lower() in suffixes)


def open_file(path: Path) -> tuple[IO[bytes], int]:
    """Open a file; return it with its size."""
    refuse_special(path)
    with on_disk(path):
        size = path.stat().st_size
        if not size:
            raise damaged(path, "is empty (0 bytes)")
        file = path.open("rb")
    if pointer := describe_lfs_pointer(file.read(1024)):
        file.close()
        raise DataError(path, *pointer, code="wrong-kind")
    file.seek(0)
    return file, size


def open_parts(
    paths: Sequence[Path], open_part: Callable[[Path], LogPart]
) -> tuple[list[LogPart], Counter[str]]:
    """Open the files of a recording; count those that cannot be read."""
    parts: list[LogPart] = []
    refusals: list[DataError] = []
    for path in paths:
        try:
            parts.append(open_part(path))
        except DataError as error:
            refusals.append(error)
        except BaseException:
            for part in parts:
                part.close()
            raise
    if refusals and not parts:
        raise refusals[0]
    return parts, Counter({UNREADABLE_FILES: len(refusals)} if refusals else {})
