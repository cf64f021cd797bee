"""Fit of the body: derivatives against differences, and modelled people whose shape and pose are known."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from pipelines.geometry.arrays import Float, Index
from pipelines.geometry.body_model import MEAN_SHAPE, SHAPE_SIGMA, body_model
from pipelines.geometry.poses import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
)
from pipelines.geometry.rig import BONES
from pipelines.reconstruction import one_camera
from pipelines.reconstruction.body_fit import (
    BodyFit,
    Landmarks,
    Places,
    Points,
    Poses,
    Rays,
    Shared,
    _bounded,
    _less,
    _seen,
    fit_body,
    joint_ranges,
    landmarks_of,
    side_view_errors,
)
from pipelines.reconstruction.one_camera import (
    STATURE_M,
    UNKNOWN_LEVEL_SIGMA_M,
    GroundHeight,
    StandingPoints,
    fit_seen_body,
)
from pipelines.session.people import SKELETONS

TIMES = 40


def known_landmarks(skeleton: str = "blazepose33") -> Landmarks:
    """Return the landmarks of a skeleton."""
    found = landmarks_of(SKELETONS[skeleton].joints)
    assert found is not None
    return found[0]


def moving(rng: np.random.Generator) -> tuple[Poses, Float]:
    """Return poses of a walk, and a shape of the prior."""
    t_s = np.arange(TIMES, dtype=np.float64) * 0.4
    return Poses(np.outer(t_s, [1.0, 0.0, 0.0]), walking(t_s)), MEAN_SHAPE + SHAPE_SIGMA * rng.normal(size=12)


def errors_of(own: Float, rows: Index, scale: float = 0.0) -> tuple[Float, Float, Float]:
    """Return the covariances of some moments, no common error, and the variance of the scale."""
    return own[rows], np.zeros((len(rows), 3, 3)), np.full(len(rows), scale)


def places(points: Points, poses: Poses, shared: Shared) -> Float:
    """Compute the landmarks [T, K, 3] by the formula of `body_model`."""
    return places_of(poses, shared.shape[0], points.vectors(shared))


@pytest.mark.parametrize("cameras", [1, 2])
def test_derivatives_are_those_of_the_cost(cameras: int) -> None:
    rng, landmarks = np.random.default_rng(0), known_landmarks()
    points, (poses, shape) = Points(body_model(), landmarks), moving(rng)
    poses = Poses(poses.root[:1], poses.turn[:1])
    shared = Shared(shape, rng.normal(0, 0.005, landmarks.offset.shape))
    # Far below the bound of the loss, whose second derivatives Gauss-Newton leaves out.
    place = places(points, poses, shared)
    seen: Places | Rays = _seen(place, np.tile(np.eye(3), (1, len(landmarks.bone), 1, 1)))
    if cameras == 1:
        camera = np.array([[1.0, -8.0, 3.0]])
        ray = place - camera[:, None]
        length = np.linalg.norm(ray, axis=-1, keepdims=True)
        seen = Rays(camera, ray / length, 1 / length[..., 0])
        points = StandingPoints(landmarks, GroundHeight(flat, 0.1), (1.7, 0.08))
    poses = poses.moved(rng.normal(0, 0.03, (1, 69)))
    normal = points.normal(poses, seen, shared, whole=True)
    step = 1e-5
    for d in range(0, 69, 4):
        move = step * (np.arange(69) == d)[None]
        costs = [points.normal(poses.moved(way * move), seen, shared, whole=False).cost[0] for way in (1, -1)]
        assert normal.pose_right[0, d] == pytest.approx(-(costs[0] - costs[1]) / (4 * step), abs=1e-3)
    for g in range(0, 13 + landmarks.offset.size, 5):
        change = step * (np.arange(13 + landmarks.offset.size) == g)
        others = [shared.moved(way * change) for way in (1, -1)]
        moments = [points.normal(poses, seen, other, whole=False).cost.sum() for other in others]
        costs = [cost + points.prior.cost(other) for cost, other in zip(moments, others, strict=True)]
        assert normal.shared_right[g] == pytest.approx(np.diff(costs)[0] / (4 * step), rel=1e-3, abs=1e-3)


def test_modes_of_landmarks_count_as_their_covariance_does() -> None:
    rng = np.random.default_rng(1)
    # Errors of 1e-3 standard deviations have weights of 1 to 1e-6.
    white, modes = 1e-3 * rng.normal(size=(2, 5, 3)), rng.normal(size=(2, 5, 3, 4))
    error, flat, unit = white.reshape(2, 15, 1), modes.reshape(2, 15, 4), np.eye(15)[None].repeat(2, axis=0)
    precision = np.linalg.inv(unit + flat @ flat.mT)
    _, cost, shift = _bounded(white, modes)
    np.testing.assert_allclose(cost, (error.mT @ precision @ error).ravel(), rtol=1e-5)
    np.testing.assert_allclose(_less(shift, _less(shift, unit)), precision, atol=1e-5)


def test_modes_that_move_in_a_walk_are_found_within_their_standard_deviations() -> None:
    rng, landmarks, t_s = np.random.default_rng(3), known_landmarks(), np.arange(60) / 3
    points, many = Points(body_model(), landmarks), landmarks.modes.shape[-1]
    poses, shared = (
        Poses(np.outer(t_s, [0.4, 0.3, 0.0]), walking(t_s)),
        Shared(MEAN_SHAPE, 0 * landmarks.offset),
    )
    amplitude = 1.4 * np.sin(t_s[:, None] * rng.uniform(1.0, 4.0, many) + rng.uniform(0.0, 6.3, many))
    moved = np.einsum("tkij,kjm,tm->tki", poses.turn[:, landmarks.bone], landmarks.modes, amplitude)
    sigma_m = MEAN_SHAPE[0] * landmarks.picture_sigma[:, None] / 2
    place = places(points, poses, shared) + MEAN_SHAPE[0] * moved
    place += sigma_m * rng.normal(size=place.shape)
    own = np.tile(sigma_m[..., None] ** 2 * np.eye(3), (len(t_s), 1, 1, 1))
    body = fit_body(landmarks, np.round(t_s * 1e9).astype(np.int64), place, partial(errors_of, own))
    assert body is not None

    # One system of amplitudes and the fitted poses, which have the fit's prior.
    fitted, seen = Poses(body.centre[:, 0], matrix_from_quaternion(body.rotation)), _seen(place, own)
    shared = Shared(body.shape, shared.offset)
    *_, slope, shift = points._whitened(fitted, seen, shared)
    prior = points.normal(fitted, seen, shared, whole=False).pose - slope.mT @ slope
    slope = np.linalg.inv(np.eye(slope.shape[1]) - shift @ shift.mT) @ slope
    modes = body.shape[0] * seen.root_weight @ fitted.turn[:, landmarks.bone] @ landmarks.modes
    both = np.concatenate([slope, modes.reshape(len(t_s), -1, many)], axis=2)
    precision = both.mT @ both + np.eye(69 + many) * (np.arange(69 + many) >= 69)
    precision[:, :69, :69] += prior
    white = (seen.root_weight @ (place - places(points, fitted, shared))[..., None]).reshape(len(t_s), -1, 1)
    error = np.linalg.solve(precision[:, 69:, 69:], both[..., 69:].mT @ white)[..., 0] - amplitude
    error -= error.mean(axis=0)  # offsets of the body are constant, too
    white = np.linalg.solve(np.linalg.inv(precision)[:, 69:, 69:], error[..., None])[..., 0]
    # The mean of 360 squares of standard normal numbers errs by 0.075.
    assert np.mean(error * white) == pytest.approx(1.0, abs=0.3)


def test_far_limbs_err_more_in_pictures_from_the_side() -> None:
    landmarks, left = known_landmarks(), np.array([0.0, 1.0, 0.0])
    rays = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [np.nan, 0.0, 0.0]])
    front, from_right, from_left, unknown = side_view_errors(landmarks, left, left, rays)
    assert (front == 1).all()
    assert (unknown == 1).all()
    one, other = (landmarks.joints.index(f"{side}_wrist") for side in ("left", "right"))
    assert from_right[one] == from_left[other] > from_right[other] == from_left[one] == 1


@pytest.fixture(scope="module")
def fitted() -> list[tuple[BodyFit, Poses, Float]]:
    """Fit bodies whose landmarks lie off the table and whose keypoints err as the table says."""
    found, landmarks = [], known_landmarks()
    for seed in range(3):
        rng = np.random.default_rng(seed)
        points, (poses, shape) = Points(body_model(), landmarks), moving(rng)
        prior = np.linalg.inv(points.prior.precision)[12:-1, 12:-1]
        offset = np.linalg.cholesky(prior) @ rng.normal(size=len(prior))
        place = places(points, poses, Shared(shape, offset.reshape(-1, 3)))
        sigma_m = MEAN_SHAPE[0] * landmarks.picture_sigma
        place += sigma_m[:, None] * rng.normal(size=place.shape)
        own = np.tile((sigma_m**2)[:, None, None] * np.eye(3), (TIMES, 1, 1, 1))
        t_ns = np.arange(TIMES) * 400_000_000

        body = fit_body(landmarks, t_ns, place, partial(errors_of, own))
        assert body is not None
        found.append((body, poses, shape))
    return found


def test_shape_and_joint_centres_err_as_much_as_they_say(fitted: list[tuple[BodyFit, Poses, Float]]) -> None:
    points, shape_nees, centre_nees = Points(body_model(), known_landmarks()), [], []
    for body, poses, shape in fitted:
        error = body.shape - shape
        assert abs(error[0]) < 0.04  # 1 cm of standard deviation, and 1 cm of noise that looks like length
        shape_nees.append(error @ np.linalg.solve(body.shape_covariance, error) / len(error))
        arms = np.tensordot(np.array([1.0, *shape[1:]]), points.centres, 1)
        centre = poses.root[:, None] + shape[0] * np.einsum("nbij,kbj->nki", poses.turn, arms)
        away = body.centre - centre
        white = np.linalg.solve(body.centre_covariance, away[..., None])[..., 0]
        centre_nees.append(np.mean(np.sum(away * white, axis=-1)))
        surface = [
            points.model.surface(body.shape, body.centre[k, 0], body.rotation[k])
            - points.model.surface(shape, poses.root[k], quaternion_from_matrix(poses.turn[k]))
            for k in range(0, TIMES, 10)
        ]
        # Offsets of landmarks and their spread in pictures are 1 % of the height each, and more for hands.
        assert np.linalg.norm(surface, axis=-1).mean() < 0.045
    # Noise makes bodies too large: means of 1 and 3 without it.
    assert 0.4 < np.mean(shape_nees) < 3.0
    assert 1.5 < np.mean(centre_nees) < 6.0


def test_another_skeleton_and_a_person_without_a_trunk_have_no_body() -> None:
    for skeleton, count in (("blazepose33", 33), ("coco17", 17), ("body25", 25)):
        assert len(known_landmarks(skeleton).joints) == count
    assert landmarks_of(("left_hip", "right_hip", "tail")) is None
    landmarks = known_landmarks()
    place = np.full((2, len(landmarks.bone), 3), np.nan)
    assert fit_body(landmarks, np.arange(2), place, lambda _: (place, place, place)) is None


def test_depths_that_parallel_rays_leave_open_have_no_weight() -> None:
    rng, landmarks = np.random.default_rng(7), known_landmarks()
    points, (poses, shape) = Points(body_model(), landmarks), moving(rng)
    place = places(points, poses, Shared(shape, np.zeros((len(landmarks.bone), 3))))
    own = np.tile(1e-4 * np.eye(3), (*place.shape[:2], 1, 1))
    ray = np.array([0.48, 0.64, 0.6])
    place[:, ::3] += 5.0 * ray
    own[:, ::3] += 1e18 * np.outer(ray, ray)  # singular to double precision
    body = fit_body(landmarks, np.arange(TIMES) * 400_000_000, place, partial(errors_of, own))
    assert body is not None
    assert np.isfinite(body.centre_covariance).all()
    assert abs(body.shape[0] - shape[0]) < 4 * np.sqrt(body.shape_covariance[0, 0])
    # A scale that is known to 10 % leaves the stature to its prior.
    by_scale = partial(errors_of, own, scale=0.1**2)
    unscaled = fit_body(landmarks, np.arange(TIMES) * 400_000_000, place, by_scale)
    assert unscaled is not None
    sigma_m = 1 / np.hypot(1 / SHAPE_SIGMA[0], 1 / (0.1 * MEAN_SHAPE[0]))
    share = (SHAPE_SIGMA[0] - sigma_m) * (SHAPE_SIGMA[0] + sigma_m) / SHAPE_SIGMA[0] ** 2
    away = unscaled.shape[0] - MEAN_SHAPE[0], body.shape[0] - MEAN_SHAPE[0]
    assert away[0] == pytest.approx(share * away[1], abs=5e-3)
    assert np.sqrt(unscaled.shape_covariance[0, 0]) == pytest.approx(sigma_m, rel=0.05)


@pytest.mark.parametrize(("level_sigma_m", "most_mm"), [(0.05, 350.0), (UNKNOWN_LEVEL_SIGMA_M, 700.0)])
def test_one_camera_places_a_person_as_well_as_it_says(
    level_sigma_m: float, most_mm: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """See somebody of 1.76 m who walks on the ground from 9 m away; keypoints err as the table says.

    The stature is known to 8 cm, which is 0.4 m of the distance; a ground that is known makes that 0.25 m.
    """
    rng, landmarks, t_s = np.random.default_rng(1), known_landmarks(), np.arange(60) / 12
    points = StandingPoints(landmarks, GroundHeight(flat, level_sigma_m), STATURE_M)
    turn = walking(t_s)
    shape = MEAN_SHAPE + 0.5 * SHAPE_SIGMA * rng.normal(size=len(MEAN_SHAPE))
    shape[0] = 1.76
    soles = np.tensordot([1.0, *shape[1:]], points.contacts, 1)
    sole = shape[0] * np.einsum("nbij,kbj->nki", turn, soles)[..., 2].min(axis=1)
    poses = Poses(np.stack([0.4 * t_s, 0.3 * t_s, -sole], axis=1), turn)
    place = places(points, poses, Shared(shape, np.zeros(landmarks.offset.shape)))
    place += MEAN_SHAPE[0] * landmarks.picture_sigma[:, None] * rng.normal(size=place.shape)
    camera = np.stack([8 * np.sin(t_s / 5), -8 * np.cos(t_s / 5), 3 + 0 * t_s], axis=1)
    ray = place - camera[:, None]
    rays = Rays(camera, ray / np.linalg.norm(ray, axis=-1, keepdims=True), np.ones(ray.shape[:2]))
    t_ns, exact = np.round(t_s * 1e9).astype(np.int64), np.zeros((len(t_s), 2))

    found = fit_seen_body(landmarks, t_ns, rays, points.ground, STATURE_M, exact)
    assert found is not None
    body = found.body
    vectors = np.tensordot([1.0, *shape[1:]], points.centres, 1)
    error = body.centre - places_of(poses, shape[0], vectors)[body.row]
    assert 1e3 * np.linalg.norm(error - error[:, :1], axis=-1).mean() < 90
    assert 1e3 * np.linalg.norm(error[:, 0], axis=-1).mean() < most_mm
    white = np.linalg.solve(body.centre_covariance, error[..., None])[..., 0]
    assert np.sum(error * white, axis=-1).mean() < 4.5
    assert abs(body.shape[0] - shape[0]) < 2.5 * np.sqrt(body.shape_covariance[0, 0])
    # Rays that err by more than usual, here 5 degrees, widen the covariances.
    noisy = replace(rays, direction=rays.direction + rng.normal(0, 0.09, ray.shape))
    worse = fit_seen_body(landmarks, t_ns, noisy, points.ground, STATURE_M, exact)
    assert worse is not None
    assert np.median(worse.body.rotation_covariance[..., 0, 0] / body.rotation_covariance[..., 0, 0]) > 2.0
    # Windows hold the shape that all of them gave.
    monkeypatch.setattr(one_camera, "_WINDOW", 20)
    parts = fit_seen_body(landmarks, t_ns, rays, points.ground, STATURE_M, exact)
    assert parts is not None
    error = parts.body.centre - places_of(poses, shape[0], vectors)[parts.body.row]
    assert 1e3 * np.linalg.norm(error[:, 0], axis=-1).mean() < most_mm
    assert abs(parts.body.shape[0] - shape[0]) < 2.5 * np.sqrt(parts.body.shape_covariance[0, 0])
    # Two moments have no acceleration.
    two = Rays(*(each[:2] for each in (rays.camera, rays.direction, rays.sigma)))
    short = fit_seen_body(landmarks, t_ns[:2], two, points.ground, STATURE_M, exact[:2])
    assert short is not None
    assert np.isfinite(short.body.centre).all()


def walking(t_s: Float) -> Float:
    """Return world rotations [T, 22, 3, 3] of somebody who walks on a curve."""
    usual, turn = joint_ranges(), np.zeros((len(t_s), len(BONES), 3, 3))
    turn[:, 0] = matrix_from_quaternion(quaternion_from_rotation_vector(np.outer(t_s / 4, [0, 0, 1.0])))
    stride = {"left_thigh": 1, "right_thigh": -1, "left_upper_arm": -1, "right_upper_arm": 1}
    for k, (bone, parent) in enumerate(zip(usual.bone, usual.parent, strict=True)):
        vector = np.tile(usual.usual[k], (len(t_s), 1))
        vector[:, 1] += 0.4 * stride.get(BONES[bone], 0) * np.sin(6 * t_s)
        if "shank" in BONES[bone]:
            vector[:, 1] += 0.3 * (1 + np.sin(6 * t_s + (2 if "left" in BONES[bone] else 5)))
        relative = matrix_from_quaternion(quaternion_from_rotation_vector(vector))
        turn[:, bone] = turn[:, parent] @ usual.middle[k] @ relative
    return turn


def flat(at: Float) -> Float:
    """Return the height of level ground."""
    return np.zeros(len(at))


def places_of(poses: Poses, stature_m: float, vectors: Float) -> Float:
    """Place points with vectors [K, 22, 3] of the bones."""
    found: Float = poses.root[:, None] + stature_m * np.einsum("nbij,kbj->nki", poses.turn, vectors)
    return found
