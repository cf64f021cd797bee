"""`mocap batch`: many flights on Dask, with the same results as single runs."""

import shutil
import sys
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

import pytest

from pipelines import batch
from pipelines import detect as detection
from pipelines.batch import BatchSettings, Job, run_flight
from pipelines.detect import detect, follow
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.reconstruction import refining
from pipelines.session.parallel import connected
from pipelines.session.registries import install_command
from pipelines.session.stages import locked
from tests.commands.runner import content, mocap, refused, succeeds
from tests.keypoints.spotted_flights import spot_detector, write_spotted_flight
from tests.synthetic.flights import write_flight


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """Start a scheduler with a worker in a thread of this process; return its address."""
    from distributed import LocalCluster

    options = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "dashboard_address": None}
    with LocalCluster(**options) as made:  # type: ignore[no-untyped-call]
        yield str(made.scheduler_address)


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
            detect(session, detector=detector, workers=workers, executor=executor)
            follow(session, workers=workers, executor=executor)
        return content(folder)

    expected = found(here)
    assert found(processes, workers=2) == expected
    with connected(scheduler) as client:
        executor = client.get_executor(pure=False)
        assert found(there, executor=executor) == expected
        with locked(apart) as session:  # backgrounds without keypoints
            follow(session, executor=executor)
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
    settings = BatchSettings(("ingest", "reconstruct"), ReconstructSettings("dlt"))
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
