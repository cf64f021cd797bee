"""Options that several commands share, each declared once."""

import functools
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])

Option = Callable[[Any], Any]
"""A decorator that adds one or several options to a command."""


def grouped(name: str, make: Callable[..., Any], *options: Option) -> Callable[[Command], Command]:
    """Add options to a command that takes their values together.

    Args:
        name: of the command's argument.
        make: called with the values by the names of the options' parameters; a dataclass, or a function.
        options: in the order of the help text.
    """

    def decorated(command: Command) -> Command:
        @functools.wraps(command)
        def run(*arguments: Any, **values: Any) -> Any:
            own = {parameter.name: values.pop(parameter.name) for parameter in added}
            return command(*arguments, **{name: make(**own)}, **values)

        before = len(getattr(run, "__click_params__", ()))
        for option in reversed(options):
            option(run)
        added = tuple(run.__click_params__[before:])  # type: ignore[attr-defined]
        return run  # type: ignore[return-value]

    return decorated


any_place = click.Path(path_type=Path)
"""A path or URL that click does not check: the function that reads it reports what is wrong with it."""


class _PathHere(click.Path):
    """Path on this machine."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Refuse a URL, of which a folder with a strange name would be made."""
        if is_url(value):
            self.fail(f"{str(value)!r} is a URL, and must be a path here.", param, ctx)
        return super().convert(value, param, ctx)


def is_url(place: Path | str) -> bool:
    """Return True for a place in an object store."""
    if ":/" not in str(place):
        return False
    from pipelines.session.storage import url_of

    return url_of(place) is not None


any_path = _PathHere(path_type=Path)
"""A path that click does not check: the function that reads it reports a missing path or a wrong kind."""

overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace what lies at the output. Never done without this."
)
force_option = click.option(
    "--force",
    is_flag=True,
    help="Make everything that the command makes again although inputs and settings did not change.",
)
json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print the result as JSON; everything else goes to stderr."
)


@dataclass(frozen=True)
class ChosenPictures:
    """The pictures that the detector looks at."""

    start_s: float | None = None  # since the flight's first picture
    end_s: float | None = None
    every: int = 1


class _Pictures(click.ParamType[ChosenPictures]):
    """`[START]:[END][:N]`: seconds since the flight's first picture, and every N-th picture."""

    name = "pictures"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> ChosenPictures:
        """Convert the value, or raise a usage error."""
        if isinstance(value, ChosenPictures):
            return value
        parts = str(value).split(":")
        try:
            start_s, end_s = (float(part) if part else None for part in parts[:2])
            every = int(parts[2]) if len(parts) > 2 and parts[2] else 1
        except ValueError:
            parts = []
        if not 2 <= len(parts) <= 3:
            self.fail(f"{value!r} is not like 2:10 (seconds) or ::5 (every fifth).", param, ctx)
        if not 1 <= every <= 1000:
            self.fail(f"{every} is not from 1 to 1000.", param, ctx)
        if any(end is not None and not 0 <= end <= 1e9 for end in (start_s, end_s)):
            self.fail(f"{value!r} has a time that is not from 0 to 1e9 s.", param, ctx)
        if start_s is not None and end_s is not None and start_s >= end_s:
            self.fail(f"{end_s:g} s is not after {start_s:g} s.", param, ctx)
        return ChosenPictures(start_s, end_s, every)


pictures_option = click.option(
    "--pictures",
    type=_Pictures(),
    default=ChosenPictures(),
    metavar="[START]:[END][:N]",
    help="Pictures that the detector looks at: from START up to END, in seconds since the flight's first"
    " picture, and of these every N-th, as in 2:10, ::5 or 2:10:5 [default: all].",
)


def scheduler_option(help_text: str) -> Option:
    """Make the option --scheduler, the address of a Dask cluster."""
    return click.option(
        "--scheduler",
        metavar="tcp://HOST:PORT",
        help=f"{help_text} Its machines see the same folders under the same paths.",
    )


cores_option = click.option(
    "--workers",
    type=click.IntRange(1, 256),
    default=lambda: os.cpu_count() or 1,
    show_default="all cores",
    help="Threads and processes; the result does not depend on them.",
)


def workers_option(help_text: str) -> Callable[[Command], Command]:
    """Make the option --workers of a simulation; two by default."""
    return click.option(
        "--workers", type=click.IntRange(1, 256), default=2, show_default=True, help=help_text
    )


class FiniteRange(click.FloatRange):
    """A range of numbers that refuses NaN and infinity, which click accepts."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert the value to a number, or raise a usage error."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is no finite number.", param, ctx)
        return number


@dataclass(frozen=True)
class Shown:
    """The values of the options on what a command prints."""

    as_json: bool
    quiet: bool
    verbose: bool

    @property
    def level(self) -> int:
        """Both of -q and -v: -1 is quiet, 0 is normal, 1 is more."""
        return -1 if self.quiet else int(self.verbose)


output_options = grouped(
    "shown",
    lambda as_json, quiet: Shown(as_json, quiet is True, quiet is False),
    json_option,
    click.option(
        "-q/-v",
        "--quiet/--verbose",
        default=None,
        help="Print only the place of the result, and errors; or print more than usual.",
    ),
)
"""--json, -q and -v; the command takes `shown: Shown`."""
