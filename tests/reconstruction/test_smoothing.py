"""Filters against their closed forms, and the smoother against least squares over a whole run."""

from __future__ import annotations

from math import factorial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.reconstruction.smoothing import (
    STATES,
    UNKNOWN,
    Butterworth,
    RauchTungStriebel,
    find_density,
    smooth_positions,
    smoother,
)
from pipelines.session.errors import DataError

Int64 = NDArray[np.int64]

RATE = 60.0


def stamps(count: int) -> Int64:
    return 1_700_000_000_000_000_000 + np.round(np.arange(count) * 1e9 / RATE).astype(np.int64)


def one_joint(values: Float) -> tuple[Float, Float]:
    """Build a skeleton of one joint from values [T, 3], with covariances of 1 cm^2."""
    position = values[:, None, None, :]
    return position, np.tile(1e-4 * np.eye(3), (*position.shape[:3], 1, 1))


# --- butterworth ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [2, 4, 6, 8])
def test_the_gain_is_that_of_two_passes_and_nothing_lags(order: int) -> None:
    """Filter sines at 2, 6 (the cutoff: -3 dB of both passes together) and 12 Hz, one on each axis."""
    cutoff_hz, count = 6.0, 600
    frequency = np.array([2.0, 6.0, 12.0])
    t_s = np.arange(count) / RATE
    wave = np.sin(2 * np.pi * frequency * t_s[:, None] + 0.3)
    wave[:, 1] += 1000  # metres from the origin: no digits may be lost
    smoothed = Butterworth(cutoff_hz, order).apply(stamps(count), *one_joint(wave))
    # Bilinear transform: frequencies go as their tangents; the square of a pass of half the order.
    ratio = np.tan(np.pi * frequency / RATE) / np.tan(np.pi * cutoff_hz / RATE)
    gain = 1 / (1 + (np.sqrt(2) - 1) * ratio**order)
    assert gain[1] == pytest.approx(1 / np.sqrt(2))
    expected = gain * np.sin(2 * np.pi * frequency * t_s[:, None] + 0.3)
    expected[:, 1] += 1000
    # Far from the ends: what the ends start dies by e^-1 in 1 / (2 pi 6 Hz sin(pi/8)) = 70 ms or less.
    middle = slice(180, 420)
    np.testing.assert_allclose(smoothed.position[middle, 0, 0], expected[middle], atol=1e-9)
    assert smoothed.report["cutoff_hz"] == cutoff_hz
    assert smoothed.report["cutoff_of_a_pass_hz"] > cutoff_hz


def test_runs_on_both_sides_of_a_gap_know_nothing_of_each_other() -> None:
    rng = np.random.default_rng(0)
    values = np.cumsum(rng.normal(0, 0.01, (200, 3)), axis=0)
    values[100:] += 50.0
    values[90:100] = np.nan
    t_ns = stamps(200)
    whole = Butterworth().apply(t_ns, *one_joint(values)).position
    for part in (slice(0, 90), slice(100, 200)):
        alone = Butterworth().apply(t_ns[part], *one_joint(values[part])).position
        np.testing.assert_allclose(whole[part], alone, atol=1e-12)
    assert np.isnan(whole[90:100]).all()
    # A pause of the recorder is a gap, too.
    t_ns[150:] += 10**9
    late = Butterworth().apply(t_ns, *one_joint(values)).position
    assert not np.allclose(late[145:155], whole[145:155])


def test_what_is_too_short_is_left_as_it_is_and_counted() -> None:
    values = np.random.default_rng(1).normal(size=(60, 3))
    values[8] = np.nan
    position, covariance = one_joint(values)
    smoothed = Butterworth().apply(stamps(60), position, covariance)
    np.testing.assert_array_equal(smoothed.position[:8], position[:8])
    assert smoothed.report["joint_frames_in_runs_too_short"] == 8
    assert smoothed.covariance is covariance


def test_a_filter_needs_an_even_rate_and_a_cutoff_below_half_of_it() -> None:
    position, covariance = one_joint(np.zeros((100, 3)))
    with pytest.raises(DataError, match=r"cutoff_hz=30\b.*\(30 Hz\)"):
        Butterworth(cutoff_hz=30).apply(stamps(100), position, covariance)
    uneven = stamps(100) + np.tile([0, 8_000_000], 50)
    with pytest.raises(DataError, match="uneven"):
        Butterworth().apply(uneven, position, covariance)


