"""Matching of pictures, poses, calibrations and truth to cameras.

A camera is anything with pictures: a video, keypoints, a topic with pictures. Every other thing goes to the
camera with the same name. If there are several for a camera, the one that overlaps in time with its film is
taken, then the one of the likelier kind. The others are kept and listed as alternatives.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from pipelines.drafting import candidates as of
from pipelines.drafting.candidates import Candidate
from pipelines.drafting.found import Findings, Found, Joints, Recording, Span
from pipelines.drafting.labels import (
    EQUAL,
    NUMBER,
    OTHER,
    PART,
    TRUTH_WORDS,
    UNNAMED,
    Label,
    affinity,
    camera_names,
    fitting,
    is_called,
    order,
    unique,
)
from pipelines.drafting.recordings import joined, label_of_recording


@dataclass(frozen=True)
class Choice:
    """The candidate that was taken, and its alternatives."""

    taken: Candidate
    others: tuple[Candidate, ...] = ()
    named: bool = True  # True if its name matches; else it is the only one there is

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
    intrinsics: Choice | None = None
    true_poses: Choice | None = None

    @property
    def filmed(self) -> Span | None:
        """The span of its film, if that is known from the stamps of a log."""
        return self.videos[0].span if self.videos else None

    def mentioned(self) -> list[Candidate]:
        """List every candidate that the manifest mentions for it, also those in comments."""
        choices = (self.frame_times, self.poses, self.gimbal, self.intrinsics, self.true_poses)
        return [*self.videos, *self.keypoints, *(c for choice in choices if choice for c in choice.all)]


@dataclass(frozen=True)
class Draft:
    """A flight as far as it is known from what was found."""

    logs: dict[str, Recording]  # those that are used, by their name in the manifest
    cameras: list[CameraDraft]
    true_joints: list[Joints]  # the first is taken
    actors: list[Candidate]  # the first is taken
    maps: list[Found]  # the first is taken
    unused: list[Found]


def match(findings: Findings) -> Draft:
    """Find the cameras, and what belongs to each."""
    logs = _log_names(joined(findings.recordings))
    cameras = _cameras(findings, logs)
    moving, still = of.moving_poses(findings, logs), of.still_poses(findings)
    truth = of.true_poses(findings)
    called_true = (joints for joints in findings.joints if is_called(joints.place[-1], TRUTH_WORDS))
    true_joints = sorted(called_true, key=lambda j: (-_shared([j.span], _spans(moving)), j.place))
    lenses, gimbals, stamps = of.lenses(findings, logs), of.gimbals(logs), of.frame_times(findings)
    anchors = [*moving, *of.joints(findings)]

    for camera in cameras:
        choose = _Chooser(camera, cameras, anchors)
        camera.poses = _beside(choose(moving), choose(still)) or choose(truth) or choose(of.true_topics(logs))
        if camera.poses and not camera.poses.taken.is_true:
            camera.true_poses = choose(truth)
        camera.intrinsics = choose(lenses, shared=True)
        camera.frame_times = choose(stamps) if "log" not in _video(camera) else None
        if camera.poses and (camera.poses.taken.of_body or camera.poses.taken.unturned):
            camera.gimbal = choose(gimbals)

    actors = of.actors(logs)
    mentioned = [*(c for camera in cameras for c in camera.mentioned()), *actors]
    used = {candidate.found.path for candidate in mentioned}
    used |= {thing.path for thing in (*true_joints, *findings.maps)}
    return Draft(
        logs={name: log for name, log in logs.items() if log.path in used},
        cameras=cameras,
        true_joints=true_joints,
        actors=actors,
        maps=list(findings.maps),
        unused=[
            found
            for found in findings.all()
            if found.path not in used and not any(found.path in log.parts for log in logs.values())
        ]
        + [log for log in logs.values() if log.path not in used],
    )


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
    for video in sorted(of.videos(findings), key=_by_name):
        _home(cameras, video, lambda camera: camera.videos).videos.append(video)
    for topic in sorted(of.picture_topics(logs), key=_by_name):
        _home(cameras, topic, lambda camera: [c for c in camera.videos if c.topic]).videos.append(topic)
    for keypoints in sorted(of.keypoints(findings), key=_by_name):
        _home(cameras, keypoints, lambda camera: camera.keypoints).keypoints.append(keypoints)
    _pair_the_last(cameras)
    if not cameras:
        for poses in sorted(of.moving_poses(findings, logs), key=_by_name):
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
        if not rivals and len(candidates) == 1 and (self._lone or shared):
            rivals = list(candidates)
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
            return elsewhere, -self._likeness(rival), -of.near(rival, self._topic), rival.rank

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
