"""Accuracy of `refined` compared with `robust`, and its speed, given in docs/measurements-refined.md.

python -m benchmarks.refine [--seeds N] [--times T] [--cameras N ...] [--long T]

BLAS runs on one thread: set OPENBLAS_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Mapping, Sequence

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.geometry.noise import Bias, Drift, GaussMarkov, NoiseModel, White, pose_errors
from pipelines.reconstruction.refinement.refine import Refined, refine
from tests.reconstruction.formations import BONES, Formation, formation, mean_mm

MODELS: Mapping[str, Sequence[NoiseModel]] = {
    "exact": (),
    "white": (White(position_m=0.3, rotation_deg=1.0),),
    "bias, world": (Bias(position_m=0.3, rotation_deg=1.0),),
    "bias, body": (Bias(position_m=0.3, rotation_deg=1.0, frame="body"),),
    "bias + drift": (
        Bias(position_m=0.3, rotation_deg=1.0),
        Drift(position_m_per_sqrt_s=0.03, rotation_deg_per_sqrt_s=0.15),
    ),
    "Gauss-Markov 20 s": (GaussMarkov(position_m=0.3, rotation_deg=1.0, correlation_s=20.0),),
}

PEERS: Mapping[str, tuple[float, float, float]] = {
    "Pose2Sim, best cameras": (6.4, 12.7, 15.3),
    "aniposelib, optimised": (5.2, 7.4, 16.3),
    "aniposelib, with bone lengths": (3.4, 6.5, 14.2),
}
"""Figures of other tools: k joint-frames/s, mean mm with 2 px, and with outliers; not run by this script.

As measured for this project in 2026, once, on another machine, at true poses: 2,250 frames of such a walk,
seen by five such cameras.
"""


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=4, help="flights of the noise table, 0 for none")
    parser.add_argument("--times", type=int, default=300, help="frames of the flights of the noise table")
    parser.add_argument("--cameras", type=int, nargs="*", default=[2, 3, 5])
    parser.add_argument("--long", type=int, default=2250, help="frames of the speed table, 0 for none")
    arguments = parser.parse_args()
    formation_and_refined(60, 3, (), 0, stated=True)  # compiles
    if arguments.long:
        print_speed(arguments.long)
    if arguments.seeds:
        print_noise(arguments.times, arguments.cameras, arguments.seeds)


def print_speed(times: int) -> None:
    """Print time, memory and error on the walk of the peers' table."""
    print(f"{times} frames, 17 joints, 5 cameras, 2 px, true poses\n")
    print("| data | robust mm | refined mm | seconds | CPU s | k joint-frames/s | peak MB |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, share in (("2 px", 0.0), ("outliers", 0.05)):
        flight = formation(times, 5, (), 0, bad_share=share)
        started, busy = time.perf_counter(), time.process_time()
        result = refined_of(flight, (), stated=True, threads=2)
        elapsed, busy = time.perf_counter() - started, time.process_time() - busy
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(
            f"| {name} | {mean_mm(flight.start, flight.truth):.2f}"
            f" | {mean_mm(result.position, flight.truth):.2f}"
            f" | {elapsed:.1f} | {busy:.1f} | {times * 17 / elapsed / 1e3:.1f} | {peak:.0f} |",
            flush=True,
        )
    print(
        "\nPeers, measured for this project in 2026, once, on another machine, at true poses; not run here\n"
    )
    print("| peer | 2 px, mm | outliers, mm | k joint-frames/s |")
    print("| --- | --- | --- | --- |")
    for name, (speed, clean_mm, outliers_mm) in PEERS.items():
        print(f"| {name} | {clean_mm} | {outliers_mm} | {speed} |")


def print_noise(times: int, cameras: Sequence[int], seeds: int) -> None:
    """Print results for every noise model, stated (stated) or not, with hovering and moving cameras."""
    print(f"\n{seeds} flights of {times} frames, 0.3 m / 1 deg, 2 px: mean mm, absolute / root-relative")
    print("| noise | cameras | formation | stated | robust | refined | ratio (worst) | NEES | fell back |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, models in MODELS.items():
        for count in cameras:
            for still in (False, True):
                for stated in (True, False):
                    rows = np.array(
                        [
                            row_of(times, count, models, seed, still=still, stated=stated)
                            for seed in range(seeds)
                        ]
                    )
                    mean = rows.mean(axis=0)
                    ratio = rows[:, 2] / rows[:, 0]
                    kept = rows[rows[:, 5] == 0, 4]
                    nees = f"{kept.mean():.2f}" if len(kept) else ""
                    formed, knows = ("hovering" if still else "moving"), ("yes" if stated else "no")
                    print(
                        f"| {name} | {count} | {formed} | {knows}"
                        f" | {mean[0]:.0f} / {mean[1]:.0f} | {mean[2]:.1f} / {mean[3]:.1f}"
                        f" | {mean[2] / mean[0]:.2f} ({ratio.max():.2f})"
                        f" | {nees}"
                        f" | {rows[:, 5].sum():.0f} |",
                        flush=True,
                    )


def row_of(
    times: int, cameras: int, models: Sequence[NoiseModel], seed: int, *, still: bool, stated: bool
) -> list[float]:
    """Compute errors of `robust` and `refined` (`robust`'s after a fallback), NEES, and fallback (0 or 1)."""
    flight, result = formation_and_refined(times, cameras, models, seed, stated=stated, still=still)
    fell = result.fallback is not None
    position = flight.start if fell else result.position
    nees = np.nan if fell else mean_nees(result, flight.truth)
    return [
        mean_mm(flight.start, flight.truth),
        mean_mm(rooted(flight.start), rooted(flight.truth)),
        mean_mm(position, flight.truth),
        mean_mm(rooted(position), rooted(flight.truth)),
        nees,
        float(fell),
    ]


def formation_and_refined(
    times: int, cameras: int, models: Sequence[NoiseModel], seed: int, *, stated: bool, still: bool = False
) -> tuple[Formation, Refined]:
    """Simulate a flight and refine it."""
    flight = formation(times, cameras, models, seed, still=still)
    return flight, refined_of(flight, models, stated=stated)


def refined_of(flight: Formation, models: Sequence[NoiseModel], *, stated: bool, threads: int = 1) -> Refined:
    """Refine a flight; without stated noise (`stated` False) the refinement estimates the levels itself."""
    count = len(flight.sightings)
    prior = [pose_errors(models)] * count if stated else None
    return refine(flight.t_s, flight.sightings, flight.start, BONES, prior, np.zeros(count), threads=threads)


def rooted(position: Float) -> Float:
    """Return joints relative to the middle of the hips."""
    relative: Float = position - position[:, 11:13].mean(axis=1, keepdims=True)
    return relative


def mean_nees(result: Refined, truth: Float) -> float:
    """Compute the mean of e' S^-1 e; it is 3 for correct covariances."""
    error = result.position - truth
    return float(np.einsum("tji,tjik,tjk->tj", error, np.linalg.inv(result.covariance), error).mean())


if __name__ == "__main__":
    main()
