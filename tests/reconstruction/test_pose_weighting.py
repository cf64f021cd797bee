"""Covariances where nobody stated the poses' errors, and errors of which only a level is known."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.geometry.arrays import Float
from pipelines.geometry.noise import ROTATION, GaussMarkov, PoseErrors, errors_of_level, pose_errors
from pipelines.geometry.poses import quaternion_from_rotation_vector
from pipelines.geometry.triangulation import STATUS, estimate_noise, triangulate
from pipelines.reconstruction.loading import shared_position_variance
from pipelines.reconstruction.log_stretches import MOST_SIGMA, mend
from pipelines.reconstruction.refinement.refine import Refined, refine
from pipelines.reconstruction.solving import triangulate_widened
from pipelines.session.records import Trajectory
from tests.geometry.rings import ring, turned, with_pixel_noise
from tests.reconstruction.formations import BONES, Formation, formation, mean_mm, triangulated

OK = STATUS.index("ok")


def test_covariances_hold_where_nobody_stated_constant_errors() -> None:
    """Draw flights with constant errors of 0.05 m and 0.3 deg, and white ones of 0.02 m and 0.2 deg.

    The mean NEES is 3. By residuals alone it is 3.7.
    """
    frames, flights = 10, 300
    constant, white = (np.array([m] * 3 + [np.radians(deg)] * 3) for m, deg in ((0.05, 0.3), (0.02, 0.2)))
    truth, exact = ring(frames, 3)
    mean, inside = np.empty(flights), np.empty(flights)
    for flight in range(flights):
        rng = np.random.default_rng(flight)
        error = constant * rng.standard_normal((1, 3, 6)) + white * rng.standard_normal((frames, 3, 6))
        position, rotation = exact.position + error[..., :3], turned(exact.rotation, error[..., 3:])
        views = with_pixel_noise(replace(exact, position=position, rotation=rotation), rng)
        views = replace(views, pixel_sigma=estimate_noise(views))
        found = triangulate_widened(views, solve=partial(triangulate, method="robust"))
        off = (found.points - truth)[found.status == OK]
        information = np.linalg.inv(found.covariance[found.status == OK])
        squared = np.einsum("ni,nij,nj->n", off, information, off)
        mean[flight], inside[flight] = squared.mean(), (squared < 7.815).mean()  # 95 % of chi-square
    assert mean.mean() == pytest.approx(3, abs=3 * mean.std() / np.sqrt(flights))
    assert inside.mean() > 0.9


def test_a_level_alone_becomes_half_new_and_half_lasting_errors() -> None:
    errors = errors_of_level(np.array([0.3, 0.02]))
    found = np.square(errors.white)
    for process in errors.processes:
        assert process.constant
        found[1 if process.number == ROTATION else 0] += process.sigma0**2
    np.testing.assert_allclose(np.sqrt(found), [0.3, 0.02])


def test_receivers_share_half_of_their_variance() -> None:
    """The mean of C errors with variance v, each pair of which has v / 2 in common, has v (1 + 1 / C) / 2."""
    satellites, other = (
        pose_errors([GaussMarkov(position_m=1.5, rotation_deg=1.0, correlation_s=s)]) for s in (100.0, 10.0)
    )
    for count in (1, 2, 5):
        mean = 1.5**2 / count + shared_position_variance([satellites] * count)
        assert mean == pytest.approx(1.5**2 * (1 + 1 / count) / 2)
    assert not any(shared_position_variance([satellites, beside]) for beside in (other, None))


SECONDS, RATE_HZ = 8.0, 50


def flown(noise_m: float = 0.01, speed_mps: float = 1.0) -> Trajectory:
    """Fly along a slightly bent line and turn meanwhile, with white noise."""
    rng = np.random.default_rng(0)
    t_s = np.arange(0, SECONDS, 1 / RATE_HZ)
    place = np.stack([speed_mps * t_s, 0.05 * speed_mps * t_s**2, 5 + 0 * t_s], axis=1)
    turn = np.stack([0 * t_s, 0 * t_s, 0.2 * speed_mps * t_s], axis=1)
    turn += 0.1 * noise_m * rng.standard_normal(turn.shape)
    stamps = np.round(1e9 * t_s).astype(np.int64)
    return Trajectory(
        stamps,
        place + noise_m * rng.standard_normal(place.shape),
        np.asarray(quaternion_from_rotation_vector(turn)),
    )


def held(log: Trajectory, every: int, rows: slice = slice(None)) -> Trajectory:
    """Repeat every k-th pose until the next, in some rows."""
    source = np.arange(len(log.t_ns))
    source[rows] = source[rows.start or 0] + (source[rows] - (rows.start or 0)) // every * every
    return Trajectory(log.t_ns, log.position[source], log.quaternion_xyzw[source])


def off_m(log: Trajectory, truth: Trajectory) -> Float:
    apart: Float = np.linalg.norm(log.position - truth.position, axis=1)
    return apart


def test_a_frozen_stretch_is_bridged_and_loosened() -> None:
    truth = flown()
    frozen = slice(100, 201)
    log = held(truth, 1000, frozen)
    found = mend(log)
    assert (found.frozen, found.jumps, found.poses) == (2, 0, 100)  # positions and rotations
    assert found.longest_s == pytest.approx(101 / RATE_HZ)
    assert off_m(log, truth).max() > 1.9
    assert off_m(found.trajectory, truth).max() < 0.12  # 0.05 m/s^2 of bending, and noise at both ends
    assert found.loosened is not None
    np.testing.assert_allclose(found.loosened[frozen][1:], [MOST_SIGMA] * 100)
    outside = np.ones(len(log.t_ns), dtype=bool)
    outside[frozen] = False
    assert not found.loosened[outside].any()
    np.testing.assert_array_equal(found.trajectory.position[outside], log.position[outside])


@pytest.mark.parametrize("every", [RATE_HZ, RATE_HZ // 5])
def test_a_stepping_log_becomes_a_line_through_its_steps(every: int) -> None:
    truth = flown()
    found = mend(held(truth, every))
    assert found.frozen > 10
    assert off_m(found.trajectory, truth)[: -2 * every].max() < 0.1


@pytest.mark.parametrize("until", [320, 400], ids=["returns late", "stays"])
def test_positions_that_jump_and_stay_are_moved_to_the_origin_of_most_time(until: int) -> None:
    truth, by = flown(), np.array([2.0, -1.0, 0.5])
    away = (np.arange(SECONDS * RATE_HZ) >= 50) & (np.arange(SECONDS * RATE_HZ) < until)
    found = mend(replace(truth, position=truth.position + away[:, None] * by))
    assert (found.jumps, found.steps) == (0, 2 if until < len(away) else 1)
    assert off_m(found.trajectory, replace(truth, position=truth.position + by)).max() < 0.1
    assert found.stepped_m == pytest.approx(
        np.sqrt(by @ by * (1 + SECONDS - until / RATE_HZ) / SECONDS / 3), rel=0.05
    )


def test_a_jump_and_back_is_bridged() -> None:
    truth = flown()
    position = truth.position.copy()
    position[150:220] += [2.0, -1.0, 0.5]
    found = mend(Trajectory(truth.t_ns, position, truth.quaternion_xyzw))
    assert (found.frozen, found.jumps, found.poses) == (0, 1, 70)
    assert off_m(found.trajectory, truth).max() < 0.12


@pytest.mark.parametrize(
    "log",
    [
        flown(),
        flown(noise_m=0.3),
        flown(speed_mps=0.0),
        flown(noise_m=0.0, speed_mps=0.0),
        held(flown(noise_m=0.01, speed_mps=0.0), RATE_HZ),
        replace(flown(speed_mps=5.0), t_ns=10 * flown().t_ns),
        replace(flown(), position=flown(speed_mps=5.0).position + np.eye(400)[:, 88:90] @ [[0.6], [0.6]]),
        Trajectory(flown().t_ns[:1], flown().position[:1], flown().quaternion_xyzw[:1]),
    ],
    ids=["flies", "noisy", "hovers", "stands", "hovers at 1 Hz", "bends at 5 Hz", "glitch", "one pose"],
)
def test_other_logs_are_left_as_they_are(log: Trajectory) -> None:
    found = mend(log)
    assert (found.loosened, found.stepped_m) == (None, 0.0)
    assert found.trajectory is log


CAMERAS, TIMES = 3, 60
GOOD = np.repeat([0.03, np.radians(0.1)], 3)  # of position (m), rotation (rad)
POOR = np.repeat([0.6, np.radians(2.0)], 3)


def disturbed(root: Float, seed: int) -> Formation:
    """Simulate a flight whose pose errors have the logged covariances root root' [C, T, 6, 6]."""
    flight = formation(TIMES, CAMERAS, (), seed)
    drawn = np.random.default_rng(seed).normal(size=root.shape[:3])
    error = np.einsum("ctij,ctj->cti", root, drawn)
    sightings = [
        replace(
            sighting,
            position=sighting.position + off[:, :3],
            rotation=sighting.rotation @ Rotation.from_rotvec(off[:, 3:]).as_matrix(),
            pose_covariance=own @ np.swapaxes(own, 1, 2),
        )
        for sighting, off, own in zip(flight.sightings, error, root, strict=True)
    ]
    return replace(flight, sightings=sightings, start=triangulated(sightings))


