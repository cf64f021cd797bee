"""Fields of a picture straight from the bytes of its message.

Most readers need little more than a picture's stamp. If the message has ROS's usual layout, this takes
a fifth of the time of decoding. Otherwise the message is decoded.
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
_LATEST_NS = 2**62  # later stamps are invalid; the general decoder reports them


class PictureFields(NamedTuple):
    """Fields of a picture message; sizes are None if the picture is compressed."""

    stamp_ns: int
    format: str  # or the encoding of pixels
    width: int | None
    height: int | None
    step: int | None
    data: NDArray[np.uint8]


Heads = tuple[Int64, Int64, NDArray[np.uint8]]
"""Receipt stamps [n] of messages, their lengths in bytes [n], and their first bytes [n, length]."""

HEAD_LENGTH = 256
"""Bytes at the start of a picture message that hold all fields before the picture, unless names are long."""


class _OtherLayoutError(Exception):
    """Error for a message with an unusual layout."""


def picture_decoder(schema: Schema) -> Decoder:
    """Make a decoder like `decoder` that returns a picture of the usual layout as `PictureFields`.

    Raises:
        ValueError: messages of this schema cannot be decoded; the text gives the reason.
    """
    general = decoder(schema)
    if not _is_known(schema):
        return general

    like: _Layout | None = None  # layout of the last picture, tried first for the next one

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
    """Return header stamps [N] and receipt stamps [N] of all pictures of a topic, in the order of receipt.

    The result is None if not all have the same usual layout, or if a stamp of receipt is invalid. Then
    messages must be decoded one by one.

    Args:
        schema: of the topic.
        messages: in any order; messages of equal stamps keep theirs. Read to the end, or to the first
            one with another layout.
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
    """Layout of a picture's message, and its fields besides stamp and data."""

    parts: struct.Struct  # head or number, stamp, bytes in between, length of the data
    head: bytes | None  # None if it may have any value
    between: bytes
    format: str
    width: int | None
    height: int | None
    step: int | None

    def picture(self, data: memoryview | bytes) -> PictureFields | None:
        """Return the fields; None if the message has another layout or other fixed fields."""
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
        """Return the stamps [n] of messages by their heads; None if one has another layout or fields."""
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
    """Return the four-byte numbers at one position of every head."""
    return heads[:, at : at + 4].copy().view(kind)[:, 0].astype(np.int64)


def _layout(schema: Schema, data: memoryview | bytes, size: int) -> _Layout:
    """Find the layout field by field: CDR aligns numbers to four bytes and ends text with a zero, ROS 1 not.

    Args:
        schema: of the message.
        data: its bytes, or its first ones.
        size: number of bytes of the message.
    """
    is_cdr = schema.encoding == "cdr"
    head = bytes(data[:4])
    if is_cdr and head != _CDR_LITTLE_ENDIAN:
        raise _OtherLayoutError
    width = height = step = None
    _, at = _text(data, _BEGIN.size, is_cdr)  # the frame's name, checked to be text but not used
    if schema.type == _RAW:
        at += -at % 4 if is_cdr else 0
        height, width = _SIZE.unpack_from(data, at)
        stated, at = _text(data, at + _SIZE.size, is_cdr)
        at += 1  # is_bigendian
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
    """Read a text; return it with its end."""
    (length,) = _U32.unpack_from(data, at)
    end = at + 4 + length
    text = bytes(data[at + 4 : end])
    if len(text) != length or (is_cdr and text[-1:] != b"\x00"):
        raise _OtherLayoutError
    return (text[:-1] if is_cdr else text).decode(), end
