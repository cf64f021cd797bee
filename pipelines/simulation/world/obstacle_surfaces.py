"""Visible surfaces of trees and walls, as large as their solids."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.simulation.surfaces import Surface, joined
from pipelines.simulation.world.obstacles import Obstacles

Faces = NDArray[np.int32]

_SIDES = 10  # of a trunk
_RINGS = 5
_CLUSTERS = 16  # of leaves in a crown
_HEART = 0.8  # radius of the part that is always filled with leaves: no line of sight slips through
_OUTLINE = 12
_RAGGED = 0.04  # deviation of leaves from their cluster, of the crown's radius (sigma)
_MANY_TREES = 40  # more are drawn with fewer triangles each
_BARK = (0.16, 0.115, 0.08)
_GREENS = ((0.10, 0.19, 0.045), (0.13, 0.22, 0.05), (0.075, 0.155, 0.05), (0.165, 0.22, 0.06))
_STONE = (0.36, 0.33, 0.29)
_BLOCK_M = (0.6, 0.3)  # length and height of a wall's stones
_MOST_BLOCKS = (120, 20)  # along and up a wall; longer walls have larger stones


def tree_surfaces(obstacles: Obstacles, seed: int) -> list[Surface]:
    """Draw all trunks as one surface and all crowns as another; nothing without trees."""
    if not len(obstacles.trunks):
        return []
    sphere = _sphere(3 if len(obstacles.trunks) <= _MANY_TREES else 2)
    trunks, crowns = [], []
    for k, (trunk, crown) in enumerate(zip(obstacles.trunks, obstacles.crowns, strict=True)):
        rng = np.random.default_rng([seed, _LOOKS, k])
        trunks.append(_drawn_trunk(trunk, rng))
        crowns.append(_drawn_crown(crown, sphere, rng))
    return [joined(*trunks), joined(*crowns)]


def wall_surfaces(obstacles: Obstacles, seed: int) -> list[Surface]:
    """Draw all walls as one surface, stone by stone; nothing without walls."""
    if not len(obstacles.slabs):
        return []
    walls = [
        _drawn_wall(slab, np.random.default_rng([seed, _LOOKS + 1, k]))
        for k, slab in enumerate(obstacles.slabs)
    ]
    return [joined(*walls)]


def _drawn_trunk(trunk: Float, rng: np.random.Generator) -> Surface:
    """Draw a prism of the trunk's cross-section, its bark mottled."""
    x, y, low, high, radius = trunk
    bearing = np.arange(_SIDES) * (2 * np.pi / _SIDES)
    # The polygon has the circle's area: sides (1/2) R^2 sin(2 pi / sides) = pi r^2.
    outer = radius * math.sqrt(2 * np.pi / _SIDES / math.sin(2 * np.pi / _SIDES))
    ring = np.stack([x + outer * np.cos(bearing), y + outer * np.sin(bearing)], axis=1)
    levels = np.linspace(low, high, _RINGS)
    vertices = np.concatenate([np.column_stack([ring, np.full(_SIDES, z)]) for z in levels])
    this = np.arange(_SIDES)
    following = (this + 1) % _SIDES
    quads = np.concatenate(
        [
            np.stack([this, following, following + _SIDES, this + _SIDES], axis=1) + k * _SIDES
            for k in range(_RINGS - 1)
        ]
    )
    tone = rng.uniform(0.7, 1.3, len(vertices))
    return Surface(vertices, _split(quads), _colours(np.array(_BARK), tone), smooth=True)


def _drawn_crown(crown: Float, sphere: tuple[Float, Faces], rng: np.random.Generator) -> Surface:
    """Draw clusters of leaves around the middle: the outermost of some balls in every direction.

    An outline shows the outermost leaves. A high mean of the radius over all directions is therefore scaled
    to 1, so that outlines are as large as the ellipsoid's.
    """
    direction, faces = sphere
    middle = _spread(_CLUSTERS, rng) * rng.uniform(0.58, 0.66, _CLUSTERS)[:, None]
    size = rng.uniform(0.38, 0.46, _CLUSTERS)
    toward = np.einsum("vk,ck->vc", direction, middle)
    inside = size**2 - (middle**2).sum(axis=1) + toward**2
    reach = np.where(inside > 0, toward + np.sqrt(np.maximum(inside, 0)), 0)
    nearest = reach.argmax(axis=1)
    radius = np.maximum(reach.max(axis=1), _HEART)
    depth = np.clip((radius - _HEART) / (1.05 - _HEART), 0, 1)
    radius = np.clip(radius + rng.normal(0, _RAGGED, len(radius)), 0.7, 1.2)
    radius /= (radius**_OUTLINE).mean() ** (1 / _OUTLINE)
    green = np.array(_GREENS)[rng.integers(len(_GREENS))] * rng.uniform(0.85, 1.15)
    tone = rng.uniform(0.75, 1.25, _CLUSTERS)[nearest] * (0.5 + 0.5 * depth)  # dark between the clusters
    tone *= rng.uniform(0.75, 1.25, len(radius))
    vertices = crown[:3] + direction * radius[:, None] * crown[[3, 3, 4]]
    return Surface(vertices, faces, _colours(green, tone), smooth=False)


