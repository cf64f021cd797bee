"""Optional steps after triangulation: filling of short gaps, always marked, then a low-pass filter.

A gap is a stretch of times at which a joint was not measured, between two at which it was; its length is the
time between those two. A joint is interpolated by PCHIP (Fritsch & Butland 1984), which uses the two measured
samples before and after, and never swings beyond them. The interpolation error is measured on complete
stretches of the same joint: the same number of samples is left out, interpolated and compared. The
covariance grows by that error.

The filter is the usual one in biomechanics: Butterworth's, a pass of order n/2 forwards and one backwards,
so that there is no lag. The cutoff of a pass is raised so that both together have -3 dB at `cutoff_hz`
(Robertson & Dowling 2003; Winter 2009, 3.4.4.2), exactly, for the digital filter. It works on contiguous
runs of a joint's samples and never across a gap; filled samples belong to runs. Covariances stay, because
the filter's effect on correlated errors is unknown.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int8, Int64
from pipelines.geometry.noise import parse
from pipelines.geometry.triangulation import STATUS, Triangulation, Views, reprojection_px
from pipelines.reconstruction.observations import Observations
from pipelines.session.errors import DataError

_PLACE = "--smooth"
# A step of more than so many median ones is a gap.
_USUAL_STEP = 1.5
# A filter of fixed rate is wrong for stamps that jitter by a larger share of the step.
_UNEVEN = 0.25


@dataclass(frozen=True)
class Butterworth:
    """Zero-phase low-pass filter with the options of `--smooth butterworth`."""

    # Biomechanics filters gait at 6 Hz (Winter 2009).
    cutoff_hz: float = 6.0
    # Twice a filter of second order, forwards and backwards, is usual in biomechanics.
    order: float = 4

    def __post_init__(self) -> None:
        if not 0 < self.cutoff_hz < math.inf:
            raise ValueError(f"cutoff_hz is {self.cutoff_hz:g}; it must be above 0")
        if self.order not in (2, 4, 6, 8):
            raise ValueError(f"order is {self.order:g}; both passes together have 2, 4, 6 or 8")

    def apply(self, t_ns: Int64, position: Float) -> tuple[Float, dict[str, Any]]:
        """Filter every run of positions [T, P, J, 3] m; return them and a JSON-able report."""
        from scipy.signal import butter, sosfiltfilt

        step_s, rate_hz = _even_rate(t_ns)
        if self.cutoff_hz >= rate_hz / 2:
            raise DataError(
                _PLACE,
                f"cutoff_hz={self.cutoff_hz:g} is not below half the skeleton's rate ({rate_hz / 2:.4g} Hz)",
                "state a lower cutoff",
            )
        passes = int(self.order) // 2
        design_hz = self._design_hz(rate_hz)
        sections = butter(passes, design_hz, fs=rate_hz, output="sos")
        # Ends are mirrored in their last sample, over the memory of the filter.
        padding = max(3 * (2 * len(sections) + 1), round(rate_hz / self.cutoff_hz))
        smooth = position.copy()
        runs = _runs(t_ns, position, step_s)
        short = 0
        for person, joint, first, stop in runs:
            if stop - first <= padding:
                short += stop - first
                continue
            own = position[first:stop, person, joint]
            smooth[first:stop, person, joint] = (
                sosfiltfilt(sections, own - own[0], axis=0, padlen=padding) + own[0]
            )  # far from the origin digits are lost
        report = {
            "filter": "butterworth",
            "passes": "one forwards, one backwards: no lag",
            "order": int(self.order),
            "order_of_a_pass": passes,
            "cutoff_hz": self.cutoff_hz,
            "cutoff_of_a_pass_hz": design_hz,
            "rate_hz": rate_hz,
            "runs": len(runs),
            "joint_frames_in_runs_too_short": short,
            "covariances": "as before smoothing",
        }
        return smooth, report

    def _design_hz(self, rate_hz: float) -> float:
        """Compute the -3 dB frequency of one pass for which two passes have theirs at `cutoff_hz`.

        A digital pass has the gain 1 / (1 + (tan(pi f / rate) / tan(pi d / rate))^2m) (bilinear transform),
        two have its square; that is 1/2 where the ratio to the power of 2m is sqrt(2) - 1.
        """
        passes = int(self.order) // 2
        tangent = math.tan(math.pi * self.cutoff_hz / rate_hz) / (math.sqrt(2) - 1) ** (1 / (2 * passes))
        return math.atan(tangent) * rate_hz / math.pi


def smoother(text: str | None) -> Butterworth | None:
    """Parse a text like `butterworth:cutoff_hz=6,order=4` to a filter; None stays None."""
    if text is None:
        return None
    remedy = "write butterworth:cutoff_hz=6,order=4"
    try:
        (name, parameters), *others = [(text.strip(), {})] if text.strip() == "butterworth" else parse(text)
    except ValueError as error:
        raise DataError(_PLACE, str(error), remedy) from None
    if others or name != "butterworth":
        raise DataError(_PLACE, f"no such filter: {text}", remedy, code="no-such-name")
    unknown = sorted(set(parameters) - {"cutoff_hz", "order"})
    if unknown:
        raise DataError(_PLACE, f"{name} has no {', '.join(unknown)}", "it has cutoff_hz, order")
    for key, value in parameters.items():
        if not isinstance(value, float):
            raise DataError(_PLACE, f"{key} is {value!r} instead of a number", remedy, code="bad-value")
    try:
        return Butterworth(**parameters)  # type: ignore[arg-type]
    except ValueError as error:
        raise DataError(_PLACE, f"{name}: {error}", remedy) from None


def _even_rate(t_ns: Int64) -> tuple[float, float]:
    """Compute the skeleton's step (s) and rate (Hz); refuse uneven times."""
    if len(t_ns) < 2:
        raise DataError(_PLACE, "a single sample has no rate to filter at", "leave it out")
    steps = np.diff(t_ns)
    step = float(np.median(steps))
    near = steps <= _USUAL_STEP * step
    if np.mean(np.abs(steps[near] - step) > _UNEVEN * step) > _UNEVEN:
        raise DataError(
            _PLACE,
            f"the skeleton's times are uneven ({steps.min() / 1e6:.1f} ms apart and more)",
            "state --rate as well",
        )
    # The mean, not the median: stamps in whole ns or jitter make no bias.
    mean_s = float(steps[near].mean()) / 1e9
    return mean_s, 1 / mean_s


