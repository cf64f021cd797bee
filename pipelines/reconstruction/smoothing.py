"""Smoothing of a skeleton at the user's request: a zero-phase Butterworth filter, or an RTS smoother.

Both work on contiguous runs of a joint's samples and never across a gap. `filled` samples belong to runs.

- `butterworth`: the usual filter in biomechanics. A pass of order n/2 forwards and one backwards (so there is
  no lag); the cutoff of a pass is raised so that both together have -3 dB at `cutoff_hz` (Robertson & Dowling
  2003; Winter 2009, 3.4.4.2), exactly, for the digital filter.
- `rts`: a Kalman filter and the smoother of Rauch, Tung & Striebel (1965) on a model of constant acceleration
  (driven by white jerk) or constant jerk (driven by white snap), weighing each sample by its covariance.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from math import factorial
from typing import Any, Literal

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.noise import parse
from pipelines.session.errors import DataError

_PLACE = "--smooth"
# A step of more than so many median ones is a gap.
_USUAL_STEP = 1.5
# A filter of fixed rate is wrong for stamps that jitter by a larger share of the step.
_UNEVEN = 0.25


@dataclass(frozen=True)
class Smoothed:
    """Skeleton after smoothing, with a report of the filter."""

    position: Float  # [T, P, J, 3] m
    covariance: Float  # [T, P, J, 3, 3] m^2
    report: dict[str, Any]  # JSON-able: the filter, its effective cutoff or density, runs that were too short


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

    def apply(self, t_ns: Int64, position: Float, covariance: Float) -> Smoothed:
        """Filter every run; covariances stay, because the filter's effect on correlated errors is unknown."""
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
        return Smoothed(smooth, covariance, report)

    def _design_hz(self, rate_hz: float) -> float:
        """Compute the -3 dB frequency of one pass for which two passes have theirs at `cutoff_hz`.

        A digital pass has the gain 1 / (1 + (tan(pi f / rate) / tan(pi d / rate))^2m) (bilinear transform),
        two have its square; that is 1/2 where the ratio to the power of 2m is sqrt(2) - 1.
        """
        passes = int(self.order) // 2
        tangent = math.tan(math.pi * self.cutoff_hz / rate_hz) / (math.sqrt(2) - 1) ** (1 / (2 * passes))
        return math.atan(tangent) * rate_hz / math.pi


@dataclass(frozen=True)
class RauchTungStriebel:
    """Smoother with the options of `--smooth rts`; without a density it is estimated from the data."""

    model: Literal["acceleration", "jerk"] = "acceleration"
    density: float | None = None

    def __post_init__(self) -> None:
        if self.model not in STATES:
            raise ValueError(f"model is {self.model!r} instead of {' or '.join(STATES)}")
        if self.density is not None and not 0 < self.density < math.inf:
            raise ValueError(f"density is {self.density}; it must be a number above 0")

    def apply(self, t_ns: Int64, position: Float, covariance: Float) -> Smoothed:
        """Smooth every run.

        With a stated density, covariances count as white errors, independent from sample to sample. If the
        density is estimated, a factor on the covariances is estimated too: the white share of the variance.
        Only that share is smoothed away; the rest, correlated over time, stays in the covariance.
        """
        step_s = float(np.median(np.diff(t_ns))) / 1e9 if len(t_ns) > 1 else 0.0
        states = STATES[self.model]
        runs = _runs(t_ns, position, step_s)
        begins, used = _marks(position.shape[:3], [run for run in runs if run[3] - run[2] > states])
        columns = used.any(axis=0)
        shape = (len(t_ns), int(columns.sum()))
        t_s = (t_ns - t_ns[0]) / 1e9
        measured, known = position[:, columns], covariance[:, columns]
        density, share = self.density, np.ones(shape[1])
        densities = np.full(shape[1], density or 0.0)
        if density is None and shape[1]:
            densities, share = find_density(
                t_s, measured, known, used[:, columns], begins[:, columns], states
            )
        smooth, uncertain = smooth_positions(
            t_s,
            measured,
            share[:, None, None] * known,
            used[:, columns],
            begins[:, columns],
            densities,
            states,
        )
        correlated = np.maximum(1 - share, 0.0)[:, None, None] * known
        own = used[:, columns]
        new_position, new_covariance = position.copy(), covariance.copy()
        new_position[:, columns] = np.where(own[..., None], smooth, measured)
        new_covariance[:, columns] = np.where(own[..., None, None], uncertain + correlated, known)
        median = float(np.median(densities)) if shape[1] else None
        report = {
            "filter": "rts",
            "model": f"constant {self.model}",
            "density": density if density is not None else median,
            "density_unit": "m/s^3 per sqrt(Hz)" if self.model == "acceleration" else "m/s^4 per sqrt(Hz)",
            "density_from": "stated" if density is not None else "the data, joint by joint (median)",
            "new_share_of_variance": float(np.median(share)) if shape[1] else None,
            "cutoff_hz": _cutoff_hz(densities, share, known, own, step_s, states),
            "runs": len(runs),
            "joint_frames_in_runs_too_short": int((np.isfinite(position[..., 0]) & ~used).sum()),
            "covariances": "of the smoother",
        }
        return Smoothed(new_position, new_covariance, report)


