"""Attitudes from a static background: hovering and flying cameras against true poses, levels, covariances."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Intrinsics
from pipelines.geometry.cameras import row_delay_s
from pipelines.geometry.noise import (
    ROTATION,
    SHIFT_IN_WORLD,
    SURVEYED_M,
    UNKNOWN_SIGMA,
    Bias,
    Drift,
    GaussMarkov,
    NoiseModel,
    PoseErrors,
    Process,
    White,
    disturb,
    pose_errors,
)
from pipelines.geometry.poses import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from pipelines.reconstruction import background
from pipelines.reconstruction.background import (
    Adjusted,
    Background,
    PosePrior,
    SeenPoints,
    adjust,
    refine_cameras,
)
from pipelines.reconstruction.background_kernels import (
    BackgroundPoints,
    BackgroundSightings,
    eliminate_points,
)
from pipelines.reconstruction.background_tracks import Followed, Tracks, follow, off_people
from pipelines.reconstruction.observations import Camera
from pipelines.session.description import Interpolation
from pipelines.session.records import Detections, Trajectory

Int64 = NDArray[np.int64]
Poses = tuple[Float, Float]

FOCAL = 760.0
ERRORS = PoseErrors(
    (0.02, np.radians(0.2)), (Process(SHIFT_IN_WORLD, 0.05), Process(ROTATION, np.radians(0.3)))
)
PRIOR = PosePrior.of(ERRORS)


def flown(pictures: int, way_m: float, turn_deg: float = 90.0) -> tuple[Float, Float]:
    """Simulate a camera that looks 15 deg down and 90 deg left of its way, an arc 3 m above the ground."""
    angle = np.radians(turn_deg) * np.linspace(0, 1, pictures)
    step = way_m / pictures * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    position = np.cumsum(step, axis=0) + np.array([0.0, 0.0, 3.0])
    tilt = np.radians(15)
    left = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    forward = np.cos(tilt) * left - np.array([0.0, 0.0, np.sin(tilt)])
    right = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return position, np.stack([right, np.cross(forward, right), forward], axis=2)


def sighted(
    position: Float, rotation: Float, rng: np.random.Generator, noise_px: float = 0.3
) -> tuple[Int64, Int64, Float]:
    """Project points of the ground and of trees that fall into the picture, with noise."""
    points = rng.uniform([-40, -20, 0], [30, 40, 0.2], (900, 3))
    points[::4, 2] = rng.uniform(0, 5, len(points[::4]))
    away = np.einsum("tji,tnj->tni", rotation, points[None] - position[:, None])
    xy = away[..., :2] / away[..., 2:]
    inside = (away[..., 2] > 1) & (np.abs(xy) < [0.84, 0.47]).all(axis=-1)
    picture, point = np.nonzero(inside)
    return picture, point, xy[inside] + rng.normal(0, noise_px / FOCAL, (len(point), 2))


def logged(position: Float, rotation: Float, rng: np.random.Generator, every: int = 1) -> tuple[Float, Float]:
    """Add errors drawn from the prior to poses, between every k-th of which others are interpolated."""
    error = np.tile(rng.normal(0, 1, 6) * np.repeat(PRIOR.constant[:2], 3), (len(position), 1))
    at = np.arange(0, len(position) - 1 + every, every)
    white = rng.normal(0, 1, (len(at), 6)) * np.repeat(PRIOR.white, 3)
    error += np.stack([np.interp(np.arange(len(position)), at, column) for column in white.T], axis=1)
    turned = matrix_from_quaternion(quaternion_from_rotation_vector(error[:, 3:]))
    return position + error[:, :3], rotation @ turned


def turns_deg(one: Float, other: Float) -> Float:
    """Compute the angles [T] (deg) between rotations."""
    return np.asarray(np.linalg.norm(errors_deg(one, other), axis=1))


def adjusted(
    picture: Int64, point: Int64, xy: Float, poses: Poses, prior: PosePrior = PRIOR, alike: float = 1.0
) -> Adjusted:
    """Adjust poses of pictures 30 times a second."""
    seen, t_s = SeenPoints(picture, point, xy), np.arange(len(poses[0])) / 30
    return adjust(Background(seen.between, FOCAL, t_s, None, (alike, alike)), *poses, prior)


def refined(way_m: float, seed: int, lost: float = 0.0) -> tuple[Adjusted, Float, Float, Float, Float]:
    """Return the adjustment, true and logged attitudes, true and logged positions."""
    rng = np.random.default_rng(seed)
    position, rotation = flown(40, way_m)
    picture, point, xy = sighted(position, rotation, rng)
    wrong = rng.random(len(xy)) < lost
    xy[wrong] += rng.normal(0, 20 / FOCAL, (int(wrong.sum()), 2))
    at, turned = logged(position, rotation, rng)
    return adjusted(picture, point, xy, (at, turned)), rotation, turned, position, at


def turning(pictures: int) -> tuple[Float, Float]:
    """Simulate a camera on a tripod that pans by 20 deg, and shakes by 0.1 deg at 7 Hz about each axis."""
    t_s = np.arange(pictures) / 30
    pan = np.radians(20) * np.sin(2 * np.pi * 0.2 * t_s)
    shake = np.radians(0.1) * np.sin(2 * np.pi * 7 * t_s[:, None] + [0.0, 1.0, 2.0])
    _, start = flown(1, 0.0)
    up = quaternion_from_rotation_vector(pan[:, None] * [0.0, 0.0, 1.0])
    turned = (
        matrix_from_quaternion(up) @ start @ matrix_from_quaternion(quaternion_from_rotation_vector(shake))
    )
    return np.tile([0.0, 0.0, 3.0], (pictures, 1)), turned


def errors_deg(found: Float, truth: Float) -> Float:
    """Compute the rotation vectors [T, 3] (deg) by which attitudes err, in the camera."""
    turned = quaternion_from_matrix(np.swapaxes(truth, 1, 2) @ found)
    errors: Float = np.degrees(rotation_vector_from_quaternion(turned))
    return errors


def nees(found: Adjusted, position: Float, rotation: Float) -> float:
    """Compute the mean of e' C^-1 e over the six numbers of all poses."""
    errors = np.append(found.position - position, np.radians(errors_deg(found.rotation, rotation)), axis=1)
    whitened = np.linalg.solve(found.covariance, errors[..., None])[..., 0]
    return float(np.einsum("ti,ti->t", errors, whitened).mean()) / 6


