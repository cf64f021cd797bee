"""Overhead of the stage `detect` with BlazePose: `python -m benchmarks.detection`.

The lower bound is decoding every picture and running the networks as often as the stage does, back to back,
on as many threads as the stage has workers. The goal is a stage that takes at most 1.15 times as long. Both
take turns on the sample flight (2 cameras, 1280 x 720). The fastest turn of each counts, because other work
on the machine only adds time. The table gives processor seconds too.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import cycle, islice
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from pipelines.detect import detect
from pipelines.formats.videos.video import frames
from pipelines.ingest import ingest
from pipelines.keypoints.blazepose import BlazePose, _Network
from pipelines.session.registries import find_detector
from pipelines.session.stages import locked

SAMPLE = Path(__file__).parent.parent / "sample_data" / "mound_walk"
MOST_TIMES = 1.15
_KEPT = 8  # pictures of each network: enough to see none twice in a row


@dataclass
class Runs:
    """Number of runs of each network (by the side of its input) in the stage, with some of its inputs."""

    count: Counter[int] = field(default_factory=Counter)
    given: dict[int, list[NDArray[np.uint8]]] = field(default_factory=dict)

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Add one run on that picture."""
        side = len(picture)
        self.count[side] += 1
        if len(kept := self.given.setdefault(side, [])) < _KEPT:
            kept.append(picture.copy())


def main() -> None:
    """Print the table of docs/benchmarks.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, help="of the flight (default all 12)")
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mocap-") as name:
        session = Path(name) / "flight.session"
        ingest(SAMPLE / "flight.yaml", session)
        with counted() as runs:  # this run also imports everything
            read = stage(session, 1, arguments.seconds)
        print(f"{sum(read.values())} pictures; networks run by the side of their input: {dict(runs.count)}\n")
        print("| workers | turn | decoding, s (CPU) | networks, s (CPU) | stage, s (CPU) |")
        print("| --- | --- | --- | --- | --- |")
        ratios = []
        for workers in arguments.workers:
            turns = np.empty((arguments.repeats, 3))
            for turn in range(arguments.repeats):
                rows = [
                    taken(decode, read, workers),
                    taken(infer, runs, workers),
                    taken(stage, session, workers, arguments.seconds),
                ]
                written = " | ".join(f"{wall_s:.2f} ({cpu_s:.2f})" for wall_s, cpu_s in rows)
                print(f"| {workers} | {turn + 1} | {written} |", flush=True)
                turns[turn] = [wall_s for wall_s, _ in rows]
            decoding_s, networks_s, stage_s = turns.min(axis=0)
            ratios.append(stage_s / (decoding_s + networks_s))
            shown = f"{decoding_s:.2f} | {networks_s:.2f} | {stage_s:.2f}: {ratios[-1]:.2f} times"
            print(f"| {workers} | fastest | {shown} |", flush=True)
        verdict = "PASS" if max(ratios) <= MOST_TIMES else "FAIL"
        print(f"\n{verdict}: the stage takes at most {max(ratios):.2f} times as long (aim {MOST_TIMES})")


def stage(session: Path, workers: int, seconds: float | None) -> dict[str, int]:
    """Run the stage; return the number of pictures of each camera."""
    with locked(session) as writable:
        record = detect(writable, workers=workers, end_s=seconds, force=True)
    if record is None:
        raise RuntimeError("the sample flight came with keypoints")
    return {name: camera["frames"] for name, camera in record.counts["cameras"].items()}


def decode(read: dict[str, int], workers: int) -> None:
    """Decode as many pictures of each camera, one video per thread."""
    with ThreadPoolExecutor(workers) as pool:
        for _ in pool.map(lambda camera: _decoded(SAMPLE / f"{camera}.mp4", read[camera]), read):
            pass


def _decoded(path: Path, count: int) -> None:
    for _ in frames(path, 0, count):
        pass


def infer(runs: Runs, workers: int) -> None:
    """Run each network as often as it was run, an equal share on each thread."""
    with ThreadPoolExecutor(workers) as pool:
        for _ in pool.map(lambda share: _inferred(runs, share, workers), range(workers)):
            pass


def _inferred(runs: Runs, share: int, of: int) -> None:
    networks = find_detector("blazepose").load(threads=1)
    if not isinstance(networks, BlazePose):
        raise TypeError("blazepose is another detector here")
    for network in (networks._people, networks._landmarks):
        side = network._interpreter.get_input_details()[0]["shape"][1]
        # The network alone: its input was filled before.
        inputs = [np.float32(1 / 255) * picture[None] for picture in runs.given.get(side, [])]
        for picture in islice(cycle(inputs), len(range(share, runs.count[side], of))):
            network._interpreter.set_tensor(network._input, picture)
            network._interpreter.invoke()


@contextmanager
def counted() -> Iterator[Runs]:
    """Count the runs of the networks."""
    runs = Runs()
    call = _Network.__call__

    def counting(network: _Network, picture: NDArray[np.uint8]) -> Any:
        runs.add(picture)
        return call(network, picture)

    with patch.object(_Network, "__call__", counting):
        yield runs


def taken(function: Callable[..., object], *arguments: object) -> tuple[float, float]:
    """Measure wall and processor seconds of a call."""
    started, before = time.perf_counter(), _processor_s()
    function(*arguments)
    return time.perf_counter() - started, _processor_s() - before


def _processor_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