Smoother = Butterworth | RauchTungStriebel
_SMOOTHERS: Mapping[str, Callable[..., Smoother]] = {"butterworth": Butterworth, "rts": RauchTungStriebel}


def smoother(text: str | None) -> Smoother | None:
    """Parse a text like `butterworth:cutoff_hz=6,order=4` or `rts` to a smoother; None stays None.

    Raises:
        DataError: the text has another form, or an unknown filter or option.
    """
    if text is None:
        return None
    remedy = "write butterworth:cutoff_hz=6,order=4 or rts:model=acceleration"
    try:
        parts = [(text.strip(), {})] if text.strip() in _SMOOTHERS else parse(text)
    except ValueError as error:
        raise DataError(_PLACE, str(error), remedy) from None
    if len(parts) != 1:
        raise DataError(_PLACE, f"{text!r} names {len(parts)} filters", "choose one")
    name, parameters = parts[0]
    if name not in _SMOOTHERS:
        raise DataError(_PLACE, f"no such filter: {name}", remedy, code="no-such-name")
    known = [field.name for field in fields(_SMOOTHERS[name])]  # type: ignore[arg-type]
    unknown = sorted(set(parameters) - set(known))
    if unknown:
        raise DataError(_PLACE, f"{name} has no {', '.join(unknown)}", f"it has {', '.join(known)}")
    for key, value in parameters.items():
        if key != "model" and not isinstance(value, float):
            raise DataError(_PLACE, f"{key} is {value!r} instead of a number", remedy, code="bad-value")
    try:
        return _SMOOTHERS[name](**parameters)
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
            "state --rate as well, or smooth with rts",
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


def _marks(shape: tuple[int, ...], runs: list[tuple[int, int, int, int]]) -> tuple[Bool, Bool]:
    """Mark the first samples of runs, and the samples that belong to a run, both [T, P, J]."""
    begins, used = np.zeros(shape, dtype=np.bool_), np.zeros(shape, dtype=np.bool_)
    for person, joint, first, stop in runs:
        begins[first, person, joint] = True
        used[first:stop, person, joint] = True
    return begins, used


def _cutoff_hz(
    density: Float, share: Float, covariance: Float, used: Bool, step_s: float, states: int
) -> float | None:
    """Compute the frequency at which the smoother's gain is 1/sqrt(2) (-3 dB): median over the joints.

    Far from the ends the smoother of n states has the gain 1 / (1 + (w / w0)^2n) with w0^2n = density^2 /
    (variance x step), for steps that are short beside it (Wiener); -3 dB lie at w0 (sqrt(2) - 1)^(1/2n).
    """
    variance = np.trace(covariance, axis1=-2, axis2=-1) / 3
    typical = np.array(
        [
            np.median(own[there]) if there.any() else np.nan
            for own, there in zip(variance.T, used.T, strict=True)
        ]
    )
    noise = share * typical * step_s
    known = np.isfinite(noise) & (noise > 0) & (density > 0)
    if not known.any():
        return None
    corner = (density[known] ** 2 / noise[known]) ** (1 / (2 * states))
    lower = (math.sqrt(2) - 1) ** (1 / (2 * states))
    return float(np.median(corner) * lower / (2 * math.pi))


