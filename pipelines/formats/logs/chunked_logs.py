"""Logs as a sequence of records, most of them in compressed chunks: the common part of ROS 1 bags and MCAP.

The file is read from record to record, without its summary: the same code reads a whole file
and one that ends early. Chunks are skipped, because the index after each gives the positions of its
messages. Only a chunk without an index is decompressed to find them.
"""

import zlib
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np

from pipelines.formats.logs.message_decoders import inflate
from pipelines.formats.logs.recordings import (
    DAMAGED,
    MISPLACED,
    NOT_FOUND,
    TAIL,
    TRUNCATED,
    UNCLOSED,
    UNINDEXED,
    UNNAMED,
    Channel,
    LogPart,
    MessageTable,
    require_content,
)
from pipelines.geometry.arrays import Int64
from pipelines.session.errors import DataError

# No recorder writes larger chunks, so a larger size in a header is damage.
CHUNK_LIMIT = 1 << 28
# Chunks that overlap in time are kept up to this many bytes.
_CACHE = 64 << 20
# Empty chunks have no bytes, so their number is bounded, too.
_CACHED = 1000
# A small file may inflate to anything. Logs compress to a tenth, black pictures to a hundredth. The stamps of
# messages differ, so that a message takes a byte at the least.
_INFLATED = 1 << 30  # bytes of all chunks in any file
_MOST_EXPANSION = 100  # bytes for one in the file
_RECORDS = 100_000  # in the chunks of any file; one more for each of its bytes

# Recorders write an index behind each chunk but the last. Some leave indices out, of chunks of 1 MB.
_BARE_CHUNKS = 10_000  # without an index in any file; one more for each 4 kB
_BARE_SIZE = 4096
# Some recorders write an index of no message for each channel that a chunk does not hold.
_EMPTY_INDICES = 10_000  # in any file; one more for each 256 bytes
_EMPTY_SIZE = 256

# Chunks are smaller, so their memory is used again and not returned to the system.
_KEPT = 16 << 20
RECORD_AGAIN = "no recorder writes this; copy it again from the drone"


