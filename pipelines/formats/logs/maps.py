"""Maps in logs: octomap_msgs/Octomap, nav_msgs/OccupancyGrid, and by `clouds` sensor_msgs/PointCloud2.

Consecutive maps of a topic replace each other, as they did in flight. So every change is a map of its own,
with the stamp from which it is valid. A log of any length needs the memory of its largest map only; its
messages are read twice if there is more than one map.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import Any

import numpy as np

from pipelines.formats.logs.clouds import accumulated
from pipelines.formats.logs.map_topics import (
    OCTOMAP,
    PLACELESS,
    POINT_CLOUD,
    RECORD_AGAIN,
    LoggedMaps,
    Losses,
    MapTopic,
    evenly,
    place_at,
    time_of,
)
from pipelines.formats.logs.messages import bytes_of
from pipelines.formats.maps.octomap import leaves_of, occupancy_from
from pipelines.formats.maps.voxel_grids import Pose, extruded, placed
from pipelines.geometry.poses import compose
from pipelines.session.errors import DataError
from pipelines.session.maps import MOST_VOXELS, check_resolution
from pipelines.session.records import Message, Occupancy

MOST_MAPS = 100
"""Limit of the maps kept; a replay computes the distance field of each, which takes seconds if large."""

_EMPTY = "empty maps"
_LATE = "maps without a later stamp"
_NOT_KEPT = "maps between those that are kept"


class _EmptyMapError(Exception):
    """Error for a map without any known cell."""


@dataclass(frozen=True)
class _Change:
    """Map that differs from the one before."""

    row: int  # of its message
    t_ns: int
    voxels: int


def read_maps(read: Callable[[], Iterator[Message]], type_: str, about: MapTopic) -> LoggedMaps:
    """Read the maps of a topic, in the world's axes and by the log's times.

    Args:
        read: returns the messages in the order of receipt, anew at each call.
        type_: of the messages.
        about: settings to read them.

    Raises:
        DataError: no map is usable, or one is too large.
    """
    if type_ == POINT_CLOUD:
        return accumulated(read(), about)
    return _changing(read, about)


def _changing(read: Callable[[], Iterator[Message]], about: MapTopic) -> LoggedMaps:
    lost = Losses(about.source)
    changes: list[_Change] = []
    only: Occupancy | None = None  # the first map, while there is no other
    last, newest_ns, repeated = b"", -(2**62), 0
    for row, message in enumerate(read()):
        try:
            made = _made(message, about)
        except _EmptyMapError:
            lost.counts[_EMPTY] += 1
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
            lost.counts[_LATE] += 1
        else:
            only = None if changes else made
            last, newest_ns = digest, made.from_ns
            changes.append(_Change(row, made.from_ns, made.probability.size))
    if not changes:
        raise lost.nothing_usable()
    notes = lost.notes()
    kept = _spread(changes)
    if len(kept) < len(changes):
        lost.counts[_NOT_KEPT] += len(changes) - len(kept)
        notes.append(
            f"{about.source}: {len(kept)} of {len(changes)} changes of the map are kept, evenly over the"
            f" flight (at most {MOST_MAPS}, and {MOST_VOXELS / 1e6:g} million voxels together)"
        )
    if lost.counts[_LATE]:
        notes.append(
            f"{about.source}: maps whose stamp stands still or goes back; `stamps: receive` may be better"
        )
    if len(kept) > 1:
        notes.append(
            f"{about.source}: {len(kept)} maps that follow each other ({repeated} repeat the one before)"
        )
    maps = iter([only]) if only is not None else _made_again(read, about, kept)
    return LoggedMaps(maps, np.array([change.t_ns for change in kept], np.int64), dict(+lost.counts), notes)


def _made(message: Message, about: MapTopic) -> Occupancy | None:
    """Make the map of one message; None if the pose of its frame is unknown."""
    try:
        t_ns = time_of(message, about)
        pose = place_at(t_ns, about)
        if pose is None:
            return None
        make = _octomap if message.topic.type == OCTOMAP else _plan
        return replace(make(message.value, about, pose), from_ns=t_ns)
    except AttributeError as error:
        raise DataError(about.source, f"lacks the field {error.name!r}", RECORD_AGAIN) from error
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(about.source, f"cannot be read ({str(error)[:100]})", RECORD_AGAIN) from error


def _made_again(
    read: Callable[[], Iterator[Message]], about: MapTopic, changes: list[_Change]
) -> Iterator[Occupancy]:
    rows = {change.row for change in changes}
    for row, message in enumerate(read()):
        if row in rows:
            made = _made(message, about)
            if made is not None:
                yield made


def _spread(changes: list[_Change]) -> list[_Change]:
    """Choose as many changes as may be kept, evenly spaced, with the first and the last."""
    most = max(1, min(MOST_MAPS, MOST_VOXELS // max(change.voxels for change in changes)))
    return [changes[row] for row in evenly(len(changes), most)]


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
        raise DataError(source, f"holds {len(cells)} of {width} x {height} cells", RECORD_AGAIN)
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
        raise DataError(source, f"its origin is no pose ({[*position, *quaternion]})", RECORD_AGAIN)
    return position, quaternion / norm
