"""Common parts of all map messages: time, frame, pose of the frame, and losses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from pipelines.formats.logs.message_decoders import Decoder, Schema, decoder
from pipelines.formats.logs.messages import nanoseconds
from pipelines.formats.logs.recordings import OpenLog
from pipelines.formats.logs.trajectories import Stamps
from pipelines.formats.maps.voxel_grids import Pose
from pipelines.geometry.poses import interpolate_poses
from pipelines.session.errors import DataError
from pipelines.session.records import Int64, Message, Occupancy, Trajectory
from pipelines.session.registries import Log

OCTOMAP = "octomap_msgs/msg/Octomap"
OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
MAP_TYPES = (OCTOMAP, OCCUPANCY_GRID, POINT_CLOUD)

DAMAGED = "map messages that cannot be used"
PLACELESS = "map messages at whose time no transform is known"
RECORD_AGAIN = "check what wrote the log"

# Definition that rosbags lacks: logs of ROS 2 up to Humble carry no definitions.
_OCTOMAP_DEFINITION = """std_msgs/Header header
bool binary
string id
float64 resolution
int8[] data
================================================================================
MSG: std_msgs/Header
{sequence}builtin_interfaces/Time stamp
string frame_id
"""


@dataclass(frozen=True)
class MapTopic:
    """Settings to read the messages of a topic of maps.

    Args:
        source: log and topic, for messages.
        frame: of all its messages.
        stamps: the stamps in use: header or receive.
        world_from_frame: poses of that frame; a single row always holds.
        max_gap_ns: the longest gap between two of its rows that is interpolated.
        resolution_m: side of the voxels, if it is stated.
        height_m: height of the cells of a floor plan.
    """

    source: str
    frame: str
    stamps: Stamps
    world_from_frame: Trajectory
    max_gap_ns: int
    resolution_m: float | None
    height_m: float


@dataclass(frozen=True)
class LoggedMaps:
    """Maps of a topic in the order of their times, with losses and notes."""

    maps: Iterator[Occupancy]  # made one at a time
    from_ns: Int64  # [K] of each, strictly increasing
    dropped: dict[str, int]  # by cause
    notes: list[str] = field(default_factory=list)


def map_messages(recording: Log, topic: str) -> Iterator[Message]:
    """Yield the messages of a topic of maps, in the order of receipt."""
    if isinstance(recording, OpenLog):
        return recording.messages([topic], _decoder)
    return recording.messages([topic])


def frame_of(message: Message, source: str) -> str:
    """Return the frame of a map, without the leading slash of ROS 1.

    Raises:
        DataError: the message has no readable frame.
    """
    try:
        return str(message.value.header.frame_id).lstrip("/")
    except AttributeError as error:
        raise DataError(source, f"its messages lack the field {error.name!r}", RECORD_AGAIN) from error


class Losses:
    """Messages of a topic that could not be used.

    Attributes:
        counts: number of messages by cause.
    """

    def __init__(self, source: str, counts: Mapping[str, int] | None = None) -> None:
        self.counts: Counter[str] = Counter(counts)
        self._source = source
        self._first: DataError | None = None

    def damaged(self, fault: DataError) -> None:
        """Count a message that cannot be read; keep the first fault for the note."""
        self.counts[DAMAGED] += 1
        self._first = self._first or fault

    def notes(self) -> list[str]:
        """Return a note about the messages that cannot be read; empty if all can."""
        if self._first is None:
            return []
        return [f"{self._source}: {self._first.problem} ({self.counts[DAMAGED]} such messages)"]

    def nothing_usable(self) -> DataError:
        """Return the error for a topic without a usable map: the first fault, else the losses."""
        if self._first is not None:
            return self._first
        causes = ", ".join(f"{count} {cause}" for cause, count in (+self.counts).items())
        return DataError(
            self._source,
            f"holds no map ({causes or 'it is empty'})",
            "name another topic, or leave `map:` out",
        )


def evenly(count: int, most: int) -> list[int]:
    """Return at most `most` of `count` rows, evenly spaced, always with the last one."""
    if count <= most:
        return list(range(count))
    rows: list[int] = np.linspace(count - 1, 0, most).round().astype(int)[::-1].tolist()
    return rows


def time_of(message: Message, about: MapTopic) -> int:
    """Return the stamp to use.

    Raises:
        DataError: the message lies in another frame than those before it.
    """
    if (frame := frame_of(message, about.source)) != about.frame:
        raise DataError(
            about.source, f"lies in frame {frame!r}, the messages before in {about.frame!r}", RECORD_AGAIN
        )
    stamp_ns = nanoseconds(message.value.header.stamp) if about.stamps == "header" else 0
    return stamp_ns or message.receive_ns


def place_at(t_ns: int, about: MapTopic) -> Pose | None:
    """Return the pose of a topic's frame in the world; None if no transform gives it."""
    poses = about.world_from_frame
    if len(poses.t_ns) == 1:
        return poses.position[0], poses.quaternion_xyzw[0]
    after = int(np.searchsorted(poses.t_ns, t_ns))
    around = slice(max(after - 1, 0), after + 1)
    position, quaternion = interpolate_poses(
        poses.t_ns[around],
        poses.position[around],
        poses.quaternion_xyzw[around],
        np.array([t_ns], np.int64),
        max_gap_ns=about.max_gap_ns,
        max_extrapolation_ns=0,
    )
    return None if np.isnan(position[0, 0]) else (position[0], quaternion[0])


def _decoder(schema: Schema) -> Decoder:
    """Make a decoder like `decoder`, also for octomap_msgs/Octomap without a definition in the log."""
    if schema.type == OCTOMAP and not schema.definition and schema.encoding in {"ros1", "cdr"}:
        is_ros1 = schema.encoding == "ros1"
        text = _OCTOMAP_DEFINITION.format(sequence="uint32 seq\n" if is_ros1 else "")
        if is_ros1:
            text = text.replace("builtin_interfaces/Time", "time")
        else:
            text += "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
        schema = replace(
            schema, definition_encoding="ros1msg" if is_ros1 else "ros2msg", definition=text.encode()
        )
    return decoder(schema)
