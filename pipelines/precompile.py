"""Compilation of the numerical functions before their first use, so that no command has to wait for it.

numba compiles a function for the types of its arguments. data/kernels.json lists the functions and types that
simulation, reconstruction and replay call (`python tools/kernels.py --write` makes it from a flight).
All others are compiled at their first use.

`python -m pipelines.precompile` compiles them for every processor of a level and puts the code beside the
program (`compilation.SHIPPED`). From there it goes into the wheel. Where that code does not hold, the first
command compiles for its own processor.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from enum import StrEnum
from importlib import import_module
from importlib.resources import files
from itertools import cycle
from typing import Any, Literal

from pipelines.session.progress import Progress, Silent

Signatures = dict[str, list[list[object]]]
"""Types of the arguments of each function, by `module:name`, as JSON."""


def listed() -> Signatures:
    """Read the list of functions."""
    text = (files("pipelines") / "data" / "kernels.json").read_text(encoding="utf-8")
    signatures: Signatures = json.loads(text)
    return signatures


def precompile(
    workers: int,
    progress: Progress | None = None,
    names: Sequence[str] | None = None,
    environment: Mapping[str, str] | None = None,
) -> list[str]:
    """Compile functions of the list that are not in numba's cache yet.

    Args:
        workers: the number of processes; functions are dealt out to them, largest first.
        names: the functions; by default all.
        environment: variables of these processes, beside those of this one.

    Returns:
        The functions of the list that do not exist, or not for the listed types. They are compiled at their
        first use, like all that the list lacks.
    """
    progress = progress or Silent()
    names = list(listed()) if names is None else names
    progress.start("Compiling", len(names))
    shares: list[list[str]] = [[] for _ in range(workers)]
    for name, share in zip(names, cycle(shares), strict=False):
        share.append(name)
    running = [
        subprocess.Popen(  # noqa: S603
            [sys.executable, "-m", "pipelines.precompile", *share],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # what fails is an outcome
            env={**os.environ, **(environment or {})},
            text=True,
            start_new_session=True,  # Ctrl-C reaches them by their parent alone
        )
        for share in shares
        if share
    ]
    outdated: list[str] = []
    try:
        for process in running:
            assert process.stdout is not None  # noqa: S101  # it is a pipe
            for line in process.stdout:
                name, _, outcome = line.rpartition(" ")
                if outcome.strip() == Outcome.OUTDATED:
                    outdated.append(name)
                progress.advance()
    finally:
        for process in running:
            process.terminate()
            process.communicate()
    return outdated


def precompile_for(stage: Literal["reconstruct", "replan"], progress: Progress) -> None:
    """Compile the functions of a stage on all cores, with one line, if this machine has few of them.

    Without it, the stage compiles them one after the other.
    """
    names = [
        name
        for name in listed()
        if name.startswith("pipelines.planning.") == (stage == "replan")
        and not name.startswith("pipelines.simulation.")
    ]
    if 2 * sum(map(is_compiled, names)) >= len(names):  # not all: an outdated one never is
        return
    progress.note("compiling numerical functions for this processor, once")
    precompile(os.cpu_count() or 1, progress, names)


def is_compiled(name: str) -> bool:
    """Test if there is any code of a function; True where there can be no cache."""
    from pipelines.geometry.compilation import has_code

    try:
        return has_code(_function(name))
    except (ImportError, AttributeError):
        return True


class Outcome(StrEnum):
    """Result of compiling a function of the list."""

    COMPILED = "compiled"
    CACHED = "cached"
    OUTDATED = "outdated"  # the list is older than the code


def compile_function(name: str, signatures: Sequence[Sequence[object]]) -> Outcome:
    """Compile a function for types of arguments, unless all comes from the cache.

    Args:
        name: `module:name`.
        signatures: types of the arguments, as in the list.
    """
    from numba.core.errors import NumbaError

    from pipelines.geometry.compilation import dispatcher_of

    try:
        dispatcher = dispatcher_of(_function(name))
        for signature in signatures:
            dispatcher.compile(tuple(type_of(each) for each in signature))
    except (ImportError, AttributeError, TypeError, NumbaError):
        return Outcome.OUTDATED
    return Outcome.COMPILED if sum(dispatcher.stats.cache_misses.values()) else Outcome.CACHED


def _function(name: str) -> Any:
    module, _, function = name.partition(":")
    return getattr(import_module(module), function)


def type_of(text: object) -> Any:
    """Make numba's type from its entry in the list: `float64`, `float64 2C` or {class: [types]}.

    `uint8 1C const` is an array that cannot be written into, as one of a file's bytes.
    """
    types: Any = import_module("numba.core.types")

    if isinstance(text, Mapping):
        [(name, fields)] = text.items()
        module, _, kind = name.partition(":")
        named = getattr(import_module(module), kind) if kind else None
        return types.BaseTuple.from_types([type_of(field) for field in fields], named)
    scalar, _, array = str(text).partition(" ")
    dtype = getattr(types, scalar)
    if not array:
        return dtype
    shape, _, const = array.partition(" ")
    return types.Array(dtype, int(shape[:-1]), shape[-1], readonly=const == "const")


def entry_of(kind: Any) -> object:
    """Make the entry of the list from numba's type: the inverse of `type_of`."""
    types: Any = import_module("numba.core.types")

    if isinstance(kind, types.BaseTuple):
        made = getattr(kind, "instance_class", tuple)
        name = "tuple" if made is tuple else f"{made.__module__}:{made.__qualname__}"
        return {name: [entry_of(field) for field in kind.types]}
    if isinstance(kind, types.Array):
        return f"{kind.dtype} {kind.ndim}{kind.layout}{'' if kind.mutable else ' const'}"
    return str(kind)


def _for_every_processor() -> dict[str, str]:
    """Return the variables with which numba compiles what comes with the program.

    There are none if this processor is of another kind.
    """
    from pipelines.geometry.compilation import EVERY_PROCESSOR, has_every_feature

    return {"NUMBA_CPU_NAME": EVERY_PROCESSOR, "NUMBA_CPU_FEATURES": ""} if has_every_feature() else {}


def main(names: Sequence[str]) -> None:
    """Compile functions and print the outcome of each; without names all, and exit 1 if any is outdated."""
    from pipelines.geometry.compilation import outdated_files

    if not names:
        outdated = precompile(os.cpu_count() or 1, environment=_for_every_processor())
        if outdated:
            raise SystemExit(f"pipelines/data/kernels.json is older than the code of {', '.join(outdated)}")
        for path in outdated_files(map(_function, listed())):
            path.unlink()
    everything = listed()
    for name in names:
        print(name, compile_function(name, everything[name]), flush=True)  # noqa: T201  # read by precompile


if __name__ == "__main__":
    main(sys.argv[1:])