def _runs(t_ns: Int64, position: Float, step_s: float) -> list[tuple[int, int, int, int]]:
    """List every run without a gap: person, joint, first sample, and the one after the last."""
    runs = []
    gap = np.append(np.diff(t_ns) > _USUAL_STEP * step_s * 1e9, True)
    there = np.isfinite(position[..., 0])
    for person, joint in np.ndindex(there.shape[1:]):
        own = there[:, person, joint]
        (first,) = np.nonzero(own & ~np.append(False, own[:-1] & ~gap[:-1]))
        (last,) = np.nonzero(own & (gap | ~np.append(own[1:], False)))
        runs += [(person, joint, int(a), int(b) + 1) for a, b in zip(first, last, strict=True)]
    return runs


def finish(
    observations: Observations,
    views: Views,
    result: Triangulation,
    *,
    fill_s: float | None,
    smoother: Butterworth | None,
) -> tuple[Triangulation, dict[str, Any]]:
    """Fill gaps of at most `fill_s` (None: none), smooth (None: not), and report both as JSON."""
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
        position, report["smoothing"] = smoother.apply(observations.t_ns, position)
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
    """Interpolate joints [T, P, J, 3] m across gaps of at most that length between two measured samples.

    The covariance at share a of a gap is (1-a)^2 C0 + a^2 C1 + 4 a (1-a) M: a straight line between the ends,
    and M the mean outer product of the interpolation errors in the middle of gaps of that length. A gap next
    to a single sample between two gaps stays open.
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
    """Compute the mean outer product [3, 3] of errors mid-gap; None for fewer than 4 stretches."""
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

    return PchipInterpolator(t_s, position, axis=0)(at_s)
