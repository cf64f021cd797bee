"""Writer of H.264 videos whose frames carry their own time stamps, in parts that join without loss."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.geometry.arrays import Int64, Picture

if TYPE_CHECKING:
    from av import Packet, VideoCodecContext, VideoStream

TICK_S = Fraction(1, 90_000)
"""Unit of the stamps, as in MPEG; a stamp is off by up to 5.6 microseconds."""

# Of pictures in a log, often two a second: a viewer decodes from a key frame on.
_WIDEST_PX, _SEEK_EVERY = 960, 10
_STATED_HZ = 60  # of such a stream, whose pictures come more seldom: the level of H.264 follows from it
# The edit list that shifts a part to its start counts in the movie's own unit, by default 1 ms.
_KEY_EVERY = 60  # frames from one key frame to the next; a seek goes to a key frame
_OPTIONS = {"movflags": "faststart", "movie_timescale": str(TICK_S.denominator)}


def write_h264(
    path: Path,
    pictures: Iterable[Picture],
    pts_ns: Int64,
    *,
    width: int,
    height: int,
    quality: int = 23,
    bits_per_s: int | None = None,
) -> None:
    """Encode pictures [height, width, 3] BGR as an H.264 MP4, 4:2:0, in one thread.

    Args:
        pictures: as many as stamps.
        pts_ns: [N] strictly increasing times of showing, at least 0.
        width: of the pictures, even.
        height: of the pictures, even.
        quality: x264's constant rate factor; 18 looks lossless, 28 poor.
        bits_per_s: a mean rate over a second, kept in place of the quality.
    """
    import av

    ticks = ticks_of(pts_ns)
    with av.open(str(path), "w", options=_OPTIONS) as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.time_base = stream.codec_context.time_base = TICK_S
        stream.codec_context.thread_count = 1
        rate = {"crf": str(quality)}
        if bits_per_s is not None:
            rate = {name: str(bits_per_s) for name in ("b", "maxrate", "bufsize")}
        stream.codec_context.options = {**rate, "preset": "fast", "g": str(_KEY_EVERY), "bf": "0"}
        for pts, picture in zip(ticks, pictures, strict=True):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="bgr24")
            frame.pts, frame.time_base = pts, TICK_S
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


class H264Stream:
    """Encoder of the pictures of one camera for logs: one access unit of H.264 (Annex B) for each picture.

    There are no B frames, and every key frame carries its parameter sets, as foxglove.CompressedVideo and
    Rerun's VideoStream want it. All pictures have the size of the first, at most 960 px wide, made even. One
    thread: the same pictures give the same bytes.
    """

    def __init__(self) -> None:
        self._codec: VideoCodecContext | None = None
        self._count = 0

    def encode(self, picture: Picture) -> tuple[bytes, bool]:
        """Encode a picture [height, width, 3] BGR; return its access unit, and if it is a key frame."""
        import av
        import cv2

        if self._codec is None:
            self._codec = _open_stream(picture.shape[1], picture.shape[0])
        size = (self._codec.width, self._codec.height)
        if (picture.shape[1], picture.shape[0]) != size:
            picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="bgr24")
        frame.pts, self._count = self._count, self._count + 1
        packets = self._codec.encode(frame)
        return b"".join(bytes(packet) for packet in packets), any(packet.is_keyframe for packet in packets)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the video, px; (0, 0) before its first picture."""
        return (0, 0) if self._codec is None else (self._codec.width, self._codec.height)


def _open_stream(width: int, height: int) -> VideoCodecContext:
    """Open an encoder that gives each picture at once, for pictures of a size."""
    from av import VideoCodecContext

    shrunk = min(_WIDEST_PX / width, 1.0)
    codec = VideoCodecContext.create("libx264", "w")
    codec.width, codec.height = (max(2 * round(shrunk * side / 2), 2) for side in (width, height))
    codec.pix_fmt, codec.thread_count = "yuv420p", 1
    codec.framerate, codec.time_base = Fraction(_STATED_HZ), Fraction(1, _STATED_HZ)
    codec.options = {"crf": "23", "preset": "fast", "tune": "zerolatency", "g": str(_SEEK_EVERY), "bf": "0"}
    return codec


def join_videos(path: Path, parts: Sequence[Path]) -> None:
    """Join parts that were encoded alike to one video; their stamps continue from part to part.

    The coded pictures are copied, so nothing is lost.
    """
    import av

    if not parts:
        raise ValueError("no parts to join")
    with av.open(str(path), "w", options=_OPTIONS) as container:
        with av.open(str(parts[0])) as first:
            stream = container.add_stream_from_template(first.streams.video[0])
        stream.time_base = TICK_S
        for packet in _packets(parts):
            packet.stream = stream
            container.mux(packet)


def ticks_of(pts_ns: Int64) -> list[int]:
    """Convert stamps to units of `TICK_S`, rounded to the nearest."""
    return [round(Fraction(stamp, 10**9) / TICK_S) for stamp in pts_ns.tolist()]


def _packets(parts: Sequence[Path]) -> Iterator[Packet[VideoStream]]:
    import av

    for part in parts:
        with av.open(str(part)) as source:
            for packet in source.demux(source.streams.video[0]):
                if packet.size:
                    yield packet
