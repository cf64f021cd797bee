"""Stage `draft`: write a flight.yaml for files and folders; it can be ingested or says what is missing."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from itertools import islice, takewhile
from pathlib import Path

import numpy as np

from pipelines.drafting.found import (
    ACTOR,
    GIMBAL,
    LAST_POSE_TYPE,
    NED,
    NO_DATE_NS,
    OPTICAL,
    POSE_TYPES,
    FlownPoses,
    FoundFilm,
    FoundFrames,
    FoundLink,
    FoundLog,
    NamePlace,
    Proposal,
    SourceKind,
    TimeSpan,
    VideoStart,
    is_called,
    label_of,
    label_of_place,
)
from pipelines.drafting.manifest_text import flow, one_line, write_manifest
from pipelines.drafting.matching import Ask, MotionMatch, leave_open, match
from pipelines.drafting.motion import TrackedPoints, explain_motion, explains_better
from pipelines.formats.common.rows import median_step_ns
from pipelines.formats.drone_logs.dji_records import recordings_of
from pipelines.formats.drone_logs.dji_subtitles import read_subtitles
from pipelines.formats.drone_logs.place_tracks import AIRSIM
from pipelines.formats.drone_logs.tlog import FORMAT as TLOG
from pipelines.formats.logs.maps import MAP_TYPES, frame_of
from pipelines.formats.logs.messages import all_samples, header_ns, kind_of, samples
from pipelines.formats.logs.positions import FIXES, pairs_of
from pipelines.formats.logs.trajectories import attitudes_of, poses_of
from pipelines.formats.videos.frame_times import FrameTimesFormat, read_frame_times
from pipelines.formats.videos.picture_folder import (
    PICTURES,
    FolderPictures,
    patterns_of_airsim,
    picture_files,
    read_tags,
)
from pipelines.formats.videos.video import VideoReader, created_ns
from pipelines.geometry.arrays import Float, Int64, Intrinsics, Place, RelativeTo
from pipelines.geometry.geodesy import enu_from_geodetic
from pipelines.geometry.mounting import body_from_camera, level_heading
from pipelines.geometry.poses import interpolate_points, interpolate_rotations, multiply
from pipelines.reconstruction.background_tracks import Follower
from pipelines.session.errors import DataError
from pipelines.session.manifest import read_flight
from pipelines.session.maps import MapSizeError
from pipelines.session.progress import Progress, Silent
from pipelines.session.recognition import EXPECTED, describe_unknown, recognise, refuse_pointers
from pipelines.session.records import SHARED_SECONDS, UNTIMED, PoseSample, Trajectory
from pipelines.session.registries import (
    FORMATS,
    CalibrationFormat,
    Format,
    JointFormat,
    KeypointFormat,
    Log,
    LogFormat,
    MapFormat,
    TelemetryChoice,
    TelemetryFormat,
    TrajectoryFormat,
    VideoFormat,
)
from pipelines.session.storage import as_data_error, drop_link, is_folder, on_disk
from pipelines.sources.attitudes import FilmOfCamera, turned_by_pictures
from pipelines.sources.parts import CameraFrames
from pipelines.sources.pictures import open_files
from pipelines.sources.poses import USUAL_SATELLITE_SIGMA_M

# Coordinates beyond it are those of a map projection, m.
MAX_LOCAL_M = 100_000.0

# One minute of a video is enough to compare its motion with logs.
WATCHED_NS = 60_000_000_000

# Motion is still visible in pictures reduced to this width.
WATCHED_WIDTH_PX = 320

# Points are lost and found again after a fifth of a second.
STRETCH_NS = 200_000_000

# Fewer points may all lie on one thing that moves.
MIN_POINTS_OF_A_STRETCH = 12

# A picture is 1.25 focal lengths wide at an ordinary angle of view, 64 deg.
NOMINAL_FOCAL = 0.8

# Focal lengths are compared as on photographic film.
WIDTH_OF_FILM_MM = 36.0

# Tilts that are tried for a camera whose mount nobody stated, deg.
TRIED_DOWN_DEG = (0.0, 30.0, 60.0, 90.0)

# Positions of a log that are further apart are not interpolated.
MAX_GAP_NS = 2_000_000_000

# The metadata of a video state when it began or ended, to some seconds.
MADE_WITHIN_NS = 5_000_000_000

# The first messages of a topic of transforms name all of its frames.
TRANSFORMS_READ = 2000

# A calibration of more cameras holds the pictures of one moving camera.
MAX_CAMERAS_OF_CALIBRATION = 200

KINDS = (
    KeypointFormat,
    TrajectoryFormat,
    CalibrationFormat,
    JointFormat,
    LogFormat,
    VideoFormat,
    MapFormat,
    TelemetryFormat,
    FrameTimesFormat,
)


@dataclass(frozen=True)
class Drafted:
    """A manifest that was written, with remarks on it."""

    path: Path
    text: str
    cameras: list[str]
    filmed: bool  # one of them has pictures or keypoints
    missing: list[str]  # the flight cannot be ingested without it
    assumed: list[str]  # the flight can be ingested, but results depend on it
    left_out: dict[Path, str]  # paths that were not used, with the reason


def draft(
    paths: Sequence[Path],
    output: Path | None = None,
    *,
    overwrite: bool = False,
    ask: Ask = leave_open,
    progress: Progress | None = None,
) -> Drafted:
    """Examine files and folders and write the manifest of their flight.

    Folders are searched, without hidden files and sessions. Things that the files do not determine are in
    comments beside the line that they concern. By default it is flight.yaml in the folder that all paths
    share. `ask` decides what neither names nor contents do; without it, that is missing.

    DataError: nothing was recognised, a path is missing, or the output exists or cannot be written.
    """
    search = _FileSearch()
    things, home = search.look([_absolute(path) for path in paths])
    target = output or home / "flight.yaml"
    if target.exists() and not overwrite:
        problem, remedy = "exists", "choose another with --output, or replace it with --overwrite"
        raise DataError(target, problem, remedy, code="exists")
    progress = progress or Silent()
    progress.start("Reading", len(things))
    found: list[Proposal | FoundLog] = []
    for path, formats in things:
        read, problem = _read(path, formats, home)
        found += read
        if problem:
            search.left_out[path] = problem
        progress.advance()
    search.left_out.pop(_absolute(target), None)
    if not found:
        path, reason = home, f"holds nothing that can be used ({len(search.left_out)} files)"
        for file, why in search.left_out.items():
            if len(search.left_out) == 1 or "; " in why:  # it can be mended
                path, reason = file, why
                break
        raise DataError(path, reason, "" if "; " in reason else EXPECTED, code="wrong-kind")

    candidates = [each for each in found if isinstance(each, Proposal)]
    logs = [each for each in found if isinstance(each, FoundLog)]
    flight = match(candidates, logs, _MotionComparison(), _focal_by_film, _distance_m, ask)
    manifest = write_manifest(flight, home.name or "flight", lambda path: _stated(path, target.parent))
    text = manifest.text
    if [_absolute(target.parent)] == [_absolute(path) for path in paths]:
        text += f"{_DRAFT}{_digest(text)} of {_digest(_listing(target))}\n"
    problem = _write(target, text)
    return Drafted(
        path=target,
        text=text,
        cameras=[camera.name for camera in flight.cameras],
        filmed=any(each for camera in flight.cameras for each in camera.pictures.values()),
        missing=manifest.missing or ([problem] if problem else []),
        assumed=manifest.assumed,
        left_out=search.left_out,
    )


# The last line of a draft says what it was made of.
_DRAFT = "# `mocap run` drafts it again when files are added, until you edit it: "


def _is_made(folder: Path) -> bool:
    """Test if `mocap` made a folder: a session, or an export."""
    return folder.suffix in (".session", ".export") or _is_session(folder)


def _is_session(folder: Path) -> bool:
    return (folder / "session.json").is_file()


def must_be_drafted(manifest: Path) -> bool:
    """Test if there is no manifest, or an unedited draft that lacks something or whose files changed."""
    try:
        text, mark, digests = manifest.read_text(encoding="utf-8", errors="replace").rpartition(_DRAFT)
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError as error:
        raise as_data_error(error, manifest) from error
    edited, _, files = digests.partition(" of ")
    if not mark or edited != _digest(text):
        return False
    return "missing: " in text or files.strip() != _digest(_listing(manifest))


def leave_out(manifest: Path, reason: str) -> bool:
    """Turn the camera that a reason names into comments, in a draft that nobody edited with more cameras."""
    text, mark, digests = manifest.read_text(encoding="utf-8").rpartition(_DRAFT)
    edited, _, files = digests.partition(" of ")
    cameras = read_flight(manifest).cameras
    named = [name for name in cameras if f": cameras.{name}." in reason]
    if not mark or edited != _digest(text) or len(named) != 1 or len(cameras) == 1:
        return False
    before, head, after = text.partition(f"\n  {flow(named[0])}:\n")
    lines = list(takewhile(lambda line: line.startswith("    "), after.splitlines()))
    kept = "\n".join(f"  # {line.strip()}" for line in [head.strip(), *lines])
    rest = "\n".join(after.splitlines()[len(lines) :])
    text = f"{before}\n  # left out: {one_line(reason)}\n{kept}\n{rest}\n"
    problem = _write(manifest, f"{text}{_DRAFT}{_digest(text)} of {files.strip()}\n")
    return not problem


def _digest(text: str) -> str:
    return sha256(text.encode(errors="replace")).hexdigest()[:12]


def _listing(manifest: Path) -> str:
    """List the files beside a manifest with their sizes, without hidden ones and what `mocap` made."""
    home, files = manifest.parent, list[str]()
    for folder, inner, names in os.walk(home):
        inner[:] = sorted(name for name in inner if name[0] != "." and not _is_made(Path(folder, name)))
        shown = [Path(folder, name) for name in sorted(names) if name[0] != "."]
        files += [f"{each.relative_to(home)} {each.lstat().st_size}" for each in shown if each != manifest]
    return "\n".join(files)


def _absolute(path: Path) -> Path:
    """Return the path without `..`; links are not followed, so the manifest states what the user sees."""
    return Path(os.path.abspath(path))  # noqa: PTH100 - resolve() follows links


def _stated(path: Path, folder: Path) -> str:
    """Write a path as in a manifest in a folder, with slashes: relative if it is below it, else absolute."""
    inside = path.is_relative_to(_absolute(folder))
    return (path.relative_to(_absolute(folder)) if inside else path).as_posix()


def _write(target: Path, text: str) -> str:
    """Write the manifest completely or not at all; return the problem if it is not valid, else ''."""
    temporary = target.with_name(f"{target.name}.new")
    drop_link(temporary)
    problem = ""
    with on_disk(target):
        temporary.write_text(text, encoding="utf-8", newline="\n")
        try:
            read_flight(temporary)
        except DataError as error:
            problem = error.problem
        temporary.replace(target)
    return problem


# --- search --------------------------------------------------------------------------------------------

Thing = tuple[Path, list[Format]]
"""A file or folder, and the formats that recognise it."""


class _FileSearch:
    """Search through files and folders; `left_out` has the paths that cannot be used, with the reason."""

    def __init__(self) -> None:
        self.left_out: dict[Path, str] = {}
        self._formats = FORMATS.all()
        self._seen: set[Path] = set()

    def look(self, paths: Sequence[Path]) -> tuple[list[Thing], Path]:
        """Find everything that is recognised, each thing once, and the folder that all paths share."""
        things: list[Thing] = []
        bases: list[Path] = []
        for path in paths:
            if not path.exists():
                raise DataError(path, "does not exist", "check the path", code="no-such-file")
            if _is_session(path):
                remedy = "name the folder of the flight's files, or look at `mocap report SESSION`"
                raise DataError(path, "is a session", remedy, code="wrong-kind")
            found = list(self._under(path))
            alone = not path.is_dir() or [thing for thing, _ in found] == [path]
            bases.append(path.parent if alone else path)
            things += found
        return sorted(things, key=lambda thing: thing[0]), Path(os.path.commonpath(bases))

    def _under(self, path: Path) -> Iterator[Thing]:
        if path.resolve() in self._seen:  # named twice, or a link that leads back
            return
        self._seen.add(path.resolve())
        try:
            str(path).encode()
        except UnicodeEncodeError:
            self.left_out[path] = "its name is no text that a manifest could state, left out"
            return
        if path.is_dir():
            yield from self._under_folder(path)
        elif formats := self._recognising(path):
            yield path, formats
        else:
            self.left_out[path] = _why_left_out(path)

    def _under_folder(self, folder: Path) -> Iterator[Thing]:
        """Yield the folder itself if it is one thing, and things in it that are not part of that."""
        try:
            every = sorted(folder.iterdir())
        except OSError as error:
            self.left_out[folder] = f"cannot be read ({error.strerror}), left out"
            return
        children = [c for c in every if c.name[0] != "." and not _is_made(c) and c.exists()]
        formats = [f for f in self._recognising(folder) if self._is_whole(folder, children, f)]
        patterns = patterns_of_airsim(folder) if PICTURES in formats else []
        for pattern in patterns:
            yield pattern, [PICTURES]
        if formats and not patterns:
            yield folder, formats
        kinds = {_kind_of_format(format_) for format_ in formats}
        for child in children:
            if child.is_dir() or not formats:
                yield from self._under(child)
            elif KeypointFormat not in kinds or child.suffix.lower() != ".json":
                others = [f for f in self._recognising(child) if _kind_of_format(f) not in kinds]
                if others:
                    yield child, others

    def _is_whole(self, folder: Path, children: Sequence[Path], format_: Format) -> bool:
        """Test if a folder that a format recognises is one thing, not a folder with several such things."""
        if isinstance(format_, LogFormat):
            inside = [_kind_of_format(f) for child in children for f in self._recognising(child)]
            alone = len(inside) == 1 and not (folder / "metadata.yaml").exists()
            return not alone and all(kind is LogFormat for kind in inside)
        if not isinstance(format_, KeypointFormat):
            return True
        files = [child for child in children if child.suffix.lower() == ".json"]
        if len(files) < 2 or any(f is not format_ for file in files[:2] for f in self._recognising(file)):
            return False
        try:
            format_.read_keypoints(folder, skeleton=None, first_frame=0)
        except DataError:  # two files of one frame: they are of several cameras
            return False
        return True

    def _recognising(self, path: Path) -> list[Format]:
        return [format_ for format_ in self._formats if format_.recognises(path)]


def _kind_of_format(format_: Format) -> type | None:
    return next((kind for kind in KINDS if isinstance(format_, kind)), None)


def _why_left_out(path: Path) -> str:
    if path.suffix.lower() in {".yaml", ".yml"}:
        with suppress(DataError):
            read_flight(path)
            return "is a flight manifest already (run `mocap ingest` on it), left out"
    like = describe_unknown(path)
    return "; ".join(filter(None, [f"{like.problem}, left out", like.remedy]))


# --- reading -------------------------------------------------------------------------------------------


def _read(path: Path, formats: Sequence[Format], home: Path) -> tuple[list[Proposal | FoundLog], str]:
    """Read a thing as every kind that it can be; of several formats of a kind the first that works counts."""
    *folders, name = path.relative_to(home).parts or (path.name,)
    place = (*folders, name.strip("_*") if is_folder(path) else Path(name).stem)
    found: dict[type | None, list[Proposal | FoundLog]] = {}
    problems: list[tuple[Format, DataError]] = []
    for format_ in formats:
        kind = _kind_of_format(format_)
        rivals = [other for other in formats if _kind_of_format(other) is kind]
        try:
            known = [] if kind in found else list(_described(path, place, format_, len(rivals) > 1))
        except DataError as error:
            problems.append((format_, error))
            continue
        if known:
            found[kind] = known
    problem = "" if found else "of no use here, left out"
    for format_, cause in problems:
        if _kind_of_format(format_) not in found:
            own = str(cause.source).startswith(str(path))  # a missing library names itself
            what = cause.problem if own else f"{cause.source} {cause.problem}"
            said = f"{format_.title} left out: {what}" if found else f"{what}, left out"
            problem = "; ".join(filter(None, [said, cause.remedy]))
            break
    return [thing for things in found.values() for thing in things], problem


def _described(
    path: Path, place: NamePlace, format_: Format, ambiguous: bool
) -> Iterator[Proposal | FoundLog]:
    refuse_pointers(path)
    file: dict[str, object] = {"file": path}
    head, labels, title = (path, place), (label_of_place(place),), format_.title
    if isinstance(format_, KeypointFormat):
        listed = format_.read_keypoints(path, skeleton=None, first_frame=0).frames_listed
        about = f"{title}, {len(listed)} frames"
        found = FoundFrames("keypoints", *head, about, file, labels, (0, place), frames=len(listed))
        rival = format_.name if ambiguous else ""
        yield replace(found, first_frame=int(listed[0]), last_frame=int(listed[-1]), ambiguous=rival)
    elif isinstance(format_, TrajectoryFormat):
        span = _span(format_.read_trajectory(path).t_ns)
        about, rank = f"{title}, {span}", (0, 0, place)
        yield Proposal("pose", *head, about, file, labels, rank, span, type=format_.name)
    elif isinstance(format_, CalibrationFormat):
        yield from _of_calibration(path, place, format_)
    elif isinstance(format_, JointFormat):
        motion = format_.read_joints(path, unit=None, axes=None)
        if not motion.timed:
            remedy = "name it under truth: {file: ..., fps: 30, offset_s: SECONDS}"
            raise DataError(path, "states no times", remedy, code="clock-unknown")
        span = _span(motion.t_ns)
        yield Proposal("joints", *head, title, file, labels, (0, place), span, type=format_.name)
    elif isinstance(format_, LogFormat):
        yield _recording(path, place, format_)
    elif isinstance(format_, VideoFormat):
        index = format_.index(path)
        length_ns = int(index.pts_ns[-1])
        about = f"{index.count} frames, {length_ns / 1e9:.6g} s"
        film = FoundFilm("video", *head, about, file, labels, (0, place), frames=index.count)
        film = replace(film, size=(index.width, index.height))
        made_ns = (index.start_ns or None) if is_folder(path) else created_ns(path)
        clock = {SHARED_SECONDS: "whole seconds", UNTIMED: "none"}.get(index.codec, "own")
        focal_35_mm = read_tags(picture_files(path)[0]).focal_35_mm if is_folder(path) else None
        yield replace(film, length_ns=length_ns, made_ns=made_ns, clock=clock, focal_35_mm=focal_35_mm)
    elif isinstance(format_, MapFormat):
        try:
            grid = format_.read_map(path)
        except MapSizeError as error:
            if error.fitting_m is None:
                raise
            grid, file = format_.read_map(path, resolution_m=error.fitting_m), dict(file)
            file["resolution_m"] = error.fitting_m
        far = float(np.abs(grid.origin[:2]).max()) > MAX_LOCAL_M
        frame = "projected" if far and grid.crs is None else ""
        yield Proposal("map", *head, title, file, labels, (0, place), frame=frame)
    elif isinstance(format_, TelemetryFormat):
        yield from _drone_logs(path, place, format_)
    elif isinstance(format_, FrameTimesFormat):
        t_ns = read_frame_times(path).t_ns
        about = f"{len(t_ns)} times" + (", local time taken as UTC" if path.suffix.lower() == ".srt" else "")
        span = _span(t_ns)
        yield FoundFrames("frame_times", *head, about, file, labels, (0, place), span, frames=len(t_ns))


def _of_calibration(path: Path, place: NamePlace, format_: CalibrationFormat) -> Iterator[Proposal]:
    cameras, label = format_.read_calibration(path), label_of_place(place)
    if len(cameras) > MAX_CAMERAS_OF_CALIBRATION:
        return
    for name, camera in cameras.items():
        own, alone = label_of(name), len(cameras) == 1
        both = tuple({word.key: word for word in (*label, *own)}.values())
        labels = tuple(each for each in ([label, own] if alone else [own, both]) if each) or ((),)
        settings: dict[str, object] = {"file": path} | ({} if alone else {"camera": name})
        about = (path, place, format_.title, settings, labels, (0, place, name))
        if camera.intrinsics is not None:
            yield Proposal("intrinsics", *about)
        if camera.position is not None:
            yield Proposal("still", *about)


def _span(t_ns: Int64) -> TimeSpan:
    return TimeSpan(int(t_ns[0]), int(t_ns[-1]))


# --- drones' own logs ------------------------------------------------------------------------------------


def _drone_logs(path: Path, place: NamePlace, format_: TelemetryFormat) -> Iterator[Proposal]:
    """Describe the poses in a drone's own log, with or without attitudes; those of each vehicle in it."""
    vehicles: dict[int, str] = {}
    if format_.name == TLOG.name:
        vehicles = {number: f"vehicle{number}" for number in TLOG.vehicles(path)}
    if format_.name == AIRSIM.name:
        vehicles = AIRSIM.vehicles(path)
        t_ns = AIRSIM.picture_times(path, TelemetryChoice())
        about, labels = f"{len(t_ns)} times", tuple(map(label_of, vehicles.values()))
        stamps = FoundFrames(
            "frame_times", path, place, about, {"file": path}, labels, (0, place), _span(t_ns)
        )
        yield replace(stamps, frames=len(t_ns))
    for instance in vehicles if len(vehicles) > 1 else [None]:
        yield _drone_log(path, place, format_, instance, vehicles.get(instance or 0, ""))


