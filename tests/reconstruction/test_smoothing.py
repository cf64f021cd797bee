"""The filter against its closed form."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.reconstruction.finishing import Butterworth, smoother
from pipelines.reconstruction.results import camera_poses_table
from pipelines.session.description import Interpolation
from pipelines.session.errors import DataError
from pipelines.session.records import Trajectory
from tests.reconstruction.test_trials import camera

Int64 = NDArray[np.int64]

RATE = 60.0


def stamps(count: int) -> Int64:
    return 1_700_000_000_000_000_000 + np.round(np.arange(count) * 1e9 / RATE).astype(np.int64)


def one_joint(values: Float) -> Float:
    """Build a skeleton of one joint from values [T, 3]."""
    return values[:, None, None, :]


@pytest.mark.parametrize("order", [2, 4, 6, 8])
def test_the_gain_is_that_of_two_passes_and_nothing_lags(order: int) -> None:
    """Filter sines at 2, 6 (the cutoff: -3 dB of both passes together) and 12 Hz, one on each axis."""
    cutoff_hz, count = 6.0, 600
    frequency = np.array([2.0, 6.0, 12.0])
    t_s = np.arange(count) / RATE
    wave = np.sin(2 * np.pi * frequency * t_s[:, None] + 0.3)
    wave[:, 1] += 1000  # metres from the origin: no digits may be lost
    smoothed, report = Butterworth(cutoff_hz, order).apply(stamps(count), one_joint(wave))
    # Bilinear transform: frequencies go as their tangents; the square of a pass of half the order.
    ratio = np.tan(np.pi * frequency / RATE) / np.tan(np.pi * cutoff_hz / RATE)
    gain = 1 / (1 + (np.sqrt(2) - 1) * ratio**order)
    assert gain[1] == pytest.approx(1 / np.sqrt(2))
    expected = gain * np.sin(2 * np.pi * frequency * t_s[:, None] + 0.3)
    expected[:, 1] += 1000
    # Far from the ends: what the ends start dies by e^-1 in 1 / (2 pi 6 Hz sin(pi/8)) = 70 ms or less.
    middle = slice(180, 420)
    np.testing.assert_allclose(smoothed[middle, 0, 0], expected[middle], atol=1e-9)
    assert report["cutoff_hz"] == cutoff_hz
    assert report["cutoff_of_a_pass_hz"] > cutoff_hz


def test_runs_on_both_sides_of_a_gap_know_nothing_of_each_other() -> None:
    rng = np.random.default_rng(0)
    values = np.cumsum(rng.normal(0, 0.01, (200, 3)), axis=0)
    values[100:] += 50.0
    values[90:100] = np.nan
    t_ns = stamps(200)
    whole = Butterworth().apply(t_ns, one_joint(values))[0]
    for part in (slice(0, 90), slice(100, 200)):
        alone = Butterworth().apply(t_ns[part], one_joint(values[part]))[0]
        np.testing.assert_allclose(whole[part], alone, atol=1e-12)
    assert np.isnan(whole[90:100]).all()
    # A pause of the recorder is a gap, too.
    t_ns[150:] += 10**9
    late = Butterworth().apply(t_ns, one_joint(values))[0]
    assert not np.allclose(late[145:155], whole[145:155])


def test_what_is_too_short_is_left_as_it_is_and_counted() -> None:
    values = np.random.default_rng(1).normal(size=(60, 3))
    values[8] = np.nan
    position = one_joint(values)
    smoothed, report = Butterworth().apply(stamps(60), position)
    np.testing.assert_array_equal(smoothed[:8], position[:8])
    assert report["joint_frames_in_runs_too_short"] == 8


def test_a_filter_needs_an_even_rate_and_a_cutoff_below_half_of_it() -> None:
    position = one_joint(np.zeros((100, 3)))
    with pytest.raises(DataError, match=r"cutoff_hz=30\b.*\(30 Hz\)"):
        Butterworth(cutoff_hz=30).apply(stamps(100), position)
    uneven = stamps(100) + np.tile([0, 8_000_000], 50)
    with pytest.raises(DataError, match="uneven"):
        Butterworth().apply(uneven, position)


# --- what users write ----------------------------------------------------------------------------------
def test_texts_become_smoothers() -> None:
    assert smoother(None) is None
    assert smoother("butterworth") == Butterworth(6.0, 4)
    assert smoother(" butterworth: cutoff_hz=8, order=2") == Butterworth(8.0, 2)


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
        ("butterworth:order=4 + butterworth:order=2", "no such filter"),
        ("rts", "does not read"),
    ],
)
def test_nonsense_is_refused_in_a_line(text: str, said: str) -> None:
    with pytest.raises(DataError, match=said) as refused:
        smoother(text)
    assert "\n" not in str(refused.value)


SECOND_NS = 1_000_000_000


def test_poses_are_not_made_up_in_pauses_of_the_log() -> None:
    """Log poses at 0, 1, 2, 12 and 13 s; of the pictures every second, those in the pause have no pose."""
    logged_s = np.array([0, 1, 2, 12, 13])
    position = np.stack([logged_s, 0 * logged_s, 0 * logged_s], axis=1).astype(np.float64)
    log = Trajectory(logged_s * SECOND_NS, position, np.tile([0.0, 0, 0, 1], (5, 1)))
    pictures_s = np.arange(16)
    drone = replace(
        camera("drone"),
        trajectory=log,
        frame_t_ns=pictures_s * SECOND_NS,
        frame_number=pictures_s,
        follows=np.ones(16, dtype=np.bool_),
    )
    table = camera_poses_table([drone], Interpolation(max_gap_s=1.5, max_extrapolation_s=0.0))
    np.testing.assert_array_equal(table["t_ns"], np.array([0, 1, 2, 12, 13]) * SECOND_NS)
    np.testing.assert_allclose(table["x"], [0, 1, 2, 12, 13])

    still = replace(
        drone, static=True, trajectory=Trajectory(log.t_ns[:1], position[:1], log.quaternion_xyzw[:1])
    )
    assert len(camera_poses_table([still], Interpolation(max_gap_s=1.5, max_extrapolation_s=0.0))) == 16
