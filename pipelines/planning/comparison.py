"""Comparison of arms: means, differences, and their confidence intervals.

Intervals are percentiles of bootstrap means (Efron & Tibshirani 1993, 13.3): of the trials for errors, which
are independent draws, and of stretches of the flight for figures that depend on the flight's course.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float

Float32 = NDArray[np.float32]

RESAMPLES = 2000
LEVEL = 0.95
STRETCH_S = 5.0
"""Length of the pieces in which the flight is resampled, because neighbouring moments are alike, s."""


@dataclass(frozen=True)
class Estimate:
    """A mean and the interval that holds it with `LEVEL` probability; None where it cannot be computed."""

    mean: float
    interval: tuple[float, float] | None

    def as_json(self) -> dict[str, object]:
        """Return the estimate as stored in metrics.json."""
        return {"mean": self.mean, "interval": None if self.interval is None else list(self.interval)}


def mean_of_trials(values: Float, seed: int) -> Estimate | None:
    """Compute the mean of a figure over trials [K]; None without any, no interval for a single one."""
    return _weighted(values, np.ones(len(values)), seed)


def mean_over_time(values: Float, counted: Bool, stretch: NDArray[np.int64], seed: int) -> Estimate | None:
    """Compute the mean over the moments that count, with the interval of whole stretches.

    Args:
        values: [T] or [N, T].
        counted: [T].
        stretch: [T] the number of the stretch of every moment (`stretches`).
        seed: of the resampling.
    """
    flat = np.atleast_2d(values).mean(axis=0)
    weight = np.bincount(stretch, weights=counted.astype(np.float64)).astype(np.float64)
    total = np.bincount(stretch, weights=np.where(counted, flat, 0.0)).astype(np.float64)
    used = weight > 0
    return _weighted(total[used] / weight[used], weight[used], seed)


def stretches(t_s: Float) -> NDArray[np.int64]:
    """Return the stretch [T] that each moment belongs to."""
    return (t_s // STRETCH_S).astype(np.int64)


def common_frames(errors: Mapping[str, Float32]) -> Bool:
    """Return the joint-frames [trials, T, J] that every arm measured.

    Arms that measured none do not count.
    """
    measured = [np.isfinite(error) for error in errors.values() if np.isfinite(error).any()]
    shape = next(iter(errors.values())).shape
    return np.logical_and.reduce(measured) if measured else np.zeros(shape, dtype=np.bool_)


def mpjpe_mm(error_m: Float32, counted: Bool) -> Float:
    """Compute the mean error of each trial over the joint-frames [K, T, J] that count.

    Returns:
        [K], or fewer: trials in which none counts are left out.
    """
    number = counted.sum(axis=(1, 2))
    total = np.where(counted, error_m, 0.0).sum(axis=(1, 2), dtype=np.float64)
    has_any = number > 0
    mean: Float = 1e3 * total[has_any] / number[has_any]
    return mean


def coverage(error_m: Float32, joint_frames: int) -> Float:
    """Compute the share [K] of the joint-frames with a truth that were measured, 0..1."""
    share: Float = np.isfinite(error_m).sum(axis=(1, 2)) / max(joint_frames, 1)
    return share


def _weighted(values: Float, weight: Float, seed: int) -> Estimate | None:
    """Compute the weighted mean of independent values, and its bootstrap interval."""
    if not len(values):
        return None
    mean = float((values * weight).sum() / weight.sum())
    if len(values) < 2:
        return Estimate(mean, None)
    rows = np.random.default_rng([seed, len(values)]).integers(len(values), size=(RESAMPLES, len(values)))
    means = (values * weight)[rows].sum(axis=1) / weight[rows].sum(axis=1)
    tail = 50 * (1 - LEVEL)
    low, high = np.percentile(means, [tail, 100 - tail])
    return Estimate(mean, (float(low), float(high)))
