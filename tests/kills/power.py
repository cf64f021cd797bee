"""Losses of power, replayed from a trace: what was not synced is lost, in part or whole, at any moment.

A trace is recorded while a command runs in this process. The whole folder is compared before and after
each call that renames, removes, makes or syncs something, so that what libraries in C write is seen as well.
From a trace follow the states of the disk that a loss of power may leave at each of its moments:

- Changes of entries of folders reach the disk in their order, as a journal keeps them. Those before the last
  sync of a file or folder are there; of the others, any number of the first.
- Of a file, what was there at its last sync is there, or what was written since. That may also be cut
  anywhere, be zeros, or be missing.
"""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial, wraps
from itertools import count as numbers_from
from pathlib import Path
from threading import RLock
from typing import Any
from unittest.mock import patch

import numpy as np

from pipelines.session.errors import DataError
from pipelines.session.stages import STAGES, locked
from tests.commands.runner import mocap, succeeds
from tests.kills.killing import kept
from tests.synthetic.flights import write_flight

Disk = Mapping[str, bytes | None]
"""Contents of files by relative path; None for a folder. Folders stand before what they hold."""


@dataclass(frozen=True)
class Moment:
    """A folder at one moment: numbers of files by path, contents until now, and what syncs made last."""

    entries: Mapping[str, int | None]
    last: Mapping[int, bytes]
    synced: Mapping[int, bytes]
    certain: bool = False


# --- recording -----------------------------------------------------------------------------------------
_CHANGING = ("rename", "replace", "remove", "unlink", "mkdir", "rmdir", "link", "truncate", "ftruncate")
_SYNCING = ("fsync", "fdatasync")


class Recorder:
    """Comparison of a folder, first all on the disk, before and after calls that change or sync entries."""

    def __init__(self, folder: Path) -> None:
        self.trace = [Moment({}, {}, {})]
        self._folder = folder
        self._numbers: dict[int, int] = {}  # of files, by inode
        self._next = numbers_from()
        self._lock = RLock()
        self._look(at_once=True)
        self.trace = [replace(self.trace[-1], synced=self.trace[-1].last, certain=True)]

    @contextmanager
    def recording(self) -> Iterator[list[Moment]]:
        """Record what happens meanwhile."""
        with ExitStack() as stack:
            for name in _CHANGING:
                stack.enter_context(patch.object(os, name, self._around(getattr(os, name))))
            for name in _SYNCING:
                stack.enter_context(patch.object(os, name, self._around(getattr(os, name), syncs=True)))
            yield self.trace
        self._look()

    def _around(self, call: Callable[..., Any], *, syncs: bool = False) -> Callable[..., Any]:
        @wraps(call)
        def called(*arguments: Any, **options: Any) -> Any:
            with self._lock:
                self._look()
                result = call(*arguments, **options)
                if syncs:
                    self._sync(os.fstat(arguments[0]).st_ino)
                else:
                    self._look(at_once=True)
                return result

        return called

    def _sync(self, inode: int) -> None:
        now, number = self.trace[-1], self._numbers.get(inode)
        folders = [self._folder, *(self._folder / name for name, of in now.entries.items() if of is None)]
        if number is not None:
            now = replace(now, synced={**now.synced, number: now.last[number]})
        elif inode not in {folder.stat().st_ino for folder in folders}:
            return
        self.trace.append(replace(now, certain=True))

    def _look(self, *, at_once: bool = False) -> None:
        """Append the moments that lead to what the folder is now; new entries one by one, or all at once."""
        before = self.trace[-1]
        found = {
            path.relative_to(self._folder).as_posix(): (path, path.is_dir(), path.stat().st_ino)
            for path in sorted(self._folder.rglob("*"))
        }
        there = {inode for _, _, inode in found.values()}
        self._numbers = {inode: number for inode, number in self._numbers.items() if inode in there}
        entries: dict[str, int | None] = {}
        last = dict(before.last)
        for name, (path, is_folder, inode) in found.items():
            if is_folder:
                entries[name] = None
                continue
            if inode not in self._numbers:
                self._numbers[inode] = next(self._next)
            entries[name] = self._numbers[inode]
            last[self._numbers[inode]] = path.read_bytes()
        if (entries, last) == (before.entries, before.last):
            return
        so_far = {name: of for name, of in before.entries.items() if name in entries}
        for name in [] if at_once else [name for name in entries if name not in so_far]:
            so_far[name] = entries[name]
            self.trace.append(Moment(dict(so_far), last, before.synced))
        self.trace.append(Moment(entries, last, before.synced))


