"""Runner of `mocap` commands, which returns exit status and output.

Commands run in this process, because starting Python with all imports takes longer than most commands. Tests
of the process itself (signals, memory, imports) start one, by `mocap_process` or from `MOCAP`.
"""

import hashlib
import json
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import Any
from unittest.mock import patch

from mocap_cli.main import print_error, run
from pipelines.session.errors import MocapError, read_codes
from tests.synthetic.flights import SyntheticFlight

MOCAP = str(Path(sys.executable).with_name("mocap"))


class Done(subprocess.CompletedProcess[str]):
    """Result of a command that ran in this process."""

    code: str | None = None  # of the error that ended it


def mocap(*arguments: str | Path) -> Done:
    """Run the command to its end, in this process; an exception without an error line fails the test."""
    given = [MOCAP, *map(str, arguments)]
    # Encoded like the streams of a process, so that text that cannot be written is found here as well.
    printed, told = BytesIO(), BytesIO()
    out = TextIOWrapper(printed, "utf-8", write_through=True)
    err = TextIOWrapper(told, "utf-8", "backslashreplace", write_through=True)
    status: int | str | None = 0
    errors: list[MocapError] = []

    def keep_and_print(error: MocapError) -> None:
        errors.append(error)
        print_error(error)

    with (
        patch.object(sys, "argv", given),
        patch("mocap_cli.main.print_error", keep_and_print),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        try:
            run()
        except SystemExit as ended:
            status = ended.code
    assert isinstance(status, int), status
    done = Done(given, status, printed.getvalue().decode(), told.getvalue().decode())
    done.code = errors[0].code if errors else None
    return done


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


def result_of(*arguments: str | Path) -> dict[str, Any]:
    """Run a command that must succeed with --json; return what it prints."""
    result: dict[str, Any] = json.loads(succeeds(*arguments, "--json"))
    return result


def ingested(flight: SyntheticFlight) -> Path:
    """Ingest a flight; return its session, which lies beside it."""
    succeeds("ingest", flight.manifest)
    return flight.manifest.with_suffix(".session")


def measured(session: Path, *options: str) -> dict[str, Any]:
    """Reconstruct by `robust`; return the metrics."""
    return result_of("reconstruct", session, "--method", "robust", *options)


def refused(*arguments: str | Path, code: str | None = None) -> str:
    """Run a command that must refuse its input in one line and exit 1, with this code; return that line.

    Changes of flight.yaml that mend it follow it, each in a line of its own.
    """
    done = mocap(*arguments)
    line = refusal(done)
    assert code is None or (code in read_codes("errors") and done.code == code), (done.code, line)
    return line


def refusal(done: subprocess.CompletedProcess[str]) -> str:
    """Check that a command refused its input in one line, after warnings, and exited 1; return that line."""
    assert done.returncode == 1, (done.returncode, done.stdout, done.stderr)
    lines = [line for line in done.stderr.strip().splitlines() if not line.startswith("warning: ")]
    assert all(line.startswith("  ") for line in lines[1:]), done.stderr
    assert lines[0].startswith("mocap: ")
    assert "Traceback" not in done.stderr
    return "\n".join(lines)


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
