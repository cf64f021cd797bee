"""Alignments against known motions, the least-squares property, and the cases without an answer."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipelines.geometry.arrays import Float
from pipelines.geometry.metrics import align_each


def cloud(count: int = 17, seed: int = 0) -> Float:
    return np.random.default_rng(seed).normal(size=(count, 3)) * [0.3, 0.2, 0.6] + [4.0, -3.0, 1.0]


def rotation_of(vector: tuple[float, float, float]) -> Float:
    return np.asarray(Rotation.from_rotvec(vector).as_matrix(), dtype=np.float64)


@given(
    seed=st.integers(0, 1000),
    vector=st.tuples(*[st.floats(-3, 3)] * 3),
    scale=st.floats(0.05, 20),
    shift=st.tuples(*[st.floats(-1000, 1000)] * 3),
    count=st.integers(3, 20),
)
def test_a_known_similarity_is_found(
    seed: int,
    vector: tuple[float, float, float],
    scale: float,
    shift: tuple[float, float, float],
    count: int,
) -> None:
    source = cloud(count, seed)
    rotation = rotation_of(vector)
    target = scale * source @ rotation.T + shift
    found = align_each(source, target, with_scale=True)
    # Coordinates of 1e3 carry 1e-13 of rounding; narrow triangles multiply it by at most some 1e4.
    np.testing.assert_allclose(found.apply(source), target, rtol=0, atol=1e-9 * scale + 1e-9)
    np.testing.assert_allclose(found.scale, scale, rtol=1e-7)
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_a_rigid_alignment_keeps_the_size() -> None:
    source = cloud()
    rotation = rotation_of((0.3, -1.0, 2.0))
    found = align_each(source, source @ rotation.T + [1, 2, 3], with_scale=False)
    assert found.scale == 1
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
    doubled = align_each(source, 2 * source, with_scale=False)
    # The mean goes onto the mean, whatever the size.
    np.testing.assert_allclose(doubled.apply(source).mean(axis=0), 2 * source.mean(axis=0), atol=1e-12)


def test_a_mirror_image_is_not_matched_by_a_reflection() -> None:
    source = cloud()
    found = align_each(source, source * [-1, 1, 1], with_scale=True)
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    assert np.abs(found.apply(source) - source * [-1, 1, 1]).max() > 0.05


def test_points_missing_on_either_side_are_left_out() -> None:
    source = cloud()
    target = 0.7 * source @ rotation_of((1.0, 0.2, 0.3)).T - 5
    source[3] = np.nan
    target[8, 1] = np.nan
    found = align_each(source, target, with_scale=True)
    assert found.scale == pytest.approx(0.7)
    moved = found.apply(source)
    assert np.isnan(moved[3]).all()
    np.testing.assert_allclose(moved[[0, 16]], target[[0, 16]], atol=1e-12)


def test_a_batch_is_its_members_and_nan_where_there_is_no_answer() -> None:
    rng = np.random.default_rng(2)
    source = rng.normal(size=(2, 3, 6, 3))
    target = rng.normal(size=(2, 3, 6, 3))
    source[0, 1, 2:] = np.nan  # two points
    target[1, 2] = np.linspace(0, 1, 6)[:, None] * [1.0, 2, 3]  # a line
    target[0, 0, 4, 0] = np.nan
    batch = align_each(source, target, with_scale=True)
    for i, j in np.ndindex(2, 3):
        if (i, j) in {(0, 1), (1, 2)}:
            assert np.isnan(batch.rotation[i, j]).all()
            assert np.isnan(batch.apply(source)[i, j]).all()
        else:
            one = align_each(source[i, j], target[i, j], with_scale=True)
            np.testing.assert_allclose(batch.apply(source)[i, j], one.apply(source[i, j]), atol=1e-12)


@pytest.mark.parametrize("origin", [0.0, 1000.0])
@pytest.mark.parametrize("step", [0.0, 0.3])
def test_points_on_a_line_or_a_spot_have_no_alignment(origin: float, step: float) -> None:
    line = origin + np.arange(5.0)[:, None] * step * np.array([0.3, -0.7, 0.2])
    assert np.isnan(align_each(line, line + 1, with_scale=True).rotation).all()
