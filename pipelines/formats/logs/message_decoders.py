"""Decoders of messages: from bytes to a value with the schema's fields as attributes, by encoding."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

if TYPE_CHECKING:
    from google.protobuf.descriptor_pb2 import FileDescriptorProto
    from rosbags.interfaces.typing import Typesdict
    from rosbags.typesys.store import Typestore

Decoder = Callable[[memoryview | bytes], Any]

# No message is larger, so a compressed one that inflates to more is damage.
MESSAGE_LIMIT = 1 << 28
# The largest definitions of ROS have some 10,000 bytes, and the parser is slow.
_DEFINITION_LIMIT = 1 << 18
# The library rosbags unrolls fixed arrays of messages into code, which must stay small.
ARRAY_LIMIT = 1 << 20
_TYPE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)+", re.ASCII)
OCTOMAP = "octomap_msgs/msg/Octomap"
# rosbags does not know these types, and logs of ROS 2 up to Humble carry no definitions.
_DEFINITIONS = {
    OCTOMAP: {OCTOMAP: "std_msgs/Header header\nbool binary\nstring id\nfloat64 resolution\nint8[] data\n"}
}
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
# The second byte of messages in CDR version 2 by table 60 of DDS-XTypes 1.3, and by its tables for DDS-RPC.
_CDR2 = {*range(0x06, 0x0C), *range(0x10, 0x16)}
_MUTABLE = {0x0A, 0x0B, 0x12, 0x13}
_APPENDABLE = {0x08, 0x09, 0x14, 0x15}
# Version 2 aligns numbers of 8 bytes to 4.
_CDR2_ALIGNMENT = 4
# Numbers as `struct` and NumPy name them.
_FORMATS = {
    "bool": "?", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip


@dataclass(frozen=True)
class Schema:
    """Encoding and definition of the messages of a channel."""

    type: str  # in the spelling of ROS 2, or the schema's own
    encoding: str  # of the messages: ros1, cdr, json, protobuf, or another name from the file
    definition_encoding: str = ""  # ros1msg, ros2msg, ros2idl, jsonschema, protobuf; empty if there is none
    definition: bytes = b""


def ros2_name(name: str) -> str:
    """Return a type's name in ROS 2 spelling: nav_msgs/Odometry is nav_msgs/msg/Odometry."""
    package, _, rest = name.partition("/")
    return f"{package}/msg/{rest}" if rest and "/" not in rest else name


def decoder(schema: Schema) -> Decoder:
    """Make the function that decodes messages of a schema; it raises ValueError for bytes that do not fit.

    ros1 and cdr (version 1 or 2): dataclasses of rosbags, numeric arrays as views into the message; without a
    definition in the file, those of ROS 1 Noetic or of the newest ROS 2. json: namespaces. protobuf: messages
    of that library. Messages of a ROS 2 bag in compression mode `message` are decompressed.
    """
    found = _decoder_or_reason(schema)
    if isinstance(found, str):
        raise ValueError(found)
    return found


@lru_cache(maxsize=256)
def _decoder_or_reason(schema: Schema) -> Decoder | str:
    """Return the decoder, or why there is none: also that is found once for the many topics of a type."""
    try:
        return _decoder(schema)
    except ValueError as error:
        return str(error)


def _decoder(schema: Schema) -> Decoder:
    if len(schema.definition) > _DEFINITION_LIMIT:
        raise ValueError(f"the definition of {schema.type[:100]} has {len(schema.definition)} bytes")
    if schema.encoding in {"ros1", "cdr"}:
        return _ros_decoder(schema)
    if schema.encoding == "json":
        return _decode_json
    if schema.encoding == "protobuf":
        return _protobuf_decoder(schema)
    raise ValueError(f"messages in encoding {schema.encoding or 'none'!r} are not read")


def _ros_decoder(schema: Schema) -> Decoder:
    from rosbags.serde import SerdeError

    store = typestore(schema)
    deserialize = store.deserialize_ros1 if schema.encoding == "ros1" else store.deserialize_cdr

    def decode(data: memoryview | bytes) -> Any:
        if data[:4] == _ZSTD_MAGIC and schema.encoding == "cdr":
            data = _inflate_message(data)
        try:
            if schema.encoding == "cdr" and len(data) > 1 and data[1] in _CDR2:
                return _decode_cdr2(store, schema.type, data)
            return deserialize(data, schema.type)
        except (SerdeError, AssertionError, IndexError, OverflowError) as error:
            raise ValueError(str(error)) from error

    return decode


def _inflate_message(data: memoryview | bytes) -> memoryview | bytes:
    content, complete = inflate(data, "zstd", MESSAGE_LIMIT)
    if not complete:
        raise ValueError("the compressed message is cut off or too large")
    return content


