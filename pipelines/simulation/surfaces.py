"""Surfaces of triangles: what bodies and worlds are made of and what is rendered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Surface:
    """Triangles with a colour at each corner, seen from both sides.

    `smooth` surfaces are shaded with normals averaged at their corners, others face by face. Where
    `ground` is True the colour is multiplied by the renderer's ground texture at (x, y).
    """

    vertices: Float  # [V, 3] m, world
    faces: NDArray[np.int32]  # [F, 3], counterclockwise seen from outside
    colour: NDArray[np.float32]  # [V, 3] RGB reflectance, 0..1, linear
    smooth: bool = True
    ground: bool = False


def joined(*surfaces: Surface) -> Surface:
    """Several surfaces of one kind as one.

    Raises:
        ValueError: they differ in `smooth` or `ground`, or there are none.
    """
    if len({(s.smooth, s.ground) for s in surfaces}) != 1:
        raise ValueError("only surfaces of one kind can be joined")
    first = np.cumsum([0, *(len(s.vertices) for s in surfaces[:-1])])
    return Surface(
        np.concatenate([s.vertices for s in surfaces]),
        np.concatenate([s.faces + k for s, k in zip(surfaces, first, strict=True)]).astype(np.int32),
        np.concatenate([s.colour for s in surfaces]),
        surfaces[0].smooth,
        surfaces[0].ground,
    )