@pytest.mark.parametrize("known", [True, False])
def test_a_camera_that_only_turns_gets_the_changing_part_of_its_attitudes(known: bool) -> None:
    """Expect the constant part of the log, and beside it what 0.3 px of 100 points say.

    A rotation of the world by 0.3 deg that is left appears as up to 0.3 sin 20 deg = 0.1 deg that changes.
    Pictures err by 0.3 px / 760 / sqrt(100) = 0.002 deg, and points drift by some such steps.
    """
    rng = np.random.default_rng(2)
    position, rotation = turning(150)
    picture, point, xy = sighted(position, rotation, rng)
    at, turned = logged(position, rotation, rng)
    found = adjusted(picture, point, xy, (at, turned), PRIOR if known else PosePrior.of(None))
    assert found.refused is None
    assert found.left is not None
    before, after = (
        np.einsum("tij,tj->ti", rotation, errors_deg(of, rotation)) for of in (turned, found.rotation)
    )
    assert np.sqrt(np.mean((before - before.mean(axis=0)) ** 2)) > 0.15
    assert np.sqrt(np.mean((after - after.mean(axis=0)) ** 2)) < 0.01
    assert np.sqrt(np.mean((found.rotation - rotation) ** 2)) < np.sqrt(np.mean((turned - rotation) ** 2))
    (sigma,) = [of.sigma0 for of in found.left.processes if of.number == ROTATION and of.constant]
    # The pan tells the log's error in the camera from a turn of the world, but for its own axis.
    # An unknown level is estimated from two axes: it is between the true one and the widest that is possible.
    assert 0.9 * 0.3 / np.sqrt(3) < np.degrees(sigma) < 1.1 * (0.3 if known else 1.0)


