"""Stage `draft`: write a flight.yaml for files and folders; it can be ingested or says what is missing."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.drafting.found import (
    Angles,
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
    Search,
    Span,
    Thing,
    TopicFound,
    TopicKind,
    Video,
    VideoStart,
    kind_of_format,
    with_remedy,
)
from pipelines.drafting.manifest_text import write_manifest
from pipelines.drafting.matching import NO_DATE_NS, Alike, match
from pipelines.formats.common.rows import median_step_ns
from pipelines.formats.drone_logs.dji_records import recordings_of
from pipelines.formats.drone_logs.dji_subtitles import read_subtitles
from pipelines.formats.drone_logs.tlog import FORMAT as TLOG
from pipelines.formats.logs.maps import MAP_TYPES, frame_of
from pipelines.formats.logs.messages import header_ns, kind_of, samples
from pipelines.formats.logs.presets import FIXES, namespaces, pairs_of, parts_of
from pipelines.formats.poses.trajectory_files import times_of
from pipelines.formats.videos.frame_times import read_frame_times
from pipelines.formats.videos.picture_folder import SHARED_SECONDS, UNTIMED
from pipelines.formats.videos.video import created_ns, followed_points, index_video
from pipelines.geometry.arrays import Int64
from pipelines.geometry.cameras import Intrinsics
from pipelines.geometry.clocks import Followed, explain_motion
from pipelines.geometry.geodesy import Place, enu_from_geodetic
from pipelines.geometry.mounting import body_from_camera
from pipelines.geometry.poses import interpolate_points, multiply
from pipelines.session.errors import DataError
from pipelines.session.manifest import AngleLog, OwnLog, read_flight
from pipelines.session.maps import MapSizeError
from pipelines.session.progress import Progress, Silent
from pipelines.session.records import PoseSample
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
)
from pipelines.session.storage import as_data_error
from pipelines.session.telemetry import AttitudeFormat, Telemetry, TelemetryChoice, TelemetryFormat
from pipelines.session.unknown_files import EXPECTED

_FRAME_TIMES = "frame_times"  # the only format without a protocol of its own
_KEYS: dict[str, OwnLog] = {
    "dji": "dji",
    "dji_record": "dji",
    "picture_tags": "dji",
    "ulog": "ulog",
    "ardupilot": "ardupilot",
    "tlog": "tlog",
    "gopro": "gopro",
}
"""The key in a manifest for each format of a drone's own log."""

_ANGLE_KEYS: dict[OwnLog, AngleLog] = {"dji": "dji", "gopro": "gopro"}
"""The key in a gimbal for each key of a log whose angles are of use without its positions."""

_OTHER_KINDS: dict[str, TopicKind] = {
    **dict.fromkeys(MAP_TYPES, "maps"),
    **dict.fromkeys(FIXES, "fixes"),
}
"""Kinds of topics whose messages are no samples, by type."""

_LOCAL_M = 100_000.0  # coordinates beyond it are those of a map projection
_WATCHED_NS = 60_000_000_000  # of a video, to compare its motion with logs
_NOMINAL_FOCAL = 0.8  # of a picture's width: an angle of view of 64 degrees
_DOWN_DEG = (0.0, 30.0, 60.0, 90.0)  # of a camera whose mount nobody stated
_BRIDGED_NS = 2_000_000_000  # between two positions of a log
_MADE_WITHIN_NS = 5_000_000_000  # of the time when a video was made by its metadata, beside its length
_TRANSFORMS_ASKED = 2000  # messages of a topic that are read for the names of its frames


@dataclass(frozen=True)
class Drafted:
    """A manifest that was written, with remarks on it."""

    path: Path
    text: str
    cameras: list[str]
    missing: list[str]  # the flight cannot be ingested without it
    assumed: list[str]  # the flight can be ingested, but results depend on it
    left_out: dict[Path, str]  # paths that were not used, with the reason


