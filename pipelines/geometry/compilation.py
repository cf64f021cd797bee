"""Compilation of numerical functions with numba, with a cache on disk; a lost or bad cache is no error.

Where numba's own places for its cache cannot be written, it lies among temporary files. A function is
compiled again also if the file of a helper changed in its contents. The first compilation of a process is
logged, because it takes seconds. Of several processes that start together one compiles, and the others wait.
"""

import hashlib
import logging
import os
import stat
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache, wraps
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, ParamSpec, TypeVar

import numba
from filelock import FileLock, Timeout
from numba.core import event

LOGGER = logging.getLogger(__name__)
"""Logger of one line, at level INFO, when a process compiles for the first time."""

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


# The largest function compiles in ten seconds, and a slow machine may take many times as long.
_WAIT_S = 600.0

_UNREADABLE = (EOFError, UnpicklingError, OSError, ImportError, AttributeError)
"""Errors of code that was cut short, or whose types are in other modules by now."""

_OPTIONS = {
    "error_model": "numpy",  # a division by zero gives inf, as in arrays
    "no_cfunc_wrapper": True,  # nothing here is called from C
}


def helper(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Compile a function that compiled ones alone call: no wrapper for Python, 3/4 of the time."""
    compiled: Callable[Arguments, Result] = numba.njit(function, no_cpython_wrapper=True, **_OPTIONS)
    return compiled


def cached(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Compile at the first call (in this process only where numba's cache fails); release the interpreter."""
    options = {"nogil": True, **_OPTIONS}
    try:
        compiled = _with_cache(function, options)
        _watch_helpers(compiled, function)
        _compile_in_one_process(compiled)
    except RuntimeError:
        uncached: Callable[Arguments, Result] = numba.njit(function, **options)
        return uncached

    @wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        try:
            result: Result = compiled(*args, **kwargs)
        except _UNREADABLE:
            with suppress(OSError):
                compiled._cache.flush()
            compiled._cache.disable()
            result = compiled(*args, **kwargs)
        return result

    return call


def _with_cache(function: Callable[Arguments, Result], options: dict[str, Any]) -> Any:
    """Make numba's compiler with a cache, else among temporary files; RuntimeError: there is no place."""
    try:
        return numba.njit(function, cache=True, **options)
    except RuntimeError:
        folder = Path(tempfile.gettempdir()) / f"mocap-numba-{os.getuid()}"
        with suppress(OSError):
            folder.mkdir(mode=0o700, exist_ok=True)
            state = folder.lstat()
            # The cache is code: nobody else may write it.
            if stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and not state.st_mode & 0o077:
                numba.config.CACHE_DIR = str(folder)
        return numba.njit(function, cache=True, **options)


class _Announcement(event.Listener):  # type: ignore[misc]  # numba has no types
    """Log line at the first compilation of the process; code from the cache is not compiled."""

    def on_start(self, event: object) -> None:  # noqa: ARG002  # numba calls it so
        """Log the line once."""
        if not self._done:
            self._done = True
            LOGGER.info("compiling numerical functions for this processor, once: for a minute at most")

    def on_end(self, event: object) -> None:
        """Do nothing: only the beginning is announced."""

    _done = False


_ANNOUNCEMENT = _Announcement()
event.register("numba:compile", _ANNOUNCEMENT)


def _watch_helpers(compiled: Any, function: Callable[..., object]) -> None:
    """Validate numba's cache by the files of the function and its helpers, if its internals allow."""
    files = {function.__code__.co_filename}
    waiting = [function]
    while waiting:
        for value in waiting.pop().__globals__.values():
            source = getattr(value, "py_func", None)
            if source is not None and source.__code__.co_filename not in files:
                files.add(source.__code__.co_filename)
                waiting.append(source)
    with suppress(AttributeError, OSError):
        compiled._cache._cache_file._source_stamp = tuple(sorted(map(_content, files)))


def _content(name: str) -> bytes:
    state = Path(name).stat()
    return _content_of(name, state.st_mtime_ns, state.st_size)


@cache
def _content_of(name: str, mtime_ns: int, size: int) -> bytes:  # noqa: ARG001  # the state keys the cache
    return hashlib.sha256(Path(name).read_bytes()).digest()


def _compile_in_one_process(compiled: Any) -> None:
    """Let processes that find nothing in the cache compile one after the other, and look again before.

    The lock is the kernel's, on a file beside the cache's index, so it ends with the process. Where it cannot
    be made, every process compiles. numba has no public interface for this either.
    """
    with suppress(AttributeError):
        cache, load, compile_ = compiled._cache, compiled._cache.load_overload, compiled.compile
        index = Path(cache._cache_file._index_path)
        locks: list[FileLock] = []

        def load_or_wait(signature: object, context: object) -> object:
            found = load(signature, context)
            if found is None and cache._enabled:
                _ANNOUNCEMENT.on_start(None)
                with suppress(OSError, Timeout):
                    index.parent.mkdir(parents=True, exist_ok=True)
                    lock = FileLock(index.with_suffix(".lock"))
                    lock.acquire(timeout=_WAIT_S)
                    locks.append(lock)
                    found = load(signature, context)
            return found

        def compile_once(signature: object) -> object:
            try:
                return compile_(signature)
            finally:
                while locks:
                    locks.pop().release()

        cache.load_overload, compiled.compile = load_or_wait, compile_once
