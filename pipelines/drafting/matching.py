"""Matching of pictures, poses, calibrations and truth to cameras.

A camera is anything with pictures or keypoints. Every other candidate goes to the camera with the same name;
of several the one that overlaps in time with its film is taken, then the one of the likelier kind. The others
are listed as alternatives.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, get_args

import numpy as np

from pipelines.drafting.found import (
    ACTOR,
    COMMANDED,
    EQUAL,
    GIMBAL,
    NO_DATE_NS,
    NO_PICTURES,
    NUMBER,
    OTHER,
    PART,
    TRUTH_WORDS,
    UNNAMED,
    FlownPoses,
    FoundFilm,
    FoundFrames,
    FoundLog,
    Label,
    Proposal,
    TimeSpan,
    VideoStart,
    affinity,
    camera_names,
    choose_stamps,
    fitting,
    is_called,
    join_parts,
    order,
    unique,
)
from pipelines.drafting.motion import SIGNIFICANT_SIGMAS, explains_better, sigmas_above
from pipelines.geometry.arrays import Float, RelativeTo

# Two receivers on one drone state places that differ by less, m.
SAME_DRONE_M = 30.0

# Subtitles may lack this share of the frames of their own video.
MAX_MISSING_SUBTITLES = 0.1

# Focal lengths of one lens, measured by several films, differ by less.
SAME_LENS_SHARE = 0.1

LENSES_35_MM = {
    24: "drones since 2018",
    28: "Mavic Pro, Mavic 2 Pro, older drones",
    35: "longer lenses",
    18: "action cameras",
}
"""Focal lengths of usual cameras, as on film 36 mm wide; the first is the likeliest."""

MAP_TYPES = ("Octomap", "GridMap", "OccupancyGrid")
"""Types of whole maps, the preferred first; clouds of points are seldom in the frame of the poses."""


@dataclass(frozen=True)
class MotionMatch:
    """Agreement of a video with poses, by their motion."""

    gain: Float  # [S] log-likelihood of each stretch of the video, over a camera that stands still
    start_ns: int  # of the video, on the log's clock
    gimbal: Proposal | None = None  # the angles that turn the camera, if any do
    relative_to: RelativeTo = "world"  # what these angles are relative to
    of_body: bool = False  # the poses are the body's and a mount turns the camera
    down_deg: float = 0.0  # its tilt


Compare = Callable[[FoundFilm, Proposal, Sequence[Proposal]], MotionMatch | None]
"""Comparison of a video with poses, and with angles of gimbals; None if one of them shows no motion."""
FocalByFilm = Callable[[FoundFilm, Proposal, int], float | None]
"""Focal length (as on film 36 mm wide) that a video shows with poses and its start; None if it shows none."""
Distance = Callable[[FlownPoses, FlownPoses], float | None]
"""Median distance across (m) of the positions in two drones' logs; None if they share no time or place."""


@dataclass(frozen=True)
class Question:
    """Question to the user about a key of cameras, with its possible values, the likeliest first."""

    cameras: tuple[str, ...]
    key: str
    options: tuple[str, ...]


class Answer(NamedTuple):
    """An option of a question; `stated` if a person chose it, else it is an assumption."""

    option: int
    stated: bool


Ask = Callable[[Question], Answer | None]
"""Answer to a question; None leaves it open."""


def leave_open(_: Question) -> None:
    """Leave a question open: what nothing tells is missing."""


@dataclass(frozen=True)
class Chosen:
    """The candidate that was taken, and its alternatives."""

    taken: Proposal
    others: tuple[Proposal, ...] = ()
    named: bool = True  # False: it is the only one there is, or `why` says how it was found
    why: str = ""
    start_ns: int | None = None  # of the video, if that was found with it

    @property
    def all(self) -> tuple[Proposal, ...]:
        """It and its alternatives."""
        return (self.taken, *self.others)


