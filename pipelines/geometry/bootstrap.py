"""How sure a mean over a flight is: a bootstrap of stretches, because neighbouring moments err alike.

The circular block bootstrap (Politis & Romano 1992): stretches of a fixed length, drawn with replacement from
anywhere in the flight, whose end is followed by its beginning, are joined to a flight of the same length; the
interval holds the middle 95 % of the means of many such flights. What is the same all through a flight, such
as a constant pose error, does not show: the interval speaks of this flight, not of the next.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Int64 = NDArray[np.int64]
Series = tuple[Float, Float]
"""Sums [T] and weights [T] of a figure at every moment: the figure is the ratio of their totals."""

LEVEL = 0.95
STRETCH_S = 2.0
"""Two steps of a walk; errors of a detector and of white poses are forgotten long before."""

RESAMPLES = 1000
_FEWEST_STRETCHES = 5
_FEWEST_SAMPLES = 10


def stretch_samples(t_ns: Int64) -> int:
    """How many samples a stretch has: `STRETCH_S`, in a short flight a fifth of it, and at least one."""
    step_s = float(np.median(np.diff(t_ns))) / 1e9
    return max(min(round(STRETCH_S / step_s), len(t_ns) // _FEWEST_STRETCHES), 1)


def intervals(
    series: Mapping[str, Series], t_ns: Int64, *, seed: int = 0
) -> dict[str, tuple[float, float] | None]:
    """The interval of every figure; the same draws for all of them.

    Args:
        series: by name, [T] each; nothing may be NaN.
        t_ns: [T] strictly increasing.
        seed: of the draws.

    Returns:
        By name; None where there are fewer than ten samples, or a resampled flight holds nothing of it.
    """
    return {name: interval_of(values) for name, values in resampled(series, t_ns, seed=seed).items()}


def resampled(series: Mapping[str, Series], t_ns: Int64, *, seed: int = 0) -> dict[str, Float]:
    """Every figure of every resampled flight, [RESAMPLES]; the same draws for all figures.

    Arguments as of `intervals`. NaN where a resampled flight holds nothing of a figure, and all of them
    where there are fewer than ten samples.
    """
    times = len(t_ns)
    if times < _FEWEST_SAMPLES:
        return {name: np.full(RESAMPLES, np.nan) for name in series}
    length = stretch_samples(t_ns)
    first = np.random.default_rng(seed).integers(times, size=(RESAMPLES, math.ceil(times / length)))
    found = {}
    for name, (sums, weights) in series.items():
        total, weight = (_of_stretches(values, length)[first].sum(axis=1) for values in (sums, weights))
        there = weight > 0
        found[name] = np.where(there, total / np.where(there, weight, 1.0), np.nan)
    return found


def interval_of(values: Float) -> tuple[float, float] | None:
    """The middle 95 % of a figure of resampled flights; None where one of them holds nothing of it."""
    if not np.isfinite(values).all():
        return None
    tail = 50 * (1 - LEVEL)
    low, high = np.percentile(values, [tail, 100 - tail])
    return float(low), float(high)


def _of_stretches(values: Float, length: int) -> Float:
    """The sum [T] of the stretch that begins at each moment, around the end."""
    total = np.concatenate([[0.0], np.cumsum(np.concatenate([values, values[: length - 1]]))])
    return np.asarray(total[length:] - total[:-length], dtype=np.float64)
