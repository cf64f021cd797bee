"""Are the covariances of `refined` calibrated? NEES and 95 % ellipsoids over many short flights.

python -m benchmarks.refine_calibration [--noise NAME ...] [--draws N] [--times T] [--cameras N] [--told ...]

Simulated: the walk and the formations of `benchmarks.refine`, every flight with keypoint and pose errors of
its own. All joint-frames of a flight share its pose errors, so a flight is one draw: standard errors are
those of the flights' means. Set OPENBLAS_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.refine import MODELS, refined_of
from tests.reconstruction.formations import formation

Float = NDArray[np.float64]

CHI2_95 = 7.8147  # of the chi-square distribution with three degrees of freedom


def main() -> None:
    """Print a row for each noise model."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--noise", nargs="*", default=["white", "bias, world", "bias, body", "bias + drift"])
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--times", type=int, default=90, help="frames of each flight, at 30 Hz")
    parser.add_argument("--cameras", type=int, default=3)
    parser.add_argument("--told", default="right", choices=["right", "nothing"])
    arguments = parser.parse_args()
    print("| noise | n | told | flights | fell back | NEES | within 95 % ellipsoids | CPU s a flight |")
    print("|" + " --- |" * 8)
    for name in arguments.noise:
        began = time.process_time()
        told = arguments.told == "right"
        flights = [
            squares_of(name, seed, arguments.times, arguments.cameras, told=told)
            for seed in range(arguments.draws)
        ]
        took = (time.process_time() - began) / arguments.draws
        believed = [flight for flight in flights if flight is not None]
        nees = [float(flight.mean()) for flight in believed]
        within = [100 * float((flight < CHI2_95).mean()) for flight in believed]
        print(
            f"| {name} | {arguments.cameras} | {arguments.told} | {arguments.draws}"
            f" | {arguments.draws - len(believed)} | {with_error(nees, 2)} | {with_error(within, 1)}"
            f" | {took:.1f} |",
            flush=True,
        )


def squares_of(name: str, seed: int, times: int, cameras: int, *, told: bool) -> Float | None:
    """e' S^-1 e [T, J] of one flight, moving cameras; None where `refined` fell back."""
    models = MODELS[name]
    flight = formation(times, cameras, models, seed)
    result = refined_of(flight, models, told=told)
    if result.fallback is not None:
        return None
    error = result.position - flight.truth
    squares: Float = np.einsum("tji,tjik,tjk->tj", error, np.linalg.inv(result.covariance), error)
    return squares


def with_error(values: Sequence[float], digits: int) -> str:
    """Mean of independent values and its standard error."""
    if len(values) < 2:
        return ", ".join(f"{value:.{digits}f}" for value in values)
    error = np.std(values, ddof=1) / np.sqrt(len(values))
    return f"{np.mean(values):.{digits}f} +- {error:.{digits}f}"


if __name__ == "__main__":
    main()
