"""Smoother of Rauch, Tung & Striebel (1965) for many joints at once, and the estimate of its one parameter.

A joint's state is its position and the first n - 1 derivatives, the n-th derivative is white noise of a
density that is the same on all axes. Joints are independent of each other and stored as columns [T, M].
The Kalman filter runs forwards, the smoother backwards. Each run starts with a very wide prior, so that
earlier samples have no effect. The result equals least squares over the run with the same weights.
"""

from __future__ import annotations

from math import factorial

import numpy as np

from pipelines.geometry.arrays import Bool, Float

STATES = {"acceleration": 3, "jerk": 4}
"""Number of derivatives in the state of each model, the position included."""

UNKNOWN = (1e2, 1e2, 1e3, 1e4)
"""Prior standard deviation of the state at the start of a run, in m, m/s, m/s^2, m/s^3 from its first sample.

A body's motion is a hundredth of it; a larger value would lose digits.
"""

_CORNERS = np.logspace(-2, 0.5, 26)  # rad per sample: the smoother's corner frequency


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
