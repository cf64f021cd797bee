"""Poses straight from the bytes of a whole topic, if every message has the same layout.

The messages of one topic of poses usually differ in numbers only: they have the same frames and the same
length. Then a thousand of them are one array, which is read ten times as fast as single messages. In all
other cases the result here is None, and the messages are decoded one by one.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.formats.logs.message_decoders import Schema, is_standard
from pipelines.formats.logs.recordings import UnlikeError, messages_alike
from pipelines.geometry.arrays import Float
from pipelines.session.records import Int64
from pipelines.session.registries import Log

Messages = tuple[Int64, NDArray[np.uint8]]
"""Stamps of receipt [n], and the bytes of messages of one length [n, length]."""

_LATEST_NS = 2**62  # later stamps are invalid; the general decoder reports them
_CDR_LITTLE_ENDIAN = (0, 1, 0, 0)


@dataclass(frozen=True)
class _Fields:
    """Layout of the fields after the header of a message."""

    has_child: bool  # the id of a second frame
    has_covariance: bool
    doubles: int  # from the position to the end


_KNOWN = {
    "geometry_msgs/msg/PoseStamped": _Fields(False, False, 7),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _Fields(False, True, 43),
    "geometry_msgs/msg/TransformStamped": _Fields(True, False, 7),
    "nav_msgs/msg/Odometry": _Fields(True, True, 43 + 42),
}


@dataclass(frozen=True)
class PoseArrays:
    """Poses of one topic as logged."""

    frames: tuple[str, str]  # target and source
    header_ns: Int64  # [N]
    receive_ns: Int64  # [N]
    pose: Float  # [N, 7] position, then quaternion xyzw
    covariance: Float | None  # [N, 36], for types that have one


class _OtherLayoutError(Exception):
    """Error for a message whose layout differs from the first one's."""


@dataclass(frozen=True)
class _Layout:
    """Positions of the fields in every message of a topic."""

    is_cdr: bool
    length: int
    stamp: slice  # seconds, signed as rosbags reads them, then nanoseconds
    text: slice  # lengths and characters of the frames' names, with their padding
    text_bytes: NDArray[np.uint8]
    names: tuple[str, str]
    doubles: slice  # position, quaternion xyzw, and the covariance of types that have one


def read_poses(schema: Schema, messages: Iterable[Messages]) -> PoseArrays | None:
    """Read all poses of a topic in the order of receipt; None unless all have one known layout.

    Args:
        schema: of the topic.
        messages: in any order; messages of equal stamps keep theirs. Read to the end, or to the first
            one with another layout.
    """
    fields = _KNOWN.get(schema.type)
    if fields is None or schema.encoding not in {"cdr", "ros1"} or not is_standard(schema):
        return None
    # These grow in place: joining parts would need the memory of a long log twice.
    header, received, numbers = array("q"), array("q"), array("d")
    layout: _Layout | None = None
    try:
        for receive_ns, raw in messages:
            layout = layout or _layout(schema.encoding, fields, raw[0].tobytes())
            _refuse_another_layout(layout, raw)
            received.frombytes(receive_ns.tobytes())
            header.frombytes(_stamps(raw[:, layout.stamp]).tobytes())
            doubles = np.ascontiguousarray(raw[:, layout.doubles]).view("<f8")
            numbers.frombytes(doubles.astype(np.float64, copy=False).tobytes())
    except (_OtherLayoutError, UnlikeError):
        return None
    if layout is None:
        return None
    header_ns, receive_ns = np.frombuffer(header, np.int64), np.frombuffer(received, np.int64)
    if np.abs(receive_ns).max() >= _LATEST_NS:
        return None
    values: Float = np.frombuffer(numbers, np.float64).reshape(len(header_ns), -1)
    if (np.diff(receive_ns) < 0).any():
        order = np.argsort(receive_ns, kind="stable")
        header_ns, receive_ns, values = header_ns[order], receive_ns[order], values[order]
    return PoseArrays(
        frames=layout.names,
        header_ns=header_ns,
        receive_ns=receive_ns,
        pose=values[:, :7],
        covariance=values[:, 7:] if fields.has_covariance else None,
    )


def _refuse_another_layout(layout: _Layout, raw: NDArray[np.uint8]) -> None:
    """Refuse messages that differ from the first one in anything but the numbers that are used."""
    if raw.shape[1] != layout.length or (raw[:, layout.text] != layout.text_bytes).any():
        raise _OtherLayoutError
    if layout.is_cdr and (raw[:, :4] != _CDR_LITTLE_ENDIAN).any():
        raise _OtherLayoutError


def _stamps(raw: NDArray[np.uint8]) -> Int64:
    """Convert the bytes of header stamps [n, 8] (seconds, signed, then nanoseconds) to ns [n]."""
    words = np.ascontiguousarray(raw).view("<u4")
    stamps: Int64 = words[:, 0].view("<i4").astype(np.int64) * 1_000_000_000 + words[:, 1]
    return stamps


def _layout(encoding: str, fields: _Fields, first: bytes) -> _Layout:
    """Find the layout of a topic's messages from the first one.

    CDR (OMG DDSI-RTPS 2.5, section 10) aligns each number to its size, counted from the end of its four bytes
    of head, and ends text with a zero. ROS 1 does neither.
    """
    cdr = encoding == "cdr"
    stamp_at = 4  # behind the head of CDR, or the sequence number of ROS 1
    position = text_at = stamp_at + 8
    names = ["", ""]
    for index in range(1 + fields.has_child):
        position += -position % 4 if cdr else 0
        if position + 4 > len(first):
            raise _OtherLayoutError
        (length,) = struct.unpack_from("<I", first, position)
        text = first[position + 4 : position + 4 + length]
        position += 4 + length
        try:
            names[index] = (text[:-1] if cdr else text).decode()
        except UnicodeDecodeError:
            raise _OtherLayoutError from None
        if cdr and not text.endswith(b"\x00"):
            raise _OtherLayoutError
    doubles_at = position + (-(position - 4) % 8 if cdr else 0)
    if doubles_at + 8 * fields.doubles != len(first):
        raise _OtherLayoutError
    return _Layout(
        is_cdr=cdr,
        length=len(first),
        stamp=slice(stamp_at, text_at),
        text=slice(text_at, position),
        text_bytes=np.frombuffer(first, np.uint8)[text_at:position],
        names=(names[0], names[1]),
        doubles=slice(doubles_at, doubles_at + 8 * (43 if fields.has_covariance else 7)),
    )


def poses_at_once(recording: Log, topic: str) -> PoseArrays | None:
    """Read all poses of a topic at once, if our own reader opened the log and the messages are alike."""
    alike = messages_alike(recording, topic)
    return None if alike is None else read_poses(alike.schema, alike.log.arrays(alike.topic))
