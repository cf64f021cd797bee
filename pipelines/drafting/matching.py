"""Matching of pictures, poses, calibrations and truth to cameras.

A camera is anything with pictures: a video, keypoints, a topic with pictures. Every other thing that a
manifest can state is a candidate, and goes to the camera with the same name. If there are several for a
camera, the one that overlaps in time with its film is taken, then the one of the likelier kind. The others
are kept and listed as alternatives.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.drafting.found import (
    Angles,
    Calibration,
    DroneLog,
    Findings,
    Found,
    FrameTimes,
    Joints,
    Keypoints,
    Map,
    Poses,
    Recording,
    Span,
    TopicFound,
    TopicKind,
    Video,
    chains,
    joined,
    label_of_recording,
    label_of_topic,
    with_stamps,
)
from pipelines.drafting.labels import (
    ACTOR,
    COMMANDED,
    EQUAL,
    NO_PICTURES,
    NUMBER,
    OPTICAL,
    OTHER,
    PART,
    TRUTH_WORDS,
    UNNAMED,
    Label,
    affinity,
    camera_names,
    fitting,
    hints_at_ned,
    is_called,
    label_of,
    label_of_place,
    order,
    unique,
)
from pipelines.geometry.arrays import Float
from pipelines.geometry.clocks import explains_better
from pipelines.session.manifest import PoseSource

_POSE_TYPES = ("Odometry", "PoseWithCovarianceStamped", "PoseStamped", "PoseInFrame", "TransformStamped")
"""Types of pose messages, the preferred first: odometry states its uncertainty. All others come last."""
_MAP_TYPES = ("Octomap", "GridMap", "OccupancyGrid")
"""Types of whole maps, the preferred first; clouds of points are a sensor's, seldom in the frame of poses."""
_GIMBAL = frozenset({"gimbal", "mount", "pan", "tilt", "ptz", "camera", "cam"})
NO_DATE_NS = 10**17  # stamps below it count from boot
_SAME_DRONE_M = 30.0  # between two receivers on one drone
_MISSED = 0.1  # part of a video's frames that its own subtitles may lack
_MANY_CAMERAS = 200  # of one calibration file: more are the pictures of one moving camera


@dataclass(frozen=True)
class Candidate:
    """Something that a manifest can state, with its labels and its rank among candidates of its kind."""

    settings: dict[str, object]  # for the manifest; paths are Path objects
    labels: tuple[Label, ...]  # the labels of its names, one or more
    found: Found
    rank: tuple[object, ...] = ()  # the smallest is the likeliest among those with equal names
    span: Span | None = None
    topic: TopicFound | None = None
    of_body: bool = False  # poses of the body; else of the camera
    by_gps: bool = False  # poses whose position is that of a satellite receiver
    unturned: bool = False  # positions only, without attitudes of drone or gimbal
    is_true: bool = False  # its name says that it is ground truth
    placed: bool = False  # maps in the frame of poses
    ned_hint: str = ""  # a name that sounds like north-east-down

    def affinity(self, label: Label) -> int:
        """Rate how well it matches a camera's label."""
        return max(affinity(own, label) for own in self.labels)


def _moving_poses(findings: Findings, logs: Mapping[str, Recording]) -> list[Candidate]:
    """List trajectories, topics and chains of transforms; not those named after truth, commands or actor."""
    files = [_of_trajectory(found) for found in _trajectories(findings) if not _is_true(found)]
    drones = [_of_drone(found) for found in findings.of(DroneLog)]
    topics = [c for c in _pose_topics(logs) if not is_called(_topic_of(c), TRUTH_WORDS | ACTOR | COMMANDED)]
    return [*files, *drones, *_of_drivers(logs), *topics, *_of_transforms(logs)]


def _trajectories(findings: Findings) -> list[Poses]:
    """List trajectory files for whose format manifests have a key."""
    return [found for found in findings.of(Poses) if _key_of(found) in PoseSource.one_of]


def _key_of(found: Poses) -> str:
    return "tum" if found.format == "kitti" else found.format


def _calibrated(findings: Findings, part: Literal["intrinsics", "pose"]) -> list[Candidate]:
    """List cameras of calibrations with a part: their intrinsics, or their pose if they stand still."""
    return [
        _of_calibration(found, name)
        for found in findings.of(Calibration)
        if len(found.cameras) <= _MANY_CAMERAS
        for name, lens in found.cameras.items()
        if getattr(lens, part)
    ]