def _drone_log(
    path: Path, place: NamePlace, format_: TelemetryFormat, instance: int | None, vehicle: str
) -> FlownPoses:
    try:
        telemetry = format_.read_telemetry(path, TelemetryChoice(instance=instance))
    except DataError:  # if only heights are missing, reading with a stated height works
        telemetry = format_.read_telemetry(path, TelemetryChoice(altitude=0.0, instance=instance))
    track, start, focal_35_mm = telemetry.position, None, None
    if path.suffix.lower() == ".srt":
        subtitles = read_subtitles(path)
        focal_35_mm = subtitles.focal_35_mm()
        start_ns = subtitles.start_ns() if subtitles.are_slow else None
        if start_ns is not None:
            start = VideoStart(start_ns, "by the subtitles' clock, local time taken as UTC", sigma_s=1)
    elif telemetry.video_began is not None:
        began_ns, sigma_s = telemetry.video_began
        made = telemetry.clock == "the video's time of creation"
        source = f"by the {'time of creation in its metadata' if made else 'telemetry in it'}"
        start = VideoStart(began_ns, source, sigma_s)
    films = recordings_of(path) if format_.name == "dji_record" else []
    turned, held = telemetry.gimbal is not None, telemetry.body is not None
    span = _span(track.t_ns)
    has = "with gimbal angles" if turned else "no gimbal angles"
    return FlownPoses(
        "pose",
        path,
        place,
        f"{format_.title}, {len(track.t_ns)} positions, {has}, {span}",
        {"file": path} | ({} if instance is None else {"instance": instance}),
        (label_of_place(place) if instance is None else label_of(vehicle),),
        (0, int(not turned), place, instance or 0),
        span,
        of_body=held and not turned,
        unturned=not (held or turned),
        by_gps=track.on_earth or track.origin is not None,
        telemetry=telemetry,
        step_ns=int(median_step_ns(track.t_ns) or 0),
        states_altitude="altitude" in getattr(format_, "choices", ()),
        height=track.height,
        video_start=start,
        films=tuple(TimeSpan(*film) for film in films),
        focal_35_mm=focal_35_mm,
    )


