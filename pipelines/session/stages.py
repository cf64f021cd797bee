"""The life of a stage: begun under a lock, resumed, published in one piece, mended after a kill.

A stage writes into `<stage>.new/`. Its `stage.json`, written last and synced, is the point of no return:
without it the folder is thrown away, with it publication is carried to its end, by whoever opens the
session next. Stages read like this:

    with locked(folder) as session:
        run = session.begin(RECONSTRUCT, settings=settings, inputs=hashes)
        if run.finished:
            return run.record
        rays = run.chunk("rays", produce_rays)
        write_table(run.folder / "skeleton.parquet", skeleton, SKELETON)
        return run.publish(counts=counts, warnings=warnings)
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from pipelines.session.errors import BusyError, DataError, MocapError
from pipelines.session.storage import (
    as_data_error,
    hash_of,
    jsonable,
    read_json,
    remove_tree,
    sha256_of,
    sync_folder,
    sync_tree,
    write_json,
)

SCHEMA = 1
"""Version of session.json and stage.json. Older ones are read, newer ones refused."""

_AT_ROOT = {
    "ingest": (
        "cameras",
        "actor.parquet",
        "map",
        "plan.parquet",
        "truth.parquet",
        "truth_poses.parquet",
        "session.json",
    )
}
"""What a stage publishes beside its own folder instead of inside it; these names are its own."""

STAGES = ("ingest", "detect", "reconstruct", "overlay", "replan", "film", "report")
"""In the order in which they may run."""

_SHOWN_BY = {"reconstruct": ("overlay",)}
"""Stages that show a stage's result and nothing else: they go with the result that they show."""

_LEFT_BY_KILLED_INGEST = {".lock", ".lock.pid", ".partial", "ingest.new", "run.json.new"}


class NewerSchemaError(DataError):
    """A file of a later version of this program."""


@dataclass(frozen=True)
class Stage:
    """One of the stages of a session.

    Args:
        name: its folder in the session.
        revision: raised when the same input and settings give other results than before.
    """

    name: str
    revision: int

    def __post_init__(self) -> None:
        if self.name not in STAGES:
            raise ValueError(f"{self.name} is not a stage of a session")


@dataclass(frozen=True)
class StageRecord:
    """What `stage.json` says of a finished stage."""

    stage: str
    revision: int
    key: str
    settings: dict[str, Any]
    inputs: dict[str, str]  # name to sha256
    outputs: dict[str, str]  # path relative to the session, to sha256
    counts: dict[str, Any]
    warnings: list[str]


def key_of(stage: Stage, settings: Mapping[str, object], inputs: Mapping[str, str]) -> str:
    """Sha256 of all that decides a stage's result: equal keys, equal bytes."""
    ingredients = {
        "stage": stage.name,
        "revision": stage.revision,
        "settings": settings,
        "inputs": inputs,
    }
    return hash_of(ingredients)


