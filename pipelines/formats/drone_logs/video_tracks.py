"""Data tracks inside videos: their packets and the times of these, fields of protobuf, and a video's date."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

from pipelines.formats.common.files import first_bytes
from pipelines.session.errors import DataError

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_NO_DATE_BEFORE = timedelta(days=365)
_MPEG_TS = b"G"  # the byte with which each of its packets begins
_TS_PACKET = 188


def track_container(path: Path) -> str | None:
    """Return FFmpeg's name of the container if a file is MP4, MOV or an MPEG transport stream; else None."""
    head = first_bytes(path, _TS_PACKET + 1)
    if head[4:8] == b"ftyp":
        return "mov"
    return "mpegts" if head[:1] == head[_TS_PACKET:] == _MPEG_TS else None


def track_packets(path: Path, is_wanted: Callable[[bytes], bool]) -> Iterator[tuple[int, int, bytes]]:
    """Yield start and length of each packet in video time, ns, and its bytes.

    Args:
        path: a video; a file of another kind has no packets.
        is_wanted: tells by its first packet if a data track is the one.

    Raises:
        DataError: FFmpeg cannot read the file.
    """
    if (kind := track_container(path)) is None:
        return

    import av
    from av.stream import Discard

    try:
        # Named format and protocol, as for pictures: a playlist must not make FFmpeg open other files.
        with av.open(f"file:{path.absolute()}", format=kind, metadata_errors="replace") as container:
            began = (container.start_time or 0) * 1000 if kind == "mpegts" else 0
            for track in [stream for stream in container.streams if stream.type == "data"]:
                for stream in container.streams:
                    stream.discard = Discard.default if stream is track else Discard.all
                container.seek(0)
                found = False
                for packet in container.demux(track):
                    content, step = bytes(packet), track.time_base
                    if packet.pts is None or step is None or not content:
                        continue
                    if not found and not is_wanted(content):
                        break
                    found = True
                    start, length = (round(n * step * 10**9) for n in (packet.pts, packet.duration or 0))
                    yield start - began, length, content
                if found:
                    return
    except (av.error.FFmpegError, OSError, ValueError) as error:
        problem = f"cannot be read ({str(error)[:100]})"
        raise DataError(path, problem, "copy it from the camera again") from error


def has_track(path: Path, is_wanted: Callable[[bytes], bool]) -> bool:
    """Return True if a video has a data track whose first packet is wanted; False if it cannot be read."""
    try:
        return path.is_file() and next(track_packets(path, is_wanted), None) is not None
    except (DataError, OSError):
        return False


def made_ns(texts: Iterable[str | None]) -> int | None:
    """Return the first time of creation that was ever set, ns since the epoch; None without one."""
    for text in texts:
        if not text:
            continue
        try:
            made = datetime.fromisoformat(text)
        except ValueError:
            continue
        elapsed = (made if made.tzinfo else made.replace(tzinfo=UTC)) - _EPOCH
        if elapsed > _NO_DATE_BEFORE:  # MP4 counts from 1904, and a clock that was never set from 1970
            return elapsed // timedelta(microseconds=1) * 1000
    return None


def video_made_ns(path: Path) -> int | None:
    """Return when a video was made by its metadata, whole seconds; None without a date or a video."""
    if (kind := track_container(path)) is None:
        return None

    import av

    try:
        with av.open(f"file:{path.absolute()}", format=kind, metadata_errors="replace") as container:
            texts = [{**container.metadata}.get("creation_time")]
            texts += [{**stream.metadata}.get("creation_time") for stream in container.streams]
            return made_ns(texts)
    except (av.error.FFmpegError, OSError, ValueError):
        return None


# --- messages of protobuf ------------------------------------------------------------------------------

Value = int | bytes  # a varint; the bytes of a message, a text or a number of fixed size
Place = tuple[int, ...]  # numbers of fields, from the outermost message to the innermost
_VARINT, _FIXED_64, _BYTES, _FIXED_32 = 0, 1, 2, 5


def field_at(message: bytes, place: Place) -> Value | None:
    """Return the field at a place in nested messages; None if it is left out.

    Raises:
        ValueError: the message is damaged.
    """
    for depth, number in enumerate(place, 1):
        found: Value | None = None
        for there, value in fields_of(message):
            if there == number:
                found = value
        if depth == len(place) or not isinstance(found, bytes):
            return found if depth == len(place) else None
        message = found
    return None


def fields_of(message: bytes) -> Iterator[tuple[int, Value]]:
    """Yield number and value of each field of a message of protobuf ("Encoding", protobuf.dev).

    Raises:
        ValueError: it breaks off, or has a type of the wire that is not in use.
    """
    place = 0
    while place < len(message):
        key, place = _varint(message, place)
        kind = key & 7
        if kind == _VARINT:
            value: Value
            value, place = _varint(message, place)
            yield key >> 3, value
            continue
        if kind == _BYTES:
            size, place = _varint(message, place)
        elif kind in {_FIXED_64, _FIXED_32}:
            size = 8 if kind == _FIXED_64 else 4
        else:
            raise ValueError(f"type {kind}")
        if place + size > len(message):
            raise ValueError("breaks off")
        yield key >> 3, message[place : place + size]
        place += size


def _varint(message: bytes, place: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if place >= len(message):
            raise ValueError("breaks off")
        byte = message[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, place
    raise ValueError("a number of more than 64 bits")


def signed_number(value: int) -> int:
    """Return the number of an int32 or int64, whose negative ones take 64 bits."""
    value &= 2**64 - 1
    return value - 2**64 if value >= 2**63 else value


def real_number(value: Value | None) -> float:
    """Return a float or double; 0 where it is left out.

    Raises:
        ValueError: the field has another type.
    """
    if value is None:
        return 0.0
    kinds = {4: "<f", 8: "<d"}
    if not isinstance(value, bytes) or len(value) not in kinds:
        raise ValueError("is no real number")
    return float(struct.unpack(kinds[len(value)], value)[0])
