"""A stage survives a kill at every step, a second writer, a full disk and damage."""

import errno
import itertools
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.session.errors import BusyError, DataError
from pipelines.session.stages import COMMANDS, Run, Stage, locked, open_session, versions_of
from pipelines.session.storage import SCHEMA, Making, is_made, read_json, sha256_of, whole_folder, write_json
from tests.raising import refused

INGEST = Stage("ingest", 1)
RECONSTRUCT = Stage("reconstruct", 1)


def ingest(folder: Path, flight: str, files: dict[str, str], **options: bool) -> Run:
    """Run a small ingest: a session.json and `files`, path to content."""
    with locked(folder, create=True, **options) as session:
        run = session.begin(INGEST, settings={"flight": flight}, inputs={"flight": "0" * 64})
        if not run.finished:
            for name, content in files.items():
                path = run.folder / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(content)
            write_json(run.folder / "session.json", {"schema": SCHEMA, "flight": flight})
            run.publish(counts={"files": len(files)})
        return run


def reconstruct(folder: Path, method: str, *, force: bool = False) -> Run:
    """Run a small version of a long stage: two chunks, made of the files that ingest wrote."""
    with locked(folder) as session:
        inputs = {"session": sha256_of(folder / "session.json")}
        run = session.begin(
            RECONSTRUCT, settings={"method": method, "rate": None}, inputs=inputs, force=force
        )
        if not run.finished:
            parts = [run.chunk(name, produce_part(f"{method} {name}")) for name in ("first", "second")]
            (run.folder / "skeleton").write_text(" ".join((part / "part").read_text() for part in parts))
            (run.folder / "deep").mkdir()
            (run.folder / "deep" / "metrics").write_text(method)
            run.publish(counts={"parts": len(parts)}, warnings=[f"used {method}"])
        return run


def produce_part(text: str) -> Callable[[Path], None]:
    def produce(folder: Path) -> None:
        (folder / "part").write_text(text)

    return produce


OLD = {
    "cameras/a/frames": "old a",
    "cameras/b/frames": "old b",
    "map/0.npz": "old map",
    "truth.parquet": "old",
}
NEW = {"cameras/a/frames": "new a", "cameras/c/frames": "new c", "actor.parquet": "new actor"}


def work(folder: Path) -> None:
    ingest(folder, "new", NEW)
    reconstruct(folder, "robust")


def contents(folder: Path) -> dict[str, bytes]:
    """Read everything in a session except run.json and the lock; any leftover of a kill would appear."""
    files = {p.relative_to(folder).as_posix(): p for p in sorted(folder.rglob("*")) if p.is_file()}
    folders = {f"{p.relative_to(folder).as_posix()}/": b"" for p in sorted(folder.rglob("*")) if p.is_dir()}
    ours = {name: path.read_bytes() for name, path in files.items() if name not in {".lock", "run.json"}}
    return {**folders, **ours}


def assert_every_stage_is_whole(folder: Path) -> None:
    """Check that each stage is the old or the new one, never a mixture, without files that are not listed."""
    try:
        session = open_session(folder)
    except DataError:  # of an interrupted publication, which a writer completes
        with locked(folder) as session:
            pass
    listed = set()
    for stage in ("ingest", "reconstruct"):
        record = session.record(stage)
        if record is not None:
            assert {name: sha256_of(folder / name) for name in record.outputs} == record.outputs
            listed |= {*record.outputs, f"{stage}/stage.json"}
    published = {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() and not path.relative_to(folder).parts[0].startswith(".")
    }
    assert {name for name in published if ".new/" not in name} - {"run.json", "run.json.new"} == listed


class Killed(BaseException):
    """Stand-in for SIGKILL: once raised, every call that changes a file fails, also in clean-up."""


@contextmanager
def failing_at(step: int, failure: BaseException, *, for_good: bool) -> Iterator[list[int]]:
    """Let the `step`-th call that changes the file system fail, and all after it if `for_good`."""
    calls = [0]
    with pytest.MonkeyPatch.context() as patch:
        for name in ("rename", "replace", "unlink", "rmdir", "mkdir", "open"):
            original = getattr(os, name)

            def guarded(*args: Any, _original: Any = original, **kwargs: Any) -> Any:
                calls[0] += 1
                if calls[0] == step or (for_good and calls[0] > step):
                    raise failure
                return _original(*args, **kwargs)

            patch.setattr(os, name, guarded)
        yield calls


