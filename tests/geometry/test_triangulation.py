"""Triangulation against closed-form walks, numpy's SVD and its own statistics."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.arrays import Float
from pipelines.geometry.triangulation import (
    STATUS,
    Method,
    Triangulation,
    _closed,
    _pair_table,
    estimate_noise,
    triangulate,
)
from tests.geometry.rings import (
    FOCAL,
    LEVELS,
    project,
    ring,
    turned,
    with_outliers,
    with_pixel_noise,
    with_pose_noise,
)

METHODS = get_args(Method)


def mean_error_mm(result: Triangulation, truth: Float) -> float:
    error = np.linalg.norm(result.points - truth, axis=1)
    return 1e3 * float(np.nanmean(error))


def words(result: Triangulation) -> list[str]:
    return [STATUS[code] for code in result.status]


@pytest.mark.parametrize("cameras", [2, 3, 5, 16])
@pytest.mark.parametrize("method", METHODS)
def test_exact_views_give_exact_points(method: Method, cameras: int) -> None:
    truth, views = ring(50, cameras)

    result = triangulate(views, method=method)

    assert np.abs(result.points - truth).max() < 1e-6
    assert np.nanmax(result.residual_px) < 1e-6
    assert (result.views == cameras).all()


@pytest.mark.parametrize("method", METHODS)
def test_two_pixel_noise_gives_the_error_of_the_peers(method: Method) -> None:
    """Compare with the peers' mean of 12.6 mm; our walk has another route and other joint positions."""
    truth, views = ring(2250, 5)

    result = triangulate(with_pixel_noise(views, np.random.default_rng(1)), method=method)

    assert mean_error_mm(result, truth) == pytest.approx(12.6, abs=0.7)


@pytest.mark.parametrize("uniform", [False, True])
def test_robust_drops_the_bad_views_and_little_else(uniform: bool) -> None:
    rng = np.random.default_rng(2)
    truth, views = ring(2250, 5)
    views, good = with_outliers(with_pixel_noise(views, rng), rng, uniform=uniform)

    noisy = replace(views, pixel_sigma=estimate_noise(views))
    result = triangulate(noisy, method="robust")
    oracle = triangulate(replace(views, weight=good.astype(float)), method="robust")

    assert noisy.pixel_sigma == pytest.approx(2.0, rel=0.02)
    assert mean_error_mm(result, truth) <= 14.0
    assert mean_error_mm(result, truth) <= 1.02 * mean_error_mm(oracle, truth)
    determinable = good.sum(axis=1) >= 2
    assert (result.status[determinable] == 0).mean() >= 0.98


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("cameras", [2, 3, 5])
def test_robust_is_as_good_as_least_squares_under_pose_errors(cameras: int, level: str, stated: bool) -> None:
    truth, views = ring(20, cameras)
    errors = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        drawn = with_pose_noise(with_pixel_noise(views, rng), rng, level, constant=True, stated=stated)
        result = triangulate(replace(drawn, pixel_sigma=estimate_noise(drawn)), method="robust")
        assert (result.status == 0).mean() > 0.99
        errors.append(
            (mean_error_mm(result, truth), mean_error_mm(triangulate(drawn, method="midpoint"), truth))
        )

    robust, least_squares = np.mean(errors, axis=0)
    assert robust <= 1.02 * least_squares


@pytest.mark.parametrize("noise", ["pixels", "a"])
@pytest.mark.parametrize("cameras", [2, 5])
@pytest.mark.parametrize("method", METHODS)
def test_the_covariance_is_that_of_the_errors(method: Method, cameras: int, noise: str) -> None:
    rng = np.random.default_rng(5)
    frames = 4000
    truth, views = ring(frames, cameras)
    one_joint = np.arange(frames) * 17 + np.arange(frames) % 17  # joints of a frame share its pose errors
    truth = truth[one_joint]
    views = replace(
        views,
        rays=views.rays[one_joint],
        weight=rng.uniform(0.5, 1.0, (frames, cameras)),
        pose_index=views.pose_index[one_joint],
    )
    sigma = 2.0 / FOCAL / views.weight[..., None]
    views = replace(views, rays=views.rays + sigma * rng.standard_normal(views.rays.shape))
    if noise == "a":
        views = with_pose_noise(views, rng, noise, constant=False, stated=True)

    result = triangulate(views, method=method, gate=8.0)  # so that the gate takes no part of the tail

    error = result.points - truth
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(result.covariance), error)
    # A sum of 4000 chi-square variables with 3 degrees of freedom: the mean is 3 +- sqrt(6/4000) = 0.039;
    # four of them, and as much again for what the first order leaves out (0.5 deg at 10 m).
    assert nees.mean() == pytest.approx(3.0, abs=0.16 if noise == "pixels" else 0.32)
    inside = (nees < 7.815).mean()  # 95 % quantile; binomial deviation 0.0034
    assert inside == pytest.approx(0.95, abs=0.015)


