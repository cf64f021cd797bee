"""Pieces of a surface whose vertices carry values, and cuts along lines across their triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float

Faces = NDArray[np.intp]


@dataclass(frozen=True)
class Patch:
    """Triangles [F, 3] and values [V, ...] of their vertices, by name."""

    values: dict[str, Float]
    faces: Faces

    def replaced(self, **values: Float) -> Patch:
        """Return the same patch with other or additional values."""
        return Patch(self.values | values, self.faces)


def triangles(quads: Faces) -> Faces:
    """Split quads [Q, 4] into triangles [2 Q, 3]."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def normals(vertices: Float, faces: Faces) -> Float:
    """Compute outward unit normals [V, 3], means over the triangles around by area; zero where none are."""
    across = np.cross(
        vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    )
    total = np.zeros_like(vertices)
    for corner in faces.T:
        np.add.at(total, corner, across)
    unit: Float = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    return unit


def cut(patch: Patch, keep: Float) -> Patch:
    """Return the part of a patch where `keep` [V], linear in each triangle, is not negative.

    Along the cut, vertices are added whose values are linear between the ends of the edge that was cut.
    """
    inside = keep[patch.faces] >= 0
    count = inside.sum(axis=1)
    one = _odd_first(patch.faces[count == 1], inside[count == 1])
    two = _odd_first(patch.faces[count == 2], ~inside[count == 2])
    crossed = np.concatenate([one[:, [0, 1]], one[:, [0, 2]], two[:, [0, 1]], two[:, [0, 2]]])
    edges, which = np.unique(np.sort(crossed, axis=1), axis=0, return_inverse=True)
    one_b, one_c, two_b, two_c = np.split(
        which.ravel() + len(keep), np.cumsum([len(one), len(one), len(two)])
    )
    faces = np.concatenate(
        [
            patch.faces[count == 3],
            np.stack([one[:, 0], one_b, one_c], axis=1),
            np.stack([two_b, two[:, 1], two[:, 2]], axis=1),
            np.stack([two_b, two[:, 2], two_c], axis=1),
        ]
    )
    first, second = edges.T
    share = keep[first] / (keep[first] - keep[second])

    def extended(value: Float) -> Float:
        part = share.reshape(-1, *(1,) * (value.ndim - 1))
        return np.concatenate([value, value[first] + part * (value[second] - value[first])])

    return _compact({name: extended(value) for name, value in patch.values.items()}, faces)


def pick(patch: Patch, wanted: NDArray[np.bool_]) -> Patch:
    """Return some triangles [F] of a patch, whole."""
    return _compact(patch.values, patch.faces[wanted])


def together(patches: list[Patch], names: tuple[str, ...]) -> Patch:
    """Join several patches side by side, with the values named."""
    counts = [len(patch.values[names[0]]) for patch in patches]
    first = np.cumsum([0, *counts[:-1]])
    faces = np.concatenate([patch.faces + k for patch, k in zip(patches, first, strict=True)])
    return Patch({name: np.concatenate([patch.values[name] for patch in patches]) for name in names}, faces)


def _odd_first(faces: Faces, odd: NDArray[np.bool_]) -> Faces:
    """Rotate each triangle's corners, in their order, until the one that differs comes first."""
    turn = (np.argmax(odd, axis=1)[:, None] + np.arange(3)) % 3
    return np.take_along_axis(faces, turn, axis=1)


def _compact(values: dict[str, Float], faces: Faces) -> Patch:
    used, corners = np.unique(faces, return_inverse=True)
    return Patch({name: value[used] for name, value in values.items()}, corners.reshape(faces.shape))