def draft(
    paths: Sequence[Path],
    output: Path | None = None,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Drafted:
    """Examine files and folders and write the manifest of their flight.

    Folders are searched, without hidden files and sessions. Things that the files do not determine are in
    comments of the manifest, beside the line that they concern.

    Args:
        output: the manifest; by default flight.yaml in the folder that all paths share.
        overwrite: replace an existing file.

    Raises:
        DataError: nothing was recognised, a path is missing, or the output exists or cannot be written.
    """
    search = Search()
    things, home = search.look([_absolute(path) for path in paths])
    target = output or home / "flight.yaml"
    if target.exists() and not overwrite:
        raise DataError(target, "exists", "choose another with --output, or replace it with --overwrite")
    findings, unread = _read_all(things, home, progress or Silent())
    left_out = search.left_out | unread
    for path in (_absolute(target), *_read_beside(findings)):
        left_out.pop(path, None)
    if not findings.all():
        path, reason = home, f"holds nothing that can be used ({len(left_out)} files)"
        if len(left_out) == 1:
            [(path, reason)] = left_out.items()
        raise DataError(path, reason, "" if "; " in reason else EXPECTED)

    comparison = _Comparison()
    flight = match(findings, comparison, comparison.distance_m)
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


_CLOCKS: dict[str, Literal["whole seconds", "none"]] = {SHARED_SECONDS: "whole seconds", UNTIMED: "none"}
"""Clocks of sequences of pictures by the codec of their index."""

_BESIDE: dict[str, Callable[[Path], Path]] = {"kitti": times_of}
"""Functions that find the file that belongs to one of a format, by the format's name."""


def _read_beside(findings: Findings) -> list[Path]:
    """List the files that were read with others: the times of a trajectory."""
    return [_BESIDE[found.format](found.path) for found in findings.all() if found.format in _BESIDE]


def _absolute(path: Path) -> Path:
    """Return the path without `..`; links are not followed, so the manifest states what the user sees."""
    return Path(os.path.abspath(path))  # noqa: PTH100 - resolve() follows links


def _stated(path: Path, folder: Path) -> str:
    """Write a path as in a manifest in a folder, with slashes: relative if it is below it, else absolute."""
    return (
        path.relative_to(_absolute(folder)) if path.is_relative_to(_absolute(folder)) else path
    ).as_posix()


def _write(target: Path, text: str) -> str:
    """Write the manifest completely or not at all; return the problem if it is not valid, else ''."""
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


# --- reading -------------------------------------------------------------------------------------------


def _read_all(things: Sequence[Thing], home: Path, progress: Progress) -> tuple[Findings, dict[Path, str]]:
    """Read all things as far as the matching needs it; return also those that are of no use."""
    progress.start("Reading", len(things))
    found: list[Found] = []
    unread: dict[Path, str] = {}
    for path, formats in things:
        known, problem = _read(path, formats, home)
        found += known
        if problem:
            unread[path] = problem
        progress.advance()
    return Findings(found), unread


def _read(path: Path, formats: Sequence[Format], home: Path) -> tuple[list[Found], str]:
    """Read a thing as every kind that it can be; of several formats of a kind, the first that works is used.

    Return also the reason if it is of no kind, or if one of its kinds cannot be read.
    """
    found: dict[type[Found], Sequence[Found]] = {}
    kinds: set[type | None] = set()  # of formats that read it
    problems: list[tuple[Format, DataError]] = []
    *folders, name = path.relative_to(home).parts or (path.name,)
    place = (*folders, name if path.is_dir() else Path(name).stem)
    for format_ in formats:
        ambiguous = sum(kind_of_format(other) is kind_of_format(format_) for other in formats) > 1
        head = Found(path, place, format_.name, format_.title)
        try:
            if isinstance(format_, TelemetryFormat):
                things: Sequence[Found] = _drone_logs(head, format_)
            else:
                thing = _described(head, format_, ambiguous)
                things = [thing] if thing else []
        except DataError as error:
            problems.append((format_, error))
            continue
        if things:
            found.setdefault(type(things[0]), things)
            kinds.add(kind_of_format(format_))
    problem = "" if found else "of no use here, left out"
    for format_, cause in problems:
        # A missing library names itself.
        own = str(cause.source).startswith(str(path))
        what = cause.problem if own else f"{cause.source} {cause.problem}"
        if not found:
            problem = with_remedy(f"{what}, left out", cause.remedy)
            break
        if kind_of_format(format_) not in kinds:
            problem = with_remedy(f"{format_.title} left out: {what}", cause.remedy)
            break
    return [thing for things in found.values() for thing in things], problem


def _described(head: Found, format_: Format, ambiguous: bool) -> Found | None:
    """Describe a thing by the kind of its format; None for kinds that manifests cannot name.

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
        made_ns = (index.start_ns or None) if path.is_dir() else created_ns(path)
        return Video(*about, index.count, int(index.pts_ns[-1]), made_ns, _CLOCKS.get(index.codec, "own"))
    if isinstance(format_, MapFormat):
        fitting_m = None
        try:
            grid = format_.read_map(path)
        except MapSizeError as error:
            if (fitting_m := error.fitting_m) is None:
                raise
            grid = format_.read_map(path, resolution_m=fitting_m)
        far = float(np.abs(grid.origin[:2]).max()) > _LOCAL_M
        return Map(*about, fitting_m, projected=far and grid.crs is None)
    if head.format == _FRAME_TIMES:
        stamps = read_frame_times(path)
        key: Literal["csv", "srt"] = "srt" if path.suffix.lower() == ".srt" else "csv"
        return FrameTimes(*about, key, len(stamps.t_ns), _span(stamps.t_ns))
    return None


class _Comparison:
    """Comparison of videos with drones' logs by their motion; each is read once."""

    def __init__(self) -> None:
        self._followed: dict[Path, Followed] = {}
        self._telemetry: dict[tuple[Path, int | None], Telemetry | None] = {}

    def __call__(self, video: Video, log: DroneLog) -> Alike | None:
        """Return how well the poses in a log explain the motion in a video's pictures; None without poses.

        The lens is taken to have an ordinary angle of view. Without a gimbal, the camera is taken to look
        forward and down by the angle that explains most.
        """
        if video.path not in self._followed:
            self._followed[video.path] = _followed_points(video.path)
        telemetry = self._read(log)
        if telemetry is None or (track := telemetry.gimbal or telemetry.body) is None:
            return None
        if telemetry.position.on_earth:
            latitude, longitude, height = telemetry.position.values.T
            place = Place(float(latitude[0]), float(longitude[0]), float(height[0]))
            position = enu_from_geodetic(latitude, longitude, height, place)
        else:
            position = telemetry.position.values
        moved = interpolate_points(telemetry.position.t_ns, position, track.t_ns, max_gap_ns=_BRIDGED_NS)
        rows = np.isfinite(moved).all(axis=1)
        if video.made_ns is not None and log.span.first_ns > NO_DATE_NS:  # it began or ended at that time
            within_ns = 2 * video.length_ns + _MADE_WITHIN_NS
            rows &= np.abs(track.t_ns - video.made_ns) <= within_ns
        found: list[Alike] = []
        for down_deg in (0.0,) if telemetry.gimbal else _DOWN_DEG:
            turned = multiply(track.quaternion_xyzw[rows], body_from_camera("forward", down_deg))
            explained = explain_motion(
                track.t_ns[rows], moved[rows], turned, self._followed[video.path], max_gap_ns=_BRIDGED_NS
            )
            if explained is not None:
                found.append(Alike(*explained))
        return max(found, key=lambda alike: float(np.nansum(alike.gain)), default=None)

    def distance_m(self, log: DroneLog, other: DroneLog) -> float | None:
        """Return the median distance across of positions on Earth in two logs, at the times of the first."""
        tracks = [each.position for each in map(self._read, (log, other)) if each and each.position.on_earth]
        if len(tracks) < 2:
            return None
        place = Place(*tracks[0].values[0].tolist())
        own, theirs = (
            enu_from_geodetic(track.values[:, 0], track.values[:, 1], track.values[:, 2] * 0, place)[:, :2]
            for track in tracks
        )
        there = interpolate_points(tracks[1].t_ns, theirs, tracks[0].t_ns, max_gap_ns=_BRIDGED_NS)
        apart_m = np.linalg.norm(own - there, axis=1)
        return float(np.nanmedian(apart_m)) if np.isfinite(apart_m).any() else None

    def _read(self, log: DroneLog) -> Telemetry | None:
        key = log.path, log.instance
        if key not in self._telemetry:
            self._telemetry[key] = _telemetry_of(log)
        return self._telemetry[key]


def _followed_points(path: Path) -> Followed:
    index = index_video(path)
    focal_px = _NOMINAL_FOCAL * index.width
    nominal = Intrinsics(
        index.width, index.height, focal_px, focal_px, (index.width - 1) / 2, (index.height - 1) / 2
    )
    return followed_points(path, nominal, index.pts_ns[index.pts_ns <= _WATCHED_NS])


def _telemetry_of(log: DroneLog) -> Telemetry | None:
    reader = FORMATS.get(log.format)
    if not isinstance(reader, TelemetryFormat):
        return None
    altitude = 0.0 if log.height == "stated" else None
    return reader.read_telemetry(log.path, TelemetryChoice(altitude=altitude, instance=log.instance))


def _span(t_ns: Int64) -> Span:
    return Span(int(t_ns[0]), int(t_ns[-1]))


# --- drones' own logs ------------------------------------------------------------------------------------


def _drone_logs(head: Found, format_: TelemetryFormat) -> list[Found]:
    """Describe the poses in a drone's own log, with or without attitudes; those of each vehicle in it.

    Attitudes that come without positions, or without north, are a thing of their own.

    Raises:
        DataError: it cannot be read, or holds neither positions nor attitudes.
    """
    key = _KEYS.get(head.format)
    if key is None:
        return []
    vehicles = TLOG.vehicles(head.path) if head.format == TLOG.name else []
    instances = vehicles if len(vehicles) > 1 else [None]
    try:
        logs = [_drone_log(head, format_, key, instance) for instance in instances]
    except DataError:
        if angles := _angles(head, format_, key):
            return [*angles]
        raise
    whole = any(log.gimbal for log in logs)
    return [*logs, *([] if whole else _angles(head, format_, key))]


def _angles(head: Found, format_: Format, key: OwnLog) -> list[Angles]:
    """Describe the camera's attitudes in a log that can be used for them alone; empty without any."""
    angle_key = _ANGLE_KEYS.get(key)
    if angle_key is None or not isinstance(format_, AttitudeFormat):
        return []
    try:
        found = format_.read_attitudes(head.path)
    except DataError:
        return []
    about = (head.path, head.place, head.format, head.title)
    return [Angles(*about, angle_key, len(found.camera.t_ns), found.knows_north)]


def _drone_log(head: Found, format_: TelemetryFormat, key: OwnLog, instance: int | None) -> DroneLog:
    try:
        telemetry = format_.read_telemetry(head.path, TelemetryChoice(instance=instance))
    except DataError:  # if only heights are missing, reading with a stated height works
        telemetry = format_.read_telemetry(head.path, TelemetryChoice(altitude=0.0, instance=instance))
    track = telemetry.position
    start = None
    films = recordings_of(head.path) if head.format == "dji_record" else []
    if head.path.suffix.lower() == ".srt":
        subtitles = read_subtitles(head.path)
        start_ns = subtitles.start_ns() if subtitles.are_slow else None
        if start_ns is not None:
            start = VideoStart(start_ns, "by the subtitles' clock, local time taken as UTC", sigma_s=1)
    elif telemetry.video_began is not None:
        began_ns, sigma_s = telemetry.video_began
        made = telemetry.clock == "the video's time of creation"
        source = f"by the {'time of creation in its metadata' if made else 'telemetry in it'}"
        start = VideoStart(began_ns, source, sigma_s)
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
        height=track.height,
        instance=instance,
        video_start=start,
        films=tuple(Span(*film) for film in films),
    )