@dataclass(eq=False)
class CameraDraft:
    """One camera with the candidates that belong to it, by part of the manifest."""

    label: Label
    name: str = ""
    pictures: dict[str, list[Proposal]] = field(default_factory=lambda: {"video": [], "keypoints": []})
    paired: bool = False  # video and keypoints are matched only because nothing else is left
    choices: dict[str, Chosen] = field(default_factory=dict)
    unnamed_angles: Chosen | None = None  # beside its poses, which no name calls those of a gimbal
    gimbal_reference: RelativeTo | None = None  # what its gimbal's angles are relative to
    motion: MotionMatch | None = None  # of its video and poses, where they agree
    likely: dict[int, float] = field(default_factory=dict)  # gain of motion by id of poses
    focal_35_mm: float | None = None  # as on film 36 mm wide, where no calibration has it
    focal_by_film: bool = False  # its pictures determine it
    true_poses: Chosen | None = None

    @property
    def film(self) -> FoundFilm | None:
        """The video file or folder of pictures."""
        first = next(iter(self.pictures["video"]), None)
        return first if isinstance(first, FoundFilm) else None

    @property
    def logged_film(self) -> Proposal | None:
        """The pictures in a log."""
        first = next(iter(self.pictures["video"]), None)
        return None if isinstance(first, FoundFilm) else first

    def mentioned(self) -> list[Proposal]:
        """List every candidate that the manifest mentions for it, also those in comments."""
        choices = [*self.choices.values(), *([self.true_poses] if self.true_poses else [])]
        listed = [*self.pictures["video"], *self.pictures["keypoints"]]
        return listed + [c for choice in choices for c in choice.all]


@dataclass(frozen=True)
class FlightDraft:
    """A flight as far as it is known from what was found."""

    logs: dict[str, FoundLog]  # those that are used, by their name in the manifest
    cameras: list[CameraDraft]
    joints: list[Proposal]  # true ones; the first is taken
    actors: list[Proposal]  # the first is taken
    maps: list[Proposal]  # the first is taken if it lies where the poses do, or is a file
    free_poses: list[Proposal]  # of moving things, that no camera has
    free_intrinsics: list[Proposal]
    unused: list[Proposal | FoundLog]


def match(
    found: Sequence[Proposal],
    recordings: Sequence[FoundLog],
    compare: Compare,
    focal_by_film: FocalByFilm,
    distance: Distance,
    ask: Ask,
) -> FlightDraft:
    """Find the cameras, and what belongs to each.

    `compare` decides where neither names nor times do, `distance` between logs of one time, for cameras whose
    own positions lack attitudes, `focal_by_film` what no calibration tells, and `ask` what nothing else does.
    """
    logs = choose_stamps(join_parts(recordings))
    every = [*found, *(candidate for log in logs for candidate in log.candidates())]
    of: dict[str, list[Proposal]] = {}
    for candidate in every:
        of.setdefault(candidate.kind, []).append(candidate)
    of = {kind: _with_own_words(alike) for kind, alike in of.items()}
    poses = of.get("pose", [])
    true = [replace(c, is_true=True) for c in poses if _is_true(c)]
    actors = [c for c in poses if c.topic and is_called(c.topic, ACTOR)]
    moving = [c for c in poses if not _is_true(c) and not (c.topic and is_called(c.topic, ACTOR | COMMANDED))]
    joints = [c for c in of.get("joints", []) if _is_true(c)]
    joints.sort(key=lambda c: (-_shared([c.span], _spans(moving)), c.place))
    # Three numbers of other names are magnetic fields and velocities, and quaternions may be attitudes.
    turning = [c for c in of.get("gimbal", []) if is_called(c.topic, GIMBAL) or "Quaternion" in c.type]
    gimbals = [c for c in turning if is_called(c.topic, GIMBAL)]
    cameras = _cameras(of, moving)
    anchors = [*moving, *of.get("joints", [])]

    for camera in cameras:
        choose = _Chooser(camera, cameras, anchors)
        chosen = _beside(choose(moving), choose(of.get("still", [])))
        pose = chosen or choose(true)
        if chosen is not None:
            camera.true_poses = choose([c for c in true if not c.topic])
        turned = None
        if pose and (pose.taken.of_body or pose.taken.unturned):
            turned = choose(gimbals) or _beside_pose(pose.taken, gimbals, moving)
        found_choices = {
            "pose": pose,
            "intrinsics": choose(of.get("intrinsics", []), shared=True),
            "frame_times": _own_stamps(camera, choose(of.get("frame_times", [])), moving),
            "gimbal": turned,
        }
        camera.choices = {part: choice for part, choice in found_choices.items() if choice is not None}
        if turned is None and pose and pose.taken.of_body:
            camera.unnamed_angles = _beside_pose(pose.taken, turning, moving)
    _pair_by_content(cameras, moving, gimbals, turning, compare)
    _prefer_attitudes(cameras, moving, distance)
    for camera in cameras:
        logged = camera.choices.get("pose")
        if logged is not None and "intrinsics" not in camera.choices:
            beside = _beside_pose(logged.taken, of.get("intrinsics", []), moving)
            camera.choices |= {"intrinsics": beside} if beside else {}
    _pair_the_last_lens(cameras, of.get("intrinsics", []))
    for camera in cameras:
        _ask_for_the_rest(camera, cameras, moving, gimbals, of.get("intrinsics", []), compare, ask)
    _find_lenses(
        [c for c in cameras if c.film is not None and "intrinsics" not in c.choices], of, focal_by_film, ask
    )
    if any("pose" in c.choices and c.choices["pose"].taken.by_gps for c in cameras):
        actors += [c for c in of.get("fixes", []) if is_called(f"{c.topic} {c.place[-1]}", ACTOR)]
    maps = _maps(of.get("map", []), cameras)
    mentioned = [c for camera in cameras for c in camera.mentioned()]
    used = {c.path for c in (*mentioned, *actors, *maps, *joints)}
    names: list[str] = []
    for log in logs:
        label = "_".join(word.text for word in log.label)
        names.append(unique(fitting(label, fitting(log.place[-1], "log")), names))
    unused: dict[object, Proposal | FoundLog] = {c.path: c for c in found if c.path not in used}
    unused |= {log.path: log for log in logs if log.path not in used}
    return FlightDraft(
        {name: log for name, log in zip(names, logs, strict=True) if log.path in used},
        cameras,
        joints,
        actors,
        maps,
        free_poses=sorted((c for c in moving if c not in mentioned), key=lambda c: (c.place, c.rank)),
        free_intrinsics=[c for c in of.get("intrinsics", []) if c not in mentioned],
        unused=sorted(unused.values(), key=lambda each: each.place),
    )