@pytest.mark.parametrize("known", [True, False])
def test_a_camera_that_stands_is_where_its_log_has_it_on_average(known: bool) -> None:
    """Give a log of white errors of 0.05 m and slow ones of 0.02 m per sqrt(s).

    No parallax is seen, so what changes in the log is error. The place no longer changes, and errs by what
    the average of the log errs by. A log that begins exactly says it as well as its first poses.
    """
    errors = PoseErrors(
        (0.05, np.radians(0.2)),
        (Process(SHIFT_IN_WORLD, 1e-5, 0.02), Process(ROTATION, 1e-5, np.radians(0.1))),
    )
    rng = np.random.default_rng(4)
    position, rotation = turning(150)
    picture, point, xy = sighted(position, rotation, rng, noise_px=0.1)
    models: list[NoiseModel] = [
        White(position_m=0.05, rotation_deg=0.2),
        Drift(position_m_per_sqrt_s=0.02, rotation_deg_per_sqrt_s=0.1),
    ]
    t_ns = np.round(1e9 * np.arange(150) / 30).astype(np.int64)
    at, quaternion = disturb(models, t_ns, position, quaternion_from_matrix(rotation), rng)
    prior = PosePrior.of(errors if known else None)
    found = adjusted(picture, point, xy, (at, matrix_from_quaternion(quaternion)), prior)
    assert found.refused is None
    away = found.position - position
    assert (at - position).std(axis=0).min() > 0.04
    assert away.std(axis=0).max() < 1e-3
    assert found.prior.white[0] == pytest.approx(0.05, rel=0.2)
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)[:, :3].mean())
    assert np.abs(away).max() < 3 * sigma
    assert sigma < 0.02 if known else sigma > UNKNOWN_SIGMA[0]  # a constant error is always possible


@pytest.mark.parametrize(
    ("measured_m", "moves_m", "surveyed"), [(0, 0, True), (1e-3, 0, False), (0, 0.3, False)]
)
def test_a_position_that_never_changes_was_surveyed_unless_pictures_show_that_it_moves(
    measured_m: float, moves_m: float, surveyed: bool
) -> None:
    """Nobody states the noise.

    A log that moves by a millimetre was measured, and may be off by much more. One that stays while the
    camera climbs by 0.3 m and comes back is frozen: points at 10 m move by 0.3 / 10 x 760 = 23 px more than
    far ones.
    """
    rng = np.random.default_rng(5)
    position, rotation = turning(60)
    swaying = position + moves_m * np.sin(np.linspace(0, np.pi, 60))[:, None] * [0.0, 0.0, 1.0]
    picture, point, xy = sighted(swaying, rotation, rng, noise_px=0.1)
    at, turned = logged(position, rotation, rng)
    at = position + rng.normal(0, 1, position.shape) * measured_m
    found = adjusted(picture, point, xy, (at, turned), PosePrior.of(None))
    assert found.left is not None
    assert found.frozen == (moves_m > 0)
    (sigma,) = [of.sigma0 for of in found.left.processes if of.number == SHIFT_IN_WORLD and of.constant]
    assert SURVEYED_M <= sigma < 1.1 * SURVEYED_M if surveyed else sigma >= UNKNOWN_SIGMA[0]


