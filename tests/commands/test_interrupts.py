"""Killed at any moment, run again: the same bytes as undisturbed. Two writers: the second says so."""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from pipelines.session.stages import locked
from tests.commands.runner import MOCAP, content, mocap_process, refusal, succeeds
from tests.synthetic.flights import write_flight

KILLS = 4  # fifty moments of every stage: `python -m tests.kills`


def killed_after(seconds: float, *arguments: str | Path) -> None:
    process = subprocess.Popen(
        [MOCAP, *map(str, arguments)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    time.sleep(seconds)
    process.send_signal(signal.SIGKILL)
    process.wait()


@pytest.mark.slow
def test_kill_at_random_moments_of_ingest_and_reconstruct(tmp_path: Path) -> None:
    flight = write_flight(tmp_path, cameras=3)
    undisturbed = tmp_path / "undisturbed.session"
    started = time.monotonic()
    assert mocap_process("ingest", flight.manifest, "-o", undisturbed).returncode == 0
    ingest_s = time.monotonic() - started
    succeeds("reconstruct", undisturbed)  # once more below: the first one may compile kernels
    started = time.monotonic()
    assert mocap_process("reconstruct", undisturbed, "--force").returncode == 0
    reconstruct_s = time.monotonic() - started

    moments = np.random.default_rng(20)
    session = tmp_path / "killed.session"
    for _ in range(KILLS):
        killed_after(moments.uniform(0.0, ingest_s), "ingest", flight.manifest, "-o", session, "--force")
        succeeds("ingest", flight.manifest, "-o", session)
        killed_after(moments.uniform(0.0, reconstruct_s), "reconstruct", session, "--force")
        succeeds("reconstruct", session)
        assert content(session) == content(undisturbed)


def test_second_writer_says_so(tmp_path: Path) -> None:
    flight = write_flight(tmp_path)
    session = tmp_path / "flight.session"
    succeeds("ingest", flight.manifest)
    with locked(session):
        for arguments in (
            ("ingest", flight.manifest, "--force"),
            ("reconstruct", session),
            ("report", session),
        ):
            assert "is being written by process" in refusal(mocap_process(*arguments))
    succeeds("reconstruct", session)