@pytest.fixture(scope="module", params=["fresh", "replacing"])
def prepared(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Make the session at the start (it may be absent), and the one after undisturbed work."""
    start = tmp_path_factory.mktemp(request.param) / "start.session"
    end = start.with_name("end.session")
    if request.param == "replacing":
        ingest(start, "old", OLD)
        reconstruct(start, "dlt")
        shutil.copytree(start, end)
    work(end)
    return start, end


def put(start: Path, folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    if start.exists():
        shutil.copytree(start, folder)
    return folder


@pytest.mark.slow
def test_kill_at_every_step_and_again_while_mending(prepared: tuple[Path, Path], tmp_path: Path) -> None:
    start, end = prepared
    expected = contents(end)
    # Fixed draws: the second kill falls somewhere into mending and going on.
    draw = np.random.default_rng(1)
    for step in itertools.count(1):
        folder = put(start, tmp_path / "a.session")
        try:
            with failing_at(step, Killed(), for_good=True):
                work(folder)
        except Killed:
            pass
        else:
            break
        try:
            with failing_at(int(draw.integers(1, 40)), Killed(), for_good=True):
                work(folder)
        except Killed:
            pass
        if (folder / "session.json").exists():
            assert_every_stage_is_whole(folder)
        work(folder)
        assert contents(folder) == expected, f"killed at step {step}"
        assert versions_of(folder).keys() == versions_of(end).keys(), f"killed at step {step}"
    assert step > 40, "the faults were not injected"


def test_a_full_disk_at_every_step_is_one_line(prepared: tuple[Path, Path], tmp_path: Path) -> None:
    start, end = prepared
    expected = contents(end)
    lines = []
    for step in itertools.count(1):
        folder = put(start, tmp_path / "a.session")
        full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        with failing_at(step, full, for_good=False) as calls:
            try:
                work(folder)
            except DataError as error:
                lines.append(str(error))
        if calls[0] < step:
            break
        if (folder / "session.json").exists():
            assert_every_stage_is_whole(folder)
            assert not list(folder.glob("*.new")), "tidied at once"
        work(folder)
        assert contents(folder) == expected, f"disk full at step {step}"
    assert len(lines) > 40, "the faults were not injected"
    assert all(os.strerror(errno.ENOSPC) in line for line in lines)


def test_what_is_published_was_synced_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that a stage and its parts were synced before the rename that publishes them."""
    folder = tmp_path / "a.session"
    synced: set[int] = set()
    published: set[str] = set()
    rename = Path.rename

    def renamed(self: Path, target: Path) -> Path:
        if self.suffix == ".new":
            assert {path.stat().st_ino for path in [*self.rglob("*"), self]} <= synced
            published.add(self.stem)
        return rename(self, target)

    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.add(os.fstat(descriptor).st_ino))
    monkeypatch.setattr(Path, "rename", renamed)
    work(folder)
    assert {"first", "second", "ingest", "reconstruct"} <= published


HOLDER = """
import sys
from pathlib import Path
from pipelines.session.stages import locked
with locked(Path(sys.argv[1])):
    print("ready", flush=True)
    sys.stdin.read()
"""


