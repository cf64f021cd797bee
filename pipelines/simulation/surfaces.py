"""Surfaces of triangles, for bodies, worlds and rendering."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.compilation import cached


@dataclass(frozen=True)
class TriangleSurface:
    """Triangles with a colour at each corner, seen from both sides.

    `smooth` surfaces are shaded with normals averaged at their corners, others face by face. Where
    `ground` is True the colour is multiplied by the renderer's ground texture at (x, y).
    """

    vertices: Float  # [V, 3] m, world
    faces: NDArray[np.int32]  # [F, 3], counterclockwise seen from outside
    colour: NDArray[np.float32]  # [V, 3] RGB reflectance, 0..1, linear
    smooth: bool = True
    ground: bool = False


def joined(*surfaces: TriangleSurface) -> TriangleSurface:
    """Join several surfaces of one kind to one.

    Raises:
        ValueError: they differ in `smooth` or `ground`, or there are none.
    """
    if len({(s.smooth, s.ground) for s in surfaces}) != 1:
        raise ValueError("only surfaces of one kind can be joined")
    first = np.cumsum([0, *(len(s.vertices) for s in surfaces[:-1])])
    return TriangleSurface(
        np.concatenate([s.vertices for s in surfaces]),
        np.concatenate([s.faces + k for s, k in zip(surfaces, first, strict=True)]).astype(np.int32),
        np.concatenate([s.colour for s in surfaces]),
        surfaces[0].smooth,
        surfaces[0].ground,
    )


def hidden_by(surface: TriangleSurface, eye: Float, targets: Float) -> Bool:
    """Test if a surface, whose both sides hide, stands between an eye [3] and targets [N, 3] m, world.

    Exact up to rounding, which counts where a line runs through the edge of a triangle. False for a target
    with NaN.
    """
    out = np.empty(len(targets), dtype=np.bool_)
    eye, targets = np.ascontiguousarray(eye, np.float64), np.ascontiguousarray(targets, np.float64)
    _meets(np.ascontiguousarray(surface.vertices, np.float64), surface.faces, eye, targets, out)
    return out


@cached
def _meets(vertices: Float, faces: NDArray[np.int32], eye: Float, targets: Float, out: Bool) -> None:
    """Moeller and Trumbore 1997, "Fast, minimum storage ray/triangle intersection", between two points."""
    for n in range(len(targets)):
        wx, wy, wz = targets[n, 0] - eye[0], targets[n, 1] - eye[1], targets[n, 2] - eye[2]
        out[n] = False
        for f in range(len(faces)):
            a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
            ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
            vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
            px, py, pz = wy * vz - wz * vy, wz * vx - wx * vz, wx * vy - wy * vx
            volume = ux * px + uy * py + uz * pz
            if volume == 0.0:  # the line runs within the triangle's plane
                continue
            sx, sy, sz = eye[0] - a[0], eye[1] - a[1], eye[2] - a[2]
            first = (sx * px + sy * py + sz * pz) / volume
            if not 0.0 <= first <= 1.0:
                continue
            qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
            second = (wx * qx + wy * qy + wz * qz) / volume
            if second < 0.0 or first + second > 1.0:
                continue
            along = (vx * qx + vy * qy + vz * qz) / volume
            if 0.0 < along < 1.0:
                out[n] = True
                break