class _MotionComparison:
    """Comparison of videos with poses by their motion; each video is followed once."""

    def __init__(self) -> None:
        self._followed: dict[Path, TrackedPoints] = {}

    def __call__(self, film: FoundFilm, found: Proposal, gimbals: Sequence[Proposal]) -> MotionMatch | None:
        """Return how well poses explain the motion in a video's pictures; None without poses."""
        poses = _poses_in(found)
        if poses is None:
            return None
        if film.path not in self._followed:
            self._followed[film.path] = _followed_points(film.path)
        t_ns, position, body = poses
        within = np.isfinite(position).all(axis=1)
        if film.made_ns is not None and found.span and found.span.first_ns > NO_DATE_NS:
            within &= np.abs(t_ns - film.made_ns) <= 2 * film.length_ns + MADE_WITHIN_NS
        ahead = body_from_camera("forward")

        def match(
            turned: Float, gimbal: Proposal | None = None, of: RelativeTo = "world"
        ) -> MotionMatch | None:
            rows = within & np.isfinite(turned).all(axis=1)
            explained = explain_motion(
                t_ns[rows], position[rows], turned[rows], self._followed[film.path], max_gap_ns=MAX_GAP_NS
            )
            return None if explained is None else MotionMatch(*explained, gimbal, of)

        best: MotionMatch | None = None
        turning = [(gimbal, turn) for gimbal in gimbals for turn in _turned_by(gimbal, t_ns, body)]
        for gimbal, (relative_to, attitude) in turning:
            other = match(multiply(attitude, ahead), gimbal, relative_to)
            if other and (best is None or np.nansum(other.gain) > np.nansum(best.gain)):
                best = other
        if turning and all(is_called(gimbal.topic, GIMBAL) for gimbal in gimbals):
            return best
        fixed = self._without_gimbal(match, found, body)
        turns = best is not None and (fixed is None or explains_better(best.gain, fixed.gain))
        return best if turns else fixed

    @staticmethod
    def _without_gimbal(
        explain: Callable[[Float], MotionMatch | None], found: Proposal, body: Float
    ) -> MotionMatch | None:
        """Return how well a mount that does not turn explains a video."""
        best: MotionMatch | None = None
        own = explain(body)
        if isinstance(found, FlownPoses) and not found.of_body:
            return own
        for down_deg in TRIED_DOWN_DEG:
            other = explain(multiply(body, body_from_camera("forward", down_deg)))
            if other and (best is None or explains_better(other.gain, best.gain)):
                best = replace(other, of_body=True, down_deg=down_deg)
        named, other = (best, own) if found.of_body else (own, best)
        return other if other and named and explains_better(other.gain, named.gain) else named


