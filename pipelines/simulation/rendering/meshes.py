"""Several surfaces as one mesh, with normals, colour and kind for shading."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.compilation import cached
from pipelines.simulation.surfaces import Surface

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]

SMOOTH, GROUND = 1, 2


class Mesh(NamedTuple):
    """Triangles of all surfaces together."""

    vertices: Float  # [V, 3] m, world
    faces: Int32  # [F, 3]
    normals: Float32  # [V, 3] unit, averaged over the faces that meet, weighed by their areas
    colour: Float32  # [V, 3] RGB reflectance, linear
    kind: NDArray[np.uint8]  # [F] SMOOTH and GROUND, or-ed


def mesh_of(surfaces: Sequence[Surface]) -> Mesh:
    """Join the surfaces, one after another; an empty mesh for none."""
    parts = [_single(surface) for surface in surfaces]
    return stacked(parts) if parts else _single(_EMPTY)


def stacked(meshes: Sequence[Mesh]) -> Mesh:
    """Join meshes, one after another; their corners stay apart."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + k for mesh, k in zip(meshes, first, strict=True)]).astype(np.int32),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.colour for mesh in meshes]),
        np.concatenate([mesh.kind for mesh in meshes]),
    )


def _single(surface: Surface) -> Mesh:
    vertices = np.ascontiguousarray(surface.vertices, np.float64)
    faces = np.ascontiguousarray(surface.faces, np.int32)
    kind = (SMOOTH if surface.smooth else 0) | (GROUND if surface.ground else 0)
    return Mesh(
        vertices,
        faces,
        _corner_normals(vertices, faces),
        np.ascontiguousarray(surface.colour, np.float32),
        np.full(len(faces), kind, np.uint8),
    )


@cached
def _corner_normals(vertices: Float, faces: Int32) -> Float32:
    sums = np.zeros_like(vertices)
    for f in range(len(faces)):
        a, b, c = faces[f]
        ux, uy, uz = vertices[b] - vertices[a]
        vx, vy, vz = vertices[c] - vertices[a]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for k in (a, b, c):
            sums[k, 0] += nx
            sums[k, 1] += ny
            sums[k, 2] += nz
    normals = np.empty(vertices.shape, np.float32)
    for i in range(len(sums)):
        x, y, z = sums[i]
        length = max(np.sqrt(x * x + y * y + z * z), 1e-30)
        normals[i, 0], normals[i, 1], normals[i, 2] = x / length, y / length, z / length
    return normals


_EMPTY = Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
