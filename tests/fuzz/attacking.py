"""Driver of inputs: each is read by a process of its own, whose time and memory are measured."""

from __future__ import annotations

import json
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.fuzz.crafted import Crafted

MOST_S = 10.0
MOST_MB = 1000
_END_S = 15  # of processor time: an input that needs more is ended
_WAIT_S = 300.0
_MOST_ADDRESSES = 16 << 30  # bytes: a reader that asks for more gets an error, and the machine goes on
_MOST_FILE = 4 << 30  # bytes


@dataclass(frozen=True)
class Met:
    """Result of one input."""

    kind: str
    what: str
    bytes: int  # of the input
    cpu_s: float
    mb: float  # the most memory that the process held, with the libraries of all readers
    read: int  # ways in which the input was read
    refused: int
    trouble: str  # empty if it was read or refused in time and memory
    line: str  # the first refusal


def attack(inputs: Iterable[Crafted], folder: Path) -> Iterator[Met]:
    """Write and read inputs, one at a time, in an empty folder."""
    place = folder / "input"
    with Reader() as reader:
        for crafted in inputs:
            place.mkdir()
            crafted.write(place)
            size = sum(file.stat().st_size for file in place.rglob("*") if file.is_file())
            answer = reader.ask(place / crafted.entry, crafted.stated)
            shutil.rmtree(place)
            yield Met(crafted.kind, crafted.what, size, **answer)


class Reader:
    """Process with all readers loaded, which forks one for each input.

    Args:
        warm: paths of sound inputs with their formats, which load what the readers import late.
    """

    def __init__(self, warm: Sequence[tuple[str, str]] = ()) -> None:
        self._warm = json.dumps(warm)

    def __enter__(self) -> Reader:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.attacking"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert self._process.stdin is not None
        self._process.stdin.write(self._warm + "\n")
        return self

    def __exit__(self, *exception: object) -> None:
        self._process.kill()
        self._process.communicate()

    def ask(self, path: Path, stated: str) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([str(path), stated]) + "\n")
        self._process.stdin.flush()
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer


def main() -> None:
    """Read the inputs that stdin names as JSON lines; answer with a line for each on stdout."""
    from pipelines.session.registries import FORMATS
    from tests.fuzz.reading import read_or_refuse  # loads the stages before memory is counted

    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    FORMATS.all()
    for path, stated in json.loads(sys.stdin.readline()):
        read_or_refuse(Path(path), stated)
    for line in sys.stdin:
        path, stated = json.loads(line)
        print(json.dumps(_measured(Path(path), stated)), file=answers, flush=True)


def _measured(path: Path, stated: str) -> dict[str, object]:
    """Read in a child; return time, memory and outcome."""
    out, into = os.pipe()
    child = os.fork()
    if not child:
        os.close(out)
        _read_as_child(path, stated, into)
    os.close(into)
    said = _all_of(out, child)
    _, status, used = os.wait4(child, 0)
    found: dict[str, Any] = {"read": 0, "refused": 0, "trouble": "", "line": ""}
    found |= json.loads(said) if said else {"trouble": f"ended by signal {os.waitstatus_to_exitcode(status)}"}
    cpu_s, mb = used.ru_utime + used.ru_stime, used.ru_maxrss / 1024
    if not found["trouble"] and (cpu_s > MOST_S or mb > MOST_MB):
        found["trouble"] = "too slow" if cpu_s > MOST_S else "too large"
    return {"cpu_s": cpu_s, "mb": mb, **found}


def _all_of(out: int, child: int) -> bytes:
    said, until = b"", time.monotonic() + _WAIT_S
    while select.select([out], [], [], max(0.0, until - time.monotonic()))[0]:
        part = os.read(out, 1 << 16)
        if not part:
            break
        said += part
    else:
        os.kill(child, signal.SIGKILL)
    os.close(out)
    return said


def _read_as_child(path: Path, stated: str, into: int) -> None:
    from tests.fuzz.reading import read_or_refuse

    resource.setrlimit(resource.RLIMIT_CPU, (_END_S, _END_S))
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_ADDRESSES, _MOST_ADDRESSES))
    resource.setrlimit(resource.RLIMIT_FSIZE, (_MOST_FILE, _MOST_FILE))
    warnings.simplefilter("error")  # a terminal would show them as lines of code
    lines: list[str] = []
    try:
        read, refused = read_or_refuse(path, stated, lines)
        answer: dict[str, object] = {"read": read, "refused": refused, "line": lines[0] if lines else ""}
    except BaseException:
        answer = {"trouble": traceback.format_exc()}
    os.write(into, json.dumps(answer).encode())
    os._exit(0)


if __name__ == "__main__":
    main()
