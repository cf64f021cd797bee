"""Parts of one flight on several processes, or on the machines of a Dask cluster, through one executor.

The result of a part depends on its arguments and on the session alone. It travels back to the process that
holds the session's lock, and only that process writes. Arrays that wait stand in a file.
"""

import ctypes
import gc
import logging
import mmap
import multiprocessing
import os
import pickle
import signal
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryFile
from threading import Thread
from typing import Any, Self, TypeVar
from weakref import WeakSet

from pipelines.session.errors import DataError
from pipelines.session.progress import Progress
from pipelines.session.registries import need
from pipelines.session.stages import Session

# A scheduler on the same network answers within a second. A busy one may take longer.
SCHEDULER_ANSWER_TIMEOUT_S = 20.0

T = TypeVar("T")
R = TypeVar("R")


def each_part(
    work: Callable[[T], R], parts: Sequence[T], *, workers: int = 1, executor: Executor | None = None
) -> Generator[tuple[int, R]]:
    """Call a function with every part; yield number and result as they end. One worker is this process."""
    workers = min(workers, len(parts))
    if executor is None and (workers < 2 or multiprocessing.current_process().daemon):
        yield from ((number, work(part)) for number, part in enumerate(parts))
        return
    with _processes(workers) if executor is None else nullcontext(executor) as pool:
        numbers = {pool.submit(work, part): number for number, part in enumerate(parts)}
        try:
            for future in as_completed(list(numbers)):
                yield numbers.pop(future), result_of(future, "a part of the flight")
        finally:
            for future in numbers:
                future.cancel()


@contextmanager
def _processes(count: int) -> Iterator[Executor]:
    """Start processes, which end at once when the context is left."""
    pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), initializer=_end_with_parent)
    try:
        yield pool
    finally:
        # Nobody waits for the minute that a part may still take.
        for process in list((pool._processes or {}).values()):
            process.terminate()
        pool.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    """Leave Ctrl-C to the process that gave the parts, and end when that has ended, however it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
        os._exit(1)

    Thread(target=wait, daemon=True).start()


def result_of(future: Future[T], what: Path | str) -> T:
    """Return the result of a finished call; MocapError about `what` if the workers are at fault."""
    try:
        return future.result()
    except CancelledError as error:
        problem, remedy = "the Dask cluster went away", "give the same command again, which continues"
        raise DataError(what, problem, remedy, code="worker-lost") from error
    except ImportError as error:
        problem, remedy = f"a worker cannot run it ({error})", "every machine needs this version of mocap"
        raise DataError(what, problem, remedy, code="wrong-worker") from error
    except Exception as error:
        if not isinstance(error, BrokenProcessPool) and type(error).__name__ != "KilledWorker":
            raise
        problem = "the process that worked on it was killed, perhaps for lack of memory"
        raise DataError(what, problem, code="worker-lost") from error


@contextmanager
def connected(scheduler: str, progress: Progress | None = None) -> Iterator[Any]:
    """Connect to the Dask cluster at an address, and yield the client; DataError if nothing answers there."""
    distributed = need("distributed", "batch")
    for name in list(logging.root.manager.loggerDict):
        # A lost connection is one line, not a traceback.
        if name.startswith(("distributed", "concurrent.futures")):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(scheduler, timeout=SCHEDULER_ANSWER_TIMEOUT_S)
    except (OSError, ValueError, TypeError) as error:
        problem = "no Dask scheduler answers there"
        remedy = "start one with `dask scheduler`, or leave it out to use this machine"
        raise DataError(f"--scheduler {scheduler}", problem, remedy, code="no-scheduler") from error
    with client:
        if progress is not None and not client.scheduler_info()["workers"]:
            progress.note(f"{scheduler} has no workers yet: waiting for them")
        yield client


@contextmanager
def local_cluster(workers: int) -> Iterator[Any]:
    """Start a Dask cluster of so many processes on this machine, and yield its client."""
    distributed = need("distributed", "batch")
    dask = need("dask", "batch")
    dask.config.set({"distributed.worker.daemon": False})  # workers start processes of their own
    cluster = distributed.LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address=None,
        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # its usual port may be taken
        memory_limit=0,  # Dask pauses workers near a limit for ever if they do not free memory
        silence_logs=logging.CRITICAL,
        env={"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    )
    with cluster, distributed.Client(cluster) as client:
        yield client


@dataclass(frozen=True)
class SharedSession:
    """Session that workers read under the same path while the process that made this holds its lock."""

    place: str
    ingested: str  # key of its ingest
    code: str  # version of mocap

    @classmethod
    def at(cls, folder: Path) -> Self:
        """Describe a session whose ingest is finished."""
        return cls(str(folder.absolute()), _key_of_ingest(folder), version("mocap-pipeline"))

    def opened(self) -> Path:
        """Return the session's folder on the worker; DataError if that has another mocap or session."""
        if self.code != version("mocap-pipeline"):
            problem = f"a Dask worker has mocap {version('mocap-pipeline')}, not {self.code}"
            remedy = "install the same version on every machine"
            raise DataError("--scheduler", problem, remedy, code="wrong-worker")
        if _key_of_ingest(Path(self.place)) != self.ingested:
            problem = "is not this session on a machine of the Dask cluster"
            remedy = "every machine needs the same folders under the same paths"
            raise DataError(self.place, problem, remedy, code="wrong-worker")
        return Path(self.place)


