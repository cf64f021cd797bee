"""Options that several commands share, each declared once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])

existing_file = click.Path(exists=True, dir_okay=False, path_type=Path)
existing_path = click.Path(exists=True, path_type=Path)
folder = click.Path(file_okay=False, path_type=Path)

session_argument = click.argument(
    "session", type=click.Path(exists=True, file_okay=False, path_type=Path), metavar="SESSION"
)
overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Write where something else lies. Never done without this."
)
force_option = click.option(
    "--force", is_flag=True, help="Do it again although inputs and settings did not change."
)
json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print the result as JSON; everything else goes to stderr."
)


def verbosity_options(command: Command) -> Command:
    """Add -q and -v; the command takes `quiet: bool` and `verbose: int`."""
    quiet = click.option("-q", "--quiet", is_flag=True, help="Say nothing but errors and the result.")
    verbose = click.option("-v", "--verbose", count=True, help="Say more.")
    return quiet(verbose(command))


def level(quiet: bool, verbose: int) -> int:
    """One number for both: -1 quiet, 0 as usual, 1 and above more."""
    return -1 if quiet else verbose
