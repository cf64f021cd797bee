"""Fields straight from the bytes of a whole topic, if all its messages have one layout.

Messages of one topic usually differ in numbers only: their texts are equal, and so every field stands at
one position. A thousand of them are then one array, which is read ten times as fast as single messages
(docs/decisions/0009-log-readers.md). In all other cases messages are decoded one by one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipelines.formats.logs.message_decoders import Schema, typestore

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_CDR_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_NUMBERS = {"bool": "u1", "byte": "u1", "char": "u1", "octet": "u1"} | {
    name: np.dtype(name).newbyteorder("<").str
    for name in (
        "int8",
        "int16",
        "int32",
        "int64",
        "uint8",
        "uint16",
        "uint32",
        "uint64",
        "float32",
        "float64",
    )
}
_LENGTH = np.dtype("<u4")
_TEXT, _TAIL = "text", "tail"


class _NoLayoutError(Exception):
    """Error for a type or a message whose fields have no fixed positions."""


@dataclass(frozen=True)
class _Field:
    path: str  # as header.stamp.sec
    kind: str  # a type of numpy, `_TEXT`, or `_TAIL`: bytes to the end of the message
    count: int = 1


@dataclass(frozen=True)
class Layout:
    """Positions of the fields in every message of a topic, found in one of them.

    Bytes between fields, which align them, have any value.
    """

    numbers: Mapping[str, tuple[slice, np.dtype[Any]]]  # by path
    texts: Mapping[str, str]  # by path; equal in all messages
    end: int  # of the fields besides the tail
    has_tail: bool  # bytes of any number follow, behind their number
    _fixed: tuple[tuple[slice, NDArray[np.uint8]], ...]  # the bytes that all messages share

    def fits(self, raw: NDArray[np.uint8], sizes: NDArray[np.int64]) -> bool:
        """Return True if messages have this layout.

        Args:
            raw: [n, length] the messages, or at least their first `end` bytes.
            sizes: [n] bytes of the messages.
        """
        if raw.shape[1] < self.end:
            return False
        if self.has_tail:
            tails = _column(raw, slice(self.end - 4, self.end), _LENGTH)[:, 0].astype(np.int64)
            if not tails.all() or (self.end + tails != sizes).any():
                return False
        elif (sizes != self.end).any():
            return False
        return all(
            np.array_equal(raw[:, place], np.broadcast_to(b, (len(raw), len(b)))) for place, b in self._fixed
        )

    def column(self, raw: NDArray[np.uint8], first: str, *more: str) -> NDArray[Any]:
        """Return the numbers [n, N] of a field, or of several fields that follow each other directly."""
        places = [self.numbers[path] for path in (first, *more)]
        if any(one[0].stop != other[0].start or one[1] != other[1] for one, other in pairwise(places)):
            raise ValueError(f"{first} and {', '.join(more)} do not follow each other")
        return _column(raw, slice(places[0][0].start, places[-1][0].stop), places[0][1])

    def stamps_ns(self, raw: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Return the stamps [n] of the messages' headers."""
        seconds = self.column(raw, "header.stamp.sec")[:, 0].astype(np.int64)
        stamps: NDArray[np.int64] = seconds * 1_000_000_000 + self.column(raw, "header.stamp.nanosec")[:, 0]
        return stamps


def find_layout(schema: Schema, first: bytes) -> Layout | None:
    """Find the positions of the fields in one message, or in its first bytes; None if they are not fixed.

    CDR (OMG DDSI-RTPS 2.5, section 10) aligns each number to its size, counted from the end of its four bytes
    of head, and ends text with a zero. ROS 1 does neither.
    """
    is_cdr = schema.encoding == "cdr"
    if schema.encoding not in {"cdr", "ros1"} or (is_cdr and first[:4] != _CDR_LITTLE_ENDIAN):
        return None
    try:
        return _placed(list(_fields(typestore(schema), schema.type)), first, is_cdr)
    except (_NoLayoutError, ValueError):  # ValueError: no usable definition, or text of other letters
        return None


def _placed(fields: list[_Field], first: bytes, is_cdr: bool) -> Layout:
    numbers: dict[str, tuple[slice, np.dtype[Any]]] = {}
    texts: dict[str, str] = {}
    fixed = [slice(0, 4)] if is_cdr else []
    at, tail = (4 if is_cdr else 0), False
    for field in fields:
        if tail:
            raise _NoLayoutError  # fields behind bytes of any number
        dtype = _LENGTH if field.kind in {_TEXT, _TAIL} else np.dtype(field.kind)
        at += -(at - 4) % dtype.itemsize if is_cdr else 0
        begin, at = at, at + dtype.itemsize * field.count
        if at > len(first):
            raise _NoLayoutError
        if field.kind == _TEXT:
            length = int.from_bytes(first[begin:at], "little")
            text, at = first[at : at + length], at + length
            if len(text) != length or (is_cdr and not text.endswith(b"\x00")):
                raise _NoLayoutError
            texts[field.path] = (text[:-1] if is_cdr else text).decode()
            fixed.append(slice(begin, at))
        elif field.kind == _TAIL:
            tail = True
        else:
            numbers[field.path] = slice(begin, at), dtype
    return Layout(numbers, texts, at, tail, tuple((p, np.frombuffer(first[p], np.uint8)) for p in fixed))


def _fields(store: Typestore, type_: str, before: str = "") -> Iterator[_Field]:
    """Yield the fields of a type and its nested types, in the order of their bytes."""
    from rosbags.interfaces import Nodetype

    for name, (node, about) in store.fielddefs[type_][1]:
        path = before + name
        described: Any = about
        if node == Nodetype.NAME:
            yield from _fields(store, described, f"{path}.")
        elif node == Nodetype.BASE and described[0] == "string":
            yield _Field(path, _TEXT)
        elif node == Nodetype.BASE:
            if described[0] not in _NUMBERS:
                raise _NoLayoutError
            yield _Field(path, _NUMBERS[described[0]])
        else:
            (inner, about_inner), count = described
            kind = _NUMBERS.get(about_inner[0]) if inner == Nodetype.BASE else None
            if kind is None or (node == Nodetype.SEQUENCE and np.dtype(kind).itemsize > 1):
                raise _NoLayoutError
            yield _Field(path, kind, count) if node == Nodetype.ARRAY else _Field(path, _TAIL)


def _column(raw: NDArray[np.uint8], place: slice, dtype: np.dtype[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(raw[:, place]).view(dtype)
