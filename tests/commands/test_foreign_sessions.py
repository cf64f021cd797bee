"""Sessions of others, and machines that are short of something: one line, and no harm to the user's files."""

import json
import os
import shutil
import stat
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pipelines.session.stages import locked
from pipelines.session.storage import remove_tree
from tests.commands.runner import MOCAP, content, refused, succeeds
from tests.synthetic.flights import write_flight


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a session with a skeleton and a report."""
    folder = tmp_path_factory.mktemp("made")
    succeeds("ingest", write_flight(folder, seconds=0.4).manifest)
    session = folder / "flight.session"
    succeeds("reconstruct", session, "--method", "dlt")
    succeeds("report", session)
    return session


@pytest.fixture
def session(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path / "a" / "flight.session")


@pytest.fixture
def precious(tmp_path: Path) -> Iterator[Path]:
    """Make a folder of the user's; it must stay as it is."""
    folder = tmp_path / "precious"
    (folder / "deep").mkdir(parents=True)
    (folder / "deep" / "thesis.txt").write_text("years of work")
    (folder / "session.json").write_text("mine")
    before = content(folder)
    yield folder
    assert content(folder) == before


def everything(folder: Path) -> dict[str, tuple[int, int]]:
    """List all that lies in a folder, hidden files too, with its time of change."""
    return {str(path): (path.lstat().st_mtime_ns, path.lstat().st_size) for path in sorted(folder.rglob("*"))}


def test_no_link_under_a_name_of_our_own_is_followed(session: Path, precious: Path) -> None:
    for name in (".film.old", "report.new", ".partial"):
        (session / name).symlink_to(precious)
    before = everything(session)
    for command in (("info",), ("check",), ("report",), ("export", "--to", "csv")):
        succeeds(command[0], session, *command[1:])
    assert everything(session) == before  # reading writes nothing
    succeeds("reconstruct", session, "--method", "dlt", "--force")
    assert not any((session / name).is_symlink() for name in (".film.old", "report.new", ".partial"))


LEADING_OUT: dict[str, object] = {
    "outputs": {"../../etc/passwd": "0" * 64},
    "settings": {},
    "inputs": {},
    "counts": {},
}
LEADING_OUT |= {"schema": 1, "stage": "ingest", "revision": 1, "key": "", "warnings": []}


@pytest.mark.parametrize(
    ("name", "harm", "code"),
    [
        ("ingest/stage.json", os.mkfifo, "special-file"),
        ("session.json", lambda path: path.symlink_to("/dev/zero"), "not-a-session"),
        ("session.json", lambda path: path.write_bytes(bytes(1 + (1 << 26))), "too-large"),
        ("ingest", Path.mkdir, "not-a-session"),
        ("cameras/drone1/poses.parquet", Path.mkdir, "changed"),
        ("ingest/stage.json", lambda path: path.write_text(json.dumps(LEADING_OUT)), "damaged"),
    ],
)
def test_a_part_that_is_not_as_written_is_refused(
    session: Path, name: str, harm: Callable[[Path], object], code: str
) -> None:
    remove_tree(session / name)
    harm(session / name)
    for command in (("report",), ("export", "--to", "tum"), ("reconstruct",), ("replan-compare",)):
        assert "passwd" not in refused(command[0], session, *command[1:], code=code)


def test_a_session_that_cannot_be_written_is_looked_at_and_copied(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in [session, *session.rglob("*")]:
        path.chmod(stat.S_IRUSR | (stat.S_IXUSR if path.is_dir() else 0))
    before = everything(session)
    assert "unchanged" in succeeds("report", session)
    succeeds("report", session, "--video", "none", "-o", tmp_path / "page.html")
    assert "<html" in (tmp_path / "page.html").read_text()
    (tmp_path / "mine.html").write_text("mine")
    refused("report", session, "-o", tmp_path / "mine.html", code="exists")
    succeeds("check", session)
    copy = tmp_path / "elsewhere" / "copy.session"
    succeeds("reconstruct", session, "--method", "robust", "-o", copy)
    assert "unchanged" in succeeds("reconstruct", session, "--method", "robust", "-o", copy)
    refused("reconstruct", session, "-o", tmp_path, code="exists")
    assert everything(session) == before
    for path in [session, *session.rglob("*")]:
        path.chmod(stat.S_IRWXU)


def test_a_session_that_is_written_can_be_read(session: Path) -> None:
    with locked(session):
        succeeds("info", session)
        succeeds("check", session)
        succeeds("export", session, "--to", "tum")


INTERRUPTED_WHILE_IMPORTING = """
import os, signal, sys, time

class Interrupts:
    def find_spec(self, name, path=None, target=None):
        if name == MODULE:
            try:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(0.1)
            except KeyboardInterrupt:  # lost, as in modules that are compiled
                pass

MODULE = sys.argv.pop(1)
sys.meta_path.insert(0, Interrupts())
sys.argv[0] = "mocap"
from mocap_cli.main import run
run()
"""


@pytest.mark.parametrize("module", ["click", "pipelines.survey"])
def test_ctrl_c_while_modules_are_loaded_is_one_line(session: Path, module: str) -> None:
    python = Path(MOCAP).with_name("python")
    program: list[str | Path] = [python, "-c", INTERRUPTED_WHILE_IMPORTING, module, "info", session]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 130
    assert len(done.stderr.strip().splitlines()) == 1