def _near(candidate: Candidate, pictures: str) -> int:
    """Count the leading name parts that a camera info shares with a topic of pictures; 0 for other kinds."""
    if candidate.topic is None or candidate.topic.kind != "intrinsics":
        return 0
    ours, theirs = (name.strip("/").split("/") for name in (candidate.topic.name, pictures))
    shared = 0
    while shared < min(len(ours), len(theirs)) and ours[shared] == theirs[shared] != "":
        shared += 1
    return shared


def _of_file(found: Found, key: str = "path", span: Span | None = None) -> Candidate:
    return Candidate({key: found.path}, (label_of_place(found.place),), found, (0, found.place), span)


def _of_trajectory(found: Poses) -> Candidate:
    return replace(_of_file(found, _key_of(found), found.span), rank=(0, 0, found.place))


def _of_drone(found: DroneLog) -> Candidate:
    """Make a candidate of a drone's own log; with gimbal angles, it has the poses of the camera."""
    of_file = _of_file(found, found.key, found.span)
    own = () if found.instance is None else (label_of(f"vehicle{found.instance}"),)
    return replace(
        of_file,
        settings=of_file.settings | {"instance": found.instance},
        labels=own or of_file.labels,
        rank=(0, int(not found.gimbal), found.place, found.instance or 0),
        of_body=found.body and not found.gimbal,
        by_gps=found.by_gps,
        unturned=not (found.body or found.gimbal),
    )


def _of_drivers(logs: Mapping[str, Recording]) -> Iterator[Candidate]:
    """Yield candidates of drivers: the usual topics of a driver together hold more than each topic alone."""
    for log, recording in logs.items():
        for driver in recording.drivers:
            named = driver.settings.get("namespace") or driver.settings.get("topic") or ""
            likelihood = -1 if "preset" in driver.settings else len(_POSE_TYPES)
            yield Candidate(
                {"log": log, **driver.settings},
                (label_of_topic(recording, named),),
                recording,
                (1, 1 - int(driver.gimbal) + int(not driver.body), likelihood, -driver.count, named),
                driver.span,
                of_body=driver.body and not driver.gimbal,
                by_gps=driver.by_gps,
                unturned=not (driver.body or driver.gimbal),
            )


def _is_true(found: Found) -> bool:
    """Test if a thing's name, or that of a folder above it, says that it is the truth."""
    return any(is_called(name, TRUTH_WORDS) for name in found.place)


def _of_calibration(found: Calibration, camera: str) -> Candidate:
    """Make a candidate of one camera of a calibration; an only camera is not named in the settings."""
    of_file, own = label_of_place(found.place), label_of(camera)
    alone = len(found.cameras) == 1
    both = tuple({word.key: word for word in (*of_file, *own)}.values())
    labels = [of_file, own] if alone else [own, both]
    return Candidate(
        {"path": found.path, "camera": None if alone else camera},
        tuple(label for label in labels if label) or ((),),
        found,
        (0, found.place, camera),
    )


def _topics(logs: Mapping[str, Recording], kind: TopicKind) -> list[Candidate]:
    return [
        Candidate(
            {"log": log, "topic": topic.name},
            (label_of_topic(recording, topic.name),),
            recording,
            (1, -topic.count, topic.name),
            topic.span,
            topic,
        )
        for log, recording in logs.items()
        for topic in recording.topics
        if topic.kind == kind and topic.count
    ]


def _pose_topics(logs: Mapping[str, Recording]) -> list[Candidate]:
    return [_of_pose_topic(c, c.topic) for c in _topics(logs, "poses") if c.topic]


def _of_pose_topic(candidate: Candidate, topic: TopicFound) -> Candidate:
    type_ = topic.type.rpartition("/")[2].rpartition(".")[2]
    likelihood = _POSE_TYPES.index(type_) if type_ in _POSE_TYPES else len(_POSE_TYPES)
    of_body = not is_called(topic.source or topic.name, OPTICAL)
    return replace(
        candidate,
        rank=(1, int(of_body), likelihood, -topic.count, topic.name),
        of_body=of_body,
        ned_hint=hints_at_ned(topic.target, topic.source, topic.name),
    )


