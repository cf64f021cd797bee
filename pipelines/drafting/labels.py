"""Labels of files and topics, to find those of the same camera, and what logs hold for which camera.

A name is split into words with their numbers (drone_1_poses: drone 1, poses). Words for the kind of a thing
(poses, camera, json) are ignored; the rest is its label. `drone1.mp4`, `drone1_poses.tum`,
`/drone1/odometry` and `drone-01/calib.yaml` all have the label drone 1.
"""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from pipelines.drafting.found import Edge, Place, Recording

EQUAL, PART, NUMBER, UNNAMED, OTHER = 4, 3, 2, 1, 0
"""Ratings of two labels: they are the same; one is within the other; only the numbers agree (d1, drone1); one
of them is empty; they differ."""

TRUTH_WORDS = frozenset({"truth", "true", "gt", "groundtruth"})
_GENERIC_TEXT = """
    cam camera cameras video videos vid movie clip image images img picture pictures frame frames photo
    rgb bgr color colour mono gray raw compressed rect rectified info odometry odom pose poses trajectory
    traj path paths tf transform transforms tum csv json toml yaml yml txt log logs bag bags rosbag mcap
    data dataset recording record keypoints keypoint kpts kp joints skeleton openpose alphapose mmpose coco
    detections detection detector results result predictions calib calibration calibrations intrinsic
    intrinsics extrinsic extrinsics camchain kalibr opencv ost ground gimbal attitude angles angle local
    position orientation mavros state estimator estimate filtered fused global world map time times
    timestamp timestamps stamps stamp static base link body optical imu vio slam the of and
"""
_GENERIC = TRUTH_WORDS | frozenset(_GENERIC_TEXT.split())
"""Words for the kind of a thing, which do not name its owner. With a number (cam01) they do name a camera."""
_GENERIC_NUMBERED = re.compile(
    r"(?i)(?<![^\W_])(?:rosbag2|halpe26|coco17|coco133|body25b?|blazepose33|[hx]26[45]|[23]d|\d{3,4}p|\d+fps)"
    r"(?![^\W_])"
)
_WORD = re.compile(r"[^\W\d_]+[0-9]*|[0-9]+")
_MOST_DIGITS = 18  # of a number; only the last ones are compared


class Word(NamedTuple):
    """A word of a name, with the number that follows it."""

    text: str  # as it is spelled
    word: str  # lower case
    number: int | None

    @property
    def key(self) -> tuple[str, int | None]:
        """The key by which words are equal: drone_1, Drone01."""
        return self.word, self.number


Label = tuple[Word, ...]


def words(text: str) -> list[Word]:
    """Split a name into its words in their order; a number belongs to the word before it."""
    found: list[Word] = []
    start = end = 0  # of the word found last
    for match in _WORD.finditer(_GENERIC_NUMBERED.sub(lambda generic: " " * len(generic[0]), text)):
        letters = match[0].rstrip("0123456789")
        number = int(match[0][len(letters) :][-_MOST_DIGITS:] or -1)
        if not letters and found and found[-1].number is None and match.start() == end + 1:
            found[-1] = Word(text[start : match.end()], found[-1].word, number)
        else:
            start = match.start()
            found.append(Word(match[0], letters.lower(), None if number < 0 else number))
        end = match.end()
    return found


def label_of(text: str) -> Label:
    """Return the label of a name: its words without those for kinds of things."""
    kept = {word.key: word for word in words(text) if word.number is not None or word.word not in _GENERIC}
    return tuple(kept.values())


def label_of_place(place: Place) -> Label:
    """Return the label of a file: that of its name, with numbered folders above it (drone1/DJI_0001.mp4).

    If the name has no label (drone1/video.mp4), it is the label of the nearest folder that has one.
    """
    *folders, name = place
    own = label_of(name)
    above = [label_of(folder) for folder in folders]
    if not own:
        return next((label for label in reversed(above) if label), ())
    numbered = [word for label in above for word in label if word.word and word.number is not None]
    return tuple({word.key: word for word in (*numbered, *own)}.values())


