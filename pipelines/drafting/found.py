"""Search of files and folders for everything that a format recognises, and records of what was found.

A record has what a draft needs: names, kinds, times, topics; no arrays. Files of one log are joined, and the
frames of its transforms are searched for cameras.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar

from pipelines.drafting.labels import OPTICAL, Label, Place, is_called, label_of, label_of_place
from pipelines.session.errors import DataError
from pipelines.session.manifest import AngleLog, OwnLog, read_flight
from pipelines.session.registries import (
    FORMATS,
    CalibrationFormat,
    Format,
    JointFormat,
    KeypointFormat,
    LogFormat,
    MapFormat,
    TrajectoryFormat,
    VideoFormat,
)
from pipelines.session.telemetry import Height, TelemetryFormat
from pipelines.session.unknown_files import describe_unknown

F = TypeVar("F", bound="Found")

TopicKind = Literal["poses", "transforms", "angles", "intrinsics", "pictures", "maps", "fixes"]


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
    made_ns: int | None = None  # its start or its end, in UTC, by its metadata
    clock: Literal["own", "whole seconds", "none"] = "own"  # of its pictures, where they are in a folder


@dataclass(frozen=True)
class Map(Found):
    """A map of the surroundings."""

    resolution_m: float | None = None  # at which it fits, if its own would be too fine
    projected: bool = False  # its coordinates are those of a map projection that it does not name


@dataclass(frozen=True)
class TopicFound:
    """A topic that a manifest can name; `target` and `source` are the frames of its first pose.

    The `target` of maps is the frame in which they lie.
    """

    name: str
    type: str
    kind: TopicKind
    count: int
    span: Span
    target: str = ""
    source: str = ""
    lead_ns: int | None = None  # by which header stamps are ahead of those of receipt; None without


class VideoStart(NamedTuple):
    """Start of a video, as a drone's own log has it."""

    start_ns: int
    source: str  # for the user
    sigma_s: float = 0.0  # 0: as exactly as its poses


@dataclass(frozen=True)
class DroneLog(Found):
    """A drone's own log: positions, and perhaps attitudes of body and gimbal."""

    key: OwnLog  # its key in a manifest
    span: Span
    positions: int
    step_ns: int  # median step between positions
    by_gps: bool
    body: bool
    gimbal: bool
    height: Height = "unknown"  # zero level of its heights; "stated" if it has no heights
    instance: int | None = None  # the vehicle, of a log that holds several
    video_start: VideoStart | None = None  # of the video beside it, or of the one that holds it
    films: tuple[Span, ...] = ()  # when it says that the camera recorded videos

    def film_of(self, video: Video) -> Span | None:
        """Return the only recording of about a video's length; None if there is none, or several."""
        alike = [f for f in self.films if abs(f.last_ns - f.first_ns - video.length_ns) < _LENGTHS_DIFFER_NS]
        return alike[0] if len(alike) == 1 else None


@dataclass(frozen=True)
class Angles(Found):
    """Attitudes of a camera in a log, for the positions of another one."""

    key: AngleLog  # its key in a gimbal
    count: int
    knows_north: bool


@dataclass(frozen=True)
class Driver:
    """Topics of a drone in a log that make poses together: those of a preset, or two that are named."""

    settings: dict[
        str, str | None
    ]  # preset and namespace (None if it is the only one), or topic and attitude
    span: Span
    count: int
    body: bool
    gimbal: bool
    by_gps: bool
    lead_ns: int | None = None  # as for topics


@dataclass(frozen=True)
class Edge:
    """A logged transform: the frame `child` in `parent`."""

    topic: str
    parent: str
    child: str
    still: bool
    first_ns: int = field(default=0, compare=False)  # time of the first one
    lead_ns: int | None = field(default=None, compare=False)  # as for topics


