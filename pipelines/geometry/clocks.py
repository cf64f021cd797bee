"""Offset and drift between two clocks, from stamps of the same events."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float

Int64 = NDArray[np.int64]

_MOST_PAIRS = 400  # events whose pairs give the slopes: 80,000 pairs
_CLEAR = 4.0  # standard deviations from which a drift counts as significant
_LARGEST_DRIFT_PPM = 1000.0  # quartz is off by 100 at most; more is a jump or a wrong unit
_CORRELATED_S = 10.0  # correlation time of the delays of one link


@dataclass(frozen=True)
class ClockFit:
    """The other clock's reading is `at_ns + offset_ns + (t - at_ns) * drift`, for a reading t of this one."""

    at_ns: int  # reading of this clock, in the middle of the events
    offset_ns: int  # other - this, at `at_ns`
    drift_ppm: float  # 0 if it is not significant
    drift_sigma_ppm: float
    residual_s: float  # scatter of the events about the line: 1.4826 times their median deviation
    events: int  # that were compared
    rejected: int  # of them, further than six times the scatter from the line

    def other_ns(self, t_ns: Int64) -> Int64:
        """Convert times of this clock to readings of the other; exact integers except for the drift."""
        drifted = np.rint((t_ns - self.at_ns) * (self.drift_ppm * 1e-6)).astype(np.int64)
        moved: Int64 = t_ns + (self.offset_ns + drifted)
        return moved


def fit_clock(this_ns: Int64, other_ns: Int64) -> ClockFit | None:
    """Fit a line between the readings of two clocks; return None for fewer than two events.

    The first slope is the median of the slopes between pairs (Theil 1950 and Sen 1968). Least squares without
    the events far from that line then gives the drift. A drift that is not significant (within four of its
    standard deviations of 0) is set to 0, because in short logs the delays of a link look like a drift.

    Args:
        this_ns: [N] readings of the one clock, in any order.
        other_ns: [N] readings of the other at the same events.
    """
    if len(this_ns) < 2:
        return None
    at_ns = int(np.sort(this_ns)[len(this_ns) // 2])
    lead_ns = other_ns - this_ns
    middle_ns = int(np.sort(lead_ns)[len(lead_ns) // 2])
    t_s = (this_ns - at_ns) / 1e9
    lead_s = (lead_ns - middle_ns) / 1e9
    drift = _median_slope(t_s, lead_s)
    if abs(drift) > _LARGEST_DRIFT_PPM * 1e-6:
        drift = 0.0
    inside, scatter = _inside(lead_s - drift * t_s)
    spread = float(np.std(t_s[inside]))
    if drift and spread > 0:  # one-sided outliers tilt the medians a little: fit again without them
        drift = float(np.polyfit(t_s[inside], lead_s[inside], 1)[0])
        inside, scatter = _inside(lead_s - drift * t_s)
    # Neighbouring delays correlate: there are at most as many independent ones as correlation times.
    independent = max(1.0, min(float(inside.sum()), np.ptp(t_s) / _CORRELATED_S))
    sigma = max(scatter, 1e-9) / (spread * np.sqrt(independent)) if spread > 0 else np.inf
    if abs(drift) < _CLEAR * sigma:
        drift = 0.0
    offset_s = float(np.median((lead_s - drift * t_s)[inside]))
    return ClockFit(
        at_ns=at_ns,
        offset_ns=middle_ns + round(offset_s * 1e9),
        drift_ppm=drift * 1e6,
        drift_sigma_ppm=min(float(sigma) * 1e6, 1e9),
        residual_s=scatter,
        events=len(this_ns),
        rejected=int(np.count_nonzero(~inside)),
    )


def _inside(residual_s: Float) -> tuple[NDArray[np.bool_], float]:
    """Mark the events near the line, and compute their scatter about it."""
    centred = residual_s - np.median(residual_s)
    scatter = 1.4826 * float(np.median(np.abs(centred)))
    return np.abs(centred) <= 6 * max(scatter, 1e-9), scatter


def _median_slope(t_s: Float, lead_s: Float) -> float:
    """Compute the median slope over all pairs of events, which are thinned out evenly."""
    order = np.argsort(t_s, kind="stable")
    kept = order[np.unique(np.linspace(0, len(order) - 1, min(len(order), _MOST_PAIRS)).astype(np.intp))]
    first, second = np.triu_indices(len(kept), 1)
    step = t_s[kept][second] - t_s[kept][first]
    rise = lead_s[kept][second] - lead_s[kept][first]
    # Pairs far apart determine the drift; the slopes of close ones are dominated by delays.
    far = step > np.ptp(t_s) / 4
    return float(np.median(rise[far] / step[far])) if far.any() else 0.0
