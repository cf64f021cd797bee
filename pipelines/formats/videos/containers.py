"""Containers of videos: their kind, their largest stream, and the coded frames in it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.session.errors import DataError

if TYPE_CHECKING:
    from av import Packet
    from av.container import InputContainer
    from av.video.stream import VideoStream

_MOST_PIXELS = 1 << 27  # 16384 x 8192; a larger size in a header is damage and would exhaust the memory
_MP4_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide")
_PACKET_TS, _PACKET_M2TS = 188, 192


def open_container(path: Path) -> tuple[InputContainer, VideoStream]:
    """Open a container and its largest video stream, ready to decode; cover pictures are ignored.

    Raises:
        DataError: missing, empty, no known container, without its table or a video stream, a
            codec that cannot be decoded, or a picture size beyond the limit.
    """
    import av
    from av.error import FFmpegError
    from av.stream import Disposition

    kind = _kind(path)
    try:
        # Named format and protocol, because a playlist under this name must not make FFmpeg open other files.
        container = av.open(f"file:{path.absolute()}", format=kind, metadata_errors="replace")
    except FFmpegError as error:
        raise _unreadable(path, kind, "cannot be opened as a video") from error
    streams = [s for s in container.streams.video if not s.disposition & Disposition.attached_pic]
    if not streams:
        container.close()
        raise _unreadable(path, kind, "holds no video stream")
    known = [s for s in streams if _has_decoder(s)]
    if not known:
        container.close()
        raise DataError(path, "is coded in a way that FFmpeg cannot decode", "export it again, as H.264")
    stream = max(known, key=lambda s: s.width * s.height)
    if stream.width * stream.height > _MOST_PIXELS:
        container.close()
        raise DataError(
            path,
            f"states pictures of {stream.width} x {stream.height} px",
            "its header is damaged: copy it again",
        )
    stream.codec_context.options = {"max_pixels": str(_MOST_PIXELS)}
    # Not frame by frame: then the output for a damaged frame would depend on the number of processors.
    stream.thread_type = "SLICE"
    return container, stream


def _has_decoder(stream: VideoStream) -> bool:
    context: object = stream.codec_context  # None for an unknown codec, despite its annotation
    return context is not None


def _unreadable(path: Path, kind: str, problem: str) -> DataError:
    if kind == "mov" and not _has_table(path):
        return DataError(
            path,
            "has no table of its frames (moov): the recording was not closed, or the file is cut off",
            "copy it again, or repair it with a whole recording of the same camera",
        )
    return DataError(path, problem, "check that it is a video, and copy it again")


def _kind(path: Path) -> str:
    """Return FFmpeg's name of the container, by its first bytes."""
    try:
        size = path.stat().st_size
        kind = container_format(path)
    except OSError as error:
        raise DataError(path, f"cannot be read ({error.strerror})", "check the path") from error
    if not size:
        raise DataError(path, "is empty", "copy it from the camera again")
    if kind is None:
        raise DataError(
            path, "is no video container that is known here", "known are MP4, MOV, MKV, WebM, AVI, MPEG-TS"
        )
    return kind


def container_format(path: Path) -> str | None:
    """Return FFmpeg's name of the container by a file's first bytes; None for an unknown one.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(2 * _PACKET_M2TS)
    if head[4:8] in _MP4_BOXES:
        return "mov"
    if head.startswith(b"\x1a\x45\xdf\xa3"):
        return "matroska"
    if head.startswith(b"RIFF") and head[8:12] == b"AVI ":
        return "avi"
    for first, step in ((0, _PACKET_TS), (4, _PACKET_M2TS)):
        if head[first : first + 1] == b"G" == head[first + step : first + step + 1]:
            return "mpegts"
    return None


def _has_table(path: Path) -> bool:
    """Return True if an MP4 has its complete `moov` box."""
    size = path.stat().st_size
    start = 0
    with path.open("rb") as file:
        while start + 8 <= size:
            file.seek(start)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big")
            if length == 1:
                length = int.from_bytes(head[8:], "big")
            if head[4:8] == b"moov":
                return length >= 8 and start + length <= size
            if length < 8:
                return False
            start += length
    return False


def packets(container: InputContainer, stream: VideoStream) -> Iterator[Packet[VideoStream]]:
    """Yield the coded frames in the order of storage, as far as the container can be read."""
    from av.error import FFmpegError

    try:
        for packet in container.demux(stream):
            if packet.size:  # the last packet is empty and only tells the decoder that it is the last
                yield packet
    except FFmpegError:
        return


def is_shown(packet: Packet[VideoStream], codec: str) -> bool:
    """Test if a coded frame gives a picture.

    VP8 and VP9 code frames that are never shown, only referred to (alternate reference frames). Some writers
    store them as packets of their own, with the stamp of the next picture or one just before it.
    VP8: RFC 6386, section 9.1. VP9: bitstream specification 0.6, section 6.2 and annex B (superframes).
    """
    if codec not in {"vp8", "vp9"}:
        return True
    content = bytes(packet)
    if codec == "vp8":
        return bool(content[0] >> 4 & 1)
    return any(_is_shown_vp9(content[start]) for start in _vp9_frames(content))


def _vp9_frames(content: bytes) -> list[int]:
    """List the starts of the frames of a VP9 packet; several if there is an index at its end."""
    last = content[-1]
    count, width = (last & 7) + 1, (last >> 3 & 3) + 1
    length = 2 + count * width
    if last >> 5 != 0b110 or length > len(content) or content[-length] != last:
        return [0]
    sizes = content[1 - length : -1]
    starts = [0]
    for place in range(0, len(sizes) - width, width):
        starts.append(starts[-1] + int.from_bytes(sizes[place : place + width], "little"))
    return [start for start in starts if start < len(content) - length] or [0]


def _is_shown_vp9(first: int) -> bool:
    """Read show_existing_frame and show_frame of a frame's first byte (profile 3: one bit later)."""
    bits = first << 1 if first >> 4 & 3 == 3 else first
    return first >> 6 != 2 or bool(bits & 0b1010)