def refined(flight: Formation, *, logged: bool) -> Refined:
    """Refine with the covariances (`logged`), or with their level alone."""
    stated = [sighting.pose_covariance for sighting in flight.sightings]
    covariance = np.stack([own for own in stated if own is not None])
    variance = np.diagonal(covariance, axis1=2, axis2=3).mean(axis=(0, 1))
    level = PoseErrors((float(variance[:3].mean() ** 0.5), float(variance[3:].mean() ** 0.5)), (), logged)
    return refine(flight.t_s, flight.sightings, flight.start, BONES, [level] * CAMERAS, np.zeros(CAMERAS))


def test_the_same_covariance_for_all_poses_is_a_level() -> None:
    """Compare up to the constant that keeps inverses finite, (1e-5)^2 against (1e-3)^2 and more."""
    flight = disturbed(np.tile(np.diag(GOOD), (CAMERAS, TIMES, 1, 1)), seed=1)
    own, level = refined(flight, logged=True), refined(flight, logged=False)
    assert own.fallback is None
    np.testing.assert_allclose(own.position, level.position, atol=1e-5)
    np.testing.assert_allclose(own.covariance, level.covariance, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("seed", [1, 2])
def test_good_poses_hold_up_the_poor_ones(seed: int) -> None:
    """Expect a better skeleton if the log states that every other group of poses is twenty times better.

    With equal weights, the mean of N poses errs by 1 / sqrt(2 N) of the poor level. With right weights, it
    errs by 1 / sqrt(N / 2) of the good level, a tenth of that. Motion is estimated too and adds error, so
    the test requires a factor of two.
    """
    poor = (np.arange(TIMES) // 10 + np.arange(CAMERAS)[:, None]) % 2 == 1
    root = np.where(poor[..., None], POOR, GOOD)[..., None] * np.eye(6)
    flight = disturbed(root, seed)
    own, level = refined(flight, logged=True), refined(flight, logged=False)
    assert own.fallback is None
    assert not own.warnings
    assert mean_mm(own.position, flight.truth) < 0.5 * mean_mm(level.position, flight.truth)


def test_correlations_count() -> None:
    """Use correlated errors of position and rotation (a lever arm): one unknown is left of six."""
    arm = np.zeros((6, 6))
    arm[:, 0] = [0.3, 0.2, 0.1, 0.01, 0.02, -0.01]
    arm += np.diag(GOOD / 10)
    flight = disturbed(np.tile(arm, (CAMERAS, TIMES, 1, 1)), seed=3)
    own, level = refined(flight, logged=True), refined(flight, logged=False)
    assert own.fallback is None
    assert mean_mm(own.position, flight.truth) < 0.5 * mean_mm(level.position, flight.truth)
