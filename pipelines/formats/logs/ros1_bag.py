"""ROS 1 bags, version 2.0 (wiki.ros.org/Bags/Format/2.0), whole or cut off; rosbags decodes the messages."""

import re
import struct

import numpy as np

from pipelines.formats.logs.message_decoders import Schema, ros2_name
from pipelines.formats.logs.recordings import Channel, Chunk, ChunkedPart, Content
from pipelines.formats.logs.trajectories import LogFile
from pipelines.geometry.arrays import Int64
from pipelines.session.errors import DataError

_BEGINNING = b"#ROSBAG V"
_MAGIC = re.compile(rb"#ROSBAG V(\d+)\.(\d+)\n")
_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
# The header of a record has some hundred bytes, so more is damage.
_HEADER_LIMIT = 1 << 20
_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")
_STAMP = struct.Struct("<II")
_INDEX_ROW = np.dtype([("s", "<u4"), ("ns", "<u4"), ("place", "<u4")])

Fields = dict[bytes, bytes]


class _Bag(ChunkedPart):
    """ROS 1 bag; chunks uncompressed, bz2 or lz4."""

    def walk(self) -> tuple[int, bool]:
        """Walk the records up to the end of the file or to the first incomplete one."""
        position, chunks_stated = self._bag_header()
        while position < self.file_size:
            try:
                fields, data_at, length = self._record(position)
                kind = fields[b"op"][0]
                end = data_at + length
                if kind == _CHUNK:
                    self._take_chunk(fields, data_at, length)
                if end > self.file_size:
                    break
                if kind == _INDEX and self.chunks:
                    self.take_index(self._index_rows(fields, data_at, length))
                elif kind == _CONNECTION:
                    number, channel = _connection(fields, self.bytes_at(data_at, length))
                    self.channels.setdefault(number, channel)
            except (struct.error, ValueError, KeyError, IndexError):
                break
            position = end
        return position, position == self.file_size and chunks_stated == len(self.chunks)

    def look(self, content: memoryview) -> Content:
        """Find messages and connections in a chunk."""
        channels: dict[int, Channel] = {}
        index: list[tuple[int, int, int]] = []
        position = 0
        while position < len(content):
            try:
                fields, data_at, length = _parse_record(content, position)
                if data_at + length > len(content):
                    break
                self.count_record()
                if fields[b"op"][0] == _MESSAGE:
                    stamp = _stamp(fields)
                    index.append((_U32.unpack(fields[b"conn"])[0], stamp, position))
                elif fields[b"op"][0] == _CONNECTION:
                    number, channel = _connection(fields, bytes(content[data_at : data_at + length]))
                    channels[number] = channel
            except (struct.error, ValueError, KeyError, IndexError):
                break
            position = data_at + length
        return Content(channels, index, position)

    def payload(self, content: memoryview, place: int, channel: int, stamp_ns: int) -> memoryview:
        """Return the bytes of a message; some writers let the index point to the connection before it."""
        try:
            fields, data_at, length = _parse_record(content, place)
            while fields[b"op"][0] == _CONNECTION:
                fields, data_at, length = _parse_record(content, data_at + length)
            right = (
                fields[b"op"][0] == _MESSAGE
                and _U32.unpack(fields[b"conn"])[0] == channel
                and _stamp(fields) == stamp_ns
                and data_at + length <= len(content)
            )
        except (struct.error, KeyError, IndexError) as error:
            raise ValueError("no record here") from error
        if not right:
            raise ValueError("another record")
        return content[data_at : data_at + length]

    def _bag_header(self) -> tuple[int, int]:
        """Return the position after the bag's header, and its number of chunks (-1 if unknown)."""
        head = self.bytes_at(0, 16)
        match = _MAGIC.match(head)
        if not match:
            raise DataError(
                self.path, "is no ROS 1 bag (the first line is not `#ROSBAG V2.0`)", code="wrong-kind"
            )
        if (version := b".".join(match.groups()).decode()) != "2.0":
            raise DataError(self.path, f"is a bag of version {version}", "convert it with `rosbag fix`")
        try:
            fields, data_at, length = self._record(match.end())
            if fields.get(b"encryptor"):
                raise DataError(self.path, "is encrypted", "record or convert it without encryption")
            closed = _U64.unpack(fields[b"index_pos"])[0] > 0
            return data_at + length, _U32.unpack(fields[b"chunk_count"])[0] if closed else -1
        except (struct.error, ValueError, KeyError):
            return match.end(), -1

    def _record(self, position: int) -> tuple[Fields, int, int]:
        """Return the fields of a record's header, the position of its data in the file, and its length."""
        header_length = _U32.unpack(self.bytes_at(position, 4))[0]
        if header_length > _HEADER_LIMIT:
            raise ValueError("no header")
        head = memoryview(self.bytes_at(position, 4 + header_length + 4))
        fields, data_at, length = _parse_record(head, 0)
        return fields, position + data_at, length

    def _take_chunk(self, fields: Fields, data_at: int, length: int) -> None:
        compression = fields[b"compression"].decode()
        here = min(length, self.file_size - data_at)
        self.take_chunk(Chunk(data_at, here, compression, _U32.unpack(fields[b"size"])[0], cut=here < length))

    def _index_rows(self, fields: Fields, data_at: int, length: int) -> Int64:
        raw = np.frombuffer(self.bytes_at(data_at, length - length % _INDEX_ROW.itemsize), _INDEX_ROW)
        stamp = raw["s"].astype(np.int64) * 10**9 + raw["ns"]
        connection = np.full(len(raw), _U32.unpack(fields[b"conn"])[0], np.int64)
        return np.stack([connection, stamp, raw["place"].astype(np.int64)], axis=1)


def _parse_record(content: memoryview, position: int) -> tuple[Fields, int, int]:
    """Return the fields of a record's header, the position of its data, and its length."""
    header_end = position + 4 + _U32.unpack_from(content, position)[0]
    (length,) = _U32.unpack_from(content, header_end)
    return _fields(bytes(content[position + 4 : header_end])), header_end + 4, length


def _fields(header: bytes) -> Fields:
    fields: Fields = {}
    position = 0
    while position < len(header):
        end = position + 4 + _U32.unpack_from(header, position)[0]
        name, separator, value = header[position + 4 : end].partition(b"=")
        if not separator or end > len(header):
            raise ValueError("no field")
        fields[name] = value
        position = end
    return fields


def _stamp(fields: Fields) -> int:
    seconds, nanoseconds = _STAMP.unpack(fields[b"time"])
    return int(seconds) * 10**9 + int(nanoseconds)


def _connection(fields: Fields, data: bytes) -> tuple[int, Channel]:
    about = _fields(data)
    schema = Schema(ros2_name(about[b"type"].decode()), "ros1", "ros1msg", about[b"message_definition"])
    return _U32.unpack(fields[b"conn"])[0], Channel(fields[b"topic"].decode(), schema)


FORMAT = LogFile("ros1", "ROS 1 bag", (".bag",), _BEGINNING, _Bag)