def test_any_division_of_the_joint_frames_gives_the_same_bytes() -> None:
    rng = np.random.default_rng(6)
    _, views = ring(300, 5)
    views, _ = with_outliers(with_pixel_noise(views, rng), rng, uniform=False)

    whole = triangulate(views, method="robust")
    late = slice(100, None)
    part = triangulate(
        replace(views, rays=views.rays[late], weight=views.weight[late], pose_index=views.pose_index[late]),
        method="robust",
    )
    for name in ("points", "covariance", "views", "inlier", "residual_px", "status"):
        assert getattr(whole, name)[late].tobytes() == getattr(part, name).tobytes()


def test_two_clean_views_among_three_outliers_are_found() -> None:
    rng = np.random.default_rng(7)
    truth, views = ring(100, 5)
    views = with_pixel_noise(views, rng)
    xy = views.rays.copy()
    xy[:, 2:] += rng.uniform(100, 300, xy[:, 2:].shape) * rng.choice([-1, 1], xy[:, 2:].shape) / FOCAL

    result = triangulate(replace(views, rays=xy), method="robust")

    right = np.linalg.norm(result.points - truth, axis=1) < 0.1
    # A pair with an outlier agrees by chance in about 2 x 4 x 2 px x sqrt(2)/500 px = 5 % of cases; 9 such
    # pairs leave some 65 % of joints without a rival. The others are rejected; very few are wrong.
    assert right.mean() > 0.5
    assert ((result.status == 0) & ~right).mean() < 0.06
    assert (result.inlier[right] == [True, True, False, False, False]).all(axis=1).mean() > 0.99


def test_of_two_views_an_outlier_shows_in_the_epipolar_distance() -> None:
    truth, views = ring(20, 2)
    xy = views.rays.copy()
    xy[:, 1, 1] += 60 / FOCAL  # up the picture: across the epipolar line of a camera at the same height
    # Along the first camera's line of sight the second cannot tell.
    moved = truth + 0.1 * (truth - views.position[views.pose_index, 0])
    along = views.rays.copy()
    along[:, 1] = project(moved.reshape(20, 17, 3), views.position, views.rotation).reshape(-1, 2, 2)[:, 1]

    assert set(words(triangulate(replace(views, rays=xy), method="robust"))) == {"rejected"}
    assert np.isfinite(triangulate(replace(views, rays=xy), method="midpoint").points).all()
    undetectable = triangulate(replace(views, rays=along), method="robust")
    assert undetectable.points == pytest.approx(moved, abs=1e-6)


@pytest.mark.parametrize("cameras", [16, 32])
def test_many_cameras_cost_a_bounded_number_of_trials(cameras: int) -> None:
    rng = np.random.default_rng(8)
    truth, views = ring(40, cameras)
    views = with_pixel_noise(views, rng)
    bad = rng.random(views.weight.shape) < 0.3
    xy = views.rays + bad[..., None] * rng.uniform(100, 300, views.rays.shape) / FOCAL
    views = replace(views, rays=xy)

    result = triangulate(replace(views, pixel_sigma=estimate_noise(views)), method="robust")
    oracle = triangulate(replace(views, weight=(~bad).astype(float)), method="robust")

    assert mean_error_mm(result, truth) < 1.1 * mean_error_mm(oracle, truth)
    assert _pair_table(64)[1].max() == _pair_table(8)[1][8] == 28


def test_every_missing_joint_says_why() -> None:
    _, views = ring(1, 3)
    xy, weight = views.rays[:6].copy(), views.weight[:6].copy()
    position = np.repeat(views.position, 3, axis=0)
    rotation = np.repeat(views.rotation, 3, axis=0)
    position[1, :2] = np.nan  # two cameras without a pose
    position[2] = position[2, :1]  # three cameras in one place
    rotation[2] = rotation[2, :1]
    xy[4] = xy[4, :1]
    weight[1] = 0.0
    xy[2, 1:] = np.nan
    xy[5, :, 1] += [0.0, 0.2, -0.2]
    views = replace(
        views,
        rays=xy,
        weight=weight,
        pose_index=np.array([0, 0, 0, 1, 2, 0]),
        position=position,
        rotation=rotation,
        pose_sigma=np.zeros((3, 3, 2)),
    )

    result = triangulate(views, method="robust")

    assert words(result) == ["ok", "not_detected", "few_views", "no_pose", "low_parallax", "rejected"]
    assert np.isnan(result.points[1:]).all()
    assert np.isnan(result.covariance[1:]).all()
    assert np.isnan(result.residual_px[1:]).all()
    assert not result.inlier[1:].any()
    assert result.views.tolist() == [3, 0, 0, 0, 0, 0]