def _topic_of(candidate: Candidate) -> str:
    return candidate.topic.name if candidate.topic else ""


def _of_transforms(logs: Mapping[str, Recording]) -> Iterator[Candidate]:
    for log, recording in logs.items():
        spans = [topic.span for topic in recording.topics if topic.kind == "transforms" and topic.count]
        for parent, child, first_ns in chains(recording):
            of_body = not is_called(child, OPTICAL)
            yield Candidate(
                {"log": log, "parent": parent, "child": child},
                (label_of_topic(recording, child),),
                recording,
                (1, int(of_body), len(_POSE_TYPES) + 1, 0, child),
                Span(first_ns, max(s.last_ns for s in spans)) if spans else None,
                of_body=of_body,
                ned_hint=hints_at_ned(parent, child),
            )


@dataclass(frozen=True)
class Choice:
    """The candidate that was taken, and its alternatives."""

    taken: Candidate
    others: tuple[Candidate, ...] = ()
    named: bool = True  # True if its name matches; else it is the only one there is
    why: str = ""  # the reason if neither is so
    start_ns: int | None = None  # of the video, if that was found with it

    @property
    def all(self) -> tuple[Candidate, ...]:
        """The candidate that was taken, then its alternatives."""
        return (self.taken, *self.others)


@dataclass
class CameraDraft:
    """One camera with the candidates that belong to it."""

    label: Label
    name: str = ""
    videos: list[Candidate] = field(default_factory=list)  # the first is taken
    keypoints: list[Candidate] = field(default_factory=list)
    paired: bool = False  # video and keypoints are matched only because nothing else is left
    frame_times: Choice | None = None
    poses: Choice | None = None
    gimbal: Choice | None = None
    angles: Candidate | None = None  # attitudes in its own video
    intrinsics: Choice | None = None
    true_poses: Choice | None = None

    @property
    def filmed(self) -> Span | None:
        """The span of its film, if that is known from the stamps of a log."""
        return self.videos[0].span if self.videos else None

    def mentioned(self) -> list[Candidate]:
        """List every candidate that the manifest mentions for it, also those in comments."""
        choices = (self.frame_times, self.poses, self.gimbal, self.intrinsics, self.true_poses)
        angles = [self.angles] if self.angles else []
        return [*self.videos, *self.keypoints, *angles, *(c for each in choices if each for c in each.all)]


@dataclass(frozen=True)
class Draft:
    """A flight as far as it is known from what was found."""

    logs: dict[str, Recording]  # those that are used, by their name in the manifest
    cameras: list[CameraDraft]
    true_joints: list[Joints]  # the first is taken
    actors: list[Candidate]  # the first is taken
    maps: list[Map]  # the first is taken
    logged_maps: list[Candidate]  # topics; the first is taken if there is no file and it lies where poses do
    unused: list[Found]


@dataclass(frozen=True)
class Alike:
    """Agreement of a video with a drone's log, by their motion."""

    gain: Float  # [S] log-likelihood of each stretch of the video, over a camera that stands still
    start_ns: int  # of the video, on the log's clock


Compare = Callable[[Video, DroneLog], Alike | None]
"""Comparison of a video with a drone's log; None if one of them shows no motion."""


Distance = Callable[[DroneLog, DroneLog], float | None]
"""Median distance across (m) of the positions in two drones' logs; None if they share no time or place."""


