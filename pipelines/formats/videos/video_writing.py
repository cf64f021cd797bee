"""Writer of H.264 videos whose frames carry their own time stamps, in parts that join without loss."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.geometry.arrays import Int64, Picture

if TYPE_CHECKING:
    from av import Packet, VideoStream

TICK_S = Fraction(1, 90_000)
"""Unit of the stamps, as in MPEG; a stamp is off by up to 5.6 microseconds."""

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


def join_videos(path: Path, parts: Sequence[Path]) -> None:
    """Join parts that were encoded alike to one video; their stamps continue from part to part.

    The coded pictures are copied, so nothing is lost.

    Raises:
        ValueError: there are no parts.
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
