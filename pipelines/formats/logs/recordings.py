"""Log as files that each list their messages: topics, order of receipt over all files, and losses.

A part (one file) knows the position of every message before any is read. So messages come in order and
filtered without being kept in memory, and every loss has a cause and a count.
"""

from __future__ import annotations

import heapq
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from pipelines.formats.logs.message_decoders import Schema, decoder
from pipelines.geometry.arrays import Int64
from pipelines.session.errors import DataError
from pipelines.session.records import Message, Topic
from pipelines.session.storage import code_of
from pipelines.session.unknown_files import describe_lfs_pointer

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

# The places of so many messages are Python integers at a time, which takes 10 MB.
_BATCH = 1 << 16
# A type takes a millisecond to understand, and PX4 has 250.
_MOST_TYPES = 2000


@dataclass(frozen=True)
class Channel:
    """Topic as one file names it, with the schema of its messages."""

    topic: str
    schema: Schema


@dataclass(frozen=True)
class MessageTable:
    """Positions of the messages of a file, in the order of the file; all arrays are [M]."""

    channel: Int64
    stamp_ns: Int64  # of receipt
    block: Int64  # block that must be read as a whole; 0 if there are no blocks
    place: Int64  # within the block
    size: Int64  # bytes, uncompressed; bytes between two messages count to the first of them


class LogPart(ABC):
    """Open file of a log."""

    def __init__(self, path: Path, file_size: int) -> None:
        self.path = path
        self.file_size = file_size
        self.channels: dict[int, Channel] = {}
        self.storage: list[str] = []  # kinds of storage, for `mocap info`
        self.lost: Counter[str] = Counter()  # losses of the file as a whole
        self.table = _empty_table()
        self._fates: NDArray[np.uint8] = np.zeros(0, np.uint8)
        self._rows: dict[int, Int64] = {}  # of each channel, in the order of the file
        self._causes = [""]

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
            raise DataError(
                self.path, f"defines {types} types of messages", "no drone has so many; copy the log again"
            )
        named = np.isin(table.channel, list(self.channels))
        if strangers := int(np.count_nonzero(~named)):
            self.lost[UNNAMED] += strangers
            table = MessageTable(
                table.channel[named],
                table.stamp_ns[named],
                table.block[named],
                table.place[named],
                table.size[named],
            )
        self.table = table
        self._fates = np.zeros(len(table.channel), np.uint8)
        by_channel = np.argsort(table.channel, kind="stable")
        numbers, first = np.unique(table.channel[by_channel], return_index=True)
        rows = np.split(by_channel.astype(np.int64), first[1:]) if len(numbers) else []
        self._rows = dict(zip(numbers.tolist(), rows, strict=True))

    def lose(self, rows: Int64 | int, cause: str) -> None:
        """Note why messages could not be read; a second reading counts them once only."""
        if cause not in self._causes:
            self._causes.append(cause)
        self._fates[rows] = self._causes.index(cause)

    def forget(self) -> None:
        """Forget the losses of the readings so far; those of the file as a whole stay."""
        self._fates[:] = 0

    @property
    def dropped(self) -> Counter[str]:
        """All losses so far, by cause."""
        counts = np.bincount(self._fates, minlength=len(self._causes))[1:]
        return self.lost + Counter(dict(zip(self._causes[1:], counts.tolist(), strict=True)))

    def rows_of(self, channels: Collection[int]) -> Int64:
        """Return the rows of some channels, in the order of receipt; equal stamps keep the file's order."""
        found = [rows for channel in dict.fromkeys(channels) if (rows := self._rows.get(channel)) is not None]
        rows = np.sort(np.concatenate([np.zeros(0, np.int64), *found]))
        return rows[np.argsort(self.table.stamp_ns[rows], kind="stable")]