def match(findings: Findings, compare: Compare | None = None, distance: Distance | None = None) -> Draft:
    """Find the cameras, and what belongs to each; `compare` decides where neither names nor times do.

    `distance` decides between logs of one time, for cameras whose own positions lack attitudes.
    """
    logs = _log_names(with_stamps(joined(findings.of(Recording))))
    cameras = _cameras(findings, logs)
    moving, still = _moving_poses(findings, logs), _calibrated(findings, "pose")
    truth = [replace(_of_trajectory(f), is_true=True) for f in _trajectories(findings) if _is_true(f)]
    pose_topics = _pose_topics(logs)
    true_topics = [replace(c, is_true=True) for c in pose_topics if is_called(_topic_of(c), TRUTH_WORDS)]
    true_joints = sorted(
        filter(_is_true, findings.of(Joints)), key=lambda j: (-_shared([j.span], _spans(moving)), j.place)
    )
    lenses = [*_calibrated(findings, "intrinsics"), *_topics(logs, "intrinsics")]
    # Angles of other names are magnetic fields, velocities, attitudes.
    gimbals = [c for c in _topics(logs, "angles") if is_called(_topic_of(c), _GIMBAL)]
    stamps = [_of_file(found, found.key, found.span) for found in findings.of(FrameTimes)]
    anchors = [*moving, *(_of_file(found, span=found.span) for found in findings.of(Joints))]

    for camera in cameras:
        choose = _Chooser(camera, cameras, anchors)
        camera.poses = _beside(choose(moving), choose(still)) or choose(truth) or choose(true_topics)
        if camera.poses and not camera.poses.taken.is_true:
            camera.true_poses = choose(truth)
        camera.intrinsics = choose(lenses, shared=True)
        camera.frame_times = _own_stamps(camera, choose(stamps), moving)
        if camera.poses and (camera.poses.taken.of_body or camera.poses.taken.unturned):
            camera.gimbal = choose(gimbals)

    for camera in cameras:
        films = [video.found.path for video in camera.videos[:1]]
        own = [found for found in findings.of(Angles) if found.path in films]
        camera.angles = _of_file(own[0], own[0].key) if own else None
    _pair_drones(cameras, moving, compare)
    _prefer_attitudes(cameras, moving, distance)
    actors = [c for c in pose_topics if is_called(_topic_of(c), ACTOR)]
    if any(camera.poses and camera.poses.taken.by_gps for camera in cameras):
        names = ((c, f"{_topic_of(c)} {c.found.place[-1]}") for c in _topics(logs, "fixes"))
        actors += [fixes for fixes, name in names if is_called(name, ACTOR)]
    logged_maps = _logged_maps(logs, cameras)
    mentioned = [*(c for camera in cameras for c in camera.mentioned()), *actors, *logged_maps]
    used = {candidate.found.path for candidate in mentioned}
    used |= {thing.path for thing in (*true_joints, *findings.of(Map))}
    return Draft(
        logs={name: log for name, log in logs.items() if log.path in used},
        cameras=cameras,
        true_joints=true_joints,
        actors=actors,
        maps=findings.of(Map),
        logged_maps=logged_maps,
        unused=[
            found
            for found in findings.all()
            if found.path not in used and not any(found.path in log.parts for log in logs.values())
        ]
        + [log for log in logs.values() if log.path not in used],
    )


def _own_stamps(camera: CameraDraft, choice: Choice | None, moving: Sequence[Candidate]) -> Choice | None:
    """Leave out subtitles of no matching name that are those of another film.

    They are if they count other pictures than the video has, or if the video has a clock of its own.
    """
    if choice is None or "log" in _video(camera):
        return None
    stamps, film = choice.taken.found, camera.videos[0].found if camera.videos else None
    if choice.taken.affinity(camera.label) >= NUMBER or not isinstance(film, Video):
        return choice
    if not isinstance(stamps, FrameTimes) or stamps.key != "srt":
        return choice
    clocked = any(isinstance(log.found, DroneLog) and log.found.path == film.path for log in moving)
    return None if clocked or abs(stamps.rows - film.frames) > _MISSED * film.frames else choice


def _logged_maps(logs: Mapping[str, Recording], cameras: Sequence[CameraDraft]) -> list[Candidate]:
    """List the topics of maps, those first that lie in the frame of a camera's poses in the same log."""
    poses = [camera.poses.taken for camera in cameras if camera.poses]
    frames = {
        (c.settings.get("log"), c.settings.get("parent") or (c.topic.target if c.topic else None))
        for c in poses
    }
    found = []
    for candidate in _topics(logs, "maps"):
        type_ = candidate.topic.type.rpartition("/")[2] if candidate.topic else ""
        frame = candidate.topic.target if candidate.topic else ""
        there = type_ in _MAP_TYPES and (candidate.settings["log"], frame) in frames
        likelihood = _MAP_TYPES.index(type_) if type_ in _MAP_TYPES else len(_MAP_TYPES)
        found.append(replace(candidate, rank=(int(not there), likelihood, *candidate.rank), placed=there))
    return sorted(found, key=lambda candidate: candidate.rank)