def _decode_cdr2(store: Typestore, type_: str, data: memoryview | bytes) -> Any:
    """Decode a message in CDR version 2 (DDS-XTypes 1.3, section 7.4.3).

    Writers differ in whether types within others, and sequences of them, have a header of their length. The
    headers must agree with the content, so that one of the ways alone fits.
    """
    error = ValueError("the message does not fit its definition")
    for nested, boxed in product((True, False), repeat=2):
        reader = _Cdr2Reader(store, data, nested=nested, boxed=boxed)
        try:
            message = reader.message(type_, outermost=True)
        except (ValueError, struct.error, KeyError) as failure:
            error = ValueError(str(failure))
            continue
        if len(data) - reader.place < _CDR2_ALIGNMENT:  # padding
            return message
    raise error


class _Cdr2Reader:
    """Reader of one message; `nested` types have headers, or only the outermost, `boxed` sequences, too."""

    def __init__(self, store: Typestore, data: memoryview | bytes, *, nested: bool, boxed: bool) -> None:
        self.place = 4
        self._store = store
        self._data = data
        self._order = "<" if data[1] & 1 else ">"
        self._mutable, self._appendable = data[1] in _MUTABLE, data[1] in _APPENDABLE
        self._nested = nested
        self._boxed = boxed

    def message(self, type_: str, *, outermost: bool = False) -> Any:
        defined = self._store.get_msgdef(type_)
        if not (self._nested or outermost) or not (self._mutable or self._appendable):
            return defined.cls(*(self._value(field) for _, field in defined.fields))
        end = self._end()
        if self._appendable:
            values = [self._value(field) for _, field in defined.fields]
        else:
            members = [self._member(defined.fields, end) for _ in defined.fields]
            values = [value for _, value in sorted(members, key=lambda member: member[0])]
        self._check(end)
        return defined.cls(*values)

    def _member(self, fields: Sequence[Any], end: int) -> tuple[int, Any]:
        """Read the number and value of a member of a mutable type, whose header states its length."""
        header = self._number("uint32")
        number, kind = header & 0x0FFFFFFF, header >> 28 & 7
        begin, length = self.place, 1 << kind
        if kind >= 4:
            length = self._number("uint32") * (1, 1, 4, 8)[kind - 4]
            if kind == 4:
                begin = self.place
            else:  # that number is the first of the value, too
                self.place, length = begin, length + 4
        if number >= len(fields) or begin + length > end:
            raise ValueError(f"member {number} does not fit its type")
        value = self._value(fields[number][1])
        self._check(begin + length)
        return number, value

    def _value(self, field: Any) -> Any:
        from rosbags.interfaces import Nodetype

        kind, about = field
        if kind == Nodetype.NAME:
            return self.message(about)
        if kind == Nodetype.BASE:
            return self._text() if about[0] == "string" else self._number(about[0])
        (inner, what), count = about
        is_number = inner == Nodetype.BASE and what[0] != "string"
        end = self._end() if self._boxed and not is_number else None
        if kind == Nodetype.SEQUENCE:
            count = self._number("uint32")
        if count > len(self._data):
            raise ValueError(f"{count} values are more than the message has bytes")
        values = (
            self._numbers(what[0], count) if is_number else [self._value((inner, what)) for _ in range(count)]
        )
        if end is not None:
            self._check(end)
        return values

    def _numbers(self, name: str, count: int) -> Any:
        kind = np.dtype(self._order + _FORMATS[name])
        if count:
            size = min(kind.itemsize, _CDR2_ALIGNMENT)
            self.place += -(self.place - 4) % size
        begin, self.place = self.place, self.place + count * kind.itemsize
        if self.place > len(self._data):
            raise ValueError("the message is cut off")
        return np.frombuffer(self._data, kind, count, begin)

    def _number(self, name: str) -> Any:
        kind = self._order + _FORMATS[name]
        size = struct.calcsize(kind)
        begin = self.place + -(self.place - 4) % min(size, _CDR2_ALIGNMENT)
        self.place = begin + size
        return struct.unpack_from(kind, self._data, begin)[0]

    def _text(self) -> str:
        content: bytes = self._numbers("uint8", self._number("uint32")).tobytes()
        return content.rstrip(b"\0").decode()

    def _end(self) -> int:
        length = self._number("uint32")
        return int(self.place + length)

    def _check(self, end: int) -> None:
        if self.place != end:
            raise ValueError("a header does not agree with what it heads")


