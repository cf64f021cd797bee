"""The exposure of a picture's rows: the moments to render, and how much of each a row holds."""

from __future__ import annotations

import numpy as np

from pipelines.geometry.arrays import Float

STEP_S = 1e-3
"""Longest time between moments: 1 px of an image that moves by 1,000 px/s.

A camera that yaws by 60 degrees a second then films within 0.25 of 255 (rms) of moments 0.25 ms apart, a
seventh of the sensor's noise."""


def exposed_moments(rows: int, *, exposure_s: float, readout_s: float) -> tuple[Float, Float]:
    """Choose moments whose weighted means are the rows of a picture.

    A row's light is the mean over its exposure of light that changes linearly between the moments. The
    middle of the middle row's exposure is the picture's time.

    Args:
        rows: of the picture, read from the first to the last.
        exposure_s: of each row.
        readout_s: from the first row to the last.

    Returns:
        [K] s against the picture's time, ascending, and [K, rows] weights whose columns add up to 1.
    """
    # An even number of steps: the picture's own time is one of the moments.
    steps = 2 * int(np.ceil((exposure_s + readout_s) / (2 * STEP_S) - 1e-9))
    if not steps:
        return np.zeros(1), np.ones((1, rows))
    moments = (np.arange(steps + 1) / steps - 0.5) * (exposure_s + readout_s)
    middle = (np.arange(rows) / max(rows - 1, 1) - 0.5) * readout_s
    if not exposure_s:
        return moments, _between(moments, middle)
    whole = _integral(moments, middle + exposure_s / 2) - _integral(moments, middle - exposure_s / 2)
    return moments, whole / exposure_s


def _between(moments: Float, at: Float) -> Float:
    """Compute weights [K, N] of linear interpolation between moments [K] at times [N] within them."""
    return np.stack([np.interp(at, moments, one) for one in np.eye(len(moments))])


def _integral(moments: Float, until: Float) -> Float:
    """Compute weights [K, N] of the integral of what is linear between moments, from the first one on."""
    step_s = moments[1] - moments[0]
    cell = np.clip(((until - moments[0]) / step_s).astype(np.int64), 0, len(moments) - 2)
    share = (until - moments[cell]) / step_s
    number = np.arange(len(moments))[:, None]
    # A step that was passed gives half of it to both of its ends.
    passed = np.where(number < cell, 0.5, 0.0) + np.where((number > 0) & (number <= cell), 0.5, 0.0)
    passed += np.where(number == cell, share - share**2 / 2, 0.0)
    passed += np.where(number == cell + 1, share**2 / 2, 0.0)
    weights: Float = step_s * passed
    return weights