# --- smoother of Rauch, Tung and Striebel --------------------------------------------------------------

STATES = {"acceleration": 3, "jerk": 4}
"""Number of derivatives in the state of each model, the position included."""

UNKNOWN = (1e2, 1e2, 1e3, 1e4)
"""Prior standard deviation of the state at the start of a run, in m, m/s, m/s^2, m/s^3 from its first sample.

A body's motion is a hundredth of it; a larger value would lose digits.
"""

# The smoother's corner frequency lies between these (rad per sample).
_CORNERS = np.logspace(-2, 0.5, 26)


def smooth_positions(
    t_s: Float, position: Float, covariance: Float, used: Bool, begins: Bool, density: Float, states: int
) -> tuple[Float, Float]:
    """Smooth positions and compute their covariances.

    Args:
        t_s: [T] strictly increasing.
        position: [T, M, 3] m; read where `used`.
        covariance: [T, M, 3, 3] m^2, of errors that are independent from sample to sample.
        used: [T, M] True for samples that belong to a run.
        begins: [T, M] True at the first sample of a run.
        density: [M] square root of the spectral density of the n-th derivative, m/s^n per sqrt(Hz).
        states: n, 3 or 4.

    Returns:
        [T, M, 3] m and [T, M, 3, 3] m^2; meaningless where not `used`.
    """
    times, columns, _ = position.shape
    first = _first(position, used)
    seen = np.where(used[..., None], position - first, 0.0)
    noise = np.where(used[..., None, None], covariance, np.eye(3))
    size = 3 * states
    mean, spread = np.zeros((columns, size)), np.zeros((columns, size, size))
    means, spreads = np.empty((times, columns, size)), np.empty((times, columns, size, size))
    moves = np.empty((times, columns, size, size))
    drives = np.empty((times, columns, size, size))
    for t in range(times):
        moves[t], drives[t] = _transition(t_s, t, begins[t], density**2, states)
        mean = np.einsum("mij,mj->mi", moves[t], mean)
        spread = moves[t] @ spread @ np.swapaxes(moves[t], 1, 2) + drives[t]
        innovation = seen[t] - mean[:, :3]
        gain = np.swapaxes(np.linalg.solve(spread[:, :3, :3] + noise[t], spread[:, :3]), 1, 2)
        gain *= used[t][:, None, None]
        mean = mean + np.einsum("mij,mj->mi", gain, innovation)
        # Joseph's form: stays symmetric and positive in spite of rounding.
        left = np.eye(size) - np.concatenate([gain, np.zeros((columns, size, size - 3))], axis=2)
        spread = left @ spread @ np.swapaxes(left, 1, 2) + gain @ noise[t] @ np.swapaxes(gain, 1, 2)
        means[t], spreads[t] = mean, spread
    for t in range(times - 2, -1, -1):
        predicted = moves[t + 1] @ spreads[t] @ np.swapaxes(moves[t + 1], 1, 2) + drives[t + 1]
        back = np.swapaxes(np.linalg.solve(predicted, moves[t + 1] @ spreads[t]), 1, 2)
        ahead = means[t + 1] - np.einsum("mij,mj->mi", moves[t + 1], means[t])
        means[t] += np.einsum("mij,mj->mi", back, ahead)
        spreads[t] += back @ (spreads[t + 1] - predicted) @ np.swapaxes(back, 1, 2)
    return means[..., :3] + first, spreads[..., :3, :3]


