"""Records of found files, with what a draft needs: names, kinds, times, topics; no arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pipelines.session.telemetry import Height

Place = tuple[str, ...]
"""Names of a thing: folders below the common one, then the file's name without its suffix."""

TopicKind = Literal["poses", "transforms", "angles", "intrinsics", "pictures"]


@dataclass(frozen=True)
class Span:
    """First and last stamp, ns."""

    first_ns: int
    last_ns: int

    def overlap_ns(self, other: Span) -> int:
        """Compute the length of the overlap with another span; negative is the gap between them."""
        return min(self.last_ns, other.last_ns) - max(self.first_ns, other.first_ns)


@dataclass(frozen=True)
class Found:
    """A file, or a folder that is one source."""

    path: Path
    place: Place
    format: str  # its name in the registry
    title: str


@dataclass(frozen=True)
class Keypoints(Found):
    """2D keypoints of one camera."""

    frames: int  # listed
    first_frame: int
    last_frame: int
    ambiguous: bool = False  # other formats recognise it as well: the manifest must state its format


@dataclass(frozen=True)
class Poses(Found):
    """A trajectory."""

    span: Span


@dataclass(frozen=True)
class Lens:
    """Flags for what a calibration holds of one camera."""

    intrinsics: bool
    pose: bool


@dataclass(frozen=True)
class Calibration(Found):
    """Cameras by name."""

    cameras: dict[str, Lens]


@dataclass(frozen=True)
class Joints(Found):
    """3D joints over time."""

    span: Span


@dataclass(frozen=True)
class FrameTimes(Found):
    """A file with the times of frames."""

    key: Literal["csv", "srt"]  # its key in a manifest
    rows: int
    span: Span


@dataclass(frozen=True)
class Video(Found):
    """A video; the zero of its stamps is that of its container."""

    frames: int
    length_ns: int


@dataclass(frozen=True)
class Map(Found):
    """A map of the surroundings."""


@dataclass(frozen=True)
class TopicFound:
    """A topic that a manifest can name; `target` and `source` are the frames of its first pose."""

    name: str
    type: str
    kind: TopicKind
    count: int
    span: Span
    target: str = ""
    source: str = ""


@dataclass(frozen=True)
class DroneLog(Found):
    """A drone's own log: positions, and perhaps attitudes of body and gimbal."""

    key: Literal["dji", "ulog", "ardupilot"]  # its key in a manifest
    span: Span
    positions: int
    step_ns: int  # median step between positions
    by_gps: bool
    body: bool
    gimbal: bool
    height: Height = "unknown"  # zero level of its heights; "stated" if it has no heights
    video_start_ns: int | None = None  # of the video beside it, if its own times are too coarse for frames


@dataclass(frozen=True)
class Driver:
    """The topics of a drone's driver in a log, as a manifest's preset reads them."""

    preset: str
    namespace: str | None  # None if it is the only one
    span: Span
    count: int
    body: bool
    gimbal: bool
    by_gps: bool


@dataclass(frozen=True)
class Edge:
    """A logged transform: the frame `child` in `parent`."""

    topic: str
    parent: str
    child: str
    still: bool


@dataclass(frozen=True)
class Recording(Found):
    """A log; it has several paths if it was split."""

    parts: tuple[Path, ...]
    topics: tuple[TopicFound, ...]
    edges: tuple[Edge, ...] = ()
    drivers: tuple[Driver, ...] = ()


@dataclass(frozen=True)
class Findings:
    """Everything that was found, each kind in the order of its paths."""

    keypoints: list[Keypoints] = field(default_factory=list)
    poses: list[Poses] = field(default_factory=list)
    calibrations: list[Calibration] = field(default_factory=list)
    joints: list[Joints] = field(default_factory=list)
    frame_times: list[FrameTimes] = field(default_factory=list)
    videos: list[Video] = field(default_factory=list)
    maps: list[Map] = field(default_factory=list)
    recordings: list[Recording] = field(default_factory=list)
    drone_logs: list[DroneLog] = field(default_factory=list)

    def all(self) -> list[Found]:
        """List all of them, kind by kind."""
        return [
            *self.videos,
            *self.keypoints,
            *self.recordings,
            *self.drone_logs,
            *self.poses,
            *self.calibrations,
            *self.frame_times,
            *self.joints,
            *self.maps,
        ]