class Session:
    """A session to read."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def record(self, stage: str) -> StageRecord | None:
        """What a stage says of itself, None if it was never finished.

        Raises:
            DataError: its record is damaged or of a later version.
        """
        path = self.folder / stage / "stage.json"
        return _read_record(path) if path.exists() else None


class WritableSession(Session):
    """A session that nobody else writes; `locked` hands it out."""

    def begin(
        self,
        stage: Stage,
        *,
        settings: Mapping[str, object],
        inputs: Mapping[str, str],
        force: bool = False,
    ) -> Run:
        """Begin a stage, or find that it is finished with these settings and inputs and undamaged.

        Args:
            stage: what runs.
            settings: all that decides the result, resolved, of what `jsonable` knows; no paths, no threads.
            inputs: the sha256 of everything read, by a name that is the same on every machine.
            force: do it again, from the start.

        Raises:
            DataError: the stage was written by a later version.
        """
        key = key_of(stage, settings, inputs)
        before = _usable_record(self.folder / stage.name / "stage.json")
        if force:
            _remove_partials(self.folder, stage.name)
        elif before is not None and before.key == key and self._intact(before):
            _remove_partials(self.folder, stage.name)  # of a --force that was interrupted
            return Run(self.folder, stage, key, settings, inputs, before=before, finished=True)
        new = _new(self.folder, stage.name)
        remove_tree(new)
        new.mkdir()
        return Run(self.folder, stage, key, settings, inputs, before=before, finished=False)

    def _intact(self, record: StageRecord) -> bool:
        files = {self.folder / name: expected for name, expected in record.outputs.items()}
        return all(path.is_file() and sha256_of(path) == expected for path, expected in files.items())


class Run:
    """One run of a stage.

    Attributes:
        folder: where the stage writes; it becomes the stage when published. What ingest writes there becomes
            the session's own files (session.json, cameras/, ...).
        finished: nothing is to be done, `record` says what there is.
        replaces: settings of the stage as it stands that differ from these: name to (before, now). None is
            what a setting is that was or is not there.
        outdated: stages that showed what was replaced, and went with it.
    """

    def __init__(
        self,
        session: Path,
        stage: Stage,
        key: str,
        settings: Mapping[str, object],
        inputs: Mapping[str, str],
        *,
        before: StageRecord | None,
        finished: bool,
    ) -> None:
        self.folder = _new(session, stage.name)
        self.finished = finished
        self._session = session
        self._stage = stage
        self._key = key
        self._settings: dict[str, Any] = jsonable(settings)
        self._inputs = dict(inputs)
        self._record = before if finished else None
        self._started = datetime.now(UTC)
        self._started_s = time.monotonic()
        old = {} if before is None else before.settings
        names = () if before is None else sorted({*old, *self._settings})
        self.replaces = {
            name: (old.get(name), self._settings.get(name))
            for name in names
            if old.get(name) != self._settings.get(name)
        }
        self.outdated: list[str] = []

    @property
    def record(self) -> StageRecord:
        """What the finished or published stage says of itself."""
        if self._record is None:
            raise RuntimeError(f"{self._stage.name} is not published yet")
        return self._record

    def chunk(self, name: str, produce: Callable[[Path], None]) -> Path:
        """The folder of a finished part of a long stage, made by `produce` unless an earlier run finished it.

        Args:
            name: of the part; the key of the stage is added to it.
            produce: writes the part into the empty folder it is given.
        """
        finished = self._session / ".partial" / f"{self._stage.name}-{self._key}" / name
        if finished.is_dir():
            return finished
        temporary = finished.with_name(f"{name}.new")
        remove_tree(temporary)
        temporary.mkdir(parents=True)
        produce(temporary)
        sync_tree(temporary)
        temporary.rename(finished)
        sync_folder(finished.parent)
        return finished

    def publish(self, *, counts: Mapping[str, object], warnings: Sequence[str] = ()) -> StageRecord:
        """End the stage: what lies in `folder` replaces what the stage wrote before, in one piece.

        Args:
            counts: what was found, used and dropped, of what `jsonable` knows.
            warnings: what the user should know, one line each.
        """
        sync_tree(self.folder)
        self._record = StageRecord(
            stage=self._stage.name,
            revision=self._stage.revision,
            key=self._key,
            settings=self._settings,
            inputs=self._inputs,
            outputs=self._outputs(),
            counts=jsonable(counts),
            warnings=jsonable(list(warnings)),
        )
        write_json(self.folder / "stage.json", {"schema": SCHEMA, **asdict(self._record)})
        sync_folder(self._session)
        self.outdated = _outdated(self._session, self._record)
        _roll_forward(self._session, self._stage.name)
        self._note_time()
        return self._record

    def _outputs(self) -> dict[str, str]:
        at_root = _AT_ROOT.get(self._stage.name)
        outputs = {}
        for path in sorted(path for path in self.folder.rglob("*") if path.is_file()):
            name = path.relative_to(self.folder)
            if at_root is None:
                name = Path(self._stage.name) / name
            elif name.parts[0] not in at_root:
                raise ValueError(f"{self._stage.name} does not own {name}")
            outputs[name.as_posix()] = sha256_of(path)
        return outputs

    def _note_time(self) -> None:
        path = self._session / "run.json"
        runs = read_json(path, "remove it: it holds only times of day") if path.exists() else {}
        entry = {
            "stage": self._stage.name,
            "started": self._started.isoformat(timespec="seconds"),
            "seconds": round(time.monotonic() - self._started_s, 3),
            "version": version("mocap-pipeline"),
            "libraries": _libraries(),
            "platform": platform.platform(),
        }
        write_json(path, {"schema": SCHEMA, "runs": [*runs.get("runs", []), entry]})


_LIBRARIES = (
    *("numpy", "scipy", "numba", "pandas", "pyarrow", "matplotlib"),
    *("opencv-python-headless", "av", "ai-edge-litert", "onnxruntime", "pycolmap", "mcap", "rosbags"),
)
"""What results rest on, as far as it is installed."""


@cache
def _libraries() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def versions_of(folder: Path) -> dict[str, dict[str, str]]:
    """With which mocap, Python and libraries each stage of a session last ran, as far as run.json says."""
    path = folder / "run.json"
    runs = read_json(path, "remove it: it holds only times of day") if path.exists() else {}
    told: dict[str, dict[str, str]] = {}
    for run in runs.get("runs", []):
        told[str(run.get("stage"))] = {"mocap": str(run.get("version")), **run.get("libraries", {})}
    return told


def session_name(folder: Path) -> str:
    """What a session is called: its folder's name, whatever way it was written, without `.session`."""
    return folder.resolve().name.removesuffix(".session")