class OpenLog:
    """Open log of one or more parts."""

    def __init__(self, parts: Sequence[LogPart], lost: Counter[str]) -> None:
        self.parts = parts
        self._lost = lost
        self._channels = [_channels_by_key(part) for part in parts]
        keys = {key for channels in self._channels for key in channels}
        self._topics = {key: self._summary(*key) for key in sorted(keys)}

    def __enter__(self) -> OpenLog:
        """Return the log itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the files."""
        for part in self.parts:
            part.close()

    @property
    def topics(self) -> Sequence[Topic]:
        """Channels, by name; a name whose messages are of two types is there twice."""
        return list(self._topics.values())

    @property
    def dropped(self) -> dict[str, int]:
        """Losses so far, counted by cause: of the files, then of the messages asked for."""
        total = sum((part.dropped for part in self.parts), Counter(self._lost))
        return dict(sorted(total.items()))

    def forget(self) -> None:
        """Forget the losses of the readings so far, so that `dropped` describes the next one alone."""
        for part in self.parts:
            part.forget()

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Yield the messages of some topics in the order of receipt; others are neither read nor decoded."""
        streams = [self._of_part(part, frozenset(topics)) for part in self.parts]
        return streams[0] if len(streams) == 1 else heapq.merge(*streams, key=attrgetter("receive_ns"))

    def stamps(self, topic: Topic) -> Int64:
        """Return the stamps of receipt of a topic's messages, sorted."""
        return np.sort(np.concatenate([part.table.stamp_ns[rows] for part, rows in self._rows_of(topic)]))

    def size(self, topic: Topic) -> int:
        """Return the size of a topic's messages in bytes, uncompressed."""
        return sum(int(part.table.size[rows].sum()) for part, rows in self._rows_of(topic))

    def problem(self, topic: Topic) -> str:
        """Return why the messages of a topic cannot be decoded; empty if they can."""
        for schema in dict.fromkeys(
            part.channels[channel].schema
            for part, channels in self._channels_of(topic)
            for channel in channels
        ):
            try:
                decoder(schema)
            except ValueError as error:
                return str(error)
        return ""

    def _channels_of(self, topic: Topic) -> Iterator[tuple[LogPart, list[int]]]:
        """Yield the numbers of a topic's channels by part."""
        key = topic.name, topic.type, topic.encoding
        for part, channels in zip(self.parts, self._channels, strict=True):
            yield part, channels.get(key, [])

    def _rows_of(self, topic: Topic) -> Iterator[tuple[LogPart, Int64]]:
        """Yield the rows of a topic's messages by part, in the order of receipt."""
        for part, channels in self._channels_of(topic):
            yield part, part.rows_of(channels)

    def _of_part(self, part: LogPart, topics: frozenset[str]) -> Iterator[Message]:
        decoders = {}
        for number, channel in part.channels.items():
            if channel.topic in topics:
                try:
                    decoders[number] = decoder(channel.schema), self._topics[_key(channel)]
                except ValueError:
                    part.lose(part.rows_of([number]), UNDEFINED)
        rows = part.rows_of(decoders)
        for start in range(0, len(rows), _BATCH):
            batch = rows[start : start + _BATCH]
            stamps = part.table.stamp_ns[batch].tolist()
            channels = part.table.channel[batch].tolist()
            for k, data in part.read(batch):
                decode, topic = decoders[channels[k]]
                try:
                    value = decode(data)
                except ValueError:
                    part.lose(int(batch[k]), UNDECODABLE)
                    continue
                yield Message(topic, stamps[k], value)

    def _summary(self, name: str, type_: str, encoding: str) -> Topic:
        stamps = self.stamps(Topic(name, type_, encoding, 0, None, None))
        first, last = (int(stamps[0]), int(stamps[-1])) if len(stamps) else (None, None)
        return Topic(name, type_, encoding, len(stamps), first, last)


def open_file(path: Path) -> tuple[IO[bytes], int]:
    """Open a file; return it with its size."""
    try:
        size = path.stat().st_size
        if not size:
            raise DataError(path, "is empty (0 bytes)", "copy it again from the drone")
        file = path.open("rb")
        if pointer := describe_lfs_pointer(file.read(1024)):
            file.close()
            raise DataError(path, *pointer, code="wrong-kind")
        file.seek(0)
        return file, size
    except OSError as error:
        raise DataError(
            path, f"cannot be opened ({error.strerror})", "check the path", code=code_of(error)
        ) from None


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


def require_content(part: LogPart) -> None:
    """Refuse a damaged file without any readable message; an undamaged file may be empty."""
    if part.lost and not len(part.table.stamp_ns):
        causes = ", ".join(f"{cause}: {count}" for cause, count in sorted(part.lost.items()))
        part.close()
        raise DataError(
            part.path, f"holds no message that can be read ({causes})", "copy it again from the drone"
        )


def describe_log(log: OpenLog) -> dict[str, object]:
    """Describe files, messages, times and storage of a log, each topic, and losses by cause."""
    topics = log.topics
    first = min((t.first_ns for t in topics if t.first_ns is not None), default=None)
    last = max((t.last_ns for t in topics if t.last_ns is not None), default=None)
    facts: dict[str, object] = {
        "files": len(log.parts),
        "storage": sorted({word for part in log.parts for word in part.storage}),
        "size_bytes": sum(part.file_size for part in log.parts),
        "messages": sum(topic.count for topic in topics),
    }
    if first is not None and last is not None:
        facts |= {"first_ns": first, "last_ns": last, "span_s": (last - first) / 1e9}
    named = Counter(topic.name for topic in topics)
    facts["topics"] = {
        topic.name if named[topic.name] == 1 else f"{topic.name} ({topic.type})": _describe_topic(log, topic)
        for topic in topics
    }
    return facts | {f"dropped: {cause}": count for cause, count in log.dropped.items()}


def _describe_topic(log: OpenLog, topic: Topic) -> dict[str, object]:
    facts: dict[str, object] = {
        "type": topic.type,
        "encoding": topic.encoding,
        "messages": topic.count,
        "size_bytes": log.size(topic),
    }
    if topic.first_ns is not None and topic.last_ns is not None:
        span_ns = topic.last_ns - topic.first_ns
        facts |= {"first_ns": topic.first_ns, "last_ns": topic.last_ns}
        if span_ns:
            facts["rate_hz"] = round((topic.count - 1) / span_ns * 1e9, 3)
            facts["longest_gap_s"] = round(int(np.diff(log.stamps(topic)).max()) / 1e9, 6)
    if problem := log.problem(topic):
        facts["cannot be decoded"] = problem
    return facts


def _key(channel: Channel) -> tuple[str, str, str]:
    return channel.topic, channel.schema.type, channel.schema.encoding


def _channels_by_key(part: LogPart) -> dict[tuple[str, str, str], list[int]]:
    found: dict[tuple[str, str, str], list[int]] = {}
    for number, channel in part.channels.items():
        found.setdefault(_key(channel), []).append(number)
    return found


def _empty_table() -> MessageTable:
    none = np.zeros(0, np.int64)
    return MessageTable(none, none, none, none, none)