def _video(camera: CameraDraft) -> dict[str, object]:
    return camera.videos[0].settings if camera.videos else {}


def _log_names(recordings: Sequence[Recording]) -> dict[str, Recording]:
    """Give recordings the short names that `log:` uses."""
    names: list[str] = []
    for recording in recordings:
        label = "_".join(word.text for word in label_of_recording(recording))
        names.append(unique(fitting(label, fitting(recording.place[-1], "log")), names))
    return dict(zip(names, recordings, strict=True))


# --- cameras -------------------------------------------------------------------------------------------


def _cameras(findings: Findings, logs: dict[str, Recording]) -> list[CameraDraft]:
    """Make a camera for everything that has pictures; if nothing has, one for each source of poses."""
    cameras: list[CameraDraft] = []
    together = Counter(found.path.parent for found in findings.of(Keypoints))
    pictures = _topics(logs, "pictures")
    coloured = [c for c in pictures if not is_called(_topic_of(c), NO_PICTURES)]
    for video in sorted(map(_of_file, findings.of(Video)), key=_by_name):
        _home(cameras, video, lambda camera: camera.videos).videos.append(video)
    for topic in sorted(coloured or pictures, key=_by_name):
        _home(cameras, topic, lambda camera: [c for c in camera.videos if c.topic]).videos.append(topic)
    detected = [  # those of the folder with the most of them rank first
        replace(_of_file(found), rank=(-together[found.path.parent], found.place))
        for found in findings.of(Keypoints)
    ]
    for keypoints in sorted(detected, key=_by_name):
        _home(cameras, keypoints, lambda camera: camera.keypoints).keypoints.append(keypoints)
    _pair_the_last(cameras)
    if not cameras:
        for poses in sorted(_moving_poses(findings, logs), key=_by_name):
            if not any(_same(camera.label, poses) for camera in cameras):
                cameras.append(CameraDraft(poses.labels[0]))
    cameras.sort(key=lambda camera: order(camera.label))
    for camera, name in zip(cameras, camera_names([camera.label for camera in cameras]), strict=True):
        camera.name = name
        camera.videos.sort(key=lambda candidate: candidate.rank)
        camera.keypoints.sort(key=lambda candidate: candidate.rank)
    return cameras


def _by_name(candidate: Candidate) -> tuple[object, ...]:
    return order(candidate.labels[0]), candidate.rank


def _same(label: Label, candidate: Candidate) -> bool:
    return candidate.affinity(label) == EQUAL or label == candidate.labels[0]


def _home(
    cameras: list[CameraDraft], candidate: Candidate, like: Callable[[CameraDraft], Sequence[Candidate]]
) -> CameraDraft:
    """Find or add the camera of some pictures: one of the same name, or a similar one without pictures."""
    label = candidate.labels[0]
    for camera in cameras:
        if _same(camera.label, candidate):
            return camera
    for least in (PART, NUMBER):
        fits = [c for c in cameras if not like(c) and affinity(c.label, label) >= least]
        if len(fits) == 1:
            fits[0].label = max(fits[0].label, label, key=len)
            return fits[0]
    cameras.append(CameraDraft(label))
    return cameras[-1]


def _pair_the_last(cameras: list[CameraDraft]) -> None:
    """Join one video and one keypoint file if both are the only ones without a partner."""
    filmed = [camera for camera in cameras if not camera.keypoints]
    detected = [camera for camera in cameras if not camera.videos]
    if len(filmed) == len(detected) == 1 and not _are_two(filmed[0].label, detected[0].label):
        filmed[0].keypoints, filmed[0].paired = detected[0].keypoints, True
        filmed[0].label = filmed[0].label or detected[0].label
        cameras.remove(detected[0])


def _are_two(one: Label, other: Label) -> bool:
    """Test if labels share a word, as those of two drones do: drone 1, drone 2."""
    return bool({word.word for word in one} & {word.word for word in other})


# --- what belongs to a camera ---------------------------------------------------------------------------