# --- logs ----------------------------------------------------------------------------------------------


def _recording(head: Found, format_: LogFormat) -> Recording:
    """Describe the topics of a log, with the frames of its poses and transforms."""
    with format_.open_log([head.path]) as log:
        topics: dict[str, TopicFound] = {}
        for topic in log.topics:
            kind = kind_of(topic) or _OTHER_KINDS.get(topic.type)
            if kind and topic.name not in topics:
                span = Span(topic.first_ns or 0, topic.last_ns or 0)
                lead_ns = _lead_ns(log, topic.name) if topic.count else None
                topics[topic.name] = TopicFound(
                    topic.name, topic.type, kind, topic.count, span, lead_ns=lead_ns
                )
        drivers = tuple(_drivers(log))
        edges: dict[Edge, None] = {}
        for name, known in topics.items():
            if known.kind == "poses":
                first = next(_pose_samples(log, name, 1, head.path), None)
                if first:
                    topics[name] = replace(known, target=first.target, source=first.source)
            elif known.kind == "maps":
                message = next(iter(log.messages([name])), None)
                with suppress(DataError):
                    topics[name] = replace(known, target=frame_of(message, name) if message else "")
            elif known.kind == "transforms":
                still = name.rstrip("/").endswith("tf_static")
                for sample in _pose_samples(log, name, _TRANSFORMS_ASKED, head.path):
                    lead_ns = sample.stamp_ns - sample.receive_ns if sample.stamp_ns else None
                    link = (name, sample.target, sample.source, still)
                    edges.setdefault(Edge(*link, sample.receive_ns, lead_ns))
    about = (head.path, head.place, head.format, head.title)
    return Recording(*about, (head.path,), tuple(topics.values()), tuple(edges), drivers)


