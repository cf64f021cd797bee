"""Optional steps after triangulation: filling of short gaps, always marked, then smoothing.

A gap is a stretch of times at which a joint was not measured, between two at which it was; its length is the
time between those two. A joint is interpolated by PCHIP (Fritsch & Butland 1984), which uses the two measured
samples before and after, and never swings beyond them. The interpolation error is measured on complete
stretches of the same joint: the same number of samples is left out, interpolated and compared. The
covariance grows by that error.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int8, Int64
from pipelines.geometry.triangulation import STATUS, Triangulation, Views, reprojection_px
from pipelines.reconstruction.observations import Observations
from pipelines.reconstruction.smoothing import Smoother


def finish(
    observations: Observations,
    views: Views,
    result: Triangulation,
    *,
    fill_s: float | None,
    smoother: Smoother | None,
) -> tuple[Triangulation, dict[str, Any]]:
    """Fill gaps of at most `fill_s`, smooth, and report both.

    Args:
        observations: the triangulated observations.
        views: the same, one row for each joint-frame.
        fill_s: the longest gap to fill, None to fill none.
        smoother: the smoother, None for no smoothing.

    Returns:
        The result, and JSON-able `filled` and `smoothing`, None for a step not requested. Residuals are
        those of the new positions. Filled joints have no residuals and no views.
    """
    report: dict[str, Any] = {"filled": None, "smoothing": None}
    shape = observations.confidence.shape[:3]
    position = result.points.reshape(*shape, 3)
    covariance = result.covariance.reshape(*shape, 3, 3)
    status = result.status.reshape(shape)
    if fill_s is not None:
        filled = fill_gaps(observations.t_ns, position, covariance, status, max_gap_s=fill_s)
        position, covariance, status = filled.position, filled.covariance, filled.status
        report["filled"] = {"longest_gap_s": fill_s, **filled.counts}
    residual_px = result.residual_px
    if smoother is not None:
        smooth = smoother.apply(observations.t_ns, position, covariance)
        position, covariance = smooth.position, smooth.covariance
        report["smoothing"] = smooth.report
        measured = result.status == STATUS.index("ok")
        again = reprojection_px(views, position.reshape(-1, 3))
        residual_px = np.where(measured[:, None], again, result.residual_px)
    return replace(
        result,
        points=position.reshape(-1, 3),
        covariance=covariance.reshape(-1, 3, 3),
        status=status.ravel(),
        residual_px=residual_px,
    ), report


# --- gaps ----------------------------------------------------------------------------------------------

_OK, _FILLED = STATUS.index("ok"), STATUS.index("filled")
# PCHIP uses so many measured samples on each side of a gap.
_SIDES = 2
# The interpolation error is measured at so many stretches at most, which takes little time.
_PLACES = 24
# Fewer stretches give no error of the interpolation.
_FEWEST_PLACES = 4


@dataclass(frozen=True)
class Filled:
    """Skeleton with its short gaps filled."""

    position: Float  # [T, P, J, 3] m
    covariance: Float  # [T, P, J, 3, 3] m^2
    status: Int8  # [T, P, J] index into STATUS
    counts: dict[str, int]  # gaps and joint-frames filled; short gaps left open for lack of an error estimate


def fill_gaps(t_ns: Int64, position: Float, covariance: Float, status: Int8, *, max_gap_s: float) -> Filled:
    """Interpolate joints across gaps of at most that length.

    The covariance at share a of a gap is (1-a)^2 C0 + a^2 C1 + 4 a (1-a) M. The first two terms are those of
    a straight line between the ends. M is the mean outer product of the interpolation errors in the middle
    of gaps of that length.

    Args:
        t_ns: [T] strictly increasing.
        position: [T, P, J, 3] m; NaN unless the status is "ok".
        covariance: [T, P, J, 3, 3] m^2.
        status: [T, P, J] index into STATUS.
        max_gap_s: the longest gap that is filled, from the last measured sample to the next.

    Returns:
        Skeleton with unchanged measured samples. These gaps stay open: longer ones, those before the first
        and after the last measured sample, and those next to a single sample between two gaps.
    """
    filled = Filled(position.copy(), covariance.copy(), status.copy(), {})
    t_s = (t_ns - t_ns[0]) / 1e9
    gaps = joint_frames = unjudged = 0
    for person, joint in np.ndindex(status.shape[1:]):
        there = status[:, person, joint] == _OK
        known: dict[int, Float | None] = {}
        for before, after in _gaps(t_s, there, max_gap_s):
            missing = after - before - 1
            if missing not in known:
                known[missing] = _miss(t_s, position[:, person, joint], there, missing)
            miss = known[missing]
            if miss is None:
                unjudged += 1
                continue
            inside = np.arange(before + 1, after)
            samples = np.r_[before - _SIDES + 1 : before + 1, after : after + _SIDES]
            filled.position[inside, person, joint] = _interpolated(
                t_s[samples], position[samples, person, joint], t_s[inside]
            )
            a = ((t_s[inside] - t_s[before]) / (t_s[after] - t_s[before]))[:, None, None]
            ends = covariance[[before, after], person, joint]
            filled.covariance[inside, person, joint] = (
                (1 - a) ** 2 * ends[0] + a**2 * ends[1] + 4 * a * (1 - a) * miss
            )
            filled.status[inside, person, joint] = _FILLED
            gaps += 1
            joint_frames += missing
    filled.counts.update(gaps=gaps, joint_frames=joint_frames, gaps_without_example=unjudged)
    return filled


def _gaps(t_s: Float, there: Bool, max_gap_s: float) -> list[tuple[int, int]]:
    """List the measured samples before and after every gap that may be filled."""
    (measured,) = np.nonzero(there)
    wide = np.diff(measured) > 1
    short = np.diff(t_s[measured]) <= max_gap_s * (1 + 1e-9)
    found = []
    for k in np.flatnonzero(wide & short):
        before, after = int(measured[k]), int(measured[k + 1])
        enough = before >= _SIDES - 1 and after + _SIDES <= len(there)
        if enough and there[before - _SIDES + 1 : before].all() and there[after : after + _SIDES].all():
            found.append((before, after))
    return found


def _miss(t_s: Float, position: Float, there: Bool, missing: int) -> Float | None:
    """Compute the mean outer product [3, 3] of interpolation errors in the middle of gaps of that length.

    Returns None if fewer than 4 complete stretches exist.
    """
    span = missing + 2 * _SIDES
    if len(t_s) < span:
        return None
    windows = np.lib.stride_tricks.sliding_window_view(there, span)
    complete = np.asarray(windows.all(axis=1), dtype=np.bool_)
    # A pause between the samples is no example of a gap of that many.
    usual = 1.5 * float(np.median(np.diff(t_s))) * (span - 1)
    (places,) = np.nonzero(complete & (t_s[span - 1 :] - t_s[: len(complete)] <= usual))
    if len(places) < _FEWEST_PLACES:
        return None
    chosen = places[np.linspace(0, len(places) - 1, min(len(places), _PLACES)).astype(np.int64)]
    errors = []
    for first in chosen:
        samples = first + np.r_[:_SIDES, _SIDES + missing : span]
        middle = first + _SIDES + np.array([missing // 2])
        guess = _interpolated(t_s[samples], position[samples], t_s[middle])
        errors.append((guess - position[middle])[0])
    error = np.stack(errors)
    outer: Float = error.T @ error / len(error)
    return outer


def _interpolated(t_s: Float, position: Float, at_s: Float) -> Float:
    from scipy.interpolate import PchipInterpolator

    between: Float = PchipInterpolator(t_s, position, axis=0)(at_s)
    return between
