"""Confidence intervals of means over a flight, by a block bootstrap, because neighbouring errors correlate.

This is the circular block bootstrap (Politis & Romano 1992). The flight is treated as a circle. Stretches of
a fixed length are drawn from it with replacement and joined to a flight of the same length. The interval
holds the middle 95 % of the means of many such flights. It does not include errors that are constant during
the flight, such as a constant pose error. So it is valid for this flight, not for the next.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from pipelines.geometry.arrays import Float, Int64

Series = tuple[Float, Float]
"""Sums [T] and weights [T] of a figure at every moment: the figure is the ratio of their totals."""

LEVEL = 0.95
STRETCH_S = 2.0
"""Length of a stretch: two steps of a walk. Errors of detectors and of white poses decorrelate sooner."""

RESAMPLES = 1000
_FEWEST_STRETCHES = 5
_FEWEST_SAMPLES = 10


def stretch_samples(t_ns: Int64) -> int:
    """Return the samples of a stretch: `STRETCH_S`, at most a fifth of the flight, and at least one."""
    step_s = float(np.median(np.diff(t_ns))) / 1e9
    return max(min(round(STRETCH_S / step_s), len(t_ns) // _FEWEST_STRETCHES), 1)


def intervals(
    series: Mapping[str, Series], t_ns: Int64, *, seed: int = 0
) -> dict[str, tuple[float, float] | None]:
    """Compute the interval of every figure, with the same draws for all of them.

    Args:
        series: by name, [T] each; nothing may be NaN.
        t_ns: [T] strictly increasing.
        seed: of the draws.

    Returns:
        By name; None with fewer than ten samples, or if a resampled flight has no data for the figure.
    """
    return {name: interval_of(values) for name, values in resampled(series, t_ns, seed=seed).items()}


def resampled(series: Mapping[str, Series], t_ns: Int64, *, seed: int = 0) -> dict[str, Float]:
    """Compute every figure of every resampled flight, [RESAMPLES], with the same draws for all figures.

    The arguments are those of `intervals`. A value is NaN if a resampled flight has no data for the figure.
    All values are NaN with fewer than ten samples.
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
    """Return the middle 95 % of a figure of resampled flights; None if any of them has no data for it."""
    if not np.isfinite(values).all():
        return None
    tail = 50 * (1 - LEVEL)
    low, high = np.percentile(values, [tail, 100 - tail])
    return float(low), float(high)


def _of_stretches(values: Float, length: int) -> Float:
    """Sum [T] the stretch that begins at each sample; stretches wrap around the end."""
    total = np.concatenate([[0.0], np.cumsum(np.concatenate([values, values[: length - 1]]))])
    return np.asarray(total[length:] - total[:-length], dtype=np.float64)