# --- what may be left ----------------------------------------------------------------------------------
def losses(
    trace: Sequence[Moment], choice: np.random.Generator, *, moments: int
) -> Iterator[tuple[int, Disk]]:
    """Yield states that a loss of power after some moments may leave, each once, with the moment's number.

    `moments` is the most moments, the last among them; `choice` draws what is left of unsynced files.
    """
    last = len(trace) - 1
    for count in sorted({*choice.permutation(last)[: moments - 1].tolist(), last}):
        certain = max(k for k, moment in enumerate(trace[: count + 1]) if moment.certain)
        ends = sorted({certain, count, int(choice.integers(certain, count + 1))})
        seen = set()
        for end, torn in [*((end, number > 0) for number, end in enumerate(ends)), (count, True)]:
            left = _left(trace[count], choice if torn else None)
            disk = {name: None if of is None else left[of] for name, of in trace[end].entries.items()}
            if (mark := hash(frozenset(disk.items()))) not in seen:
                seen.add(mark)
                yield count, disk


def _left(moment: Moment, choice: np.random.Generator | None) -> dict[int, bytes]:
    """Return what is left of every file: as of its last sync, or with a choice any of what may be left."""
    found = {}
    for number, content in moment.last.items():
        old = moment.synced.get(number, b"")
        found[number] = old if choice is None or old == content else _torn(old, content, choice)
    return found


def _torn(old: bytes, new: bytes, choice: np.random.Generator) -> bytes:
    """Return an old content, a new one, or something between."""
    cut = int(choice.integers(len(new) + 1))
    return (old, new, new[:cut], new[:cut] + bytes(len(new) - cut), b"")[int(choice.integers(5))]


def write_disk(disk: Disk, folder: Path) -> None:
    """Write a state into an empty folder."""
    for name, content in disk.items():
        if content is None:
            (folder / name).mkdir()
        else:
            (folder / name).write_bytes(content)


# --- commands ------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Case:
    """Command that is recorded, with what was there before it."""

    name: str
    arguments: Sequence[str | Path]
    version: Callable[[], Mapping[str, str]]  # what readers find; DataError if that is damaged
    files: Callable[[], Mapping[str, str]]  # the result, which is the same after every run
    before: Callable[[], object] = lambda: None  # makes an earlier version
    whole: bool = True  # False if every file, or every stage, is whole for itself


@dataclass(frozen=True)
class Lost:
    """Result of the states after losses of power in one command."""

    case: str
    steps: int
    states: int  # all of them were opened
    run_again: int  # of these
    troubles: Sequence[str]


def cases_on(folder: Path, names: Sequence[str] = ()) -> Iterator[tuple[Path, Case]]:
    """Yield commands, all by default, each with the folder that holds all that it reads and writes."""
    for name, make in _CASES.items():
        if not names or name in names:
            place = folder / name.replace(" ", "_")
            place.mkdir()
            yield place, make(name, place)


def replay(folder: Path, case: Case, *, moments: int, again: int, seed: int) -> Lost:
    """Record a command in a folder that holds all it reads and writes; look at states of a loss of power.

    `moments` as in `losses`; in `again` states, chosen at random, the command is given again.
    """
    choice = np.random.default_rng(seed)
    case.before()
    before = case.version()
    recorder = Recorder(folder)
    with recorder.recording() as trace:
        done = mocap(*case.arguments)
    assert done.returncode == 0, done.stderr
    expected, after = case.files(), case.version()
    assert before != after
    states = list(losses(trace, choice, moments=moments))
    chosen = set(choice.permutation(len(states))[:again].tolist())
    troubles, last = [], len(trace) - 1
    for number, (count, disk) in enumerate(states):
        shutil.rmtree(folder)
        folder.mkdir()
        write_disk(disk, folder)
        possible = [after] if count == last else [before, after]
        trouble = _damage(case, possible) or (_trouble_again(case, expected) if number in chosen else "")
        if trouble:
            troubles.append(f"after {count} of {last} steps: {trouble}")
    return Lost(case.name, last, len(states), len(chosen), troubles)


