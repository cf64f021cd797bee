"""Losses of power, replayed from a trace: what was not synced is lost, in part or whole, at any moment.

A trace is recorded while a command runs in this process. The whole folder is compared before and after
each call that renames, removes, makes or syncs something, so that what libraries in C write is seen as well.
From a trace follow the states of the disk that a loss of power may leave after each of its steps:

- Changes of entries of folders reach the disk in their order, as a journal keeps them. Those before the last
  sync of a file or folder are there; of the others, any number of the first.
- Of a file, what was there at its last sync is there, or what was written since. That may also be cut
  anywhere, be zeros, or be missing.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial, wraps
from pathlib import Path
from threading import RLock
from typing import Any
from unittest.mock import patch

import numpy as np

from pipelines.session.errors import DataError
from pipelines.session.stages import STAGES, locked
from tests.commands.runner import mocap, succeeds
from tests.keypoints.spotted_flights import spot_detector, write_spotted_flight
from tests.kills.killing import SCENARIO, kept
from tests.synthetic.flights import write_flight

Key = tuple[int, str]  # node of a folder, and a name in it

ROOT = 0  # node of the recorded folder


@dataclass(frozen=True)
class Entry:
    """Change of entries of folders: a node comes, goes, or is renamed."""

    node: int
    gone: Key | None
    come: Key | None
    is_folder: bool


@dataclass(frozen=True)
class Content:
    """New content of a file."""

    node: int
    content: bytes


@dataclass(frozen=True)
class Synced:
    """Sync of a file or a folder."""

    node: int


Step = Entry | Content | Synced


@dataclass
class Trace:
    """Steps by which a folder changed, after those that made it as it was at first."""

    steps: list[Step] = field(default_factory=list)
    first: int = 0  # number of steps that made it as it was at first


@dataclass(frozen=True)
class Disk:
    """State of a folder: nodes of all entries, and contents of files."""

    entries: Mapping[Key, int]
    contents: Mapping[int, bytes]  # of files only

    def write(self, folder: Path) -> None:
        """Write the state into an empty folder; what no entry leads to is lost."""
        inside: dict[int, list[tuple[str, int]]] = {}
        for (parent, name), node in self.entries.items():
            inside.setdefault(parent, []).append((name, node))

        def write(node: int, place: Path) -> None:
            for name, child in inside.get(node, []):
                if child in self.contents:
                    (place / name).write_bytes(self.contents[child])
                else:
                    (place / name).mkdir()
                    write(child, place / name)

        write(ROOT, folder)


# --- recording -----------------------------------------------------------------------------------------

_CHANGING = ("rename", "replace", "remove", "unlink", "mkdir", "rmdir", "link", "truncate", "ftruncate")
_SYNCING = ("fsync", "fdatasync")


class Recorder:
    """Comparison of a folder with what it was, before and after each call that changes or syncs entries.

    Args:
        folder: the folder.
    """

    def __init__(self, folder: Path) -> None:
        self.trace = Trace()
        self._folder = folder
        self._nodes: dict[int, int] = {}  # by inode
        self._entries: dict[Key, int] = {}
        self._contents: dict[int, bytes] = {}
        self._count = ROOT
        self._lock = RLock()
        self._look()
        self.trace.steps += [Synced(node) for node in [ROOT, *self._nodes.values()]]
        self.trace.first = len(self.trace.steps)

    @contextmanager
    def recording(self) -> Iterator[Trace]:
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
                    inode = os.fstat(arguments[0]).st_ino
                    if inode == self._folder.stat().st_ino:
                        self.trace.steps.append(Synced(ROOT))
                    elif inode in self._nodes:
                        self.trace.steps.append(Synced(self._nodes[inode]))
                else:
                    self._look()
                return result

        return called

    def _look(self) -> None:
        """Append the steps that lead from the folder as it was at the last look to what it is now."""
        found: list[tuple[tuple[int, str], int, Path, bool]] = []  # inode of the folder, name; inode

        def walk(folder: Path, inode: int) -> None:
            with os.scandir(folder) as entries:
                for entry in sorted(entries, key=lambda entry: entry.name):
                    assert not entry.is_symlink(), entry.path
                    own = entry.stat(follow_symlinks=False).st_ino
                    found.append(((inode, entry.name), own, Path(entry.path), entry.is_dir()))
                    if entry.is_dir():
                        walk(Path(entry.path), own)

        walk(self._folder, -1)
        there = {inode for _, inode, _, _ in found}
        nodes = {inode: node for inode, node in self._nodes.items() if inode in there}
        places = {node: key for key, node in self._entries.items()}
        steps: list[Step] = []
        entries: dict[Key, int] = {}
        came: list[tuple[Key, int, bool]] = []
        for (parent, name), inode, _, is_folder in found:
            if inode not in nodes:
                self._count += 1
                nodes[inode] = self._count
            key = (ROOT if parent == -1 else nodes[parent], name)
            entries[key] = nodes[inode]
            if self._entries.get(key) != nodes[inode]:
                came.append((key, nodes[inode], is_folder))
        renamed = {node for _, node, _ in came if node in places}
        gone = [key for key, node in self._entries.items() if node not in renamed and key not in entries]
        for key in reversed(gone):
            node = self._entries[key]
            steps.append(Entry(node, key, None, node not in self._contents))
        contents: dict[int, bytes] = {}
        for _, inode, path, is_folder in found:
            node = nodes[inode]
            if not is_folder:
                contents[node] = path.read_bytes()
                if self._contents.get(node) != contents[node]:
                    steps.append(Content(node, contents[node]))
        steps += [Entry(node, places.get(node), key, is_folder) for key, node, is_folder in came]
        self.trace.steps += steps
        self._nodes, self._entries, self._contents = nodes, entries, contents


# --- what may be left ----------------------------------------------------------------------------------


def losses(trace: Trace, choice: np.random.Generator, *, moments: int) -> Iterator[tuple[int, Disk]]:
    """Yield states that a loss of power after some steps may leave, with the number of steps before it.

    The same state is yielded once for one number of steps.

    Args:
        trace: all steps.
        choice: chooses what is left of unsynced files, and how many changes of entries.
        moments: the most moments; the last step is always one of them.
    """
    last = len(trace.steps)
    counts = trace.first + choice.permutation(last - trace.first)[: moments - 1]
    for count in sorted({*counts.tolist(), last}):
        steps = trace.steps[:count]
        certain = max((k for k, step in enumerate(steps) if isinstance(step, Synced)), default=0)
        written = {certain, count, int(choice.integers(certain, count + 1))}
        seen = set()
        states = [(end, choice if number else None) for number, end in enumerate(sorted(written))]
        for end, torn in [*states, (count, choice)]:
            disk = Disk(_entries_after(steps[:end]), _left(steps, torn))
            mark = hash((frozenset(disk.entries.items()), frozenset(disk.contents.items())))
            if mark not in seen:
                seen.add(mark)
                yield count, disk


def _entries_after(steps: Sequence[Step]) -> dict[Key, int]:
    found: dict[Key, int] = {}
    for step in steps:
        if isinstance(step, Entry):
            if step.gone is not None:
                found.pop(step.gone, None)
            if step.come is not None:
                found[step.come] = step.node
    return found


def _left(steps: Sequence[Step], choice: np.random.Generator | None) -> dict[int, bytes]:
    """Return what is left of every file: as of its last sync, or with a choice any of what may be left."""
    synced: dict[int, bytes] = {}
    last: dict[int, bytes] = {}
    for step in steps:
        if isinstance(step, Entry) and not step.is_folder:
            last.setdefault(step.node, b"")
            synced.setdefault(step.node, b"")
        elif isinstance(step, Content):
            last[step.node] = step.content
            synced.setdefault(step.node, b"")
        elif isinstance(step, Synced) and step.node in last:
            synced[step.node] = last[step.node]
    if choice is None:
        return synced
    return {
        node: content if synced[node] == content else _torn(synced[node], content, choice)
        for node, content in last.items()
    }


def _torn(old: bytes, new: bytes, choice: np.random.Generator) -> bytes:
    """Return an old content, a new one, or something between."""
    cut = int(choice.integers(len(new) + 1))
    return (old, new, new[:cut], new[:cut] + bytes(len(new) - cut), b"")[int(choice.integers(5))]


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
    """Yield commands, each with the folder that holds all that it reads and writes.

    Args:
        folder: is filled with flights and sessions.
        names: of the commands; all by default.
    """
    for name, make in _CASES.items():
        if not names or name in names:
            place = folder / name.replace(" ", "_")
            place.mkdir()
            yield place, make(name, place)


def replay(folder: Path, case: Case, *, moments: int, again: int, seed: int) -> Lost:
    """Record a command, and look at states that a loss of power may leave.

    Args:
        folder: holds everything that the command reads and writes.
        case: the command.
        moments: see `losses`.
        again: states in which the command is given again, chosen at random.
        seed: seed of the moments, of what is left of unsynced files, and of the choice.
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
    troubles, steps = [], len(trace.steps) - trace.first
    for number, (count, disk) in enumerate(states):
        shutil.rmtree(folder)
        folder.mkdir()
        disk.write(folder)
        possible = [after] if count == len(trace.steps) else [before, after]
        trouble = _damage(case, possible) or (_trouble_again(case, expected) if number in chosen else "")
        if trouble:
            troubles.append(f"after {count - trace.first} of {steps} steps: {trouble}")
    return Lost(case.name, steps, len(states), len(chosen), troubles)


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