@contextmanager
def other_process(script: str, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    root = Path(__file__).resolve().parents[2]
    with subprocess.Popen(
        [sys.executable, "-c", script, str(folder)], cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        yield process
        process.kill()


def test_a_second_writer_is_told_who_writes_until_that_one_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / "a.session"
    work(folder)
    with other_process(HOLDER, folder) as process:
        with pytest.raises(BusyError, match=rf"\b{process.pid}\b"):
            reconstruct(folder, "dlt")
        with pytest.raises(BusyError):
            ingest(folder, "old", OLD)
        assert open_session(folder).record("reconstruct") is not None, "reading needs no lock"
    assert reconstruct(folder, "robust").finished, "the lock ends with the process"


def interrupt_publication(folder: Path) -> None:
    """Leave a session as after a kill between the renames of the old and the new stage."""
    (folder / ".reconstruct.old").mkdir()
    (folder / "reconstruct").rename(folder / "reconstruct.new")


def test_a_reader_refuses_what_was_published_halfway_and_a_writer_finishes_it(tmp_path: Path) -> None:
    folder = tmp_path / "a.session"
    work(folder)
    expected = contents(folder)
    interrupt_publication(folder)
    halfway = contents(folder)
    with refused("not-a-session", folder, COMMANDS["reconstruct"]):
        open_session(folder)
    assert contents(folder) == halfway
    assert reconstruct(folder, "robust").finished
    assert contents(folder) == expected


def test_an_unchanged_stage_is_skipped_and_a_forced_one_redone_to_the_same_bytes(tmp_path: Path) -> None:
    folder = tmp_path / "a.session"
    work(folder)
    before = contents(folder)
    again = reconstruct(folder, "robust")
    assert again.finished
    assert again.record.counts == {"parts": 2}
    assert again.record.warnings == ["used robust"]
    assert len(read_json(folder / "run.json")["runs"]) == 2, "skipping leaves no trace"
    forced = reconstruct(folder, "robust", force=True)
    assert not forced.finished
    assert contents(folder) == before
    assert [run["stage"] for run in read_json(folder / "run.json")["runs"]] == [
        "ingest",
        *["reconstruct"] * 2,
    ]


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[0] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("damage", [flip, Path.unlink, lambda path: path.write_bytes(b"")])
@pytest.mark.parametrize(
    "name",
    [
        "reconstruct/skeleton",
        "reconstruct/stage.json",
        "cameras/a/frames",
        "session.json",
        "ingest/stage.json",
    ],
)
def test_a_damaged_stage_is_redone(tmp_path: Path, name: str, damage: Callable[[Path], object]) -> None:
    folder = tmp_path / "a.session"
    work(folder)
    expected = contents(folder)
    damage(folder / name)
    overwrite = name == "ingest/stage.json"  # without its record the folder is no longer known as ours
    ingest(folder, "new", NEW, overwrite=overwrite)
    reconstruct(folder, "robust")
    assert contents(folder) == expected


def test_an_interrupted_stage_keeps_its_finished_chunks(tmp_path: Path) -> None:
    folder = tmp_path / "a.session"
    work(folder)
    before = contents(folder)
    produced: list[str] = []

    def attempt(interrupt: bool, method: str = "dlt") -> None:
        def produce(name: str) -> Callable[[Path], None]:
            def write(part: Path) -> None:
                produced.append(name)
                (part / "part").write_text(name)
                if interrupt and name == "second":
                    raise KeyboardInterrupt

            return write

        with locked(folder) as session:
            run = session.begin(RECONSTRUCT, settings={"method": method}, inputs={})
            for name in ("first", "second"):
                assert (run.chunk(name, produce(name)) / "part").read_text() == name
            (run.folder / "skeleton").touch()
            run.publish(counts={})

    with pytest.raises(KeyboardInterrupt):
        attempt(interrupt=True)
    with pytest.raises(KeyboardInterrupt):
        attempt(interrupt=True, method="midpoint")
    assert not (folder / "reconstruct.new").exists()
    assert {n: c for n, c in contents(folder).items() if not n.startswith(".partial")} == before
    attempt(interrupt=False)
    assert produced == ["first", "second", "first", "second", "second"]
    assert not (folder / ".partial").exists(), "neither these chunks nor those of other settings"


def fail_to_ingest(folder: Path) -> None:
    with locked(folder, create=True) as session:
        (session.begin(INGEST, settings={}, inputs={}).folder / "truth.parquet").touch()
        raise DataError("flight.yaml", "cannot be used")


def test_a_failed_ingest_leaves_an_existing_folder_and_an_existing_session(tmp_path: Path) -> None:
    empty, old = tmp_path / "empty", tmp_path / "a.session"
    empty.mkdir()
    work(old)
    before = contents(old)
    for folder in (empty, old):
        with refused("data", "flight.yaml"):
            fail_to_ingest(folder)
    assert contents(empty) == {}
    assert contents(old) == before
    work(empty)


def test_a_foreign_folder_is_refused_unless_it_may_be_written_into(tmp_path: Path) -> None:
    foreign = {"thesis.tex": b"years of work", "session.json": b'{"of": "another program"}', "map.new/": b""}
    (tmp_path / "map.new").mkdir()
    for name in ("thesis.tex", "session.json"):
        (tmp_path / name).write_bytes(foreign[name])
    with refused("exists", tmp_path, 3, "map.new", "--overwrite"):
        ingest(tmp_path, "new", NEW)
    assert contents(tmp_path) == foreign
    assert not (tmp_path / ".lock").exists()
    ingest(tmp_path, "new", NEW, overwrite=True)
    assert (tmp_path / "thesis.tex").read_bytes() == foreign["thesis.tex"]
    assert (tmp_path / "map.new").is_dir()
    assert_record_of(tmp_path, "new")


def assert_record_of(folder: Path, flight: str) -> None:
    record = open_session(folder).record("ingest")
    assert record is not None
    assert record.settings == {"flight": flight}


def test_newer_schemas_are_refused_and_left_alone(tmp_path: Path) -> None:
    folder = tmp_path / "a.session"
    work(folder)
    of_file: dict[str, list[Callable[[Path], object]]] = {
        "session.json": [open_session, work, lambda f: reconstruct(f, "robust", force=True)],
        "reconstruct/stage.json": [lambda f: open_session(f).record("reconstruct"), work],
    }
    for name, openings in of_file.items():
        path = folder / name
        kept = path.read_bytes()
        path.write_text(json.dumps({**json.loads(kept), "schema": SCHEMA + 1}))
        before = contents(folder)
        for opening in openings:
            with refused("newer-schema", path):
                opening(folder)
        assert contents(folder) == before
        path.write_bytes(kept)


MARK = "mark.json"


def make(target: Path, key: str = "k", *, overwrite: bool = False, made: list[str] | None = None) -> None:
    def produce(folder: Path) -> None:
        (folder / "content").write_text("part")
        if made is not None:
            made.append(key)

    with whole_folder(target, key, mark=MARK, overwrite=overwrite) as making:
        part = making.part("one", produce)
        (making.folder / "copy").write_text((part / "content").read_text())
        write_json(making.folder / MARK, {"key": key})
        making.publish()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_finished_parts_outlive_an_interrupt_but_not_other_settings(tmp_path: Path) -> None:
    target, made = tmp_path / "flight", list[str]()

    def interrupted(key: str) -> None:
        with whole_folder(target, key, mark=MARK, overwrite=False) as making:
            making.part("one", lambda folder: made.append(str(folder)))
            making.part("two", _interrupt)

    with pytest.raises(KeyboardInterrupt):
        interrupted("k")
    assert not target.exists()
    with pytest.raises(KeyboardInterrupt):
        interrupted("k")
    assert len(made) == 1
    with pytest.raises(KeyboardInterrupt):
        interrupted("other")
    assert len(made) == 2


def _interrupt(_: Path) -> None:
    raise KeyboardInterrupt


def test_a_failure_leaves_the_old_one_and_no_trace(tmp_path: Path) -> None:
    target = tmp_path / "flight"
    make(target)

    def failing() -> None:
        with whole_folder(target, "new", mark=MARK, overwrite=False) as making:
            (making.folder / "half").write_text("")
            raise DataError(target, "failed")

    with pytest.raises(DataError, match="failed"):
        failing()
    assert names(tmp_path) == ["flight"]
    assert names(target) == ["copy", MARK]


def test_one_of_its_own_is_replaced_and_somebody_elses_is_not(tmp_path: Path) -> None:
    target = tmp_path / "flight"
    make(target)
    make(target, "new")
    assert is_made(target, "new", mark=MARK)
    (target / MARK).unlink()
    with pytest.raises(DataError, match=r"\b1\b.*\bcopy\b.*--overwrite"):
        make(target)
    make(target, overwrite=True)
    assert is_made(target, "k", mark=MARK)
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match=r"--output$") as caught:
        make(tmp_path / "file")
    assert caught.value.source == tmp_path / "file"


def test_a_kill_between_the_two_renames_is_mended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "flight"
    make(target)

    def killed(making: Making) -> None:
        target.rename(tmp_path / ".flight.making" / "old")
        raise SystemExit

    with monkeypatch.context() as patched:
        patched.setattr(Making, "publish", killed)
        patched.setattr("pipelines.session.storage._put_back", lambda *_: None)
        with pytest.raises(SystemExit):
            make(target, "new")
    assert not target.exists()
    with whole_folder(target, "new", mark=MARK, overwrite=False):
        assert is_made(target, "k", mark=MARK)


def test_two_do_not_make_one_folder(tmp_path: Path) -> None:
    target = tmp_path / "flight"
    with whole_folder(target, "k", mark=MARK, overwrite=False), pytest.raises(BusyError):
        make(target)