def _key_of_ingest(folder: Path) -> str:
    record = Session(folder).record("ingest")
    return "" if record is None else record.key


def contents_of(folder: Path) -> dict[str, bytes]:
    """Read the files of a flat folder, by name."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def write_contents(contents: dict[str, bytes], folder: Path) -> None:
    """Write files into a folder, by name."""
    for name, content in contents.items():
        (folder / name).write_bytes(content)


# This is the number of M_MMAP_THRESHOLD in glibc's <malloc.h>.
M_MMAP_THRESHOLD = -3
# Arrays that fill the heap with holes have 4 MB and more; smaller ones are too many for the kernel.
MIN_RETURNED_BYTES = 1 << 22
# NumPy and its libraries are fastest with arrays that begin at a line of the cache.
ALIGNMENT_BYTES = 64


def return_freed_arrays() -> None:
    """Let freed blocks of 4 MB and more go back to the system at once.

    glibc takes blocks of up to 32 MB from its heap once some were freed, and its holes are never filled: a
    refinement of ten minutes held 2.8 GB, a third of it in use. Other C libraries need no such setting.
    """
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(M_MMAP_THRESHOLD, MIN_RETURNED_BYTES)


def return_unused(*, cycles: bool = True) -> None:
    """Return memory to the system after use: else a process grew by 60 MB in sixteen parts of an hour.

    Without `cycles`, objects that refer to each other stay; to find them takes a tenth of a second.
    """
    import pyarrow as pa

    if cycles:
        gc.collect()
    pa.default_memory_pool().release_unused()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def available_bytes() -> int | None:
    """Return the memory that new processes may take without swapping; None where the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        sizes = dict(line.split(":", 1) for line in lines)
        return 1024 * int(sizes["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return None


class Waiting:
    """Arrays in files without a name, which take memory only while they are used."""

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._maps: WeakSet[mmap.mmap] = WeakSet()  # a file goes with the last array in it

    def put(self, value: T) -> T:
        """Return a copy of a value whose arrays are in a file."""
        buffers: list[pickle.PickleBuffer] = []
        head = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
        places, end = [], 0
        for buffer in buffers:
            places.append(slice(end, end + buffer.raw().nbytes))
            end = -(-places[-1].stop // ALIGNMENT_BYTES) * ALIGNMENT_BYTES
        if not end:
            return value
        with TemporaryFile(dir=self._folder) as file:
            for place, buffer in zip(places, buffers, strict=True):
                file.seek(place.start)
                file.write(buffer.raw())
            file.truncate(end)
            file.flush()
            mapped = mmap.mmap(file.fileno(), end)
        self._maps.add(mapped)
        whole = memoryview(mapped)
        copy: T = pickle.loads(head, buffers=[whole[place] for place in places])  # noqa: S301  # our own
        return copy

    def between(self, parts: Iterable[T]) -> Iterator[T]:
        """Yield parts, and give back what each of them took."""
        for part in parts:
            yield part
            self.release()

    def release(self) -> None:
        """Give back the memory of all arrays, and what is unused; who looks at them again reads the file."""
        return_unused(cycles=False)
        if hasattr(mmap, "MADV_DONTNEED"):
            for mapped in self._maps:
                mapped.madvise(mmap.MADV_DONTNEED)
