"""Writer of H.264 videos whose frames carry their own stamps, and of the skeleton over pictures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from pipelines.geometry.arrays import Int64, Picture
from pipelines.geometry.joint_angles import ANGLES
from pipelines.session.errors import DataError
from pipelines.session.records import Recording

if TYPE_CHECKING:
    from av import Packet, VideoCodecContext, VideoStream

TICK_S = Fraction(1, 90_000)
"""Unit of the stamps, as in MPEG; a stamp is off by up to 5.6 microseconds."""

# Of pictures in a log, often two a second: a viewer decodes from a key frame on.
_WIDEST_PX, _SEEK_EVERY = 960, 10
# The level of H.264 follows from this rate; pictures come more seldom.
_STATED_HZ = 60
# The edit list that shifts a part to its start counts in the movie's own unit, by default 1 ms.
_KEY_EVERY = 60  # frames from one key frame to the next; a seek goes to a key frame
# x264's constant rate factor: 18 looks lossless, 28 poor.
_QUALITY = "23"
_OPTIONS = {"movflags": "faststart", "movie_timescale": str(TICK_S.denominator)}


def write_h264(
    path: Path,
    pictures: Iterable[Picture],
    pts_ns: Int64,
    *,
    width: int,
    height: int,
    bits_per_s: int | None = None,
) -> None:
    """Encode pictures [H, W, 3] BGR (even sides) as an H.264 MP4 in one thread, shown at `pts_ns` [N]."""
    import av

    ticks = [round(Fraction(stamp, 10**9) / TICK_S) for stamp in pts_ns.tolist()]
    with av.open(str(path), "w", options=_OPTIONS) as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.time_base = stream.codec_context.time_base = TICK_S
        stream.codec_context.thread_count = 1
        rate = {"crf": _QUALITY}
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
    Rerun's VideoStream want it. Pictures are at most 960 px wide, made even. The same pictures give the same
    bytes.
    """

    def __init__(self) -> None:
        self._codec: VideoCodecContext | None = None
        self._count = 0

    def encode(self, picture: Picture) -> tuple[bytes, bool]:
        """Encode a picture [height, width, 3] BGR; return its access unit, and if it is a key frame."""
        import av

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
    """Join the coded pictures of parts that were encoded alike; their stamps continue from part to part."""
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


def _packets(parts: Sequence[Path]) -> Iterator[Packet[VideoStream]]:
    import av

    for part in parts:
        with av.open(str(part)) as source:
            for packet in source.demux(source.streams.video[0]):
                if packet.size:
                    yield packet


# Two pictures need stamps at least one tick of the video apart.
_TICK_NS = int(TICK_S * 10**9) + 1


@dataclass(frozen=True)
class OverlayExport:
    """Videos CAMERA.overlay.mp4, with the chosen joint angles beside their joints."""

    angles: tuple[str, ...] = ()
    name: str = "overlay"
    title: str = "the skeleton over every picture (MP4); overlay:left_knee+right_elbow adds joint angles"

    def configured(self, argument: str) -> OverlayExport:
        """Return the export that writes angles, with `+` between their names; DataError for unknown ones."""
        return replace(self, angles=tuple(dict.fromkeys(map(_angle_named, argument.split("+")))))

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write the video of every camera that has pictures; DataError without a skeleton or pictures."""
        if recording.motion is None:
            problem, remedy = "holds no skeleton to draw", "run `mocap reconstruct` first"
            raise DataError(recording.name, problem, remedy, code="nothing-reconstructed")
        written = []
        for camera in recording.cameras:
            film = recording.film(camera, self.angles, recording.progress)
            if film is not None:
                written.append(folder / f"{camera}.overlay.mp4")
                _write_video(written[-1], *film)
        if not written:
            remedy = "state the cameras' `video` in flight.yaml, and ingest it"
            raise DataError(recording.name, "has no pictures to draw on", remedy, code="no-pictures")
        return sorted(written)


def _angle_named(words: str) -> str:
    """Return the angle of that name, or the main one of a joint: left_knee is left_knee_flexion."""
    endings = ("", "_flexion", "_dorsiflexion", "_elevation", "_pronation")
    name = next((words + end for end in endings if words + end in ANGLES), None)
    if name is None:
        problem = f"there is no angle {words!r}"
        raise DataError("overlay", problem, f"there are {', '.join(ANGLES)}", code="no-such-name")
    return name


def _write_video(path: Path, t_ns: Int64, pictures: Iterator[Picture]) -> None:
    """Write pictures of any size in the even size of the first, with their times since the first."""
    first = next(pictures)
    height, width = (side + side % 2 for side in first.shape[:2])

    def even() -> Iterator[Picture]:
        for picture in chain([first], pictures):
            down, right = height - picture.shape[0], width - picture.shape[1]
            if down in (0, 1) and right in (0, 1):
                yield np.pad(picture, ((0, down), (0, right), (0, 0)), mode="edge")
            else:  # the pictures of a log may change their size
                yield np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)

    # Two stamps must not share a tick of the video: the later one moves by as little as possible.
    least = np.arange(len(t_ns)) * _TICK_NS
    pts_ns = np.maximum.accumulate(t_ns - t_ns[0] - least) + least
    write_h264(path, even(), pts_ns, width=width, height=height)


OVERLAY_EXPORT = OverlayExport()
