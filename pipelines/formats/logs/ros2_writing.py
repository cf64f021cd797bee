"""Writer of MCAP logs of ROS 2 messages, like a recorder on a drone; Foxglove and `ros2 bag` open them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

_CHUNK_BYTES = 1 << 20
_STAMPS = {"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"}
_COMPRESSED_VIDEO = """\
builtin_interfaces/Time timestamp
string frame_id
uint8[] data
string format
"""
"""Foxglove's schema (foxglove_msgs/CompressedVideo), which ROS 2 itself does not have."""
_BYTES = {"bool": "bool", "byte": "uint8", "char": "uint8", "octet": "uint8"}


class Ros2Recording:
    """Log that is being written; a context manager. The same messages give the same bytes."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._store.register(get_types_from_msg(_COMPRESSED_VIDEO, "foxglove_msgs/msg/CompressedVideo"))
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="mocap")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequence: dict[str, int] = {}

    def __enter__(self) -> Ros2Recording:
        """Return the recording itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write index and summary, and close the file."""
        try:
            if kind is None:
                self._writer.finish()  # type: ignore[no-untyped-call]  # left without annotations there
        finally:
            self._file.close()

    def write(self, topic: str, type_: str, receive_ns: int, fields: Mapping[str, Any]) -> None:
        """Add a message.

        Args:
            topic: its topic, of one type throughout.
            type_: in the spelling of ROS 2 (nav_msgs/msg/Odometry).
            receive_ns: time of receipt; not before that of the messages written so far.
            fields: all fields that are not zero; a stamp is a plain number of nanoseconds.
        """
        data = bytes(self._store.serialize_cdr(build(self._store, type_, fields), type_))
        number = self._sequence.get(topic, 0)
        self._sequence[topic] = number + 1
        self._writer.add_message(
            self._channel(topic, type_), receive_ns, data, publish_time=receive_ns, sequence=number
        )

    def _channel(self, topic: str, type_: str) -> int:
        if topic not in self._channels:
            if type_ not in self._schemas:
                definition = self._store.generate_msgdef(type_, ros_version=2)[0].encode()
                self._schemas[type_] = self._writer.register_schema(type_, "ros2msg", definition)
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[type_])
        return self._channels[topic]


def build(store: Typestore, type_: str, fields: Mapping[str, Any]) -> Any:
    """Build a message of a ROS type.

    Args:
        type_: in the spelling of ROS 2.
        fields: all fields that are not zero, in ROS 2 spelling. A stamp is a plain number of nanoseconds.
    """
    if type_ in _STAMPS:
        raise TypeError("stamps are plain numbers")
    _, described = store.fielddefs[type_]
    # ROS 1 spells CameraInfo's d, k, r and p in capitals.
    values = [_value(store, kind, fields.get(name, fields.get(name.lower()))) for name, kind in described]
    return store.types[type_](*values)


def _value(store: Typestore, kind: Any, given: Any) -> Any:
    if kind[0] == Nodetype.NAME:
        if kind[1] in _STAMPS:
            return store.types[kind[1]](*divmod(given or 0, 10**9))
        return build(store, kind[1], given or {})
    if kind[0] == Nodetype.BASE:
        return given if given is not None else ("" if kind[1][0] == "string" else 0)
    (inner, name), length = kind[1]
    if inner == Nodetype.NAME:
        return [build(store, name, item) for item in given or [{}] * length]
    if name[0] == "string":
        return list(given or [""] * length)
    dtype = _BYTES.get(name[0], name[0])
    if isinstance(given, bytes):
        return np.frombuffer(given, dtype)
    return np.zeros(length, dtype) if given is None else np.asarray(given, dtype).ravel()
