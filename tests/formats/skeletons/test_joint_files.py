"""Resampling of times to frames: values that are kept, interpolated or refused."""

import numpy as np
import pytest

from pipelines.formats.skeletons.joint_files import at_even_times
from pipelines.session.records import JointMotion
from tests.formats.exported import START_NS, Listener


def moving(t_ns: np.ndarray) -> JointMotion:
    """Make a point that moves at 1 m/s along x."""
    position = np.zeros((len(t_ns), 1, 1, 3))
    position[:, 0, 0, 0] = (t_ns - START_NS) / 1e9
    return JointMotion(t_ns, ("nose",), position)


def test_stamps_of_whole_milliseconds_are_kept_with_a_note() -> None:
    exact = np.arange(301) * 1e9 / 30
    t_ns = START_NS + np.rint(exact / 1e6).astype(np.int64) * 1_000_000
    listener = Listener()
    even = at_even_times("x", moving(t_ns), listener)
    assert even.rate_hz == pytest.approx(30, rel=1e-9)
    np.testing.assert_array_equal(even.motion.position, moving(t_ns).position)
    assert np.abs(even.motion.t_ns - START_NS - exact).max() <= 1
    assert len(listener.notes) == 1
    assert "0.333 ms" in listener.notes[0]


def test_uneven_stamps_are_interpolated_never_beside_a_missing_one() -> None:
    t_ns = START_NS + np.array([0, 30, 70, 100, 130, 170, 200]) * 1_000_000
    motion = moving(t_ns)
    motion.position[3] = np.nan
    listener = Listener()
    even = at_even_times("x", motion, listener)
    assert even.rate_hz == pytest.approx(30)
    x = even.motion.position[:, 0, 0, 0]
    missing = [3]  # at 100 ms exactly; `beside` finds the frames between two samples, one of them missing
    expected = np.arange(7) / 30
    known = np.isfinite(x)
    np.testing.assert_allclose(x[known], expected[known], atol=1e-9)
    assert np.flatnonzero(~known).tolist() == sorted({*missing, *(k for k in range(7) if beside(t_ns, k))})
    assert "30 Hz" in listener.notes[0]


def beside(t_ns: np.ndarray, frame: int) -> bool:
    """Return True if the missing sample is one of the two around a frame."""
    at = (t_ns[0] + t_ns[-1] * 0) + round(frame * 200_000_000 / 6)
    after = int(np.searchsorted(t_ns, at))
    return bool(t_ns[after] != at) and 3 in (after - 1, after)
