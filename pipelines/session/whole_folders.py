"""A folder of results that appears complete or not at all; its finished parts survive an interrupt.

    with whole_folder(target, key, overwrite=overwrite) as making:
        video = making.part("drone1-0", encode)
        ...
        (making.folder / "flight.yaml").write_text(...)
        making.publish()

Everything is written in a hidden folder beside the target, which is renamed to the target at the end.
Parts are stored by key, so a run with other settings does not use them. Sessions have several such folders in
them, their stages; they use the lock and the parts of this module, and `stages` publishes them.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from pipelines.session.errors import BusyError, DataError
from pipelines.session.storage import as_data_error, make_folder, read_json, remove_tree, sync, sync_tree

SIMULATION_MARK = "simulation.json"
"""The file that is in every folder of `mocap simulate`."""

STUDY_MARK = "study.json"
"""The file that is in every folder of `mocap study`."""

_LOCK = "lock"
_RELEASED_S = 0.2  # a killed process can be gone some moments before the kernel has released its lock
_OF_SESSIONS = {"session.json": "a session", "stage.json": "a stage of a session"}


@contextmanager
def held(lock: Path, target: Path | str) -> Iterator[None]:
    """Hold a lock of the kernel, which ends with the process, however that ends.

    Args:
        lock: the file of the lock. The holder's process id is in a file of its own beside it, because some
            versions of filelock empty the lock file.
        target: the folder, or the URL, that is written meanwhile, for the message.

    Raises:
        BusyError: another process holds it.
    """
    holder = lock.with_name(f"{lock.name}.pid")
    try:
        acquired = FileLock(lock).acquire(timeout=_RELEASED_S)
    except Timeout:
        raise BusyError(f"{target} is being written by {_process(holder)}; wait for it to finish") from None
    with acquired:
        try:
            holder.write_text(f"{os.getpid()}\n")
            yield
        finally:
            holder.unlink(missing_ok=True)


def _process(holder: Path) -> str:
    try:
        return f"process {int(holder.read_text())}"
    except (OSError, ValueError):
        return "another process"


def remove_if_unused(folder: Path, lock: str) -> None:
    """Remove a folder if only its lock is left in it."""
    with suppress(OSError):
        if {path.name for path in folder.iterdir()} <= {lock, f"{lock}.pid"}:
            for left in (lock, f"{lock}.pid"):
                (folder / left).unlink(missing_ok=True)
            folder.rmdir()


@contextmanager
def working_folder(work: Path, target: Path) -> Iterator[Path]:
    """Make and lock the hidden folder in which a target is written; it is removed if it ends up empty.

    Raises:
        BusyError: another process uses it.
    """
    try:
        make_folder(work)
        with held(work / _LOCK, target):
            yield work
    finally:
        remove_if_unused(work, _LOCK)


def finished_part(finished: Path, produce: Callable[[Path], None]) -> Path:
    """Return the folder of a finished part; call `produce` with an empty folder if it does not exist yet."""
    if not finished.is_dir():
        temporary = finished.with_name(f"{finished.name}.new")
        remove_tree(temporary)
        temporary.mkdir(parents=True)
        produce(temporary)
        sync_tree(temporary)
        temporary.rename(finished)
        sync(finished.parent)
    return finished


class Making:
    """A folder that is being made.

    Attributes:
        folder: the folder to write into; it becomes the target when published.
    """

    def __init__(self, work: Path, target: Path, key: str) -> None:
        self.folder = work / "whole"
        self._work = work
        self._target = target
        self._parts = work / key

    def part(self, name: str, produce: Callable[[Path], None]) -> Path:
        """Return the folder of a finished part; call `produce` if no interrupted run finished it."""
        return finished_part(self._parts / name, produce)

    def publish(self) -> None:
        """Replace the target by the folder, and move the old target away."""
        sync_tree(self.folder)
        old = self._work / "old"
        remove_tree(old)
        if self._target.exists():
            self._target.rename(old)
        self.folder.rename(self._target)
        sync(self._target.parent)


@contextmanager
def whole_folder(target: Path, key: str, *, mark: str, overwrite: bool) -> Iterator[Making]:
    """Make a folder. Parts are kept after an interrupt, and removed after success or a DataError.

    Args:
        key: equal for equal results.
        mark: a file that every such folder has; a target without it holds something else.
        overwrite: replace also a target that holds something else.

    Raises:
        DataError: the target is something else, or cannot be written.
        BusyError: another process makes the same folder.
    """
    target = target.absolute()
    _check(target, mark, overwrite)
    try:
        with working_folder(_work_of(target), target) as work:
            _put_back(work, target)
            for stale in [path for path in work.iterdir() if path.is_dir() and path.name != key]:
                remove_tree(stale)
            making = Making(work, target, key)
            making.folder.mkdir()
            try:
                yield making
            except DataError:
                remove_tree(work / key)  # the user will change an input
                raise
            else:
                remove_tree(work / key)
            finally:
                with suppress(OSError):
                    _put_back(work, target)
                    remove_tree(work / "whole")
    except OSError as error:
        raise as_data_error(error, target) from error


def refuse_sessions(target: Path, *, mark: str, option: str) -> None:
    """Refuse to replace a session or a part of one, even with `overwrite`.

    Args:
        target: the folder that would be replaced.
        mark: as for `whole_folder`.
        option: the option by which the user named the target.

    Raises:
        DataError: the target holds a session or a stage of one, at any depth, or lies in a session.
    """
    target = target.absolute()
    if not target.is_dir():
        return
    for folder, _, files in os.walk(target):
        for name in filter(files.__contains__, _OF_SESSIONS):
            what, within = _OF_SESSIONS[name], Path(folder).relative_to(target).as_posix()
            problem = f"is {what}" if within == "." else f"holds {what} in {within}"
            raise DataError(target, problem, f"name another folder with {option}")
    if not (target / mark).is_file():
        for parent in target.parents:
            if (parent / "session.json").is_file():
                raise DataError(
                    target,
                    "is a part of a session",
                    f"name another folder with {option}",
                    code="not-a-session",
                )


def is_made(target: Path, key: str, *, mark: str) -> bool:
    """Return True if the target exists with this key, which its mark file states.

    In that case, leftovers of a later attempt that was killed are useless and are removed.
    """
    try:
        made = bool(read_json(target / mark).get("key") == key)
    except DataError:
        return False
    work = _work_of(target.absolute())
    if made and work.is_dir():
        with suppress(OSError, BusyError), working_folder(work, target):
            for left in [path for path in work.iterdir() if path.is_dir()]:
                remove_tree(left)
    return made


def _work_of(target: Path) -> Path:
    return target.parent / f".{target.name}.making"


def _check(target: Path, mark: str, overwrite: bool) -> None:
    if overwrite or not target.exists() or (target / mark).is_file():
        return
    if not target.is_dir():
        raise DataError(
            target, "is a file, not a folder", "choose another place with --output", code="not-a-folder"
        )
    if entries := sorted(path.name for path in target.iterdir()):
        raise DataError(
            target,
            f"holds something else ({len(entries)} entries, the first {entries[0]})",
            "choose another place with --output, or replace it with --overwrite",
            code="exists",
        )


def _put_back(work: Path, target: Path) -> None:
    """Put the old target back if a kill between two renames left no new one; else remove it."""
    old = work / "old"
    if old.exists() and not target.exists():
        old.rename(target)
    remove_tree(old)
