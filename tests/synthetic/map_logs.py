"""Messages of maps as they are recorded: OctoMaps, floor plans and clouds."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.typesys import get_types_from_msg

from pipelines.formats.logs.maps import OCCUPANCY_GRID, POINT_CLOUD
from pipelines.formats.logs.message_decoders import OCTOMAP
from pipelines.geometry.arrays import Float
from pipelines.session.records import Occupancy
from tests.synthetic.logged_flights import header
from tests.synthetic.logs import ROS1, ROS2, Entry

# octomap_msgs/msg/Octomap.msg of OctoMap/octomap_msgs: rosbags has only the packages of ROS itself.
for _store in (ROS1, ROS2):
    _store.register(
        get_types_from_msg(
            "std_msgs/Header header\nbool binary\nstring id\nfloat64 resolution\nint8[] data\n", OCTOMAP
        )
    )

Pose = tuple[tuple[float, ...], tuple[float, ...]]
"""Position and quaternion."""

AT_REST: Pose = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def octomap_entry(file: bytes, stamp_ns: int, *, frame: str = "map", topic: str = "/octomap") -> Entry:
    """Build the message with the content of a .bt or .ot file: its data without its header."""
    head, _, body = file.partition(b"\ndata\n")
    values = dict(re.findall(rb"(?m)^(id|res) (\S+)$", head))
    fields = {
        "header": header(stamp_ns, frame),
        "binary": b"binary" in head.splitlines()[0],
        "id": values[b"id"].decode(),
        "resolution": float(values[b"res"]),
        "data": np.frombuffer(body, np.int8),
    }
    return Entry(topic, OCTOMAP, stamp_ns, fields)


def as_bt(occupancy: Occupancy, folder: Path) -> bytes:
    """Convert a map to the bytes of a .bt file, by OctoMap's own library."""
    pyoctomap = pytest.importorskip("pyoctomap")
    folder.mkdir(parents=True, exist_ok=True)
    tree = pyoctomap.OcTree(occupancy.resolution_m)
    for index in np.argwhere(np.isfinite(occupancy.probability)):
        centre = occupancy.origin + (index + 0.5) * occupancy.resolution_m
        tree.updateNode(centre, bool(occupancy.probability[*index] >= 0.5))
    assert tree.writeBinary(str(folder / "map.bt"))
    return (folder / "map.bt").read_bytes()


def grid_entry(
    cells: NDArray[np.int8], stamp_ns: int, *, origin: Pose = AT_REST, frame: str = "map", topic: str = "/map"
) -> Entry:
    """Build the message of a floor plan of cells [X, Y]."""
    position, quaternion = origin
    info = {
        "resolution": 0.5,
        "width": cells.shape[0],
        "height": cells.shape[1],
        "origin": {
            "position": dict(zip("xyz", position, strict=True)),
            "orientation": dict(zip("xyzw", quaternion, strict=True)),
        },
    }
    fields = {"header": header(stamp_ns, frame), "info": info, "data": np.ascontiguousarray(cells.T).ravel()}
    return Entry(topic, OCCUPANCY_GRID, stamp_ns, fields)


def cloud_fields(
    points: Float,
    *,
    kind: str = "f4",
    big_endian: bool = False,
    rows: int = 1,
    row_padding: int = 0,
    order: str = "xyz",
) -> dict[str, Any]:
    """Build a cloud's message without its header: points [N, 3] in records with other bytes between them."""
    size = int(kind[1])
    offsets = {name: 3 + k * (size + 1) for k, name in enumerate(order)}  # aligned nowhere
    stride = 3 + 3 * (size + 1) + 2
    prefix = ">" if big_endian else "<"
    names = list(offsets)
    record = np.dtype(
        {
            "names": names,
            "formats": [prefix + kind] * 3,
            "offsets": [offsets[name] for name in names],
            "itemsize": stride,
        }
    )
    packed = np.zeros(len(points), record)
    for axis, name in enumerate("xyz"):
        packed[name] = points[:, axis]
    width = len(points) // rows
    lines = np.frombuffer(packed.tobytes(), np.uint8).reshape(rows, width * stride)
    lines = np.pad(lines, ((0, 0), (0, row_padding)), constant_values=255)
    datatype = {"f4": 7, "f8": 8}[kind]
    described = [{"name": "intensity", "offset": 0, "datatype": 2, "count": 1}]
    described += [
        {"name": name, "offset": at, "datatype": datatype, "count": 1} for name, at in offsets.items()
    ]
    return {
        "height": rows,
        "width": width,
        "fields": described,
        "is_bigendian": big_endian,
        "point_step": stride,
        "row_step": width * stride + row_padding,
        "data": lines.ravel(),
        "is_dense": False,
    }


def cloud_entry(
    fields: Mapping[str, Any], stamp_ns: int, *, frame: str = "map", topic: str = "/cloud"
) -> Entry:
    """Build the message of a cloud."""
    return Entry(topic, POINT_CLOUD, stamp_ns, {"header": header(stamp_ns, frame), **fields})


def transform_entry(parent: str, child: str, pose: Pose, stamp_ns: int, *, topic: str = "/tf") -> Entry:
    """Build one transform of /tf or /tf_static."""
    position, quaternion = pose
    stated = {
        "header": header(stamp_ns, parent),
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", position, strict=True)),
            "rotation": dict(zip("xyzw", quaternion, strict=True)),
        },
    }
    return Entry(topic, "tf2_msgs/msg/TFMessage", stamp_ns, {"transforms": [stated]})
