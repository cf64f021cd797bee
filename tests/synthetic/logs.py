"""Small logs in every container, written by common libraries.

An entry names a topic, a type, the stamp of receipt and the fields that are not zero, as a nested dict
in the spelling of ROS 2; a stamp is a plain number of nanoseconds. The same entries go into a ROS 1 bag,
a ROS 2 bag or MCAP. Foxglove's types (`foxglove.PoseInFrame`) go into MCAP as json or protobuf.
"""

import base64
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from pipelines.formats.scenes.mcap_writing import build
from tests.formats.foxglove_protobuf import protobuf
from tests.synthetic.driver_messages import register

ROS1 = register(get_typestore(Stores.ROS1_NOETIC))
ROS2 = register(get_typestore(Stores.LATEST))

Container = Literal["ros1", "ros2-sqlite3", "ros2-mcap", "mcap-cdr", "mcap-ros1"]
CONTAINERS: tuple[Container, ...] = ("ros1", "ros2-sqlite3", "ros2-mcap", "mcap-cdr", "mcap-ros1")
Encoding = Literal["cdr", "ros1", "json", "protobuf"]
McapCompression = Literal["none", "lz4", "zstd"]


@dataclass(frozen=True)
class Entry:
    """Message to write."""

    topic: str
    type: str
    stamp_ns: int
    fields: Mapping[str, Any] = field(default_factory=dict)


def write_log(folder: Path, name: str, container: Container, entries: Sequence[Entry]) -> Path:
    """Write a log of ROS messages; return the path of its file, or of a ROS 2 bag's folder."""
    folder.mkdir(parents=True, exist_ok=True)
    if container == "ros1":
        return write_ros1(folder / f"{name}.bag", entries)
    if container == "ros2-sqlite3":
        return write_ros2(folder / name, entries, storage="sqlite3")
    if container == "ros2-mcap":
        return write_ros2(folder / name, entries, storage="mcap")
    encoding: Encoding = "cdr" if container == "mcap-cdr" else "ros1"
    # Small chunks, so that a log of a few seconds has several.
    return write_mcap(folder / f"{name}.mcap", entries, encoding, chunk_size=1 << 14)


def write_ros1(
    path: Path,
    entries: Sequence[Entry],
    *,
    compression: Literal["none", "bz2", "lz4"] = "none",
    chunk_size: int | None = None,
) -> Path:
    """Write a ROS 1 bag; chunks of `chunk_size` bytes, by default 1 MB."""
    writer = Ros1Writer(path)
    if compression != "none":
        writer.set_compression(getattr(Ros1Writer.CompressionFormat, compression.upper()))
    if chunk_size is not None:
        writer.chunk_threshold = chunk_size
    with writer:
        connections = {
            topic: writer.add_connection(topic, type_, typestore=ROS1)
            for topic, type_ in _topics(entries).items()
        }
        for entry in entries:
            data = ROS1.serialize_ros1(build(ROS1, entry.type, entry.fields), entry.type)
            writer.write(connections[entry.topic], entry.stamp_ns, data)
    return path


def write_ros2(
    folder: Path,
    entries: Sequence[Entry],
    *,
    storage: Literal["sqlite3", "mcap"] = "sqlite3",
    compression: Literal["none", "message", "file", "storage"] = "none",
    metadata: bool = True,
) -> Path:
    """Write a ROS 2 bag."""
    writer = Ros2Writer(folder, version=9, storage_plugin=getattr(StoragePlugin, storage.upper()))
    if compression != "none":
        writer.set_compression(getattr(CompressionMode, compression.upper()), CompressionFormat.ZSTD)
    with writer:
        connections = {
            topic: writer.add_connection(topic, type_, typestore=ROS2)
            for topic, type_ in _topics(entries).items()
        }
        for entry in entries:
            data = ROS2.serialize_cdr(build(ROS2, entry.type, entry.fields), entry.type)
            writer.write(connections[entry.topic], entry.stamp_ns, data)
    if not metadata:
        (folder / "metadata.yaml").unlink()
    return folder


