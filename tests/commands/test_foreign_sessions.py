"""Sessions of others, and machines that are short of something: one line, and no harm to the user's files."""

import json
import os
import resource
import shutil
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipelines.session.stages import locked
from pipelines.session.storage import whole_folder
from tests.commands.runner import MOCAP, content, mocap, refusal, refused, succeeds
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


@pytest.mark.parametrize("name", [".film.old", "report.new", ".partial"])
def test_no_link_under_a_name_of_our_own_is_followed(session: Path, precious: Path, name: str) -> None:
    (session / name).symlink_to(precious)
    before = everything(session)
    for command in (("info",), ("check",), ("report",), ("export", "--to", "csv")):
        succeeds(command[0], session, *command[1:])
    assert everything(session) == before  # reading writes nothing
    succeeds("reconstruct", session, "--method", "dlt", "--force")
    assert not (session / name).is_symlink()


@pytest.mark.parametrize("name", [".lock", ".lock.pid", "run.json.new", "run.json", ".partial/reconstruct-0"])
def test_no_link_to_a_file_is_written_through(session: Path, precious: Path, name: str) -> None:
    (session / name).unlink(missing_ok=True)
    (session / name).parent.mkdir(exist_ok=True)
    (session / name).symlink_to(precious / "deep" / "thesis.txt")
    mocap("reconstruct", session, "--method", "robust")  # a foreign run.json may be refused


def test_no_link_beside_a_result_is_followed(tmp_path: Path, session: Path, precious: Path) -> None:
    (tmp_path / ".sim.making").symlink_to(precious)
    with whole_folder(tmp_path / "sim", "key", mark="mark", overwrite=False) as making:
        (making.folder / "mark").write_text("{}")
        making.publish()
    (session.parent / "out").mkdir()
    (session.parent / "out" / ".mocap-export").symlink_to(precious)
    succeeds("export", session, "--to", "csv", "-o", session.parent / "out")


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("session.json", "pipe"),
        ("ingest/stage.json", "/dev/zero"),
        ("cameras/drone1/poses.parquet", "pipe"),
        ("reconstruct/metrics.json", "/proc/kmsg"),
    ],
)
def test_no_special_file_in_a_session_is_read(session: Path, name: str, kind: str) -> None:
    (session / name).unlink()
    if kind == "pipe":
        os.mkfifo(session / name)
    else:
        (session / name).symlink_to(kind)
    commands = [("report",), ("export", "--to", "tum")] + [("info",)] * name.endswith("n.json")
    for command in commands:
        done = mocap(command[0], session, *command[1:])
        refusal(done)
        assert done.code in {"special-file", "not-a-session", "changed", "wrong-kind"}


def test_json_has_a_limit(session: Path) -> None:
    with (session / "session.json").open("ab") as file:
        file.truncate(1 << 40)
    refused("info", session, code="too-large")


@pytest.mark.parametrize("gone", ["ingest", "cameras/drone1/poses.parquet"])
def test_a_copy_of_a_part_of_a_session_is_refused_by_every_command(session: Path, gone: str) -> None:
    (shutil.rmtree if (session / gone).is_dir() else os.remove)(session / gone)
    code = "not-a-session" if gone == "ingest" else "changed"
    for command in (
        ("report",),
        ("check",),
        ("export", "--to", "tum"),
        ("reconstruct",),
        ("replan-compare",),
    ):
        refused(command[0], session, *command[1:], code=code)


def test_paths_in_a_record_do_not_lead_out_of_the_session(session: Path) -> None:
    path = session / "ingest" / "stage.json"
    record = json.loads(path.read_text())
    record["outputs"]["../../etc/passwd"] = "0" * 64
    path.write_text(json.dumps(record))
    assert "passwd" not in refused("report", session, code="damaged")


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


@pytest.mark.parametrize("megabytes", [300, 1100])
def test_little_memory_is_one_line(session: Path, megabytes: int) -> None:
    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (megabytes << 20, megabytes << 20))

    done = subprocess.run(
        [MOCAP, "export", str(session), "--to", "csv"],
        preexec_fn=limited,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        assert "memory" in refusal(done)


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
