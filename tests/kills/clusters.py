"""Random flights through all stages on a Dask cluster whose workers are killed, compared with single runs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.batch import STAGES, Job, Settings, run_flight
from tests.commands.runner import MOCAP, content
from tests.keypoints.spotted_flights import spot_detector, write_spotted_flight
from tests.synthetic.flights import write_flight

DASK = str(Path(sys.executable).with_name("dask"))
WORKERS = 2
_FILMED = ("ingest", "reconstruct", "report")  # nobody was logged whom planners could follow
_GIVEN_UP_AFTER = 1000  # deaths of a task's workers: by default 3, which kills every minute soon reach


@dataclass(frozen=True)
class Round:
    """Result of one batch."""

    flights: int
    filmed: bool
    kills: int
    seconds: float
    trouble: str  # empty if every session has the bytes of a single run


class Workers:
    """A scheduler and workers in processes of their own; a killed worker is replaced."""

    def __init__(self, folder: Path) -> None:
        self._stack = ExitStack()
        self._folder = folder
        self._log = self._stack.enter_context((folder / "dask.log").open("w"))
        self._file = folder / "scheduler.json"
        self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        while not self._file.exists():
            time.sleep(0.05)
        self.address: str = json.loads(self._file.read_text(encoding="utf-8"))["address"]
        self._workers = [self._worker() for _ in range(WORKERS)]
        self.spared_s = 0.0  # of batches, until the next worker is killed

    def kill(self, number: int) -> None:
        """Kill a worker and start another one in its place."""
        self._workers[number].kill()
        self._workers[number].wait()
        self._workers[number] = self._worker()

    def close(self) -> None:
        """End all processes."""
        self._stack.close()

    def _worker(self) -> subprocess.Popen[bytes]:
        return self._start(
            *("worker", "--nthreads", "1", "--memory-limit", "0", "--no-nanny", "--no-dashboard"),
            *("--local-directory", str(self._folder)),
        )

    def _start(self, *arguments: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            [DASK, *arguments, "--scheduler-file", str(self._file)],
            env=os.environ | {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": str(_GIVEN_UP_AFTER)},
            stdout=self._log,
            stderr=self._log,
        )
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process


def soak_cluster(minutes: float, *, kill_every_s: float, seed: int) -> Iterator[Round]:
    """Run batches of random flights for so long, the last one to its end; kill a random worker now and then.

    Rounds with keypoints go through all stages. In every other round the flights are filmed, so that
    detection and backgrounds go through the cluster in blocks.
    """
    choice = np.random.default_rng(seed)
    until_s = time.monotonic() + 60 * minutes
    filmed = True
    with tempfile.TemporaryDirectory() as place:
        workers = Workers(Path(place))
        workers.spared_s = _pause_s(kill_every_s, choice)
        try:
            while time.monotonic() < until_s:
                with tempfile.TemporaryDirectory(dir=place) as folder:
                    yield _round(workers, Path(folder), filmed, kill_every_s, choice)
                filmed = not filmed
        finally:
            workers.close()


def _round(
    workers: Workers, folder: Path, filmed: bool, kill_every_s: float, choice: np.random.Generator
) -> Round:
    flights = [_flight(folder / "batch" / f"{k}", filmed, choice) for k in range(int(choice.integers(1, 4)))]
    detector = spot_detector(folder)
    stages = _FILMED if filmed else STAGES
    expected = []
    for flight in flights:
        session = folder / "alone" / f"{flight.parent.name}.session"
        alone = run_flight(Job(flight, session, Settings(stages=stages, detector=detector), force=False))
        assert alone.error is None, alone.error
        expected.append(_results(session))
    command = ["batch", *map(str, flights), "--scheduler", workers.address, "-o", str(folder / "results")]
    started_s, kills = time.monotonic(), 0
    # Its output goes to a file, because a full pipe would stop it.
    with (folder / "output").open("w+") as output:
        process = subprocess.Popen(
            [MOCAP, *command, "--stages", ",".join(stages), "--detector", detector],
            stdout=output,
            stderr=output,
        )
        while True:
            waiting_s = time.monotonic()
            try:
                process.wait(workers.spared_s)
                workers.spared_s = max(0.0, workers.spared_s - (time.monotonic() - waiting_s))
                break
            except subprocess.TimeoutExpired:
                workers.kill(int(choice.integers(WORKERS)))
                workers.spared_s = _pause_s(kill_every_s, choice)
                kills += 1
        output.seek(0)
        said = output.read()
    trouble = "" if process.returncode == 0 else f"exit status {process.returncode}: {said[-500:]}"
    for flight, single in zip(flights, expected, strict=True):
        found = _results(folder / "results" / f"{flight.parent.name}.session")
        differing = {name for name, _ in set(single.items()) ^ set(found.items())}
        if not trouble and differing:
            trouble = f"other bytes: {', '.join(sorted(differing)[:5])}"
    return Round(len(flights), filmed, kills, time.monotonic() - started_s, trouble)


def _pause_s(kill_every_s: float, choice: np.random.Generator) -> float:
    return kill_every_s * float(choice.uniform(0.5, 1.5))


def _flight(folder: Path, filmed: bool, choice: np.random.Generator) -> Path:
    """Write a random flight; return its flight.yaml."""
    folder.mkdir(parents=True)
    if filmed:
        return write_spotted_flight(folder, int(choice.integers(20, 400)))
    seconds, cameras = float(choice.uniform(1.2, 4.0)), int(choice.integers(2, 5))
    return write_flight(folder, seconds=seconds, cameras=cameras, seed=int(choice.integers(2**31))).manifest


def _results(session: Path) -> dict[str, str]:
    """List the results of a session with their hashes."""
    return content(session) if session.exists() else {}


def print_soak(minutes: float, *, kill_every_s: float, seed: int) -> int:
    """Soak a cluster and print every round; return 1 if anything was lost or differs."""
    rounds: list[Round] = []
    for each in soak_cluster(minutes, kill_every_s=kill_every_s, seed=seed):
        rounds.append(each)
        kind = "filmed flights" if each.filmed else "flights with keypoints"
        print(  # noqa: T201
            f"{each.flights} {kind}: {each.seconds:.0f} s, {each.kills} workers killed,"
            f" {each.trouble or 'same bytes'}",
            flush=True,
        )
    troubles = sum(bool(each.trouble) for each in rounds)
    print(  # noqa: T201
        f"{sum(each.flights for each in rounds)} flights in {len(rounds)} batches,"
        f" {sum(each.kills for each in rounds)} workers killed: {troubles} batches made trouble"
    )
    return 1 if troubles else 0