def test_a_view_from_behind_is_left_out_and_its_residual_is_infinite() -> None:
    truth, views = ring(5, 4)
    rotation = views.rotation.copy()
    rotation[:, 3] *= [-1.0, 1.0, -1.0]

    result = triangulate(replace(views, rotation=rotation), method="robust")

    assert np.abs(result.points - truth).max() < 1e-6
    assert (result.inlier == [True, True, True, False]).all()
    assert np.isinf(result.residual_px[:, 3]).all()


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), method=st.sampled_from(METHODS))
def test_moving_the_world_or_reordering_cameras_moves_the_points_along(seed: int, method: Method) -> None:
    rng = np.random.default_rng(seed)
    _, views = ring(2, 5)
    views, _ = with_outliers(with_pixel_noise(views, rng), rng, uniform=False)
    R = turned(np.eye(3), rng.normal(0, 1, 3))
    t = rng.uniform(-100, 100, 3)
    order = rng.permutation(5)

    plain = triangulate(views, method=method)
    moved = triangulate(
        replace(views, position=views.position @ R.T + t, rotation=R @ views.rotation), method=method
    )
    shuffled = triangulate(
        replace(
            views,
            rays=views.rays[:, order],
            position=views.position[:, order],
            rotation=views.rotation[:, order],
        ),
        method=method,
    )

    same = (plain.status == moved.status) & (plain.status == 0)
    # A view on the very gate may fall to either side by rounding; then the points differ by a view's pull.
    assert same.sum() >= len(same) - 1 - (plain.status != 0).sum()
    assert moved.points[same] == pytest.approx(plain.points[same] @ R.T + t, abs=1e-6)
    assert (shuffled.status == plain.status).all()
    ok = plain.status == 0
    assert shuffled.points[ok] == pytest.approx(plain.points[ok], abs=1e-6)


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 2**32 - 1), method=st.sampled_from(METHODS), cameras=st.integers(1, 6))
def test_nan_never_leaks(seed: int, method: Method, cameras: int) -> None:
    rng = np.random.default_rng(seed)
    _, views = ring(3, cameras)
    xy, weight, position = views.rays.copy(), views.weight.copy(), views.position.copy()
    rotation = views.rotation.copy()
    xy[rng.random(xy.shape) < 0.2] = rng.choice([np.nan, np.inf])
    weight[rng.random(weight.shape) < 0.2] = rng.choice([0.0, np.nan])
    position[rng.random(position.shape) < 0.1] = np.nan
    rotation[rng.random(rotation.shape) < 0.02] = np.nan
    views = replace(views, rays=xy, weight=weight, position=position, rotation=rotation)

    result = triangulate(views, method=method)

    ok = result.status == 0
    posed = np.isfinite(position.sum(axis=2)) & np.isfinite(rotation.sum(axis=(2, 3)))
    usable = np.isfinite(xy.sum(axis=2)) & (weight > 0) & posed[views.pose_index]
    assert np.isfinite(result.points).all(axis=1).tolist() == ok.tolist()
    assert np.isfinite(result.covariance).all(axis=(1, 2)).tolist() == ok.tolist()
    assert (np.linalg.eigvalsh(result.covariance[ok]) > 0).all()
    assert (np.isnan(result.residual_px) == ~(usable & ok[:, None])).all()
    assert (result.inlier <= usable).all()
    assert (result.views == result.inlier.sum(axis=1)).all()
    assert (result.views[ok] >= 2).all()
    assert ok[usable.sum(axis=1) < 2].sum() == 0


def test_parallel_rays_leave_a_huge_and_finite_variance() -> None:
    """Of two rays along z, one metre apart, the depth of the point between them is open."""
    normal = np.diag([1.0, 1.0, 0.0])[None]
    variance = np.linalg.inv(_closed(normal))[0]
    assert variance[2, 2] > 1e11
    assert np.isfinite(variance).all()


def test_a_view_without_weight_to_speak_of_leaves_the_other_line() -> None:
    truth, views = ring(1, 2)
    weight = np.tile([1.0, 1e-9], (len(truth), 1))

    result = triangulate(replace(views, weight=weight), method="midpoint")

    (line,) = views.rotation[:, 0] @ np.array([*views.rays[0, 0], 1.0])
    away = result.points[0] - views.position[0, 0]
    assert np.isfinite(result.points).all()
    assert np.linalg.norm(np.cross(away, line)) / np.linalg.norm(line) < 1e-4
