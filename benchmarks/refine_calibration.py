"""Distance of `refined` from the information bound, and calibration of its covariances, on short flights.

python -m benchmarks.refine_calibration [--noise NAME ...] [--draws N] [--times T] [--cameras N ...]
    [--stated LEVELS]

Simulated: the walk and the formations of `benchmarks.refine`, moving cameras, every flight with its own
keypoint and pose errors. All joint-frames of a flight share its pose errors, so a flight is one draw:
standard errors are those of the flights' means. After a fallback, errors are those of `robust`, and NEES has
no value.

The bound is the expected error of the estimator's own model at the truth, with the true levels: pictures,
pose errors, bones, and accelerations with a covariance. Errors are drawn from that posterior and measured
like any others. There are two bounds. "learned" uses the covariance of accelerations that the estimator
found in the same flight, so the same temporal terms. "known" uses the true covariance of the walk's
accelerations, which cannot be known from a few seconds of it. The flights that fell back, and the reasons,
are printed last.
Two processes; set OPENBLAS_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context

import numpy as np

from benchmarks.refine import MODELS, refined_of, rooted
from pipelines.geometry.arrays import Float
from pipelines.geometry.metrics import aligned_distances
from pipelines.geometry.noise import NoiseModel, pose_errors
from pipelines.reconstruction.refinement.elimination import eliminate, samples
from pipelines.reconstruction.refinement.estimate import BOUND, initial_state
from pipelines.reconstruction.refinement.problem import Knowledge, build, lay_out
from pipelines.reconstruction.refinement.system import System
from tests.reconstruction.formations import BONES, FPS, STATED_PX, Formation, formation

CHI2_95 = 7.8147  # of the chi-square distribution with three degrees of freedom
_PIXEL_PX = 2.0
_LEAST_BONE_M, _LEAST_ACCELERATION = 1e-3, 0.1  # as the estimator's own levels
_EXPECTED, _OF_ONE = 200, 8  # draws from the posterior at the truth, and from that of one flight


@dataclass(frozen=True)
class Draw:
    """Results of one flight: RMS errors (absolute, root-relative, PA), squares over their covariance."""

    robust_mm: Float  # [3]
    refined_mm: Float  # [3]
    bound_mm: Float  # [3] with the learned temporal terms; NaN after a fallback
    squares: Float | None  # [N] e' S^-1 e of the estimated joints; None after a fallback
    fallback: str | None
    cpu_s: float


def main() -> None:
    """Print a row for each noise model and number of cameras."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--noise", nargs="*", default=["white", "bias, world", "bias, body", "bias + drift"])
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--times", type=int, default=90, help="frames of each flight, at 30 Hz")
    parser.add_argument("--cameras", type=int, nargs="*", default=[2, 3, 5])
    parser.add_argument("--stated", default="right", choices=["right", "nothing"])
    arguments = parser.parse_args()
    print("RMS in mm: absolute / root-relative / PA")
    print(
        "| noise | n | stated | flights | fell back | robust | refined | bound, learned | bound, known"
        " | refined / learned | refined / known | NEES | within 95 % ellipsoids | CPU s a flight |"
    )
    print("|" + " --- |" * 14)
    with get_context("spawn").Pool(2) as pool:
        for name in arguments.noise:
            for cameras in arguments.cameras:
                one = partial(drawn, name, arguments.times, cameras, arguments.stated == "right")
                draws = list(pool.imap(one, range(arguments.draws)))
                exact = formation(arguments.times, cameras, (), 0)
                known = expected_mm(exact, MODELS[name], accelerations(exact.truth), _EXPECTED, seed=0)
                print(f"| {name} | {cameras} | {arguments.stated} | {row_of(draws, known)} |", flush=True)
                for seed, draw in enumerate(draws):
                    if draw.fallback is not None:
                        print(f"  flight {seed} fell back: {draw.fallback}", flush=True)


def drawn(name: str, times: int, cameras: int, stated: bool, seed: int) -> Draw:
    """Simulate and refine one flight; its processor time is that of the refinement."""
    flight = formation(times, cameras, MODELS[name], seed, pixel_px=_PIXEL_PX)
    began = time.process_time()
    result = refined_of(flight, MODELS[name], stated=stated)
    cpu_s = time.process_time() - began
    robust_mm = errors_mm(flight.start - flight.truth, flight.truth)
    if result.fallback is not None:
        return Draw(robust_mm, robust_mm, np.full(3, np.nan), None, result.fallback, cpu_s)
    error = result.position - flight.truth
    squares: Float = np.einsum("tji,tjik,tjk->tj", error, np.linalg.inv(result.covariance), error)
    bound_mm = expected_mm(flight, MODELS[name], result.acceleration, _OF_ONE, seed=seed)
    found: Float = squares[np.isfinite(squares)]  # joints with too few triangulated frames are not refined
    return Draw(robust_mm, errors_mm(error, flight.truth), bound_mm, found, None, cpu_s)