def write_split_ros2(
    folder: Path,
    parts: Sequence[Sequence[Entry]],
    *,
    storage: Literal["sqlite3", "mcap"] = "sqlite3",
    metadata: bool = True,
) -> Path:
    """Write a ROS 2 bag of several files, as `ros2 bag record --max-bag-size` does."""
    folder.mkdir(parents=True)
    suffix = "db3" if storage == "sqlite3" else "mcap"
    yaml = YAML(typ="safe", pure=True)
    for number, entries in enumerate(parts):
        single = write_ros2(folder / f"part{number}", entries, storage=storage)
        shutil.move(next(single.glob(f"*.{suffix}")), folder / f"{folder.name}_{number}.{suffix}")
        if number == 0:
            content = yaml.load((single / "metadata.yaml").read_text(encoding="utf-8"))
        shutil.rmtree(single)
    stamps = [entry.stamp_ns for entries in parts for entry in entries]
    content["rosbag2_bagfile_information"] |= {
        "relative_file_paths": [f"{folder.name}_{number}.{suffix}" for number in range(len(parts))],
        "message_count": len(stamps),
        "starting_time": {"nanoseconds_since_epoch": min(stamps)},
        "duration": {"nanoseconds": max(stamps) - min(stamps)},
    }
    if metadata:
        with (folder / "metadata.yaml").open("w", encoding="utf-8") as file:
            yaml.dump(content, file)
    return folder


def write_mcap(
    path: Path,
    entries: Sequence[Entry],
    encoding: Encoding = "cdr",
    *,
    compression: McapCompression = "zstd",
    chunk_size: int = 1 << 20,
    chunked: bool = True,
    summary: bool = True,
) -> Path:
    """Write MCAP; without `summary` there is no index, and no repeated records at the end."""
    with _mcap_writer(path, compression, chunk_size, chunked, summary) as writer:
        profile = {"cdr": "ros2", "ros1": "ros1"}.get(encoding, "")
        writer.start(profile=profile, library="test")
        channels = {
            topic: writer.register_channel(topic, encoding, _register(writer, type_, encoding))
            for topic, type_ in _topics(entries).items()
        }
        for entry in entries:
            data = ENCODERS[encoding](entry)
            writer.add_message(channels[entry.topic], entry.stamp_ns, data, publish_time=entry.stamp_ns)
    return path


@contextmanager
def _mcap_writer(
    path: Path, compression: McapCompression, chunk_size: int, chunked: bool, summary: bool
) -> Iterator[McapWriter]:
    with path.open("wb") as file:
        writer = McapWriter(
            file,
            chunk_size=chunk_size,
            compression=CompressionType[compression.upper()],
            use_chunking=chunked,
            index_types=IndexType.ALL if summary else IndexType.NONE,
            use_statistics=summary,
            use_summary_offsets=summary,
            repeat_channels=summary,
            repeat_schemas=summary,
        )
        yield writer
        writer.finish()  # type: ignore[no-untyped-call]  # the library left this one without annotations


def cut(path: Path, share: float) -> Path:
    """Truncate a file to its first part, as if the drone had crashed."""
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    return path


def _topics(entries: Sequence[Entry]) -> dict[str, str]:
    return {entry.topic: entry.type for entry in entries}


def _register(writer: McapWriter, type_: str, encoding: Encoding) -> int:
    name, kind, definition = type_, "jsonschema", json.dumps(JSON_SCHEMA).encode()
    if encoding == "ros1":
        name, kind = type_.replace("/msg/", "/"), "ros1msg"
        definition = ROS1.generate_msgdef(type_)[0].encode()
    elif encoding == "cdr":
        kind, definition = "ros2msg", ROS2.generate_msgdef(type_, ros_version=2)[0].encode()
    elif encoding == "protobuf":
        descriptor = type(protobuf(type_.removeprefix("foxglove."))).DESCRIPTOR.file
        files = FileDescriptorSet()
        for file in [descriptor, *descriptor.dependencies]:
            file.CopyToProto(files.file.add())
        kind, definition = "protobuf", files.SerializeToString()
    number: int = writer.register_schema(name, kind, definition)
    return number


# Enough of Foxglove's schemas for the one type that JSON alone cannot express.
JSON_SCHEMA = {"type": "object", "properties": {"data": {"type": "string", "contentEncoding": "base64"}}}


def _json(entry: Entry) -> bytes:
    fields = {
        name: base64.b64encode(value).decode() if isinstance(value, bytes) else value
        for name, value in entry.fields.items()
    }
    return json.dumps(fields).encode()


ENCODERS: dict[Encoding, Callable[[Entry], bytes]] = {
    "cdr": lambda entry: bytes(ROS2.serialize_cdr(build(ROS2, entry.type, entry.fields), entry.type)),
    "ros1": lambda entry: bytes(ROS1.serialize_ros1(build(ROS1, entry.type, entry.fields), entry.type)),
    "json": _json,
    "protobuf": lambda entry: protobuf(
        entry.type.removeprefix("foxglove."), **entry.fields
    ).SerializeToString(),
}