def is_called(text: str, wanted: frozenset[str]) -> bool:
    """Test if a name contains one of some words."""
    return any(word.word in wanted for word in words(text))


def affinity(one: Label, other: Label) -> int:
    """Rate how well two labels match, from `OTHER` to `EQUAL`."""
    if not one or not other:
        return UNNAMED
    ours, theirs = {word.key for word in one}, {word.key for word in other}
    if ours == theirs:
        return EQUAL
    if ours < theirs or theirs < ours:
        return PART
    numbers = [{word.number for word in label if word.number is not None} for label in (one, other)]
    return NUMBER if numbers[0] and numbers[0] == numbers[1] else OTHER


def order(label: Label) -> list[tuple[str, int]]:
    """Make a sort key that sorts drone2 before drone10."""
    return [(word.word, -1 if word.number is None else word.number) for word in label]


def camera_names(labels: Sequence[Label]) -> list[str]:
    """Make a name for each camera, [A-Za-z0-9_-]{1,64}, such that no two differ only in case.

    Numbered words that all labels share (a date, a take) are left out. Of the rest, a name has as many words
    as are needed to distinguish the cameras.
    """
    if len(labels) > 1:
        shared = Counter(word.key for label in labels for word in label if word.number is not None)
        common = {key for key, count in shared.items() if count == len(labels)}
        told = [tuple(word for word in label if word.key not in common) for label in labels]
        labels = told if all(told) else labels
        longest = max(len(label) for label in labels)
        enough = (k for k in range(1, longest) if len({_keys(label[:k]) for label in labels}) == len(labels))
        length = next(enough, longest)
        labels = [label[:length] for label in labels]
    names: list[str] = []
    for label in labels:
        names.append(unique(fitting("_".join(word.text for word in label), f"camera{len(names) + 1}"), names))
    return names


def _keys(label: Label) -> tuple[tuple[str, int | None], ...]:
    return tuple(word.key for word in label)


def fitting(text: str, otherwise: str) -> str:
    """Convert a text to [A-Za-z0-9_-]{1,64}; return `otherwise` if no letter is left of it."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", plain).strip("_-")[:64]
    return name if re.search("[A-Za-z]", name) else otherwise


def unique(name: str, taken: Sequence[str]) -> str:
    """Return the name, with a number if it is taken."""
    folded = {other.lower() for other in taken}
    candidate, number = name, 2
    while candidate.lower() in folded:
        candidate = f"{name[:58]}_{number}"
        number += 1
    return candidate


_PART = re.compile(r"(.*)_(\d{1,9})", re.DOTALL)
COMMANDED = frozenset(
    {"setpoint", "setpoints", "cmd", "command", "commanded", "desired", "goal", "reference", "target"}
    | {"plan", "planned", "planner", "waypoint", "waypoints"}
)
ACTOR = frozenset({"actor", "person", "people", "human", "subject", "pedestrian"})
NO_PICTURES = frozenset({"depth", "disparity", "infra", "mask", "segmentation", "confidence"})
OPTICAL = frozenset({"camera", "cam", "optical", "lens"})
_NED = frozenset({"ned", "px4", "fmu"})
_BODIES = frozenset({"base", "body", "imu", "fcu"})


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


def hints_at_ned(*names: str) -> str:
    """Return the first of some names that suggests north-east-down; empty if none does."""
    return next((name for name in names if is_called(name, _NED)), "")


def chains(recording: Recording) -> list[tuple[str, str]]:
    """List (parent, child) of every moving camera or body frame of a log's transforms; cameras first.

    The parent is the root of the child's tree. Frames that are fixed to the root are left out.
    """
    above: dict[str, Edge] = {}
    for edge in recording.edges:
        above.setdefault(edge.child, edge)
    found = []
    for child in sorted(above):
        way = _way_up(child, above)
        if way and not all(edge.still for edge in way):
            found.append((way[-1].parent, child))
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
