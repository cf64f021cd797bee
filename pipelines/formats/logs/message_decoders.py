"""Decoders of messages: from bytes to a value with the schema's fields as attributes, by encoding."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Protocol

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

    ros1 and cdr: dataclasses of rosbags, numeric arrays as views into the message; without a definition in
    the file, those of ROS 1 Noetic or of the newest ROS 2. json: namespaces. protobuf: messages of that
    library. Messages of a ROS 2 bag in compression mode `message` are decompressed.
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
            return deserialize(data, schema.type)
        except (SerdeError, AssertionError, IndexError, OverflowError) as error:
            raise ValueError(str(error)) from error

    return decode


def _inflate_message(data: memoryview | bytes) -> memoryview | bytes:
    content, complete = inflate(data, "zstd", MESSAGE_LIMIT)
    if not complete:
        raise ValueError("the compressed message is cut off or too large")
    return content


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