def open_session(folder: Path) -> Session:
    """Open a session to read it; what a killed writer left half published is finished first.

    Raises:
        DataError: not a session, damaged, of a later version, or unreadable.
        BusyError: it is being published right now.
    """
    try:
        if not _is_interrupted(folder):
            _check_session(folder)
            return Session(folder)
    except OSError as error:
        raise as_data_error(error, folder) from error
    with locked(folder):
        return Session(folder)


@contextmanager
def locked(folder: Path, *, create: bool = False, overwrite: bool = False) -> Iterator[WritableSession]:
    """Hold a session for writing; what an earlier writer left behind is finished or removed first.

    An exception inside leaves every stage as it was. Errors of the operating system become DataError.

    Args:
        folder: the session's.
        create: it need not be there yet (ingest); a new folder of an ingest that fails is removed again.
        overwrite: with `create`, write also into a folder with other things in it. Those stay, except
            where they bear the name of one of the session's own files.

    Raises:
        DataError: not a session, or with `create` something else; of a later version; cannot be written.
        BusyError: another process holds it.
    """
    try:
        is_new = create and not folder.exists()
        _refuse_newer_session(folder)
        if create:
            _check_target(folder, overwrite=overwrite)
            folder.mkdir(parents=True, exist_ok=True)
        elif not _is_interrupted(folder):
            _check_session(folder)
        with _lock(folder):
            try:
                _repair(folder)
                if not create:
                    _check_session(folder)
                yield WritableSession(folder)
            except BaseException as error:
                # What cannot be tidied now is tidied by whoever opens the session next.
                with suppress(OSError):
                    _repair(folder)
                    if is_new and isinstance(error, MocapError):
                        # The user will change something, and then nothing of this is of use; after an
                        # interrupt it is.
                        remove_tree(folder / ".partial")
                raise
            finally:
                if is_new and not (folder / "session.json").exists():
                    _leave_no_trace(folder)
    except OSError as error:
        raise as_data_error(error, folder) from error


def _check_session(folder: Path) -> None:
    path = folder / "session.json"
    if not path.is_file():
        raise DataError(folder, "is not a session", "make one with `mocap ingest FLIGHT.yaml`")
    remedy = "run `mocap ingest` again"
    _refuse_newer(path, read_json(path, remedy), remedy)


def _check_target(folder: Path, *, overwrite: bool) -> None:
    if not folder.exists():
        return
    if not folder.is_dir():
        raise DataError(folder, "is a file, not a folder", "choose another place with --output")
    marks = ("ingest/stage.json", "ingest.new/stage.json")
    if overwrite or any((folder / mark).is_file() for mark in marks):
        return
    foreign = sorted({path.name for path in folder.iterdir()} - _LEFT_BY_KILLED_INGEST)
    if foreign:
        raise DataError(
            folder,
            f"is not a session and not empty ({len(foreign)} entries, the first {foreign[0]})",
            "choose another place with --output, or write into it with --overwrite",
        )


def _refuse_newer_session(folder: Path) -> None:
    try:
        _check_session(folder)
    except NewerSchemaError:
        raise
    except DataError:
        pass  # missing or damaged: whoever needs it says so, and ingest writes it anew


def _refuse_newer(path: Path, document: Mapping[str, Any], remedy: str) -> None:
    schema = document.get("schema")
    if not isinstance(schema, int):
        raise DataError(path, f"states no schema number (schema: {schema!r})", remedy)
    if schema > SCHEMA:
        raise NewerSchemaError(
            path, f"has schema {schema}, this version reads up to {SCHEMA}", "update mocap to read it"
        )


