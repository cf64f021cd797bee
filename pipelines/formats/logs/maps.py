"""Maps in logs: Octomap, OccupancyGrid and PointCloud2.

Consecutive octomaps and floor plans of a topic replace each other: every change is a map of its own, with the
stamp from which it is valid. Point clouds become maps that grow: each holds all points up to one of a few
times of the flight. Moving things, above all the actor, leave a trace of occupied voxels. Only the largest
map is in memory.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Set
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from hashlib import sha256
from typing import Any

import numpy as np

from pipelines.formats.logs.message_decoders import OCTOMAP
from pipelines.formats.logs.messages import FAULTS, Stamps, bytes_of, nanoseconds
from pipelines.formats.maps.octomap import leaves_of, occupancy_from
from pipelines.formats.maps.voxel_grids import Pose, VoxelSet, extruded, placed
from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.poses import compose, interpolate_poses, transform
from pipelines.session.errors import DataError
from pipelines.session.maps import MOST_VOXELS, check_resolution
from pipelines.session.records import Message, Occupancy, Trajectory
from pipelines.session.storage import damaged

OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
MAP_TYPES = (OCTOMAP, OCCUPANCY_GRID, POINT_CLOUD)

MOST_MAPS = 100
"""Limit of the maps kept; a replay computes the distance field of each, which takes seconds if large."""

MOST_CLOUD_MAPS = 10
"""Largest number of times at which the points so far become a map."""

# Causes of losses.
DAMAGED = "map messages that cannot be used"
PLACELESS = "map messages at whose time no transform is known"
EMPTY = "empty maps"
LATE = "maps without a later stamp"
NOT_KEPT = "maps between those that are kept"

# Types that coordinates can have, by the numbers of sensor_msgs/PointField.
_FLOAT_TYPES = {7: "f4", 8: "f8"}


@dataclass(frozen=True)
class MapTopic:
    """Settings to read the messages of a topic of maps."""

    source: str  # log and topic, for messages
    frame: str  # of all its messages
    stamps: Stamps
    world_from_frame: Trajectory  # a single row always holds
    max_gap_ns: int  # the longest gap between two of its rows that is interpolated
    resolution_m: float | None  # side of the voxels, if it is stated
    height_m: float  # of the cells of a floor plan


@dataclass(frozen=True)
class LoggedMaps:
    """Maps of a topic in the order of their times, with losses and notes."""

    maps: Iterator[Occupancy]  # made one at a time
    from_ns: Int64  # [K] of each, strictly increasing
    dropped: dict[str, int]  # by cause
    notes: list[str] = field(default_factory=list)


class _EmptyMapError(Exception):
    """Error for a map without any known cell."""


def read_maps(read: Callable[[], Iterator[Message]], type_: str, about: MapTopic) -> LoggedMaps:
    """Read the maps of a topic, in the world's axes, by the log's times; each `read()` begins anew."""
    if type_ == POINT_CLOUD:
        return _accumulated(read(), about)
    return _changing(read, about)


def frame_of(message: Message, source: str) -> str:
    """Return the frame of a map, without the leading slash of ROS 1."""
    try:
        return str(message.value.header.frame_id).lstrip("/")
    except AttributeError as error:
        raise damaged(source, f"its messages lack the field {error.name!r}") from error


class Losses:
    """Messages of a topic that could not be used, counted by cause."""

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
            code="empty",
        )


def evenly(count: int, most: int) -> list[int]:
    """Return at most `most` of `count` rows, evenly spaced, always with the last one."""
    if count <= most:
        return list(range(count))
    rows: list[int] = np.linspace(count - 1, 0, most).round().astype(int)[::-1].tolist()
    return rows


def _time_of(message: Message, about: MapTopic) -> int:
    if (frame := frame_of(message, about.source)) != about.frame:
        raise damaged(about.source, f"lies in frame {frame!r}, the messages before in {about.frame!r}")
    stamp_ns = nanoseconds(message.value.header.stamp) if about.stamps == "header" else 0
    return stamp_ns or message.receive_ns


def _place_at(t_ns: int, about: MapTopic) -> Pose | None:
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
    )
    return None if np.isnan(position[0, 0]) else (position[0], quaternion[0])


def _changing(read: Callable[[], Iterator[Message]], about: MapTopic) -> LoggedMaps:
    lost = Losses(about.source)
    changes: list[tuple[int, int, int]] = []  # row and time of the message, voxels
    only: Occupancy | None = None  # the first map, while there is no other
    last, newest_ns, repeated = b"", -(2**62), 0
    for row, message in enumerate(read()):
        try:
            made = _made(message, about)
        except _EmptyMapError:
            lost.counts[EMPTY] += 1
            continue
        except DataError as fault:
            lost.damaged(fault)
            continue
        if made is None:
            lost.counts[PLACELESS] += 1
            continue
        digest = _digest(made)
        if digest == last:
            repeated += 1
        elif made.from_ns <= newest_ns:
            lost.counts[LATE] += 1
        else:
            only = None if changes else made
            last, newest_ns = digest, made.from_ns
            changes.append((row, made.from_ns, made.probability.size))
    if not changes:
        raise lost.nothing_usable()
    notes = lost.notes()
    most = max(1, min(MOST_MAPS, MOST_VOXELS // max(voxels for _, _, voxels in changes)))
    kept = [changes[row] for row in evenly(len(changes), most)]
    if len(kept) < len(changes):
        lost.counts[NOT_KEPT] += len(changes) - len(kept)
        notes.append(
            f"{about.source}: {len(kept)} of {len(changes)} changes of the map are kept, evenly over the"
            f" flight (at most {MOST_MAPS}, and {MOST_VOXELS / 1e6:g} million voxels together)"
        )
    if lost.counts[LATE]:
        notes.append(
            f"{about.source}: maps whose stamp stands still or goes back; `stamps: receive` may be better"
        )
    if len(kept) > 1:
        notes.append(
            f"{about.source}: {len(kept)} maps that follow each other ({repeated} repeat the one before)"
        )
    maps = iter([only]) if only is not None else _made_again(read, about, {row for row, _, _ in kept})
    return LoggedMaps(maps, np.array([t_ns for _, t_ns, _ in kept], np.int64), dict(+lost.counts), notes)


def _made(message: Message, about: MapTopic) -> Occupancy | None:
    """Make the map of one message; None if the pose of its frame is unknown."""
    with _one_line(about):
        t_ns = _time_of(message, about)
        pose = _place_at(t_ns, about)
        if pose is None:
            return None
        make = _octomap if message.topic.type == OCTOMAP else _plan
        return replace(make(message.value, about, pose), from_ns=t_ns)


@contextmanager
def _one_line(about: MapTopic) -> Iterator[None]:
    """Turn errors from fields of a message into one of the topic."""
    try:
        yield
    except FAULTS as error:
        raise damaged(about.source, f"a message cannot be read ({str(error)[:100]})") from error


def _made_again(
    read: Callable[[], Iterator[Message]], about: MapTopic, rows: Set[int]
) -> Iterator[Occupancy]:
    for row, message in enumerate(read()):
        if row in rows:
            made = _made(message, about)
            if made is not None:
                yield made


def _digest(occupancy: Occupancy) -> bytes:
    place = (*occupancy.origin.tolist(), occupancy.resolution_m, *occupancy.probability.shape)
    digest = sha256(repr(place).encode())
    digest.update(np.ascontiguousarray(occupancy.probability).tobytes())
    return digest.digest()


def _octomap(value: Any, about: MapTopic, pose: Pose) -> Occupancy:
    # A copy, because the compiled walk needs aligned numbers and messages may begin at any byte.
    payload = np.frombuffer(bytes_of(value.data).tobytes(), np.uint8)
    if not len(payload):
        raise _EmptyMapError
    finest_m = check_resolution(about.source, float(value.resolution))
    leaves = leaves_of(about.source, payload, is_binary=bool(value.binary), tree=str(value.id))
    if not len(leaves.depth):
        raise _EmptyMapError
    grid = occupancy_from(about.source, leaves, finest_m, about.resolution_m)
    return placed(about.source, grid, pose)


def _plan(value: Any, about: MapTopic, pose: Pose) -> Occupancy:
    info, source = value.info, about.source
    width, height = int(info.width), int(info.height)
    cells = bytes_of(value.data).view(np.int8)
    if len(cells) != width * height:
        raise damaged(source, f"holds {len(cells)} of {width} x {height} cells")
    if ((cells < -1) | (cells > 100)).any():
        worst = int(cells[(cells < -1) | (cells > 100)][0])
        raise DataError(source, f"holds a cell of {worst}", "-1 is unknown, else 0 to 100 percent")
    if not (cells >= 0).any():
        raise _EmptyMapError
    # The message has a float32: 0.0500000007 stands for 0.05.
    cell_m = check_resolution(source, float(str(np.float32(info.resolution))))
    plan = np.where(cells < 0, np.nan, cells / 100).astype(np.float32).reshape(height, width).T
    return extruded(
        source,
        plan,
        cell_m,
        compose(pose, _origin(info.origin, source)),
        side_m=cell_m if about.resolution_m is None else check_resolution(source, about.resolution_m),
        height_m=about.height_m,
    )


def _origin(stated: Any, source: str) -> Pose:
    """Return the pose of a plan's corner; a quaternion of zeros, which is common, means no rotation."""
    at, turned = stated.position, stated.orientation
    position = np.array([at.x, at.y, at.z], dtype=np.float64)
    quaternion = np.array([turned.x, turned.y, turned.z, turned.w], dtype=np.float64)
    norm = float(np.sqrt((quaternion * quaternion).sum()))
    if norm == 0:
        return position, np.array([0.0, 0.0, 0.0, 1.0])
    if not np.isfinite(position).all() or not abs(norm - 1) < 0.1:
        raise damaged(source, f"its origin is no pose ({[*position, *quaternion]})")
    return position, quaternion / norm


