"""Writer of GLB: animations and skinned bodies, read as glTF says and by trimesh."""

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from pipelines.formats.scenes.gltf_writing import EXPORT, MESH_EXPORT
from pipelines.geometry.arrays import Float
from pipelines.geometry.body_model import Skinning, body_model, shape_of
from pipelines.geometry.poses import matrix_from_quaternion, quaternion_from_rotation_vector, rotate
from pipelines.geometry.rig import BONES
from pipelines.session.errors import DataError
from pipelines.session.records import JointMotion, MovingBody
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


TYPES = {5126: ("<f4", 4), 5123: ("<u2", 2)}
COLUMNS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def body_of(t_ns: np.ndarray[Any, Any]) -> MovingBody:
    """Return a body in random poses."""
    rng, model, shape = np.random.default_rng(0), body_model(), shape_of("female", "average", 1.6)
    rotation = quaternion_from_rotation_vector(rng.normal(0, 0.3, (len(t_ns), len(BONES), 3)))
    shares = np.array([1.0, *shape[1:]])
    steps, joint = (shape[0] * np.tensordot(shares, part, 1) for part in (model.steps, model.joint))
    root = np.stack([np.arange(len(t_ns), dtype=np.float64), np.zeros(len(t_ns)), np.ones(len(t_ns))], axis=1)
    skinning = Skinning(joint, model.neutral_from_rest, steps)
    matrix, translation = skinning.transforms(root, rotation)
    centre = np.einsum("tbij,bj->tbi", matrix[:, : len(BONES)], joint) + translation[:, : len(BONES)]
    return MovingBody(0, t_ns, shape, centre, rotation, np.ones(centre.shape[:2]))


def test_the_skin_of_the_file_is_the_surface_of_the_model(tmp_path: Path) -> None:
    motion = walking(60)
    body = body_of(motion.t_ns)
    (path,) = MESH_EXPORT.write(replace(recording(), motion=motion, bodies=lambda: [body]), tmp_path)
    data = path.read_bytes()
    size = struct.unpack("<I", data[12:16])[0]
    document, buffer = json.loads(data[20 : 20 + size]), data[28 + size :]

    def array(number: int) -> Float:
        accessor = document["accessors"][number]
        view, (code, width) = (
            document["bufferViews"][accessor["bufferView"]],
            TYPES[accessor["componentType"]],
        )
        count = accessor["count"] * COLUMNS[accessor["type"]]
        assert view["byteLength"] == count * width
        values = np.frombuffer(buffer, code, count, view["byteOffset"])
        return values.reshape(accessor["count"], -1).astype(np.float64)

    (skin,) = document["skins"]
    moment, animation, world = 7, document["animations"][0], []
    times = array(animation["samplers"][0]["input"])
    parent = document["nodes"][skin["skeleton"]]
    up = np.eye(4)
    up[:3, :3] = matrix_from_quaternion(np.array(parent["rotation"]))
    assert parent["children"] == skin["joints"]
    for joint in skin["joints"]:
        values = {
            channel["target"]["path"]: array(animation["samplers"][channel["sampler"]]["output"])[moment]
            for channel in animation["channels"]
            if channel["target"]["node"] == joint
        }
        local = np.eye(4)
        local[:3, :3], local[:3, 3] = matrix_from_quaternion(values["rotation"]), values["translation"]
        world.append(up @ local)
    inverse = array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    rest, weight = array(attributes["POSITION"]), array(attributes["WEIGHTS_0"])
    bones = array(attributes["JOINTS_0"]).astype(np.int64)
    np.testing.assert_allclose(weight.sum(axis=1), 1.0, atol=1e-6)
    matrix = np.einsum("vk,vkij->vij", weight, (np.array(world) @ inverse)[bones])
    moved = np.einsum("vij,vj->vi", matrix[:, :3, :3], rest) + matrix[:, :3, 3]
    row = int(np.argmin(np.abs((motion.t_ns - motion.t_ns[0]) / 1e9 - times[moment, 0])))
    true = body_model().surface(body.shape, body.centre[row, 0], body.rotation[row])
    away = np.linalg.norm(moved - true[:, [0, 2, 1]] * [1.0, 1.0, -1.0], axis=1)
    assert away.max() < 0.03  # a vertex of more than four bones keeps the four strongest
    assert away.mean() < 0.0005

    scene = trimesh.load_scene(path)
    (mesh,) = scene.geometry.values()
    assert mesh.faces.shape == (2 * len(body_model().quads), 3)
    np.testing.assert_allclose(np.sort(mesh.extents), np.sort(np.ptp(rest, axis=0)), atol=1e-5)


def test_without_a_body_there_is_nothing_to_export(tmp_path: Path) -> None:
    with pytest.raises(DataError) as error:
        MESH_EXPORT.write(recording(), tmp_path)
    assert error.value.code == "no-body"
