"""Compiling numerical functions with numba, with a cache on disk that can be lost but never in the way.

numba puts its cache beside the source, else in the user's cache folder, or where NUMBA_CACHE_DIR says. It
compiles again where the file of the outermost function changed; here, where a helper's file did, too.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, ParamSpec, TypeVar

import numba

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


_OPTIONS = {
    "error_model": "numpy",  # a division by zero gives inf, as everywhere in arrays
    "no_cfunc_wrapper": True,  # nothing here is called by way of C
}


def helper(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Compile a function that compiled functions call, and they alone; it becomes part of them.

    Without what Python would need to call it, it compiles in three quarters of the time.
    """
    compiled: Callable[Arguments, Result] = numba.njit(function, no_cpython_wrapper=True, **_OPTIONS)
    return compiled


def cached(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Compile at the first call, release the interpreter while running, keep the code for the next process.

    numba's cache raises where it cannot be written (`RuntimeError` when decorating) or read (a file cut
    short by a full disk, or of an earlier version, whose types stood in other modules). Here the function is
    compiled for this process alone instead, and such a cache is emptied for the next one.
    """
    options = {"nogil": True, **_OPTIONS}
    try:
        compiled = numba.njit(function, cache=True, **options)
        _watch_helpers(compiled, function)
    except RuntimeError:
        uncached: Callable[Arguments, Result] = numba.njit(function, **options)
        return uncached

    @wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        try:
            result: Result = compiled(*args, **kwargs)
        except (EOFError, UnpicklingError, OSError, ImportError, AttributeError):
            with suppress(OSError):
                compiled._cache.flush()
            compiled._cache.disable()
            result = compiled(*args, **kwargs)
        return result

    return call


def _watch_helpers(compiled: Any, function: Callable[..., object]) -> None:
    """Make the age and size of the files that hold helpers part of what the cache is compared by.

    numba has no way to say so: where its inside is another, its cache watches the outermost file, as always.
    """
    files = {function.__code__.co_filename}
    waiting = [function]
    while waiting:
        for value in waiting.pop().__globals__.values():
            source = getattr(value, "py_func", None)
            if source is not None and source.__code__.co_filename not in files:
                files.add(source.__code__.co_filename)
                waiting.append(source)
    with suppress(AttributeError, OSError):
        states = [Path(name).stat() for name in sorted(files)]
        compiled._cache._cache_file._source_stamp = tuple((state.st_mtime, state.st_size) for state in states)
