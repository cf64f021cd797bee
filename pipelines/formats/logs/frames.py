"""Frames of logged data, and their poses in the log's world."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from pipelines.formats.logs.messages import all_samples, kind_of
from pipelines.formats.logs.trajectories import Stamps, TransformLog, chained, transforms_of
from pipelines.geometry.transform_tree import find_route
from pipelines.session.errors import DataError
from pipelines.session.records import PoseSample, Trajectory
from pipelines.session.registries import Log

_FIXED_FRAMES = ("world", "map", "odom", "earth")  # names of fixed frames in REP 105

_THE_WORLD = Trajectory(np.zeros(1, np.int64), np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0, 1.0]]))
"""Identity pose, for a frame that is the log's world."""


def transforms_in(recording: Log, source: str, topic: str | None = None) -> TransformLog:
    """Read every transform of a log, or of one topic; those of topics named `...static` always hold.

    Raises:
        DataError: messages that cannot be read.
    """
    every = [candidate.name for candidate in recording.topics if kind_of(candidate) == "transforms"]
    names = every if topic is None else [topic]
    static = [name for name in names if name.endswith("static")]
    moving = [name for name in names if name not in static]
    return transforms_of(
        all_samples(recording.messages(moving), source),
        source,
        static=all_samples(recording.messages(static), source),
    )


def frames_of_poses(recording: Log, source: str, taken: Iterable[tuple[str | None, str | None]]) -> list[str]:
    """Return the frames of a log's poses, each once, without the leading slash of ROS 1.

    Args:
        recording: the log.
        source: its name, for messages.
        taken: topic and parent of each; a parent names the frame itself, and a missing topic means the
            only one. Entries that do not fit the log are ignored; reading the poses reports them.
    """
    topics = [topic.name for topic in recording.topics if kind_of(topic) == "poses"]
    frames: list[str] = []
    for stated, parent in taken:
        topic = topics[0] if stated is None and len(topics) == 1 else stated
        if parent is not None:
            frames.append(parent.lstrip("/"))
        elif topic in topics:
            first = next(all_samples(recording.messages([topic]), source), None)
            if isinstance(first, PoseSample):
                frames.append(first.target.lstrip("/"))
    return [frame for frame in dict.fromkeys(frames) if frame]


def place_of_frame(
    recording: Log,
    source: str,
    place: str,
    frame: str,
    *,
    parent: str | None,
    poses_in: Sequence[str],
    stamps: Stamps,
    max_gap_ns: int,
    note: Callable[[str], None],
) -> Trajectory:
    """Return the pose of a frame in the log's world; one row if it is that world or never moves in it.

    The log's world is the stated frame, else the frame of the poses that are taken from this log, else
    one with the name of a fixed frame. If a map lies in such a fixed frame and no transforms connect it with
    the frame of the poses, both are taken for one frame, and a note says so.

    Args:
        recording: the log.
        source: its name, for messages.
        place: log and topic, for messages.
        frame: the frame to find; an empty name means the world.
        parent: the world's frame, if it is stated.
        poses_in: the frames of the poses.
        stamps: which stamps of the transforms are used.
        max_gap_ns: the longest gap between two transforms that is interpolated.
        note: receives the result in words.

    Raises:
        DataError: nothing connects the frame with the log's world.
    """
    known = [parent.lstrip("/")] if parent is not None else [*poses_in] or list(_FIXED_FRAMES)
    if not frame or frame in known:
        return _THE_WORLD
    transforms = transforms_in(recording, source)
    for world in known:
        if _are_connected(transforms, world, frame):
            note(f"{place}: lies in {frame!r}, which the log's transforms place in {world!r}")
            return chained(
                transforms, source, parent=world, child=frame, stamps=stamps, max_gap_ns=max_gap_ns
            ).trajectory
    if parent is None and frame in _FIXED_FRAMES:
        note(
            f"{place}: lies in {frame!r}, poses in {', '.join(map(repr, poses_in))};"
            " nothing in the log connects them, they are taken for one"
        )
        return _THE_WORLD
    raise DataError(
        place,
        f"lies in {frame!r}, which no transforms of the log connect with {' or '.join(map(repr, known))}",
        f"say which frame is the log's world with `parent:` ({frame!r} itself if it does not move)",
    )


def _are_connected(transforms: TransformLog, parent: str, child: str) -> bool:
    try:
        find_route({**transforms.static, **transforms.moving}, parent, child)
    except ValueError:
        return False
    return True