def _pair_drones(
    cameras: Sequence[CameraDraft], moving: Sequence[Candidate], compare: Compare | None
) -> None:
    """Give videos without poses the drones' logs that no camera has: by time, else by motion."""
    taken = {id(each) for camera in cameras if camera.poses for each in camera.poses.all}
    free = [c for c in moving if isinstance(c.found, DroneLog) and id(c) not in taken]
    filmed = [
        (camera, video)
        for camera in cameras
        if camera.poses is None and camera.videos and isinstance(video := camera.videos[0].found, Video)
    ]
    possible = {camera.name: [log for log in free if _may_be_of(video, log)] for camera, video in filmed}
    uses = Counter(id(log) for logs in possible.values() for log in logs)
    found: dict[str, tuple[Candidate, Alike]] = {}
    for camera, video in filmed:
        logs = possible[camera.name]
        if len(logs) == 1 and uses[id(logs[0])] == 1:
            camera.poses = Choice(logs[0], named=False, why="by the times of video and log")
        elif compare is not None and (own := _own_by_motion(video, logs, compare)) is not None:
            found[camera.name] = own
    for camera, _ in filmed:
        own = found.get(camera.name)
        if own is not None and sum(own[0] is log for log, _ in found.values()) == 1:
            log, alike = own
            camera.poses = Choice(log, named=False, why="by their motion", start_ns=alike.start_ns)


def _prefer_attitudes(
    cameras: Sequence[CameraDraft], moving: Sequence[Candidate], distance: Distance | None
) -> None:
    """Give cameras whose poses lack attitudes the log that has them at that time, if just one does.

    Subtitles or a GoPro's GPS have the camera's name, but a flight record or an autopilot's log has more. Of
    several, that of the same drone was where its positions are. The others become alternatives.
    """
    taken = {id(each) for camera in cameras if camera.poses for each in camera.poses.all}
    free: dict[tuple[Path, object], Candidate] = {}
    for candidate in moving:
        if candidate.unturned or candidate.span is None or id(candidate) in taken:
            continue
        key = candidate.found.path, candidate.settings.get("instance")
        if key not in free or candidate.rank < free[key].rank:
            free[key] = candidate
    wanting = [(c, c.poses) for c in cameras if c.poses and c.poses.taken.unturned and c.gimbal is None]
    fitting_logs = {
        c.name: _nearest([log for log in free.values() if _is_of_film(log, c)], choice.taken, distance)
        for c, choice in wanting
    }
    uses = Counter(id(log) for logs in fitting_logs.values() for log in logs)
    for camera, choice in wanting:
        logs = fitting_logs[camera.name]
        if len(logs) != 1 or uses[id(logs[0])] != 1:
            camera.poses = replace(choice, others=(*choice.others, *free.values()))
            continue
        if not _share_time(logs[0], choice.taken):
            camera.frame_times = None  # of another clock
        why = "by time and place, for what has its name has no attitudes"
        camera.poses = Choice(logs[0], choice.all, named=False, why=why)


def _nearest(logs: Sequence[Candidate], own: Candidate, distance: Distance | None) -> list[Candidate]:
    """Leave out logs that were elsewhere than a camera's own positions; of several, keep a clear nearest."""
    near: list[tuple[float, Candidate]] = []
    unknown: list[Candidate] = []
    for log in logs:
        metres = None
        if distance is not None and isinstance(own.found, DroneLog) and isinstance(log.found, DroneLog):
            metres = distance(own.found, log.found)
        if metres is None:
            unknown.append(log)
        elif metres < _SAME_DRONE_M:
            near.append((metres, log))
    near.sort(key=lambda pair: pair[0])
    if len(near) > 1 and not unknown and 2 * near[0][0] < near[1][0]:
        return [near[0][1]]
    return [*(log for _, log in near), *unknown]


def _is_of_film(log: Candidate, camera: CameraDraft) -> bool:
    """Test if a log shares the time of a camera's poses, or recorded one video of its video's length."""
    if camera.poses and _share_time(log, camera.poses.taken):
        return True
    video = camera.videos[0].found if camera.videos else None
    if not isinstance(video, Video) or not isinstance(log.found, DroneLog):
        return False
    return log.found.film_of(video) is not None


def _share_time(log: Candidate, other: Candidate) -> bool:
    """Test if a log has dates and covers half of another one."""
    if log.span is None or other.span is None or min(log.span.first_ns, other.span.first_ns) < NO_DATE_NS:
        return False
    length_ns = other.span.last_ns - other.span.first_ns
    return 2 * log.span.overlap_ns(other.span) >= length_ns


