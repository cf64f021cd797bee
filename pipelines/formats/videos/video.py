"""Reader of video files through FFmpeg's libraries: the exact time of every frame, and any frame exactly.

Frames are numbered as a decoder gives them, from the first that it can decode, and identified by their
presentation stamps: counting decoded pictures fails if one is damaged, and index / rate if the rate varies.
Raw streams have no stamps: their pictures are counted, and decoded from the beginning.
"""

from __future__ import annotations

import bisect
import re
from collections.abc import Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from fractions import Fraction
from functools import lru_cache
from itertools import chain, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipelines.formats.common.rows import describe_times, since_epoch_ns
from pipelines.geometry.arrays import Bool, Int64, Picture
from pipelines.session.errors import DataError
from pipelines.session.records import UNTIMED, VideoIndex
from pipelines.session.storage import damaged, empty, on_disk

if TYPE_CHECKING:
    from av import Packet, VideoFrame
    from av.container import InputContainer
    from av.video.stream import VideoStream

# The fastest cameras take 100,000 frames in a second.
_SHORTEST_S = 1e-5
# Frames after the year 2096 are damage, and int64 ns hold 292 years.
_LATEST_S = 4 * 10**9
# MP4 counts from 1904 and a clock that was never set from 1970: such dates are none.
_NO_DATE_BEFORE_NS = 365 * 86_400 * 10**9
# A frame that no seek to one of so many key frames gives counts as undecodable.
_MOST_KEY_FRAMES = 3
# A larger size in a header is damage and would exhaust the memory.
_MOST_PIXELS = 1 << 27
# A codec's noise stays below this brightness (of 255) in black bars.
_BLACK = 16
# Where two pictures of MPEG-4 are packed into one packet, or one is left out, a placeholder has fewer bytes
# (FFmpeg's MAX_NVOP_SIZE).
_NVOP_BYTES = 20
# Brightness weighs the channels so (ITU-R BT.601).
_EYE_BGR = (0.114, 0.587, 0.299)
_MP4_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide")
_PACKET_TS, _PACKET_M2TS = 188, 192
# Phones halve their rate in the dark. A lost frame doubles an interval.
_GAP = 1.5
_NOT_GIVEN = "not given by a decoder, before the first key frame or after a lost frame"
# More pictures before a key frame are rather a shorter sequence than lost ones.
_MOST_LOST = 3
# The first bytes of containers, and FFmpeg's names of them.
_MAGIC = {
    b"\x1a\x45\xdf\xa3": "matroska",
    b"FLV\x01": "flv",
    b"OggS": "ogg",
    b"DKIF": "ivf",
    b"\0\0\x01\xba": "mpeg",
    b"0&\xb2u\x8ef\xcf\x11": "asf",
    b"nut/multimedia container\0": "nut",
    b"YUV4MPEG2 ": "yuv4mpegpipe",
    bytes.fromhex("060e2b34020501010d010201"): "mxf",
}
# Raw streams, by their first unit or by the ending of their names.
_RAW = {
    "h264": (re.compile(rb"\0\0\0?\x01[\x06\x09\x27\x47\x67]"), (".h264", ".264", ".avc")),
    "hevc": (re.compile(rb"\0\0\0?\x01[\x40\x42\x44\x46\x4e]\x01"), (".h265", ".265", ".hevc")),
    "mjpeg": (None, (".mjpeg", ".mjpg", ".mjp")),
}
_RAW_BEGINNING = re.compile(rb"\0\0\0?\x01|\xff\xd8\xff")