def _with_own_words(alike: Sequence[Proposal]) -> list[Proposal]:
    """Add labels without words that all things of a kind share: vio_west, vio_east are west and east."""
    labels = {candidate.labels[0] for candidate in alike}
    names = [{word.key for word in label if word.number is None} for label in labels]
    shared = set[object]().union(*names[:1]).intersection(*names)
    own = {label: tuple(word for word in label if word.key not in shared) for label in labels}
    if not shared or not all(own.values()):
        return list(alike)
    return [replace(candidate, labels=(*candidate.labels, own[candidate.labels[0]])) for candidate in alike]


def _is_true(candidate: Proposal) -> bool:
    """Test if a thing's name, or that of a folder above it, says that it is the truth."""
    names = (candidate.topic,) if candidate.topic else candidate.place
    return any(is_called(name, TRUTH_WORDS) for name in names)


def _own_stamps(camera: CameraDraft, choice: Chosen | None, moving: Sequence[Proposal]) -> Chosen | None:
    """Leave out frame times of a video that are not clearly its own: one without its name, or subtitles."""
    film = camera.film
    if choice is None or camera.logged_film is not None or film is None:
        return None if camera.logged_film is not None else choice
    stamps = choice.taken
    if (
        max(affinity(own, camera.label) for own in stamps.labels) >= NUMBER
        or stamps.path.suffix.lower() != ".srt"
    ):
        return choice
    clocked = any(isinstance(log, FlownPoses) and log.path == film.path for log in moving)
    missing = abs(stamps.frames - film.frames) if isinstance(stamps, FoundFrames) else 0
    return None if clocked or missing > MAX_MISSING_SUBTITLES * film.frames else choice


def _maps(maps: Sequence[Proposal], cameras: Sequence[CameraDraft]) -> list[Proposal]:
    """Sort maps: files, then topics in the frame of a camera's poses in the same log, then the others."""
    poses = [choice.taken for c in cameras if (choice := c.choices.get("pose"))]
    frames = {(pose.path, pose.frame) for pose in poses}
    found = []
    for candidate in maps:
        type_ = candidate.type.rpartition("/")[2]
        placed = not candidate.topic or (type_ in MAP_TYPES and (candidate.path, candidate.frame) in frames)
        likelihood = MAP_TYPES.index(type_) if type_ in MAP_TYPES else len(MAP_TYPES)
        rank = (bool(candidate.topic), not placed, likelihood, *candidate.rank)
        found.append(replace(candidate, rank=rank, unturned=not placed))
    return sorted(found, key=lambda candidate: candidate.rank)


