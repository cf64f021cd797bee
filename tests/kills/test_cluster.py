"""`mocap batch` on a cluster of processes, one of which is killed: nothing is lost, bytes are the same."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pandas as pd
import pytest

from tests.commands.runner import MOCAP, content, succeeds
from tests.keypoints.spotted_flights import spot_detector, write_spotted_flight
from tests.synthetic.flights import write_flight

DASK = str(Path(sys.executable).with_name("dask"))
FEW_STAGES = "ingest,reconstruct"


class Cluster:
    """A Dask scheduler and two workers, each in its own process, connected by TCP."""

    def __init__(self, folder: Path) -> None:
        self._stack = ExitStack()
        self._log = self._stack.enter_context((folder / "dask.log").open("w"))
        file = folder / "scheduler.json"
        self._start(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", file
        )
        while not file.exists():
            time.sleep(0.05)
        self.address: str = json.loads(file.read_text(encoding="utf-8"))["address"]
        self.workers = [
            self._start(
                *("worker", "--scheduler-file", file, "--nthreads", "1", "--memory-limit", "0"),
                *("--no-nanny", "--no-dashboard", "--local-directory", folder),
            )
            for _ in range(2)
        ]

    def _start(self, *arguments: str | Path) -> subprocess.Popen[bytes]:
        process = subprocess.Popen([DASK, *map(str, arguments)], stdout=self._log, stderr=self._log)
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process

    def close(self) -> None:
        self._stack.close()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    made = Cluster(tmp_path)
    yield made
    made.close()


def flights_and_single_runs(folder: Path, detector: str) -> tuple[list[Path], list[dict[str, str]]]:
    """Write a flight with keypoints and one with videos, and return the results of single runs on copies.

    The first result are their manifests, in separate folders.
    """
    manifests, single = [], []
    for k in range(2):
        for place in ("alone", "batch"):
            (own := folder / place / f"day{k}").mkdir(parents=True)
            if k:
                write_spotted_flight(own, 20)
            else:
                write_flight(own, seconds=0.4)
        session = folder / "alone" / f"day{k}" / "flight.session"
        succeeds("ingest", folder / "alone" / f"day{k}" / "flight.yaml")
        succeeds("reconstruct", session, "--detector", detector)
        single.append(content(session))
        manifests.append(own / "flight.yaml")
    return manifests, single


@pytest.mark.long
def test_cluster_makes_the_bytes_of_single_runs_and_a_killed_worker_loses_nothing(
    tmp_path: Path, cluster: Cluster
) -> None:
    detector = ("--detector", spot_detector(tmp_path))
    manifests, single = flights_and_single_runs(tmp_path, detector[1])
    (manifests[1].parent / "broken.yaml").write_text("schema: 1\nname: [", encoding="utf-8")
    pattern = tmp_path / "batch" / "*" / "*.yaml"  # no shell expands it
    command = ["batch", str(pattern), "--scheduler", cluster.address, "--stages", FEW_STAGES, *detector]
    process = subprocess.Popen(
        [MOCAP, *command], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    # The first worker that holds a session dies there and then.
    numbers = {worker.pid: worker for worker in cluster.workers}
    killed = None
    while killed is None and process.poll() is None:
        for holder in (tmp_path / "batch").glob("*/flight.session/.lock.pid"):
            with suppress(OSError, ValueError):
                killed = numbers[int(holder.read_text())]
                os.kill(killed.pid, signal.SIGKILL)
                break
        time.sleep(0.01)
    _, told = process.communicate(timeout=600)
    assert killed is not None, told
    assert killed.wait() == -signal.SIGKILL

    assert process.returncode == 1
    failed, counted = told.strip().splitlines()[-2:]
    assert failed.startswith("failed: batch/day1/broken.yaml: ")
    assert re.findall(r"\d+", counted) == ["1", "3"]
    assert [content(manifest.with_suffix(".session")) for manifest in manifests] == single

    table = pd.read_csv(tmp_path / "batch" / "summary.csv").set_index("flight")
    assert list(table["status"]) == ["done", "failed", "done"]
    metrics = json.loads((manifests[0].parent / "flight.session/reconstruct/metrics.json").read_text())
    for name in ("reconstructed_share", "mpjpe_mm"):
        assert table.loc["day0/flight.yaml", name] == metrics[name]

    # The same again, now on a cluster that this machine makes for itself, finds all done, and is silent.
    (manifests[1].parent / "broken.yaml").unlink()
    local = [MOCAP, "batch", str(pattern), "--workers", "1", "--stages", FEW_STAGES, "--json", *detector]
    again = subprocess.run(local, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False)
    assert (again.returncode, again.stderr) == (0, "")
    counts = json.loads(again.stdout)
    assert (counts["flights"], counts["failed"], counts["unchanged"]) == (2, 0, 2)