# --- Rauch, Tung and Striebel --------------------------------------------------------------------------


def least_squares(
    t_s: Float, position: Float, covariance: Float, density: float, n: int
) -> tuple[Float, Float]:
    """Solve for every state of a run together: the prior of the first, the motion between, measurements.

    Returns positions [T, 3] and their covariances [T, 3, 3].
    """
    count, size = len(t_s), 3 * n
    rows, right = [], []

    def add(block: dict[int, Any], value: Float, spread: Any) -> None:
        white = np.linalg.inv(np.linalg.cholesky(spread))
        row = np.zeros((len(value), count * size))
        for k, part in block.items():
            row[:, k * size : (k + 1) * size] = part
        rows.append(white @ row)
        right.append(white @ value)

    start = np.concatenate([position[0], np.zeros(size - 3)])
    add({0: np.eye(size)}, start, np.kron(np.diag(np.square(UNKNOWN[:n])), np.eye(3)))
    for k in range(count - 1):
        dt = t_s[k + 1] - t_s[k]
        move, drive = np.eye(n), np.zeros((n, n))
        for i in range(n):
            for j in range(i + 1, n):
                move[i, j] = dt ** (j - i) / factorial(j - i)
            for j in range(n):
                # The integral of t^a/a! t^b/b! over the step: white noise integrated a + 1 and b + 1 times.
                a, b = n - 1 - i, n - 1 - j
                drive[i, j] = density**2 * dt ** (a + b + 1) / (factorial(a) * factorial(b) * (a + b + 1))
        add(
            {k: -np.kron(move, np.eye(3)), k + 1: np.eye(size)},
            np.zeros(size),
            np.kron(drive, np.eye(3)),
        )
    for k in range(count):
        add({k: np.eye(3, size)}, position[k], covariance[k])
    matrix = np.concatenate(rows)
    orthogonal, upper = np.linalg.qr(matrix)
    state = np.linalg.solve(upper, orthogonal.T @ np.concatenate(right)).reshape(count, size)
    inverse = np.linalg.inv(upper)
    spread = (inverse @ inverse.T).reshape(count, size, count, size)
    return state[:, :3], np.stack([spread[k, :3, k, :3] for k in range(count)])


@pytest.mark.parametrize("model", STATES)
def test_the_smoother_is_least_squares_over_everything_at_once(model: str) -> None:
    """Use two joints with uneven steps and full covariances; the second has two runs and a gap."""
    n, count = STATES[model], 24
    rng = np.random.default_rng(6)
    t_s = np.cumsum(rng.uniform(0.02, 0.05, count))
    position = np.cumsum(rng.normal(0, 0.02, (count, 2, 3)), axis=0) + np.array([300.0, -200.0, 1.0])
    root = rng.normal(0, 0.02, (count, 2, 3, 3))
    covariance = root @ np.swapaxes(root, -1, -2) + 1e-4 * np.eye(3)
    runs = [(0, 0, count), (1, 0, 9), (1, 12, count)]
    used, begins = np.zeros((count, 2), dtype=bool), np.zeros((count, 2), dtype=bool)
    for joint, first, stop in runs:
        used[first:stop, joint], begins[first, joint] = True, True
    position[9:12, 1] = np.nan
    density = np.array([30.0, 80.0])
    found, spread = smooth_positions(t_s, position, covariance, used, begins, density, n)
    for joint, first, stop in runs:
        part = slice(first, stop)
        expected, expected_spread = least_squares(
            t_s[part], position[part, joint], covariance[part, joint], density[joint], n
        )
        # The state where a run begins is known to 100 m or worse beside 1 cm: 1e-16 x (1e4 / 1e-2)^2 = 1e-4
        # of a standard deviation is lost at worst. The second run begins from the joint's first sample.
        sigma = np.sqrt(np.trace(expected_spread, axis1=1, axis2=2).min() / 3)
        np.testing.assert_allclose(found[part, joint], expected, atol=2e-3 * sigma)
        np.testing.assert_allclose(spread[part, joint], expected_spread, atol=4e-3 * sigma**2)


