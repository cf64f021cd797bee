"""Offset and drift between two clocks, from events that both stamped."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.arrays import ClockFit, Float, Int64
from pipelines.geometry.clocks import find_receipt_steps, find_steps, fit_clock, without_steps

START_NS = 1_700_000_000_000_000_000


def _fit(drift_ppm: float, jitter_s: float, *, seconds: int = 600, wild: int = 0) -> tuple[ClockFit, int]:
    """Fit clocks that are 2.5 s apart in the middle; return also the true other reading at the end."""
    rng = np.random.default_rng(1)
    this_ns = np.arange(0, seconds * 1_000_000_000, 200_000_000, dtype=np.int64)
    lead_s = 2.5 + (this_ns / 1e9 - seconds / 2) * drift_ppm * 1e-6
    seen = lead_s + jitter_s * rng.standard_normal(len(this_ns))
    seen[: 2 * wild : 2] += 30.0
    fit = fit_clock(this_ns, START_NS + this_ns + np.rint(seen * 1e9).astype(np.int64))
    assert fit is not None
    return fit, START_NS + int(this_ns[-1]) + round(lead_s[-1] * 1e9)


@pytest.mark.parametrize("drift_ppm", [0.0, 40.0, -80.0])
def test_drift_is_found_to_what_jitter_leaves_of_it(drift_ppm: float) -> None:
    fit, last_ns = _fit(drift_ppm, 2e-3)
    # 3000 events, sigma 2 ms over 600 s: the slope of a least squares line has sigma
    # 2e-3 / (173 * sqrt(3000)) = 0.21 ppm; medians lose a fifth at most. Five sigmas.
    assert fit.drift_ppm == pytest.approx(drift_ppm, abs=1.3)
    end_ns = int(fit.other_ns(np.array([599_800_000_000]))[0])
    assert abs(end_ns - last_ns) < 1_000_000  # 1.3 ppm of 300 s and 5 sigmas of the offset
    assert fit.residual_s == pytest.approx(2e-3, rel=0.2)


def test_no_drift_is_claimed_in_a_short_log() -> None:
    # 6 s with delays of 20 ms: a slope of 20 ms / 6 s would be 3000 ppm.
    fit, _ = _fit(0.0, 20e-3, seconds=6)
    assert fit.drift_ppm == 0.0
    assert fit.drift_sigma_ppm > 1000


def test_wild_stamps_do_not_move_it() -> None:
    fit, last_ns = _fit(40.0, 2e-3, wild=300)
    assert fit.drift_ppm == pytest.approx(40.0, abs=3)
    assert fit.rejected >= 300
    assert abs(int(fit.other_ns(np.array([599_800_000_000]))[0]) - last_ns) < 2_000_000


def test_stamps_since_the_epoch_stay_exact() -> None:
    t_ns = START_NS + np.arange(10, dtype=np.int64) * 1_000_000_007
    fit = fit_clock(t_ns, t_ns - 3_000_000_001)
    assert fit is not None
    np.testing.assert_array_equal(fit.other_ns(t_ns), t_ns - 3_000_000_001)


S = 1_000_000_000
EPOCH = 1_700_000_000 * S


def stamped(rate_hz: float, count: int, seed: int = 0) -> tuple[Int64, Int64]:
    """Make header stamps with jitter, and those of receipt 5 ms later with a scatter of 1 ms."""
    random = np.random.default_rng(seed)
    header_s = (np.arange(count) + random.uniform(-0.05, 0.05, count)) / rate_hz
    receive_s = header_s + 0.005 + random.exponential(0.001, count)
    return in_ns(header_s), in_ns(np.sort(receive_s))


def in_ns(t_s: Float) -> Int64:
    return EPOCH + np.rint(t_s * S).astype(np.int64)


@pytest.mark.parametrize("rate_hz", [10, 50, 400])
@pytest.mark.parametrize("step_s", [-1.5, -0.8, -0.1, 0.1, 0.3, 1.5])
def test_a_step_is_found_and_taken_out(rate_hz: float, step_s: float) -> None:
    header, receive = stamped(rate_hz, 12 * int(rate_hz))
    at = 6 * int(rate_hz)
    stepped = header.copy()
    stepped[at:] += round(step_s * S)
    (found,) = find_steps(stepped, receive)
    assert (found.index, found.is_clear) == (at, True)
    assert found.after_s == pytest.approx(6.0, abs=0.02)
    assert found.step_s == pytest.approx(step_s, abs=0.002)
    mended = without_steps(stepped, [found])
    assert np.abs(mended - header).max() < 0.002 * S
    assert f"steps by {found.step_s:+.3f} s" in str(found)


def test_a_clock_that_steps_away_and_back() -> None:
    header, receive = stamped(50, 600)
    stepped = header.copy()
    stepped[200:260] -= S // 4
    stepped[40] = 0  # without a header stamp
    found = find_steps(stepped, receive)
    assert [step.index for step in found] == [200, 260]
    mended = without_steps(stepped, found)
    assert mended[40] == 0
    assert np.abs(np.delete(mended - header, 40)).max() < 0.002 * S


def test_a_late_message_beside_the_step_stays_in_order() -> None:
    header, receive = stamped(50, 600)
    stepped = header.copy()
    stepped[300:] += 3 * S // 10
    receive[300] += 15_000_000
    (found,) = find_steps(stepped, receive)
    assert found.index == 300
    assert (np.diff(without_steps(stepped, [found])) > 0).all()


def test_a_step_of_the_recorder_leaves_the_header() -> None:
    header, receive = stamped(50, 600)
    receive[300:] += 3 * S // 10
    assert find_steps(header, receive) == []


def test_a_step_that_an_emptied_queue_explains_is_told_alone() -> None:
    header, receive = stamped(50, 600)
    stepped = header - 4 * S // 10
    stepped[300:] += 3 * S // 10
    (found,) = find_steps(stepped, receive)
    assert not found.is_clear
    assert "not taken out" in str(found)
    np.testing.assert_array_equal(without_steps(stepped, [found]), stepped)


def test_a_clock_set_anew_is_none() -> None:
    header, receive = stamped(50, 600)
    header[300:] += 40 * S
    assert find_steps(header, receive) == []


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    rate_hz=st.sampled_from([1.0, 5.0, 30.0, 200.0]),
    jitter=st.floats(0.0, 0.3),
    delay_s=st.floats(0.0, 0.3),
    drift=st.floats(-3e-4, 3e-4),
    offset_s=st.floats(-100.0, 100.0),
    lost=st.floats(0.0, 0.3),
    bursts=st.integers(0, 4),
)
def test_right_logs_stay_as_they_are(
    seed: int,
    rate_hz: float,
    jitter: float,
    delay_s: float,
    drift: float,
    offset_s: float,
    lost: float,
    bursts: int,
) -> None:
    random = np.random.default_rng(seed)
    count = int(20 * rate_hz)
    t_s = (np.arange(count) + random.uniform(-jitter, jitter, count)) / rate_hz
    receive_s = t_s + random.exponential(delay_s + 1e-6, count)
    for at_s, long_s in zip(random.uniform(0, 20, bursts), random.uniform(0.05, 2, bursts), strict=True):
        held = (receive_s > at_s) & (receive_s < at_s + long_s)
        receive_s[held] = at_s + long_s
    kept = random.uniform(size=count) >= lost
    order = np.argsort(receive_s[kept], kind="stable")
    header, receive = in_ns(t_s * (1 + drift) + offset_s)[kept][order], in_ns(receive_s)[kept][order]
    assert find_steps(header, receive) == []


@pytest.mark.parametrize("step_s", [-0.25, 0.1, 0.35])
def test_a_step_behind_a_slow_link_is_found_to_the_ms(step_s: float) -> None:
    """Queued messages arrive up to 0.1 s late; the header's own intervals are even."""
    sent_ns = np.arange(1200) * 10_000_000
    delay_ns = np.random.default_rng(0).exponential(20e6, 1200).astype(np.int64)
    header_ns = sent_ns + 1 + (np.arange(1200) >= 700) * round(step_s * 1e9)
    [step] = find_steps(header_ns, np.maximum.accumulate(sent_ns + delay_ns))
    assert step.index == 700
    assert abs(step.step_s - step_s) < 1e-3


@pytest.mark.parametrize("step_s", [-0.8, 0.167])
def test_a_step_of_the_receipt_alone_is_found_behind_a_slow_link(step_s: float) -> None:
    sent_ns = np.arange(1200) * 20_000_000
    delay_ns = np.random.default_rng(0).exponential(20e6, 1200).astype(np.int64)
    received_ns = np.maximum.accumulate(sent_ns + delay_ns)
    assert find_receipt_steps(sent_ns, received_ns) == []
    [(index, found_s)] = find_receipt_steps(
        sent_ns, received_ns + (np.arange(1200) >= 700) * round(step_s * 1e9)
    )
    assert abs(index - 700) <= 1
    # Medians of 250 delays of 20 ms: 1.3 ms each; four standard deviations of their difference.
    assert abs(found_s - step_s) < 7e-3