def _damage(case: Case, possible: Sequence[Mapping[str, str]]) -> str:
    """Return how a state is none of the possible versions; empty if it is one."""
    try:
        found = case.version()
    except DataError as error:
        return f"damaged: {error}"
    whole = set().union(*(of.items() for of in possible))
    if found in possible or (not case.whole and len(possible) > 1 and found.items() <= whole):
        return ""
    return f"no version: {sorted(set(found.items()) ^ set(possible[-1].items()))[:3]}"


def _trouble_again(case: Case, expected: Mapping[str, str]) -> str:
    """Give the command again; return what goes wrong."""
    done = mocap(*case.arguments)
    if done.returncode:
        return f"exit status {done.returncode}: {done.stderr[-300:]}"
    differing = {path for path, _ in set(expected.items()) ^ set(case.files().items())}
    return f"other bytes: {', '.join(sorted(differing)[:5])}" if differing else ""


def version_of_session(session: Path) -> dict[str, str]:
    """Return the key of every stage; none without a session.

    Raises:
        DataError: a file of a finished stage is missing or has another content.
    """
    if not (session / "session.json").exists() and not (session / "ingest.new" / "stage.json").exists():
        return {}
    with locked(session) as opened:  # completes what was interrupted
        records = {stage: opened.intact_record(stage) for stage in STAGES}
    return {stage: record.key for stage, record in records.items() if record is not None}


def _files_beside(folder: Path) -> dict[str, str]:
    """List a folder as `kept` does, with what was left beside it; empty without one."""
    left = [path.name for path in folder.parent.iterdir() if path.name.startswith(".")]
    return (kept(folder) if folder.exists() else {}) | dict.fromkeys(left, "left behind")


def _visible(folder: Path) -> dict[str, str]:
    """List the files of a folder that other programs take for results."""
    found = kept(folder) if folder.exists() else {}
    return {
        name: digest for name, digest in found.items() if not name.startswith(".") and name[-4:] != ".new"
    }


def _of_session(
    name: str, session: Path, arguments: Sequence[str | Path], before: Callable[[], object] = lambda: None
) -> Case:
    version, files = partial(version_of_session, session), partial(_files_beside, session)
    return Case(name, arguments, version, files, before)


def _ingest_again(name: str, place: Path) -> Case:
    session, flight = place / "flown.session", write_flight(place, seconds=0.3)

    def before() -> None:
        succeeds("ingest", flight.manifest, "-o", session)
        del flight.settings["truth"]
        flight.save()

    return _of_session(name, session, ["ingest", flight.manifest, "-o", session], before)


def _ingested(place: Path) -> Path:
    session = place / "flown.session"
    succeeds("ingest", write_flight(place, seconds=0.3).manifest, "-o", session)
    return session


def _reconstruct(name: str, place: Path) -> Case:
    session = _ingested(place)
    before = partial(succeeds, "reconstruct", session, "--method", "dlt")
    return _of_session(name, session, ["reconstruct", session, "--method", "robust"], before)


def _export(name: str, place: Path) -> Case:
    session, target = _ingested(place), place / "exported"
    succeeds("reconstruct", session, "--method", "robust")
    before = partial(succeeds, "export", session, "-o", target, "--to", "trc", "--unit", "m")
    arguments: list[str | Path] = ["export", session, "-o", target, "--to", "trc,tum,csv"]
    files = partial(_visible, target)
    return Case(name, arguments, files, files, before, whole=False)


_CASES: Mapping[str, Callable[[str, Path], Case]] = {
    "ingest again": _ingest_again,
    "reconstruct": _reconstruct,
    "export": _export,
}


def print_replays(names: Sequence[str], *, moments: int, seed: int) -> int:
    """Replay losses of power in commands and print each; return 1 if any made trouble."""
    found = []
    with tempfile.TemporaryDirectory() as place:
        for folder, case in cases_on(Path(place), names):
            lost = replay(folder, case, moments=moments, again=moments // 2, seed=seed)
            found.append(lost)
            print(  # noqa: T201
                f"{lost.case}: {lost.states} states after {lost.steps} steps, {lost.run_again} of them run"
                f" again, {len(lost.troubles)} made trouble",
                flush=True,
            )
            for trouble in lost.troubles[:5]:
                print(f"    {trouble}", flush=True)  # noqa: T201
    troubles = sum(len(lost.troubles) for lost in found)
    print(f"{sum(lost.states for lost in found)} losses of power, {troubles} made trouble")  # noqa: T201
    return 1 if troubles else 0