@pytest.mark.parametrize("model", STATES)
def test_the_density_is_found_where_the_motion_has_it(model: str) -> None:
    """Draw motion from the model itself; the grid's steps are 26 % in frequency, half a step either way.

    Covariances are stated twice as large as they are: the share comes out as a half. From 600 samples on
    3 axes a variance is known to sqrt(2/1800) = 3.3 %, and the grid's step moves it by some per cent more.
    """
    n, count, sigma_m = STATES[model], 600, 0.01
    rng = np.random.default_rng(7)
    density = 20.0 if model == "acceleration" else 200.0
    step_s = 1 / RATE
    state = np.zeros((n, 3))
    path = []
    fine = 20
    for _ in range(count):
        path.append(state[0].copy())
        for _ in range(fine):  # small steps of the chain of integrals
            state[:-1] += state[1:] * step_s / fine
            state[-1] += rng.normal(0, density * np.sqrt(step_s / fine), 3)
    position: Float = np.array(path)[:, None] + rng.normal(0, sigma_m, (count, 1, 3))
    covariance: Float = np.tile(2 * sigma_m**2 * np.eye(3), (count, 1, 1, 1))
    used = np.ones((count, 1), dtype=bool)
    begins = used & (np.arange(count) == 0)[:, None]
    t_s = np.arange(count, dtype=np.float64) * step_s
    found, share = find_density(t_s, position, covariance, used, begins, n)
    assert abs(np.log(found[0] / density)) < n * np.log(1.26)
    assert share[0] == pytest.approx(0.5, rel=0.2)


def test_errors_that_last_are_not_smoothed_away() -> None:
    """Add 1 cm of white noise and a constant error of 10 cm: the covariance keeps the 10 cm."""
    count = 400
    t_s = np.arange(count) / RATE
    truth = np.stack([np.sin(2 * t_s), np.cos(2 * t_s), 0.1 * t_s], axis=-1)
    rng = np.random.default_rng(8)
    values = truth + rng.normal(0, 0.01, truth.shape) + [0.1, -0.1, 0.1]
    position, covariance = one_joint(values)
    covariance = covariance * (1 + 100)  # both errors
    smoothed = RauchTungStriebel().apply(stamps(count), position, covariance)
    assert smoothed.report["new_share_of_variance"] == pytest.approx(1 / 101, rel=0.3)
    middle = slice(50, 350)
    kept = np.trace(smoothed.covariance[middle, 0, 0], axis1=1, axis2=2) / 3
    np.testing.assert_allclose(kept, 1e-2, rtol=0.02)
    left = (smoothed.position[:, 0, 0] - truth - [0.1, -0.1, 0.1])[middle]
    assert np.sqrt(np.mean(left**2)) < 0.005  # of 1 cm
    assert 0 < smoothed.report["cutoff_hz"] < RATE / 2


def test_a_stated_density_takes_covariances_at_their_word() -> None:
    position, covariance = one_joint(np.random.default_rng(9).normal(0, 0.01, (20, 3)))
    smoothed = RauchTungStriebel(density=5.0).apply(stamps(20), position, covariance)
    t_s = (stamps(20) - stamps(1)) / 1e9
    expected, spread = least_squares(t_s, position[:, 0, 0], covariance[:, 0, 0], 5.0, 3)
    np.testing.assert_allclose(smoothed.position[:, 0, 0], expected, atol=1e-5)
    np.testing.assert_allclose(smoothed.covariance[:, 0, 0], spread, atol=1e-7)


# --- what users write ----------------------------------------------------------------------------------


def test_texts_become_smoothers() -> None:
    assert smoother(None) is None
    assert smoother("butterworth") == Butterworth(6.0, 4)
    assert smoother(" butterworth: cutoff_hz=8, order=2") == Butterworth(8.0, 2)
    assert smoother("rts") == RauchTungStriebel()
    assert smoother("rts:model=jerk,density=100") == RauchTungStriebel("jerk", 100.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("kalman", "does not read"),
        ("kalman:q=1", "no such filter: kalman"),
        ("", "does not read"),
        ("butterworth:order=3", "order is 3"),
        ("butterworth:cutoff_hz=0", "cutoff_hz is 0"),
        ("butterworth:cutoff_hz=nan", "cutoff_hz is nan"),
        ("butterworth:cutoff_hz=six", "cutoff_hz is 'six'"),
        ("butterworth:corner=6", "has no corner; it has cutoff_hz, order"),
        ("butterworth:order=4 + rts:model=jerk", "names 2 filters"),
        ("rts:model=snap", "model is 'snap' instead of acceleration or jerk"),
        ("rts:density=inf", "density is inf"),
    ],
)
def test_nonsense_is_refused_in_a_line(text: str, said: str) -> None:
    with pytest.raises(DataError, match=said) as refused:
        smoother(text)
    assert "\n" not in str(refused.value)
