"""Exports to glTF 2.0, for Blender and viewers of the web: the moving skeleton and the cameras; bodies.

Every joint is an octahedron and every bone a bar, both moved by animation; a missing one has the size zero,
and so has a missing body. The (x, y, z) of the file are the world's (x, z, -y). Second 0 is `zero_ns` of the
asset's extras. At most 30 moments a second are written. The same recording gives the same bytes.

The surface of a body rests as `geometry.body_model` has it. Each of its moving bones is a node in the world's
axes, below one node that turns z up into y up. A vertex follows its four strongest bones. Source: Khronos,
glTF 2.0 Specification (2021): 3.6.2 accessors, 3.7.3 skins, 3.11 animations, 3.10 cameras, 4 GLB.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.formats.common.exporting import bodies_of, safe_file_name, thinned
from pipelines.geometry.arrays import Float, Int64, Intrinsics, nearest_rows
from pipelines.geometry.body_model import body_model
from pipelines.geometry.poses import continuous_signs, multiply
from pipelines.session.errors import DataError
from pipelines.session.people import bones_of, side_of, with_derived
from pipelines.session.records import JointMotion, MovingBody, Recording, Trajectory

# Viewers interpolate between key frames of this rate without a visible difference.
KEY_FRAMES_HZ = 30.0
_JOINT_M, _BONE_M = 0.022, 0.014  # radius of the spheres, half the width of the bars
FROM_WORLD = np.array([-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])  # about x by -90 degrees: z up becomes y up
_AHEAD = np.array([1.0, 0.0, 0.0, 0.0])  # about x by 180 degrees: z forward and y down become -z and y up
_FLOAT, _UINT16 = 5126, 5123
ARRAY_BUFFER, INDEX_BUFFER = 34962, 34963
_MATERIALS = {"": (0.30, 0.33, 0.36), "left": (0.01, 0.19, 0.46), "right": (0.58, 0.09, 0.01)}  # linear RGB
# A GLB counts its bytes in 32 bits.
_LARGEST = (1 << 32) - (1 << 16)


class GlbExport:
    """Writer of `<name>.glb`: skeleton and cameras, animated."""

    name = "glb"
    title = "the moving skeleton and the cameras as glTF, for Blender and the web"

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write the skeleton of every person, and the cameras while it lasts."""
        motion = recording.motion
        if motion is None or np.isnan(motion.position).all():
            raise DataError(recording.name, "holds no joints to export", "run `mocap reconstruct` first")
        rows = thinned(motion.t_ns, KEY_FRAMES_HZ)
        if len(rows) < len(motion.t_ns):
            recording.progress.note(
                f"glb: {len(rows)} of {len(motion.t_ns)} moments, at most {KEY_FRAMES_HZ:g} a second"
            )
        t_ns = motion.t_ns[rows]
        asset = GltfAsset((t_ns - t_ns[0]) / 1e9)
        spheres = {side: asset.mesh(*_octahedron(_JOINT_M), side) for side in _MATERIALS}
        corners, triangles = _octahedron(1.0)
        corners = corners * [_BONE_M, 0.5, _BONE_M] + [0.0, 0.5, 0.0]  # along y from 0 to 1
        bars = {side: asset.mesh(corners, triangles, side) for side in _MATERIALS}
        for person in range(motion.position.shape[1]):
            label = f"{recording.name_of(person)} " if motion.position.shape[1] > 1 else ""
            _add_person(asset, motion, rows, person, label, spheres, bars)
        for name, track in recording.tracks.items():
            if name in recording.lenses:
                _add_camera(asset, name, track, recording.lenses[name], t_ns)
        path = folder / f"{safe_file_name(recording.name)}.glb"
        path.write_bytes(asset.packed(recording.name, int(t_ns[0])))
        return [path]


def _add_person(
    asset: GltfAsset,
    motion: JointMotion,
    rows: Int64,
    person: int,
    label: str,
    spheres: dict[str, int],
    bars: dict[str, int],
) -> None:
    joints, position = with_derived(motion.joints, motion.position[rows, person])
    place = np.stack([position[..., 0], position[..., 2], -position[..., 1]], axis=-1)
    for j, name in enumerate(joints):
        known = np.isfinite(place[:, j, 0])
        if known.any():
            size = np.repeat(known[:, None], 3, axis=1).astype(np.float64)
            asset.moving(f"{label}{name}", spheres[side_of(name)], translation=held(place[:, j]), scale=size)
    for start, end in bones_of(joints):
        low, span = place[:, joints.index(start)], place[:, joints.index(end)] - place[:, joints.index(start)]
        length = np.linalg.norm(span, axis=1)
        known = length > 0  # False for NaN
        if known.any():
            size = np.where(known[:, None], np.stack([known, length, known], axis=1), 0.0)
            side = side_of(start, end)
            direction = held(np.where(known[:, None], span, np.nan))
            x, y, z = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).T
            turn = np.stack([z, np.zeros_like(x), -x, 1 + y], axis=1)
            turn[1 + y < 1e-12] = [1.0, 0.0, 0.0, 0.0]
            turned: Float = turn / np.linalg.norm(turn, axis=1, keepdims=True)
            asset.moving(
                f"{label}{start} to {end}",
                bars[side],
                translation=held(np.where(known[:, None], low, np.nan)),
                rotation=turned,
                scale=size,
            )


