"""The ground: level, with mounds of Gaussian shape, defined everywhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.simulation import scenario
from pipelines.simulation.world import kernels


@dataclass(frozen=True)
class Terrain:
    """Mounds over z = 0: height = sum of h exp(-(a^2 + b^2) / 2).

    a and b are the distances from a mound's centre along its yawed axes, in its sigmas.
    """

    mounds: Float  # [M, 7] as `kernels` explains

    def height(self, xy: Float) -> Float:
        """Compute the ground's height, m, [...] at points [..., 2]; NaN at NaN where there are mounds."""
        points = _rows(xy, 2)
        out = np.empty(len(points))
        kernels.heights(self.mounds, points, out)
        return out.reshape(np.shape(xy)[:-1])

    def normal(self, xy: Float) -> Float:
        """Compute unit normals of the ground [..., 3], pointing up, at points [..., 2]."""
        points = _rows(xy, 2)
        slope = np.zeros((len(points), 2))
        kernels.gradients(self.mounds, points, slope)
        upward = np.concatenate([-slope, np.ones((len(points), 1))], axis=1)
        unit: Float = upward / np.sqrt((upward**2).sum(axis=1, keepdims=True))
        return unit.reshape(*np.shape(xy)[:-1], 3)

    @property
    def slope(self) -> float:
        """Upper bound of the ground's slope: a Gaussian is steepest one sigma out, h / sigma exp(-1/2)."""
        return float((self.mounds[:, 6] / self.mounds[:, 4:6].min(axis=1)).sum() * math.exp(-0.5))

    @property
    def curvature(self) -> float:
        """Upper bound of second derivatives, any direction, 1/m: a Gaussian's is h / sigma^2, at its top."""
        return float((self.mounds[:, 6] / self.mounds[:, 4:6].min(axis=1) ** 2).sum())

    def curvature_within(self, centre: Float, radius_m: float) -> Float:
        """Compute an upper bound like `curvature`, within circles about points [N, 2].

        r sigmas out, |r^2 - 1| exp(-r^2 / 2) and exp(-r^2 / 2) times h / sigma^2 are the principal second
        derivatives of a round mound; for an oval one they are at most those with its smaller sigma.
        """
        total = np.zeros(len(centre))
        for x, y, _, _, along, across, height in self.mounds:
            away = np.hypot(centre[:, 0] - x, centre[:, 1] - y) - radius_m
            squared = np.maximum(away / max(along, across), 0) ** 2
            total += height / min(along, across) ** 2 * np.minimum(1, (1 + squared) * np.exp(-squared / 2))
        return total


def raise_mounds(mounds: Sequence[scenario.Mound]) -> Terrain:
    """Return the ground that a scenario describes."""
    rows = [
        (
            *m.centre,
            math.cos(math.radians(m.yaw_deg)),
            math.sin(math.radians(m.yaw_deg)),
            *m.sigma_m,
            m.height_m,
        )
        for m in mounds
    ]
    return Terrain(np.array(rows, dtype=np.float64).reshape(-1, 7))


def _rows(points: Float, columns: int) -> Float:
    """Return points as [N, columns] for the kernels."""
    return np.ascontiguousarray(points, dtype=np.float64).reshape(-1, columns)