def _own_by_motion(
    video: Video, logs: Sequence[Candidate], compare: Compare
) -> tuple[Candidate, Alike] | None:
    """Return the log that explains a video's motion clearly, and clearly better than all others."""
    known = [
        (log, alike)
        for log in logs
        if isinstance(log.found, DroneLog) and (alike := compare(video, log.found)) is not None
    ]
    for log, alike in known:
        others = [other.gain for each, other in known if each is not log]
        if all(explains_better(alike.gain, other) for other in (np.zeros_like(alike.gain), *others)):
            return log, alike
    return None


def _may_be_of(video: Video, log: Candidate) -> bool:
    """Test if a log covers half of a video; its metadata have the time when it began, or when it ended."""
    if video.made_ns is None or log.span is None or log.span.first_ns < NO_DATE_NS:
        return True
    length_ns = video.length_ns
    began = [Span(video.made_ns, video.made_ns + length_ns), Span(video.made_ns - length_ns, video.made_ns)]
    return max(log.span.overlap_ns(each) for each in began) >= length_ns / 2


class _Chooser:
    """Chooser of candidates of one kind for one camera; `anchors` define the time of the flight."""

    def __init__(
        self, camera: CameraDraft, cameras: Sequence[CameraDraft], anchors: Sequence[Candidate]
    ) -> None:
        self._camera = camera
        self._lone = len(cameras) == 1
        self._anchors = anchors
        self._topic = str(_video(camera).get("topic", ""))

    def __call__(self, candidates: Sequence[Candidate], *, shared: bool = False) -> Choice | None:
        """Choose the best candidate with the camera's name; or the only one, for the only camera.

        Args:
            candidates: of one kind.
            shared: True if one candidate without a matching name may serve several cameras.
        """
        least = UNNAMED if self._lone or shared else NUMBER
        rivals = [candidate for candidate in candidates if self._likeness(candidate) >= least]
        # The only candidate is taken, and for a lone camera the likeliest topic of the only log.
        logs = {id(c.found) for c in candidates if isinstance(c.found, Recording)}
        one_log = self._lone and len(logs) == 1 and all(isinstance(c.found, Recording) for c in candidates)
        if not rivals and (one_log or (len(candidates) == 1 and (self._lone or shared))):
            own = self._camera.label
            rivals = [c for c in candidates if not any(_are_two(own, label) for label in c.labels)]
        if not rivals:
            return None
        # A candidate with the camera's name excludes those without. How exactly the name matches matters less
        # than time.
        level = min(PART, max(map(self._likeness, rivals)))
        rivals = [candidate for candidate in rivals if self._likeness(candidate) >= level]
        times = self._times(rivals)

        def key(rival: Candidate) -> tuple[object, ...]:
            # A log that began a second earlier is as good as another; one of another flight is not.
            elsewhere = 2 * times[id(rival)] < max(times.values())
            return elsewhere, -self._likeness(rival), -_near(rival, self._topic), rival.rank

        taken, *others = sorted(rivals, key=key)
        likeness = self._likeness(taken)
        return Choice(taken, tuple(others), named=likeness >= NUMBER or (self._lone and likeness != OTHER))

    def _likeness(self, candidate: Candidate) -> int:
        return candidate.affinity(self._camera.label)

    def _times(self, rivals: Sequence[Candidate]) -> dict[int, float]:
        """Compute how long each overlaps in time with the camera's film, or else with the other logs."""
        others = [anchor for anchor in self._anchors if all(anchor is not rival for rival in rivals)]
        anchors = [self._camera.filmed] if self._camera.filmed else _spans(others)
        return {id(rival): _shared([rival.span] if rival.span else [], anchors) for rival in rivals}


def _shared(spans: Sequence[Span], anchors: Iterable[Span]) -> float:
    """Sum the overlaps of spans with other spans, ns."""
    return float(sum(max(span.overlap_ns(anchor), 0) for anchor in anchors for span in spans))


def _spans(candidates: Iterable[Candidate]) -> list[Span]:
    return [candidate.span for candidate in candidates if candidate.span]


def _beside(first: Choice | None, second: Choice | None) -> Choice | None:
    """Return the first choice with the candidates of the second as alternatives."""
    if first is None or second is None:
        return first or second
    return Choice(first.taken, (*first.others, *second.all), first.named)
