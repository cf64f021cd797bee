"""Visibility of the actor from a camera: exact, voxel by voxel, and as an occupied share for costs."""

from __future__ import annotations

import math

import numpy as np

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.compilation import cached
from pipelines.planning.distance_field import DistanceField
from pipelines.planning.field_kernels import Grid, line_shares


def visible(field: DistanceField, camera: Float, actor: Float, *, start_m: float) -> Bool:
    """Test that no occupied voxel lies on the sight line (Amanatides & Woo 1987, every voxel it crosses).

    Args:
        field: the distance field of the obstacles; there are none outside its grid.
        camera: [..., 3] metres, world.
        actor: [..., 3] metres, world, broadcast against `camera`.
        start_m: the end of the line next to the actor is left out, this much of it: maps contain the actor.

    Returns:
        [...]; True where camera and actor are nearer to each other than `start_m`, or not finite.
    """
    camera, actor = np.broadcast_arrays(camera, actor)
    seen = np.empty(camera.shape[:-1], dtype=np.bool_)
    _traverse(field.grid, _flat(camera), _flat(actor), start_m, seen.reshape(-1))
    return seen


def occupied_share(field: DistanceField, camera: Float, actor: Float, *, start_m: float) -> Float:
    """Compute the occupied share of the sight line, 0..1: samples every half voxel at most.

    The end next to the actor is left out as in `visible`; arguments as there.
    """
    camera, actor = np.broadcast_arrays(camera, actor)
    share = np.empty(camera.shape[:-1])
    line_shares(field.grid, field.sight, _flat(actor), _flat(camera), start_m, share.reshape(-1))
    return share


def _flat(points: Float) -> Float:
    return np.array(points, dtype=np.float64, order="C").reshape(-1, 3)  # broadcast arrays are no memory


@cached
def _traverse(grid: Grid, camera: Float, actor: Float, start_m: float, seen: Bool) -> None:
    occupied = grid.distance_m
    index, side, ahead = np.zeros(3, np.int64), np.zeros(3, np.int64), np.zeros(3, np.int64)
    direction, crossing, spacing = np.zeros(3), np.zeros(3), np.zeros(3)
    for axis in range(3):
        side[axis] = occupied.shape[axis]
    for p in range(camera.shape[0]):
        seen[p] = True
        length = 0.0
        for axis in range(3):
            direction[axis] = actor[p, axis] - camera[p, axis]
            length += direction[axis] ** 2
        length = math.sqrt(length)
        reach = length - start_m
        if not reach > 0.0:
            continue
        for axis in range(3):
            direction[axis] /= length
            place = (camera[p, axis] - grid.origin[axis]) / grid.resolution_m
            index[axis] = math.floor(place)
            ahead[axis] = 1 if direction[axis] > 0.0 else -1
            border = index[axis] + (1 if direction[axis] > 0.0 else 0)
            if direction[axis] == 0.0:
                crossing[axis] = spacing[axis] = math.inf
            else:
                spacing[axis] = grid.resolution_m / abs(direction[axis])
                crossing[axis] = (border - place) * grid.resolution_m / direction[axis]
        while True:
            inside = True
            for axis in range(3):
                inside = inside and 0 <= index[axis] < side[axis]
            if inside and occupied[index[0], index[1], index[2]] < 0.0:
                seen[p] = False
                break
            nearest = 0
            for axis in range(1, 3):
                if crossing[axis] < crossing[nearest]:
                    nearest = axis
            if crossing[nearest] >= reach:
                break
            index[nearest] += ahead[nearest]
            crossing[nearest] += spacing[nearest]
