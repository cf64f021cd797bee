"""Runs `mocap` as users do, and tells its exit status and what it printed.

In this process, since starting Python and importing everything takes longer than most commands. What is about
the process itself (signals, its memory, what it imports) starts one, by `mocap_process` or from `MOCAP`.
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
    """Run the command to its end, in this process; an exception that it tells in no line fails the test."""
    given = [MOCAP, *map(str, arguments)]
    # Encoded as streams of a process are, so that what cannot be written is found here as well.
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
    """Run a command that must succeed; its stdout."""
    done = mocap(*arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def refused(*arguments: str | Path) -> str:
    """Run a command that must refuse its input in one line and exit 1; that line."""
    return refusal(mocap(*arguments))


def refusal(done: subprocess.CompletedProcess[str]) -> str:
    """The one line of a command that refused its input and exited 1."""
    assert done.returncode == 1, (done.returncode, done.stdout, done.stderr)
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("mocap: ")
    assert "Traceback" not in done.stderr
    return lines[0]


def as_if_written(session: Path, name: str, stage: str) -> None:
    """Let a file that a test put into a session count as one that the stage wrote."""
    path = session / stage / "stage.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    record["outputs"][name] = hashlib.sha256((session / name).read_bytes()).hexdigest()
    path.write_text(json.dumps(record), encoding="utf-8")


def content(folder: Path) -> dict[str, str]:
    """Hash of every file of a session that is a result: all but times of day and locks."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in {"run.json", ".lock", ".lock.pid"}
    }
