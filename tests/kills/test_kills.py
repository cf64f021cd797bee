"""A short share of `python -m tests.kills`, on keypoints in place of a detector."""

import time
from pathlib import Path

import pytest

from tests.commands.runner import mocap_process
from tests.kills.killing import Command, soak
from tests.synthetic.flights import write_flight

SEED, KILLS = 7, 2


@pytest.mark.long
def test_killed_and_run_again_the_bytes_are_those_of_an_undisturbed_run(tmp_path: Path) -> None:
    manifest = write_flight(tmp_path, seconds=0.5).manifest
    ingested, session = tmp_path / "a.session", tmp_path / "b.session"
    commands = {
        "ingest": Command(["ingest", manifest, "-o", ingested], ingested),
        "reconstruct": Command(["reconstruct", session, "--method", "robust"], session, before=ingested),
    }
    started = time.monotonic()
    assert mocap_process("ingest", manifest, "-o", tmp_path / "other.session").returncode == 0
    length_s = time.monotonic() - started  # imports, most of it: the others take as long and longer
    found = list(soak(commands, KILLS, seed=SEED, known_s=dict.fromkeys(commands, length_s)))
    assert [kill.trouble for kill in found] == [""] * KILLS
    assert any(kill.hit for kill in found)