def _turned_by(gimbal: Proposal, t_ns: Int64, body: Float) -> Iterator[tuple[RelativeTo, Float]]:
    """Yield the world attitudes [N, 4] of a gimbal on a body, by what its angles can be relative to."""
    with suppress(DataError):
        with recognise(gimbal.path, LogFormat, "log").open_log([gimbal.path]) as log:
            logged = all_samples(log.messages([gimbal.topic]), gimbal.path)
            found = attitudes_of(logged, gimbal.path, stamps="header").trajectory
        attitude = interpolate_rotations(found.t_ns, found.quaternion_xyzw, t_ns, max_gap_ns=MAX_GAP_NS)
        yield "world", attitude
        yield "body", multiply(body, attitude)
        yield "heading", multiply(level_heading(body), attitude)


def _followed_points(path: Path) -> TrackedPoints:
    """Follow points through the first pictures of a video, each for a fifth of a second."""
    import cv2

    index = recognise(path, VideoFormat, "video").index(path)
    pts_ns = index.pts_ns[index.pts_ns <= (WATCHED_NS if index.codec != UNTIMED else 0)]
    height = round(index.height * WATCHED_WIDTH_PX / index.width)
    follower = Follower()
    with FolderPictures(path) if is_folder(path) else VideoReader(path) as reader:
        for number, picture in reader.frames(0, len(pts_ns)):
            grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
            small = cv2.resize(grey, (WATCHED_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
            follower.step(number, np.asarray(small, np.uint8))
    tracks = follower.tracks()
    rays = (tracks.xy - [(WATCHED_WIDTH_PX - 1) / 2, (height - 1) / 2]) / (NOMINAL_FOCAL * WATCHED_WIDTH_PX)
    spans, begins, ends = [], [], []
    first = 0
    while (last := int(np.searchsorted(pts_ns, pts_ns[first] + STRETCH_NS))) < len(pts_ns):
        one, other = (slice(*np.searchsorted(tracks.picture, (k, k + 1))) for k in (first, last))
        _, begin, end = np.intersect1d(tracks.point[one], tracks.point[other], return_indices=True)
        if len(begin) >= MIN_POINTS_OF_A_STRETCH:
            spans.append((first, last))
            begins.append(rays[one][begin])
            ends.append(rays[other][end])
        first = last
    pictures = np.array(spans, np.int64).reshape(-1, 2)
    nothing = np.zeros((0, 2))
    return TrackedPoints(
        pts_ns[pictures[:, 0]],
        pts_ns[pictures[:, 1]],
        np.repeat(np.arange(len(begins)), [len(points) for points in begins]),
        np.concatenate([nothing, *begins]),
        np.concatenate([nothing, *ends]),
    )


def _focal_by_film(film: FoundFilm, found: Proposal, start_ns: int) -> float | None:
    """Measure a focal length (mm on film 36 mm wide) by a map of the pictures that lies on logged places."""
    places = _places_in(found)
    if places is None:
        return None
    index = recognise(film.path, VideoFormat, "video").index(film.path)
    if index.codec == UNTIMED or len(index.pts_ns) < 2:
        return None
    pts_ns = index.pts_ns[index.pts_ns <= WATCHED_NS]
    frames = CameraFrames(np.arange(len(pts_ns)), start_ns + pts_ns - pts_ns[0], pts_ns)
    focal_px = NOMINAL_FOCAL * max(film.size)
    with suppress(DataError):
        turned = turned_by_pictures(
            str(film.path),
            film.path.name,
            FilmOfCamera("", partial(open_files, [film.path], None, "header")),
            frames,
            Intrinsics(
                fx=focal_px,
                fy=focal_px,
                cx=(film.size[0] - 1) / 2,
                cy=(film.size[1] - 1) / 2,
                width=film.size[0],
                height=film.size[1],
            ),
            Trajectory(*places, np.tile([0.0, 0.0, 0.0, 1.0], (len(places[0]), 1))),
            refine_focal=True,
            pose_noise=None,
            satellite_sigma_m=USUAL_SATELLITE_SIGMA_M if found.by_gps else None,
            kept=lambda _: None,
            note=lambda _: None,
            progress=Silent(),
        )
        if turned.map.focal_ratio != 1.0:
            return NOMINAL_FOCAL * turned.map.focal_ratio * WIDTH_OF_FILM_MM
    return None


def _places_in(found: Proposal) -> tuple[Int64, Float] | None:
    """Read times and positions, m."""
    if not isinstance(found, FlownPoses):
        poses = _poses_in(found)
        return poses if poses is None else poses[:2]
    if found.telemetry is None:
        return None
    track = found.telemetry.position
    position = _enu(track.values, Place(*track.values[0].tolist())) if track.on_earth else track.values
    return track.t_ns, position


def _poses_in(found: Proposal) -> tuple[Int64, Float, Float] | None:
    """Read times, positions and rotations of a body, or of a camera; None for those of several topics."""
    if isinstance(found, FlownPoses):
        telemetry = found.telemetry
        if telemetry is None or (track := telemetry.gimbal or telemetry.body) is None:
            return None
        position, turned = telemetry.position.values, track.quaternion_xyzw
        if telemetry.position.on_earth:
            position = _enu(position, Place(*position[0].tolist()))
        if telemetry.gimbal is not None:
            turned = multiply(turned, body_from_camera("forward"))
        moved = interpolate_points(telemetry.position.t_ns, position, track.t_ns, max_gap_ns=MAX_GAP_NS)
        return track.t_ns, moved, turned
    poses = None
    with suppress(DataError):
        if not found.topic and "parent" not in found.settings:
            poses = recognise(found.path, TrajectoryFormat, "trajectory").read_trajectory(found.path)
        elif found.settings.keys() == {"file", "topic"}:
            with recognise(found.path, LogFormat, "log").open_log([found.path]) as log:
                poses = poses_of(log, found.topic, str(found.path), "header").trajectory
    return None if poses is None else (poses.t_ns, poses.position, poses.quaternion_xyzw)


def _enu(geodetic: Float, place: Place) -> Float:
    return enu_from_geodetic(geodetic[:, 0], geodetic[:, 1], geodetic[:, 2], place)


def _distance_m(log: FlownPoses, other: FlownPoses) -> float | None:
    """Return the median distance across of positions on Earth in two logs, at the times of the first."""
    tracks = [each.telemetry.position for each in (log, other) if each.telemetry]
    if len(tracks) < 2 or not all(track.on_earth for track in tracks):
        return None
    place = Place(*tracks[0].values[0].tolist())
    own, theirs = (_enu(track.values * [1, 1, 0], place)[:, :2] for track in tracks)
    there = interpolate_points(tracks[1].t_ns, theirs, tracks[0].t_ns, max_gap_ns=MAX_GAP_NS)
    apart_m = np.linalg.norm(own - there, axis=1)
    return float(np.nanmedian(apart_m)) if np.isfinite(apart_m).any() else None


# --- logs ----------------------------------------------------------------------------------------------


def _recording(path: Path, place: NamePlace, format_: LogFormat) -> FoundLog:
    kinds: dict[str, SourceKind] = {"poses": "pose", "pictures": "video", "angles": "gimbal"}
    kinds |= {"intrinsics": "intrinsics", "transforms": "transforms"}
    topics: dict[str, Proposal] = {}
    edges: dict[FoundLink, None] = {}
    with format_.open_log([path]) as log:
        for topic in log.topics:
            kind = kinds.get(kind_of(topic) or "")
            kind = "map" if topic.type in MAP_TYPES else "fixes" if topic.type in FIXES else kind
            if kind is None or topic.name in topics:
                continue
            span = TimeSpan(topic.first_ns or 0, topic.last_ns or 0) if topic.count else None
            short = topic.type.rpartition("/")[2]
            known = Proposal(
                kind,
                path,
                place,
                f"{topic.count} {short}" + (f", {span}" if span else ""),
                {"file": path, "topic": topic.name},
                ((),),
                (1, -topic.count, topic.name),
                span,
                topic=topic.name,
                type=topic.type,
                lead_ns=_lead_ns(log, topic.name) if topic.count else None,
            )
            if kind == "pose":
                known = _pose_topic(log, known, short.rpartition(".")[2], topic.count)
            elif kind == "map" and (message := next(iter(log.messages([topic.name])), None)):
                with suppress(DataError):
                    known = replace(known, frame=frame_of(message, topic.name))
            elif kind == "transforms":
                still = topic.name.rstrip("/").endswith("tf_static")
                for sample in _pose_samples(log, topic.name, TRANSFORMS_READ, path):
                    lead_ns = sample.stamp_ns - sample.receive_ns if sample.stamp_ns else None
                    link = (topic.name, sample.target, sample.source, still)
                    edges.setdefault(FoundLink(*link, sample.receive_ns, lead_ns))
            topics[topic.name] = known
        topics |= {f"{each.rank}": each for each in _pairs(log, path, place)}
    return FoundLog(path, place, format_.title, topics, tuple(edges), (path,))


def _pose_topic(log: Log, topic: Proposal, type_: str, count: int) -> Proposal:
    """Add the frames of a topic's first pose, and what its names say of it."""
    first = next(_pose_samples(log, topic.topic, 1, topic.path), None)
    target, source = (first.target, first.source) if first else ("", "")
    of_body = not is_called(source or topic.topic, OPTICAL)
    likelihood = POSE_TYPES.index(type_) if type_ in POSE_TYPES else LAST_POSE_TYPE
    return replace(
        topic,
        rank=(1, int(of_body), likelihood, -count, topic.topic),
        of_body=of_body,
        ned_hint=next((name for name in (target, source, topic.topic) if is_called(name, NED)), ""),
        frame=target,
    )


def _pairs(log: Log, path: Path, place: NamePlace) -> Iterator[Proposal]:
    """Yield topics of positions on Earth with the attitudes beside them; alone in a log without attitudes."""
    topics = {topic.name: topic for topic in log.topics if topic.count}
    pairs: list[tuple[str, str | None]] = [*pairs_of(list(topics.values()))]
    if not pairs and not any(kind_of(topic) in {"poses", "transforms"} for topic in topics.values()):
        fixes = (name for name, topic in topics.items() if topic.type in FIXES)
        pairs = [(name, None) for name in fixes if not is_called(name, ACTOR)]
    for position, attitude in pairs:
        topic = topics[position]
        span = TimeSpan(topic.first_ns or 0, topic.last_ns or 0)
        yield Proposal(
            "pose",
            path,
            place,
            f"positions and attitudes, {span}" if attitude else f"positions alone, {span}",
            {"file": path, "topic": position} | ({"attitude": attitude} if attitude else {}),
            ((),),
            (1, 1, LAST_POSE_TYPE, -topic.count, position),
            span,
            of_body=attitude is not None,
            unturned=attitude is None,
            by_gps=True,
            topic=position,
            lead_ns=_lead_ns(log, position),
        )


def _lead_ns(log: Log, topic: str) -> int | None:
    """Return by how much the first header stamp of a topic is ahead of its receipt; None without one."""
    first = next(iter(log.messages([topic])), None)
    stamp_ns = 0 if first is None else header_ns(first)
    return stamp_ns - first.receive_ns if first is not None and stamp_ns else None


def _pose_samples(log: Log, topic: str, messages: int, source: Path) -> Iterator[PoseSample]:
    """Yield the poses in the first messages of a topic; those that cannot be read are skipped."""
    for message in islice(log.messages([topic]), messages):
        with suppress(DataError):
            yield from (sample for sample in samples(message, source) if isinstance(sample, PoseSample))