# --- cameras -------------------------------------------------------------------------------------------


def _cameras(of: dict[str, list[Proposal]], moving: Sequence[Proposal]) -> list[CameraDraft]:
    cameras: list[CameraDraft] = []
    videos = of.get("video", [])
    coloured = [c for c in videos if not (c.topic and is_called(c.topic, NO_PICTURES))]
    together = Counter(c.path.parent for c in of.get("keypoints", []))
    detected = [replace(c, rank=(-together[c.path.parent], c.place)) for c in of.get("keypoints", [])]
    for candidate in [*sorted(coloured or videos, key=_by_name), *sorted(detected, key=_by_name)]:
        _home(cameras, candidate).pictures[candidate.kind].append(candidate)
    _pair_the_last(cameras)
    if not cameras:
        for poses in sorted(moving, key=_by_name):
            if not any(_same(camera.label, poses) for camera in cameras):
                cameras.append(CameraDraft(poses.labels[0]))
    cameras.sort(key=lambda camera: order(camera.label))
    for camera, name in zip(cameras, camera_names([camera.label for camera in cameras]), strict=True):
        camera.name = name
        for candidates in camera.pictures.values():
            candidates.sort(key=lambda candidate: candidate.rank)
    return cameras


def _by_name(candidate: Proposal) -> tuple[object, ...]:
    return bool(candidate.topic), order(candidate.labels[0]), candidate.rank


def _same(label: Label, candidate: Proposal) -> bool:
    return _likeness(candidate, label) == EQUAL or label == candidate.labels[0]


def _likeness(candidate: Proposal, label: Label) -> int:
    return max(affinity(own, label) for own in candidate.labels)


def _home(cameras: list[CameraDraft], candidate: Proposal) -> CameraDraft:
    """Find or add the camera of some pictures: one of the same name, or a similar one without pictures."""
    label = candidate.labels[0]
    for camera in cameras:
        if _same(camera.label, candidate):
            return camera
    for least in (PART, NUMBER):
        fits = [
            c for c in cameras if not c.pictures[candidate.kind] and _likeness(candidate, c.label) >= least
        ]
        if len(fits) == 1:
            fits[0].label = max(fits[0].label, label, key=len)
            return fits[0]
    cameras.append(CameraDraft(label))
    return cameras[-1]


def _pair_the_last(cameras: list[CameraDraft]) -> None:
    """Join one video and one keypoint file if both are the only ones without a partner."""
    filmed = [camera for camera in cameras if not camera.pictures["keypoints"]]
    detected = [camera for camera in cameras if not camera.pictures["video"]]
    if len(filmed) == len(detected) == 1 and not _are_two(filmed[0].label, detected[0].label):
        filmed[0].pictures["keypoints"], filmed[0].paired = detected[0].pictures["keypoints"], True
        filmed[0].label = filmed[0].label or detected[0].label
        cameras.remove(detected[0])


def _pair_the_last_lens(cameras: Sequence[CameraDraft], intrinsics: Sequence[Proposal]) -> None:
    """Give the only camera without a calibration the only one that no other camera has."""
    wanting = [camera for camera in cameras if "intrinsics" not in camera.choices]
    taken = [choice.taken for camera in cameras if (choice := camera.choices.get("intrinsics"))]
    free = [lens for lens in intrinsics if lens not in taken]
    if len(wanting) == len(free) == 1:
        wanting[0].choices["intrinsics"] = Chosen(free[0], named=False, why="that the last one is its own")


def _are_two(one: Label, other: Label) -> bool:
    """Test if labels share a word, as those of two drones do: drone 1, drone 2."""
    return bool({word.word for word in one} & {word.word for word in other})


# --- what belongs to a camera ---------------------------------------------------------------------------


