"""Options that several commands share, each declared once."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])

any_path = click.Path(path_type=Path)
"""A path that click does not check: the function that reads it reports a missing path or a wrong kind."""

overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Write where something else lies. Never done without this."
)
force_option = click.option(
    "--force",
    is_flag=True,
    help="Make everything that the command makes again although inputs and settings did not change.",
)
json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print the result as JSON; everything else goes to stderr."
)


every_option = click.option(
    "--every",
    type=click.IntRange(1, 1000),
    default=1,
    show_default=True,
    metavar="N",
    help="Let the detector look at every N-th picture only.",
)


provider_option = click.option(
    "--provider",
    metavar="NAME",
    help="ONNX Runtime's execution provider that runs the models of --detector onnx:..., such as cuda"
    " [default: cpu].",
)


def with_provider(detector: str, provider: str | None) -> str:
    """Add the provider to the detector's options, where one was asked for."""
    if provider is None:
        return detector
    if ":" not in detector:
        raise click.BadParameter(
            f"{detector} is not run by ONNX Runtime: leave it out, or write --detector onnx:MODEL.onnx",
            param_hint="--provider",
        )
    return f"{detector},provider={provider}"


def workers_option(help_text: str) -> Callable[[Command], Command]:
    """Make the option --workers of a simulation; two by default."""
    return click.option(
        "--workers", type=click.IntRange(1, 256), default=2, show_default=True, help=help_text
    )


def seed_option(help_text: str) -> Callable[[Command], Command]:
    """Make the option --seed of random numbers."""
    return click.option(
        "--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True, help=help_text
    )


class FiniteRange(click.FloatRange):
    """A range of numbers that refuses NaN and infinity, which click accepts."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert the value to a number, or raise a usage error."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is no finite number.", param, ctx)
        return number


def verbosity_options(command: Command) -> Command:
    """Add -q and -v; the command takes `quiet: bool` and `verbose: int`."""
    quiet = click.option("-q", "--quiet", is_flag=True, help="Say only where the result is, and errors.")
    verbose = click.option("-v", "--verbose", count=True, help="Say more.")
    return quiet(verbose(command))


def level(quiet: bool, verbose: int) -> int:
    """Combine both to one number: -1 is quiet, 0 is normal, 1 and above is more."""
    return -1 if quiet else verbose
