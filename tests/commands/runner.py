"""Runs `mocap` as users do: a process of its own, with its exit status and what it printed."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

MOCAP = str(Path(sys.executable).with_name("mocap"))


def mocap(*arguments: str | Path, timeout: float = 120) -> subprocess.CompletedProcess[str]:
    """Run the command to its end."""
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
    done = mocap(*arguments)
    assert done.returncode == 1, (done.returncode, done.stdout, done.stderr)
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("mocap: ")
    assert "Traceback" not in done.stderr
    return lines[0]


def content(folder: Path) -> dict[str, str]:
    """Hash of every file of a session that is a result: all but times of day and locks."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in {"run.json", ".lock", ".lock.pid"}
    }
