"""The fields of a picture straight from the bytes of its message.

Of a picture in a log, most readers want little more than the stamp. Where its message is laid out as ROS
writes it, that takes a fifth of the time of a decoding; wherever it is not, it is decoded.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.formats.logs.message_decoders import Decoder, Schema, decoder, is_standard
from pipelines.session.records import Int64

_COMPRESSED = "sensor_msgs/msg/CompressedImage"
_RAW = "sensor_msgs/msg/Image"
_CDR_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_U32 = struct.Struct("<I")
_BEGIN = struct.Struct(
    "<4siI"
)  # head of CDR or number of ROS 1, then the stamp, signed as rosbags reads both
_SIZE = struct.Struct("<II")
_LATEST_NS = 2**62  # stamps beyond are no times, which is for others to say


class PictureFields(NamedTuple):
    """What a message of pictures states; sizes are None where the picture is compressed."""

    stamp_ns: int
    format: str  # or the encoding of pixels
    width: int | None
    height: int | None
    step: int | None
    data: NDArray[np.uint8]


Heads = tuple[Int64, Int64, NDArray[np.uint8]]
"""Stamps of receipt [n] of messages, how many bytes they have [n], and the first of these [n, length]."""

HEAD_LENGTH = 256
"""Bytes of a message of pictures that hold what comes before the picture, but for long names."""


class _OtherLayoutError(Exception):
    """A message that is not laid out as usual."""


def picture_decoder(schema: Schema) -> Decoder:
    """As `decoder`, but a picture of the usual layout comes as `PictureFields`.

    Raises:
        ValueError: why messages of this schema cannot be decoded.
    """
    general = decoder(schema)
    if not _is_known(schema):
        return general

    like: _Layout | None = None  # as the last picture was laid out, so is the next

    def decode(data: memoryview | bytes) -> object:
        nonlocal like
        if like is not None and (picture := like.picture(data)) is not None:
            return picture
        try:
            like = _layout(schema, data, len(data))
        except (_OtherLayoutError, struct.error, UnicodeDecodeError):
            return general(data)
        return like.picture(data)

    return decode


def read_stamps(schema: Schema, messages: Iterable[Heads]) -> tuple[Int64, Int64] | None:
    """Stamps of the headers [N] and of receipt [N] of all pictures of a topic, in the order of receipt.

    None where they are not all laid out alike and as usual, or a stamp of receipt is no time: then
    messages must be decoded one by one.

    Args:
        schema: of the topic.
        messages: in any order; those of equal stamps keep theirs. Read to the end, or to the first that
            differs.
    """
    if not _is_known(schema):
        return None
    header_ns: list[Int64] = [np.zeros(0, np.int64)]
    receive_ns: list[Int64] = [np.zeros(0, np.int64)]
    layout: _Layout | None = None
    for received, sizes, heads in messages:
        try:
            layout = layout or _layout(schema, heads[0].tobytes(), int(sizes[0]))
        except (_OtherLayoutError, struct.error, UnicodeDecodeError):
            return None
        stamps = layout.stamps(heads, sizes)
        if stamps is None or np.abs(received).max() >= _LATEST_NS:
            return None
        header_ns.append(stamps)
        receive_ns.append(received)
    every = np.concatenate(receive_ns)
    order = np.argsort(every, kind="stable")
    return np.concatenate(header_ns)[order], every[order]


def _is_known(schema: Schema) -> bool:
    known = schema.type in {_COMPRESSED, _RAW} and schema.encoding in {"cdr", "ros1"}
    return known and is_standard(schema)


@dataclass(frozen=True)
class _Layout:
    """How a picture's message is laid out, and what it states besides stamp and data."""

    parts: struct.Struct  # head or number, stamp, what lies between, length of the data
    head: bytes | None  # None where any will do
    between: bytes
    format: str
    width: int | None
    height: int | None
    step: int | None

    def picture(self, data: memoryview | bytes) -> PictureFields | None:
        """The fields; None if the message is laid out or states things otherwise."""
        at = self.parts.size
        if len(data) <= at:
            return None
        head, seconds, nanoseconds, between, length = self.parts.unpack_from(data)
        if between != self.between or at + length != len(data) or self.head not in {None, head}:
            return None
        pixels = np.frombuffer(data, np.uint8, offset=at)
        stamp_ns = seconds * 1_000_000_000 + nanoseconds
        return PictureFields(stamp_ns, self.format, self.width, self.height, self.step, pixels)

    def stamps(self, heads: NDArray[np.uint8], sizes: Int64) -> Int64 | None:
        """The stamps [n] of messages by their heads; None if one is laid out or states things otherwise."""
        at = self.parts.size
        if at > heads.shape[1]:
            return None
        between = np.frombuffer(self.between, np.uint8)
        if (heads[:, _BEGIN.size : at - _U32.size] != between).any():
            return None
        if self.head is not None and (heads[:, :4] != np.frombuffer(self.head, np.uint8)).any():
            return None
        lengths = _column(heads, at - _U32.size, "<u4")
        if (sizes <= at).any() or (at + lengths != sizes).any():
            return None
        return _column(heads, 4, "<i4") * 1_000_000_000 + _column(heads, 8, "<u4")


def _column(heads: NDArray[np.uint8], at: int, kind: str) -> Int64:
    """The numbers of four bytes that stand at one place of every head."""
    return heads[:, at : at + 4].copy().view(kind)[:, 0].astype(np.int64)


def _layout(schema: Schema, data: memoryview | bytes, size: int) -> _Layout:
    """Found field by field: CDR aligns numbers to four bytes and ends text with a zero, unlike ROS 1.

    Args:
        schema: of the message.
        data: its bytes, or its first ones.
        size: how many bytes it has.
    """
    is_cdr = schema.encoding == "cdr"
    head = bytes(data[:4])
    if is_cdr and head != _CDR_LITTLE_ENDIAN:
        raise _OtherLayoutError
    width = height = step = None
    _, at = _text(data, _BEGIN.size, is_cdr)  # of the frame, which must be text all the same
    if schema.type == _RAW:
        at += -at % 4 if is_cdr else 0
        height, width = _SIZE.unpack_from(data, at)
        stated, at = _text(data, at + _SIZE.size, is_cdr)
        at += 1  # whether it is big endian
        at += -at % 4 if is_cdr else 0
        (step,) = _U32.unpack_from(data, at)
        at += 4
    else:
        stated, at = _text(data, at + (-at % 4 if is_cdr else 0), is_cdr)
        at += -at % 4 if is_cdr else 0
    (length,) = _U32.unpack_from(data, at)
    if not length or at + 4 + length != size:
        raise _OtherLayoutError
    between = bytes(data[_BEGIN.size : at])
    parts = struct.Struct(f"{_BEGIN.format}{len(between)}sI")
    return _Layout(parts, head if is_cdr else None, between, stated, width, height, step)


def _text(data: memoryview | bytes, at: int, is_cdr: bool) -> tuple[str, int]:
    """A text, and where it ends."""
    (length,) = _U32.unpack_from(data, at)
    end = at + 4 + length
    text = bytes(data[at + 4 : end])
    if len(text) != length or (is_cdr and text[-1:] != b"\x00"):
        raise _OtherLayoutError
    return (text[:-1] if is_cdr else text).decode(), end