class VideoContainer:
    """Reader of the containers of video that FFmpeg reads, with any codec that it decodes."""

    name = "video"
    title = "video"
    suffixes: tuple[str, ...] = (
        *(".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".ts", ".mts", ".m2ts"),
        *(".flv", ".ogv", ".ogg", ".ivf", ".mpg", ".mpeg", ".vob", ".wmv", ".asf"),
        *(".nut", ".y4m", ".mxf"),
        *(suffix for _, suffixes in _RAW.values() for suffix in suffixes),
    )

    def recognises(self, path: Path) -> bool:
        """Return True if the file begins like one of these containers, or is empty with such a suffix."""
        try:
            if not path.is_file():
                return False
            empty = path.suffix.lower() in self.suffixes and path.stat().st_size == 0
            return empty or container_format(path) is not None
        except OSError:
            return False

    def describe(self, path: Path) -> dict[str, object]:
        """Describe frames, times, rate, gaps, picture size, codec, and losses."""
        index = self.index(path)
        if index.codec == UNTIMED:
            picture = f"{index.width} x {index.height} px"
            dropped = {f"dropped: {cause}": count for cause, count in index.dropped.items()}
            return {"frames": index.count, "times": "none: a raw stream", "picture": picture, **dropped}
        times = describe_times(index.pts_ns)
        return {
            "frames": index.count,
            "span_s": times["span_s"],
            "rate_hz": None if index.rate_hz is None else round(index.rate_hz, 3),
            **{key: times[key] for key in ("gaps", "longest_gap_s") if key in times},
            "start_s": round(index.start_ns / 1e9, 6),
            **({"created_s": made / 1e9} if (made := created_ns(path)) is not None else {}),
            "picture": f"{index.width} x {index.height} px",
            "turned_deg": index.rotation_deg,
            "codec": index.codec,
            **({"notes": list(index.notes)} if index.notes else {}),
            **{f"dropped: {cause}": count for cause, count in index.dropped.items()},
        }

    def index(self, path: Path) -> VideoIndex:
        """Read the time at which each frame is shown, from the container; only the first picture is decoded.

        The largest video stream is used, without cover pictures and frames that are hidden or only referred
        to. pts_ns[k] is the stamp of frame k less that of frame 0; those of equal stamps are spread up to the
        next. Counted in `dropped`: "cut off" (frames in the table after the end of the file, and the last
        ones shown later than the first lost one), "no stamp", "not given by a decoder".
        """
        with VideoReader(path) as reader:
            return reader.index


def created_ns(path: Path) -> int | None:
    """Return when a video was made by its metadata, ns since the epoch; None if unknown."""
    container, stream = open_container(path)
    with container:
        texts = [{**container.metadata}.get("creation_time"), {**stream.metadata}.get("creation_time")]
    for text in filter(None, texts):
        try:
            made = datetime.fromisoformat(text)
        except ValueError:
            continue
        t_ns = since_epoch_ns(made if made.tzinfo else made.replace(tzinfo=UTC))
        if t_ns > _NO_DATE_BEFORE_NS:
            return t_ns
    return None


def black_bars(path: Path) -> tuple[int, int, int, int]:
    """Count the black columns at the left, rows at the top, columns at the right and rows at the bottom.

    They are darker than 16 of 255 on average, in five pictures from all over the video. The brightness is
    that of all channels as the eye weighs them: codecs halve the resolution of colours, so these bleed into a
    bar.
    """
    with VideoReader(path) as reader:
        last = reader.index.count - 1
        wanted = {round(share * last) for share in (0.0, 0.25, 0.5, 0.75, 1.0)}
        pictures = [picture for k in sorted(wanted) if (picture := reader.read(k)) is not None]
    if not pictures:  # none of these can be decoded
        return 0, 0, 0, 0
    sides = []
    for axis in (0, 1):  # the mean over rows is that of each column
        means = np.stack([picture.mean(axis=axis) @ _EYE_BGR for picture in pictures])
        lit = np.flatnonzero(means.max(axis=0) >= _BLACK)
        sides.append((int(lit[0]), means.shape[1] - 1 - int(lit[-1])) if len(lit) else (0, 0))
    (left, right), (top, bottom) = sides
    return left, top, right, bottom


class VideoReader(AbstractContextManager["VideoReader"]):
    """Open video with its `index`: BGR pictures by number in any order; `missing` are undecodable ones."""

    index: VideoIndex
    missing: set[int]
    _next: tuple[int, VideoFrame] | None  # the frame that is returned next

    def __init__(self, path: Path) -> None:
        from av.video.reformatter import VideoReformatter

        self.missing = set()
        self._path = path
        self._reformatter = VideoReformatter()
        self._scan = _scan(path)
        self._reader: object = None  # the iteration of `frames` that moved the decoder last
        self._begin()
        if self._next is None:
            self.close()
            raise _undecodable(path, len(self._scan.ticks))
        if _is_mirrored(self._next[1]):
            self.close()
            problem = "shows its pictures mirrored (by its display matrix)"
            remedy = "export it again, so that its pictures are as the lens saw them"
            raise DataError(path, problem, remedy, code="unsupported")
        self.index = _index(self._scan, self._stream, self._next[1])

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def read(self, number: int) -> Picture | None:
        """Read one frame; None if it cannot be decoded."""
        return next((picture for _, picture in self.frames(number, number + 1)), None)

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[tuple[int, Picture]]:
        """Yield numbers and pictures of frames start, start + step, ... before stop (default: all).

        Frames that cannot be decoded are skipped. Several iterations may alternate.
        """
        count = self.index.count
        last = count if stop is None else stop
        if not 0 <= start <= last <= count or step < 1:
            problem = f"has no frames {start} to {last - 1} by {step}"
            raise DataError(self._path, problem, f"it has 0 to {count - 1}")
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
        """Move so that this frame comes next, or the first decodable one after it."""
        keys = self._scan.key_frames
        before = keys[: bisect.bisect_right(keys, number)]
        nearest = before[-1] if before else 0
        if self._next is not None and nearest <= self._next[0] <= number:
            return
        # A seek may land too late. After some key frames (intra refresh) the decoder needs time to recover.
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
        self._container, self._stream = open_container(self._path)
        self._coming = _numbered(self._container, self._stream, self._scan, sought=False)
        self._next = next(self._coming, None)

    def _seek(self, number: int) -> None:
        """Decode from near a key frame on, or from the beginning if the container cannot seek."""
        from av.error import FFmpegError

        try:
            self._container.seek(int(self._scan.ticks[number]), stream=self._stream, backward=True)
        except FFmpegError:
            self.close()
            self._begin()
            return
        self._coming = _numbered(self._container, self._stream, self._scan, sought=True)
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


# --- content of the container --------------------------------------------------------------------------


@dataclass(frozen=True)
class _Scan:
    ticks: Int64  # [N] stamps of the container, in order; numbers in a raw stream, lost pictures among them
    tick_s: Fraction
    key_frames: list[int]  # sorted numbers, of stamps that no other frame has
    dropped: dict[str, int]
    is_raw: bool = False
    in_order: bool = False  # decoded from the beginning, without seeking
    damaged: int = 0  # coded frames whose bytes are not as a codec writes them


class _CodedFrame(NamedTuple):
    """Coded frame as it is stored."""

    position: int | None  # in the file
    pts: int | None
    key: bool
    sound: bool
    is_guessed: bool  # its stamp of showing, where the container has none: a placeholder's, or in AVI


def _scan(path: Path) -> _Scan:
    """Read the stamps of all packets that a decoder turns into pictures, in the order of showing."""
    with on_disk(path):
        about = path.stat()
    return _scan_of(path, about.st_size, about.st_mtime_ns)


@lru_cache(maxsize=8)  # raw streams and those with gaps are decoded for it
def _scan_of(path: Path, size: int, _changed_ns: int) -> _Scan:
    container, stream = open_container(path)
    with container:
        codec, kind = stream.codec_context.codec.canonical_name, container.format.name
        reorders = kind in {"mxf", "asf"} and bool(stream.codec_context.has_b_frames)
        lengths = _bytes_of_lengths(codec, stream.codec_context.extradata or b"")
        stored = [
            _CodedFrame(
                packet.pos,
                packet.pts,
                packet.is_keyframe,
                _is_sound(packet, codec, lengths),
                # AVI, ASF and MXF without an index have stamps of decoding alone, MPEG-PS some.
                (codec == "mpeg4" and packet.size < _NVOP_BYTES)
                or (kind == "avi" and packet.pts != packet.dts)
                or (kind in {"mpeg", "mpegts", "mxf"} and packet.pts is None)
                or reorders,
            )
            for packet in packets(container, stream)
            if not packet.is_discard and is_shown(packet, codec)
        ]
        # Only a complete table, like that of MP4, lists frames beyond the file's end.
        lost = {e.pos: e.timestamp for e in stream.index_entries if e.size > 0 and e.pos + e.size > size}
        tick_s, listed = Fraction(stream.time_base or 0), stream.frames
        is_raw = kind in _RAW
    if is_raw or any(packet.is_guessed for packet in stored):
        unsound = sum(not packet.sound for packet in stored)
        return replace(_scan_in_order(path, len(stored), tick_s), damaged=unsound)
    whole = [packet for packet in stored if packet.position not in lost]
    stamped = [(packet.pts, packet.key) for packet in whole if packet.pts is not None]
    first_lost = min(lost.values(), default=0)
    # No frame is shown before it is decoded. So all frames shown before the first lost decoding are here.
    sure = [(pts, key) for pts, key in stamped if not lost or pts < first_lost]
    if not sure:
        problem = "its frames bear no time stamps" if whole else "holds no frames"
        if lost:
            problem = f"is cut off before its first frame ends ({len(lost)} are lost)"
        raise damaged(path, problem)
    ticks = np.sort(np.array([pts for pts, _ in sure], dtype=np.int64))
    _refuse_impossible(path, ticks, tick_s, listed)
    keys = np.array([pts for pts, key in sure if key], np.int64)
    given = _given(path, ticks, _key_frames(ticks, keys))
    if not given.any():
        raise _undecodable(path, len(ticks))
    counts = {
        "cut off": len(lost) + len(stamped) - len(sure),
        "no stamp": len(whole) - len(stamped),
        _NOT_GIVEN: int(np.count_nonzero(~given)),
    }
    ticks = ticks[given]
    return _Scan(
        ticks,
        tick_s,
        _key_frames(ticks, keys),
        {cause: count for cause, count in counts.items() if count},
        damaged=sum(not packet.sound for packet in whole),
    )


def _scan_in_order(path: Path, stored: int, tick_s: Fraction) -> _Scan:
    """Decode a stream whose packets do not say what is shown when: a raw one, packed MPEG-4, some AVI."""
    container, stream = open_container(path)
    with container:
        is_raw, codec = container.format.name in _RAW, stream.codec_context.codec.canonical_name
        rate = stream.average_rate
        shown = [(frame.pts, frame.dts) for frame in _decoded(container, stream, None)]
    if not shown:
        raise _undecodable(path, stored)
    if is_raw:
        found = [pts or 0 for pts, _ in shown]
        container, stream = open_container(path)
        with container:
            numbers = _numbers_by_order(found, _orders(packets(container, stream), codec, set(found)))
        unseen = int(numbers[-1]) + 1 - len(found) + min(found) + stored - 1 - max(found)
        return _Scan(
            numbers, Fraction(1), [], {_NOT_GIVEN: unseen} if unseen else {}, is_raw=True, in_order=True
        )
    # As FFmpeg does: where the stamps of showing go back, those of decoding count.
    by_pts, by_dts = (
        np.array([np.nan if t is None else t for t in each]) for each in zip(*shown, strict=True)
    )
    by_pts_known = by_pts[~np.isnan(by_pts)]
    stamps = by_pts if len(by_pts_known) and (np.diff(by_pts_known) > 0).all() else by_dts
    (known,), count = np.nonzero(~np.isnan(stamps)), np.arange(len(stamps))
    if not len(known) and rate and tick_s:  # MXF that is cut off
        stamps, known = count / float(rate * tick_s), count
    if not len(known):
        raise damaged(path, "its frames bear no time stamps")
    step = (stamps[known[-1]] - stamps[known[0]]) / max(int(known[-1] - known[0]), 1) or 1.0
    beyond = np.where(count < known[0], count - known[0], np.maximum(count - known[-1], 0))
    ticks = np.rint(np.interp(count, known, stamps[known]) + beyond * step).astype(np.int64)
    unseen = stored - len(shown) if codec != "mpeg4" else 0  # whose packets are no pictures
    dropped = {_NOT_GIVEN: unseen} if unseen > 0 else {}
    ticks = np.maximum.accumulate(ticks - count) + count
    _refuse_impossible(path, ticks, tick_s, len(ticks))
    return _Scan(ticks, tick_s, [], dropped, in_order=True)


def _refuse_impossible(path: Path, ticks: Int64, tick_s: Fraction, listed: int) -> None:
    """Raise DataError for stamps that only damage explains."""
    furthest_s = max(abs(int(ticks[0])), abs(int(ticks[-1]))) * tick_s
    if tick_s <= 0 or furthest_s > _LATEST_S:
        raise damaged(path, f"stamps its frames up to {float(furthest_s):.3g} s")
    shown_s = float((int(ticks[-1]) - int(ticks[0])) * tick_s)
    # With ticks of a second the edit list, in ticks of its own, ends before most frames.
    hidden = tick_s >= 1 and 2 * len(ticks) < listed
    if hidden or shown_s < _SHORTEST_S * (len(ticks) - 1):
        raise damaged(path, f"shows {len(ticks)} of its {listed} frames within {shown_s:.3g} s")


def _key_frames(ticks: Int64, keys: Int64) -> list[int]:
    """Return the numbers of the key frames, of stamps that no other frame has."""
    once = np.ones(len(ticks), np.bool_)
    once[1:] &= np.diff(ticks) > 0
    once[:-1] &= np.diff(ticks) > 0
    return np.flatnonzero(np.isin(ticks, keys) & once).tolist()


def _given(path: Path, ticks: Int64, keys: list[int]) -> Bool:
    """Mark the frames [N] that a decoder gives: after a lost one it may give none up to the next key frame.

    Only frames around gaps of the stamps are decoded for it, and those before the first key frame.
    """
    given = np.ones(len(ticks), np.bool_)
    interval = np.diff(ticks)
    gaps = np.flatnonzero(interval > _GAP * np.median(interval)).tolist() if len(interval) else []
    gaps = gaps if keys[:1] == [0] else [-1, *gaps]
    bounds = [0, 0, *keys, len(ticks), len(ticks)]  # at the edges of the video, too
    done = 0
    for gap in gaps:
        key = bisect.bisect_right(keys, gap) + 1  # of the last key frame before the gap, in `bounds`
        first, end = max(bounds[key], done), bounds[min(key + 2, len(bounds) - 1)]
        if first < end:
            found = _decoded_stamps(path, ticks, bounds[key - 1], end)
            if bounds[key - 1] and (not found or found[0] > ticks[bounds[key - 1]]):  # the seek went too far
                return np.isin(ticks, _decoded_stamps(path, ticks, 0, len(ticks)))
            given[first:end] = np.isin(ticks[first:end], found)
            done = end
    return given


def _decoded_stamps(path: Path, ticks: Int64, first: int, end: int) -> list[int]:
    """Decode from a key frame or before it up to another one, and return the stamps of all pictures."""
    from av.error import FFmpegError

    container, stream = open_container(path)
    with container:
        if first:
            with suppress(FFmpegError):  # a container that cannot seek begins at its beginning
                container.seek(int(ticks[first]), stream=stream, backward=True)
        decoded = _decoded(container, stream, None, sought=first > 0)
        stamps = (frame.pts for frame in decoded if frame.pts is not None)
        return list(takewhile(lambda pts: end == len(ticks) or pts < ticks[end], stamps))


def _is_mirrored(frame: VideoFrame) -> bool:
    """Test if a frame's display matrix (3 x 3, fixed point) swaps left and right."""
    sides: Any = frame.side_data  # whose annotations take its keys for its values
    for data in sides:
        if data.type.name == "DISPLAYMATRIX":
            a, b, _, c, d = np.frombuffer(bytes(data), "<i4").astype(float)[:5]
            return bool(a * d - b * c < 0)
    return False


def _index(scan: _Scan, stream: VideoStream, first: VideoFrame) -> VideoIndex:
    turned = round(first.rotation / 90) % 4 * 90
    width, height = (first.width, first.height) if turned % 180 == 0 else (first.height, first.width)
    pts_ns = _nanoseconds(scan.ticks, scan.tick_s, int(scan.ticks[0]))
    notes: tuple[str, ...] = ()
    starts = np.flatnonzero(np.diff(pts_ns, prepend=-1))  # of runs of equal stamps
    if again := len(pts_ns) - len(starts):
        step_ns = int(pts_ns[-1] - pts_ns[starts[-2]]) if len(starts) > 1 else 10**9
        ends_ns = np.append(pts_ns[starts], pts_ns[-1] + step_ns)
        pts_ns = np.interp(np.arange(len(pts_ns)), np.append(starts, len(pts_ns)), ends_ns).astype(np.int64)
        notes = (f"{again} frames have the stamp of the frame before: spread up to the next stamp",)
    codec = stream.codec_context.codec.canonical_name
    if scan.is_raw and codec != "mjpeg":
        notes += (
            "a raw stream has no times: lost pictures are counted by what the others say of their order,"
            " which may be wrong next to a key frame, and nothing shows a lost group of pictures",
        )
    if scan.damaged:
        notes += (
            f"{scan.damaged} coded frames are damaged: they keep their numbers, and a detector that leaves"
            " them out numbers the frames after them otherwise",
        )
    return VideoIndex(
        pts_ns=pts_ns,
        start_ns=int(_nanoseconds(scan.ticks[:1], scan.tick_s)[0]),
        width=width,
        height=height,
        rotation_deg=turned,
        codec=UNTIMED if scan.is_raw else codec,
        dropped=scan.dropped,
        notes=notes,
    )


def _nanoseconds(ticks: Int64, tick_s: Fraction, origin: int = 0) -> Int64:
    """Convert ticks to ns since the origin, rounded; Python integers, because products exceed 64 bits."""
    above, below = (tick_s * 10**9).as_integer_ratio()
    return np.array(
        [(2 * (t - origin) * above + below) // (2 * below) for t in ticks.tolist()], dtype=np.int64
    )


# --- order of raw streams --------------------------------------------------------------------------------


class _Order(NamedTuple):
    """Place of a coded picture in the order of showing."""

    sequence: int  # from one key frame that refers to nothing before it to the next
    place: int | None  # picture order count in the sequence; None if it is not known
    is_whole: bool  # False if the key frame of the sequence is lost


class _Bits:
    """Reader of the bits of one unit, whose emulation prevention it removes; ValueError at the end."""

    def __init__(self, unit: bytes) -> None:
        content = unit.replace(b"\0\0\3", b"\0\0")
        self._value, self._left = int.from_bytes(content), 8 * len(content)

    def read(self, count: int) -> int:
        """Read an unsigned number of so many bits."""
        self._left -= count
        return self._value >> self._left & ((1 << count) - 1)

    def golomb(self) -> int:
        """Read an unsigned number of variable length (ITU-T H.264, 9.1)."""
        zeros = 0
        while not self.read(1):
            zeros += 1
        return (1 << zeros) - 1 + self.read(zeros)

    def width(self) -> int:
        """Read how many bits a count has; no standard allows more than 16."""
        if (above := self.golomb()) > 12:
            raise ValueError
        return above + 4


# Profiles of H.264 that state their chroma and scaling lists (ITU-T H.264, 7.3.2.1.1).
_HIGH_PROFILES = {44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244}
# A picture that no decoder gives is at most so many counts from the one before it.
_NEAR = 32
# Parameter sets by their numbers, as far as the headers of pictures need them.
_Sets = dict[int, tuple[int, ...]]
# No header of a picture or a stream is longer, even with all scaling lists.
_HEADER_BYTES = 1024


def _orders(coded: Iterator[Packet[VideoStream]], codec: str, given: set[int]) -> dict[int, _Order]:
    """Read the place of each coded picture in the order of showing, by number of packet, from its header."""
    orders: dict[int, _Order] = {}
    streams: _Sets = {}
    pictures: _Sets = {}
    sequence, is_whole, reference = -1, False, 0
    seen: set[int] = set()
    for number, packet in enumerate(coded):
        try:
            found = _HEADS[codec](bytes(packet), streams, pictures)
        except (ValueError, KeyError):  # a damaged header, or MJPEG, which has none
            found = None
        if found is None or (found.is_field and number not in given):
            continue
        # The count of least distance to that of the last reference (ITU-T H.264, 8.2.1; H.265, 8.3.1).
        half = found.modulus // 2
        step = (found.place - reference + half) % found.modulus - half
        if not (found.starts or number in given or abs(step) <= _NEAR < found.modulus / 4):
            orders[number] = _Order(sequence, None, is_whole)
            continue
        count = found.place if found.starts else reference + step
        if not found.starts and count in seen and step + found.modulus <= 3 * found.modulus // 4:
            count += found.modulus  # references were lost
        # A count that was there before is that of a sequence whose first picture is lost.
        if found.starts or count in seen or sequence < 0:
            sequence, is_whole, seen = sequence + 1, found.starts, set()
            count = found.place
        seen.add(count)
        orders[number] = _Order(sequence, count, is_whole)
        reference = count if found.is_reference or found.starts else reference
    return orders


class _Coded(NamedTuple):
    """Header of a coded picture, as far as it says when it is shown."""

    starts: bool  # a sequence
    is_reference: bool
    place: int  # picture order count, modulo `modulus`
    modulus: int
    is_field: bool = False


def _h264_picture(packet: bytes, streams: _Sets, pictures: _Sets) -> _Coded | None:
    """Read the units of a packet up to its first slice; None without one (ITU-T H.264, 7.3)."""
    for unit in _units(packet):
        kind, bits = unit[0] & 31, _Bits(unit[1:])
        if kind == 7:  # sequence parameter set
            _read_h264_stream(bits, streams)
        elif kind == 8:  # picture parameter set
            pictures[bits.golomb()] = (bits.golomb(),)
        elif kind in {1, 5}:  # slice; 5: of a picture that refers to nothing before it
            bits.golomb(), bits.golomb()
            (stream,) = pictures[bits.golomb()]
            frame_bits, order_bits, planes, fields = streams[stream]
            bits.read(2 * planes)
            number = bits.read(frame_bits)
            if is_field := bool(fields and bits.read(1)):
                bits.read(1)
            if kind == 5:
                bits.golomb()
            is_reference = bool(unit[0] & 0x60)
            place = bits.read(order_bits) if order_bits else 2 * number - (not is_reference)
            modulus = 1 << order_bits if order_bits else 2 << frame_bits
            return _Coded(kind == 5, is_reference, place, modulus, is_field)
    return None


def _read_h264_stream(bits: _Bits, streams: _Sets) -> None:
    profile, planes = bits.read(24) >> 16, False
    name = bits.golomb()
    if profile in _HIGH_PROFILES:
        chroma = bits.golomb()
        planes = chroma == 3 and bool(bits.read(1))
        bits.golomb(), bits.golomb(), bits.read(1)
        for k in range(12 if chroma == 3 else 8) if bits.read(1) else ():  # scaling lists
            last = following = 8
            for _ in range((16 if k < 6 else 64) if bits.read(1) else 0):
                if following:
                    code = bits.golomb()
                    following = (last + (code + 1) // 2 * (1 if code % 2 else -1)) % 256
                last = following or last
    frame_bits, order_kind, order_bits = bits.width(), bits.golomb(), 0
    if order_kind == 0:
        order_bits = bits.width()
    elif order_kind == 1:
        bits.read(1), bits.golomb(), bits.golomb()
        for _ in range(bits.golomb()):
            bits.golomb()
    bits.golomb(), bits.read(1), bits.golomb(), bits.golomb()
    streams[name] = frame_bits, order_bits, planes, not bits.read(1)


def _h265_picture(packet: bytes, streams: _Sets, pictures: _Sets) -> _Coded | None:
    """Read the units of a packet up to its first slice; None without one (ITU-T H.265, 7.3)."""
    for unit in _units(packet):
        kind, bits = unit[0] >> 1 & 63, _Bits(unit[2:])
        if kind == 33:  # sequence parameter set
            _read_h265_stream(bits, streams)
        elif kind == 34:  # picture parameter set
            name, stream, shown = bits.golomb(), bits.golomb(), bits.read(2) & 1
            pictures[name] = stream, shown, bits.read(3)
        elif kind < 10 or 16 <= kind <= 21:  # slice; 16 to 21: of a picture at which decoding may begin
            bits.read(2 if kind >= 16 else 1)
            stream, shown, extra = pictures[bits.golomb()]
            order_bits, planes = streams[stream]
            bits.read(extra), bits.golomb(), bits.read(shown + 2 * planes)
            low = 0 if kind in {19, 20} else bits.read(order_bits)
            is_reference = unit[1] & 7 == 1 and (kind % 2 == 1 or kind >= 16) and kind not in {7, 9}
            return _Coded(16 <= kind <= 20, is_reference, low, 1 << order_bits)
    return None


def _read_h265_stream(bits: _Bits, streams: _Sets) -> None:
    layers = bits.read(7) & 7
    bits.read(1 + 96)
    flags = [bits.read(2) for _ in range(8 if layers else 0)][:layers]
    for each in flags:
        bits.read(88 * (each >> 1) + 8 * (each & 1))
    name, chroma = bits.golomb(), bits.golomb()
    planes = chroma == 3 and bool(bits.read(1))
    bits.golomb(), bits.golomb()
    for _ in range(4 if bits.read(1) else 0):
        bits.golomb()
    bits.golomb(), bits.golomb()
    streams[name] = bits.width(), planes


_HEADS = {"h264": _h264_picture, "hevc": _h265_picture}


def _units(packet: bytes) -> Iterator[bytes]:
    """Return the beginnings of the units of a packet, without start codes."""
    return (unit[:_HEADER_BYTES] for unit in packet.split(b"\0\0\1")[1:] if len(unit) > 2)


def _numbers_by_order(found: list[int], orders: dict[int, _Order]) -> Int64:
    """Number decoded pictures [N] (numbers of packets) from 0 as they were taken, lost ones among them.

    Without orders the packets are counted. Sequences of one length that end up to three pictures early lost
    these.
    """
    by_packets: Int64 = np.sort(np.array(found, np.int64)) - min(found)
    sequences: dict[int, list[int]] = {}
    unplaced: dict[int, int] = {}  # pictures after the last that is placed
    first = next((each.place for each in orders.values() if each.is_whole), 0) or 0
    for each in orders.values():
        counts = sequences.setdefault(each.sequence, [] if each.is_whole else [first])
        if not each.is_whole:  # what was not given before it belongs to it
            unplaced[each.sequence - 1] = 0
        unplaced[each.sequence] = unplaced.get(each.sequence, 0) + 1 if each.place is None else 0
        counts += [] if each.place is None else [each.place]
    places = [order.place for number in found if (order := orders.get(number))]
    if len(places) < len(found):
        return by_packets
    steps = [step for counts in sequences.values() for step in np.diff(np.unique(counts)).tolist()]
    step = max(set(steps), key=steps.count) if steps else 1
    lengths = [
        round((max(counts) - min(counts)) / step) + 1 + unplaced[sequence]
        for sequence, counts in sequences.items()
    ]
    inner, usual = lengths[:-1], max(lengths)
    if 2 * lengths.count(usual) > len(inner) > 0 and min(inner) >= usual - _MOST_LOST:
        lengths = [usual] * len(inner)
    begins = dict(zip(sequences, np.cumsum([0, *lengths]).tolist(), strict=False))
    taken = [
        begins[orders[number].sequence] + round((place - min(sequences[orders[number].sequence])) / step)
        for number, place in zip(found, places, strict=True)
        if place is not None
    ]
    count = np.arange(len(taken))
    # A decoder that misses a key frame mixes the pictures around it.
    numbers: Int64 = np.maximum.accumulate(np.sort(np.array(taken, np.int64)) - count) + count
    numbers -= numbers[0]
    # Where a third of the pictures seems lost, headers are rather damaged.
    return numbers if numbers[-1] < 1.5 * len(orders) else by_packets


# --- decoding -----------------------------------------------------------------------------------------


def _decoded(
    container: InputContainer, stream: VideoStream, first: int | None, *, sought: bool = False
) -> Iterator[VideoFrame]:
    from av.error import FFmpegError

    for number, packet in enumerate(chain(packets(container, stream), (None,))):
        if packet is not None and container.format.name in _RAW:
            packet.pts = number
        if sought and first is None:
            if packet is None or packet.pts is None or not packet.is_keyframe:
                continue
            first = packet.pts
        try:
            frames_ready = stream.decode(packet)  # packet None: the frames that the decoder still holds
        except FFmpegError:
            continue
        yield from (
            frame for frame in frames_ready if first is None or (frame.pts is not None and frame.pts >= first)
        )


def _numbered(
    container: InputContainer, stream: VideoStream, scan: _Scan, *, sought: bool
) -> Iterator[tuple[int, VideoFrame]]:
    """Yield numbers and frames in the order of showing; undecodable frames are skipped."""
    if scan.in_order:
        yield from zip(range(len(scan.ticks)), _decoded(container, stream, None), strict=False)
        return
    last = -1
    for frame in _decoded(container, stream, None if sought else int(scan.ticks[0]), sought=sought):
        number = max(int(np.searchsorted(scan.ticks, frame.pts or 0)), last + 1)
        # Stamps of a cut-off end are not in the index.
        if number < len(scan.ticks) and scan.ticks[number] == frame.pts:
            last = number
            if not frame.is_corrupt:
                yield number, frame


def open_container(path: Path) -> tuple[InputContainer, VideoStream]:
    """Open a container and its largest video stream, ready to decode; cover pictures are ignored."""
    import av
    from av.error import FFmpegError
    from av.stream import Disposition

    kind = _kind(path)
    try:
        # Named format and protocol, because a playlist under this name must not make FFmpeg open other files.
        container = av.open(f"file:{path.absolute()}", format=kind, metadata_errors="replace")
    except FFmpegError as error:
        if kind != "mov":
            raise _unreadable(path, "cannot be opened as a video") from error
        problem = "has no readable table of its frames (moov): the recording was not closed, or it is cut off"
        remedy = "copy it again, or repair it with a whole recording of the same camera"
        raise DataError(path, problem, remedy, code="damaged") from error
    streams = [s for s in container.streams.video if not s.disposition & Disposition.attached_pic]
    if not streams:
        container.close()
        raise _unreadable(path, "holds no video stream")
    # None for an unknown codec, despite its annotation.
    known = [s for s in streams if s.codec_context is not None]  # type: ignore[redundant-expr]
    if not known:
        container.close()
        raise DataError(path, "is coded in a way that FFmpeg cannot decode", "export it again, as H.264")
    stream = max(known, key=lambda s: s.width * s.height)
    if stream.width * stream.height > _MOST_PIXELS:
        container.close()
        raise damaged(path, f"states pictures of {stream.width} x {stream.height} px")
    stream.codec_context.options = {"max_pixels": str(_MOST_PIXELS)}
    # Not frame by frame: then the output for a damaged frame would depend on the number of processors.
    stream.thread_type = "SLICE"
    return container, stream


def _undecodable(path: Path, count: int) -> DataError:
    return DataError(path, f"none of its {count} frames can be decoded", "export it again, as MP4")


def _unreadable(path: Path, problem: str) -> DataError:
    return DataError(path, problem, "check that it is a video, and copy it again")


def _kind(path: Path) -> str:
    """Return FFmpeg's name of the container, by its first bytes."""
    with on_disk(path):
        size = path.stat().st_size
        kind = container_format(path)
    if not size:
        raise empty(path, "is empty")
    if kind is None:
        problem = "is no video container that is known here"
        raise DataError(path, problem, "export it as MP4", code="wrong-kind")
    return kind


def container_format(path: Path) -> str | None:
    """Return FFmpeg's name of the container by a file's first bytes; None for an unknown one."""
    with path.open("rb") as file:
        head = file.read(2 * _PACKET_M2TS)
    if head[4:8] in _MP4_BOXES:
        return "mov"
    if head.startswith(b"RIFF") and head[8:12] == b"AVI ":
        return "avi"
    for magic, kind in _MAGIC.items():
        if head.startswith(magic):
            return kind
    for first, step in ((0, _PACKET_TS), (4, _PACKET_M2TS)):
        if head[first : first + 1] == b"G" == head[first + step : first + step + 1]:
            return "mpegts"
    suffix = path.suffix.lower()
    if _RAW_BEGINNING.match(head):
        for kind, (beginning, suffixes) in _RAW.items():
            if suffix in suffixes or (beginning is not None and beginning.match(head)):
                return kind
    return None


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
    """Test if a coded frame gives a picture (RFC 6386, section 9.1; VP9 specification 0.6, 6.2 and B)."""
    if codec not in {"vp8", "vp9"}:
        return True
    content = bytes(packet)
    if codec == "vp8":
        return bool(content[0] >> 4 & 1)
    return any(_is_shown_vp9(content[start]) for start in _vp9_frames(content))


# The first bytes of every coded picture.
_STARTS = {"mpeg4": b"\0\0\1", "mjpeg": b"\xff\xd8"}


def _bytes_of_lengths(codec: str, stated: bytes) -> int:
    """Return how many bytes state the length of a unit in MP4 (ISO 14496-15); 0 for other streams."""
    place = {"h264": 4, "hevc": 21}.get(codec, len(stated))
    return (stated[place] & 3) + 1 if stated[:1] == b"\1" and place < len(stated) else 0


def _is_sound(packet: Packet[VideoStream], codec: str, lengths: int) -> bool:
    """Test if a coded picture begins as its codec writes it, and its units fill it; damage shows so."""
    content = memoryview(packet)
    if not lengths:
        return content[:3].tobytes().startswith(_STARTS.get(codec, b"")) and not packet.is_corrupt
    place = 0
    while place + lengths < len(content):
        length = int.from_bytes(content[place : place + lengths], "big")
        if not length or content[place + lengths] & 0x80:  # this bit is always 0
            return False
        place += lengths + length
    return place == len(content)


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


FORMAT = VideoContainer()
