"""Gait of feet that swing as cosines about a pelvis that moves evenly: events at their extremes."""

import numpy as np
import pytest

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.gait import GaitEvents, _low_pass, gait_events, summary

JOINTS = ("left_hip", "right_hip", "left_ankle", "right_ankle")
RATE_HZ, SPEED_MPS, SWING_M, STRIDE_S = 30.0, 1.3, 0.35, 1.1


def walk(seconds: float = 8.0, speed_mps: float = SPEED_MPS, swing_m: float = SWING_M) -> tuple[Int64, Float]:
    """Walk to the north-east; the left foot is furthest ahead at 0, 1.1, 2.2 s, the right one between."""
    t_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    ahead = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    left = np.array([-1.0, 1.0, 0.0]) / np.sqrt(2)
    swing = swing_m * np.cos(2 * np.pi * t_s / STRIDE_S)
    along = [speed_mps * t_s + offset for offset in (0 * t_s, 0 * t_s, swing, -swing)]
    sides = (0.1, -0.1, 0.1, -0.1)
    heights = (0.9, 0.9, 0.1, 0.1)
    points = [
        path[:, None] * ahead + side * left + [0, 0, height]
        for path, side, height in zip(along, sides, heights, strict=True)
    ]
    return 1_700_000_000_000_000_000 + np.rint(t_s * 1e9).astype(np.int64), np.stack(points, axis=1)


def found_in(t_ns: Int64, position: Float) -> GaitEvents:
    events = gait_events(JOINTS, t_ns, position)
    assert events is not None
    return events


def test_strikes_lie_at_the_extremes_of_the_feet() -> None:
    t_ns, position = walk()
    events = found_in(t_ns, position)
    for side in range(2):
        strikes = (t_ns[events.row[events.is_strike & (events.side == side)]] - t_ns[0]) / 1e9
        phase = strikes / STRIDE_S - side / 2
        # A frame lasts 33 ms; the extreme is at most half of one away.
        np.testing.assert_allclose(phase, np.rint(phase), atol=0.51 / RATE_HZ / STRIDE_S)
        # Without heels and toes, a foot leaves the ground half a stride after its strike.
        leaves = (t_ns[events.row[~events.is_strike & (events.side == side)]] - t_ns[0]) / 1e9
        phase = leaves / STRIDE_S - side / 2 + 0.5
        np.testing.assert_allclose(phase, np.rint(phase), atol=0.51 / RATE_HZ / STRIDE_S)


def test_cadence_length_and_speed() -> None:
    t_ns, position = walk()
    figures = summary(found_in(t_ns, position), t_ns, JOINTS)
    # Times of first and last strike are rounded to frames: a frame in all over a dozen steps.
    steps = figures["steps"]
    assert isinstance(steps, int)
    assert steps >= 11
    tolerance = 1 / RATE_HZ / (steps * STRIDE_S / 2)
    assert figures["cadence_per_min"] == pytest.approx(120 / STRIDE_S, rel=tolerance)
    length, speed = figures["step_m"], figures["speed_mps"]
    assert isinstance(length, dict)
    assert isinstance(speed, dict)
    # At most half a frame off the extreme: 1 - cos(2 pi / 66) = 0.5 % of the length.
    assert length["mean"] == pytest.approx(2 * SWING_M, rel=0.005)
    assert speed["mean"] == pytest.approx(SPEED_MPS, rel=0.01)
    assert figures["feet"] == "ankles"


@pytest.mark.parametrize(("speed_mps", "swing_m"), [(0.0, SWING_M), (SPEED_MPS, 0.05)])
def test_who_stands_or_slides_does_not_walk(speed_mps: float, swing_m: float) -> None:
    assert gait_events(JOINTS, *walk(speed_mps=speed_mps, swing_m=swing_m)) is None


def test_no_step_reaches_over_a_gap() -> None:
    t_ns, position = walk(12.0)
    position[170:190, 2] = np.nan
    events = found_in(t_ns, position)
    across = (events.row > 190) & (events.step_s > 0)
    assert np.isfinite(events.step_s).any()
    first = events.row[events.is_strike & (events.row > 190)].min()
    assert not (across & (events.row == first)).any()
    assert not ((events.row >= 170) & (events.row < 190)).any()


def test_who_is_never_seen_has_no_gait() -> None:
    t_ns, position = walk()
    assert gait_events(JOINTS, t_ns, np.full_like(position, np.nan)) is None


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 5])
def test_a_run_of_few_frames_is_filtered_far_from_the_origin(frames: int) -> None:
    values = np.full((frames, 3), 500.0)
    np.testing.assert_allclose(_low_pass(values, 0.5, 2.0), values, atol=1e-12)


@pytest.mark.parametrize("cutoff_hz", [6.0, 2.0])
def test_the_filter_is_scipys_in_both_directions(cutoff_hz: float) -> None:
    from scipy.signal import butter, sosfiltfilt

    values = np.random.default_rng(0).normal(0.0, 1.0, (300, 2))
    expected = sosfiltfilt(butter(2, cutoff_hz, fs=RATE_HZ, output="sos"), values, axis=0)
    # What made-up samples before the first one do has decayed to e^-30 within 100 steps.
    found = _low_pass(values, cutoff_hz, RATE_HZ)
    np.testing.assert_allclose(found[100:-100], expected[100:-100], atol=1e-9)
