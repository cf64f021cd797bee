"""How far `refined` is from the information bound, and are its covariances calibrated? Many short flights.

python -m benchmarks.refine_calibration [--noise NAME ...] [--draws N] [--times T] [--cameras N ...]

Simulated: the walk and the formations of `benchmarks.refine`, moving cameras, every flight with keypoint and
pose errors of its own. All joint-frames of a flight share its pose errors, so a flight is one draw: standard
errors are those of the flights' means. What fell back counts as `robust` in errors, and not in NEES.

The bound is what the estimator's own model expects at the truth, with levels as they are: pictures, pose
errors, bones, and accelerations with the covariance that those of the walk have. Its errors are drawn from
that posterior and measured like any others. Two processes; set OPENBLAS_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context

import numpy as np
from numpy.typing import NDArray

from benchmarks.refine import MODELS, refined_of, rooted
from pipelines.geometry.metrics import aligned_distances
from pipelines.geometry.noise import NoiseModel
from pipelines.reconstruction.refinement.building import build
from pipelines.reconstruction.refinement.elimination import System, eliminate, samples
from pipelines.reconstruction.refinement.estimate import BOUND, initial_state
from pipelines.reconstruction.refinement.problem import Knowledge, lay_out, pose_errors
from tests.reconstruction.formations import BONES, STATED_PX, Formation, formation

Float = NDArray[np.float64]

CHI2_95 = 7.8147  # of the chi-square distribution with three degrees of freedom
_PIXEL_PX = 2.0
_LEAST_BONE_M, _LEAST_ACCELERATION = 1e-3, 0.1  # as the estimator's own levels
_EXPECTED = 200  # draws from the posterior at the truth


@dataclass(frozen=True)
class Draw:
    """One flight: RMS errors in mm (absolute, root-relative, PA), squares against the stated covariance."""

    robust_mm: Float  # [3]
    refined_mm: Float  # [3]
    squares: Float | None  # [T, J] e' S^-1 e; None where `refined` fell back


def main() -> None:
    """Print a row for each noise model and number of cameras."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--noise", nargs="*", default=["white", "bias, world", "bias, body", "bias + drift"])
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--times", type=int, default=90, help="frames of each flight, at 30 Hz")
    parser.add_argument("--cameras", type=int, nargs="*", default=[2, 3, 5])
    parser.add_argument("--told", default="right", choices=["right", "nothing"])
    arguments = parser.parse_args()
    print("RMS in mm: absolute / root-relative / PA")
    print(
        "| noise | n | told | flights | fell back | robust | refined | bound | refined / bound"
        " | NEES | within 95 % ellipsoids | CPU s a flight |"
    )
    print("|" + " --- |" * 12)
    with get_context("spawn").Pool(2) as pool:
        for name in arguments.noise:
            for cameras in arguments.cameras:
                one = partial(drawn, name, arguments.times, cameras, arguments.told == "right")
                draws, cpu_s = zip(*pool.imap(one, range(arguments.draws)), strict=True)
                bound = expected_mm(formation(arguments.times, cameras, (), 0), MODELS[name])
                told = f"{name} | {cameras} | {arguments.told}"
                print(f"| {told} | {row_of(draws, bound)} | {np.mean(cpu_s):.1f} |", flush=True)


def drawn(name: str, times: int, cameras: int, told: bool, seed: int) -> tuple[Draw, float]:
    """A flight and its processor time."""
    began = time.process_time()
    flight = formation(times, cameras, MODELS[name], seed, pixel_px=_PIXEL_PX)
    result = refined_of(flight, MODELS[name], told=told)
    robust_mm = errors_mm(flight.start - flight.truth, flight.truth)
    if result.fallback is not None:
        return Draw(robust_mm, robust_mm, None), time.process_time() - began
    error = result.position - flight.truth
    squares: Float = np.einsum("tji,tjik,tjk->tj", error, np.linalg.inv(result.covariance), error)
    return Draw(robust_mm, errors_mm(error, flight.truth), squares), time.process_time() - began


