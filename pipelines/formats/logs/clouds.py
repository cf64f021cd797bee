"""Conversion of point clouds in logs (sensor_msgs/PointCloud2) to maps that grow.

A voxel is occupied from the time of its first point on. Each map holds all points up to one of a few times
of the flight. Moving things, above all the actor, leave a trace of occupied voxels.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from pipelines.formats.logs.map_topics import (
    PLACELESS,
    RECORD_AGAIN,
    LoggedMaps,
    Losses,
    MapTopic,
    evenly,
    place_at,
    time_of,
)
from pipelines.formats.logs.messages import bytes_of
from pipelines.formats.maps.voxel_grids import Pose, VoxelSet
from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import transform
from pipelines.session.errors import DataError
from pipelines.session.maps import MOST_VOXELS
from pipelines.session.records import Message

MOST_CLOUD_MAPS = 10
"""Largest number of times at which the points so far become a map."""

# Types that coordinates can have, by the numbers of sensor_msgs/PointField.
_FLOAT_TYPES = {7: "f4", 8: "f8"}


def accumulated(messages: Iterator[Message], about: MapTopic) -> LoggedMaps:
    """Accumulate the clouds of a topic to maps, in the world's axes and by the log's times.

    Raises:
        DataError: no point is usable, or their box is too large.
    """
    lost = Losses(about.source)
    voxels = VoxelSet(about.source, about.resolution_m)
    clouds = 0
    for message in messages:
        try:
            t_ns = time_of(message, about)
            pose = place_at(t_ns, about)
            points = cloud_points(message.value, about.source)
        except (AttributeError, TypeError, ValueError, OverflowError) as error:
            lost.damaged(
                DataError(about.source, f"a cloud cannot be read ({str(error)[:100]})", RECORD_AGAIN)
            )
            continue
        except DataError as fault:
            lost.damaged(fault)
            continue
        if pose is None:
            lost.counts[PLACELESS] += 1
            continue
        with np.errstate(invalid="ignore", over="ignore"):  # NaN and infinity stay, and are counted
            voxels.add(points if _is_the_world(pose) else transform(pose, points), t_ns)
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
    """Return the points [N, 3] of a PointCloud2 in its own frame; NaN stays NaN.

    Raises:
        DataError: no x, y, z of float32 or float64, or fewer bytes than the message states.
    """
    width, height, stride = int(value.width), int(value.height), int(value.point_step)
    order = ">" if value.is_bigendian else "<"
    fields = {str(each.name): each for each in value.fields}
    columns: dict[str, tuple[str, int]] = {}
    for name in ("x", "y", "z"):
        kind = _FLOAT_TYPES.get(int(fields[name].datatype)) if name in fields else None
        if kind is None:
            stated = f"of type {int(fields[name].datatype)}" if name in fields else "not there"
            raise DataError(source, f"its field {name} is {stated}", "x, y, z of float32 or float64 are read")
        offset = int(fields[name].offset)
        if offset < 0 or offset + int(kind[1]) > stride:
            raise DataError(
                source, f"its field {name} lies beyond the {stride} bytes of a point", RECORD_AGAIN
            )
        columns[name] = order + kind, offset
    row_bytes = int(value.row_step) or width * stride
    data = bytes_of(value.data)
    if row_bytes < width * stride or len(data) < row_bytes * height:
        raise DataError(
            source, f"a cloud breaks off: {len(data)} bytes for {width} x {height} points", RECORD_AGAIN
        )
    # Rows may be padded, and values may be unaligned, so they are copied.
    rows = np.ascontiguousarray(data[: row_bytes * height].reshape(height, row_bytes)[:, : width * stride])
    records = rows.reshape(-1, stride) if width * height else rows.reshape(0, stride)
    points = np.empty((len(records), 3))
    with np.errstate(invalid="ignore"):  # the conversion of a signalling NaN warns
        for axis, (kind, offset) in enumerate(columns.values()):
            values = np.ascontiguousarray(records[:, offset : offset + np.dtype(kind).itemsize])
            points[:, axis] = values.view(kind)[:, 0] if len(values) else 0
    return points


def _is_the_world(pose: Pose) -> bool:
    """Return True for the identity pose: points of the world's own frame then keep every bit."""
    return not pose[0].any() and pose[1].tolist() == [0.0, 0.0, 0.0, 1.0]
