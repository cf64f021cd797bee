"""Compiling numerical functions with numba, with a cache on disk that can be lost but never in the way.

numba puts its cache beside the source, else in the user's cache folder, or where NUMBA_CACHE_DIR says.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from pickle import UnpicklingError
from typing import ParamSpec, TypeVar

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
    short by a full disk). Here the function is compiled for this process alone instead, and a damaged
    cache is emptied for the next one.
    """
    options = {"nogil": True, **_OPTIONS}
    try:
        compiled = numba.njit(function, cache=True, **options)
    except RuntimeError:
        uncached: Callable[Arguments, Result] = numba.njit(function, **options)
        return uncached

    @wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        try:
            result: Result = compiled(*args, **kwargs)
        except (EOFError, UnpicklingError, OSError):
            with suppress(OSError):
                compiled._cache.flush()
            compiled._cache.disable()
            result = compiled(*args, **kwargs)
        return result

    return call