@lru_cache(maxsize=256)
def typestore(schema: Schema) -> Typestore:
    """Return a store that knows the type of a channel and all its nested types."""
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

    if not _TYPE_NAME.fullmatch(schema.type):
        raise ValueError(f"{schema.type!r} is no type of ROS")
    if schema.definition:
        store = get_typestore(Stores.EMPTY)
    else:
        store = get_typestore(Stores.ROS1_NOETIC if schema.encoding == "ros1" else Stores.LATEST)
    try:
        if schema.definition:
            types = _ros_types(schema)
            _check_arrays(types)
            store.register(types)
        for name, definition in _DEFINITIONS.get(schema.type, {}).items() if not schema.definition else ():
            store.register(get_types_from_msg(definition, name))
        store.get_msgdef(schema.type)
    except KeyError as error:
        raise ValueError(f"the log does not define {error}") from error
    except (TypesysError, SyntaxError, AssertionError, RecursionError, ValueError) as error:
        first_line = str(error).partition("\n")[0][:120]
        raise ValueError(f"the definition of {schema.type} cannot be used ({first_line})") from error
    return store


def _ros_types(schema: Schema) -> Typesdict:
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    text = schema.definition.decode("utf-8", errors="replace")
    if schema.definition_encoding in {"ros1msg", "ros2msg"}:
        return get_types_from_msg(text, schema.type)
    if schema.definition_encoding not in {"ros2idl", "omgidl"}:
        raise ValueError(f"definitions in {schema.definition_encoding!r} are not read")
    separator = "=" * 80 + "\n"
    if not text.startswith(f"{separator}IDL: "):
        return get_types_from_idl(text)
    types: Typesdict = {}
    for section in text.split(separator)[1:]:
        types.update(get_types_from_idl(section.partition("\n")[2]))
    return types


def _check_arrays(types: Typesdict) -> None:
    from rosbags.interfaces import Nodetype

    for _, fields in types.values():
        for name, description in fields:
            if description[0] == Nodetype.ARRAY and description[1][1] > ARRAY_LIMIT:
                raise ValueError(f"{name} has {description[1][1]} entries")


def _decode_json(data: memoryview | bytes) -> Any:
    """Decode a JSON object to a namespace; base64 stays text."""
    try:
        value = json.loads(bytes(data), object_hook=lambda fields: SimpleNamespace(**fields))
    except RecursionError as error:
        raise ValueError("JSON nested too deeply") from error
    if not isinstance(value, SimpleNamespace):
        raise ValueError("the message is no JSON object")
    return value


def _protobuf_decoder(schema: Schema) -> Decoder:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message import DecodeError
    from google.protobuf.message_factory import GetMessageClass

    if schema.definition_encoding != "protobuf":
        raise ValueError(f"protobuf defined by {schema.definition_encoding or 'nothing'!r} is not read")
    pool = DescriptorPool()
    try:
        for file in _by_dependency(FileDescriptorSet.FromString(schema.definition).file):
            pool.AddSerializedFile(file.SerializeToString())
        message_class = GetMessageClass(pool.FindMessageTypeByName(schema.type))
    except (DecodeError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"the definition of {schema.type} cannot be used") from error

    def decode(data: memoryview | bytes) -> Any:
        try:
            return message_class.FromString(bytes(data))
        except DecodeError as error:
            raise ValueError(str(error)) from error

    return decode


def _by_dependency(files: Any) -> list[FileDescriptorProto]:
    """Sort the files so that each comes after those that it imports, as the descriptor pool requires."""
    waiting = {file.name: file for file in files}
    ordered: list[FileDescriptorProto] = []

    def add(name: str) -> None:
        if file := waiting.pop(name, None):
            for imported in file.dependency:
                add(imported)
            ordered.append(file)

    for name in list(waiting):
        add(name)
    return ordered


class _Decompressor(Protocol):
    def decompress(self, data: memoryview | bytes, max_length: int) -> bytes: ...


def inflate(data: memoryview | bytes, compression: str, size: int) -> tuple[memoryview | bytes, bool]:
    """Decompress at most `size` bytes of a frame (none, bz2, lz4, zstd); True if that was all."""
    if compression in {"", "none"}:
        return data[:size], len(data) <= size
    if compression == "bz2":
        from bz2 import BZ2Decompressor

        return _bounded(BZ2Decompressor(), data, size, OSError)
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        return _bounded(LZ4FrameDecompressor(), data, size, RuntimeError)
    if compression == "zstd":
        from backports.zstd import ZstdDecompressor, ZstdError

        return _bounded(ZstdDecompressor(), data, size, ZstdError)
    raise ValueError(f"compression {compression!r} is not read")


def _bounded(
    decompressor: _Decompressor, data: memoryview | bytes, size: int, failure: type[Exception]
) -> tuple[bytes, bool]:
    try:
        # One byte more than allowed shows if the data goes on.
        content = decompressor.decompress(data, max_length=size + 1)
    except (failure, EOFError) as error:
        raise ValueError(str(error)) from error
    return content[:size], len(content) <= size and bool(getattr(decompressor, "eof", True))
