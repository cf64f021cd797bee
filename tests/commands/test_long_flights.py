"""Long flights: their joint estimate in windows, here of seconds for minutes, and their page."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pipelines.reconstruct import reconstruct
from pipelines.reconstruction import refining
from pipelines.session import tables
from tests.commands.runner import content, succeeds
from tests.synthetic.flights import SyntheticFlight, write_flight


@pytest.fixture
def short_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make windows of one and a half seconds that overlap by one."""
    monkeypatch.setattr(refining, "MAX_WINDOW_S", 1.5)
    monkeypatch.setattr(refining, "OVERLAP_S", 1.0)
    monkeypatch.setattr(refining, "BLENDED_S", 0.6)


def ingested(flight: SyntheticFlight) -> Path:
    session = flight.manifest.with_suffix(".session")
    succeeds("ingest", flight.manifest, "-o", session)
    return session


def test_windows_give_the_flight_with_any_number_of_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short_windows: None
) -> None:
    session = ingested(write_flight(tmp_path, cameras=3, seconds=3.0))
    apart = Path(shutil.copytree(session, tmp_path / "apart.session"))
    divided = reconstruct(session, workers=1).metrics
    monkeypatch.setattr(tables, "ROWS_PER_BATCH", 50)  # people of 17 joints are cut
    reconstruct(apart, workers=2)
    assert content(session / "reconstruct") == content(apart / "reconstruct")
    skeleton = pd.read_parquet(session / "reconstruct" / "skeleton.parquet")
    monkeypatch.setattr(refining, "MAX_WINDOW_S", 60.0)
    whole = reconstruct(apart, force=True).metrics
    assert divided["status_counts"] == whole["status_counts"]
    # Constant errors of poses are estimated from half of the pictures, the body's motion as before.
    assert divided["root_mpjpe_mm"] < 1.15 * whole["root_mpjpe_mm"]
    assert divided["mpjpe_mm"] < 1.5 * whole["mpjpe_mm"]
    # No step at the seam.
    position = skeleton[["x", "y", "z"]].to_numpy().reshape(-1, 17, 3)
    jerk = np.nanmax(np.linalg.norm(np.diff(position, 3, axis=0), axis=2), axis=1)
    seam = len(jerk) // 2
    assert jerk[seam - 15 : seam + 15].max() < 1.5 * np.r_[jerk[: seam - 15], jerk[seam + 15 :]].max()


def test_a_clock_is_that_of_the_whole_flight(tmp_path: Path, short_windows: None) -> None:
    flight = write_flight(tmp_path, cameras=3, seconds=3.0)
    # Stamped 130 ms too early, and nobody says so.
    flight.settings["cameras"]["drone2"]["clock"] = {"offset_s": -0.13, "sigma_s": 0.2}
    flight.save()
    session = ingested(flight)
    metrics = reconstruct(session, workers=1).metrics
    assert metrics["clock_offsets_s"]["drone2"] == pytest.approx(0.13, abs=0.02)
    assert 0 < metrics["clock_offset_sigmas_s"]["drone2"] < 0.1
    assert "drone2" in metrics["method_used"]["clocks"]
    cameras = pd.read_parquet(session / "reconstruct" / "cameras.parquet")
    own = cameras[cameras["camera"] == "drone2"]["t_ns"].to_numpy()
    assert len(np.unique(own - flight.t_ns[: len(own)])) == 1
