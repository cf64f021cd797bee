"""Rotations against scipy, transforms by their algebra, interpolation by closed-form motion."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.poses import (
    compose,
    conjugate,
    gaps,
    interpolate_points,
    interpolate_poses,
    invert,
    matrix_from_quaternion,
    multiply,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotate,
    rotation_vector_from_quaternion,
    transform,
    velocities,
)

EPOCH = 1_700_000_000_123_456_789
MS = 1_000_000
rotation_vectors = hnp.arrays(np.float64, (3,), elements=st.floats(-1.8, 1.8))
vectors = hnp.arrays(np.float64, (3,), elements=st.floats(-100, 100))


def random_quaternions(count: int, seed: int = 0) -> Float:
    return np.asarray(Rotation.random(count, rng=np.random.default_rng(seed)).as_quat(), dtype=np.float64)


def same_rotation(a: Float, b: Float, atol: float = 1e-12) -> None:
    signs = np.where(np.sum(a * b, axis=-1, keepdims=True) < 0, -1.0, 1.0)
    np.testing.assert_allclose(a * signs, b, rtol=0, atol=atol)


def turning(t_s: Float) -> tuple[Float, Float]:
    """Move with velocity (1, -2, 0.5) m/s and rotate at a constant 0.8 rad/s about a slanted axis."""
    axis = np.array([2.0, -1.0, 2.0]) / 3
    start = np.array([0.1, 0.2, -0.3])
    quaternion = multiply(
        quaternion_from_rotation_vector(start), quaternion_from_rotation_vector(0.8 * t_s[:, None] * axis)
    )
    return np.array([5.0, 6.0, 7.0]) + t_s[:, None] * [1.0, -2.0, 0.5], quaternion


def log_at(t_ns: Int64) -> tuple[Float, Float]:
    return turning((t_ns - EPOCH) / 1e9)


# --- rotations -----------------------------------------------------------------------------------------


def test_matrices_are_scipy_s() -> None:
    quaternions = random_quaternions(50)
    expected = Rotation.from_quat(quaternions).as_matrix()
    np.testing.assert_allclose(matrix_from_quaternion(quaternions), expected, rtol=0, atol=1e-14)
    same_rotation(quaternion_from_matrix(expected), quaternions)


@given(rotation_vectors)
def test_rotation_vectors_are_scipy_s_and_come_back(vector: Float) -> None:
    quaternion = quaternion_from_rotation_vector(vector)
    same_rotation(quaternion, np.asarray(Rotation.from_rotvec(vector).as_quat()))
    # |v| <= 1.8 sqrt(3) < pi, so the shortest rotation is the vector itself.
    np.testing.assert_allclose(rotation_vector_from_quaternion(-quaternion), vector, rtol=0, atol=1e-12)


@given(rotation_vectors, rotation_vectors, vectors)
def test_multiplying_applies_the_right_one_first(a: Float, b: Float, vector: Float) -> None:
    qa, qb = quaternion_from_rotation_vector(a), quaternion_from_rotation_vector(b)
    np.testing.assert_allclose(
        rotate(multiply(qa, qb), vector),
        matrix_from_quaternion(qa) @ matrix_from_quaternion(qb) @ vector,
        rtol=0,
        atol=1e-12 * 200,
    )


# --- chains --------------------------------------------------------------------------------------------


@given(vectors, rotation_vectors, vectors, rotation_vectors, vectors)
def test_chains_of_transforms(p: Float, r: Float, q: Float, s: Float, point: Float) -> None:
    world_from_a = (p, quaternion_from_rotation_vector(r))
    a_from_b = (q, quaternion_from_rotation_vector(s))
    world_from_b = compose(world_from_a, a_from_b)
    np.testing.assert_allclose(
        transform(world_from_b, point),
        transform(world_from_a, transform(a_from_b, point)),
        rtol=0,
        atol=1e-11,
    )
    np.testing.assert_allclose(
        transform(invert(*world_from_b), transform(world_from_b, point)), point, rtol=0, atol=1e-11
    )


# --- time ----------------------------------------------------------------------------------------------


def test_constant_motion_is_interpolated_exactly() -> None:
    t_ns = EPOCH + np.array([0, 90, 200, 310, 400], dtype=np.int64) * MS
    position, quaternion = log_at(t_ns)
    quaternion[[1, 4]] *= -1  # a log may flip signs at will
    at_ns = EPOCH + np.arange(0, 401, dtype=np.int64)[::-1] * MS
    got_position, got_quaternion = interpolate_poses(
        t_ns, position, quaternion, at_ns, max_gap_ns=200 * MS, max_extrapolation_ns=0
    )
    position_true, quaternion_true = log_at(at_ns)
    np.testing.assert_allclose(got_position, position_true, rtol=0, atol=1e-13)
    # The same hemisphere all along, not only the same rotations.
    np.testing.assert_allclose(got_quaternion, quaternion_true, rtol=0, atol=1e-14)


def test_a_nanosecond_is_not_lost_on_the_epoch() -> None:
    t_ns = np.array([EPOCH, EPOCH + 8], dtype=np.int64)
    values = np.array([[0.0], [8.0]])
    at_ns = EPOCH + np.arange(9, dtype=np.int64)
    got = interpolate_points(t_ns, values, at_ns, max_gap_ns=8)
    np.testing.assert_array_equal(got[:, 0], np.arange(9))


def test_no_pose_inside_a_gap() -> None:
    t_ns = EPOCH + np.array([0, 100, 400, 500], dtype=np.int64) * MS
    at_ns = EPOCH + np.array([50, 100, 101, 399, 400, 450], dtype=np.int64) * MS
    got = interpolate_poses(t_ns, *log_at(t_ns), at_ns, max_gap_ns=100 * MS, max_extrapolation_ns=0)
    assert [np.isfinite(part).all(axis=1).tolist() for part in got] == [
        [True, True, False, False, True, True]
    ] * 2
    assert gaps(t_ns, 100 * MS) == [(EPOCH + 100 * MS, EPOCH + 400 * MS)]
    assert gaps(t_ns[:1], 0) == []


def test_outside_the_log_the_nearest_pose_is_held_within_the_tolerance() -> None:
    t_ns = EPOCH + np.array([0, 100], dtype=np.int64) * MS
    position, quaternion = log_at(t_ns)
    at_ns = EPOCH + np.array([-21, -20, 120, 121], dtype=np.int64) * MS
    got = interpolate_poses(
        t_ns, position, quaternion, at_ns, max_gap_ns=100 * MS, max_extrapolation_ns=20 * MS
    )
    np.testing.assert_array_equal(got[0][1:3], position)
    np.testing.assert_array_equal(got[1][1:3], quaternion)
    assert np.isnan(got[0][[0, 3]]).all()
    assert np.isnan(got[1][[0, 3]]).all()


@pytest.mark.parametrize("stamps", [[0, 5, 5], [0, 5, 4]])
def test_stamps_that_do_not_increase_are_refused(stamps: list[int]) -> None:
    t_ns = np.array(stamps, dtype=np.int64)
    with pytest.raises(ValueError, match="stamps"):
        interpolate_points(t_ns, np.zeros((3, 1)), t_ns, max_gap_ns=10)


def test_points_are_never_made_from_a_missing_neighbour() -> None:
    t_ns = np.array([0, 10, 20, 30], dtype=np.int64)
    values = np.zeros((4, 2, 3))
    values[:, 0, 0] = [0, 1, np.nan, 3]
    values[:, 1, 0] = [0, 1, 2, 3]
    at_ns = np.array([-1, 5, 10, 15, 20, 25, 30, 31], dtype=np.int64)
    got = interpolate_points(t_ns, values, at_ns, max_gap_ns=10)
    n = np.nan
    np.testing.assert_array_equal(got[:, 0, 0], [n, 0.5, 1, n, n, n, 3, n])
    np.testing.assert_array_equal(got[:, 1, 0], [n, 0.5, 1, 1.5, 2, 2.5, 3, n])


@given(data=st.data())
def test_interpolated_rotations_turn_steadily_between_their_neighbours(data: st.DataObject) -> None:
    ends = np.array([quaternion_from_rotation_vector(data.draw(rotation_vectors)) for _ in range(2)])
    fraction = data.draw(st.integers(0, 1000))
    t_ns = np.array([0, 1000], dtype=np.int64)
    at_ns = np.array([fraction], dtype=np.int64)
    _, got = interpolate_poses(t_ns, np.zeros((2, 3)), ends, at_ns, max_gap_ns=1000, max_extrapolation_ns=0)
    np.testing.assert_allclose(np.linalg.norm(got), 1, rtol=0, atol=1e-14)

    def angle(a: Float, b: Float) -> float:
        return float(np.linalg.norm(rotation_vector_from_quaternion(multiply(conjugate(a), b))))

    assert angle(ends[0], got[0]) == pytest.approx(fraction / 1000 * angle(*ends), abs=1e-12)


def test_velocities_are_those_to_the_samples_before_and_after() -> None:
    """A parabola's secants, by hand; a break, a missing sample and one out of order have none."""
    t_s = np.array([[0.0], [0.1], [0.3], [0.4], [0.35]])
    values = t_s[..., None] ** 2 * [1.0, -2.0]
    before, after = velocities(t_s, values, np.array([[True], [True], [False], [True]]))
    secants = np.array([0.1, 0.4])  # (b^2 - a^2) / (b - a) = a + b
    np.testing.assert_allclose(after[:2, 0, 0], secants)
    np.testing.assert_allclose(before[1:3, 0, 1], -2 * secants)
    assert np.isnan(before[[0, 3, 4]]).all()
    assert np.isnan(after[2:]).all()
    values[1] = np.nan
    before, after = velocities(t_s, values, np.ones((4, 1), bool))
    assert np.isnan(after[:2]).all()
    assert np.isnan(before[1:3]).all()
    lone, _ = velocities(np.zeros(1), np.ones((1, 2)), np.empty(0, bool))
    assert np.isnan(lone).all()
