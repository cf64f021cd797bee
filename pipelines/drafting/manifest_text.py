"""Text of a drafted flight.yaml: what was found, with comments on what only the user can know.

Keys, their order and the words on missing ones are those of the manifest's models. Names may hold any
character: a value is always read back as the same, and a comment always ends at the end of its line.
"""

import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.representer import RoundTripRepresenter

from pipelines.drafting.found import (
    FlownPoses,
    FoundFilm,
    FoundFrames,
    FoundLog,
    Proposal,
    TimeSpan,
    camera_names,
)
from pipelines.drafting.matching import CameraDraft, Chosen, FlightDraft, known_start
from pipelines.session.manifest import PICTURES, SCHEMA, CameraSources, Manifest
from pipelines.session.yaml_models import YamlModel

# Pictures a second of usual cameras; most of those of drones film at the first unless asked otherwise.
USUAL_FPS = (30, 25, 24, 50, 60)

# Ingest bridges a gap of half a second between two poses unless asked otherwise.
BRIDGED_NS = 500_000_000

# Logs begin and end about a second around the film, or a tenth of a long flight.
UNCOVERED_NS = 1_000_000_000

# More alternatives make the manifest unreadable.
MAX_LISTED = 8

# Texts that every reader of YAML, old or new, reads as text without quotes.
_PLAIN = re.compile(r"(?:\.\.?/)*[A-Za-z_/][A-Za-z0-9_./-]*(?: [A-Za-z0-9_./-]+)*")
_WORDS_OF_YAML = frozenset(["null", "true", "false", "yes", "no", "on", "off", "y", "n"])
_AXES = {"joints_csv": "metres, z up", "c3d": "y up, or z up, as it says"}
"""Axes in which the joints of a format are read, by its name; all others have y up."""
_HEAD = """\
# A flight for `mocap ingest`, drafted by `mocap init` from what the files say.
# What is marked "assumed" or "missing" they do not say: only you can know it. Everything with
# `assumed: true` is reported as a guess until you take that away."""


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