def _pair_by_content(
    cameras: Sequence[CameraDraft],
    moving: Sequence[Proposal],
    gimbals: Sequence[Proposal],
    turning: Sequence[Proposal],
    compare: Compare,
) -> None:
    """Give videos without poses those that no camera has, by time, else by motion, which tells the start."""
    taken = _taken(cameras)
    likeliest: dict[object, Proposal] = {}  # of several topics of one drone
    for candidate in moving:
        if candidate not in taken:
            key = candidate.path, candidate.labels[0], candidate.settings.get("instance")
            likeliest[key] = min(likeliest.get(key, candidate), candidate, key=lambda each: each.rank)
    filmed = [(c, film) for c in cameras if "pose" not in c.choices and (film := c.film) is not None]
    possible = {c.name: [log for log in likeliest.values() if _may_be_of(film, log)] for c, film in filmed}
    uses = Counter(id(log) for logs in possible.values() for log in logs)
    found: dict[str, tuple[Proposal, MotionMatch, float]] = {}
    for camera, film in filmed:
        logs = possible[camera.name]
        if len(logs) == 1 and uses[id(logs[0])] == 1:
            camera.choices["pose"] = Chosen(logs[0], named=False, why="by the times of video and log")
            if gimbal := _beside_pose(logs[0], gimbals, moving):
                camera.choices["gimbal"] = gimbal
            elif logs[0].of_body:
                camera.unnamed_angles = _beside_pose(logs[0], turning, moving)
            continue
        turned = [
            (log, _beside_pose(log, gimbals, moving) or _beside_pose(log, turning, moving)) for log in logs
        ]
        compared = [(log, compare(film, log, beside.all if beside else ())) for log, beside in turned]
        known = [(log, alike) for log, alike in compared if alike is not None]
        camera.likely = {id(log): float(np.nansum(alike.gain)) for log, alike in known}
        if (own := _own_by_motion(known)) is not None:
            found[camera.name] = own
    for camera, _ in filmed:
        motion = found.get(camera.name)
        if motion is not None and sum(motion[0] is log for log, *_ in found.values()) == 1:
            log, alike, sigmas = motion
            why = f"by the motion in its pictures, {sigmas:.0f} sigma above all else"
            camera.choices["pose"] = Chosen(log, named=False, why=why, start_ns=alike.start_ns)
            camera.motion = alike
            if alike.gimbal is not None:
                camera.choices["gimbal"] = Chosen(alike.gimbal)
                camera.gimbal_reference = alike.relative_to
            elif log.of_body:
                camera.unnamed_angles = _beside_pose(log, turning, moving)
    for camera in cameras:
        _settle_by_motion(camera, compare)


def _settle_by_motion(camera: CameraDraft, compare: Compare) -> None:
    """Find the start of a video with known poses, and what the angles of its gimbal are relative to."""
    choices, film = camera.choices, camera.film
    if film is None or "pose" not in choices or choices["pose"].start_ns is not None:
        return
    pose, gimbal = choices["pose"], choices.get("gimbal")
    unnamed = camera.unnamed_angles.all if camera.unnamed_angles else ()
    timed = "frame_times" in choices or pose.taken.path == film.path
    if timed and gimbal is None and not pose.taken.of_body:
        return
    alike = compare(film, pose.taken, [gimbal.taken] if gimbal else unnamed)
    if alike is None or not explains_better(alike.gain, np.zeros_like(alike.gain)):
        return
    camera.motion = alike
    if alike.gimbal is not None:
        choices.setdefault("gimbal", Chosen(alike.gimbal))
        camera.gimbal_reference = alike.relative_to
    if not timed:
        choices["pose"] = replace(pose, start_ns=alike.start_ns)


def _ask_for_the_rest(
    camera: CameraDraft,
    cameras: Sequence[CameraDraft],
    moving: Sequence[Proposal],
    gimbals: Sequence[Proposal],
    intrinsics: Sequence[Proposal],
    compare: Compare,
    ask: Ask,
) -> None:
    """Ask for what neither names nor contents tell; what explains the motion in the pictures is likeliest."""
    film, taken = camera.film, [c.choices["pose"].taken for c in cameras if "pose" in c.choices]
    free = [c for c in moving if c not in taken and (film is None or _may_be_of(film, c))]
    for key, candidates in (("pose", free), ("intrinsics", intrinsics)):
        used = [c.choices[key].taken for c in cameras if key in c.choices]

        def unlikely(each: Proposal, used: Sequence[Proposal] = used) -> tuple[object, ...]:
            return each in used, -camera.likely.get(id(each), 0.0), each.rank, each.place

        listed = sorted(candidates, key=unlikely)
        if key in camera.choices or not listed:
            continue
        titles = [(c.path.name, c.topic or str(c.settings.get("camera", "")), f"({c.about})") for c in listed]
        options = tuple(" ".join(filter(None, each)) for each in titles)
        if (answer := ask(Question((camera.name,), key, options))) is not None:
            others = tuple(c for k, c in enumerate(listed) if k != answer.option)
            why = "for nothing else is as likely"
            camera.choices[key] = Chosen(listed[answer.option], others, answer.stated, why)
            if key == "pose":
                if turning := _beside_pose(listed[answer.option], gimbals, moving):
                    camera.choices["gimbal"] = turning
                _settle_by_motion(camera, compare)
    if "gimbal" in camera.choices and camera.gimbal_reference is None:
        references: tuple[RelativeTo, ...] = get_args(RelativeTo)
        options = tuple(f"angles relative to the {each}" for each in references)
        if (answer := ask(Question((camera.name,), "gimbal", options))) is not None:
            camera.gimbal_reference = references[answer.option]


