"""Parts of one flight on several processes, or on the machines of a Dask cluster, through one executor.

A part is a call of a function of this package. Its result depends on its arguments and on the session, and on
nothing else. It travels back to the process that holds the session's lock, and only that process writes.
"""

import logging
import multiprocessing
import os
import signal
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from threading import Thread
from typing import Any, Self, TypeVar

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
    """Call a function of a module with every part; yield number and result in the order in which they end.

    Closed early, the parts that are not done are cancelled. With one worker this process works; `executor`
    works instead of processes. MocapError: the first that a part raised, or a worker could not run it.
    """
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
