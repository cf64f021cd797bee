"""Export to mesh: the bodies of the people as glTF 2.0, skinned and animated, for Blender and the web.

The surface rests as `geometry.body_model` has it. Each of its moving bones is a node in the world's axes,
below one node that turns z up into y up. A vertex follows its four strongest bones. Where a person has no
body the size is zero. Metres; second 0 is `zero_ns` of the asset's extras. At most 30 moments a second are
written.

Source: Khronos, glTF 2.0 Specification (2021), 3.7.3 skins.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.formats.common.exporting import safe_file_name, thinned
from pipelines.formats.scenes.gltf_writing import (
    ARRAY_BUFFER,
    FROM_WORLD,
    INDEX_BUFFER,
    KEY_FRAMES_HZ,
    GltfAsset,
)
from pipelines.geometry.arrays import Int64
from pipelines.geometry.body_model import body_model
from pipelines.geometry.poses import continuous_signs
from pipelines.session.errors import DataError
from pipelines.session.records import MovingBody, Recording

# glTF's viewers must support four bones of a vertex.
_BONES_OF_A_VERTEX = 4


class MeshExport:
    """Writer of `<name>_mesh.glb`: the surface of every person who has a body."""

    name = "mesh"
    title = "the people's bodies with their surface as glTF, skinned and animated"

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write the bodies at the times of the skeleton."""
        bodies = recording.bodies()
        if recording.motion is None or not bodies:
            remedy = "run `mocap reconstruct`; a body needs hips, shoulders and ten landmarks of a person"
            raise DataError(recording.name, "holds no body to export", remedy, code="no-body")
        motion_ns = recording.motion.t_ns
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


EXPORT = MeshExport()