def _find_lenses(
    cameras: Sequence[CameraDraft], of: Mapping[str, Sequence[Proposal]], focal_by_film: FocalByFilm, ask: Ask
) -> None:
    """Find focal lengths without a calibration: by pictures, else by subtitles or EXIF, else by asking."""
    flown = [c for c in of.get("pose", []) if isinstance(c, FlownPoses) and c.focal_35_mm]
    stated = {c.labels: c.focal_35_mm for c in flown}
    for camera in cameras:
        pose = camera.choices["pose"].taken if "pose" in camera.choices else None
        if camera.film is not None:
            camera.focal_35_mm = stated.get(camera.film.labels, camera.film.focal_35_mm)
        if isinstance(pose, FlownPoses) and pose.focal_35_mm:
            camera.focal_35_mm = pose.focal_35_mm
    _measure_lenses(cameras, focal_by_film)
    unknown = [camera for camera in cameras if camera.focal_35_mm is None]
    if not unknown or of.get("intrinsics"):
        return
    options = tuple(f"{focal} mm on film 36 mm wide ({who})" for focal, who in LENSES_35_MM.items())
    if (answer := ask(Question(tuple(c.name for c in unknown), "intrinsics", options))) is not None:
        for camera in unknown:
            camera.focal_35_mm = list(LENSES_35_MM)[answer.option]


def _measure_lenses(cameras: Sequence[CameraDraft], focal_by_film: FocalByFilm) -> None:
    """Measure focal lengths by films with poses. Films of one size are of one kind of camera."""
    measured: dict[str, float] = {}
    for camera in cameras:
        pose, film, start = camera.choices.get("pose"), camera.film, known_start(camera)
        start_ns = start.start_ns if start else None
        times = camera.choices.get("frame_times")
        if pose and times and times.taken.path == pose.taken.path and pose.taken.span:  # subtitles have both
            start_ns = pose.taken.span.first_ns
        if pose is not None and film is not None and start_ns is not None:
            focal_35_mm = focal_by_film(film, pose.taken, start_ns)
            measured |= {} if focal_35_mm is None else {camera.name: focal_35_mm}
    for camera in cameras:
        size = camera.film.size if camera.film else None
        alike = [measured[c.name] for c in cameras if c.name in measured and c.film and c.film.size == size]
        if alike:
            usual = float(np.median(alike))
            # What a file states of a camera counts more than the films of others: it may be of another kind.
            own = measured.get(camera.name, camera.focal_35_mm or usual)
            is_alike = abs(own - usual) < SAME_LENS_SHARE * usual
            camera.focal_35_mm = usual if is_alike else own
            camera.focal_by_film = is_alike or camera.name in measured


def known_start(camera: CameraDraft) -> VideoStart | None:
    """Return a video's start by the log of its poses, or by its own metadata if the log covers it then."""
    film, choice = camera.film, camera.choices.get("pose")
    if film is None or choice is None:
        return None
    taken = choice.taken
    if choice.start_ns is not None:
        return VideoStart(choice.start_ns, "when its pictures move as its poses", sigma_s=0.2)
    for candidate in (taken, *choice.others):  # poses of another log, the clock of its own
        start = candidate.video_start if isinstance(candidate, FlownPoses) else None
        if start and candidate.path == film.path and (candidate is taken or start.start_ns > NO_DATE_NS):
            return start
    if isinstance(taken, FlownPoses):
        if taken.video_start is not None and taken.path.suffix.lower() == ".srt":
            return taken.video_start
        if (recorded := taken.film_of(film)) is not None:
            source = "when the flight record says that a video began"
            return VideoStart(recorded.first_ns, source, sigma_s=1)
    if film.made_ns is None or taken.span is None:
        return None
    if film.path.is_dir() and taken.path == film.path:
        whole = film.clock == "whole seconds"
        return VideoStart(film.made_ns, "by the EXIF of its pictures", sigma_s=1 if whole else 0)
    if taken.span.overlap_ns(TimeSpan(film.made_ns, film.made_ns + film.length_ns)) < film.length_ns:
        return None
    return VideoStart(film.made_ns, "by the time of creation in its metadata", sigma_s=1)