@dataclass(frozen=True)
class Recording(Found):
    """A log; it has several paths if it was split."""

    parts: tuple[Path, ...]
    topics: tuple[TopicFound, ...]
    edges: tuple[Edge, ...] = ()
    drivers: tuple[Driver, ...] = ()
    stamps: Literal["header", "receive"] = "header"
    ahead_ns: int = 0  # of its header stamps, if that is more than the log is long

    @property
    def span(self) -> Span:
        """The time from its first message to its last."""
        parts: tuple[TopicFound | Driver, ...] = (*self.topics, *self.drivers)
        spans = [part.span for part in parts if part.count]
        return Span(min(s.first_ns for s in spans), max(s.last_ns for s in spans))


_KINDS = (Video, Keypoints, Recording, DroneLog, Angles, Poses, Calibration, FrameTimes, Joints, Map)


@dataclass(frozen=True)
class Findings:
    """Everything that was found, each kind in the order of its paths."""

    found: Sequence[Found]

    def of(self, kind: type[F]) -> list[F]:
        """List those of a kind."""
        return [found for found in self.found if isinstance(found, kind)]

    def all(self) -> list[Found]:
        """List all of them, kind by kind."""
        return [found for kind in _KINDS for found in self.of(kind)]


_PART = re.compile(r"(.*)_(\d{1,9})", re.DOTALL)
_BODIES = frozenset({"base", "body", "imu", "fcu"})
_LENGTHS_DIFFER_NS = 2_000_000_000  # of a video and of its recording by a flight record
_LEAST_APART_NS = 10_000_000_000  # of header stamps and receipt; less is transport and start-up
_FILES_ASKED = 16  # of a folder of keypoints, for their format


Thing = tuple[Path, list[Format]]
"""A file or folder, and the formats that recognise it."""