@contextmanager
def _lock(folder: Path) -> Iterator[None]:
    """The kernel's lock, which ends with the process, however that ends."""
    # The holder's number stands beside the lock: some versions of filelock empty the file when they try it.
    holder = folder / ".lock.pid"
    try:
        lock = FileLock(folder / ".lock").acquire(timeout=0)
    except Timeout:
        raise BusyError(f"{folder} is being written by {_process(holder)}; wait for it to finish") from None
    with lock:
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


def _leave_no_trace(folder: Path) -> None:
    with suppress(OSError):
        (folder / ".lock").unlink()
        (folder / ".lock.pid").unlink()
        folder.rmdir()


def _read_record(path: Path) -> StageRecord:
    remedy = "run the stage again with --force"
    document = read_json(path, remedy)
    _refuse_newer(path, document, remedy)
    kinds = {
        "stage": str,
        "revision": int,
        "key": str,
        "settings": dict,
        "inputs": dict,
        "outputs": dict,
        "counts": dict,
        "warnings": list,
    }
    wrong = [name for name, kind in kinds.items() if not isinstance(document.get(name), kind)]
    if wrong:
        raise DataError(path, f"has no usable {', '.join(wrong)}", remedy)
    return StageRecord(**{name: document[name] for name in kinds})


def _usable_record(path: Path) -> StageRecord | None:
    try:
        return _read_record(path) if path.exists() else None
    except NewerSchemaError:
        raise
    except DataError:
        return None


def _new(folder: Path, stage: str) -> Path:
    return folder / f"{stage}.new"


def _old(folder: Path, stage: str) -> Path:
    # Hidden: a user may well keep a copy of a result as `reconstruct.old`, and that is not ours to remove.
    return folder / f".{stage}.old"


def _is_interrupted(folder: Path) -> bool:
    return any(
        (_new(folder, stage) / "stage.json").exists() or _old(folder, stage).exists() for stage in STAGES
    )


def _repair(folder: Path) -> None:
    """Finish what was published halfway, remove what was not."""
    for stage in STAGES:
        if _usable_record(_new(folder, stage) / "stage.json") is not None:
            _roll_forward(folder, stage)
        remove_tree(_new(folder, stage))
        _settle_old(folder, stage)
    remove_tree(folder / "run.json.new")


def _roll_forward(folder: Path, stage: str) -> None:
    """Publish a complete `<stage>.new`.

    Every step can be taken again, and the renaming of the stage's folder, with its record, comes last: a kill
    between any two steps is mended by doing it all once more.
    """
    new, old = _new(folder, stage), _old(folder, stage)
    record = _read_record(new / "stage.json")
    published = {name.partition("/")[0] for name in record.outputs}
    _remove_partials(folder, stage)
    old.mkdir(exist_ok=True)
    for entry in _AT_ROOT.get(stage, ()):
        is_in_place = entry in published and not (new / entry).exists()
        if not is_in_place:
            _move(folder / entry, old / entry)
            _move(new / entry, folder / entry)
    for shown in _outdated(folder, record):
        _move(folder / shown, old / shown)
    _move(folder / stage, old / stage)
    new.rename(folder / stage)
    sync_folder(old)
    sync_folder(folder)
    remove_tree(old)


def _outdated(folder: Path, record: StageRecord) -> list[str]:
    """The stages that show another result than this one; those of a later version are not ours to judge."""
    outdated = []
    for name in _SHOWN_BY.get(record.stage, ()):
        with suppress(NewerSchemaError):
            shown = _usable_record(folder / name / "stage.json")
            if shown is not None and shown.inputs.get(record.stage) != record.key:
                outdated.append(name)
    return outdated


def _settle_old(folder: Path, stage: str) -> None:
    """Remove what was replaced, or put it back where its successor has been removed by hand meanwhile."""
    old = _old(folder, stage)
    if old.exists() and not (folder / stage).exists():
        for entry in sorted(old.iterdir()):
            if not (folder / entry.name).exists():
                entry.rename(folder / entry.name)
    remove_tree(old)


def _move(source: Path, target: Path) -> None:
    if source.exists():
        source.rename(target)


def _remove_partials(folder: Path, stage: str) -> None:
    partial = folder / ".partial"
    for chunks in sorted(partial.glob(f"{stage}-*")):
        remove_tree(chunks)
    if partial.is_dir() and not any(partial.iterdir()):
        partial.rmdir()