def _add_camera(asset: GltfAsset, name: str, track: Trajectory, lens: Intrinsics, t_ns: Int64) -> None:
    nearest = nearest_rows(track.t_ns, t_ns)
    x, y, z = track.position[nearest].T
    turn = multiply(multiply(FROM_WORLD, track.quaternion_xyzw[nearest]), _AHEAD)
    camera = {
        "type": "perspective",
        "perspective": {
            "aspectRatio": lens.width * lens.fy / (lens.height * lens.fx),
            "yfov": 2 * float(np.arctan(lens.height / 2 / lens.fy)),
            "znear": 0.1,
        },
        "name": name,
    }
    asset.moving(name, None, camera=camera, translation=np.stack([x, z, -y], axis=1), rotation=turn)


def held(values: Float) -> Float:
    """Replace missing rows [T, 3] by the last known one, before the first by that; one must be known."""
    known = np.isfinite(values[:, 0])
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)), -1))
    return values[np.where(last < 0, int(np.argmax(known)), last)]


def _octahedron(radius: float) -> tuple[Float, Int64]:
    corners = radius * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    triangles = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    return corners.astype(np.float64), np.array(triangles)


@dataclass
class GltfAsset:
    """Parts of a glTF file, and its binary buffer."""

    t_s: Float  # [T] of all animations
    nodes: list[dict[str, Any]] = field(default_factory=list)
    meshes: list[dict[str, Any]] = field(default_factory=list)
    cameras: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)
    views: list[dict[str, Any]] = field(default_factory=list)
    skins: list[dict[str, Any]] = field(default_factory=list)
    channels: list[dict[str, Any]] = field(default_factory=list)
    samplers: list[dict[str, Any]] = field(default_factory=list)
    buffer: bytearray = field(default_factory=bytearray)

    def __post_init__(self) -> None:
        self._time = self.array(self.t_s[:, None], "SCALAR", bounded=True)

    def array(
        self, values: Any, kind: str, *, target: int | None = None, bounded: bool = False, whole: bool = False
    ) -> int:
        """Add an array [N, columns] of floats, or of `whole` numbers and indices; return its accessor."""
        whole = whole or target == INDEX_BUFFER
        code = "<u2" if whole else "<f4"
        stored = np.ascontiguousarray(values, dtype=code)
        view = {"buffer": 0, "byteOffset": len(self.buffer), "byteLength": stored.nbytes}
        self.views.append(view | ({} if target is None else {"target": target}))
        self.buffer += stored.tobytes()
        self.buffer += bytes(-len(self.buffer) % 4)
        accessor = {
            "bufferView": len(self.views) - 1,
            "componentType": _UINT16 if whole else _FLOAT,
            "count": len(stored),
            "type": kind,
        }
        if bounded:
            accessor |= {"min": stored.min(axis=0).tolist(), "max": stored.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def mesh(self, corners: Float, triangles: Int64, side: str) -> int:
        """Add a mesh with flat faces in the colour of a side of the body."""
        faces = corners[triangles]  # each face has corners of its own, so that no normals are needed
        primitive = {
            "attributes": {
                "POSITION": self.array(faces.reshape(-1, 3), "VEC3", target=ARRAY_BUFFER, bounded=True)
            },
            "indices": self.array(np.arange(faces.size // 3)[:, None], "SCALAR", target=INDEX_BUFFER),
            "material": list(_MATERIALS).index(side),
        }
        self.meshes.append({"primitives": [primitive]})
        return len(self.meshes) - 1

    def moving(
        self, name: str, mesh: int | None, *, camera: dict[str, Any] | None = None, **paths: Float
    ) -> None:
        """Add a node that its paths [T, 3 or 4] move; sizes change at once, all else in straight lines."""
        node: dict[str, Any] = {"name": name}
        if mesh is not None:
            node["mesh"] = mesh
        if camera is not None:
            self.cameras.append(camera)
            node["camera"] = len(self.cameras) - 1
        for path, values in paths.items():
            node[path] = np.float32(values[0]).tolist()
            sampler = {
                "input": self._time,
                "output": self.array(values, f"VEC{values.shape[1]}"),
                "interpolation": "STEP" if path == "scale" else "LINEAR",
            }
            self.samplers.append(sampler)
            target = {"node": len(self.nodes), "path": path}
            self.channels.append({"sampler": len(self.samplers) - 1, "target": target})
        self.nodes.append(node)

    def packed(self, name: str, zero_ns: int) -> bytes:
        """Return the GLB: header, chunk of JSON, binary chunk."""
        materials = [
            {
                "name": side or "middle",
                "pbrMetallicRoughness": {"baseColorFactor": [*colour, 1.0], "metallicFactor": 0.0},
            }
            for side, colour in _MATERIALS.items()
        ]
        children = {child for node in self.nodes for child in node.get("children", ())}
        roots = [number for number in range(len(self.nodes)) if number not in children]
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "mocap", "extras": {"zero_ns": str(zero_ns)}},
            "scene": 0,
            "scenes": [{"name": name, "nodes": roots}],
            "nodes": self.nodes,
            "meshes": self.meshes,
            "materials": materials,
            "animations": [{"name": "motion", "channels": self.channels, "samplers": self.samplers}],
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.buffer)}],
        }
        if self.cameras:
            document["cameras"] = self.cameras
        if self.skins:
            document["skins"] = self.skins
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + len(self.buffer)
        if total > _LARGEST:
            problem = "has more moments than a GLB can hold (4 GB)"
            raise DataError(name, problem, "export bvh or parquet", code="too-large")
        head = struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(text), b"JSON")
        return head + text + struct.pack("<I4s", len(self.buffer), b"BIN\0") + bytes(self.buffer)


