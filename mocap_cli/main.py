"""The `mocap` command: its group, and the only place that turns errors into a line and an exit status."""

from __future__ import annotations

import errno
import os
import signal
import sys

# Shells expect this exit status after Ctrl-C.
_INTERRUPTED = 130
_CONTINUES = "mocap: interrupted; nothing is lost, the same command continues"


def _leave_at_once(*_: object) -> None:
    """Leave with one line. Many imports turn a KeyboardInterrupt into an error of their own."""
    if sys.stderr is not None:
        os.write(2, f"{_CONTINUES}\n".encode())
    os._exit(_INTERRUPTED)


def _interrupt(_: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, but leave at once while a module is loaded: compiled ones may lose it."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            _leave_at_once()
        frame = frame.f_back
    raise KeyboardInterrupt


_is_script = os.path.basename(sys.argv[0]) == "mocap"  # noqa: PTH119  # pathlib takes a while to import
if _is_script and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _leave_at_once)  # until the command is loaded

from contextlib import suppress  # noqa: E402
from importlib import import_module  # noqa: E402
from types import FrameType  # noqa: E402
from typing import Any  # noqa: E402

import click  # noqa: E402

from mocap_cli.terminal import one_line, say  # noqa: E402
from pipelines.session.errors import DataError, MocapError  # noqa: E402

COMMANDS = (
    *("run", "init", "ingest", "check", "reconstruct", "replan-compare", "report"),
    *("batch", "export", "simulate", "study"),
    *("info", "models"),
)
"""The commands in the order of their use. Each is `NAME_command` in the module `mocap_cli.NAME`."""


class Mocap(click.Group):
    """Group that prints errors in one line."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; an error that the user can correct is one line on stderr and exit status 1."""
        try:
            _refuse_little_memory()
            return super().invoke(ctx)
        except MocapError as error:
            print_error(error)
            ctx.exit(1)
        except click.UsageError as error:
            if error.ctx is not None and error.message == error.ctx.get_help():
                raise  # `mocap models` alone: click shows its help this way
            # Patterns of the shell expand to file names, which may hold any character.
            raise click.UsageError(one_line(error.format_message()), error.ctx) from None
        except KeyboardInterrupt:
            say(_CONTINUES, err=True)
            ctx.exit(_INTERRUPTED)
        except (MemoryError, ImportError, RuntimeError, SystemError, OSError) as error:
            if not _is_short_of_memory(error):
                raise
            print_error(OUT_OF_MEMORY)
            ctx.exit(1)


OUT_OF_MEMORY = DataError(
    "this machine",
    "has too little memory left for the command",
    "end other programs, raise the limit (`ulimit -v`), or state fewer --workers",
    code="out-of-memory",
)

# Libraries report memory that they do not get in these words, as errors of several kinds.
_SHORT_OF_MEMORY = (
    *("annot allocate memory", "failed to map segment", "start new thread", "std::bad_alloc"),
    *("load shared object file", "error return without exception set"),
)


# Below it, libraries in C++ end the process themselves, with words of their own.
MIN_ADDRESS_SPACE_BYTES = 1000 << 20
# These commands load more of such libraries.
LARGE_COMMANDS = {"run", "check", "reconstruct", "replan-compare", "report", "batch", "simulate", "study"}
# With less, OpenBLAS or COLMAP ended them in one run of three.
MIN_ADDRESS_SPACE_OF_LARGE_BYTES = 2000 << 20


def _refuse_little_memory() -> None:
    """Refuse a limit (`ulimit -v`) with which libraries cannot be loaded; other systems have none."""
    with suppress(ImportError):
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        is_large = sys.argv[1:2] and sys.argv[1] in LARGE_COMMANDS
        least = MIN_ADDRESS_SPACE_OF_LARGE_BYTES if is_large else MIN_ADDRESS_SPACE_BYTES
        if limit != resource.RLIM_INFINITY and limit < least:
            problem = f"lets a command have {limit >> 20} MiB of memory, and this one needs {least >> 20} MiB"
            raise DataError("this machine", problem, "raise the limit (`ulimit -v`)", code="out-of-memory")


def _is_short_of_memory(error: BaseException) -> bool:
    """Return True if an error, or the one that caused it, says that there is no memory left."""
    if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
        return True
    if any(words in str(error) for words in _SHORT_OF_MEMORY):
        return True
    return error.__cause__ is not None and _is_short_of_memory(error.__cause__)


# A refusal that is longer, without its file, goes on with a line for each of its parts.
MAX_LINE_CHARACTERS = 140


def print_error(error: MocapError) -> None:
    """Print an error as one line on stderr; what makes it long, and lines of flight.yaml, come below it."""
    from pipelines.session.description import as_instruction

    remedy = error.remedy if isinstance(error, DataError) else ""
    changes = [as_instruction(change) for change in remedy.split("; ")]
    source = f"{error.source}: " if isinstance(error, DataError) else ""
    parts = [str(error).removeprefix(source)]
    if len(parts[0]) > MAX_LINE_CHARACTERS or changes[0].startswith(("set cameras.", "set world.")):
        problems = parts[0].removesuffix(f"; {remedy}") if remedy else parts[0]
        parts = [*problems.split("; "), *(changes if remedy else [])]
    for number, part in enumerate(parts):
        say(f"  {one_line(part)}" if number else f"mocap: {one_line(source + part)}", err=True)


class _Lazy(Mocap):
    """Group of `COMMANDS` that imports a command when it is asked for, so that none waits for the others."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002  # click calls it so
        """List the commands in the order of their use."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command; for an unknown name all of them, from which click suggests the nearest."""
        for name in (cmd_name,) if cmd_name in COMMANDS else COMMANDS:
            module = name.replace("-", "_")
            self.add_command(getattr(import_module(f"mocap_cli.{module}"), f"{module}_command"))
        if signal.getsignal(signal.SIGINT) is _leave_at_once:
            signal.signal(signal.SIGINT, _interrupt)
        return super().get_command(ctx, cmd_name)


@click.group(cls=_Lazy, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(package_name="mocap-pipeline", prog_name="mocap")
def mocap() -> None:
    """From the flight logs and keypoints of a drone team to the 3D motion of the person it filmed.

    A flight.yaml describes a flight; `init` drafts it from the flight's files. `ingest` turns it into a
    session, a folder of plain tables. `reconstruct` measures the skeleton, `report` shows how far it can be
    trusted, and `export` writes it for other programs.
    """


def run() -> None:
    """Run the `mocap` script (its entry point)."""
    _open_closed_streams()
    try:
        mocap()
    except BrokenPipeError:
        # The reader of our output (head, a pager) went away: no reason for a traceback at exit.
        _leave_stdout()
    except OSError as error:
        say(f"mocap: cannot write its output ({error.strerror}); nothing else is lost", err=True)
        _leave_stdout()


def _open_closed_streams() -> None:
    """Open what the shell has closed (`2>&-`), or the next file that is opened would get what is printed."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115, PTH123
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115, PTH123


def _leave_stdout() -> None:
    """Exit with status 1 without writing the rest of the output."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(1)
