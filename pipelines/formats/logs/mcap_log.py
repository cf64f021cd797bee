"""MCAP files (mcap.dev/spec), whole or cut off, chunked or not, with any profile.

The mcap library parses the records. Its readers stop at the first damage, so this module walks the file.
"""

import struct
from io import BytesIO

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError

from pipelines.formats.logs.message_decoders import Schema, ros2_name
from pipelines.formats.logs.recordings import CHUNK_LIMIT, Channel, Chunk, ChunkedPart, Content
from pipelines.formats.logs.trajectories import LogFile
from pipelines.geometry.arrays import Int64
from pipelines.session.errors import DataError

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX, _STATISTICS = 2, 3, 4, 5, 6, 7, 11
_DAMAGE = (McapError, struct.error, ValueError)  # errors of the library for invalid records
_HEAD = struct.Struct("<BQ")  # kind and length of a record
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")  # then channel, sequence, log time, publish time
_CHUNK_HEAD = struct.Struct("<QQQII")  # first and last stamp, size, checksum, length of what follows
_INDEX_ROW = np.dtype([("stamp", "<u8"), ("place", "<u8")])
_NO_SCHEMA = records.Schema(id=0, data=b"", encoding="", name="")
# Messages outside chunks are read in blocks of this many bytes.
_RUN = 1 << 20
# Stamps are int64, and MCAP's are unsigned.
_STAMP_LIMIT = 1 << 63


class McapPart(ChunkedPart):
    """MCAP file in ros1, cdr, json or protobuf, checked; messages outside chunks are uncompressed chunks."""

    def walk(self) -> tuple[int, bool]:
        """Walk the records up to the end of the file or to the first incomplete one."""
        if self.bytes_at(0, len(_MAGIC)) != _MAGIC:
            raise DataError(self.path, "is no MCAP file (it does not begin with its magic bytes)")
        self._schemas: dict[int, records.Schema] = {}
        position, closed = len(_MAGIC), False
        run: Chunk | None = None
        while not closed:
            head = self.bytes_at(position, _HEAD.size)
            if len(head) < _HEAD.size:
                break
            kind, length = _HEAD.unpack(head)
            content_at, end = position + _HEAD.size, position + _HEAD.size + length
            try:
                if kind == _CHUNK:
                    self._take_chunk(content_at, length)
                if end > self.file_size:
                    break
                run = self._extended(run, position, end) if kind == _MESSAGE else None
                if kind == _INDEX and self.chunks:
                    self.take_index(self._index_rows(content_at, length))
                elif kind in {_SCHEMA, _CHANNEL, _STATISTICS}:
                    self._take_record(
                        kind, self.bytes_at(content_at, min(length, CHUNK_LIMIT)), self.channels
                    )
                closed = kind == _FOOTER
            except _DAMAGE:
                break
            position = end
        if closed and self.bytes_at(position, len(_MAGIC)) == _MAGIC:
            position += len(_MAGIC)
        return position, closed

    def look(self, content: memoryview) -> Content:
        """Find messages, channels and schemas in a chunk."""
        channels: dict[int, Channel] = {}
        index: list[tuple[int, int, int]] = []
        position = 0
        try:
            while position < len(content):
                kind, length = _HEAD.unpack_from(content, position)
                end = position + _HEAD.size + length
                if end > len(content):
                    break
                self.count_record()
                if kind == _MESSAGE:
                    _, _, channel, _, stamp, _ = _MESSAGE_HEAD.unpack_from(content, position)
                    if stamp >= _STAMP_LIMIT:
                        raise ValueError("a stamp after the year 2262")
                    index.append((channel, stamp, position))
                elif kind in {_SCHEMA, _CHANNEL}:
                    self._take_record(kind, bytes(content[position + _HEAD.size : end]), channels)
                position = end
        except _DAMAGE:
            pass
        return Content(channels, index, position)

    def payload(self, content: memoryview, place: int, channel: int, stamp_ns: int) -> memoryview:
        """Return the bytes of a message."""
        try:
            kind, length, of_channel, _, log_time, _ = _MESSAGE_HEAD.unpack_from(content, place)
        except struct.error as error:
            raise ValueError("no record here") from error
        end = place + _HEAD.size + length
        if kind != _MESSAGE or of_channel != channel or log_time != stamp_ns or end > len(content):
            raise ValueError("another record")
        return content[place + _MESSAGE_HEAD.size : end]

    def _take_chunk(self, content_at: int, length: int) -> None:
        head = self.bytes_at(content_at, _CHUNK_HEAD.size)
        _, _, size, crc, name_length = _CHUNK_HEAD.unpack(head)
        name_at = content_at + _CHUNK_HEAD.size
        name = self.bytes_at(name_at, min(name_length, 16)).decode()
        data_at = name_at + name_length + 8
        stated = int.from_bytes(self.bytes_at(data_at - 8, 8), "little")
        if data_at + stated > content_at + length:
            raise ValueError("the chunk's content is longer than its record")
        here = min(stated, self.file_size - data_at)
        if here < 0:
            raise ValueError("nothing of the chunk's content is here")
        self.take_chunk(Chunk(data_at, here, name, size, crc, cut=here < stated))

    def _extended(self, run: Chunk | None, position: int, end: int) -> Chunk:
        """Add a message outside chunks to the run; begin a new run if there is none or it is full."""
        if run is None or run.length >= _RUN:
            run = Chunk(position, 0, "", 0)
            self.chunks.append(run)
        run.length = run.size = end - run.offset
        if "unchunked" not in self.storage:
            self.storage.append("unchunked")
        return run

    def _take_record(self, kind: int, content: bytes, channels: dict[int, Channel]) -> None:
        stream = ReadDataStream(BytesIO(content))
        if kind == _SCHEMA:
            schema = records.Schema.read(stream)
            self._schemas[schema.id] = schema
        elif kind == _STATISTICS:
            self.messages_stated = records.Statistics.read(stream).message_count
        else:
            channel = records.Channel.read(stream)
            channels.setdefault(channel.id, self._channel(channel))

    def _channel(self, channel: records.Channel) -> Channel:
        schema = self._schemas.get(channel.schema_id, _NO_SCHEMA)
        encoding = channel.message_encoding
        type_ = ros2_name(schema.name) if encoding in {"ros1", "cdr"} else schema.name
        return Channel(channel.topic, Schema(type_, encoding, schema.encoding, schema.data))

    def _index_rows(self, content_at: int, length: int) -> Int64:
        channel = int.from_bytes(self.bytes_at(content_at, 2), "little")
        raw = np.frombuffer(self.bytes_at(content_at + 6, (length - 6) // 16 * 16), _INDEX_ROW)
        if len(raw) and int(raw["stamp"].max()) >= _STAMP_LIMIT:
            raise ValueError("a stamp after the year 2262")
        return np.stack(
            [np.full(len(raw), channel), raw["stamp"].astype(np.int64), raw["place"].astype(np.int64)], axis=1
        )


FORMAT = LogFile("mcap", "MCAP log", (".mcap",), _MAGIC, McapPart)