# Viewers must support four bones of a vertex.
_BONES_OF_A_VERTEX = 4


class MeshExport:
    """Writer of `<name>_mesh.glb`: the surface of every person who has a body."""

    name = "mesh"
    title = "the people's bodies with their surface as glTF, skinned and animated"

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write the bodies at the times of the skeleton."""
        motion, bodies = bodies_of(recording, self.name)
        motion_ns = motion.t_ns
        t_ns = motion_ns[thinned(motion_ns, KEY_FRAMES_HZ)]
        if len(t_ns) < len(motion_ns):
            recording.progress.note(
                f"mesh: {len(t_ns)} of {len(motion_ns)} moments, at most {KEY_FRAMES_HZ:g} a second"
            )
        asset = GltfAsset((t_ns - t_ns[0]) / 1e9)
        for body in bodies:
            _add_body(asset, body, recording.name_of(body.person), t_ns)
        path = folder / f"{safe_file_name(recording.name)}_mesh.glb"
        path.write_bytes(asset.packed(recording.name, int(t_ns[0])))
        return [path]


def _add_body(asset: GltfAsset, body: MovingBody, name: str, t_ns: Int64) -> None:
    model = body_model()
    skin, hinge = model.skin(body.shape), model.hinges(body.shape)
    row = np.clip(np.searchsorted(body.t_ns, t_ns), 0, len(body.t_ns) - 1)
    known = body.t_ns[row] == t_ns
    turn, place = model.moving_bones(body.centre[row], body.rotation[row])

    whole = len(asset.nodes)
    size = np.repeat(known[:, None], 3, axis=1).astype(np.float64)
    asset.moving(name, None, scale=size)
    first = len(asset.nodes)
    for bone in range(len(hinge)):
        rotation = continuous_signs(turn[:, bone])
        asset.moving(
            f"{name} {model.moving_names[bone]}", None, translation=place[:, bone], rotation=rotation
        )
    joints = list(range(first, first + len(hinge)))
    asset.nodes[whole] |= {"rotation": FROM_WORLD.tolist(), "children": joints}

    inverse = np.tile(np.eye(4), (len(hinge), 1, 1))
    inverse[:, :3, 3] = -hinge
    matrices = asset.array(inverse.transpose(0, 2, 1).reshape(len(hinge), 16), "MAT4")
    asset.skins.append({"joints": joints, "inverseBindMatrices": matrices, "skeleton": whole})
    weight = skin.weight[:, :_BONES_OF_A_VERTEX]
    weight = weight / weight.sum(axis=1, keepdims=True)
    bones = np.where(weight > 0, skin.bone[:, :_BONES_OF_A_VERTEX], 0)
    quads = model.quads
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).reshape(-1, 1)
    primitive = {
        "attributes": {
            "POSITION": asset.array(skin.rest, "VEC3", target=ARRAY_BUFFER, bounded=True),
            "JOINTS_0": asset.array(bones, "VEC4", target=ARRAY_BUFFER, whole=True),
            "WEIGHTS_0": asset.array(weight, "VEC4", target=ARRAY_BUFFER),
        },
        "indices": asset.array(faces, "SCALAR", target=INDEX_BUFFER),
        "material": 0,
    }
    asset.meshes.append({"name": name, "primitives": [primitive]})
    asset.nodes.append(
        {"name": f"{name} surface", "mesh": len(asset.meshes) - 1, "skin": len(asset.skins) - 1}
    )


EXPORT = GlbExport()
MESH_EXPORT = MeshExport()
