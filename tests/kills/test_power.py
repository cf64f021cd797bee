"""A short share of `python -m tests.kills --power`, and what its states must be."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipelines.session.storage import make_folder, write_whole
from tests.kills.power import Recorder, cases_on, losses, replay

MOMENTS, SEED = 10, 5


def left_of(folder: Path, write: Callable[[Path], object]) -> tuple[set[bytes | None], set[bytes | None]]:
    """Return what may be left of a file, old at first: at any moment, and after the end."""
    folder.mkdir()
    path = folder / "a"
    path.write_bytes(b"old")
    recorder = Recorder(folder)
    with recorder.recording() as trace:
        write(path)
    states = [
        (count, disk.get("a"))
        for seed in range(100)
        for count, disk in losses(trace, np.random.default_rng(seed), moments=100)
    ]
    last = len(trace) - 1
    return {content for _, content in states}, {content for count, content in states if count == last}


def test_only_what_was_synced_is_there_after_a_loss_of_power(tmp_path: Path) -> None:
    def replace(path: Path, *, sync: bool) -> None:
        new = path.with_name("b")
        with new.open("wb") as file:
            file.write(b"new")
            file.flush()
            if sync:
                os.fsync(file.fileno())
        new.replace(path)

    whole, done = left_of(tmp_path / "whole", lambda path: write_whole(path, b"new"))
    assert (whole, done) == ({b"old", b"new"}, {b"new"})
    unsynced, _ = left_of(tmp_path / "unsynced", lambda path: replace(path, sync=False))
    assert {b"old", b"new", b"", b"\0\0\0"} <= unsynced
    # Without a sync of the folder, the rename may be lost.
    assert left_of(tmp_path / "file", lambda path: replace(path, sync=True))[1] == {b"old", b"new"}
    torn, _ = left_of(tmp_path / "torn", lambda path: path.write_bytes(b"new"))
    assert {b"old", b"new", b"", b"ne"} <= torn


@pytest.mark.parametrize("synced", [True, False])
def test_a_folder_is_there_once_the_one_around_it_is_synced(tmp_path: Path, synced: bool) -> None:
    (tmp_path / "disk").mkdir()
    recorder = Recorder(tmp_path / "disk")
    inner = tmp_path / "disk" / "outer" / "inner"
    with recorder.recording() as trace:
        make_folder(inner) if synced else inner.mkdir(parents=True)
    ends = [
        set(disk)
        for count, disk in losses(trace, np.random.default_rng(SEED), moments=10)
        if count == len(trace) - 1
    ]
    assert (ends == [{"outer", "outer/inner"}]) is synced


def test_a_loss_of_power_leaves_one_version_or_the_other(tmp_path: Path) -> None:
    ((folder, case),) = cases_on(tmp_path, ["ingest again"])
    lost = replay(folder, case, moments=MOMENTS, again=2, seed=SEED)
    assert lost.states > MOMENTS
    assert lost.troubles == []
