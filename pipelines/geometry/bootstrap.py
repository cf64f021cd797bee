"""Confidence intervals of means, by the bootstrap: over trials, or over a flight, where neighbours correlate.

Trials are independent: as many are drawn from them with replacement as there are (Efron & Tibshirani 1993,
13.3). Over a flight this is the circular block bootstrap (Politis & Romano 1992). The flight is treated as a
circle. Stretches of a fixed length are drawn from it with replacement and joined to a flight of the same
length. The interval holds the middle 95 % of the means of many such draws. It does not include errors that
are the same in all trials or constant during the flight, such as a constant pose error. So it is valid for
this flight, not for the next.
"""

import math
from collections.abc import Mapping

import numpy as np

from pipelines.geometry.arrays import Float, Int64

Series = tuple[Float, Float]
"""Sums [T] and weights [T] of a figure at every moment or trial: the figure is the ratio of their totals."""

# Papers of the field state intervals of 95 %.
LEVEL = 0.95
STRETCH_S = 5.0
"""Length of a stretch: the longest time over which the figures of a flight correlate.

Errors of detectors and white pose errors decorrelate within two steps of a walk, 2 s; tilt, occlusion and
drifting pose errors follow the actor's path, past an obstacle or around a turn, for up to 5 s. Too short a
stretch makes the interval too narrow. Too long a one makes only its ends less certain.
"""

RESAMPLES = 2000
"""Draws; the ends of an interval scatter by 4 % of half its width."""

# An interval of `LEVEL` leaves 2.5 % of the draws on either side.
_TAIL_PERCENT = 2.5
# Draws from fewer stretches repeat each other, and the interval would be too narrow.
_MIN_STRETCHES = 5
# Fewer samples or trials do not tell how a figure scatters.
_MIN_SAMPLES, _MIN_TRIALS = 10, 2


def stretch_samples(t_ns: Int64) -> int:
    """Return the samples of a stretch: `STRETCH_S`, at most a fifth of the flight, and at least one."""
    step_s = float(np.median(np.diff(t_ns))) / 1e9
    return max(min(round(STRETCH_S / step_s), len(t_ns) // _MIN_STRETCHES), 1)


def intervals(
    series: Mapping[str, Series], t_ns: Int64 | None, *, seed: int = 0
) -> dict[str, tuple[float, float] | None]:
    """Compute the interval of every figure, with the same draws for all of them.

    Args:
        series: by name, [T] each; nothing may be NaN.
        t_ns: [T] strictly increasing; None for independent trials.

    Returns:
        By name; None with fewer than ten samples or two trials, or if a draw has no data for the figure.
    """
    return {name: interval_of(values) for name, values in resampled(series, t_ns, seed=seed).items()}


def resampled(series: Mapping[str, Series], t_ns: Int64 | None, *, seed: int = 0) -> dict[str, Float]:
    """Compute every figure of every draw, [RESAMPLES], with the same draws for all figures.

    The arguments are those of `intervals`. A value is NaN if a draw has no data for the figure. All values
    are NaN with fewer than ten samples or two trials.
    """
    count = len(next(iter(series.values()))[0]) if series else 0
    if count < (_MIN_TRIALS if t_ns is None else _MIN_SAMPLES):
        return {name: np.full(RESAMPLES, np.nan) for name in series}
    length = 1 if t_ns is None else stretch_samples(t_ns)
    first = np.random.default_rng([seed, count]).integers(count, size=(RESAMPLES, math.ceil(count / length)))
    found = {}
    for name, (sums, weights) in series.items():
        total, weight = (_of_stretches(values, length)[first].sum(axis=1) for values in (sums, weights))
        there = weight > 0
        found[name] = np.where(there, total / np.where(there, weight, 1.0), np.nan)
    return found


def interval_of(values: Float) -> tuple[float, float] | None:
    """Return the middle 95 % of a figure's draws; None if any of them has no data for it."""
    if not np.isfinite(values).all():
        return None
    low, high = np.percentile(values, [_TAIL_PERCENT, 100 - _TAIL_PERCENT])
    return float(low), float(high)


def _of_stretches(values: Float, length: int) -> Float:
    """Sum [T] the stretch that begins at each sample; stretches wrap around the end."""
    if length == 1:
        return values
    total = np.concatenate([[0.0], np.cumsum(np.concatenate([values, values[: length - 1]]))])
    return np.asarray(total[length:] - total[:-length], dtype=np.float64)
