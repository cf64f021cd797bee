"""How long errors of a keypoint last.

A detector is wrong for the same reasons in neighbouring pictures, so many of them do not say as much as
independent ones would: the mean of a stationary error falls as if only one in tau = 1 + 2 sum of its
autocorrelations had been taken. An estimate that does not know this takes keypoint errors for slow pose
errors. What tells them apart: a pose error moves all joints of a camera together, so it is looked for in
what each joint does beside the others. Residuals show less of it, see `memory_of`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.reconstruction.refinement.problem import State
from pipelines.reconstruction.refinement.system import System, misfit

Float = NDArray[np.float64]

_LONGEST_S = 2.0  # lags up to here
_STOPS = 0.02  # an autocorrelation below this is chance, and what follows too
_MOST = 30.0


def memory_of(system: System, state: State) -> float:
    """How many neighbouring residuals at an estimate say as much as one: tau, from 1 to 30."""
    problem = system.problem
    pictures = problem.pictures
    _, residual, _ = misfit(system, state)
    far = (residual**2).sum(axis=-1) > system.bound2
    residual = np.where(far[..., None], np.nan, residual)
    cameras = np.unique(pictures.camera)
    # Of a picture whose joints are all far off nothing is left.
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
    # Of the 2 C numbers that C cameras see of a slow error, the joint's position takes three.
    shown = (2 * len(cameras) - 3) / (2 * len(cameras))
    correlation = products / np.maximum(counts, 1) / (products[0] / counts[0])
    tau = 1.0
    for value in correlation[1:]:
        if value < _STOPS:
            break
        tau += 2 * float(value) / shown
    return min(tau, _MOST)


def lasting(memory: float, pixel_scale: float) -> float:
    """How many neighbouring image points say as much as one where part of their error hardly shows.

    What a single one errs by is stated: for a detector, what was measured. Pictures show less, a share
    `pixel_scale`, where the rest lasts so long that joints and cameras follow it. The mean of N has the
    variance (s^2 + (1 - s^2) tau) / N of a stated one, s^2 / N was counted. Where errors do not last, a small
    scale says that the points are better than stated.

    Args:
        memory: tau, as `memory_of` found it.
        pixel_scale: s, standard deviation of what pictures show, as a share of the stated.
    """
    return max(memory, 1.0 + (pixel_scale**-2 - 1.0) * memory)


def _evenly(when_s: Float, values: Float, step_s: float) -> Float:
    """Values [F, ...] at their places in an even sequence; NaN where there is none."""
    place = np.round((when_s - when_s[0]) / step_s).astype(np.int64)
    even = np.full((int(place[-1]) + 1, *values.shape[1:]), np.nan)
    even[place] = values
    return even
