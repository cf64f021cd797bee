"""Candidates for the keys of a camera, among all that was found: each with labels, times and rank."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

from pipelines.drafting.found import (
    Calibration,
    DroneLog,
    Findings,
    Found,
    Poses,
    Recording,
    Span,
    TopicFound,
    TopicKind,
)
from pipelines.drafting.labels import (
    TRUTH_WORDS,
    Label,
    affinity,
    is_called,
    label_of,
    label_of_place,
)
from pipelines.drafting.recordings import (
    chains,
    hints_at_ned,
    is_actor,
    is_commanded,
    is_of_camera,
    is_truth,
    label_of_topic,
    shows_colours,
)
from pipelines.session.manifest import PoseSource

_POSE_TYPES = ("Odometry", "PoseWithCovarianceStamped", "PoseStamped", "PoseInFrame", "TransformStamped")
"""Types of pose messages, the preferred first: odometry states its uncertainty. All others come last."""
_GIMBAL = frozenset({"gimbal", "mount", "pan", "tilt", "ptz", "camera", "cam"})
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
    ned_hint: str = ""  # a name that sounds like north-east-down

    def affinity(self, label: Label) -> int:
        """Rate how well it matches a camera's label."""
        return max(affinity(own, label) for own in self.labels)


def videos(findings: Findings) -> list[Candidate]:
    """List video files."""
    return [_of_file(video, {"path": video.path}) for video in findings.videos]


def picture_topics(logs: Mapping[str, Recording]) -> list[Candidate]:
    """List topics with pictures; depth and masks only if there is nothing else."""
    found = list(_topics(logs, "pictures", _of_topic))
    return [c for c in found if c.topic and shows_colours(c.topic)] or found


def keypoints(findings: Findings) -> list[Candidate]:
    """List keypoint files; those of the folder with the most of them rank first."""
    together = Counter(found.path.parent for found in findings.keypoints)
    return [
        replace(_of_file(found, {"path": found.path}), rank=(-together[found.path.parent], found.place))
        for found in findings.keypoints
    ]


def moving_poses(findings: Findings, logs: Mapping[str, Recording]) -> list[Candidate]:
    """List trajectories, topics and chains of transforms; not those named after truth, commands or actor."""
    files = [_trajectory(found) for found in findings.poses if not _is_true(found)]
    topics = [
        candidate
        for candidate in _topics(logs, "poses", _of_pose_topic)
        if candidate.topic
        and not (is_truth(candidate.topic) or is_actor(candidate.topic) or is_commanded(candidate.topic))
    ]
    drones = [_of_drone(found) for found in findings.drone_logs]
    return [*(c for c in files if c), *drones, *_of_drivers(logs), *topics, *_of_transforms(logs)]


def true_poses(findings: Findings) -> list[Candidate]:
    """List trajectories whose names say that they are ground truth."""
    files = (_trajectory(found) for found in findings.poses if _is_true(found))
    return [replace(candidate, is_true=True) for candidate in files if candidate]


def true_topics(logs: Mapping[str, Recording]) -> list[Candidate]:
    """List topics of poses whose names say that they are ground truth."""
    topics = _topics(logs, "poses", _of_pose_topic)
    return [replace(c, is_true=True) for c in topics if c.topic and is_truth(c.topic)]


def actors(logs: Mapping[str, Recording]) -> list[Candidate]:
    """List topics of the person's position."""
    return [c for c in _topics(logs, "poses", _of_pose_topic) if c.topic and is_actor(c.topic)]


def still_poses(findings: Findings) -> list[Candidate]:
    """List poses of still cameras in calibrations."""
    return [
        _of_calibration(found, name)
        for found in findings.calibrations
        if len(found.cameras) <= _MANY_CAMERAS
        for name, lens in found.cameras.items()
        if lens.pose
    ]


def lenses(findings: Findings, logs: Mapping[str, Recording]) -> list[Candidate]:
    """List intrinsics in calibrations and topics."""
    files = [
        _of_calibration(found, name)
        for found in findings.calibrations
        if len(found.cameras) <= _MANY_CAMERAS
        for name, lens in found.cameras.items()
        if lens.intrinsics
    ]
    return [*files, *_topics(logs, "intrinsics", _of_topic)]


def gimbals(logs: Mapping[str, Recording]) -> list[Candidate]:
    """List topics of angles named after a gimbal; others are magnetic fields, velocities, attitudes."""
    return [c for c in _topics(logs, "angles", _of_topic) if c.topic and is_called(c.topic.name, _GIMBAL)]


