"""Rotations that bodies are made of: about one axis, from three axes, part of the way."""

from __future__ import annotations

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import (
    conjugate,
    multiply,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)


def about(axis: int, angle: Float) -> Float:
    """Return rotations [T, 4] about x, y or z (0, 1, 2) by [T] rad.

    y turns forward (x) down, z turns to the left.
    """
    turned = np.zeros((len(angle), 4))
    turned[:, axis] = np.sin(angle / 2)
    turned[:, 3] = np.cos(angle / 2)
    return turned


def partly(start: Float, end: Float, share: Float) -> Float:
    """Return rotations [T, 4] that are `share` [T] of the shortest way from one to another."""
    vector = rotation_vector_from_quaternion(multiply(conjugate(start), end))
    return multiply(start, quaternion_from_rotation_vector(share[:, None] * vector))


def from_axes(forward: Float, left: Float, up: Float) -> Float:
    """Return rotations [T, 4] that take x, y, z to these orthonormal [T, 3] axes."""
    return quaternion_from_matrix(np.stack([forward, left, up], axis=-1))


def unit(vectors: Float) -> Float:
    """Scale vectors [T, 3] to length 1."""
    return np.asarray(vectors / np.sqrt(np.sum(vectors * vectors, axis=-1, keepdims=True)), dtype=np.float64)


def between(one: Float, other: Float) -> Float:
    """Return the shortest rotation [4] from one direction [3] to another; about z where they are opposite."""
    one, other = one / np.sqrt(np.sum(one**2)), other / np.sqrt(np.sum(other**2))
    turned = np.array([*np.cross(one, other), 1.0 + float(np.sum(one * other))])
    length = float(np.sqrt(np.sum(turned**2)))
    if length < 1e-9:
        return np.array([0.0, 0.0, 1.0, 0.0])
    return turned / length
