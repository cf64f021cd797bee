"""Truth between its samples: gaps stay gaps for any spacing of the samples."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipelines.session.people import true_joints_at
from pipelines.session.records import JointMotion

MS = 1_000_000
Int64 = NDArray[np.int64]


def known_at(t_ns: Int64, at_ns: Int64) -> NDArray[np.bool_]:
    """Test at which times a joint with constant velocity is known; check that it is then on its line."""
    x = t_ns / 1e9
    truth = JointMotion(t_ns, ("nose",), np.stack([x, 2 * x, -x], axis=1)[:, None, None])
    found = true_joints_at(truth, at_ns)[:, 0, 0]
    known = ~np.isnan(found[:, 0])
    at = at_ns[known] / 1e9
    np.testing.assert_allclose(found[known], np.stack([at, 2 * at, -at], axis=1), atol=1e-9)
    return known


def taking_turns(steps_ms: tuple[float, ...], turns: int, jitter_ms: float = 0.0) -> Int64:
    at_ms = np.concatenate([[0.0], np.cumsum(np.tile(steps_ms, turns))])
    at_ms += np.random.default_rng(1).uniform(-jitter_ms, jitter_ms, len(at_ms))
    return np.round(1000 * MS + at_ms * MS).astype(np.int64)


@pytest.mark.parametrize(
    ("steps_ms", "jitter_ms"),
    [
        ((8, 32), 0),
        ((32, 8), 1),
        ((1, 39), 0.3),
        ((15, 25), 2),
        ((3, 12, 25), 1),
        ((2, 2, 36), 0),
        ((40,), 2),
    ],
)
@pytest.mark.parametrize("turns", [6, 200])
def test_samples_that_take_turns_are_bridged_and_holes_are_not(
    steps_ms: tuple[float, ...], jitter_ms: float, turns: int
) -> None:
    t_ns = taking_turns(steps_ms, turns, jitter_ms)
    between = (t_ns[:-1] + t_ns[1:]) // 2
    assert known_at(t_ns, between).all()
    # A tenth of a second is missing: nothing is known there, and everything is elsewhere.
    first = len(t_ns) // 2
    last = int(np.searchsorted(t_ns, t_ns[first] + 100 * MS))
    whole = np.delete(t_ns, np.arange(first + 1, last))
    inside = (between > t_ns[first]) & (between < t_ns[last])
    np.testing.assert_array_equal(known_at(whole, between), ~inside)


def test_a_single_sample_that_is_missing_is_a_hole() -> None:
    t_ns = taking_turns((40,), 100)
    at_ns = np.array([t_ns[40] - 3 * MS, t_ns[40], t_ns[40] + 3 * MS])
    assert known_at(t_ns, at_ns).all()
    assert not known_at(np.delete(t_ns, 40), at_ns).any()


@given(st.integers(0, 2**32), st.floats(0.0, 0.12))
def test_regular_samples_of_which_some_are_missing_are_never_bridged(seed: int, share: float) -> None:
    every = np.arange(400, dtype=np.int64) * 10 * MS
    kept = np.random.default_rng(seed).uniform(size=400) >= share
    kept[[0, -1]] = True
    at_ns = every[:-1] + 5 * MS
    np.testing.assert_array_equal(known_at(every[kept], at_ns), kept[:-1] & kept[1:])
