"""Data tracks inside videos: packets of telemetry at their times, and when a video was made."""

from __future__ import annotations

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
    import av
    from av.stream import Discard

    if (kind := track_container(path)) is None:
        return
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
    import av

    if (kind := track_container(path)) is None:
        return None
    try:
        with av.open(f"file:{path.absolute()}", format=kind, metadata_errors="replace") as container:
            texts = [{**container.metadata}.get("creation_time")]
            texts += [{**stream.metadata}.get("creation_time") for stream in container.streams]
            return made_ns(texts)
    except (av.error.FFmpegError, OSError, ValueError):
        return None