def _beside_pose(pose: Proposal, candidates: Sequence[Proposal], moving: Sequence[Proposal]) -> Chosen | None:
    """Choose what a log has of the name of a topic of poses in it; of any name where one drone logged."""
    alike = [(_likeness(c, pose.labels[0]), c) for c in candidates if c.topic and c.path == pose.path]
    own = [(likeness, c) for likeness, c in alike if likeness >= NUMBER]
    drones = {tuple(word.key for word in c.labels[0]) for c in moving if c.path == pose.path}
    ranked = sorted(own or (alike if len(drones) == 1 else ()), key=lambda each: (-each[0], each[1].rank))
    return Chosen(ranked[0][1], tuple(c for _, c in ranked[1:])) if ranked else None


def _taken(cameras: Sequence[CameraDraft]) -> list[Proposal]:
    chosen = [choice for camera in cameras if (choice := camera.choices.get("pose"))]
    return [c for choice in chosen for c in choice.all]


def _prefer_attitudes(cameras: Sequence[CameraDraft], moving: Sequence[Proposal], distance: Distance) -> None:
    """Give cameras whose poses lack attitudes the log that has them at that time, if just one does."""
    taken = _taken(cameras)
    free: dict[object, Proposal] = {}
    for candidate in moving:
        if not (candidate.unturned or candidate.span is None or candidate in taken):
            key = candidate.path, candidate.settings.get("instance")
            free[key] = min(free.get(key, candidate), candidate, key=lambda each: each.rank)
    wanting = [
        (c, pose)
        for c in cameras
        if (pose := c.choices.get("pose")) and pose.taken.unturned and not c.choices.get("gimbal")
    ]
    fitting_logs = {
        c.name: _nearest([log for log in free.values() if _is_of_film(log, c)], pose.taken, distance)
        for c, pose in wanting
    }
    uses = Counter(id(log) for logs in fitting_logs.values() for log in logs)
    for camera, choice in wanting:
        logs = fitting_logs[camera.name]
        if len(logs) != 1 or uses[id(logs[0])] != 1:
            camera.choices["pose"] = replace(choice, others=(*choice.others, *free.values()))
            continue
        if not _share_time(logs[0], choice.taken):
            camera.choices.pop("frame_times", None)  # of another clock
        why = "by time and place, for what has its name has no attitudes"
        camera.choices["pose"] = Chosen(logs[0], (choice.taken, *choice.others), named=False, why=why)


def _nearest(logs: Sequence[Proposal], own: Proposal, distance: Distance) -> list[Proposal]:
    """Leave out logs that were elsewhere than a camera's own positions; of several, keep a clear nearest."""
    near: list[tuple[float, Proposal]] = []
    unknown: list[Proposal] = []
    for log in logs:
        apart_m = distance(own, log) if isinstance(own, FlownPoses) and isinstance(log, FlownPoses) else None
        if apart_m is None:
            unknown.append(log)
        elif apart_m < SAME_DRONE_M:
            near.append((apart_m, log))
    near.sort(key=lambda pair: pair[0])
    if len(near) > 1 and not unknown and 2 * near[0][0] < near[1][0]:
        return [near[0][1]]
    return [*(log for _, log in near), *unknown]


def _is_of_film(log: Proposal, camera: CameraDraft) -> bool:
    """Test if a log shares the time of a camera's poses, or recorded one video of its video's length."""
    pose, film = camera.choices.get("pose"), camera.film
    if pose and _share_time(log, pose.taken):
        return True
    return film is not None and isinstance(log, FlownPoses) and log.film_of(film) is not None


def _share_time(log: Proposal, other: Proposal) -> bool:
    """Test if a log has dates and covers half of another one."""
    if log.span is None or other.span is None or min(log.span.first_ns, other.span.first_ns) < NO_DATE_NS:
        return False
    return 2 * log.span.overlap_ns(other.span) >= other.span.length_ns


