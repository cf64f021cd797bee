"""Offset and drift between two clocks, from events that both stamped."""

import numpy as np
import pytest

from pipelines.geometry.arrays import ClockFit
from pipelines.geometry.clocks import fit_clock

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
