"""Text of a drafted flight.yaml: what was found, with comments on what only the user can know.

Names come from file systems and logs, and may hold any character. A value is always read back as the same,
and a comment always ends at the end of its line.
"""

import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from io import StringIO
from pathlib import Path
from typing import Any, get_args

from ruamel.yaml import YAML
from ruamel.yaml.representer import RoundTripRepresenter

from pipelines.drafting.found import (
    Angles,
    Calibration,
    DroneLog,
    Found,
    FrameTimes,
    Joints,
    Keypoints,
    Poses,
    Recording,
    Span,
    Video,
    VideoStart,
)
from pipelines.drafting.matching import NO_DATE_NS, CameraDraft, Candidate, Draft
from pipelines.session.manifest import SCHEMA, OwnLog

# Texts that every reader of YAML, old or new, reads as text without quotes.
_PLAIN = re.compile(r"(?:\.\.?/)*[A-Za-z_/][A-Za-z0-9_./-]*(?: [A-Za-z0-9_./-]+)*")
_WORDS_OF_YAML = frozenset(["null", "true", "false", "yes", "no", "on", "off", "y", "n"])


class _Representer(RoundTripRepresenter):
    """Writes times with all their digits, and quotes texts that a reader may take for another type."""

    def represent_str(self, data: str) -> Any:
        plain = _PLAIN.fullmatch(data) and data.lower() not in _WORDS_OF_YAML
        return self.represent_scalar("tag:yaml.org,2002:str", data, style=None if plain else '"')

    def represent_decimal(self, data: Decimal) -> Any:
        text = format(data, "f")
        return self.represent_scalar(f"tag:yaml.org,2002:{'float' if '.' in text else 'int'}", text)


_Representer.add_representer(str, _Representer.represent_str)
_Representer.add_representer(Decimal, _Representer.represent_decimal)


def flow(value: object) -> str:
    """Write texts, numbers, mappings and lists as YAML on one line."""
    yaml = YAML()
    yaml.Representer = _Representer
    yaml.default_flow_style = True
    yaml.brace_single_entry_mapping_in_flow_sequence = True
    yaml.width = sys.maxsize
    text = StringIO()
    yaml.dump([value], text)  # a document cannot be a bare text without a line "..." after it
    return text.getvalue().strip()[1:-1]


def entry(key: str, value: object, comment: str = "") -> str:
    """Write a line `key: value  # comment`, without indentation."""
    return commented(f"{flow(key)}: {flow(value)}", comment)


def commented(line: str, comment: str) -> str:
    """Append a comment to a line, if there is one."""
    return f"{line}  # {one_line(comment)}" if comment else line


