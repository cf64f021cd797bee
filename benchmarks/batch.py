"""Gain of two workers of a batch over one: the figures of docs/scale.md.

python -m benchmarks.batch [--flights 8] [--seconds 4]

Small flights with keypoints, ingested and reconstructed by `mocap batch` with one worker and with two, in
turns, three times each; into new folders, with kernels compiled before. The table also gives the processor
seconds of the busiest worker. They approximate the wall time on an idle machine without the start of Dask,
also if other work keeps the cores busy. The minimum of three counts.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections import Counter
from pathlib import Path

from pipelines.batch import Settings, batch
from pipelines.session.storage import read_json
from tests.synthetic.flights import write_flight

STAGES = ("ingest", "reconstruct")
TURNS = 3


def main() -> None:
    """Write the flights, run the batches, print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flights", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=4.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        manifests = [
            write_flight(Path(folder) / f"flight{k}", seconds=options.seconds, cameras=3, seed=k).manifest
            for k in range(options.flights)
        ]
        batch(manifests[:1], Path(folder) / "first", Settings(stages=STAGES, method="robust"), workers=1)
        runs: dict[int, list[tuple[float, float, float]]] = {1: [], 2: []}
        for turn in range(TURNS):
            for workers, of_workers in runs.items():
                of_workers.append(run(manifests, Path(folder) / f"out{turn}-{workers}", workers))
    print("| workers | s | cpu s of the busiest worker | cpu s of all |")
    print("| --- | --- | --- | --- |")
    best = {workers: tuple(map(min, zip(*of_workers, strict=True))) for workers, of_workers in runs.items()}
    for workers, (seconds, busiest, total) in best.items():
        print(f"| {workers} | {seconds:.1f} | {busiest:.2f} | {total:.2f} |")
    by_clock, by_cpu = best[1][0] / best[2][0], best[1][1] / best[2][1]
    print(
        f"\n{options.flights} flights of {options.seconds:g} s: {by_clock:.2f} times as fast by the clock,"
        f" {by_cpu:.2f} by the busiest worker (load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores)"
    )


def run(manifests: list[Path], output: Path, workers: int) -> tuple[float, float, float]:
    """Run a batch; return wall seconds, and processor seconds of the busiest worker and of all."""
    started = time.perf_counter()
    done = batch(manifests, output, Settings(stages=STAGES, method="robust"), workers=workers)
    seconds = time.perf_counter() - started
    assert not done.failed
    of_worker: Counter[int] = Counter()
    for flight in read_json(output / "run.json")["flights"]:
        of_worker[flight["worker"]] += sum(stage["cpu"] for stage in flight["seconds"].values())
    assert len(of_worker) == workers
    return seconds, max(of_worker.values()), sum(of_worker.values())


if __name__ == "__main__":
    main()
