"""Analysis of logs: files that are one recording, purposes of topics, and frames of drones."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from pipelines.drafting.found import Edge, Place, Recording, TopicFound
from pipelines.drafting.labels import TRUTH_WORDS, Label, is_called, label_of, label_of_place, words

_PART = re.compile(r"(.*)_(\d{1,9})", re.DOTALL)
_COMMANDED = frozenset(
    {"setpoint", "setpoints", "cmd", "command", "commanded", "desired", "goal", "reference", "target"}
    | {"plan", "planned", "planner", "waypoint", "waypoints"}
)
_ACTOR = frozenset({"actor", "person", "people", "human", "subject", "pedestrian"})
_NO_PICTURES = frozenset({"depth", "disparity", "infra", "mask", "segmentation", "confidence"})
_OPTICAL = frozenset({"camera", "cam", "optical", "lens"})
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


def is_truth(topic: TopicFound) -> bool:
    """Test if a topic's name says that it is ground truth."""
    return is_called(topic.name, TRUTH_WORDS)


def is_actor(topic: TopicFound) -> bool:
    """Test if a topic's name says that it is about the filmed person."""
    return is_called(topic.name, _ACTOR)


def is_commanded(topic: TopicFound) -> bool:
    """Test if a topic's name says that it holds commands, not measurements."""
    return is_called(topic.name, _COMMANDED)


def shows_colours(topic: TopicFound) -> bool:
    """Test if a topic holds pictures of a camera, not depth or masks."""
    return not any(word.word in _NO_PICTURES for word in words(topic.name))


def is_of_camera(name: str) -> bool:
    """Test if a frame or topic is that of a camera, not of the body."""
    return is_called(name, _OPTICAL)


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
    cameras = [pair for pair in found if is_of_camera(pair[1])]
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
