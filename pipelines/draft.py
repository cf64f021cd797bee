"""Stage `draft`: files and folders in, a flight.yaml out that can be ingested, or says what is missing."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Literal

from pipelines.drafting.found import (
    Calibration,
    Driver,
    DroneLog,
    Edge,
    Findings,
    Found,
    FrameTimes,
    Joints,
    Keypoints,
    Lens,
    Map,
    Poses,
    Recording,
    Span,
    TopicFound,
    Video,
)
from pipelines.drafting.manifest_text import write_manifest
from pipelines.drafting.matching import match
from pipelines.formats.common.summaries import median_step_ns
from pipelines.formats.drone_logs.dji_srt import read_subtitles
from pipelines.formats.logs.messages import kind_of, samples
from pipelines.formats.logs.presets import namespaces, parts_of
from pipelines.formats.videos.frame_times import read_frame_times
from pipelines.session.errors import DataError
from pipelines.session.manifest import read_flight
from pipelines.session.progress import Progress, Silent
from pipelines.session.records import Int64, PoseSample
from pipelines.session.registries import (
    FORMATS,
    CalibrationFormat,
    Format,
    JointFormat,
    KeypointFormat,
    Log,
    LogFormat,
    MapFormat,
    TrajectoryFormat,
    VideoFormat,
    why_not,
)
from pipelines.session.storage import as_data_error
from pipelines.session.telemetry import TelemetryChoice, TelemetryFormat

_FRAME_TIMES = "frame_times"  # the one format that no protocol tells apart
_TRANSFORMS_ASKED = 2000  # messages of a topic, for the names of its frames
_FILES_ASKED = 16  # of a folder of keypoints, for their format


@dataclass(frozen=True)
class LeftOut:
    """What was looked at in vain."""

    path: Path
    reason: str


@dataclass(frozen=True)
class Drafted:
    """A manifest that was written, and what is to be said of it."""

    path: Path
    text: str
    cameras: list[str]
    missing: list[str]  # without it the flight cannot be ingested
    assumed: list[str]  # it can, but the result depends on it
    left_out: list[LeftOut]


def draft(
    paths: Sequence[Path],
    output: Path | None = None,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Drafted:
    """Look into files and folders and write the manifest of their flight.

    Folders are looked through; hidden files and sessions are left out. What the files cannot say stands in
    comments of the manifest, beside the line that it is about.

    Args:
        paths: what the team brought home.
        output: the manifest; by default flight.yaml in the folder that all paths have in common.
        overwrite: replace a file that is there.
        progress: who watches.

    Raises:
        DataError: nothing was recognised, a path is missing, or the output is there or cannot be written.
    """
    search = _Search(progress or Silent())
    things, home = search.look([_absolute(path) for path in paths])
    target = output or home / "flight.yaml"
    if target.exists() and not overwrite:
        raise DataError(target, "exists", "choose another with --output, or replace it with --overwrite")
    findings = search.read(things, home)
    left_out = [left for left in search.left_out if left.path != _absolute(target)]
    if not findings.all():
        raise DataError(*_nothing(home, left_out))

    flight = match(findings)
    manifest = write_manifest(flight, home.name or "flight", lambda path: _stated(path, target.parent))
    problem = _write(target, manifest.text)
    return Drafted(
        path=target,
        text=manifest.text,
        cameras=[camera.name for camera in flight.cameras],
        missing=manifest.missing or ([problem] if problem else []),
        assumed=manifest.assumed,
        left_out=left_out,
    )


def _nothing(home: Path, left_out: Sequence[LeftOut]) -> tuple[Path, str, str]:
    """What to say where nothing can be used."""
    known = f"known formats: {', '.join(FORMATS.names())}"
    if len(left_out) == 1:
        return left_out[0].path, left_out[0].reason, known
    return home, f"holds nothing that can be used ({len(left_out)} files)", known


def _absolute(path: Path) -> Path:
    """The path without `..`; links are not followed, for a manifest states what the user sees."""
    return Path(os.path.abspath(path))  # noqa: PTH100 - resolve() follows links


def _stated(path: Path, folder: Path) -> str:
    """A path as a manifest in a folder states it, with slashes: relative if it lies there, else in full."""
    return (
        path.relative_to(_absolute(folder)) if path.is_relative_to(_absolute(folder)) else path
    ).as_posix()


def _write(target: Path, text: str) -> str:
    """Write the manifest, whole or not at all; what keeps it from being valid, if anything does."""
    temporary = target.with_name(f"{target.name}.new")
    try:
        temporary.write_text(text, encoding="utf-8", newline="\n")
        try:
            read_flight(temporary)
        except DataError as error:
            problem = error.problem
        else:
            problem = ""
        temporary.replace(target)
    except OSError as error:
        raise as_data_error(error, target) from error
    return problem


# --- looking -------------------------------------------------------------------------------------------

Thing = tuple[Path, list[Format]]
"""A file or folder, and the formats that recognise it."""


class _Search:
    """Goes through files and folders, and notes what it had to leave out."""

    def __init__(self, progress: Progress) -> None:
        self.left_out: list[LeftOut] = []
        self._formats = FORMATS.all()
        self._progress = progress
        self._seen: set[Path] = set()

    def look(self, paths: Sequence[Path]) -> tuple[list[Thing], Path]:
        """Everything that is recognised, each thing once, and the folder that all paths have in common.

        Raises:
            DataError: a path does not exist.
        """
        things: list[Thing] = []
        bases: list[Path] = []
        for path in paths:
            if not path.exists():
                raise DataError(path, "does not exist", "check the path")
            found = list(self._under(path))
            alone = not path.is_dir() or [thing for thing, _ in found] == [path]
            bases.append(path.parent if alone else path)
            things += found
        return sorted(things, key=lambda thing: thing[0]), Path(os.path.commonpath(bases))

    def read(self, things: Sequence[Thing], home: Path) -> Findings:
        """What is in them, as far as it helps to tell what belongs together."""
        self._progress.start("Reading", len(things))
        found: list[Found] = []
        for path, formats in things:
            found += self._read(path, formats, home)
            self._progress.advance()
        return Findings(
            keypoints=[thing for thing in found if isinstance(thing, Keypoints)],
            poses=[thing for thing in found if isinstance(thing, Poses)],
            calibrations=[thing for thing in found if isinstance(thing, Calibration)],
            joints=[thing for thing in found if isinstance(thing, Joints)],
            frame_times=[thing for thing in found if isinstance(thing, FrameTimes)],
            videos=[thing for thing in found if isinstance(thing, Video)],
            maps=[thing for thing in found if isinstance(thing, Map)],
            recordings=[thing for thing in found if isinstance(thing, Recording)],
            drone_logs=[thing for thing in found if isinstance(thing, DroneLog)],
        )

    def _under(self, path: Path) -> Iterator[Thing]:
        """The things at a path and below it."""
        if path.resolve() in self._seen:  # named twice, or a link that leads back
            return
        self._seen.add(path.resolve())
        if not _is_text(path):
            self.left_out.append(LeftOut(path, "its name is no text that a manifest could state, left out"))
        elif path.is_dir():
            yield from self._under_folder(path)
        elif formats := self._recognising(path):
            yield path, formats
        else:
            self.left_out.append(LeftOut(path, _why_left_out(path)))

    def _under_folder(self, folder: Path) -> Iterator[Thing]:
        """The folder itself where it is one thing, and what lies in it but is no part of that."""
        children = self._children(folder)
        formats = [f for f in self._recognising(folder) if self._is_whole(folder, children, f)]
        if not formats:
            for child in children:
                yield from self._under(child)
            return
        yield folder, formats
        kinds = {_kind(format_) for format_ in formats}
        for child in children:
            if child.is_dir():
                yield from self._under(child)
            elif KeypointFormat not in kinds or child.suffix.lower() != ".json":
                others = [f for f in self._recognising(child) if _kind(f) not in kinds]
                if others:
                    yield child, others

    def _is_whole(self, folder: Path, children: Sequence[Path], format_: Format) -> bool:
        """Whether a folder that a format recognises is one thing, and not a place where such things lie.

        Files of keypoints, one for each camera, are recognised as a folder too, and so are a log that lies
        alone in a folder and the files of a bag beside the videos of its flight.
        """
        if isinstance(format_, LogFormat):
            inside = [_kind(f) for child in children for f in self._recognising(child)]
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
            self.left_out.append(LeftOut(folder, f"cannot be read ({error.strerror}), left out"))
            return []
        return [c for c in children if not c.name.startswith(".") and c.suffix != ".session" and c.exists()]

    def _recognising(self, path: Path) -> list[Format]:
        return [format_ for format_ in self._formats if format_.recognises(path)]

    # --- reading -----------------------------------------------------------------------------------------

    def _read(self, path: Path, formats: Sequence[Format], home: Path) -> list[Found]:
        """A thing as every kind that it is; of several formats of a kind as the first that can read it."""
        found: dict[type[Found], Found] = {}
        problems: list[str] = []
        *folders, name = path.relative_to(home).parts or (path.name,)
        place = (*folders, name if path.is_dir() else Path(name).stem)
        for format_ in formats:
            ambiguous = sum(_kind(other) is _kind(format_) for other in formats) > 1
            head = Found(path, place, format_.name, format_.title)
            try:
                thing = _described(head, format_, ambiguous)
            except DataError as error:
                problems.append(f"{error.problem}, left out")
                continue
            if thing is not None:
                found.setdefault(type(thing), thing)
        if not found:
            self.left_out.append(LeftOut(path, problems[0] if problems else "of no use here, left out"))
        return list(found.values())


def _is_text(path: Path) -> bool:
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


def _kind(format_: Format) -> type | None:
    """The protocol that a format keeps to."""
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


def _described(head: Found, format_: Format, ambiguous: bool) -> Found | None:
    """What is in a thing, by the kind of its format; None for kinds that no manifest states.

    Raises:
        DataError: it cannot be read.
    """
    path = head.path
    about = (path, head.place, head.format, head.title)
    if isinstance(format_, KeypointFormat):
        listed = format_.read_keypoints(path, skeleton=None, first_frame=0).frames_listed
        return Keypoints(*about, len(listed), int(listed[0]), int(listed[-1]), ambiguous)
    if isinstance(format_, TrajectoryFormat):
        return Poses(*about, _span(format_.read_trajectory(path).t_ns))
    if isinstance(format_, TelemetryFormat):
        return _drone_log(head, format_)
    if isinstance(format_, CalibrationFormat):
        cameras = format_.read_calibration(path)
        held = {name: Lens(c.intrinsics is not None, c.position is not None) for name, c in cameras.items()}
        return Calibration(*about, held)
    if isinstance(format_, JointFormat):
        return Joints(*about, _span(format_.read_joints(path, unit=None, axes=None).t_ns))
    if isinstance(format_, LogFormat):
        return _recording(head, format_)
    if isinstance(format_, VideoFormat):
        index = format_.index(path)
        return Video(*about, index.count, int(index.pts_ns[-1]))
    if isinstance(format_, MapFormat):
        return Map(*about)
    if head.format == _FRAME_TIMES:
        stamps = read_frame_times(path)
        key: Literal["csv", "srt"] = "srt" if path.suffix.lower() == ".srt" else "csv"
        return FrameTimes(*about, key, len(stamps.t_ns), _span(stamps.t_ns))
    return None


def _span(t_ns: Int64) -> Span:
    return Span(int(t_ns[0]), int(t_ns[-1]))


# --- drones' own logs ------------------------------------------------------------------------------------


def _drone_log(head: Found, format_: TelemetryFormat) -> DroneLog | None:
    """What a drone's own log says of its poses, whether or not it says where the drone looked.

    Raises:
        DataError: it cannot be read, or holds no position.
    """
    has_height = True
    try:
        telemetry = format_.read_telemetry(head.path, TelemetryChoice())
    except DataError as error:
        if "height" not in error.problem:
            raise
        has_height = False
        telemetry = format_.read_telemetry(head.path, TelemetryChoice(altitude=0.0))
    track = telemetry.position
    keys: tuple[Literal["dji"], Literal["ulog"], Literal["ardupilot"]] = ("dji", "ulog", "ardupilot")
    key = next((key for key in keys if key == head.format), None)
    if key is None:
        return None
    start_ns = None
    if head.path.suffix.lower() == ".srt":
        subtitles = read_subtitles(head.path)
        start_ns = subtitles.start_ns() if subtitles.are_slow else None
    return DroneLog(
        head.path,
        head.place,
        head.format,
        head.title,
        key=key,
        span=_span(track.t_ns),
        positions=len(track.t_ns),
        step_ns=int(median_step_ns(track.t_ns) or 0),
        by_gps=track.on_earth or track.origin is not None,
        body=telemetry.body is not None,
        gimbal=telemetry.gimbal is not None,
        has_height=has_height,
        video_start_ns=start_ns,
    )


# --- logs ----------------------------------------------------------------------------------------------


def _recording(head: Found, format_: LogFormat) -> Recording:
    """The topics of a log, with the frames that its poses and transforms speak of."""
    with format_.open_log([head.path]) as log:
        topics: dict[str, TopicFound] = {}
        for topic in log.topics:
            kind = kind_of(topic)
            if kind and topic.name not in topics:
                span = Span(topic.first_ns or 0, topic.last_ns or 0)
                topics[topic.name] = TopicFound(topic.name, topic.type, kind, topic.count, span)
        drivers = tuple(_drivers(log))
        edges: dict[Edge, None] = {}
        for name, known in topics.items():
            if known.kind == "poses":
                first = next(_pose_samples(log, name, 1, head.path), None)
                if first:
                    topics[name] = replace(known, target=first.target, source=first.source)
            elif known.kind == "transforms":
                still = name.rstrip("/").endswith("tf_static")
                for sample in _pose_samples(log, name, _TRANSFORMS_ASKED, head.path):
                    edges[Edge(name, sample.target, sample.source, still)] = None
    about = (head.path, head.place, head.format, head.title)
    return Recording(*about, (head.path,), tuple(topics.values()), tuple(edges), drivers)


def _drivers(log: Log) -> Iterator[Driver]:
    """The drones whose drivers' usual topics are in a log."""
    topics = {topic.name: topic for topic in log.topics if topic.count}
    every = namespaces(list(topics))
    for preset, namespace in every:
        parts = parts_of(preset, namespace, list(topics))
        spans = [topics[name] for name in parts.position]
        yield Driver(
            preset=preset,
            namespace=None
            if len([known for known, _ in every if known == preset]) == 1
            else namespace or "/",
            span=Span(min(t.first_ns or 0 for t in spans), max(t.last_ns or 0 for t in spans)),
            count=max(topic.count for topic in spans),
            body=bool(parts.attitude),
            gimbal=bool(parts.gimbal),
            by_gps=any("NavSatFix" in topics[name].type for name in parts.position),
        )


def _pose_samples(log: Log, topic: str, messages: int, source: Path) -> Iterator[PoseSample]:
    """What the first messages of a topic say; those that cannot be read say nothing here."""
    for message in islice(log.messages([topic]), messages):
        try:
            yield from (sample for sample in samples(message, source) if isinstance(sample, PoseSample))
        except DataError:
            continue


def _why_left_out(path: Path) -> str:
    """What to say of a file that no format knows."""
    if path.suffix.lower() in {".yaml", ".yml"}:
        try:
            read_flight(path)
        except DataError:
            pass
        else:
            return "is a flight manifest already (run `mocap ingest` on it), left out"
    return f"not recognised{why_not(path)}, left out"