def find_density(
    t_s: Float, position: Float, covariance: Float, used: Bool, begins: Bool, states: int
) -> tuple[Float, Float]:
    """Find the maximum-likelihood density of each joint, and the factor on its covariances.

    The likelihood of a Kalman filter's innovations with the common factor at its best (concentrated: Harvey
    1989, 3.4.3), over a grid of ratios of density to noise; axes alike, with a third of the trace as
    variance.

    Returns:
        [M] density as `smooth_positions` takes it, and [M] the factor.
    """
    times, columns, _ = position.shape
    variance = np.where(used, np.trace(covariance, axis1=-2, axis2=-1) / 3, 1.0)
    typical = np.array([np.median(own[there]) for own, there in zip(variance.T, used.T, strict=True)])
    step_s = float(np.median(np.diff(t_s)))
    # A smoother of n states has its corner where w^2n = density^2 / (variance x step) (Wiener).
    grid = (typical / step_s ** (2 * states - 1))[:, None] * _CORNERS ** (2 * states)
    density2 = grid.ravel()
    repeat = len(_CORNERS)
    seen = np.repeat(np.where(used[..., None], position - _first(position, used), 0.0), repeat, axis=1)
    noise = np.repeat(variance, repeat, axis=1)
    mean = np.zeros((columns * repeat, states, 3))
    spread = np.zeros((columns * repeat, states, states))
    squared, logarithm, count = (np.zeros(columns * repeat) for _ in range(3))
    age = np.zeros(columns, dtype=np.int64)
    for t in range(times):
        move, drive = _transition(t_s, t, np.repeat(begins[t], repeat), density2, states, axes=1)
        mean = move @ mean
        spread = move @ spread @ np.swapaxes(move, 1, 2) + drive
        expected = spread[:, 0, 0] + noise[t]
        innovation = seen[t] - mean[:, 0]
        there = np.repeat(used[t], repeat)
        gain = there[:, None] * spread[:, :, 0] / expected[:, None]
        mean = mean + gain[..., None] * innovation[:, None]
        left = np.eye(states) - np.concatenate(
            [gain[..., None], np.zeros((len(gain), states, states - 1))], axis=2
        )
        spread = left @ spread @ np.swapaxes(left, 1, 2) + noise[t][:, None, None] * (
            gain[:, :, None] * gain[:, None, :]
        )
        age = np.where(begins[t], 0, age + 1)
        counted = np.repeat(used[t] & (age >= states), repeat)  # before that the prior decides
        squared += np.where(counted, (innovation**2).sum(axis=1) / expected, 0.0)
        logarithm += np.where(counted, 3 * np.log(expected), 0.0)
        count += 3 * counted
    factor = squared / np.maximum(count, 1)
    cost = (count * np.log(np.maximum(factor, 1e-300)) + logarithm).reshape(columns, repeat)
    best = cost.argmin(axis=1)
    chosen = factor.reshape(columns, repeat)[np.arange(columns), best]
    chosen = np.where(count.reshape(columns, repeat)[:, 0] > 0, chosen, 1.0)
    density = np.sqrt(chosen * grid[np.arange(columns), best])
    return density, chosen


def _transition(
    t_s: Float, t: int, begins: Bool, density2: Float, states: int, axes: int = 3
) -> tuple[Float, Float]:
    """Compute the transition of the state [M] to time t and the added covariance; restart at new runs."""
    elapsed = float(t_s[t] - t_s[t - 1]) if t else 0.0
    move, drive = np.eye(states), np.empty((states, states))
    for i in range(states):
        for j in range(i + 1, states):
            move[i, j] = elapsed ** (j - i) / factorial(j - i)
        for j in range(states):
            a, b = states - 1 - i, states - 1 - j
            drive[i, j] = elapsed ** (a + b + 1) / (factorial(a) * factorial(b) * (a + b + 1))
    one = np.eye(axes)
    fresh = begins[:, None, None] | (t == 0)
    moves = np.where(fresh, 0.0, np.kron(move, one))
    drives = np.where(
        fresh,
        np.kron(np.diag(np.square(UNKNOWN[:states])), one),
        density2[:, None, None] * np.kron(drive, one),
    )
    return moves, drives


def _first(position: Float, used: Bool) -> Float:
    """Return each joint's first used sample [M, 3], to work near the origin and keep digits."""
    first: Float = np.take_along_axis(position, used.argmax(axis=0)[None, :, None], axis=0)[0]
    return np.nan_to_num(first)
