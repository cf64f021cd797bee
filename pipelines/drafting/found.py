"""What was found, as far as drafting a manifest needs it: names, kinds, times, topics - no arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pipelines.session.telemetry import Height

Place = tuple[str, ...]
"""Folders below the common one, then the name without its suffix: what a thing is called."""

TopicKind = Literal["poses", "transforms", "angles", "intrinsics", "pictures"]


@dataclass(frozen=True)
class Span:
    """First and last stamp, ns."""

    first_ns: int
    last_ns: int

    def overlap_ns(self, other: Span) -> int:
        """How long both last; negative is the gap between them."""
        return min(self.last_ns, other.last_ns) - max(self.first_ns, other.first_ns)


@dataclass(frozen=True)
class Found:
    """A file, or a folder that is one thing."""

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
    ambiguous: bool = False  # other formats recognise it as well: its own must be stated


@dataclass(frozen=True)
class Poses(Found):
    """A trajectory."""

    span: Span


@dataclass(frozen=True)
class Lens:
    """What a calibration holds of one camera."""

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
    """When frames were taken."""

    key: Literal["csv", "srt"]  # what it is called in a manifest
    rows: int
    span: Span


@dataclass(frozen=True)
class Video(Found):
    """A video; its stamps count from wherever its container lets them begin."""

    frames: int
    length_ns: int


@dataclass(frozen=True)
class Map(Found):
    """What stands around."""


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
    """A log that a drone wrote itself: where it was, and perhaps how it and its gimbal were turned."""

    key: Literal["dji", "ulog", "ardupilot"]  # what it is called in a manifest
    span: Span
    positions: int
    step_ns: int  # between positions, usually
    by_gps: bool
    body: bool
    gimbal: bool
    height: Height = "unknown"  # what its heights count from; "stated" where it has none
    video_start_ns: int | None = None  # of the video beside it, where its own times are too coarse for frames


@dataclass(frozen=True)
class Driver:
    """The topics of a drone's driver in a log, as a manifest's preset reads them."""

    preset: str
    namespace: str | None  # None where it is the only one
    span: Span
    count: int
    body: bool
    gimbal: bool
    by_gps: bool


@dataclass(frozen=True)
class Edge:
    """A transform that a log states: the frame `child` in `parent`."""

    topic: str
    parent: str
    child: str
    still: bool


@dataclass(frozen=True)
class Recording(Found):
    """A log; several paths where it was split."""

    parts: tuple[Path, ...]
    topics: tuple[TopicFound, ...]
    edges: tuple[Edge, ...] = ()
    drivers: tuple[Driver, ...] = ()


@dataclass(frozen=True)
class Findings:
    """Everything, each kind in the order of its paths."""

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
        """Every one of them, kind by kind."""
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