def _drawn_wall(slab: Float, rng: np.random.Generator) -> Surface:
    """Draw four sides and the top, of stones that differ in tone."""
    x, y, cos, sin, length, thickness, low, high = slab
    along, across = np.array([cos, sin, 0.0]), np.array([-sin, cos, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    base = np.array([x, y, low])
    length, thickness, tall = 2 * length * along, 2 * thickness * across, (high - low) * up
    corner = base - length / 2 - thickness / 2
    sides = [
        (corner, length, tall),
        (corner + length + thickness, -length, tall),
        (corner + length, thickness, tall),
        (corner + thickness, -thickness, tall),
        (corner + tall, length, thickness),
    ]
    return joined(*(_stones(*side, rng) for side in sides))


def _stones(corner: Float, along: Float, up: Float, rng: np.random.Generator) -> Surface:
    """Draw a rectangle of stones, each with four corners of its own; seen from `along` x `up`."""
    columns, rows = (
        min(max(1, round(float(np.sqrt((edge**2).sum())) / size)), most)
        for edge, size, most in zip((along, up), _BLOCK_M, _MOST_BLOCKS, strict=True)
    )
    u, v = (part.ravel() for part in np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"))
    steps = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    s, t = (u[:, None] + steps[:, 0]) / columns, (v[:, None] + steps[:, 1]) / rows
    vertices = (corner + s[..., None] * along + t[..., None] * up).reshape(-1, 3)
    tone = np.repeat(rng.uniform(0.75, 1.2, len(u)), 4) * rng.uniform(0.92, 1.08, 4 * len(u))
    quads = np.arange(4 * len(u)).reshape(-1, 4)
    return Surface(vertices, _split(quads), _colours(np.array(_STONE), tone), smooth=False)


def _split(quads: NDArray[np.int64]) -> Faces:
    """Split each quadrangle [Q, 4] into two triangles [2 Q, 3]."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)


def _colours(colour: Float, tone: Float) -> NDArray[np.float32]:
    return np.clip(colour * tone[:, None], 0, 1).astype(np.float32)


def _spread(count: int, rng: np.random.Generator) -> Float:
    """Draw unit vectors [count, 3], evenly about the sphere (a Fibonacci spiral).

    They are turned and shaken at random.
    """
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    bearing = k * (np.pi * (1 + math.sqrt(5))) + rng.uniform(0, 2 * np.pi)
    flat = np.sqrt(1 - z**2)
    points = np.stack([flat * np.cos(bearing), flat * np.sin(bearing), z], axis=1)
    points += rng.normal(0, 0.18, points.shape)
    unit: Float = points / np.sqrt((points**2).sum(axis=1, keepdims=True))
    return unit


def _sphere(halvings: int) -> tuple[Float, Faces]:
    """Return directions and triangles of an icosahedron whose edges were halved some times.

    There are 20 * 4^halvings triangles.
    """
    g = (1 + math.sqrt(5)) / 2
    # Three golden rectangles; every triangle joins three corners that are mutually 2 apart.
    corners = np.array([np.roll((0.0, a, b * g), k) for k in range(3) for a in (-1, 1) for b in (-1, 1)])
    apart = ((corners[:, None] - corners) ** 2).sum(axis=-1)
    near = np.isclose(apart, 4)
    faces = np.array(
        [
            (a, b, c)
            for a in range(12)
            for b in range(a)
            for c in range(b)
            if near[a, b] and near[b, c] and near[a, c]
        ]
    )
    inward = np.linalg.det(corners[faces]) < 0
    faces[inward] = faces[inward][:, ::-1]
    for _ in range(halvings):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        unique, which = np.unique(edges, axis=0, return_inverse=True)
        middle = which.reshape(-1, 3) + len(corners)
        corners = np.concatenate([corners, corners[unique].sum(axis=1) / 2])
        (a, b, c), (ab, bc, ca) = faces.T, middle.T
        triangles = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        faces = np.concatenate([np.stack(triangle, axis=1) for triangle in triangles])
    return corners / np.sqrt((corners**2).sum(axis=1, keepdims=True)), faces.astype(np.int32)


_LOOKS = 2  # keeps these random numbers apart from the wood's
