"""Runner of `mocap` commands, which returns exit status and output.

Commands run in this process, because starting Python with all imports takes longer than most commands. Tests
of the process itself (signals, memory, imports) start one, by `mocap_process` or from `MOCAP`.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import BytesIO, TextIOWrapper
from pathlib import Path
from unittest.mock import patch

from mocap_cli.main import run

MOCAP = str(Path(sys.executable).with_name("mocap"))


def mocap(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the command to its end, in this process; an exception without an error line fails the test."""
    given = [MOCAP, *map(str, arguments)]
    # Encoded like the streams of a process, so that text that cannot be written is found here as well.
    printed, told = BytesIO(), BytesIO()
    out = TextIOWrapper(printed, "utf-8", write_through=True)
    err = TextIOWrapper(told, "utf-8", "backslashreplace", write_through=True)
    status: int | str | None = 0
    with patch.object(sys, "argv", given), redirect_stdout(out), redirect_stderr(err):
        try:
            run()
        except SystemExit as ended:
            status = ended.code
    assert isinstance(status, int), status
    return subprocess.CompletedProcess(given, status, printed.getvalue().decode(), told.getvalue().decode())


def mocap_process(*arguments: str | Path, timeout: float = 120) -> subprocess.CompletedProcess[str]:
    """Run the command to its end, in a process of its own."""
    return subprocess.run(
        [MOCAP, *map(str, arguments)], capture_output=True, text=True, timeout=timeout, check=False
    )


def succeeds(*arguments: str | Path) -> str:
    """Run a command that must succeed; return its stdout."""
    done = mocap(*arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def refused(*arguments: str | Path) -> str:
    """Run a command that must refuse its input in one line and exit 1; return that line."""
    return refusal(mocap(*arguments))


def refusal(done: subprocess.CompletedProcess[str]) -> str:
    """Check that a command refused its input in one line and exited 1; return that line."""
    assert done.returncode == 1, (done.returncode, done.stdout, done.stderr)
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("mocap: ")
    assert "Traceback" not in done.stderr
    return lines[0]


def as_if_written(session: Path, name: str, stage: str) -> None:
    """Record a file that a test put into a session as one that the stage wrote."""
    path = session / stage / "stage.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    record["outputs"][name] = hashlib.sha256((session / name).read_bytes()).hexdigest()
    path.write_text(json.dumps(record), encoding="utf-8")


def content(folder: Path) -> dict[str, str]:
    """Hash every file of a session that is a result: all except run.json and locks."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in {"run.json", ".lock", ".lock.pid"}
    }
