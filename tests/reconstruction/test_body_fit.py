"""Fit of the body: derivatives against differences, and modelled people whose shape and pose are known."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from pipelines.geometry.arrays import Float, Index, Intrinsics
from pipelines.geometry.body_model import MEAN_SHAPE, SHAPE_SIGMA, body_model
from pipelines.geometry.poses import (
    look_at,
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
)
from pipelines.geometry.rig import BONES
from pipelines.geometry.triangulation import Triangulation
from pipelines.reconstruction import one_camera
from pipelines.reconstruction.body_fit import (
    BodyFit,
    Landmarks,
    Places,
    Points,
    Poses,
    Rays,
    Shared,
    _seen,
    fit_body,
    joint_ranges,
    landmarks_of,
    turns_of_bones,
)
from pipelines.reconstruction.observations import Camera, candidates, observe, on_sides
from pipelines.reconstruction.one_camera import (
    STATURE_M,
    UNKNOWN_LEVEL_SIGMA_M,
    GroundHeight,
    StandingPoints,
    fit_seen_body,
)
from pipelines.reconstruction.view_errors import ViewErrors, without_view_errors
from pipelines.session.description import Interpolation
from pipelines.session.people import SKELETONS, mirrored
from pipelines.session.records import Detections, Trajectory

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


@pytest.mark.parametrize("exchanged", [False, True])
def test_keypoints_of_a_body_lose_the_errors_of_their_side(exchanged: bool) -> None:
    joints, landmarks, t_ns = SKELETONS["blazepose33"].joints, known_landmarks(), np.arange(6) * 100_000_000
    columns = [joints.index(name) for name in landmarks.joints]
    poses, none = Poses(np.zeros((6, 3)), walking(t_ns / 1e9)), np.zeros((len(columns), 3))
    place = places(Points(body_model(), landmarks), poses, Shared(MEAN_SHAPE, none))
    at, every = np.array([4.8, 5.6, 3.2]), np.arange(6)
    between = Interpolation(max_gap_s=1.0, max_extrapolation_s=1.0)
    quaternion = look_at(at, np.zeros(3))
    ray = (place - at) / np.linalg.norm(place - at, axis=-1, keepdims=True)
    shift = MEAN_SHAPE[0] * ViewErrors.of(landmarks.joints).at(turns_of_bones(landmarks, place), ray)
    assert 0.01 < np.linalg.norm(shift, axis=-1).max() < 0.1  # of joints that are known within a hand's width

    def rays_to(points: Float) -> Float:
        seen = (points - at) @ matrix_from_quaternion(quaternion)
        return np.asarray(seen[..., :2] / seen[..., 2:])

    xy, points = np.full((6, 33, 2), np.nan), np.full((6, 33, 3), np.nan)
    xy[:, columns], points[:, columns] = 500 * rays_to(place + shift), place
    order = [joints.index(mirrored(joint)) for joint in joints] if exchanged else list(range(33))
    log = Trajectory(t_ns, np.tile(at, (6, 1)), np.tile(quaternion, (6, 1)))
    people = Detections(joints, every, every * 0, xy[:, order], np.ones((6, 33)), every)
    lens = Intrinsics(640, 480, 500.0, 500.0, 0.0, 0.0, "none", ())
    camera = Camera("drone1", lens, every, t_ns, every >= 0, log, False, None, people, blazepose=True)
    found, choice = candidates([camera], between), np.zeros((6, 1, 1), dtype=np.int64)
    seen = observe([camera], found, choice, t_ns, between)
    sides = np.broadcast_to(np.array(order)[:, None], seen.confidence.shape)
    one, ok = np.ones((6 * 33, 1)), np.zeros(6 * 33, dtype=np.int8)
    result = Triangulation(
        points.reshape(-1, 3), one > 0, ok, one[:, :, None], one[:, 0].astype(np.int64), one
    )
    corrected = without_view_errors([camera], found, choice, seen, sides, result, None)
    seen = observe(corrected, candidates(corrected, between), choice, t_ns, between)
    rays, _ = on_sides(seen.rays, seen.confidence, sides)
    # A ray's shift is taken as linear in the joint's: what is left is the square of their angle.
    assert np.abs(rays[:, 0, columns, 0] - rays_to(place)).max() < 2 * (0.1 / 8) ** 2


def test_errors_of_both_sides_are_mirrored() -> None:
    joints, rng = SKELETONS["blazepose33"].joints, np.random.default_rng(0)
    errors = ViewErrors.of(joints)
    turn = np.broadcast_to(np.eye(3), (20, 22, 3, 3))
    direction = rng.normal(size=(20, 33, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    other, mirror = [joints.index(mirrored(joint)) for joint in joints], np.array([1.0, -1.0, 1.0])
    mirrored_shift = errors.at(turn, (direction * mirror)[:, other])[:, other] * mirror
    np.testing.assert_allclose(errors.at(turn, direction), mirrored_shift, atol=2e-5)


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