def row_of(draws: Sequence[Draw], bound_mm: Float) -> str:
    """The cells of one noise model."""
    believed = [draw.squares for draw in draws if draw.squares is not None]
    robust, refined = (
        np.sqrt(np.mean(np.square([getattr(draw, f"{method}_mm") for draw in draws]), axis=0))
        for method in ("robust", "refined")
    )
    nees = [float(squares.mean()) for squares in believed]
    within = [100 * float((squares < CHI2_95).mean()) for squares in believed]
    ratio = " / ".join(f"{value:.2f}" for value in refined / bound_mm)
    return (
        f"{len(draws)} | {len(draws) - len(believed)} | {slashed(robust)} | {slashed(refined)}"
        f" | {slashed(bound_mm)} | {ratio} | {with_error(nees, 2)} | {with_error(within, 1)}"
    )


def expected_mm(flight: Formation, models: Sequence[NoiseModel]) -> Float:
    """The information bound [3]: RMS errors that the posterior at the truth expects.

    Args:
        flight: with exact poses.
        models: what the poses are said to be like.
    """
    count = len(flight.sightings)
    exact = []
    for camera, sighting in enumerate(flight.sightings):
        away = flight.truth - flight.position[camera][:, None]
        seen = np.einsum("tji,tkj->tki", flight.rotation[camera], away)
        xy = seen[..., :2] / seen[..., 2:]
        exact.append(
            replace(sighting, xy=xy, position=flight.position[camera], rotation=flight.rotation[camera])
        )
    problem = build(flight.t_s, exact, BONES)
    step_s = float(np.diff(flight.t_s).mean())
    acceleration = np.diff(flight.truth, 2, axis=0) / step_s**2
    covariance = np.einsum("tji,tki->jk", acceleration, acceleration) / (3 * len(acceleration))
    ends = flight.truth[:, BONES]
    lengths = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)
    known = Knowledge(
        poses=(pose_errors(models),) * count,
        clock_sigma_s=np.zeros(count),
        acceleration=covariance + _LEAST_ACCELERATION**2 * np.eye(len(covariance)),
        bone_sigma_m=np.maximum(lengths.std(axis=0), _LEAST_BONE_M),
        size_m=float(lengths.mean()),
        pixel_scale=_PIXEL_PX / STATED_PX,
    )
    layout = lay_out(known.poses, known.clock_sigma_s, len(BONES), problem.knot_t_s)
    system = System(problem, known, layout, BOUND**2)
    at = eliminate(system, initial_state(problem, known, flight.truth))
    drawn_mm = [
        errors_mm(error, flight.truth) for error in samples(system, at, _EXPECTED, np.random.default_rng(0))
    ]
    expected: Float = np.sqrt(np.mean(np.square(drawn_mm), axis=0))
    return expected


def errors_mm(error: Float, truth: Float) -> Float:
    """RMS [3] of errors [T, J, 3] m, where there are any: absolute, root-relative, PA (similarity)."""
    relative = rooted(truth + error) - rooted(truth)
    aligned = aligned_distances(truth + error, truth)
    squares = [np.nanmean(np.sum(error**2, axis=-1)), np.nanmean(np.sum(relative**2, axis=-1))]
    found: Float = 1e3 * np.sqrt([*squares, np.nanmean(aligned**2)])
    return found


def slashed(values: Float) -> str:
    """Three errors in one cell."""
    return " / ".join(f"{value:.0f}" if value >= 100 else f"{value:.1f}" for value in values)


def with_error(values: Sequence[float], digits: int) -> str:
    """Mean of independent values and its standard error."""
    if len(values) < 2:
        return ", ".join(f"{value:.{digits}f}" for value in values)
    error = np.std(values, ddof=1) / np.sqrt(len(values))
    return f"{np.mean(values):.{digits}f} +- {error:.{digits}f}"


if __name__ == "__main__":
    main()