def _own_by_motion(
    known: Sequence[tuple[Proposal, MotionMatch]],
) -> tuple[Proposal, MotionMatch, float] | None:
    """Return the log that explains a video's motion clearly better than all others, and how clearly."""
    for log, alike in known:
        others = [other.gain for each, other in known if each is not log]
        sigmas = min(sigmas_above(alike.gain, other) for other in (np.zeros_like(alike.gain), *others))
        if sigmas > SIGNIFICANT_SIGMAS:
            return log, alike, sigmas
    return None


def _may_be_of(film: FoundFilm, log: Proposal) -> bool:
    """Test if a log covers half of a video; its metadata have the time when it began, or when it ended."""
    if film.made_ns is None or log.span is None or log.span.first_ns < NO_DATE_NS:
        return True
    filmed = TimeSpan(film.made_ns, film.made_ns + film.length_ns)
    overlap_ns = max(log.span.overlap_ns(each) for each in (filmed, filmed.later(-film.length_ns)))
    return 2 * overlap_ns >= film.length_ns


@dataclass(frozen=True)
class _Chooser:
    """Chooser of candidates of one kind for one camera; `anchors` define the time of the flight."""

    camera: CameraDraft
    cameras: Sequence[CameraDraft]
    anchors: Sequence[Proposal]

    def __call__(self, candidates: Sequence[Proposal], *, shared: bool = False) -> Chosen | None:
        """Choose the best candidate with the camera's name; or the only one, for the only camera."""
        lone = len(self.cameras) == 1
        likeness = {id(c): _likeness(c, self.camera.label) for c in candidates}
        least = UNNAMED if lone or shared else NUMBER
        rivals = [c for c in candidates if likeness[id(c)] >= least]
        # The only candidate is taken, and for a lone camera the likeliest topic of the only log.
        one_log = lone and len({c.path for c in candidates if c.topic or "parent" in c.settings}) == 1
        one_log &= all(c.topic or "parent" in c.settings for c in candidates)
        if not rivals and (one_log or (len(candidates) == 1 and (lone or shared))):
            own = self.camera.label
            rivals = [c for c in candidates if not any(_are_two(own, label) for label in c.labels)]
        if not rivals:
            return None
        # A candidate with the camera's name excludes those without. How exactly the name matches matters less
        # than time.
        level = min(PART, max(likeness[id(c)] for c in rivals))
        rivals = [c for c in rivals if likeness[id(c)] >= level]
        times = self._times(rivals)

        def key(rival: Proposal) -> tuple[object, ...]:
            # A log that began a second earlier is as good as another; one of another flight is not.
            elsewhere = 2 * times[id(rival)] < max(times.values())
            return elsewhere, -likeness[id(rival)], -self._near(rival), rival.rank

        taken, *others = sorted(rivals, key=key)
        best = likeness[id(taken)]
        return Chosen(taken, tuple(others), named=best >= NUMBER or (lone and best != OTHER))

    def _near(self, candidate: Proposal) -> int:
        """Count the leading name parts that a camera info shares with the topic of the pictures."""
        logged = self.camera.logged_film
        if candidate.kind != "intrinsics" or not candidate.topic or logged is None:
            return 0
        names = [[*each.topic.strip("/").split("/"), ""] for each in (candidate, logged)]
        return next(k for k, pair in enumerate(zip(*names, strict=False)) if len({*pair}) > 1 or "" in pair)

    def _times(self, rivals: Sequence[Proposal]) -> dict[int, float]:
        """Compute how long each overlaps in time with the camera's film, or else with the other logs."""
        filmed = self.camera.logged_film
        others = [anchor for anchor in self.anchors if all(anchor is not rival for rival in rivals)]
        anchors = [filmed.span] if filmed and filmed.span else _spans(others)
        return {id(rival): _shared([rival.span], anchors) for rival in rivals}


def _shared(spans: Iterable[TimeSpan | None], anchors: Iterable[TimeSpan]) -> float:
    return float(sum(max(span.overlap_ns(anchor), 0) for anchor in anchors for span in spans if span))


def _spans(candidates: Iterable[Proposal]) -> list[TimeSpan]:
    return [candidate.span for candidate in candidates if candidate.span]


def _beside(first: Chosen | None, second: Chosen | None) -> Chosen | None:
    if first is None or second is None:
        return first or second
    return Chosen(first.taken, (*first.others, second.taken, *second.others), first.named)
