"""Poses straight from the bytes of a whole topic, where every message has the same layout.

The messages of one topic of poses differ in nothing but numbers: the same frames, the same length. Then a
thousand of them are one array, read ten times as fast as one at a time. Wherever that does not hold,
nothing is said here and the messages are decoded one by one.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.formats.message_decoders import Schema, is_standard
from pipelines.session.records import Float, Int64

Payload = tuple[int, memoryview | bytes]
"""Stamp of receipt, and the bytes of a message; a view need be valid only until the next."""

_LATEST_NS = 2**62  # stamps beyond are no times, which is for others to say
_BATCH = 4096  # messages of one array: 3 MB of Odometry
_CDR_LITTLE_ENDIAN = b"\x00\x01\x00\x00"


@dataclass(frozen=True)
class _Fields:
    """What follows the header of a message."""

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
    """Poses of one topic as it states them."""

    frames: tuple[str, str]  # target and source
    header_ns: Int64  # [N]
    receive_ns: Int64  # [N]
    pose: Float  # [N, 7] position, then quaternion xyzw
    covariance: Float | None  # [N, 36], for types that have one


class _OtherLayoutError(Exception):
    """A message that is not laid out as the first."""


@dataclass(frozen=True)
class _Layout:
    """Where things are in every message of a topic."""

    length: int
    stamp_at: int  # seconds, then nanoseconds
    seconds: Literal["<i4", "<u4"]
    text: slice  # lengths and characters of the frames' names, with what pads them
    names: tuple[str, str]
    doubles_at: int


def read_poses(schema: Schema, payloads: Iterable[Payload]) -> PoseArrays | None:
    """All poses of a topic; None where they are not of one known layout, or there are none.

    Args:
        schema: of the topic.
        payloads: its messages in the order of receipt; read to the end, or to the first that differs.
    """
    fields = _KNOWN.get(schema.type)
    if fields is None or schema.encoding not in {"cdr", "ros1"} or not is_standard(schema):
        return None
    try:
        copies = ((stamp, bytes(data)) for stamp, data in payloads)
        blocks = list(_blocks(schema.encoding, fields, copies))
    except _OtherLayoutError:
        return None
    if not blocks:
        return None
    return PoseArrays(
        frames=blocks[0].frames,
        header_ns=np.concatenate([block.header_ns for block in blocks]),
        receive_ns=np.concatenate([block.receive_ns for block in blocks]),
        pose=np.concatenate([block.pose for block in blocks]),
        covariance=np.concatenate([b.covariance for b in blocks if b.covariance is not None])
        if fields.has_covariance
        else None,
    )


def _blocks(encoding: str, fields: _Fields, payloads: Iterator[tuple[int, bytes]]) -> Iterator[PoseArrays]:
    layout: _Layout | None = None
    text = b""
    while batch := list(islice(payloads, _BATCH)):
        if layout is None:
            layout = _layout(encoding, fields, batch[0][1])
            text = batch[0][1][layout.text]
        if any(len(data) != layout.length for _, data in batch):
            raise _OtherLayoutError
        raw = np.frombuffer(b"".join(data for _, data in batch), np.uint8).reshape(-1, layout.length)
        if encoding == "cdr" and (raw[:, :4] != np.frombuffer(_CDR_LITTLE_ENDIAN, np.uint8)).any():
            raise _OtherLayoutError
        if (raw[:, layout.text] != np.frombuffer(text, np.uint8)).any():
            raise _OtherLayoutError
        receive_ns = np.array([stamp for stamp, _ in batch], np.int64)
        if np.abs(receive_ns).max() >= _LATEST_NS:
            raise _OtherLayoutError
        yield _block(layout, fields, raw, receive_ns)


def _block(layout: _Layout, fields: _Fields, raw: NDArray[np.uint8], receive_ns: Int64) -> PoseArrays:
    count = 43 if fields.has_covariance else 7
    record = np.dtype(
        {
            "names": ["seconds", "nanoseconds", "doubles"],
            "formats": [layout.seconds, "<u4", ("<f8", (count,))],
            "offsets": [layout.stamp_at, layout.stamp_at + 4, layout.doubles_at],
            "itemsize": layout.length,
        }
    )
    rows = raw.reshape(-1).view(record)
    doubles: Float = rows["doubles"].astype(np.float64)
    return PoseArrays(
        frames=layout.names,
        header_ns=rows["seconds"].astype(np.int64) * 1_000_000_000 + rows["nanoseconds"],
        receive_ns=receive_ns,
        pose=doubles[:, :7],
        covariance=doubles[:, 7:] if fields.has_covariance else None,
    )


def _layout(encoding: str, fields: _Fields, first: bytes) -> _Layout:
    """The layout of a message, by its first one.

    CDR (OMG DDSI-RTPS 2.5, section 10) aligns to the size of a number, counted behind its four bytes of
    head, and ends text with a zero; ROS 1 does neither.
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
        length=len(first),
        stamp_at=stamp_at,
        seconds="<i4" if cdr else "<u4",
        text=slice(text_at, position),
        names=(names[0], names[1]),
        doubles_at=doubles_at,
    )
