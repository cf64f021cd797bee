"""`mocap batch`: many flights on Dask, with the same results as single runs."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from pipelines import batch
from pipelines import detect as detection
from pipelines.batch import BatchSettings, Job, run_flight
from pipelines.detect import Following, detect
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.reconstruction import refining
from pipelines.session.parallel import connected
from pipelines.session.registries import install_command
from pipelines.session.stages import locked
from tests.commands.runner import MOCAP, content, mocap, refused, succeeds
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


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    made = Cluster(tmp_path_factory.mktemp("dask"))
    yield made
    made.close()


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """Start a scheduler with a worker in a thread of this process; return its address."""
    from distributed import LocalCluster

    options = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "dashboard_address": None}
    with LocalCluster(**options) as made:  # type: ignore[no-untyped-call]
        yield str(made.scheduler_address)


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


def test_blocks_of_a_flight_make_the_same_bytes_here_on_processes_and_on_a_cluster(
    tmp_path: Path, scheduler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(detection, "BLOCK", 10)
    monkeypatch.setattr(detection, "MIN_PICTURES_FOR_PROCESSES", 0)
    monkeypatch.setattr(detection, "MIN_FOLLOWED_FOR_PROCESSES", 0)
    manifest = write_spotted_flight(tmp_path, 25)
    here, processes, there, apart = (tmp_path / f"{name}.session" for name in "abcd")
    succeeds("ingest", manifest, "-o", here)
    for copy in (processes, there, apart):
        shutil.copytree(here, copy)
    detector = spot_detector(tmp_path)

    def found(folder: Path, *, workers: int = 1, executor: Executor | None = None) -> dict[str, str]:
        with locked(folder) as session:
            following = Following(session)
            detect(session, detector=detector, following=following, workers=workers, executor=executor)
            following.finish(workers=workers, executor=executor)
        return content(folder)

    expected = found(here)
    assert found(processes, workers=2) == expected
    with connected(scheduler) as client:
        executor = client.get_executor(pure=False)
        assert found(there, executor=executor) == expected
        with locked(apart) as session:  # backgrounds without keypoints
            Following(session).finish(executor=executor)
    assert content(apart / "background") == content(here / "background")


def test_windows_of_a_long_flight_on_a_cluster_make_the_bytes_of_one_process(
    tmp_path: Path, scheduler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"MAX_WINDOW_S": 1.0, "OVERLAP_S": 0.5, "BLENDED_S": 0.3}.items():
        monkeypatch.setattr(refining, name, value)
    manifest = write_flight(tmp_path, seconds=1.8).manifest
    here, there = tmp_path / "here.session", tmp_path / "there.session"
    succeeds("ingest", manifest, "-o", here)
    shutil.copytree(here, there)
    settings = ReconstructSettings(method="refined")
    reconstruct(here, settings, workers=1)
    with connected(scheduler) as client:
        reconstruct(there, settings, executor=client.get_executor(pure=False))
    assert content(there / "reconstruct") == content(here / "reconstruct")


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


@pytest.mark.slow
def test_all_stages_of_a_flight_are_those_of_the_commands(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, seconds=1.2)
    session = tmp_path / "flight.session"
    outcome = run_flight(Job(flight.manifest, session, BatchSettings(), force=False))
    assert outcome.error is None
    assert not outcome.unchanged
    assert {"reconstructed_share", "mpjpe_mm", "tilt_deg_adaptive", "tilt_deg_fixed"} <= set(outcome.figures)
    for command in ("reconstruct", "replan-compare", "report"):
        assert "unchanged" in succeeds(command, session)
    assert run_flight(Job(flight.manifest, session, BatchSettings(), force=False)).unchanged


def test_a_session_at_a_url_is_uploaded_when_its_flight_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    flight = write_flight(tmp_path, seconds=0.4)
    (tmp_path / "store").mkdir()
    settings = BatchSettings(stages=("ingest", "reconstruct"), method="dlt")
    job = Job(flight.manifest, Path(f"file://{tmp_path}/store/flight.session"), settings, force=False)
    assert run_flight(job).error is None
    assert (tmp_path / "store" / "flight.session" / "reconstruct" / "skeleton.parquet").is_file()
    assert run_flight(job).unchanged
    failed = run_flight(replace(job, session=Path("s3://me:pw@bucket/x.session")))
    assert failed.failed_stage == "ingest"
    assert "pw" not in str(failed.error)


def test_what_a_batch_cannot_start_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_flight(tmp_path / "a", seconds=0.1)
    write_flight(tmp_path / "b" / "a", seconds=0.1)
    pattern = tmp_path / "**" / "*.yaml"
    line = refused("batch", pattern, "-o", tmp_path / "out")
    assert line.startswith(f"mocap: {tmp_path}/b/a/flight.yaml: ")
    assert f"{tmp_path}/a/flight.yaml" in line
    assert refused("batch", tmp_path / "*.nothing").startswith(f"mocap: {tmp_path}/*.nothing: ")
    line = refused("batch", pattern, "--stages", "ingest,fly")
    assert line.startswith("mocap: --stages fly: ")
    assert line.endswith(", ".join(batch.STAGES))
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "summary.csv").write_text("my,own,table\n", encoding="utf-8")
    assert "--overwrite" in refused("batch", tmp_path / "a" / "*.yaml", "-o", foreign)
    assert mocap("batch", pattern, "--workers", "1", "--scheduler", "tcp://x:1").returncode == 2
    monkeypatch.setattr("pipelines.session.parallel.SCHEDULER_ANSWER_TIMEOUT_S", 0.2)
    assert "--scheduler tcp://127.0.0.1:9: " in refused(
        "batch", tmp_path / "a" / "*.yaml", "--scheduler", "tcp://127.0.0.1:9", "-o", tmp_path / "out"
    )
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert install_command("batch") in refused("batch", tmp_path / "a" / "*.yaml")