class Search:
    """A search through files and folders; `left_out` has the paths that cannot be used, with the reason."""

    def __init__(self) -> None:
        self.left_out: dict[Path, str] = {}
        self._formats = FORMATS.all()
        self._seen: set[Path] = set()

    def look(self, paths: Sequence[Path]) -> tuple[list[Thing], Path]:
        """Find everything that is recognised, each thing once, and the folder that all paths share.

        Raises:
            DataError: a path does not exist.
        """
        things: list[Thing] = []
        bases: list[Path] = []
        for path in paths:
            if not path.exists():
                raise DataError(path, "does not exist", "check the path", code="no-such-file")
            found = list(self._under(path))
            alone = not path.is_dir() or [thing for thing, _ in found] == [path]
            bases.append(path.parent if alone else path)
            things += found
        return sorted(things, key=lambda thing: thing[0]), Path(os.path.commonpath(bases))

    def _under(self, path: Path) -> Iterator[Thing]:
        """Yield the things at a path and below it."""
        if path.resolve() in self._seen:  # named twice, or a link that leads back
            return
        self._seen.add(path.resolve())
        if not _is_text(path):
            self.left_out[path] = "its name is no text that a manifest could state, left out"
        elif path.is_dir():
            yield from self._under_folder(path)
        elif formats := self._recognising(path):
            yield path, formats
        else:
            self.left_out[path] = _why_left_out(path)

    def _under_folder(self, folder: Path) -> Iterator[Thing]:
        """Yield the folder itself if it is one thing, and things in it that are not part of that."""
        children = self._children(folder)
        formats = [f for f in self._recognising(folder) if self._is_whole(folder, children, f)]
        if not formats:
            for child in children:
                yield from self._under(child)
            return
        yield folder, formats
        kinds = {kind_of_format(format_) for format_ in formats}
        for child in children:
            if child.is_dir():
                yield from self._under(child)
            elif KeypointFormat not in kinds or child.suffix.lower() != ".json":
                others = [f for f in self._recognising(child) if kind_of_format(f) not in kinds]
                if others:
                    yield child, others

    def _is_whole(self, folder: Path, children: Sequence[Path], format_: Format) -> bool:
        """Test if a folder that a format recognises is one thing, not a folder with several such things.

        A folder is also recognised if it holds keypoint files, one for each camera, or a single log, or the
        files of a bag beside the videos of its flight.
        """
        if isinstance(format_, LogFormat):
            inside = [kind_of_format(f) for child in children for f in self._recognising(child)]
            alone = len(inside) == 1 and not (folder / "metadata.yaml").exists()
            return not alone and all(kind is LogFormat for kind in inside)
        if not isinstance(format_, KeypointFormat):
            return True
        files = [child for child in children if child.suffix.lower() == ".json"]
        asked = files[:: max(1, len(files) // _FILES_ASKED)]
        if len(files) < 2 or any(f is not format_ for file in asked for f in self._recognising(file)):
            return False
        try:
            format_.read_keypoints(folder, skeleton=None, first_frame=0)
        except DataError:  # two files of one frame: they are of several cameras
            return False
        return True

    def _children(self, folder: Path) -> list[Path]:
        try:
            children = sorted(folder.iterdir())
        except OSError as error:
            self.left_out[folder] = f"cannot be read ({error.strerror}), left out"
            return []
        return [c for c in children if not c.name.startswith(".") and c.suffix != ".session" and c.exists()]

    def _recognising(self, path: Path) -> list[Format]:
        return [format_ for format_ in self._formats if format_.recognises(path)]


def kind_of_format(format_: Format) -> type | None:
    """Return the protocol of a format; None if it has none of these."""
    kinds = (
        KeypointFormat,
        TrajectoryFormat,
        CalibrationFormat,
        JointFormat,
        LogFormat,
        VideoFormat,
        MapFormat,
        TelemetryFormat,
    )
    return next((kind for kind in kinds if isinstance(format_, kind)), None)


def _is_text(path: Path) -> bool:
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


def _why_left_out(path: Path) -> str:
    """Explain why a file is left out that no format recognises."""
    if path.suffix.lower() in {".yaml", ".yml"}:
        try:
            read_flight(path)
        except DataError:
            pass
        else:
            return "is a flight manifest already (run `mocap ingest` on it), left out"
    likeness = describe_unknown(path)
    return with_remedy(f"{likeness.problem}, left out", likeness.remedy)


def with_remedy(problem: str, remedy: str) -> str:
    """Return a problem with what the user can do about it, if that is known."""
    return f"{problem}; {remedy}" if remedy else problem


def joined(recordings: Sequence[Recording]) -> list[Recording]:
    """Join files named NAME_0, NAME_1, ... to one recording, if each begins after the previous one ends.

    Two drones that log at the same time stay two recordings.
    """
    result: list[Recording] = []
    for recording in sorted(recordings, key=_part):
        before = result[-1] if result else None
        if before and _continues(before, recording):
            result[-1] = _extended(before, recording)
        else:
            result.append(recording)
    return sorted(result, key=lambda recording: recording.place)


def _ahead_ns(recording: Recording) -> int:
    """Return the largest difference of a log's header stamps from receipt."""
    every: list[TopicFound | Driver] = [*recording.topics, *recording.drivers]
    return max((part.lead_ns for part in every if part.lead_ns is not None), key=abs, default=0)


def with_stamps(recordings: Sequence[Recording]) -> list[Recording]:
    """Choose one kind of stamps for all logs; with it, the spans are those of these stamps.

    Header stamps are taken, unless they differ from those of receipt by more than a log is long (simulation
    time, time since boot) and are not alike in all topics of all logs: then only the receipt is one clock.
    """
    leads: list[int | None] = []
    apart = False
    longest_ns = _LEAST_APART_NS
    for recording in recordings:
        still = {"intrinsics", "maps"}  # published once, perhaps long before
        moving = [t for t in recording.topics if t.kind not in still and not t.name.endswith("static")]
        every: list[TopicFound | Driver] = [*moving, *recording.drivers]
        parts = [part for part in every if part.count]
        if not parts:
            continue
        length_ns = recording.span.last_ns - recording.span.first_ns
        longest_ns = max(longest_ns, length_ns)
        leads += [part.lead_ns for part in parts]
        apart |= any(abs(part.lead_ns or 0) > max(length_ns, _LEAST_APART_NS) for part in parts)
    if not apart:
        return list(recordings)
    known = [lead for lead in leads if lead is not None]
    alike = len(known) == len(leads) and max(known) - min(known) <= longest_ns
    ahead_ns = int(max(known, key=abs))
    if not alike:
        return [
            replace(recording, stamps="receive", ahead_ns=_ahead_ns(recording)) for recording in recordings
        ]
    return [
        replace(
            recording,
            ahead_ns=ahead_ns,
            topics=tuple(replace(t, span=_later(t.span, t.lead_ns, ahead_ns)) for t in recording.topics),
            drivers=tuple(replace(d, span=_later(d.span, d.lead_ns, ahead_ns)) for d in recording.drivers),
            edges=tuple(
                replace(e, first_ns=e.first_ns + (ahead_ns if e.lead_ns is None else e.lead_ns))
                for e in recording.edges
            ),
        )
        for recording in recordings
    ]


def _later(span: Span, lead_ns: int | None, otherwise_ns: int) -> Span:
    later_ns = otherwise_ns if lead_ns is None else lead_ns
    return Span(span.first_ns + later_ns, span.last_ns + later_ns)


def _part(recording: Recording) -> tuple[Place, str, int]:
    match = _PART.fullmatch(recording.place[-1])
    name, number = (match[1], int(match[2])) if match else (recording.place[-1], -1)
    return (*recording.place[:-1], name), recording.path.suffix, number


def _continues(before: Recording, recording: Recording) -> bool:
    name, suffix, number = _part(recording)
    first = _part(before)
    if (name, suffix) != first[:2] or first[2] != 0 or number != len(before.parts):
        return False
    ours, theirs = (
        {topic.name: topic.span for topic in log.topics if topic.count} for log in (before, recording)
    )
    shared = ours.keys() & theirs.keys()
    return bool(shared) and all(ours[topic].last_ns <= theirs[topic].first_ns for topic in shared)


def _extended(before: Recording, recording: Recording) -> Recording:
    topics = {topic.name: topic for topic in before.topics}
    for topic in recording.topics:
        known = topics.get(topic.name)
        if known is None or not known.count:
            topics[topic.name] = topic
        elif topic.count:
            span = replace(known.span, last_ns=max(known.span.last_ns, topic.span.last_ns))
            topics[topic.name] = replace(known, count=known.count + topic.count, span=span)
    return replace(
        before,
        parts=(*before.parts, *recording.parts),
        topics=tuple(topics[name] for name in sorted(topics)),
        edges=tuple(dict.fromkeys((*before.edges, *recording.edges))),
    )


def label_of_recording(recording: Recording) -> Label:
    """Return the label of a log, without the _0 of its first part."""
    *folders, name = recording.place
    match = _PART.fullmatch(name)
    return label_of_place((*folders, match[1] if match and label_of(match[1]) else name))


def label_of_topic(recording: Recording, name: str) -> Label:
    """Return the label of a topic or frame: that of its own name, or else that of its log."""
    return label_of(name) or label_of_recording(recording)


def chains(recording: Recording) -> list[tuple[str, str, int]]:
    """List (parent, child) of every moving camera or body frame of a log's transforms; cameras first.

    The third is the time (ns) from which all transforms between them are known.

    The parent is the root of the child's tree. Frames that are fixed to the root are left out.
    """
    above: dict[str, Edge] = {}
    for edge in recording.edges:
        above.setdefault(edge.child, edge)
    found = []
    for child in sorted(above):
        way = _way_up(child, above)
        if way and not all(edge.still for edge in way):
            first_ns = max(edge.first_ns for edge in way if not edge.still)
            found.append((way[-1].parent, child, first_ns))
    cameras = [pair for pair in found if is_called(pair[1], OPTICAL)]
    # A picture's frame is the optical one; its mounting frame has the axes of a body.
    optical = [pair for pair in cameras if is_called(pair[1], frozenset({"optical"}))]
    bodies = [pair for pair in found if pair not in cameras and is_called(pair[1], _BODIES)]
    return [*(optical or cameras), *bodies]


def _way_up(child: str, above: dict[str, Edge]) -> list[Edge]:
    way: list[Edge] = []
    while child in above and len(way) <= len(above):
        way.append(above[child])
        child = above[child].parent
    return way if len(way) <= len(above) else []
