"""When pictures were taken, from how the camera turned: in the pictures, and by the log of its poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.poses import conjugate, multiply, rotation_vector_from_quaternion

Int64 = NDArray[np.int64]
Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

_STEP_S = 0.02
_SMOOTHED_S = 0.1  # standard deviation of the window: a log's attitude is noisy from row to row
_LEAST_WEIGHT = 0.9  # of a window: beside gaps and ends its mean is not that of its middle
_ALIKE_S = 2 * np.sqrt(np.pi) * _SMOOTHED_S  # smoothed rates this far apart count as independent
_LEAST_RATE = 1e-3  # rad/s, that rates err by at the least
_LEAST_OVERLAP = 0.5  # of the pictures, that the log must cover
_LEAST_EXPLAINED = 0.5
_ELSEWHERE_S = 0.5  # a start this far from the best is another one
_CLEAR = 18.0  # difference of log-likelihoods to it: six standard deviations
_LARGEST_SIGMA_S = 0.1
_BLOCK_S = 1.0  # errors within a second resemble each other


@dataclass(frozen=True)
class StartFit:
    """When the first picture was taken."""

    start_ns: int
    sigma_s: float
    explained: float  # share of the pictures' turning, squared, that the log's explains
    turning_deg_s: float  # root mean square of the log's, while the pictures were taken


def fit_start(
    t_ns: Int64, quaternion_xyzw: Float, pts_ns: Int64, turned: Float, *, max_gap_ns: int
) -> StartFit:
    """The time of the first picture at which the turning of pictures and poses agrees best.

    Both are integrated to angular rates about the camera's axes on a grid of 20 ms, smoothed alike, and
    compared at every shift (least squares; all shifts at once by Fourier transform), then the best is
    refined by Gauss-Newton. Its standard deviation lets errors within a second be of any correlation
    (sums over blocks: Liang and Zeger 1986).

    Args:
        t_ns: [N] strictly increasing stamps of the poses.
        quaternion_xyzw: [N, 4] world_from_camera.
        pts_ns: [F] strictly increasing stamps of pictures, from 0.
        turned: [F - 1, 3] rad, the camera's rotation from each picture to the next about its own axes;
            NaN where that is not known.
        max_gap_ns: poses further apart than this say nothing in between.

    Raises:
        ValueError: they agree nowhere, or at several times; what the matter is, in words.
    """
    between = multiply(conjugate(quaternion_xyzw[:-1]), quaternion_xyzw[1:])
    of_log = rotation_vector_from_quaternion(between)
    of_log[np.diff(t_ns) > max_gap_ns] = np.nan
    log, log_known = _rates((t_ns - t_ns[0]) / 1e9, of_log)
    seen, seen_known = _rates((pts_ns - pts_ns[0]) / 1e9, turned)
    if not seen_known.any() or not log_known.any():
        raise ValueError("their motion cannot be measured")
    gain, energy, covered = _gains(log, log_known, seen, seen_known)
    doubt = _doubts(gain, energy, covered, seen[seen_known])
    if not np.isfinite(doubt).any():
        raise ValueError("the poses cover less than half of them")
    best = int(np.argmin(doubt))
    explained = float(gain[best] / energy[best])
    if not explained > _LEAST_EXPLAINED:
        raise ValueError(
            f"they do not turn as the poses do (these explain {max(explained, 0.0):.0%} of their motion)"
        )
    elsewhere = np.abs(np.arange(len(doubt)) - best) * _STEP_S > _ELSEWHERE_S
    second = int(np.argmin(np.where(elsewhere, doubt, np.inf)))
    turning_deg_s = float(np.degrees(np.sqrt(np.mean((seen[seen_known] ** 2).sum(axis=1)))))
    if doubt[second] - doubt[best] < _CLEAR:
        raise ValueError(
            f"they turn as the poses do at several times, {abs(best - second) * _STEP_S:.2f} s apart"
            f" ({turning_deg_s:.2g} deg/s is too little or too even)"
        )
    start_s, sigma_s = _refined(log, log_known, seen, seen_known, (best - len(seen) + 1) * _STEP_S)
    if not sigma_s < _LARGEST_SIGMA_S:
        raise ValueError(
            f"their turning ({turning_deg_s:.2g} deg/s) says when to {sigma_s:.2g} s only, not to"
            f" {_LARGEST_SIGMA_S:g} s"
        )
    return StartFit(
        start_ns=int(t_ns[0]) + round(start_s * 1e9),
        sigma_s=sigma_s,
        explained=explained,
        turning_deg_s=turning_deg_s,
    )


def _rates(t_s: Float, turned: Float) -> tuple[Float, Bool]:
    """Smoothed angular rates rad/s [G, 3] in steps from t_s[0] on, and where they are known."""
    from scipy.ndimage import gaussian_filter1d

    unknown: Bool = np.asarray(np.isnan(turned).any(axis=1))
    angle = np.zeros((len(t_s), 3))
    np.cumsum(np.where(unknown[:, None], 0.0, turned), axis=0, out=angle[1:])
    missing_s = np.concatenate([[0.0], np.cumsum(np.where(unknown, np.diff(t_s), 0.0))])
    edges = np.arange(0.0, t_s[-1] - t_s[0] + 1e-9, _STEP_S)
    at = edges + t_s[0]
    rate = np.stack([np.diff(np.interp(at, t_s, axis)) for axis in angle.T], axis=1) / _STEP_S
    known = np.asarray(np.diff(np.interp(at, t_s, missing_s)) < 1e-9)
    width = _SMOOTHED_S / _STEP_S
    weight = gaussian_filter1d(known.astype(np.float64), width, mode="constant")
    smooth = gaussian_filter1d(rate * known[:, None], width, axis=0, mode="constant")
    known = known & np.asarray(weight > _LEAST_WEIGHT)
    return np.where(known[:, None], smooth / np.maximum(weight, 1e-9)[:, None], 0.0), known


def _gains(log: Float, log_known: Bool, seen: Float, seen_known: Bool) -> tuple[Float, Float, Float]:
    """What the log explains of what is seen, by start: from len(seen) - 1 steps before the log's on.

    Returns:
        [S] what it explains and [S] what there is, rad^2/s^2 summed over the steps that the log covers; and
        [S] how many these are.
    """
    from scipy.signal import correlate

    def summed(of_log: Float, of_seen: Float) -> Float:
        return np.asarray(correlate(of_log, of_seen, mode="full", method="fft"))

    log_one, seen_one = log_known.astype(np.float64), seen_known.astype(np.float64)
    both = np.sum([summed(log[:, axis], seen[:, axis]) for axis in range(3)], axis=0)
    gain = 2 * both - summed((log**2).sum(axis=1), seen_one)
    energy = summed(log_one, (seen**2).sum(axis=1))
    return gain, np.maximum(energy, 1e-12), np.rint(summed(log_one, seen_one))


def _doubts(gain: Float, energy: Float, covered: Float, seen: Float) -> Float:
    """[S] the negative logarithm of each start's likelihood, but for a constant; inf where little is covered.

    Steps that the log covers err by what it leaves, the others by all that is seen.
    """
    enough = covered >= _LEAST_OVERLAP * len(seen)
    left = np.maximum((energy - gain) / np.maximum(3 * covered, 1), _LEAST_RATE**2)
    all_seen = max(float((seen**2).mean()), _LEAST_RATE**2)
    independent = 3 * _STEP_S / _ALIKE_S  # of a step's three rates
    doubt = independent / 2 * (covered * np.log(left) + (len(seen) - covered) * np.log(all_seen))
    return np.where(enough, doubt, np.inf)


def _refined(
    log: Float, log_known: Bool, seen: Float, seen_known: Bool, start_s: float
) -> tuple[float, float]:
    """The start to a fraction of a step, s after the log's, and its standard deviation in s."""
    from scipy.interpolate import CubicSpline

    log_s = _STEP_S * np.arange(len(log))
    curve = CubicSpline(log_s, log)
    slope = curve.derivative()
    sigma_s = np.inf
    for _ in range(10):
        at = _STEP_S * np.arange(len(seen)) + start_s
        nearest = np.rint(at / _STEP_S).astype(np.int64)
        inside: Bool = np.asarray((nearest >= 0) & (nearest < len(log)) & seen_known)
        inside[inside] = log_known[nearest[inside]]
        rise = slope(at[inside])
        pull = (rise * (seen[inside] - curve(at[inside]))).sum(axis=1)
        weight = float((rise**2).sum())
        if not weight:
            return start_s, np.inf
        block = np.floor(at[inside] / _BLOCK_S).astype(np.int64)
        sums = np.bincount(block - block.min(), pull)
        sigma_s = float(np.sqrt((sums**2).sum())) / weight
        start_s += float(pull.sum()) / weight
    return start_s, sigma_s
