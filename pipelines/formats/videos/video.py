"""Video files through FFmpeg's libraries: the exact time of every frame, and any frame exactly.

Frames are told apart by their presentation stamps alone. Counting decoded pictures goes wrong where one is
damaged, and index / rate where the rate varies; a seek may land behind the frame it was asked for.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from pipelines.formats.common.summaries import describe_times
from pipelines.formats.videos.containers import container_format, is_shown, open_container, packets
from pipelines.session.errors import DataError
from pipelines.session.records import Int64, VideoIndex

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer
    from av.video.stream import VideoStream

Picture = NDArray[np.uint8]  # [height, width, 3] blue, green, red

_LATEST_S = 4 * 10**9  # after the year 2096, counted from the epoch; int64 ns hold 292 years
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_NO_DATE_BEFORE = timedelta(days=365 * 15)  # 1985: there were no drones
_MOST_KEY_FRAMES = 3  # to seek before a frame counts as undecodable


class VideoContainer:
    """MP4, MOV, MKV, WebM, AVI and MPEG transport streams, with whatever codec FFmpeg decodes."""

    name = "video"
    title = "video"
    suffixes: tuple[str, ...] = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".ts", ".mts", ".m2ts")

    def recognises(self, path: Path) -> bool:
        """Whether it begins as one of these containers does; or is empty, but was to become one."""
        try:
            if not path.is_file():
                return False
            empty = path.suffix.lower() in self.suffixes and path.stat().st_size == 0
            return empty or container_format(path) is not None
        except OSError:
            return False

    def describe(self, path: Path) -> dict[str, object]:
        """Frames, times, rate, gaps, picture, codec, and what the file lost."""
        index = self.index(path)
        times = describe_times(index.pts_ns)
        return {
            "frames": index.count,
            "span_s": times["span_s"],
            "rate_hz": None if index.rate_hz is None else round(index.rate_hz, 3),
            "rate": "variable" if index.variable else "constant",
            **{key: times[key] for key in ("gaps", "longest_gap_s") if key in times},
            "start_s": round(index.start_ns / 1e9, 6),
            **({"created_s": made / 1e9} if (made := created_ns(path)) is not None else {}),
            "picture": f"{index.width} x {index.height} px",
            "turned_deg": index.rotation_deg,
            "codec": index.codec,
            **{f"dropped: {cause}": count for cause, count in index.dropped.items()},
        }

    def index(self, path: Path) -> VideoIndex:
        """What `index_video` says."""
        return index_video(path)


def index_video(path: Path) -> VideoIndex:
    """When each frame is shown, from the container; only the first picture is decoded.

    The largest video stream counts, cover pictures do not; frames that an edit list hides are none,
    nor are those that VP8 and VP9 code for reference only.
    pts_ns[k] is the stamp of frame k less that of frame 0, rounded to a nanosecond once.

    Counted in `dropped`: "cut off" (the container's table lists them, the file ends before; with them the
    last few frames that come later in time than the first one lost, whose numbers nobody can tell),
    "no stamp", "duplicate stamp".

    Raises:
        DataError: missing, empty, no video container, without its table (an MP4 that was never closed),
            without a video stream, a codec that cannot be decoded, no frame with a stamp, no frame that can
            be decoded, or a picture size beyond reason.
    """
    with VideoReader(path) as reader:
        return reader.index


def created_ns(path: Path) -> int | None:
    """When a video says that it was made, ns since the epoch; None where it does not say.

    MP4 and MOV hold whole seconds of UTC, by definition; some cameras write local time, some the moment
    when they closed the file.

    Raises:
        DataError: it cannot be opened as a video.
    """
    container, stream = open_container(path)
    with container:
        texts = [{**container.metadata}.get("creation_time"), {**stream.metadata}.get("creation_time")]
    for text in texts:
        if not text:
            continue
        try:
            made = datetime.fromisoformat(text)
        except ValueError:
            continue
        elapsed = (made if made.tzinfo else made.replace(tzinfo=UTC)) - _EPOCH
        if elapsed > _NO_DATE_BEFORE:  # 1904 is the zero of MP4, 1970 that of a clock that was never set
            return elapsed // timedelta(microseconds=1) * 1000
    return None


def frames(
    path: Path, start: int = 0, stop: int | None = None, step: int = 1
) -> Iterator[tuple[int, Picture]]:
    """Frames start, start + step, ... before stop, one at a time; as `VideoReader.frames` says."""
    with VideoReader(path) as reader:
        yield from reader.frames(start, stop, step)


class VideoReader:
    """A video at hand: `index`, and its frames by number, in any order.

    A context manager. Pictures are BGR, uint8, turned as players and OpenCV show them, so that their size
    is that of the index. `missing` holds the numbers of the frames found undecodable so far.

    Raises:
        DataError: as `index_video` says.
    """

    index: VideoIndex
    missing: set[int]
    _next: tuple[int, VideoFrame] | None  # comes out next

    def __init__(self, path: Path) -> None:
        from av.video.reformatter import VideoReformatter

        self.missing = set()
        self._path = path
        self._reformatter = VideoReformatter()
        self._scan = _scan(path)
        self._reader: object = None  # whose turn it is among the iterations of `frames`
        self._begin()
        if self._next is None:
            self.close()
            count = len(self._scan.ticks)
            raise DataError(path, f"none of its {count} frames can be decoded", "export it again, as MP4")
        self.index = _index(self._scan, self._stream, self._next[1])

    def __enter__(self) -> Self:
        """The reader itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def read(self, number: int) -> Picture | None:
        """One frame; None where it cannot be decoded.

        Raises:
            DataError: no such frame, or it has another size than the first.
        """
        return next((picture for _, picture in self.frames(number, number + 1)), None)

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[tuple[int, Picture]]:
        """Numbers and pictures of the frames start, start + step, ... before stop (default: all), in order.

        Pictures come one at a time. Frames that cannot be decoded are left out, the others keep their
        numbers. Iterations may take turns.

        Raises:
            DataError: no such frames, or a picture of another size than the first.
        """
        count = self.index.count
        last = count if stop is None else stop
        if not 0 <= start <= last <= count or step < 1:
            raise DataError(
                self._path, f"has no frames {start} to {last - 1} by {step}", f"it has 0 to {count - 1}"
            )
        reader = object()
        for number in range(start, last, step):
            if self._reader is not reader:
                self._go_to(number)
                self._reader = reader
            self._skip_to(number)
            if self._next is not None and self._next[0] == number:
                yield number, self._picture(self._next[1])
            else:
                self.missing.add(number)

    def _go_to(self, number: int) -> None:
        """Have that frame come out next, or the first after it that can be decoded."""
        keys = self._scan.key_frames
        before = keys[: bisect.bisect_right(keys, number)]
        nearest = before[-1] if before else 0
        if self._next is not None and nearest <= self._next[0] <= number:
            return
        # A seek may land too late; and after some key frames (intra refresh) it takes a while to recover.
        for key in before[: -_MOST_KEY_FRAMES - 1 : -1]:
            self._seek(key)
            self._skip_to(number)
            if self._next is not None and self._next[0] == number:
                return
        if len(before) < _MOST_KEY_FRAMES:
            self.close()
            self._begin()

    def _skip_to(self, number: int) -> None:
        while self._next is not None and self._next[0] < number:
            self._next = next(self._coming, None)

    def _begin(self) -> None:
        """Open the file and decode from the beginning."""
        self._container, self._stream = open_container(self._path)
        self._coming = _numbered(self._container, self._stream, self._scan.ticks, sought=False)
        self._next = next(self._coming, None)

    def _seek(self, number: int) -> None:
        """Decode from about a key frame on, or from the beginning where the container cannot seek."""
        from av.error import FFmpegError

        try:
            self._container.seek(int(self._scan.ticks[number]), stream=self._stream, backward=True)
        except FFmpegError:
            self.close()
            self._begin()
            return
        self._coming = _numbered(self._container, self._stream, self._scan.ticks, sought=True)
        self._next = next(self._coming, None)

    def _picture(self, frame: VideoFrame) -> Picture:
        pixels = self._reformatter.reformat(frame, format="bgr24").to_ndarray()
        picture = np.ascontiguousarray(np.rot90(pixels, self.index.rotation_deg // 90), dtype=np.uint8)
        height, width = picture.shape[:2]
        if (width, height) != (self.index.width, self.index.height):
            raise DataError(
                self._path,
                f"its pictures change from {self.index.width} x {self.index.height} to {width} x {height} px",
                "cut it there and give each part by itself",
            )
        return picture


# --- what the container says ---------------------------------------------------------------------------


@dataclass(frozen=True)
class _Scan:
    ticks: Int64  # [N] strictly increasing stamps of the container
    tick_s: Fraction
    key_frames: list[int]  # sorted numbers
    dropped: dict[str, int]


class _Packet(NamedTuple):
    """One coded frame as it is stored."""

    position: int | None  # in the file
    pts: int | None
    key: bool


def _scan(path: Path) -> _Scan:
    """The stamps of all packets, in the order of showing."""
    container, stream = open_container(path)
    with container:
        size = path.stat().st_size
        stored = [
            _Packet(packet.pos, packet.pts, packet.is_keyframe)
            for packet in packets(container, stream)
            if not packet.is_discard and is_shown(packet, stream.codec_context.codec.canonical_name)
        ]
        # Only a whole table, as of MP4, lists frames beyond the file's end.
        lost = {e.pos: e.timestamp for e in stream.index_entries if e.size > 0 and e.pos + e.size > size}
        tick_s = Fraction(stream.time_base or 0)
    whole = [packet for packet in stored if packet.position not in lost]
    stamped = [(packet.pts, packet.key) for packet in whole if packet.pts is not None]
    first_lost = min(lost.values(), default=0)
    # No frame is shown before it is decoded: what is shown before the first lost one's decoding is complete.
    sure = [(pts, key) for pts, key in stamped if not lost or pts < first_lost]
    if not sure:
        problem = "its frames bear no time stamps" if whole else "holds no frames"
        if lost:
            problem = f"is cut off before its first frame ends ({len(lost)} are lost)"
        raise DataError(path, problem, "copy it from the camera again, or export it as MP4")
    ticks = np.unique(np.array([pts for pts, _ in sure], dtype=np.int64))
    furthest_s = max(abs(int(ticks[0])), abs(int(ticks[-1]))) * tick_s
    if tick_s <= 0 or furthest_s > _LATEST_S:
        raise DataError(path, f"stamps its frames up to {float(furthest_s):.3g} s", "its header is damaged")
    counts = {
        "cut off": len(lost) + len(stamped) - len(sure),
        "no stamp": len(whole) - len(stamped),
        "duplicate stamp": len(sure) - len(ticks),
    }
    return _Scan(
        ticks,
        tick_s,
        np.flatnonzero(np.isin(ticks, [pts for pts, key in sure if key])).tolist(),
        {cause: count for cause, count in counts.items() if count},
    )


def _index(scan: _Scan, stream: VideoStream, first: VideoFrame) -> VideoIndex:
    turned = round(first.rotation / 90) % 4 * 90
    width, height = (first.width, first.height) if turned % 180 == 0 else (first.height, first.width)
    return VideoIndex(
        pts_ns=_nanoseconds(scan.ticks, scan.tick_s, int(scan.ticks[0])),
        start_ns=int(_nanoseconds(scan.ticks[:1], scan.tick_s)[0]),
        width=width,
        height=height,
        rotation_deg=turned,
        codec=stream.codec_context.codec.canonical_name,
        variable=_is_variable(scan.ticks),
        dropped=scan.dropped,
    )


def _nanoseconds(ticks: Int64, tick_s: Fraction, origin: int = 0) -> Int64:
    """Since the origin, to the nearest ns. In Python's integers: the products need more than 64 bits."""
    above, below = (tick_s * 10**9).as_integer_ratio()
    return np.array(
        [(2 * (t - origin) * above + below) // (2 * below) for t in ticks.tolist()], dtype=np.int64
    )


def _is_variable(ticks: Int64) -> bool:
    """Whether a frame is off the even grid by more than the container's clock and 1 % of a frame."""
    count = len(ticks)
    if count < 3:
        return False
    even = np.linspace(0.0, float(ticks[-1] - ticks[0]), count)
    return bool(np.abs(ticks - ticks[0] - even).max() > max(1.0, 0.01 * even[1]))


# --- decoding -----------------------------------------------------------------------------------------


def _numbered(
    container: InputContainer, stream: VideoStream, ticks: Int64, *, sought: bool
) -> Iterator[tuple[int, VideoFrame]]:
    """Numbers and frames in the order of showing; those that cannot be decoded do not come.

    After a seek, from the first key frame that is met: what a decoder delivers for frames shown before it
    refers to pictures that were not decoded.
    """
    from av.error import FFmpegError

    first = None if sought else int(ticks[0])
    last = -1
    for packet in chain(packets(container, stream), (None,)):
        if first is None:
            if packet is None or packet.pts is None or not packet.is_keyframe:
                continue
            first = packet.pts
        try:
            frames_ready = stream.decode(packet)  # None: what the decoder still holds
        except FFmpegError:
            continue
        for frame in frames_ready:
            if frame.pts is None or frame.pts < first or frame.is_corrupt:
                continue
            number = int(np.searchsorted(ticks, frame.pts))
            # The stamps of a cut-off end are not in the index.
            if last < number < len(ticks) and ticks[number] == frame.pts:
                last = number
                yield number, frame


FORMAT = VideoContainer()