def row_of(draws: Sequence[Draw], known_mm: Float) -> str:
    """Format the cells of one noise model."""
    kept = [draw.squares for draw in draws if draw.squares is not None]
    robust, refined, learned = (
        np.sqrt(np.nanmean(np.square([getattr(draw, f"{name}_mm") for draw in draws]), axis=0))
        for name in ("robust", "refined", "bound")
    )
    nees = [float(squares.mean()) for squares in kept]
    within = [100 * float((squares < CHI2_95).mean()) for squares in kept]
    ratios = [" / ".join(f"{value:.2f}" for value in refined / bound) for bound in (learned, known_mm)]
    return (
        f"{len(draws)} | {len(draws) - len(kept)} | {slashed(robust)} | {slashed(refined)}"
        f" | {slashed(learned)} | {slashed(known_mm)} | {' | '.join(ratios)}"
        f" | {with_error(nees, 2)} | {with_error(within, 1)}"
        f" | {np.mean([draw.cpu_s for draw in draws]):.1f}"
    )


def accelerations(position: Float) -> Float:
    """Compute the covariance [J, J] (m/s^2)^2 of the accelerations of joints [T, J, 3] at `FPS`."""
    change = np.diff(position, 2, axis=0) * FPS**2
    covariance: Float = np.einsum("tji,tki->jk", change, change) / (3 * len(change))
    return covariance + _LEAST_ACCELERATION**2 * np.eye(len(covariance))


def expected_mm(
    flight: Formation, models: Sequence[NoiseModel], acceleration: Float, count: int, *, seed: int
) -> Float:
    """Compute the information bound [3] (mm): expected RMS errors under the posterior at the truth.

    Args:
        flight: the flight; its truth is used, its logs and keypoints are not.
        models: noise of the poses.
        acceleration: [J, J] (m/s^2)^2, covariance of the joints' accelerations.
        count: number of draws from the posterior.
        seed: seed of the draws.
    """
    cameras = len(flight.sightings)
    exact = []
    for camera, sighting in enumerate(flight.sightings):
        away = flight.truth - flight.position[camera][:, None]
        seen = np.einsum("tji,tkj->tki", flight.rotation[camera], away)
        xy = seen[..., :2] / seen[..., 2:]
        exact.append(
            replace(sighting, rays=xy, position=flight.position[camera], rotation=flight.rotation[camera])
        )
    problem = build(flight.t_s, exact, BONES)
    ends = flight.truth[:, BONES]
    lengths = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)
    known = Knowledge(
        poses=(pose_errors(models),) * cameras,
        clock_sigma_s=np.zeros(cameras),
        acceleration=acceleration,
        bone_sigma_m=np.maximum(lengths.std(axis=0), _LEAST_BONE_M),
        size_m=float(lengths.mean()),
        pixel_scale=_PIXEL_PX / STATED_PX,
    )
    layout = lay_out(known.poses, known.clock_sigma_s, len(BONES), problem.knot_t_s)
    system = System(problem, known, layout, BOUND**2)
    at = eliminate(system, initial_state(problem, known, flight.truth))
    rng = np.random.default_rng(seed)
    drawn_mm = [errors_mm(error, flight.truth) for error in samples(system, at, count, rng)]
    expected: Float = np.sqrt(np.mean(np.square(drawn_mm), axis=0))
    return expected


def errors_mm(error: Float, truth: Float) -> Float:
    """Compute the RMS [3] (mm) of finite errors [T, J, 3] m: absolute, root-relative, PA (similarity)."""
    relative = rooted(truth + error) - rooted(truth)
    aligned = aligned_distances(truth + error, truth)
    squares = [np.nanmean(np.sum(error**2, axis=-1)), np.nanmean(np.sum(relative**2, axis=-1))]
    found: Float = 1e3 * np.sqrt([*squares, np.nanmean(aligned**2)])
    return found


def slashed(values: Float) -> str:
    """Format three errors in one cell."""
    return " / ".join(f"{value:.0f}" if value >= 100 else f"{value:.1f}" for value in values)


def with_error(values: Sequence[float], digits: int) -> str:
    """Format the mean of independent values and its standard error."""
    if len(values) < 2:
        return ", ".join(f"{value:.{digits}f}" for value in values)
    error = np.std(values, ddof=1) / np.sqrt(len(values))
    return f"{np.mean(values):.{digits}f} +- {error:.{digits}f}"


if __name__ == "__main__":
    main()