def _accumulated(messages: Iterator[Message], about: MapTopic) -> LoggedMaps:
    """Accumulate the clouds of a topic to maps, in the world's axes and by the log's times."""
    lost = Losses(about.source)
    voxels = VoxelSet(about.source, about.resolution_m)
    clouds = 0
    for message in messages:
        try:
            with _one_line(about):
                t_ns = _time_of(message, about)
                pose = _place_at(t_ns, about)
                points = cloud_points(message.value, about.source)
        except DataError as fault:
            lost.damaged(fault)
            continue
        if pose is None:
            lost.counts[PLACELESS] += 1
            continue
        with np.errstate(invalid="ignore", over="ignore"):  # NaN and infinity stay, and are counted
            # Points of the world's own frame keep every bit.
            is_world = not pose[0].any() and pose[1].tolist() == [0.0, 0.0, 0.0, 1.0]
            voxels.add(points if is_world else transform(pose, points), t_ns)
        clouds += 1
    lost.counts.update(voxels.dropped)
    grew_ns = voxels.grew_ns
    if not len(grew_ns):
        raise lost.nothing_usable()
    most = max(1, min(MOST_CLOUD_MAPS, MOST_VOXELS // int(np.prod(voxels.shape))))
    from_ns = grew_ns[evenly(len(grew_ns), most)]
    notes = lost.notes()
    notes.append(
        f"{about.source}: {clouds} clouds make {len(from_ns)} maps, each of what had been seen by then;"
        " what moved, like the actor, stays in them"
    )
    return LoggedMaps((voxels.occupancy(int(t_ns)) for t_ns in from_ns), from_ns, dict(+lost.counts), notes)


def cloud_points(value: Any, source: str) -> Float:
    """Return the points [N, 3] of a PointCloud2 in its own frame; NaN stays NaN."""
    width, height, stride = int(value.width), int(value.height), int(value.point_step)
    order = ">" if value.is_bigendian else "<"
    fields = {str(each.name): each for each in value.fields}
    columns: list[tuple[str, str, int]] = []
    for name in ("x", "y", "z"):
        kind = _FLOAT_TYPES.get(int(fields[name].datatype)) if name in fields else None
        if kind is None:
            stated = f"of type {int(fields[name].datatype)}" if name in fields else "not there"
            raise DataError(source, f"its field {name} is {stated}", "x, y, z of float32 or float64 are read")
        columns.append((name, order + kind, int(fields[name].offset)))
    row_bytes = int(value.row_step) or width * stride
    data = bytes_of(value.data)
    if row_bytes < width * stride or len(data) < row_bytes * height:
        raise damaged(source, f"a cloud breaks off: {len(data)} bytes for {width} x {height} points")
    # Fields that lie beyond the point are a ValueError here. Rows may be padded, and values unaligned.
    names, formats, offsets = zip(*columns, strict=True)
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": stride})
    rows = data[: row_bytes * height].reshape(height, row_bytes)[:, : width * stride]
    records = np.frombuffer(rows.tobytes(), layout)
    with np.errstate(invalid="ignore"):  # the conversion of a signalling NaN warns
        return np.stack([records[name].astype(np.float64) for name in names], axis=1)