def _made(folder: Path) -> dict[str, str]:
    """List a folder that is made whole; between two renames, that which the same command puts back."""
    return _visible(folder if folder.exists() else folder.parent / f".{folder.name}.making" / "old")


def _of_session(
    name: str,
    session: Path,
    arguments: Sequence[str | Path],
    before: Callable[[], object] = lambda: None,
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


def _ingested(place: Path, seconds: float = 0.3) -> Path:
    session = place / "flown.session"
    succeeds("ingest", write_flight(place, seconds=seconds).manifest, "-o", session)
    return session


def _reconstruct(name: str, place: Path) -> Case:
    session = _ingested(place)
    before = partial(succeeds, "reconstruct", session, "--method", "dlt")
    return _of_session(name, session, ["reconstruct", session, "--method", "robust"], before)


def _detect(name: str, place: Path) -> Case:
    """Detection in blocks, which are kept in `.partial`."""
    session = place / "flown.session"
    succeeds("ingest", write_spotted_flight(place, 20), "-o", session)
    options = ("--detector", spot_detector(place))
    made = _of_session(name, session, ["reconstruct", session, *options, "--workers", "1"])
    return replace(made, whole=False)


def _export(name: str, place: Path) -> Case:
    session, target = _ingested(place), place / "exported"
    succeeds("reconstruct", session, "--method", "robust")
    before = partial(succeeds, "export", session, "-o", target, "--to", "trc", "--unit", "m")
    arguments: list[str | Path] = ["export", session, "-o", target, "--to", "trc,tum,csv"]
    files = partial(_visible, target)
    return Case(name, arguments, files, files, before, whole=False)


def _simulate(name: str, place: Path) -> Case:
    scenario, target = place / "scenario.yaml", place / "simulated"

    def before() -> None:
        scenario.write_text(SCENARIO.replace("seed: 3", "seed: 4"), encoding="utf-8")
        succeeds("simulate", scenario, "-o", target)
        scenario.write_text(SCENARIO, encoding="utf-8")

    files = partial(_files_beside, target)
    return Case(name, ["simulate", scenario, "-o", target], partial(_made, target), files, before)


_CASES: Mapping[str, Callable[[str, Path], Case]] = {
    "ingest again": _ingest_again,
    "reconstruct": _reconstruct,
    "detect": _detect,
    "export": _export,
    "simulate": _simulate,
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
