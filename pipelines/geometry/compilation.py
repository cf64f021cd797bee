"""Compilation of numerical functions with numba, with a cache on disk; a lost or bad cache is no error.

numba puts its cache beside the source, else in the user's cache folder, or in NUMBA_CACHE_DIR; where none of
them can be written, this module puts it among temporary files. numba compiles again if the file of the
outermost function changed. With this module, it does so also if the file of a
helper changed, and it compares what the files contain, not their age. The first compilation of a process is
logged, because it takes seconds. Of several processes that start together one compiles, and the others wait
for what it writes into the cache.

What the cache lacks is looked up among the code that `pipelines.precompile` put beside the program, and that
a wheel brings along. It is for every processor of the level `EVERY_PROCESSOR`, and for one version of numba
and of Python. With others it is not used.
"""

import hashlib
import logging
import os
import stat
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache, wraps
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, ParamSpec, TypeVar

import numba
from filelock import FileLock, Timeout
from llvmlite.binding import get_host_cpu_features
from numba.core import event
from numba.core.caching import IndexDataCacheFile

SHIPPED = Path(__file__).parents[1] / "data" / "compiled"
"""Folder of the code that comes with the program."""

EVERY_PROCESSOR = "x86-64-v3"
"""Processor that this code is for: x86-64 with AVX2, since 2013 (psABI of x86-64, table 3.1)."""

_NEEDED = ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")  # by that level

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
    """Compile a function that only compiled functions call; it becomes part of them.

    Without the wrapper for calls from Python, it compiles in three quarters of the time.
    """
    compiled: Callable[Arguments, Result] = numba.njit(function, no_cpython_wrapper=True, **_OPTIONS)
    return compiled


def cached(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Compile at the first call, release the interpreter while running, keep the code for the next process.

    numba's cache raises an error if it cannot be written (`RuntimeError` when decorating) or read (a file cut
    short by a full disk, or of an earlier version with types in other modules). In these cases the function
    is compiled for this process only, and an unreadable cache is emptied for the next process.
    """
    options = {"nogil": True, **_OPTIONS}
    try:
        compiled = _with_cache(function, options)
        _watch_helpers(compiled, function)
        _use_shipped(compiled)
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
    """Make numba's compiler of a function with a cache, for temporary files if need be.

    Raises:
        RuntimeError: there is no place for a cache.
    """
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
            LOGGER.info("compiling numerical functions for this processor, once: for up to a minute")

    def on_end(self, event: object) -> None:
        """Do nothing: only the beginning is announced."""

    _done = False


_ANNOUNCEMENT = _Announcement()
event.register("numba:compile", _ANNOUNCEMENT)


def dispatcher_of(function: Callable[..., object]) -> Any:
    """Return numba's compiler of a function that `cached` or `helper` made; None of any other function."""
    made = (getattr(cell, "cell_contents", None) for cell in function.__closure__ or ())
    return next((one for one in (function, *made) if hasattr(one, "py_func")), None)


def _watch_helpers(compiled: Any, function: Callable[..., object]) -> None:
    """Validate the cache by the contents of the files of the function and its helpers.

    numba has no public interface for this. If its internals differ, the cache checks the age of the outermost
    file.
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
        compiled._cache._cache_file._source_stamp = tuple(sorted(map(_content, files)))


def _content(name: str) -> bytes:
    """Hash a source file."""
    state = Path(name).stat()
    return _content_of(name, state.st_mtime_ns, state.st_size)


@cache
def _content_of(name: str, mtime_ns: int, size: int) -> bytes:  # noqa: ARG001  # the state keys the cache
    return hashlib.sha256(Path(name).read_bytes()).digest()


def has_code(function: Callable[..., object]) -> bool:
    """Test if there is any code of a function, for any types, that this process need not compile.

    Raises:
        AttributeError: nothing of the function is cached.
    """
    own = dispatcher_of(function)._cache
    if Path(own._cache_file._index_path).is_file():
        return True
    with suppress(*_UNREADABLE):
        return has_every_feature() and bool(_shipped(own)._load_index())
    return False


def outdated_files(functions: Iterable[Callable[..., object]]) -> list[Path]:
    """List the files beside the program, of this version of Python, that hold no code of these functions."""
    kept = {_shipped_index(dispatcher_of(function)._cache) for function in functions}
    tags = {index.stem.rpartition(".")[2] for index in kept}
    return [
        path
        for path in SHIPPED.glob("*/*")
        if not any(path.parent == index.parent and path.name.startswith(f"{index.stem}.") for index in kept)
        and any(f".{tag}." in path.name for tag in tags)
    ]


def _shipped(own: Any) -> Any:
    """Return numba's cache file of the code that comes with the program, beside a function's own cache."""
    index = _shipped_index(own)
    return IndexDataCacheFile(index.parent, index.stem, own._cache_file._source_stamp)


def _shipped_index(own: Any) -> Path:
    module: str = own._py_func.__module__
    return SHIPPED / module / f"{own._impl.filename_base}.nbi"


@cache
def has_every_feature() -> bool:
    """Test if this processor can run code for `EVERY_PROCESSOR`."""
    features = get_host_cpu_features()
    return all(features.get(name) for name in _NEEDED)


def _use_shipped(compiled: Any) -> None:
    """Look up what the cache lacks in the code that comes with the program.

    If numba compiles for `EVERY_PROCESSOR`, that code is the cache. numba has no public interface for this.
    """
    with suppress(AttributeError):
        own, load = compiled._cache, compiled._cache.load_overload
        index, shipped = _shipped_index(own), _shipped(own)
        if numba.config.CPU_NAME == EVERY_PROCESSOR:
            index.parent.mkdir(parents=True, exist_ok=True)
            own._cache_file = shipped
            return

        def load_or_take(signature: object, context: Any) -> object:
            found = load(signature, context)
            if found is None and own._enabled and index.is_file() and has_every_feature():
                types, (triple, _, _), code = own._index_key(signature, context.codegen())
                with suppress(*_UNREADABLE):
                    data = shipped.load((types, (triple, EVERY_PROCESSOR, ""), code))
                    found = None if data is None else own._impl.rebuild(context, data)
            return found

        own.load_overload = load_or_take


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