def _drivers(log: Log) -> Iterator[Driver]:
    """Yield the drones whose drivers' usual topics are in a log."""
    topics = {topic.name: topic for topic in log.topics if topic.count}
    every = namespaces(list(topics))
    for preset, namespace in every:
        parts = parts_of(preset, namespace, list(topics))
        spans = [topics[name] for name in parts.position]
        alone = len([known for known, _ in every if known == preset]) == 1
        yield Driver(
            settings={"preset": preset, "namespace": None if alone else namespace or "/"},
            span=Span(min(t.first_ns or 0 for t in spans), max(t.last_ns or 0 for t in spans)),
            count=max(topic.count for topic in spans),
            body=bool(parts.attitude),
            gimbal=bool(parts.gimbal),
            by_gps=preset == "px4" or any(topics[name].type in FIXES for name in parts.position),
            lead_ns=0 if preset == "px4" else _lead_ns(log, parts.position[0]),
        )
    for place, turned in pairs_of(list(topics.values())):
        topic = topics[place]
        yield Driver(
            settings={"topic": place, "attitude": turned},
            span=Span(topic.first_ns or 0, topic.last_ns or 0),
            count=topic.count,
            body=True,
            gimbal=False,
            by_gps=True,
            lead_ns=_lead_ns(log, place),
        )


def _lead_ns(log: Log, topic: str) -> int | None:
    """Return by how much the first header stamp of a topic is ahead of its receipt; None without one."""
    first = next(iter(log.messages([topic])), None)
    stamp_ns = 0 if first is None else header_ns(first)
    return stamp_ns - first.receive_ns if first is not None and stamp_ns else None


def _pose_samples(log: Log, topic: str, messages: int, source: Path) -> Iterator[PoseSample]:
    """Yield the poses in the first messages of a topic; those that cannot be read are skipped."""
    for message in islice(log.messages([topic]), messages):
        try:
            yield from (sample for sample in samples(message, source) if isinstance(sample, PoseSample))
        except DataError:
            continue
