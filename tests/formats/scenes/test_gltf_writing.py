"""Writer of GLB: read by trimesh, and its animation against the motion that was written."""

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.formats.scenes.gltf_writing import EXPORT
from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import rotate
from pipelines.session.records import JointMotion
from tests.formats.exported import START_NS, recording, walking, without

FLOAT32_M = 1e-5  # float32 of lengths below 50 m


def written(folder: Path, motion: JointMotion | None = None) -> tuple[Path, dict[str, Any], bytes]:
    """Write a recording; return the file, its JSON and its buffer, read as the specification says."""
    whole = recording() if motion is None else replace(recording(), motion=motion)
    (path,) = EXPORT.write(whole, folder)
    data = path.read_bytes()
    magic, version, total, size, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, total, kind) == (b"glTF", 2, len(data), b"JSON")
    length, kind = struct.unpack("<I4s", data[20 + size : 28 + size])
    assert (kind, length) == (b"BIN\0", len(data) - 28 - size)
    return path, json.loads(data[20 : 20 + size]), data[28 + size :]


def animated(document: dict[str, Any], buffer: bytes, node: str, path: str) -> Float:
    """Return the values of a node's animation, [T, columns]."""
    index = [each["name"] for each in document["nodes"]].index(node)
    animation = document["animations"][0]
    (channel,) = [each for each in animation["channels"] if each["target"] == {"node": index, "path": path}]
    accessor = document["accessors"][animation["samplers"][channel["sampler"]]["output"]]
    view = document["bufferViews"][accessor["bufferView"]]
    values = np.frombuffer(buffer, "<f4", view["byteLength"] // 4, view["byteOffset"])
    return values.reshape(accessor["count"], -1).astype(np.float64)


def test_joints_and_bones_are_where_the_motion_has_them(tmp_path: Path) -> None:
    motion = without(walking(60), "left_wrist", slice(20, 30))
    _, document, buffer = written(tmp_path, motion=motion)
    x, y, z = motion.position[:, 0, motion.joints.index("left_wrist")].T
    known = np.isfinite(x)
    place = animated(document, buffer, "left_wrist", "translation")
    np.testing.assert_allclose(place[known], np.stack([x, z, -y], axis=1)[known], rtol=0, atol=FLOAT32_M)
    np.testing.assert_array_equal(place[20:30], np.repeat(place[19:20], 10, axis=0))
    size = animated(document, buffer, "left_wrist", "scale")
    np.testing.assert_array_equal(size, np.repeat(known[:, None], 3, axis=1))
    # The tip of a bar is its end: the bar's own y axis, turned, as long as the bone.
    node = next(each["name"] for each in document["nodes"] if each["name"].endswith(" to left_wrist"))
    foot, turn, size = (
        animated(document, buffer, node, path) for path in ("translation", "rotation", "scale")
    )
    tip = foot + rotate(turn, np.array([0.0, 1.0, 0.0])) * size[:, 1:2]
    np.testing.assert_allclose(tip[known], place[known], rtol=0, atol=FLOAT32_M)
    assert not size[~known].any()
    assert document["asset"]["extras"]["zero_ns"] == str(START_NS)
