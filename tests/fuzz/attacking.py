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
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

from tests.fuzz.crafted import Crafted

MOST_S = 10.0
MOST_MB = 1000
_END_S = 15  # of processor time: an input that needs more is ended
_COMPUTING_END_S = 60  # of processor time: a command that needs more is ended
_WAIT_S = 300.0
_MOST_ADDRESSES = 16 << 30  # bytes: a reader that asks for more gets an error, and the machine goes on
_MOST_FILE = 4 << 30  # bytes
_CHANGES = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "shutil.rmtree", "shutil.copytree"}
_LEFT_OUT = {  # as in tests/commands: half of the time of reconstructing and of drawing pages
    "pipelines.reconstruct.doubts_of": lambda *_, **__: [],
    "pipelines.reporting.chart._inline_svg": lambda *_: "<svg></svg>",
}


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
            yield reader.met(crafted.kind, crafted.what, place / crafted.entry, crafted.stated)
            shutil.rmtree(place)


@dataclass(frozen=True)
class Command:
    """`mocap` command; what it prints goes to the files `printed` and `told` of its folder."""

    arguments: Sequence[str]
    most_mb: int | None = None  # of addresses: with a limit it is a process that loads everything itself
    public: str = ""  # an address of this machine that stands for one of the Internet
    touched: str = ""  # a file for the names of all that it opens to write, makes, moves and removes


class Reader:
    """Process with all readers loaded, which forks one for each input."""

    def __init__(self, warm: Sequence[tuple[str, str]] = ()) -> None:
        # Paths of sound inputs with their formats load what the readers import late.
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

    def met(self, kind: str, what: str, path: Path, stated: str) -> Met:
        """Read an input, alone in its folder."""
        size = sum(file.stat().st_size for file in path.parent.rglob("*") if file.is_file())
        answer = self.ask(path, stated)
        del answer["status"]
        return Met(kind, what, size, **answer)

    def ask(
        self, path: Path, stated: str, command: Command | None = None, *, most_s: float = MOST_S
    ) -> dict[str, Any]:
        """Read an input, or run a command in a folder; return what `Met` says, or the command's `status`."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        asked = [str(path), stated, None if command is None else asdict(command), most_s]
        self._process.stdin.write(json.dumps(asked) + "\n")
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
        path, stated, command, most_s = json.loads(line)
        child = partial(_run_as_child, Path(path), Command(**command)) if command else None
        done = _measured(child or partial(_read_as_child, Path(path), stated), most_s)
        print(json.dumps(done), file=answers, flush=True)


def _measured(act: Callable[[int], None], most_s: float) -> dict[str, object]:
    """Act in a child, which gets a pipe for its answer; return time, memory and outcome."""
    out, into = os.pipe()
    child = os.fork()
    if not child:
        os.close(out)
        act(into)
    os.close(into)
    said = _all_of(out, child)
    _, status, used = os.wait4(child, 0)
    ended = os.waitstatus_to_exitcode(status)
    found: dict[str, Any] = {"read": 0, "refused": 0, "trouble": "", "line": "", "status": ended}
    found |= json.loads(said) if said else {"trouble": f"ended by signal {-ended}" if ended < 0 else ""}
    cpu_s, mb = used.ru_utime + used.ru_stime, used.ru_maxrss / 1024
    if not found["trouble"] and (cpu_s > most_s or mb > MOST_MB):
        found["trouble"] = "too slow" if cpu_s > most_s else "too large"
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


def _run_as_child(folder: Path, command: Command, into: int) -> None:
    """Run a command as its process would; the pipe is open until it ends."""
    from mocap_cli.main import run
    from pipelines.session import urls
    from tests.commands.runner import MOCAP

    for number, name in enumerate((os.devnull, "printed", "told")):
        os.dup2(os.open(folder / name, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
    os.chdir(folder)
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    sys.argv = [MOCAP, *command.arguments]
    resource.setrlimit(resource.RLIMIT_CPU, (_COMPUTING_END_S, _COMPUTING_END_S))
    resource.setrlimit(resource.RLIMIT_FSIZE, (_MOST_FILE, _MOST_FILE))
    if command.most_mb is not None:
        os.set_inheritable(into, True)
        resource.setrlimit(resource.RLIMIT_AS, (command.most_mb << 20, command.most_mb << 20))
        os.execv(MOCAP, sys.argv)  # noqa: S606
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_ADDRESSES, _MOST_ADDRESSES))
    public = urls.is_public
    status: object = 1
    touched = set[str]()

    def note(event: str, given: tuple[Any, ...]) -> None:
        if event in _CHANGES and (event != "open" or (given[2] or 0) & (os.O_WRONLY | os.O_RDWR)):
            touched.update(str(path) for path in given[:2] if isinstance(path, str | Path))

    if command.touched:
        sys.addaudithook(note)
    try:
        with ExitStack() as stack:
            for place, instead in _LEFT_OUT.items():
                stack.enter_context(patch(place, instead))
            seems_public = lambda address: address == command.public or public(address)  # noqa: E731
            stack.enter_context(patch.object(urls, "is_public", seems_public))
            run()
    except SystemExit as ended:
        status = ended.code
    except BaseException:
        traceback.print_exc()
    if command.touched:
        Path(command.touched).write_text("\n".join(sorted(touched)), encoding="utf-8")
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status if isinstance(status, int) else 1)


if __name__ == "__main__":
    main()