def one_line(text: str) -> str:
    """Replace all characters that end a line or control a terminal."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


ASSUMED_FPS = 30
_BRIDGED_NS = 500_000_000  # ingest's default for the longest gap between two poses
_AXES = {"joints_csv": "metres, z up", "c3d": "y up, or z up, as it says"}
"""Axes in which the joints of a format are read, by its name; all others have y up."""
_MOST_OTHERS = 8  # candidates that are listed after the chosen one


@dataclass
class Remarks:
    """Short remarks on the whole manifest: each with the cameras that it concerns."""

    missing: dict[str, list[str]] = field(default_factory=dict)  # ingest is not possible without it
    assumed: dict[str, list[str]] = field(default_factory=dict)  # the result depends on it


class CameraText:
    """Writer of one camera, key by key.

    Args:
        camera: the camera with its candidates.
        draft: the flight of the camera.
        relative: converts a path to the form in the manifest.
        remarks: missing and assumed things are added here.
    """

    def __init__(
        self, camera: CameraDraft, draft: Draft, relative: Callable[[Path], str], remarks: Remarks
    ) -> None:
        self._camera = camera
        self._draft = draft
        self._relative = relative
        self._remarks = remarks
        self._assumed: set[str] = set()  # keys that get `assumed: true`

    def lines(self) -> list[str]:
        """Write the lines below the camera's name, without indentation."""
        return [
            *self._video(),
            *self._keypoints(),
            *self._frame_times(),
            *self._clock(),
            *self._pose(),
            *self._mount(),
            *self._intrinsics(),
            *self._noise(),
        ]

    # --- pictures --------------------------------------------------------------------------------------

    def _video(self) -> list[str]:
        videos = self._camera.videos
        if not videos and self._camera.keypoints:
            return []
        if not videos:
            self._miss("a video or keypoints")
            return [
                f"# video: {self._camera.name}.mp4  # missing: or {{log, topic}} of pictures, or keypoints"
            ]
        remark = describe(videos[0])
        if self._camera.paired:
            remark += "; assumed: of the same camera as the keypoints"
            self._assume("video", "of the same camera as the keypoints")
        return self._said("video", videos, remark)

    def _keypoints(self) -> list[str]:
        if not self._camera.keypoints:
            return []
        taken, *others = self._camera.keypoints
        found = taken.found
        settings = dict(taken.settings)
        remarks = [describe(taken)]
        if isinstance(found, Keypoints) and found.ambiguous:
            settings["format"] = found.format
            remarks.append("assumed: other formats recognise it too")
            self._assume("keypoints", f"that they are {found.format}'s")
        if isinstance(found, Keypoints) and (first := _first_frame(found, self._film)):
            settings["first_frame"] = first
            remarks.append(f"assumed: frame {first} of it is the first")
            self._assume("keypoints", f"first_frame {first}")
        return self._said("keypoints", [replace(taken, settings=settings), *others], "; ".join(remarks))

    @property
    def _film(self) -> Video | None:
        """The video file, if its pictures are in one."""
        found = self._camera.videos[0].found if self._camera.videos else None
        return found if isinstance(found, Video) else None

    # --- time ------------------------------------------------------------------------------------------

    def _frame_times(self) -> list[str]:
        choice = self._camera.frame_times
        if choice:
            return self._said("frame_times", choice.all, describe(choice.taken))
        if self._camera.videos and self._film is None:
            return []  # the log's own stamps
        if self._film and self._film.clock == "none":
            self._miss("frame_times: when its pictures were taken, for their EXIF does not say it")
            why = "their EXIF has no times that rise; or a csv"
            return [f"# frame_times: {{start: SECONDS, fps: {ASSUMED_FPS}}}  # missing: {why}"]
        if (known := self._known_start) is not None:
            settings = {"start": (Decimal(known.start_ns) / 10**9).normalize()}
            if not known.sigma_s:
                return [self._entry("frame_times", settings, known.source)]
            self._assume("frame_times", f"start {known.source}, to {known.sigma_s:g} s")
            return [self._entry("frame_times", settings, f"assumed: {known.source}")]
        start, reason = self._start()
        if self._film:
            if start is None:
                return ["# frame_times: {start: SECONDS}  # when the first frame was taken, if not at 0"]
            self._assume("frame_times", "start, when the first frame was taken")
            return [self._entry("frame_times", {"start": start}, f"assumed: the first frame {reason}")]
        if not self._camera.keypoints:
            return []
        fps = {"fps": ASSUMED_FPS}
        if start is None:
            self._assume("frame_times", f"fps {ASSUMED_FPS}, the first frame at 0 s")
            remark = f"assumed: {ASSUMED_FPS} frames a second, the first at 0 s"
            return [self._entry("frame_times", fps, remark)]
        self._assume("frame_times", f"fps {ASSUMED_FPS}; start, when the first frame was taken")
        remark = f"assumed: {ASSUMED_FPS} frames a second, the first {reason}"
        return [self._entry("frame_times", {"start": start, **fps}, remark)]

    @property
    def _known_start(self) -> VideoStart | None:
        """The video's start by the log of its poses, or by its own metadata if the log covers it then.

        A log inside the video knows it exactly, and motion that a log explains determines it well. Subtitles
        with whole seconds know it to a second, and so does a record of one video of about this length.
        """
        film, poses = self._film, self._camera.poses
        if film is None or poses is None:
            return None
        taken = poses.taken.found
        if poses.start_ns is not None:
            return VideoStart(poses.start_ns, "when its pictures move as its poses", sigma_s=0.2)
        for found in (each.found for each in poses.all):  # poses of another log, the clock of its own
            start = found.video_start if isinstance(found, DroneLog) else None
            if start is None or found.path != film.path:
                continue
            if found is taken or start.start_ns > NO_DATE_NS:
                return start
        if isinstance(taken, DroneLog):
            if taken.video_start is not None and taken.path.suffix.lower() == ".srt":
                return taken.video_start
            if (recorded := taken.film_of(film)) is not None:
                source = "when the flight record says that a video began"
                return VideoStart(recorded.first_ns, source, sigma_s=1)
        if film.made_ns is None or poses.taken.span is None:
            return None
        if film.path.is_dir() and taken.path == film.path:
            whole = film.clock == "whole seconds"
            return VideoStart(film.made_ns, "by the EXIF of its pictures", sigma_s=1 if whole else 0)
        made = Span(film.made_ns, film.made_ns + film.length_ns)
        if poses.taken.span.overlap_ns(made) < film.length_ns:
            return None
        return VideoStart(film.made_ns, "by the time of creation in its metadata", sigma_s=1)

    def _start(self) -> tuple[Decimal | None, str]:
        """Assume the first frame's time in seconds: the start of poses and truth; None for 0."""
        poses = self._camera.poses.taken.span if self._camera.poses else None
        truth = next((joints.span for joints in self._draft.true_joints), None)
        known = {"its poses": poses, "the truth": truth}
        spans = {what: span for what, span in known.items() if span}
        if poses and truth and poses.overlap_ns(truth) < 0:
            spans = {"its poses": poses}  # the truth has another zero of time
        filmed = Span(0, self._length_ns())
        if not spans or all(filmed.overlap_ns(span) >= 0 for span in spans.values()):
            return None, ""
        first_ns = max(span.first_ns for span in spans.values())
        return Decimal(-(-first_ns // 10**6)) / 1000, f"when {' and '.join(spans)} begin"

    def _length_ns(self) -> int:
        if self._film:
            return self._film.length_ns
        frames = (c.found.frames for c in self._camera.keypoints[:1] if isinstance(c.found, Keypoints))
        return next(frames, 0) * 10**9 // ASSUMED_FPS

    def _clock(self) -> list[str]:
        if self._camera.videos and self._film is None:
            return []
        known = None if self._camera.frame_times else self._known_start
        if known is not None and known.sigma_s:
            settings = {"offset_s": 0, "sigma_s": known.sigma_s}
            return [entry("clock", settings, f"the start is known to {known.sigma_s:g} s")]
        return ["# clock: {offset_s: 0, sigma_s: 0.2}  # if its clock is off against the poses', or unsure"]

    # --- poses -----------------------------------------------------------------------------------------

    def _pose(self) -> list[str]:
        choice = self._camera.poses
        if choice is None:
            self._miss("pose: nothing of that name has poses")
            loose = self._loose(Poses, DroneLog, Recording, Calibration)
            return [
                f"# pose: {{tum: {self._camera.name}.tum}}  # missing: nothing of that name has poses{loose}",
                "#   or {csv: FILE}, {static: CALIBRATION}, {log: LOG, topic: TOPIC}, {log, parent, child},",
                f"#   {{log, preset: mavros}}, or a drone's own log: {', '.join(get_args(OwnLog))}",
            ]
        taken = choice.taken
        remarks = [describe(taken)]
        if not choice.named:
            remarks.append(" ".join(["assumed: they are its own", choice.why]).strip(" ,"))
            self._assume("pose", " ".join(["that these poses are its own", choice.why]).strip())
        if taken.is_true:
            remarks.append("assumed: these poses, called the truth, for there are no others")
            self._assume("pose", "what is called the truth, for there is nothing else")
        filmed = self._camera.filmed
        if filmed and taken.span and filmed.overlap_ns(taken.span) < 0:
            remarks.append(f"missing: it was filmed at other times, {spanned(filmed)}")
            self._miss("pose: there are no poses of the time when it filmed")
        if isinstance(taken.found, Poses):
            remarks.append("if of the body, not the camera: add of: body, and a mount")
        if isinstance(taken.found, DroneLog):
            remarks += self._about_drone(taken.found)
        if taken.ned_hint:
            remarks.append(f"{flow(taken.ned_hint)} sounds like north-east-down: then add axes: ned")
            self._assume("pose", "axes enu, although a name sounds like ned")
        return self._said("pose", choice.all, "; ".join(remarks), self._pose_settings)

    def _about_drone(self, found: DroneLog) -> list[str]:
        """List remarks on what a drone's own log does not determine."""
        remarks = []
        if found.height == "stated":
            self._miss("pose: altitude, for its log states no height")
            remarks.append("missing: altitude: METRES above the take-off")
        elif found.key == "dji" and found.height == "unknown":
            self._assume("pose", "absolute heights from a barometer, which differ between drones by metres")
            remarks.append("assumed: absolute heights (altitude: relative takes the other)")
        elif found.key == "dji":
            self._assume("pose", "heights above the take-off, which was level for all")
            remarks.append("assumed: heights above the take-off (altitude: absolute takes the other)")
        if found.step_ns > _BRIDGED_NS:
            step_s = found.step_ns / 1e9
            remarks.append(f"a position every {step_s:.3g} s: ingest with --max-pose-gap {1.5 * step_s:.3g}")
        return remarks

    def _pose_settings(self, candidate: Candidate) -> object:
        if isinstance(candidate.found, Calibration):
            return {"static": self._of_calibration(candidate)}
        if "log" in candidate.settings and "preset" not in candidate.settings:
            return {**candidate.settings, "of": "body" if candidate.of_body else "camera"}
        return candidate.settings

    def _mount(self) -> list[str]:
        if self._camera.poses is None:
            return []
        taken = self._camera.poses.taken
        if self._camera.gimbal is None and (taken.unturned or taken.of_body):
            own = self._camera.angles
            if own is not None and isinstance(own.found, Angles):
                return self._own_angles(own, own.found, taken)
        if taken.unturned and self._camera.gimbal is None:
            self._miss("gimbal: how the camera was turned, for its log does not say it")
            return [
                "# gimbal: {fixed: {yaw_deg: 90, pitch_deg: -30}}  # missing: from north to east, and up; or"
                " {log: LOG, topic: TOPIC, relative_to: world}"
            ]
        if not taken.of_body and (isinstance(taken.found, DroneLog) or "preset" in taken.settings):
            return ["# mount: {looks: forward, translation: [0, 0, 0]}  # the lever arm to the gimbal, m"]
        if not (taken.of_body or taken.unturned):
            return []
        choice = self._camera.gimbal
        if choice is None:
            return [self._fixed_mount()]
        self._miss("gimbal: relative_to, what its angles are relative to")
        lines = ["gimbal:", *(f"  {entry(key, value)}" for key, value in choice.taken.settings.items())]
        lines.append(
            "  # relative_to: world  # missing: world (DJI: it replaces the body's turn), body or heading"
        )
        if choice.taken.topic and "Quaternion" not in choice.taken.topic.type:
            lines.append("  # order: ypr  # assumed: yaw, pitch, roll as they stand in the message; or rpy")
            lines.append("  # units: deg  # assumed; or rad")
            self._assume("gimbal", "order ypr, units deg")
            lines.append("  assumed: true")
        lines.append("# mount: {looks: forward, translation: [0, 0, 0]}  # the lever arm to the gimbal, m")
        return [*lines, *self._others("gimbal", choice.others)]

    def _fixed_mount(self) -> str:
        self._assume("mount", "the camera looks forward, level, from the body's origin")
        settings = {"looks": "forward", "down_deg": 0, "translation": [0, 0, 0]}
        return self._entry("mount", settings, "assumed: along the body's x axis, level, no lever arm (m)")

    def _own_angles(self, own: Candidate, found: Angles, taken: Candidate) -> list[str]:
        """Write the camera's attitudes in its own video, for poses that lack them."""
        lever_arm = "# mount: {looks: forward, translation: [0, 0, 0]}  # the lever arm to the gimbal, m"
        held = f"{found.count} attitudes of the camera in its video"
        if found.knows_north:
            return [self._entry("gimbal", own.settings, held), lever_arm]
        unsure = entry("gimbal", stated({**own.settings, "yaw_deg": 90}, self._relative), "")
        heading = "yaw_deg is where its first picture looks, from north to east"
        if taken.of_body:
            return [self._fixed_mount(), commented(f"# or {unsure}", f"if it turned in a gimbal: {heading}")]
        self._miss("gimbal: yaw_deg, the heading of its first picture, which a GoPro does not log")
        return [commented(f"# {unsure}", f"missing: {heading} ({held})"), lever_arm]

    def _noise(self) -> list[str]:
        if self._camera.poses is None or self._camera.poses.taken.span is None:
            return []
        if self._camera.poses.taken.by_gps:
            return [
                "# pose_noise: {gauss-markov: {position_m: 1.5, rotation_deg: 1, correlation_s: 100},"
                " white: {position_m: 0.1, rotation_deg: 0.3}}",
                "#   what GPS alone is good for: 1 to 2 m across, twice that in height, for minutes alike",
            ]
        return ["# pose_noise: {white: {position_m: 0.1, rotation_deg: 0.5}}  # how good they are, if known"]

    # --- intrinsics ------------------------------------------------------------------------------------

    def _intrinsics(self) -> list[str]:
        choice = self._camera.intrinsics
        if choice is None:
            self._miss("intrinsics: nothing of that name has them")
            return [
                "# intrinsics: {width: 1920, height: 1080, fx: 1400, fy: 1400, cx: 959.5, cy: 539.5}"
                f"  # missing: nothing of that name has them{self._loose(Calibration)}",
                "#   or a calibration file, or {log: LOG, topic: TOPIC}",
            ]
        remark = describe(choice.taken)
        if not choice.named:
            remark += "; assumed: it holds for this camera"
            self._assume("intrinsics", "that one calibration holds for them")
        return self._said("intrinsics", choice.all, remark, self._of_calibration)

    def _of_calibration(self, candidate: Candidate) -> object:
        """Write only the path if the camera is clear: it has the same name, or it is the only one."""
        if candidate.settings.get("camera") in {None, self._camera.name} and "path" in candidate.settings:
            return candidate.found.path
        return candidate.settings

    # --- sentences -------------------------------------------------------------------------------------

    def _said(
        self,
        key: str,
        candidates: Sequence[Candidate],
        remark: str,
        settings: Callable[[Candidate], object] = lambda candidate: candidate.settings,
    ) -> list[str]:
        """Write the first candidate, and the others as comments below."""
        line = self._entry(key, settings(candidates[0]), remark)
        return [line, *self._others(key, candidates[1:], settings)]

    def _entry(self, key: str, settings: object, remark: str) -> str:
        """Write a line of the camera, with `assumed: true` where anything in it was assumed."""
        value = stated(settings, self._relative)
        if key in self._assumed:
            value = {**(value if isinstance(value, dict) else {"path": value}), "assumed": True}
        return entry(key, value, remark)

    def _others(
        self,
        key: str,
        candidates: Sequence[Candidate],
        settings: Callable[[Candidate], object] = lambda candidate: candidate.settings,
    ) -> list[str]:
        lines = [
            f"# or {entry(key, stated(settings(candidate), self._relative), describe(candidate))}"
            for candidate in candidates[:_MOST_OTHERS]
        ]
        more = len(candidates) - len(lines)
        return [*lines, f"#   and {more} more"] if more else lines

    def _loose(self, *kinds: type[Found]) -> str:
        """List found things of some kinds that are not used."""
        paths = [self._relative(found.path) for found in self._draft.unused if isinstance(found, kinds)]
        return f"; there is {', '.join(map(flow, paths[:_MOST_OTHERS]))}" if paths else ""

    def _assume(self, key: str, what: str) -> None:
        self._assumed.add(key)
        self._remarks.assumed.setdefault(f"{key}: {what}", []).append(self._camera.name)

    def _miss(self, what: str) -> None:
        self._remarks.missing.setdefault(what, []).append(self._camera.name)


def stated(settings: object, relative: Callable[[Path], str]) -> object:
    """Convert settings to the form in the manifest: relative paths, no None, a lone path without its key."""
    if isinstance(settings, Path):
        return relative(settings)
    if not isinstance(settings, dict):
        return settings
    said = {key: stated(value, relative) for key, value in settings.items() if value is not None}
    return said["path"] if said.keys() == {"path"} else said


def describe(candidate: Candidate) -> str:
    """Describe a candidate in a few words."""
    found, topic = candidate.found, candidate.topic
    if topic:
        type_ = topic.type.rpartition("/")[2]
        return f"{topic.count} {type_}, {spanned(topic.span)}"
    match found:
        case Video():
            return f"{found.frames} frames, {found.length_ns / 1e9:.6g} s"
        case Keypoints():
            return f"{found.title}, {found.frames} frames"
        case FrameTimes():
            return f"{found.rows} times" + (", local time taken as UTC" if found.key == "srt" else "")
        case Poses():
            return f"{found.title}, {spanned(found.span)}"
        case DroneLog():
            has = "with gimbal angles" if found.gimbal else "no gimbal angles"
            return f"{found.title}, {found.positions} positions, {has}, {spanned(found.span)}"
        case Recording() if "attitude" in candidate.settings:
            return "positions and attitudes" + (f", {spanned(candidate.span)}" if candidate.span else "")
        case Recording() if "preset" in candidate.settings:
            turned = "" if candidate.of_body or candidate.unturned else " with gimbal angles"
            return f"usual topics{turned}" + (f", {spanned(candidate.span)}" if candidate.span else "")
        case Recording():
            return "transforms" + (f", {spanned(candidate.span)}" if candidate.span else "")
    return found.title


def spanned(span: Span) -> str:
    """Write the length and the start of a span."""
    return f"{(span.last_ns - span.first_ns) / 1e9:.6g} s from {span.first_ns / 1e9:.3f}"


def _first_frame(found: Keypoints, video: Video | None) -> int:
    """Return the first frame's number if the numbers cannot count from 0; else 0."""
    if video is None:
        return found.first_frame if found.first_frame > found.frames else 0
    fits = found.last_frame - found.first_frame < video.frames
    return found.first_frame if found.last_frame >= video.frames and fits else 0


def flowing(settings: object, relative: Callable[[Path], str]) -> str:
    """Write settings in one line of YAML."""
    return flow(stated(settings, relative))


_HEAD = """\
# A flight for `mocap ingest`, drafted by `mocap init` from what the files say.
# What is marked "assumed" or "missing" they do not say: only you can know it. Everything with
# `assumed: true` is reported as a guess until you take that away."""
_NO_CAMERA = """
# cameras:  # missing: one for each drone, with its video or keypoints, poses and intrinsics
#   drone1:
#     video: drone1.mp4
#     pose: {tum: drone1.tum}
#     intrinsics: drone1.yaml"""
_ABOUT_LOGS = """\
  # With stamps: receive the time of receipt counts. Where a clock or an origin is another:
  #   clock: {offset_s: 0, drift_ppm: 0}, world_from_log: {translation: [0, 0, 0], yaw_deg: 0}"""
_NAMES_LISTED = 5


@dataclass(frozen=True)
class ManifestText:
    """The manifest, with short versions of its comments."""

    text: str
    missing: list[str]  # the flight cannot be ingested without it
    assumed: list[str]  # the flight can be ingested, but results depend on it


def write_manifest(draft: Draft, name: str, relative: Callable[[Path], str]) -> ManifestText:
    """Write the whole manifest of a draft.

    Args:
        draft: the flight with its cameras and sources.
        relative: converts a path to the form in the manifest.
    """
    remarks = Remarks()
    guessed = any(
        isinstance(camera.poses.taken.found, Poses | Recording) for camera in draft.cameras if camera.poses
    )  # calibrations and drones' own logs state their axes
    world = {"frame": "enu"} | ({"assumed": True} if guessed else {})
    lines = [
        _HEAD,
        entry("schema", SCHEMA),
        entry("name", name),
        entry("world", world, "assumed: the poses have z up (x east, y north); or ned" if guessed else ""),
        *_origin(draft),
        *_logs(draft, relative, remarks),
        *_cameras(draft, relative, remarks),
        *_actor(draft, relative, remarks),
        *_map(draft, relative, remarks),
        *_truth(draft, relative),
        *_unused(draft, relative),
    ]
    return ManifestText("\n".join(lines) + "\n", _in_short(remarks.missing), _in_short(remarks.assumed))


def _in_short(remarks: Mapping[str, list[str]]) -> list[str]:
    """Write one line for each remark, with the cameras that it concerns."""
    lines = []
    for what, names in remarks.items():
        shown = ", ".join(names[:_NAMES_LISTED]) + (", ..." if len(names) > _NAMES_LISTED else "")
        lines.append(f"{shown}: {what}" if shown else what)
    return lines


def _origin(draft: Draft) -> list[str]:
    """Write a comment on the world's origin, for positions on Earth."""
    if not any(camera.poses and camera.poses.taken.by_gps for camera in draft.cameras):
        return []
    return ["#   origin: {latitude_deg: 0, longitude_deg: 0, altitude_m: 0}  # else the first position's"]


def _logs(draft: Draft, relative: Callable[[Path], str], remarks: Remarks) -> list[str]:
    """Write every log that the rest of the manifest names."""
    if not draft.logs:
        return []
    lines = ["", "logs:"]
    taken = [camera.poses.taken.settings for camera in draft.cameras if camera.poses]
    several = len({str(settings["log"]) for settings in taken if "log" in settings}) > 1
    for name, log in draft.logs.items():
        paths = [relative(path) for path in log.parts]
        settings: dict[str, object] = {"path": paths[0] if len(paths) == 1 else paths, "stamps": log.stamps}
        remark = f"{log.title}, {spanned(log.span)}"
        if log.stamps == "receive" and abs(log.ahead_ns) < 10**9:
            remark += "; receipt, as the header stamps of another log are of another clock"
        elif log.ahead_ns:
            remark += (
                f"; header stamps are {abs(log.ahead_ns) / 1e9:.3f} s"
                f" {'ahead of' if log.ahead_ns > 0 else 'behind'} receipt, assumed: {log.stamps}"
            )
        if log.stamps == "receive" or log.ahead_ns:
            what = (
                f"logs: {log.stamps} stamps, for header stamps and those of receipt are of different clocks"
            )
            remarks.assumed[what] = []
        if several or log.ahead_ns or log.stamps == "receive":
            settings["assumed"] = True
        lines.append("  " + entry(name, settings, remark))
    if several:
        remarks.assumed["logs: one clock and one origin for all; else say clock and world_from_log"] = []
    return [*lines, _ABOUT_LOGS]


def _cameras(draft: Draft, relative: Callable[[Path], str], remarks: Remarks) -> list[str]:
    if not draft.cameras:
        remarks.missing["cameras: nothing was found that has pictures, keypoints or poses of a drone"] = []
        return [_NO_CAMERA]
    lines = ["", "cameras:"]
    for camera in draft.cameras:
        lines.append(f"  {flow(camera.name)}:")
        lines += [f"    {line}" for line in CameraText(camera, draft, relative, remarks).lines()]
    return lines


def _actor(draft: Draft, relative: Callable[[Path], str], remarks: Remarks) -> list[str]:
    """Write the source of the person's logged positions."""
    if not draft.actors:
        return []
    taken, *others = draft.actors
    remarks.assumed["actor: point hip, which point of the person the log follows"] = []
    remark = f"{describe(taken)}; assumed: point, one of hip, head, feet, centre"
    lines = [
        "",
        entry("actor", stated({**taken.settings, "point": "hip", "assumed": True}, relative), remark),
    ]
    return lines + [f"# or actor: {flowing(other.settings, relative)}" for other in others]


def _map(draft: Draft, relative: Callable[[Path], str], remarks: Remarks) -> list[str]:
    """Write the maps: the first file, else a topic that lies where the poses do; the others as comments."""
    on_earth = any(camera.poses and camera.poses.taken.by_gps for camera in draft.cameras)
    placed = [c for c in draft.logged_maps if c.placed]
    lines = []
    for found in draft.maps:
        settings = {"path": relative(found.path), "resolution_m": found.resolution_m}
        said = [found.title]
        if found.resolution_m:
            said.append("at a finer resolution_m it would be too large")
        if found.projected and on_earth:
            said.append("missing: crs: EPSG:32632, that of its coordinates")
            if found is draft.maps[0]:
                remarks.missing["map: crs, for its coordinates are those of a map projection"] = []
        lines.append(entry("map", stated(settings, relative), "; ".join(said)))
    lines += [entry("map", c.settings, describe(c)) for c in placed]
    others = [
        entry("map", c.settings, f"{describe(c)}; in another frame than the poses: needs transforms")
        for c in draft.logged_maps[len(placed) :]
    ]
    comments = [f"# or {line}" for line in [*lines[1:], *others][:_MOST_OTHERS]]
    return ["", *lines[:1], *comments] if lines or comments else []


def _truth(draft: Draft, relative: Callable[[Path], str]) -> list[str]:
    """Write the truth; joints only if they overlap with poses in time, because ingest refuses others."""
    known: dict[str, object] = {}
    lines: list[str] = []
    spans = [camera.poses.taken.span for camera in draft.cameras if camera.poses]
    logged = [span for span in spans if span]
    remark = ""
    for joints in draft.true_joints:
        meets = not logged or any(joints.span.overlap_ns(span) >= 0 for span in logged)
        if meets and "joints" not in known:
            known["joints"] = relative(joints.path)
            remark = f"{_AXES.get(joints.format, 'y up')}; where it is not so: joints: {{path, unit, axes}}"
            continue
        why = "" if meets else ", when there are no poses: add offset_s to its times"
        shown = relative(joints.path) if meets else {"path": relative(joints.path), "offset_s": 0}
        lines.append(
            commented(
                f"# or truth: {{joints: {flow(shown)}}}", f"{joints.title}, {spanned(joints.span)}{why}"
            )
        )
    poses = {c.name: next(iter(c.true_poses.taken.settings.values())) for c in draft.cameras if c.true_poses}
    if poses:
        known["poses"] = poses
    if known:
        lines.insert(0, entry("truth", stated(known, relative), remark))
    return ["", *lines] if lines else []


def _unused(draft: Draft, relative: Callable[[Path], str]) -> list[str]:
    """Write comments on files that were recognised but are not used."""
    if not draft.unused:
        return []
    lines = ["", "# Recognised, but not used:"]
    for found in draft.unused:
        hint = "; if known to be true: truth: {joints: FILE}" if isinstance(found, Joints) else ""
        if isinstance(found, Recording) and (fixes := [t.name for t in found.topics if t.kind == "fixes"]):
            hint = f" with positions alone; if the person carried it: actor: {{log: FILE, topic: {fixes[0]}}}"
        lines.append(f"#   {flow(relative(found.path))}  ({one_line(found.title)}{hint or _held(found)})")
    return lines


def _held(found: Found) -> str:
    """List the topics of an unused log, which the user could still name."""
    if not isinstance(found, Recording):
        return ""
    topics = [topic.name for topic in found.topics if topic.count]
    presets = [driver.settings for driver in found.drivers if "preset" in driver.settings]
    topics += [" of ".join(str(each) for each in settings.values() if each) for settings in presets]
    return f" with {one_line(', '.join(topics[:_NAMES_LISTED]))}" if topics else " without poses or pictures"
