"""Parts of one flight on the workers of a Dask cluster or on processes, and the connection to the cluster.

A part is a call of a function of this package. Its result depends on its arguments and on the session, which
every worker finds under the same path or in an object store, and on nothing else. The result travels back to
the process that holds the session's lock, and only that process writes. A lost worker loses its part, which
Dask gives to another one.
"""

import logging
import multiprocessing
import os
import signal
from asyncio import CancelledError
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from threading import Thread
from typing import Any, Self, TypeVar

from pipelines.session.errors import DataError, MocapError
from pipelines.session.progress import Progress, Silent
from pipelines.session.registries import need
from pipelines.session.stages import Session
from pipelines.session.stores import fetched, published_version, url_of

GPU = "GPU"
"""Dask resource of workers with a graphics card: `dask worker ... --resources GPU=1`."""

_ANSWER_S = 20.0
_FIRST = 10  # priority of parts, above that of whole flights: what was begun ends first

_PART = "a part of the flight on the Dask cluster"

T = TypeVar("T")
R = TypeVar("R")


class Cluster:
    """Workers of a Dask cluster.

    Args:
        client: opens the connection for as long as parts are under way.
    """

    def __init__(self, client: Callable[[], AbstractContextManager[Any]]) -> None:
        self._client = client

    @classmethod
    def of(cls, client: Any) -> Self:
        """Use an open connection."""
        return cls(lambda: nullcontext(client))

    @classmethod
    def of_task(cls) -> Self:
        """Use the cluster on which the current task runs; the task's thread takes parts meanwhile."""
        return cls(need("distributed", "batch").worker_client)

    def each(
        self,
        work: Callable[[T], R],
        parts: Sequence[T],
        *,
        on_gpu: bool = False,
        progress: Progress | None = None,
    ) -> Generator[tuple[int, R]]:
        """Call a function with every part, and yield number and result in the order in which they end.

        Closed early, the parts that are not done are cancelled.

        Args:
            work: a function of a module.
            parts: its arguments.
            on_gpu: only workers with the resource `GPU` take them, if the cluster has such workers now.
            progress: is told where the cluster has no workers yet.

        Raises:
            MocapError: the first error that a part raised, or a worker could not run it.
        """
        if not parts:
            return
        distributed = need("distributed", "batch")
        with self._client() as client:
            workers = client.scheduler_info()["workers"].values()
            if not workers:
                (progress or Silent()).note("the Dask cluster has no workers yet: waiting for them")
            has_gpu = any(worker.get("resources", {}).get(GPU) for worker in workers)
            futures = client.map(
                work, parts, pure=False, priority=_FIRST, resources={GPU: 1} if on_gpu and has_gpu else None
            )
            numbers = {future: number for number, future in enumerate(futures)}
            del futures  # else the cluster would keep every result until the end
            try:
                for future in distributed.as_completed(list(numbers)):
                    yield numbers.pop(future), result_of(future, _PART)
            finally:
                with suppress(OSError, CancelledError):  # of a cluster that is gone
                    client.cancel(list(numbers))


class Processes:
    """Processes of this machine, which take parts as the workers of a cluster do.

    Args:
        count: of the processes; with one, this process works.
    """

    def __init__(self, count: int) -> None:
        self._count = 1 if multiprocessing.current_process().daemon else count

    def each(self, work: Callable[[T], R], parts: Sequence[T]) -> Generator[tuple[int, R]]:
        """Call a function with every part, and yield number and result in the order in which they end.

        Closed early, all processes end.

        Args:
            work: a function of a module.
            parts: its arguments.

        Raises:
            MocapError: the first error that a part raised, or a process was killed.
        """
        if self._count == 1 or len(parts) < 2:
            yield from ((number, work(part)) for number, part in enumerate(parts))
            return
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(min(self._count, len(parts)), context, initializer=_end_with_parent)
        try:
            numbers = {pool.submit(work, part): number for number, part in enumerate(parts)}
            for future in as_completed(list(numbers)):
                yield numbers.pop(future), future.result()
        except BrokenProcessPool as error:
            raise DataError(
                "a process of mocap", "was killed, perhaps for lack of memory", code="worker-lost"
            ) from error
        finally:
            for process in list((pool._processes or {}).values()):  # a part takes a minute
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


def result_of(future: Any, what: Path | str) -> Any:
    """Return the result of a finished task.

    Args:
        what: the subject of the line if the cluster is at fault.

    Raises:
        MocapError: the task raised it, or the cluster could not run the task.
    """
    if future.cancelled():
        raise DataError(
            what,
            "the Dask cluster went away",
            "give the same command again, which continues",
            code="worker-lost",
        )
    error = future.exception()
    if error is None:
        return future.result()
    if isinstance(error, MocapError):
        raise error
    if isinstance(error, need("distributed", "batch").KilledWorker):
        raise DataError(what, "every worker that took it died, perhaps for lack of memory") from error
    line = " ".join(f"{type(error).__name__}: {error}".split())
    raise DataError(
        what,
        f"the Dask worker could not run it ({line})",
        "every machine needs this version of mocap",
        code="worker-lost",
    ) from error


@contextmanager
def connected(scheduler: str) -> Iterator[Any]:
    """Connect to the Dask cluster at an address.

    Raises:
        DataError: Dask is not installed, or no scheduler answers there.
    """
    distributed = need("distributed", "batch")
    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] == "distributed":  # a lost connection is one line, not a traceback
            logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(scheduler, timeout=_ANSWER_S)
    except (OSError, ValueError, TypeError) as error:
        raise DataError(
            f"--scheduler {scheduler}",
            "no Dask scheduler answers there",
            "start one with `dask scheduler`, or leave it out to use this machine",
            code="no-scheduler",
        ) from error
    with client:
        yield client


@contextmanager
def local_cluster(workers: int) -> Iterator[Any]:
    """Start a cluster of so many processes on this machine, and connect to it."""
    distributed = need("distributed", "batch")
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
    """Session that workers read while the process that made this holds its lock."""

    place: str  # its folder on every machine, or the URL of its version in a store
    ingested: str  # key of its ingest
    code: str  # version of mocap

    @classmethod
    def at(cls, folder: Path) -> Self:
        """Describe a session whose ingest is finished."""
        place = published_version(folder) or str(folder.absolute())
        return cls(place, _ingested(folder), version("mocap-pipeline"))

    def opened(self) -> Path:
        """Return the session's folder on the worker.

        Raises:
            DataError: the worker has another version of mocap, or finds no such session there.
        """
        if self.code != version("mocap-pipeline"):
            raise DataError(
                "--scheduler",
                f"a Dask worker has mocap {version('mocap-pipeline')}, not {self.code}",
                "install the same version on every machine",
                code="worker-lost",
            )
        folder = fetched(self.place) if url_of(self.place) else Path(self.place)
        if _ingested(folder) != self.ingested:
            raise DataError(
                self.place,
                "is not this session on a machine of the Dask cluster",
                "every machine needs the same folders under the same paths",
                code="worker-lost",
            )
        return folder


def _ingested(folder: Path) -> str:
    record = Session(folder).record("ingest")
    return "" if record is None else record.key


def contents_of(folder: Path) -> dict[str, bytes]:
    """Read the files of a flat folder, by name."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def write_contents(contents: dict[str, bytes], folder: Path) -> None:
    """Write files into a folder, by name."""
    for name, content in contents.items():
        (folder / name).write_bytes(content)
