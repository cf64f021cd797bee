"""Reader of commanded positions: setpoints, and plans that replace each other, from on-board planners.

A plan (nav_msgs/Path with times, MultiDOFJointTrajectory) looks ahead and is replaced by the next one: each
is valid from its first point to the first point of the next. mavros_msgs/PositionTarget is one setpoint in
the log's axes, as `setpoint_raw` expects it.
"""

from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np

from pipelines.formats.logs.messages import FAULTS, Stamps, nanoseconds, unreadable
from pipelines.formats.poses.pose_rows import clean_poses
from pipelines.session.errors import DataError
from pipelines.session.records import Message, Trajectory
from pipelines.session.registries import Log

PATH = "nav_msgs/msg/Path"
TRAJECTORY = "trajectory_msgs/msg/MultiDOFJointTrajectory"
TARGET = "mavros_msgs/msg/PositionTarget"
COMMAND_TYPES = (PATH, TRAJECTORY, TARGET)
"""Message types that are read here; setpoints that are poses (PoseStamped, Odometry) are read as poses."""

_LOCAL_FRAME, _NO_POSITION = 1, 0b111  # PositionTarget: coordinate_frame, and type_mask of x, y, z

_Point = tuple[int, float, float, float]


class _Way:
    """Points in the order of time; a later plan replaces all points from its beginning on."""

    def __init__(self) -> None:
        self._t_ns = array("q")
        self._position = array("d")

    def replace_from(self, points: list[_Point]) -> None:
        """Add a plan: it replaces all earlier points from its first time on."""
        kept = bisect_left(self._t_ns, points[0][0])
        del self._t_ns[kept:], self._position[3 * kept :]
        for t_ns, *place in points:
            self._t_ns.append(t_ns)
            self._position.extend(place)

    def trajectory(self, source: str) -> Trajectory:
        """Return the points as a clean trajectory; the rotation is the identity."""
        position = np.frombuffer(self._position, dtype=np.float64).reshape(-1, 3)
        level = np.tile([0.0, 0.0, 0.0, 1.0], (len(position), 1))
        readable = np.ones(len(position), dtype=np.bool_)
        return clean_poses(source, np.frombuffer(self._t_ns, dtype=np.int64), readable, position, level)


def read_commands(recording: Log, source: str, topic: str, stamps: Stamps) -> Trajectory:
    """Read the positions that a topic of one of `COMMAND_TYPES` commanded, in the axes of the log.

    By the stamps of receipt, a plan begins at the time of its receipt.

    Setpoints without a position or relative to the body are dropped and counted, and so are empty
    plans. The rotation is the identity and has no meaning.
    """
    way, dropped = _Way(), Counter[str]()
    for message in recording.messages([topic]):
        try:
            points = list(_POINTS[message.topic.type](message, dropped))
        except FAULTS as error:
            raise unreadable(message, source, error) from error
        if not points:
            continue
        if any(later[0] <= earlier[0] for earlier, later in pairwise(points)):
            raise DataError(
                source,
                f"topic {topic}: the points of a plan have no times of their own",
                "name a topic of setpoints instead",
            )
        late_ns = message.receive_ns - points[0][0] if stamps == "receive" or not points[0][0] else 0
        way.replace_from([(t_ns + late_ns, x, y, z) for t_ns, x, y, z in points])
    found = way.trajectory(f"{source} {topic}")
    found.dropped.update(Counter(found.dropped) + dropped)
    return found


def _of_path(message: Message, dropped: Counter[str]) -> Iterator[_Point]:
    if not message.value.poses:
        dropped["empty plan"] += 1
    for stated in message.value.poses:
        yield _point(nanoseconds(stated.header.stamp), stated.pose.position)


def _of_trajectory(message: Message, dropped: Counter[str]) -> Iterator[_Point]:
    value = message.value
    if not value.points:
        dropped["empty plan"] += 1
    begins_ns = nanoseconds(value.header.stamp)
    for stated in value.points:
        if len(stated.transforms) != 1:
            raise ValueError(f"it moves {len(stated.transforms)} things, not one")
        after_ns = nanoseconds(stated.time_from_start)
        yield _point(begins_ns + after_ns, stated.transforms[0].translation)


def _of_target(message: Message, dropped: Counter[str]) -> Iterator[_Point]:
    value = message.value
    if value.type_mask & _NO_POSITION:
        dropped["setpoint without a position"] += 1
    elif value.coordinate_frame != _LOCAL_FRAME:
        dropped["setpoint relative to the body"] += 1
    else:
        yield _point(nanoseconds(value.header.stamp), value.position)


def _point(t_ns: int, position: Any) -> _Point:
    return t_ns, float(position.x), float(position.y), float(position.z)


_POINTS = {PATH: _of_path, TRAJECTORY: _of_trajectory, TARGET: _of_target}