def one_line(text: str) -> str:
    """Replace all characters that end a line or control a terminal."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


@dataclass
class DraftedKey:
    """A key of the manifest: its value, the comment behind it, and lines of comments below it."""

    value: object = None  # None: the key is missing, and stands in a comment with an example
    remarks: list[str] = field(default_factory=list)
    below: list[str] = field(default_factory=list)
    example: object = None
    blank: bool = False  # an empty line before it

    def lines(self, key: str, model: type[YamlModel] | None) -> list[str]:
        """Write the key as YAML without indentation."""
        comment = one_line("; ".join(self.remarks))
        if self.value is None and self.example is None:
            return self.below
        if self.value is None:
            described = model.model_fields[key].description if model else None
            comment = "; ".join(filter(None, [comment, (described or "").rstrip(".")]))
        text = f"{flow(key)}: {flow(self.value if self.value is not None else self.example)}"
        line = ("# " if self.value is None else "") + text + (f"  # {comment}" if comment else "")
        return [*([""] if self.blank else []), line, *self.below]


@dataclass(frozen=True)
class ManifestText:
    """The manifest, with short versions of its comments."""

    text: str
    missing: list[str]  # the flight cannot be ingested without it
    assumed: list[str]  # the flight can be ingested, but results depend on it


class _ManifestWriter:
    """Writer of a draft; collects what is missing and what is assumed, with the cameras that it concerns."""

    def __init__(self, draft: FlightDraft, relative: Callable[[Path], str]) -> None:
        self.draft = draft
        self._relative = relative
        self._log_names = {log.path: name for name, log in draft.logs.items()}
        self.missing: dict[str, list[str]] = {}
        self.assumed: dict[str, list[str]] = {}

    def assume(self, camera: CameraDraft | None, key: str, what: str) -> str:
        """Note that something is assumed; return the remark on it."""
        self.assumed.setdefault(f"{key}: {what}", []).extend([camera.name] if camera else [])
        return f"assumed: {what}"

    def miss(self, camera: CameraDraft | None, key: str, what: str) -> str:
        """Note that something is missing; return the remark on it."""
        self.missing.setdefault(f"{key}: {what}", []).extend([camera.name] if camera else [])
        return f"missing: {what}"

    def stated(self, settings: object) -> object:
        """Convert settings to the form in the manifest: relative paths, names of logs, a lone file bare."""
        if isinstance(settings, Path):
            return self._log_names.get(settings) or self._relative(settings)
        if not isinstance(settings, dict):
            return settings
        said = {key: self.stated(value) for key, value in settings.items() if value is not None}
        return said["file"] if said.keys() == {"file"} else said

    def guessed(self, settings: Mapping[str, object]) -> dict[str, object]:
        """Convert settings to the form in the manifest, as a guess."""
        value = self.stated(dict(settings))
        return {**(value if isinstance(value, dict) else {"file": value}), "assumed": True}

    def others(self, key: str, candidates: Sequence[Proposal]) -> list[str]:
        """List alternatives as comments."""
        lines = [
            f"# or {flow(key)}: {flow(self.stated(_settings(c)))}  # {one_line(c.about)}"
            for c in candidates[:MAX_LISTED]
        ]
        more = len(candidates) - len(lines)
        return [*lines, f"#   and {more} more"] if more else lines

    def entry(
        self, key: str, candidates: Sequence[Proposal], remarks: Sequence[str], settings: object = None
    ) -> DraftedKey:
        """Return the entry of the first candidate, a guess if a remark says so, with the others below it."""
        stated = settings if isinstance(settings, dict) else _settings(candidates[0])
        is_guess = any(remark.startswith("assumed") for remark in remarks)
        value = self.guessed(stated) if is_guess else self.stated(stated)
        return DraftedKey(value, [candidates[0].about, *remarks], self.others(key, candidates[1:]))

    # --- a camera --------------------------------------------------------------------------------------

    def camera(self, camera: CameraDraft) -> dict[str, DraftedKey]:
        """Return the entries of a camera by key."""
        entries = {
            "video": self._video(camera),
            "keypoints": self._keypoints(camera),
            **self._times(camera),
            "pose": self._pose(camera),
            "intrinsics": self._intrinsics(camera),
            **self._mount(camera),
        }
        return {key: entries[key] for key in CameraSources.model_fields if key in entries}

    def _video(self, camera: CameraDraft) -> DraftedKey:
        if videos := camera.pictures["video"]:
            what = "of the same camera as the keypoints"
            return self.entry("video", videos, [self.assume(camera, "video", what)] if camera.paired else [])
        if camera.pictures["keypoints"]:
            return DraftedKey()
        remark = self.miss(camera, "video", "a video, pictures of a log, or keypoints")
        return DraftedKey(None, [remark], example=f"{camera.name}.mp4")

    def _keypoints(self, camera: CameraDraft) -> DraftedKey:
        listed = camera.pictures["keypoints"]
        if not listed:
            return DraftedKey()
        first, remarks = listed[0], []
        settings = dict(first.settings)
        if isinstance(first, FoundFrames):
            if first.ambiguous:
                settings["format"] = first.ambiguous
                what = f"that they are {first.ambiguous}'s, for other formats recognise them too"
                remarks.append(self.assume(camera, "keypoints", what))
            if number := _first_frame(first, camera.film):
                settings["first_frame"] = number
                remarks.append(self.assume(camera, "keypoints", f"first_frame {number}"))
        return self.entry("keypoints", listed, remarks, settings)

    def _times(self, camera: CameraDraft) -> dict[str, DraftedKey]:
        choice, film = camera.choices.get("frame_times"), camera.film
        clock = DraftedKey(None, ["if its clock is off, or unsure"], example={"offset_s": 0, "sigma_s": 0.2})
        if choice:
            times = self.entry("frame_times", [choice.taken, *choice.others], [])
            return {"frame_times": times, "clock": clock}
        if camera.logged_film is not None:
            return {}  # the log's own stamps
        if film and film.clock == "none":
            remark = self.miss(camera, "frame_times", "the times of its pictures, which EXIF does not have")
            times = DraftedKey(None, [remark], example={"start": "SECONDS", "fps": USUAL_FPS[0]})
            return {"frame_times": times, "clock": clock}
        if (known := known_start(camera)) is not None:
            settings: dict[str, object] = {"start": (Decimal(known.start_ns) / 10**9).normalize()}
            if not known.sigma_s:
                return {"frame_times": DraftedKey(settings, [known.source]), "clock": clock}
            remark = self.assume(camera, "frame_times", f"start {known.source}, to {known.sigma_s:g} s")
            stated = DraftedKey({"offset_s": 0, "sigma_s": known.sigma_s}, [])
            return {"frame_times": DraftedKey(self.guessed(settings), [remark]), "clock": stated}
        if not film and not camera.pictures["keypoints"]:
            return {"clock": clock}
        start, reason = self._start(camera)
        if film and start is None:
            why = "when the first frame was taken, if not at 0"
            return {"frame_times": DraftedKey(None, [why], example={"start": "SECONDS"}), "clock": clock}
        settings = ({} if start is None else {"start": start}) | ({} if film else {"fps": _usual_fps(camera)})
        assumed = [] if film else [f"fps {_usual_fps(camera)}"]
        assumed.append("the first frame at 0 s" if start is None else f"start, {reason}")
        remark = self.assume(camera, "frame_times", ", ".join(assumed))
        return {"frame_times": DraftedKey(self.guessed(settings), [remark]), "clock": clock}

    def _start(self, camera: CameraDraft) -> tuple[Decimal | None, str]:
        """Assume the first frame's time in seconds: the start of poses and truth; None for 0."""
        pose = camera.choices.get("pose")
        poses = pose.taken.span if pose else None
        truth = next((joints.span for joints in self.draft.joints if joints.span), None)
        spans = {what: span for what, span in (("its poses", poses), ("the truth", truth)) if span}
        if poses and truth and poses.overlap_ns(truth) < 0:
            spans = {"its poses": poses}  # the truth has another zero of time
        length_ns = camera.film.length_ns if camera.film else _frames(camera) * 10**9 // _usual_fps(camera)
        filmed = TimeSpan(0, length_ns)
        if all(filmed.overlap_ns(span) >= 0 for span in spans.values()):
            return None, ""
        first_ns = max(span.first_ns for span in spans.values())
        return Decimal(-(-first_ns // 10**6)) / 1000, f"when {' and '.join(spans)} begin"

    # --- poses -----------------------------------------------------------------------------------------

    def _pose(self, camera: CameraDraft) -> DraftedKey:
        choice = camera.choices.get("pose")
        if choice is None:
            free = "no other file has poses"
            if self.draft.free_poses:
                free = "neither names nor times nor the motion in its pictures tell which of the poses below"
            remark = self.miss(camera, "pose", free)
            others = self.others("pose", self.draft.free_poses)
            films = [each for each in self.draft.cameras if each.film and "pose" not in each.choices]
            if 1 < len(films) == len(self.draft.cameras):
                others.append(
                    f"# or pose: {PICTURES}  # drones that fly about; say stature_m, frame_times.start"
                )
            return DraftedKey(None, [remark], others, example={"file": f"{camera.name}.tum"})
        taken, remarks = choice.taken, []
        if not choice.named:
            remarks.append(self.assume(camera, "pose", f"that these poses are its own {choice.why}".rstrip()))
        if taken.is_true:
            remarks.append(self.assume(camera, "pose", "what is called the truth, there is nothing else"))
        filmed = camera.logged_film.span if camera.logged_film else None
        if filmed and taken.span and filmed.overlap_ns(taken.span) < 0:
            remarks.append(self.miss(camera, "pose", f"poses of the time when it filmed, {filmed}"))
        if isinstance(taken, FlownPoses):
            if taken.height == "stated":
                what = "altitude in METRES above the take-off, for its log states no height"
                remarks.append(self.miss(camera, "pose", what))
            elif taken.states_altitude:
                other = "absolute" if taken.height != "unknown" else "relative"
                kind = "above the take-off" if other == "absolute" else "absolute, from a barometer"
                what = f"heights {kind} (altitude: {other} takes the other)"
                remarks.append(self.assume(camera, "pose", what))
            if taken.step_ns > BRIDGED_NS and not _is_turned_by_film(camera):
                step_s = taken.step_ns / 1e9
                gap = f"ingest with --max-pose-gap {1.5 * step_s:.3g}"
                remarks.append(f"a position every {step_s:.3g} s: {gap}")
        elif _is_of_body(camera) != taken.of_body:
            own = "body" if _is_of_body(camera) else "camera"
            remarks.append(self.assume(camera, "pose", f"poses of the {own}, as its pictures move"))
            return self.entry("pose", [taken, *choice.others], remarks, {**taken.settings, "of": own})
        elif taken.kind == "pose" and not taken.topic and "parent" not in taken.settings:
            remarks.append("if of the body, not the camera: add of: body, and a mount")
        if _is_turned_by_film(camera):
            remarks.append("no attitudes: the film says how the camera turned")
            turned = {**taken.settings, "attitude": PICTURES}
            return self.entry("pose", [taken, *choice.others], remarks, turned)
        if taken.ned_hint:
            what = (
                f"axes enu, although {flow(taken.ned_hint)} sounds like north-east-down: else add axes: ned"
            )
            remarks.append(self.assume(camera, "pose", what))
        return self.entry("pose", [taken, *choice.others], remarks)

    def _mount(self, camera: CameraDraft) -> dict[str, DraftedKey]:
        choice, gimbal = camera.choices.get("pose"), camera.choices.get("gimbal")
        if choice is None or choice.taken.kind == "still":
            return {}
        taken = choice.taken
        if _is_turned_by_film(camera):
            why = "in place of attitude: pictures, if the camera never turned"
            return {"gimbal": DraftedKey(None, [why], example={"yaw_deg": 90, "pitch_deg": -30})}
        example = {"looks": "forward", "translation": [0, 0, 0]}
        lever = DraftedKey(None, ["the lever arm to the gimbal, m"], example=example)
        if not (_is_of_body(camera) or taken.unturned):
            return {"mount": lever} if isinstance(taken, FlownPoses) else {}
        if gimbal is not None:
            return {"gimbal": self._gimbal(camera, gimbal), "mount": lever}
        if taken.unturned:
            what = "constant angles, from north to east and up, or a file and topic of angles"
            fixed = {"yaw_deg": 90, "pitch_deg": -30}
            return {"gimbal": DraftedKey(None, [self.miss(camera, "gimbal", what)], example=fixed)}
        return {"mount": self._fixed_mount(camera)}

    def _gimbal(self, camera: CameraDraft, gimbal: Chosen) -> DraftedKey:
        """Return the angles of a gimbal in a log; its pictures say what they are relative to, or the user."""
        others, reference = self.others("gimbal", gimbal.others), camera.gimbal_reference
        if reference is None:
            what = "relative_to, what its angles are relative to; order and units if not ypr and deg"
            turned = self.stated({**gimbal.taken.settings, "relative_to": "world"})
            return DraftedKey(None, [gimbal.taken.about, self.miss(camera, "gimbal", what)], others, turned)
        what = f"angles relative to the {reference}, which fits its pictures best or is the likeliest"
        stated = {**gimbal.taken.settings, "relative_to": reference}
        remarks = [gimbal.taken.about, self.assume(camera, "gimbal", what)]
        return DraftedKey(self.guessed(stated), remarks, others)

    def _fixed_mount(self, camera: CameraDraft) -> DraftedKey:
        down_deg = camera.motion.down_deg if camera.motion else 0
        tilt = f"{down_deg:g} deg down, as its pictures move" if down_deg else "level"
        remark = self.assume(camera, "mount", f"the camera looks forward, {tilt}, from the body's origin")
        angles = camera.unnamed_angles
        by_film = "# or, in place of the mount: pose: {..., attitude: pictures}"
        return DraftedKey(
            self.guessed({"looks": "forward", "down_deg": down_deg, "translation": [0, 0, 0]}),
            [remark],
            [by_film] * bool(camera.film) + self.others("gimbal", angles.all if angles else ()),
        )

    def _intrinsics(self, camera: CameraDraft) -> DraftedKey:
        choice = camera.choices.get("intrinsics")
        if choice is None and (guess := _lens(camera)) is not None:
            how = "by its pictures, to some 5 %" if camera.focal_by_film else "a guess without a calibration"
            what = f"a focal length of {camera.focal_35_mm:.3g} mm on film 36 mm wide, {how}"
            remark = what if camera.focal_by_film else self.assume(camera, "intrinsics", what)
            return DraftedKey(guess, [remark], self.others("intrinsics", self.draft.free_intrinsics))
        if choice is None:
            free = (
                "no name tells which of those below"
                if self.draft.free_intrinsics
                else "no other file has them"
            )
            remark = self.miss(camera, "intrinsics", free)
            numbers = {"width": 1920, "height": 1080, "fx": 1400, "fy": 1400, "cx": 959.5, "cy": 539.5}
            others = self.others("intrinsics", self.draft.free_intrinsics)
            return DraftedKey(None, [remark], others, example=numbers)
        what = choice.why or "that one calibration holds for them"
        remarks = [] if choice.named else [self.assume(camera, "intrinsics", what)]
        settings = choice.taken.settings
        if settings.get("camera") == camera.name:  # its own name need not be stated
            settings = {"file": choice.taken.path}
        return self.entry("intrinsics", [choice.taken, *choice.others], remarks, settings)

    # --- the flight ------------------------------------------------------------------------------------

    def world(self) -> DraftedKey:
        """Return the axes of the world, which trajectories and logs do not state."""
        taken = [c.choices["pose"].taken for c in self.draft.cameras if "pose" in c.choices]
        # Latitude and longitude leave no axes open; attitudes beside them do.
        open_axes = [c for c in taken if c.kind == "pose" and not (c.by_gps and c.unturned)]
        guessed = any(not isinstance(c, FlownPoses) for c in open_axes)
        origin = "#   origin: {latitude_deg: 0, longitude_deg: 0, altitude_m: 0}  # else the first position's"
        return DraftedKey(
            {"frame": "enu"} | ({"assumed": True} if guessed else {}),
            [self.assume(None, "world", "the poses have z up (x east, y north); or ned")] if guessed else [],
            [origin] if any(c.by_gps for c in taken) else [],
        )

    def logs(self) -> dict[str, DraftedKey]:
        """Return the logs that the rest of the manifest names."""
        poses = {c.choices["pose"].taken.path for c in self.draft.cameras if "pose" in c.choices}
        several = len(poses & set(self._log_names)) > 1
        if several:
            self.assume(None, "logs", "one clock and one origin for all; else say clock, world_from_source")
        entries = {}
        for name, log in self.draft.logs.items():
            paths = [self._relative(path) for path in log.parts]
            settings: dict[str, object] = {"file": paths[0] if len(paths) == 1 else paths}
            settings["stamps"] = log.stamps
            remarks = [f"{log.title}, {log.span}"]
            if log.stamps == "receive" or log.ahead_ns:
                what = f"stamps {log.stamps}, for header stamps and those of receipt are of different clocks"
                remarks.append(self.assume(None, "logs", what))
            if abs(log.ahead_ns) >= 10**9:
                side = "ahead of" if log.ahead_ns > 0 else "behind"
                remarks.append(f"header stamps are {abs(log.ahead_ns) / 1e9:.3f} s {side} receipt")
            if several or log.ahead_ns or log.stamps == "receive":
                settings["assumed"] = True
            entries[name] = DraftedKey(settings, remarks)
        return entries

    def actors(self) -> dict[str, DraftedKey]:
        """Return the sources of logged positions: of one person, or of several with other names."""
        if not self.draft.actors:
            return {}
        drones = [c.label for c in self.draft.cameras]
        drones += [c.choices["pose"].taken.labels[0] for c in self.draft.cameras if "pose" in c.choices]
        of_drones = {word.key for label in drones for word in label}
        people: dict[tuple[object, ...], Proposal] = {}
        for candidate in self.draft.actors:
            own = tuple(word.key for word in candidate.labels[0] if word.key not in of_drones)
            people.setdefault(own, candidate)
        remark = self.assume(None, "actor", "point hip, which the log follows; or head, feet, centre")
        taken = list(people.values())
        if len(taken) == 1:
            settings = {**taken[0].settings, "point": "hip"}
            entry = self.entry("actor", self.draft.actors, [remark], settings)
            return {"actor": replace(entry, blank=True)}
        names = camera_names([each.labels[0] for each in taken])
        stated = [self.guessed({**each.settings, "point": "hip"}) for each in taken]
        return {"actors": DraftedKey(dict(zip(names, stated, strict=True)), [remark], blank=True)}

    def map(self) -> DraftedKey:
        """Return the map: the first file, else a topic that lies where the poses do."""
        if not self.draft.maps:
            return DraftedKey()
        taken = self.draft.maps[0]
        remarks = (
            ["at a finer resolution_m it would be too large"] if "resolution_m" in taken.settings else []
        )
        on_earth = any(c.choices["pose"].taken.by_gps for c in self.draft.cameras if "pose" in c.choices)
        if taken.frame == "projected" and on_earth:
            remarks.append(self.miss(None, "map", "crs of its coordinates, a map projection: EPSG:32632"))
        if taken.topic and taken.unturned:
            return DraftedKey(None, [], self.others("map", self.draft.maps), blank=True)
        return replace(self.entry("map", self.draft.maps, remarks), blank=True)

    def truth(self) -> DraftedKey:
        """Return the truth; joints only if they overlap with poses in time, because ingest refuses others."""
        logged = [c.choices["pose"].taken.span for c in self.draft.cameras if "pose" in c.choices]
        spans = [span for span in logged if span]
        entry = DraftedKey(blank=True)
        known: dict[str, object] = {}
        for joints in self.draft.joints:
            meets = not spans or any(joints.span and joints.span.overlap_ns(s) >= 0 for s in spans)
            if meets and "file" not in known:
                known["file"] = joints.path
                axes = _AXES.get(joints.type, "y up")
                entry.remarks.append(f"{axes}; where it is not so: state unit and axes")
                continue
            shown = self.stated(joints.settings if meets else {**joints.settings, "offset_s": 0})
            why = "" if meets else ", when there are no poses: add offset_s to its times"
            entry.below.append(f"# or truth: {flow(shown)}  # {one_line(joints.about)}, {joints.span}{why}")
        poses = {c.name: c.true_poses.taken.path for c in self.draft.cameras if c.true_poses}
        if poses:
            known["poses"] = poses
        entry.value = self.stated(known) if known else None
        return entry

    def unused(self) -> list[str]:
        """List files that were recognised but are not used."""
        lines = ["", "# Recognised, but not used:"] if self.draft.unused else []
        for found in self.draft.unused:
            about = found.about if isinstance(found, Proposal) else found.title
            if isinstance(found, FoundLog):
                held = [t.topic or t.about for t in found.topics.values() if t.span]
                about += f" with {', '.join(held[:MAX_LISTED])}" if held else " without poses or pictures"
            elif found.kind == "joints":
                about += "; if known to be true: truth: FILE"
            lines.append(f"#   {flow(self._relative(found.path))}  ({one_line(about)})")
        return lines


def _is_of_body(camera: CameraDraft) -> bool:
    """Test if a camera's poses are those of its drone: by the motion in its pictures, else by their name."""
    taken, motion = camera.choices["pose"].taken, camera.motion
    if motion is None or motion.gimbal is not None or taken.unturned:
        return taken.of_body
    return motion.of_body


def _is_turned_by_film(camera: CameraDraft) -> bool:
    """Test if nothing but its film says how a camera turned."""
    choice = camera.choices.get("pose")
    filmed = camera.film is not None and "gimbal" not in camera.choices
    return choice is not None and choice.taken.unturned and filmed


def _lens(camera: CameraDraft) -> dict[str, object] | None:
    """Return the lens of a camera whose focal length is known without a calibration."""
    film, focal_35_mm = camera.film, camera.focal_35_mm
    if film is None or focal_35_mm is None:
        return None
    width, height = film.size
    focal_px = round(focal_35_mm / 36 * max(film.size), 1)
    size: dict[str, object] = {"width": width, "height": height, "fx": focal_px, "fy": focal_px}
    guessed = {} if camera.focal_by_film else {"assumed": True}
    return {**size, "cx": (width - 1) / 2, "cy": (height - 1) / 2, **guessed}


def _settings(candidate: Proposal) -> dict[str, object]:
    logged = candidate.kind == "pose" and ("topic" in candidate.settings or "parent" in candidate.settings)
    return {**candidate.settings, **({"of": "body" if candidate.of_body else "camera"} if logged else {})}


def _frames(camera: CameraDraft) -> int:
    """Return the number of frames that a camera's keypoints list."""
    return next((c.frames for c in camera.pictures["keypoints"] if isinstance(c, FoundFrames)), 0)


def _usual_fps(camera: CameraDraft) -> int:
    """Return the likeliest rate of keypoints: the first usual one at which they last as long as the poses."""
    poses = camera.choices["pose"].taken.span if "pose" in camera.choices else None
    for fps in USUAL_FPS:
        longer_ns = poses.length_ns - _frames(camera) * 10**9 / fps if poses else 0
        if poses and -UNCOVERED_NS <= longer_ns <= max(UNCOVERED_NS, poses.length_ns // 10):
            return fps
    return USUAL_FPS[0]


def _first_frame(listed: FoundFrames, film: FoundFilm | None) -> int:
    """Return the first frame's number if the numbers cannot count from 0; else 0."""
    if film is None:
        return listed.first_frame if listed.first_frame > listed.frames else 0
    fits = listed.last_frame - listed.first_frame < film.frames
    return listed.first_frame if listed.last_frame >= film.frames and fits else 0


def write_manifest(draft: FlightDraft, name: str, relative: Callable[[Path], str]) -> ManifestText:
    """Write the whole manifest of a draft; `relative` converts a path to the form in the manifest."""
    writer = _ManifestWriter(draft, relative)
    lines = [_HEAD, *DraftedKey(SCHEMA).lines("schema", None), *DraftedKey(name).lines("name", None)]
    lines += writer.world().lines("world", None)
    if draft.logs:
        lines += ["", "logs:"]
        lines += [f"  {line}" for key, log in writer.logs().items() for line in log.lines(key, None)]
    lines += ["", "cameras:"] if draft.cameras else ["", "# cameras:  # missing: one for each drone"]
    if not draft.cameras:
        writer.miss(None, "cameras", "nothing was found that has pictures, keypoints or poses of a drone")
    for camera in draft.cameras:
        lines.append(f"  {flow(camera.name)}:")
        for key, entry in writer.camera(camera).items():
            lines += [f"    {line}" for line in entry.lines(key, CameraSources)]
    for key, entry in {**writer.actors(), "map": writer.map(), "truth": writer.truth()}.items():
        lines += entry.lines(key, Manifest)
    lines += writer.unused()
    return ManifestText("\n".join(lines) + "\n", _in_short(writer.missing), _in_short(writer.assumed))


def _in_short(remarks: Mapping[str, list[str]]) -> list[str]:
    lines = []
    for what, names in remarks.items():
        shown = ", ".join(names[:MAX_LISTED]) + (", ..." if len(names) > MAX_LISTED else "")
        lines.append(f"{shown}: {what}" if shown else what)
    return lines
