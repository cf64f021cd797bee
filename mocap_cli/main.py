"""The `mocap` command: its group, and the only place that turns errors into a line and an exit status."""

import os
import sys
from importlib import import_module
from typing import Any

import click

from mocap_cli.terminal import one_line, say
from pipelines.session.errors import MocapError

COMMANDS = (
    *("init", "ingest", "check", "reconstruct", "replan-compare", "report"),
    *("batch", "export", "simulate", "study"),
    *("info", "models"),
)
"""The commands in the order of their use. Each is `NAME_command` in the module `mocap_cli.NAME`."""

_GONE = {
    "ablate": "`mocap study tilt_deg=0:60:15`, robots=... or noise=...",
    "replan-sweep": "`mocap study range_m=8,10 SESSION`",
}
_INTERRUPTED = 130  # the exit status that shells expect after Ctrl-C


class Mocap(click.Group):
    """Group that prints errors in one line."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; an error that the user can correct is one line on stderr and exit status 1."""
        try:
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
            say("mocap: interrupted; nothing is lost, the same command continues", err=True)
            ctx.exit(_INTERRUPTED)


def print_error(error: MocapError) -> None:
    """Print an error as one line on stderr."""
    say(f"mocap: {one_line(str(error))}", err=True)


class _Lazy(Mocap):
    """Group of `COMMANDS` that imports a command when it is asked for, so that none waits for the others."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002  # click calls it so
        """List the commands in the order of their use."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command; for an unknown name all of them, from which click suggests the nearest."""
        if cmd_name in _GONE:
            raise click.UsageError(f"{cmd_name} does not exist any more: write {_GONE[cmd_name]}.", ctx)
        for name in (cmd_name,) if cmd_name in COMMANDS else COMMANDS:
            module = name.replace("-", "_")
            self.add_command(getattr(import_module(f"mocap_cli.{module}"), f"{module}_command"))
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
    try:
        mocap()
    except BrokenPipeError:
        # The reader of our output (head, a pager) went away: no reason for a traceback at exit.
        _leave_stdout()
    except OSError as error:
        say(f"mocap: cannot write its output ({error.strerror}); nothing else is lost", err=True)
        _leave_stdout()


def _leave_stdout() -> None:
    """Exit with status 1 without writing the rest of the output."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(1)