def test_a_hovering_camera_does_not_follow_the_noise_of_its_log() -> None:
    """Points that are lost before the camera moves could lie anywhere; then its noise would seem true."""
    rng = np.random.default_rng(0)
    t_s = np.arange(120) / 30
    _, facing = flown(1, 0.0)
    position = np.stack([np.maximum(t_s - 2.0, 0.0) ** 2, 0 * t_s, 0 * t_s + 3.0], axis=1)  # 2 m/s^2
    rotation = np.tile(facing, (120, 1, 1))
    picture, point, xy = sighted(position, rotation, rng, noise_px=0.15)
    white = [White(position_m=0.05, rotation_deg=0.3)]
    at, quaternion = disturb(
        white, (1e9 * t_s).astype(np.int64), position, quaternion_from_matrix(rotation), rng
    )
    logged_poses = at, matrix_from_quaternion(quaternion)
    found = adjusted(picture, 10 * point + picture // 30, xy, logged_poses, PosePrior.of(None))
    # The mean of the log over the 30 pictures of a track errs by 0.05 m / sqrt(30) = 9 mm; three of them.
    assert np.std(found.position - position, axis=0).max() < 3 * 0.05 / np.sqrt(30)
    # The deviation of 360 numbers errs by 4 %; a few of them are spent on slow errors.
    assert found.prior.white[0] == pytest.approx(0.05, rel=0.25)


@pytest.mark.parametrize("pictures", [60, 150])
def test_levels_that_nobody_stated_are_estimated(pictures: int) -> None:
    """Compare with the errors drawn: their standard deviations are known to 1 / sqrt(6 pictures).

    Positions are compared in flight. A camera that stands on a tripod sees no points near enough.
    """
    rng = np.random.default_rng(3)
    position, rotation = flown(pictures, 0.2 * pictures)
    picture, point, xy = sighted(position, rotation, rng)
    found = adjusted(picture, point, xy, logged(position, rotation, rng), PosePrior.of(None))
    assert found.refused is None
    assert found.prior.estimated
    scatter = 1 / np.sqrt(6 * pictures)
    assert found.prior.white[0] == pytest.approx(PRIOR.white[0], rel=0.1 + 3 * scatter)
    assert found.prior.white[1] == pytest.approx(PRIOR.white[1], rel=0.1 + 3 * scatter)


@pytest.mark.parametrize("seed", range(2))
def test_logs_that_are_off_by_many_pixels_are_adjusted_too(seed: int) -> None:
    """Take errors that nobody stated, new in every pose: 0.15 m and 0.8 deg (11 px), with 10 % wrong points.

    With a narrow loss alone, neither of these two converges. Right ones leave the points' own 0.3 px.
    """
    rng = np.random.default_rng(seed)
    position, rotation = flown(60, 3.0)
    picture, point, xy = sighted(position, rotation, rng)
    wrong = rng.random(len(xy)) < 0.1
    xy[wrong] += rng.normal(0, 20 / FOCAL, (int(wrong.sum()), 2))
    error = rng.normal(0, 1, (60, 6)) * np.repeat([0.15, np.radians(0.8)], 3)
    turned = matrix_from_quaternion(quaternion_from_rotation_vector(error[:, 3:]))
    found = adjusted(picture, point, xy, (position + error[:, :3], rotation @ turned), PosePrior.of(None))
    assert found.refused is None
    assert found.reprojection_px < 0.6
    assert found.prior.white[1] == pytest.approx(np.radians(0.8), rel=0.1 + 3 / np.sqrt(360))


@pytest.mark.parametrize(("way_m", "every"), [(0.0, 1), (0.3, 1), (12.0, 1), (12.0, 10)])
def test_covariances_hold_for_hovering_and_flying_cameras(way_m: float, every: int) -> None:
    """Compare e' C^-1 e / 6 with its mean 1.

    A flight's constant errors are 6 numbers, so the mean over flights scatters by sqrt(2 / 6 / flights) at
    most. Points err by the 1 px that is assumed.
    """
    flights = 6
    values = []
    for seed in range(flights):
        rng = np.random.default_rng(seed)
        position, rotation = flown(60, way_m, turn_deg=60.0)
        seen = sighted(position, rotation, rng, noise_px=1.0)
        found = adjusted(*seen, logged(position, rotation, rng, every), alike=every)
        assert found.refused is None
        values.append(nees(found, position, rotation))
    assert np.mean(values) == pytest.approx(1.0, abs=3 * np.sqrt(2 / 6 / flights))


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("way_m", [0.0, 8.0])
def test_errors_that_wander_faster_than_the_knots_do_not_spoil_attitudes(way_m: float, known: bool) -> None:
    """Expect the changing part of attitudes better than the log's by far, and covariances that hold.

    Between knots half a second apart they stray by 0.3 sqrt(2 / 2 * 0.5 / 6) = 0.09 deg, 1.1 px, which 0.3 px
    of 100 points show in every picture. What is left is the drift of tracks, 0.002 deg each, and the constant
    part seen from a camera that turns by 20 deg, up to 0.1 deg. The few flights double e' C^-1 e at most.
    """
    wandering = (
        Process(SHIFT_IN_WORLD, 0.05, correlation_s=2.0),
        Process(ROTATION, np.radians(0.3), correlation_s=2.0),
    )
    prior = PosePrior.of(PoseErrors((0.0, 0.0), wandering) if known else None)
    model = GaussMarkov(position_m=0.05, rotation_deg=0.3, correlation_s=2.0)
    before: list[float] = []
    after: list[float] = []
    squares: list[float] = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        position, rotation = flown(120, way_m, turn_deg=20.0)
        seen = sighted(position, rotation, rng)
        moved, turned = disturb(
            [model], np.arange(120) * 10**9 // 30, position, quaternion_from_matrix(rotation), rng
        )
        found = adjusted(*seen, (moved, matrix_from_quaternion(turned)), prior)
        assert found.refused is None
        for errors, attitudes in ((before, matrix_from_quaternion(turned)), (after, found.rotation)):
            off = errors_deg(attitudes, rotation)
            errors.append(float(np.mean((off - off.mean(axis=0)) ** 2)))
        squares.append(nees(found, position, rotation))
    assert np.mean(after) < np.mean(before) / 9
    assert np.mean(squares) < 2


def test_the_errors_that_remain_are_described_over_time() -> None:
    """Compare the parts with errors of many flights: constant, and new in every picture, of attitudes.

    Points err by the 1 px that is assumed. The constants of six flights are 18 numbers.
    """
    constant, fresh, stated = [], [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        position, rotation = flown(90, 12.0, turn_deg=60.0)
        picture, point, xy = sighted(position, rotation, rng, noise_px=1.0)
        found = adjusted(picture, point, xy, logged(position, rotation, rng))
        assert found.left is not None
        errors = errors_deg(found.rotation, rotation)
        constant.append(errors.mean(axis=0))
        fresh.append(np.diff(errors, axis=0))
        (steady,) = [of.sigma0 for of in found.left.processes if of.number == ROTATION and of.constant]
        stated.append(np.degrees([steady, found.left.white[1]]))
    sizes = np.sqrt([np.mean(np.square(constant)), np.mean(np.square(fresh)) / 2])
    ratio = np.mean(stated, axis=0) / sizes
    assert ratio[0] == pytest.approx(1.0, abs=3 / np.sqrt(2 * 18))
    assert ratio[1] == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("lost", [0.0, 0.1])
def test_attitudes_come_out_of_the_background(lost: float) -> None:
    """Expect a third of the log's 0.6 deg, twice the accuracy that the way allows.

    Over half of the 12 m of way, positions err by 0.02 m / sqrt(10) at each end, so its course is known to
    0.1 deg. Points lost on the way change little.
    """
    found, truth, before, _, at = refined(12.0, 1, lost)
    assert found.refused is None
    assert found.reprojection_px < 0.6
    logged_deg, left_deg = (np.sqrt(np.mean(turns_deg(of, truth) ** 2)) for of in (before, found.rotation))
    assert left_deg < logged_deg / 3
    # Paths are not moved: the constant part of the positions' errors stays.
    np.testing.assert_allclose((found.position - at).mean(axis=0), 0, atol=0.02)
    assert (found.covariance[:, range(3), range(3)] >= PRIOR.constant[0] ** 2).all()
    # What modes say is part of the covariance, and for attitudes, which change slowly, most of it.
    own, within = found.covariance[:, 3:, 3:], found.modes[:, 3:] @ found.modes[:, 3:].swapaxes(1, 2)
    assert (np.linalg.eigvalsh(own - within) > -1e-9 * np.trace(own, axis1=1, axis2=2)[:, None]).all()
    assert np.trace(within, axis1=1, axis2=2).mean() > 0.5 * np.trace(own, axis1=1, axis2=2).mean()


def test_a_straight_way_tells_nothing_of_a_turn_about_itself() -> None:
    """Keep the log's rotation about the way, here the camera's x axis, and find the other two."""
    rng = np.random.default_rng(7)
    position, rotation = flown(40, 12.0, turn_deg=0.0)
    picture, point, xy = sighted(position, rotation, rng)
    found = adjusted(picture, point, xy, logged(position, rotation, rng))
    assert found.refused is None
    sigma = np.sqrt(np.diagonal(found.covariance[:, 3:, 3:], axis1=1, axis2=2).mean(axis=0))
    # Over 40 poses the white part averages out (0.2 deg / sqrt(40)), the constant part does not.
    assert np.degrees(sigma[0]) == pytest.approx(0.3, rel=0.1)
    assert np.degrees(sigma[1:]).max() < 0.15


def test_a_log_that_the_pictures_contradict_is_kept_and_named() -> None:
    rng = np.random.default_rng(4)
    position, rotation = flown(40, 12.0)
    picture, point, xy = sighted(position, rotation, rng)
    askew = matrix_from_quaternion(quaternion_from_rotation_vector(np.radians(rng.normal(0, 3, (40, 3)))))
    found = adjusted(picture, point, xy, (position, rotation @ askew))
    assert "standard deviations from the log" in str(found.refused)


@pytest.mark.parametrize("stated", [ERRORS, PoseErrors(ERRORS.white, ())], ids=["0.3 deg", "none"])
def test_a_constant_error_far_beyond_what_is_stated_is_believed_of_pictures(stated: PoseErrors) -> None:
    rng = np.random.default_rng(4)
    position, rotation = flown(60, 12.0)
    wrong = rotation @ matrix_from_quaternion(quaternion_from_rotation_vector(np.radians([0.0, 5.0, 0.0])))
    found = adjusted(*sighted(position, rotation, rng), (position, wrong), PosePrior.of(stated))
    off = errors_deg(found.rotation, rotation).mean(axis=0)
    sigmas = np.radians(off) / np.sqrt(np.diagonal(found.covariance[:, 3:, 3:].mean(axis=0)))
    assert np.abs(off).max() < 0.3
    assert sigmas @ sigmas < 16  # of three numbers, 1 in 1000


def test_points_that_move_against_each_other_are_refused() -> None:
    rng = np.random.default_rng(4)
    position, rotation = flown(40, 12.0)
    picture, point, xy = sighted(position, rotation, rng)
    xy += rng.normal(0, 4 / FOCAL, xy.shape)
    found = adjusted(picture, point, xy, logged(position, rotation, rng))
    assert "px" in str(found.refused)


def test_poses_do_not_jump_where_a_stretch_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare with stretches that do not overlap: each takes the path where its own log's errors are 0.

    Handed over in 30 pictures, that difference is 1.5 / 30 of it from one picture to the next, at most.
    """
    monkeypatch.setattr(background, "STRETCH", 150)
    rng = np.random.default_rng(9)
    position, rotation = flown(300, 12.0)
    picture, point, xy = sighted(position, rotation, rng)
    wander = GaussMarkov(position_m=0.3, rotation_deg=0.5, correlation_s=5.0)
    models = (White(position_m=0.02, rotation_deg=0.2), wander)
    t_ns = np.arange(300) * 10**9 // 30
    at, quaternion = disturb(models, t_ns, position, quaternion_from_matrix(rotation), rng)
    logs = at, matrix_from_quaternion(quaternion)
    prior = PosePrior.of(pose_errors(models))
    smooth = adjusted(picture, point, xy, logs, prior)
    monkeypatch.setattr(background, "_REACH", 1000)
    apart = adjusted(picture, point, xy, logs, prior)
    assert smooth.refused is None
    steps, jumps = (np.linalg.norm(np.diff(of.position - position, axis=0), axis=1) for of in (smooth, apart))
    usual = np.percentile(jumps, 95)
    assert jumps[149] > 10 * usual
    assert steps[134:164].max() < usual + 1.5 / 30 * jumps[149] + usual
    assert (np.linalg.eigvalsh(smooth.covariance) > 0).all()


@pytest.mark.parametrize(("posed", "reason"), [(True, "share fewer"), (False, "a pose")])
def test_a_camera_of_which_nothing_is_seen_keeps_its_logged_poses(posed: bool, reason: str) -> None:
    """Keep logged poses in fog or at night, or for a video taken before the log began."""
    position, rotation = flown(40, 12.0)
    position = position if posed else np.full_like(position, np.nan)
    nothing = np.empty(0, np.int64)
    found = adjusted(nothing, nothing, np.empty((0, 2)), (position, rotation))
    assert found.refused is not None
    assert reason in found.refused
    np.testing.assert_array_equal(found.position, position)
    assert np.isnan(found.covariance).all()


def test_a_point_behind_all_of_its_pictures_spoils_nothing() -> None:
    rays, sides = np.zeros((3, 2)), np.eye(3)[None, :2].copy()
    seen = BackgroundSightings(np.array([0, 3]), np.arange(3), rays, 1e-3)
    points = BackgroundPoints(np.zeros((1, 3)), np.array([[0.0, 0.0, -1.0]]), np.full(1, 0.05), sides)
    place, turned, prior = np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1)), np.array([0.0, 0.01])
    band, force, missed, kept = np.zeros((18, 18)), np.zeros(18), np.zeros(3), np.zeros((1, 12))
    eliminate_points(seen, points, place, turned, 1.0, prior, 8, 6 * np.arange(3), band, force, missed, kept)
    np.testing.assert_array_equal(points.direction, [[0.0, 0.0, -1.0]])
    assert np.isfinite(points.inverse_depth).all()
    assert not band.any()
    assert not force.any()
    assert np.isnan(missed).all()
    assert np.isfinite(kept).all()


def test_pictures_without_a_pose_stay_without() -> None:
    rng = np.random.default_rng(5)
    position, rotation = flown(40, 12.0)
    picture, point, xy = sighted(position, rotation, rng)
    at, turned = logged(position, rotation, rng)
    at[10], turned[10] = np.nan, np.nan
    found = adjusted(picture, point, xy, (at, turned))
    assert found.refused is None
    assert np.isnan(found.position[10]).all()
    assert np.isfinite(np.delete(found.position, 10, axis=0)).all()


def test_points_are_followed_and_people_left_out() -> None:
    """Follow a textured plane that moves by (3, 1) px a picture, with a person's box to leave out."""
    rng = np.random.default_rng(6)
    texture = cv2.GaussianBlur(rng.integers(0, 256, (400, 500), dtype=np.uint8), (0, 0), 2)
    texture = cv2.normalize(texture, np.empty_like(texture), 0, 255, cv2.NORM_MINMAX)
    pictures: list[NDArray[np.uint8] | None] = [
        np.ascontiguousarray(texture[40 - k : 280 - k, 60 - 3 * k : 380 - 3 * k]) for k in range(8)
    ]
    pictures[4] = None
    box = np.array([100.0, 60.0, 180.0, 200.0])
    whole = follow(pictures)
    tracks = off_people(whole, np.tile(box, (8, 1, 1)))
    assert len(np.unique(tracks.point)) > 50
    assert set(tracks.picture.tolist()) == {0, 1, 2, 3, 5, 6, 7}
    inside = ((whole.xy > box[:2]) & (whole.xy < box[2:])).all(axis=1)
    assert inside.any()
    # A track ends in the box: the points that leave it again stay away.
    kept = set(zip(tracks.picture.tolist(), tracks.point.tolist(), strict=True))
    for row, point in zip(whole.picture[inside].tolist(), whole.point[inside].tolist(), strict=True):
        assert not any((later, point) in kept for later in range(row, 8))
    first = {point: (row, xy) for row, point, xy in zip(*_reversed(tracks), strict=True)}
    moved = [
        (row - first[point][0], xy - first[point][1])
        for row, point, xy in zip(tracks.picture.tolist(), tracks.point.tolist(), tracks.xy, strict=True)
    ]
    # Flow is good to a tenth of a pixel; 3 pictures in a row at most before one is missing.
    for steps, by in moved:
        np.testing.assert_allclose(by, [3.0 * steps, 1.0 * steps], atol=0.3)
    # Nothing is followed over a picture that is missing.
    assert all((steps <= 3) for steps, _ in moved)


def _reversed(tracks: object) -> tuple[list[int], list[int], Float]:
    picture, point, xy = (getattr(tracks, name)[::-1] for name in ("picture", "point", "xy"))
    return picture.tolist(), point.tolist(), xy


def test_stated_models_say_what_is_new_what_changes_and_what_is_constant() -> None:
    wander = Process(ROTATION, 0.01, correlation_s=5.0)
    errors = PoseErrors((0.02, 0.003), (Process(SHIFT_IN_WORLD, 0.3), Process(ROTATION, 0.04), wander))
    prior = PosePrior.of(errors)
    assert (prior.white, prior.constant) == ((0.02, 0.003), (0.3, 0.04, 0.0))
    assert prior.slow[1] == wander
    np.testing.assert_allclose(prior.level, [np.hypot(0.02, 0.3), np.sqrt(0.003**2 + 0.04**2 + 0.01**2)])


@pytest.mark.parametrize("shutter", ["global", "rolling", "rolling, not stated"])
def test_a_rolling_shutter_does_not_bend_the_background(shutter: str) -> None:
    """A camera that turns and nods at up to 34 and 26 deg/s, read in 30 ms: rows differ by up to 1.4 deg.

    Unstated, the picture is stretched and compressed by up to 26 deg/s x 15 ms = 0.4 deg at its edges. With
    the readout, what changes of the attitudes' errors is as small as with a global shutter, beside the way's
    positions that err by 0.02 m / sqrt(30) in a second of 4 m: 0.05 deg.
    """
    readout_s = 0.0 if shutter == "global" else 0.03
    lens = Intrinsics(1280, 720, FOCAL, FOCAL, 639.5, 359.5, readout_s=readout_s)
    rng = np.random.default_rng(8)
    points = rng.uniform([-40, -20, 0], [30, 40, 0.2], (900, 3))
    points[::4, 2] = rng.uniform(0, 5, len(points[::4]))
    fine = 3001  # poses a millisecond apart
    way, turned = flown(fine, 12.0)
    nod = np.radians(6.0) * np.sin(2 * np.pi * 0.7 * np.arange(fine) / 1e3)
    turned = turned @ matrix_from_quaternion(quaternion_from_rotation_vector(nod[:, None] * [1.0, 0.0, 0.0]))
    stamps = np.arange(100, 2900, 33)
    delay_s = np.zeros((len(stamps), len(points)))
    for _ in range(6):
        at = stamps[:, None] + 1e3 * delay_s
        share = (at % 1)[..., None]
        seen = [
            np.einsum("tnji,tnj->tni", turned[row], points[None] - way[row])
            for row in (at.astype(int), at.astype(int) + 1)
        ]
        away = seen[0] + share * (seen[1] - seen[0])
        xy = FOCAL * away[..., :2] / away[..., 2:] + [lens.cx, lens.cy]
        inside = (away[..., 2] > 1) & (xy > 0).all(axis=-1) & (xy < [1279, 719]).all(axis=-1)
        delay_s = np.where(inside, row_delay_s(xy[..., 1], lens), 0.0)
    picture, point = np.nonzero(inside)
    tracks = Tracks(picture, point, xy[inside] + rng.normal(0, 0.3, (len(point), 2)))
    position, rotation = logged(way[stamps], turned[stamps], rng)
    if shutter == "rolling, not stated":
        lens = replace(lens, readout_s=0.0)
    t_ns = stamps * 10**6
    nobody = Detections(
        ("nose",), *(np.empty(0, np.int64),) * 2, np.empty((0, 1, 2)), np.empty((0, 1)), np.empty(0, np.int64)
    )
    camera = Camera(
        "drone1",
        lens,
        np.arange(len(t_ns)),
        t_ns,
        np.ones(len(t_ns), bool),
        Trajectory(t_ns[3:], position[3:], quaternion_from_matrix(rotation[3:])),  # begins after the film
        static=False,
        sigma=None,
        detections=nobody,
    )
    between = Interpolation(max_gap_s=1.0, max_extrapolation_s=0.0)
    followed = {"drone1": Followed(np.arange(len(t_ns)), np.zeros(1, np.int64), [lambda: tracks])}
    (found,), entries, _ = refine_cameras([camera], followed, [ERRORS], between=between)
    left = errors_deg(matrix_from_quaternion(found.trajectory.quaternion_xyzw), turned[stamps[3:]])
    assert entries["drone1"]["used"]
    sigma_deg = entries["drone1"]["rotation_sigma_deg"]
    assert 0.0 < sigma_deg["background"] < sigma_deg["log"]
    changing_deg = float(np.std(left - left.mean(axis=0)))
    assert changing_deg > 0.08 if shutter == "rolling, not stated" else changing_deg < 0.04


@pytest.mark.parametrize("places", [Bias(position_m=1.5), GaussMarkov(position_m=1.5, correlation_s=100)])
def test_a_bias_of_40_deg_is_found_beside_white_errors_that_nobody_stated(places: NoiseModel) -> None:
    rng = np.random.default_rng(3)
    position, rotation = flown(60, 8.0)
    at, turned = logged(position, rotation, rng)
    wrong = turned @ matrix_from_quaternion(quaternion_from_rotation_vector(np.radians([24.0, -28.0, 18.0])))
    stated = PosePrior.of(pose_errors([places, Bias(rotation_deg=20)]))
    found = adjusted(*sighted(position, rotation, rng), (at + 1.5, wrong), stated)
    assert found.left is not None, found.refused
    assert sum(each.sigma0**2 for each in found.left.processes if each.number == SHIFT_IN_WORLD) > 2.1
    # Places that drift by 0.2 m in a second may turn a way of 8 m by 2 deg.
    assert np.abs(errors_deg(found.rotation, rotation).mean(axis=0)).max() < 1.0


def test_an_unstated_lever_arm_leaves_an_attitude_uncertain() -> None:
    """Round an arc of 60 deg, 0.15 m along the camera's axes look like an attitude error of 0.5 deg."""
    azimuth = np.radians(np.linspace(0, 60, 240))
    forward = np.stack([-np.cos(azimuth), -np.sin(azimuth), np.full(240, -0.5)], axis=1)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=2)
    position = 8 * np.stack([np.cos(azimuth), np.sin(azimuth), np.full(240, 0.5)], axis=1)
    rng = np.random.default_rng(4)
    picture, point, xy = sighted(position, rotation, rng)
    arm = rotation @ np.array([0.1, -0.05, 0.1])
    found = adjusted(picture, point, xy, (position + arm, rotation), PosePrior.of(None))
    assert found.left is not None, found.refused
    constant = [p.sigma0 for p in found.left.processes if p.number == ROTATION and p.constant]
    error = errors_deg(found.rotation, rotation).mean(axis=0)
    assert np.linalg.norm(error) < 4 * np.degrees(np.linalg.norm(constant))
