"""Compilation of the numerical functions before their first use, so that no command has to wait for it.

numba compiles a function for the types of its arguments. data/kernels.json lists the functions and types that
reconstruction and replay call (`python -m benchmarks.kernels --write` makes it from a flight). All others are
compiled at their first use.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from importlib.resources import files
from itertools import cycle
from typing import Any

from pipelines.session.progress import Progress, Silent

Signatures = dict[str, list[list[object]]]
"""Types of the arguments of each function, by `module:name`, as JSON."""


def listed() -> Signatures:
    """Read the list of functions."""
    text = (files("pipelines") / "data" / "kernels.json").read_text(encoding="utf-8")
    signatures: Signatures = json.loads(text)
    return signatures


def precompile(workers: int, progress: Progress | None = None) -> int:
    """Compile all functions of the list that are not in numba's cache yet, and return their number.

    Args:
        workers: the number of processes; each compiles every so-manieth function, largest first.
    """
    progress = progress or Silent()
    names = list(listed())
    progress.start("Compiling", len(names))
    shares: list[list[str]] = [[] for _ in range(workers)]
    for name, share in zip(names, cycle(shares), strict=False):
        share.append(name)
    running = [
        subprocess.Popen(  # noqa: S603
            [sys.executable, "-m", "pipelines.precompile", *share], stdout=subprocess.PIPE, text=True
        )
        for share in shares
        if share
    ]
    compiled = 0
    for process in running:
        assert process.stdout is not None  # noqa: S101  # it is a pipe
        for line in process.stdout:
            compiled += int(line)
            progress.advance()
        process.wait()
    return compiled


def compile_function(name: str, signatures: Sequence[Sequence[object]]) -> bool:
    """Compile a function for types of arguments; return False if all came from the cache, or it is not there.

    Args:
        name: `module:name`.
        signatures: types of the arguments, as in the list.
    """
    from pipelines.geometry.compilation import dispatcher_of

    module, _, function = name.partition(":")
    with suppress(ImportError, AttributeError, TypeError):  # a list older than the code
        dispatcher = dispatcher_of(getattr(import_module(module), function))
        for signature in signatures:
            dispatcher.compile(tuple(type_of(each) for each in signature))
        return bool(sum(dispatcher.stats.cache_misses.values()))
    return False


def type_of(text: object) -> Any:
    """Make numba's type from its entry in the list: `float64`, `float64 2C` or {class: [types]}."""
    types: Any = import_module("numba.core.types")

    if isinstance(text, Mapping):
        [(name, fields)] = text.items()
        module, _, kind = name.partition(":")
        named = getattr(import_module(module), kind) if kind else None
        return types.BaseTuple.from_types([type_of(field) for field in fields], named)
    scalar, _, array = str(text).partition(" ")
    dtype = getattr(types, scalar)
    return types.Array(dtype, int(array[:-1]), array[-1]) if array else dtype


def entry_of(kind: Any) -> object:
    """Make the entry of the list from numba's type: the inverse of `type_of`."""
    types: Any = import_module("numba.core.types")

    if isinstance(kind, types.BaseTuple):
        made = getattr(kind, "instance_class", tuple)
        name = "tuple" if made is tuple else f"{made.__module__}:{made.__qualname__}"
        return {name: [entry_of(field) for field in kind.types]}
    if isinstance(kind, types.Array):
        return f"{kind.dtype} {kind.ndim}{kind.layout}"
    return str(kind)


if __name__ == "__main__":
    if not sys.argv[1:]:
        precompile(os.cpu_count() or 1)
    everything = listed()
    for one in sys.argv[1:]:
        print(int(compile_function(one, everything[one])), flush=True)  # noqa: T201  # read by precompile
