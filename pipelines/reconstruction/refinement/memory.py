"""Memory of keypoint errors: their correlation over neighbouring pictures.

A detector is wrong for the same reasons in neighbouring pictures, so they carry less information than
independent pictures: the mean of a stationary error falls as if only one in tau = 1 + 2 sum of its
autocorrelations had been taken. An estimate that ignores this treats keypoint errors as slow pose errors.
A pose error moves all joints of a camera together. The memory is therefore measured on each joint's residual
relative to the other joints. Residuals show only a part of the error, see `memory_of`.
"""

from __future__ import annotations

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.reconstruction.refinement.problem import State
from pipelines.reconstruction.refinement.system import System, misfit

_LONGEST_S = 2.0  # lags up to here
_STOPS = 0.02  # an autocorrelation below this is chance; the sum stops there
_MOST = 30.0


def memory_of(system: System, state: State) -> float:
    """Estimate tau, the number of neighbouring residuals that count as one independent one, from 1 to 30."""
    problem = system.problem
    pictures = problem.pictures
    _, residual, _ = misfit(system, state)
    far = (residual**2).sum(axis=-1) > system.bound2
    residual = np.where(far[..., None], np.nan, residual)
    cameras = np.unique(pictures.camera)
    # A picture without any inlier joint contributes nothing.
    own = residual - np.nansum(residual, axis=1, keepdims=True) / np.maximum(
        np.sum(~np.isnan(residual), axis=1, keepdims=True), 1
    )
    lags = max(int(_LONGEST_S / system.usual_step_s), 1)
    products, counts = np.zeros(lags + 1), np.zeros(lags + 1)
    for camera in cameras:
        (mine,) = np.nonzero(pictures.camera == camera)
        order = mine[np.argsort(pictures.when_s[mine], kind="stable")]
        step_s = float(np.median(np.diff(pictures.when_s[order]))) if len(order) > 1 else 1.0
        values = _evenly(pictures.when_s[order], own[order], step_s)
        for lag in range(min(lags, len(values) - 1) + 1):
            product = values[: len(values) - lag] * values[lag:]
            products[lag] += np.nansum(product)
            counts[lag] += np.isfinite(product).sum()
    if counts[0] == 0:
        return 1.0
    # Of the 2 C numbers that C cameras see of a slow error, the joint's position absorbs three.
    shown = (2 * len(cameras) - 3) / (2 * len(cameras))
    correlation = products / np.maximum(counts, 1) / (products[0] / counts[0])
    tau = 1.0
    for value in correlation[1:]:
        if value < _STOPS:
            break
        tau += 2 * float(value) / shown
    return min(tau, _MOST)


def lasting(memory: float, pixel_scale: float) -> float:
    """Compute the memory of image points if part of their error does not show in residuals.

    The error of a single point is known beforehand: for a detector, the measured one. Residuals show only
    the share `pixel_scale` of it if the rest is correlated for so long that joints and cameras follow it. The
    mean of N points has (s^2 + (1 - s^2) tau) / N times the stated variance, where s^2 / N was counted. For
    errors without correlation, a small scale means that the points are better than stated.

    Args:
        memory: tau from `memory_of`.
        pixel_scale: s, standard deviation of the residuals, as a share of the stated one.
    """
    return max(memory, 1.0 + (pixel_scale**-2 - 1.0) * memory)


def _evenly(when_s: Float, values: Float, step_s: float) -> Float:
    """Put values [F, ...] at their places in an even sequence; NaN where there is none."""
    place = np.round((when_s - when_s[0]) / step_s).astype(np.int64)
    even = np.full((int(place[-1]) + 1, *values.shape[1:]), np.nan)
    even[place] = values
    return even