def joints(findings: Findings) -> list[Candidate]:
    """List 3D joints, for their times."""
    return [replace(_of_file(found, {"path": found.path}), span=found.span) for found in findings.joints]


def frame_times(findings: Findings) -> list[Candidate]:
    """List files with the times of frames."""
    stamps = findings.frame_times
    return [replace(_of_file(found, {found.key: found.path}), span=found.span) for found in stamps]


def near(candidate: Candidate, pictures: str) -> int:
    """Count the leading name parts that a camera info shares with a topic of pictures; 0 for other kinds."""
    if candidate.topic is None or candidate.topic.kind != "intrinsics":
        return 0
    ours, theirs = (name.strip("/").split("/") for name in (candidate.topic.name, pictures))
    shared = 0
    while shared < min(len(ours), len(theirs)) and ours[shared] == theirs[shared] != "":
        shared += 1
    return shared


def _of_file(found: Found, settings: dict[str, object]) -> Candidate:
    return Candidate(settings, (label_of_place(found.place),), found, (0, found.place))


def _trajectory(found: Poses) -> Candidate | None:
    """Make a candidate of a trajectory file, if manifests have a key for its format."""
    if found.format not in PoseSource.one_of:
        return None
    return replace(_of_file(found, {found.format: found.path}), rank=(0, 0, found.place), span=found.span)


def _of_drone(found: DroneLog) -> Candidate:
    """Make a candidate of a drone's own log; with gimbal angles, it has the poses of the camera."""
    return replace(
        _of_file(found, {found.key: found.path}),
        rank=(0, int(not found.gimbal), found.place),
        span=found.span,
        of_body=found.body and not found.gimbal,
        by_gps=found.by_gps,
        unturned=not (found.body or found.gimbal),
    )


def _of_drivers(logs: Mapping[str, Recording]) -> Iterator[Candidate]:
    """Yield candidates of drivers: the usual topics of a driver together hold more than each topic alone."""
    for log, recording in logs.items():
        for driver in recording.drivers:
            namespace = driver.namespace or ""
            settings = {"log": log, "preset": driver.preset, "namespace": driver.namespace}
            yield Candidate(
                dict(settings),
                (label_of_topic(recording, namespace),),
                recording,
                (1, 1 - int(driver.gimbal) + int(not driver.body), -1, -driver.count, namespace),
                driver.span,
                of_body=driver.body and not driver.gimbal,
                by_gps=driver.by_gps,
                unturned=not (driver.body or driver.gimbal),
            )


def _is_true(found: Found) -> bool:
    return is_called(found.place[-1], TRUTH_WORDS)


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


def _topics(
    logs: Mapping[str, Recording],
    kind: TopicKind,
    candidate: Callable[[str, Recording, TopicFound], Candidate],
) -> Iterator[Candidate]:
    for log, recording in logs.items():
        for topic in recording.topics:
            if topic.kind == kind and topic.count:
                yield candidate(log, recording, topic)


def _of_topic(log: str, recording: Recording, topic: TopicFound) -> Candidate:
    return Candidate(
        {"log": log, "topic": topic.name},
        (label_of_topic(recording, topic.name),),
        recording,
        (1, -topic.count, topic.name),
        topic.span,
        topic,
    )


def _of_pose_topic(log: str, recording: Recording, topic: TopicFound) -> Candidate:
    type_ = topic.type.rpartition("/")[2].rpartition(".")[2]
    likelihood = _POSE_TYPES.index(type_) if type_ in _POSE_TYPES else len(_POSE_TYPES)
    of_body = not is_of_camera(topic.source or topic.name)
    return replace(
        _of_topic(log, recording, topic),
        rank=(1, int(of_body), likelihood, -topic.count, topic.name),
        of_body=of_body,
        ned_hint=hints_at_ned(topic.target, topic.source, topic.name),
    )


def _of_transforms(logs: Mapping[str, Recording]) -> Iterator[Candidate]:
    for log, recording in logs.items():
        spans = [topic.span for topic in recording.topics if topic.kind == "transforms" and topic.count]
        for parent, child in chains(recording):
            of_body = not is_of_camera(child)
            yield Candidate(
                {"log": log, "parent": parent, "child": child},
                (label_of_topic(recording, child),),
                recording,
                (1, int(of_body), len(_POSE_TYPES) + 1, 0, child),
                Span(min(s.first_ns for s in spans), max(s.last_ns for s in spans)) if spans else None,
                of_body=of_body,
                ned_hint=hints_at_ned(parent, child),
            )