def inflated_limit(file_size: int) -> int:
    """Return the most bytes to which a compressed log may inflate."""
    return max(_INFLATED, _MOST_EXPANSION * file_size)


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

    record_overhead: int  # bytes of a message's record besides the message

    def __init__(self, path: Path, file: IO[bytes], file_size: int) -> None:
        super().__init__(path, file_size)
        self.file = file
        self.chunks: list[Chunk] = []
        self._bare = 0  # chunks without an index, other than the last
        self._empty = 0  # indices of no message
        self.messages_stated: int | None = None  # by the file's summary
        self._cache: dict[int, memoryview | None] = {}
        self._cached = 0  # bytes
        self._records_left = _RECORDS + file_size
        # glibc returns freed memory to the system and gets it again, page by page, for every chunk. Once it
        # has freed a block of this size, it keeps as much (mallopt(3), M_MMAP_THRESHOLD). So ROS 1 chunks
        # of 1 MB are read at 8 GB/s instead of 2.7.
        bytes(_KEPT)
        try:
            end, closed = self.walk()
            self._note_end(end, closed)
            self._refuse_bombs()
            self._look_into_chunks(closed)
            self.take(self._table())
            self._compare_with_stated()
            require_content(self)
        except BaseException:
            file.close()
            raise

    @abstractmethod
    def walk(self) -> tuple[int, bool]:
        """Find chunks, index and channels; return the end of the last complete record, and True if closed."""

    @abstractmethod
    def look(self, content: memoryview) -> Content:
        """Find the records of a chunk."""

    def take_chunk(self, chunk: Chunk) -> None:
        """Add the next chunk of the file."""
        self._bare += bool(self.chunks) and not self.chunks[-1].index
        if self._bare > max(_BARE_CHUNKS, self.file_size // _BARE_SIZE):
            raise DataError(
                self.path,
                f"holds over {self._bare - 1} chunks without an index in {self.file_size} bytes",
                RECORD_AGAIN,
            )
        self.chunks.append(chunk)

    def take_index(self, rows: Int64) -> None:
        """Add an index [n, 3] of channel, stamp and place to the last chunk."""
        self._empty += not len(rows)
        if self._empty > max(_EMPTY_INDICES, self.file_size // _EMPTY_SIZE):
            raise DataError(
                self.path,
                f"holds over {self._empty - 1} empty indices in {self.file_size} bytes",
                RECORD_AGAIN,
            )
        self.chunks[-1].index.append(rows)

    def count_record(self) -> None:
        """Count a record that was found in a chunk."""
        self._records_left -= 1
        if self._records_left < 0:
            raise DataError(
                self.path, "inflates to more messages than it has bytes", RECORD_AGAIN, code="too-large"
            )

    @abstractmethod
    def payload(self, content: memoryview, place: int, channel: int, stamp_ns: int) -> memoryview:
        """Return the bytes of the message at the index's place; ValueError if it is not there."""

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
        table = self.table
        blocks = table.block[rows].tolist()
        last_of_block = dict(zip(blocks, range(len(blocks)), strict=True))
        places = zip(
            blocks,
            table.place[rows].tolist(),
            table.channel[rows].tolist(),
            table.stamp_ns[rows].tolist(),
            strict=True,
        )
        for k, (block, place, channel, stamp_ns) in enumerate(places):
            content = self._content(block)
            if last_of_block[block] == k:
                # The next chunk then uses the same memory, which is in the processor's cache.
                self._drop(block)
            if content is None:
                self.lose(int(rows[k]), DAMAGED)
                continue
            try:
                data = self.payload(content, place, channel, stamp_ns)
            except ValueError:
                self.lose(int(rows[k]), MISPLACED)
                continue
            yield k, data

    def bytes_at(self, offset: int, length: int) -> bytes:
        """Read bytes of the file; fewer at its end."""
        self.file.seek(offset)
        return self.file.read(max(0, min(length, self.file_size - offset)))

    def _note_end(self, end: int, closed: bool) -> None:
        if not closed:
            self.lost[TRUNCATED if end < self.file_size else UNCLOSED] += 1
        cut_chunk = bool(self.chunks) and self.chunks[-1].cut
        if end < self.file_size and not cut_chunk:
            self.lost[TAIL] += self.file_size - end

    def _compare_with_stated(self) -> None:
        found = len(self.table.stamp_ns) + self.lost[UNNAMED]
        if self.messages_stated is not None and found < self.messages_stated:
            self.lost[NOT_FOUND] += self.messages_stated - found

    def _look_into_chunks(self, closed: bool) -> None:
        for number, chunk in enumerate(self.chunks):
            # The index of the last chunk may be incomplete.
            unindexed = not chunk.index or (not closed and chunk is self.chunks[-1])
            mentioned = {int(rows[0, 0]) for rows in chunk.index if len(rows)}
            if not unindexed and mentioned <= self.channels.keys():
                continue
            content = self._content(number)
            if content is None:
                if unindexed:
                    self.lost[UNINDEXED] += 1
                continue
            found = self.look(content)
            self.channels = found.channels | self.channels
            if unindexed:
                chunk.index = [np.array(found.index, np.int64).reshape(-1, 3)]
                if found.end < len(content):
                    self.lost[TAIL] += len(content) - found.end

    def _content(self, number: int) -> memoryview | None:
        if number not in self._cache:
            content = self._cache[number] = self._inflated(self.chunks[number])
            self._cached += len(content or b"")
            while len(self._cache) > 1 and (self._cached > _CACHE or len(self._cache) > _CACHED):
                self._drop(next(iter(self._cache)))
        return self._cache[number]

    def _drop(self, number: int) -> None:
        self._cached -= len(self._cache.pop(number) or b"")

    def _refuse_bombs(self) -> None:
        """Refuse a file whose chunks inflate beyond reason; none is inflated to more than it states."""
        sizes = [chunk.size for chunk in self.chunks if chunk.size <= CHUNK_LIMIT]
        if sum(sizes) > inflated_limit(self.file_size):
            raise DataError(self.path, f"inflates from {self.file_size} to {sum(sizes)} bytes", RECORD_AGAIN)

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
        block, rows = block[order], rows[order]
        ends = np.array([min(chunk.size, CHUNK_LIMIT) for chunk in self.chunks], np.int64)[block]
        same_block = np.append(block[1:] == block[:-1], False) if len(block) else np.zeros(0, bool)
        next_place = np.where(same_block, np.roll(rows[:, 2], -1), ends)
        size = np.maximum(next_place - rows[:, 2] - self.record_overhead, 0)
        return MessageTable(rows[:, 0], rows[:, 1], block, rows[:, 2], size)
