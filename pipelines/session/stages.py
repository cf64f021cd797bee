"""Stages of a session: begin under a lock, resume after an interrupt, publish completely or not at all.

    with locked(folder) as session:
        run = session.begin(RECONSTRUCT, settings=settings, inputs=hashes)
        if run.finished:
            return run.record
        write_table(run.folder / "skeleton.parquet", skeleton, SKELETON)
        return run.publish(counts=counts, warnings=warnings)

`stage.json` records of what a stage was made. `run.json`, with run times, versions and stamps of sources, is
the only file that differs from run to run.
"""

from __future__ import annotations

import platform
import shutil
import stat
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath
from typing import Any

from pipelines.session.errors import DataError, MocapError
from pipelines.session.storage import (
    SCHEMA,
    NewerSchemaError,
    drop_link,
    finished_part,
    hash_of,
    held,
    is_special,
    jsonable,
    make_folder,
    on_disk,
    read_json,
    refuse_newer,
    refuse_others,
    refuse_special,
    remove_if_unused,
    remove_tree,
    sha256_of,
    sync,
    sync_tree,
    write_json,
)

COMMANDS = {
    "ingest": "mocap ingest",
    "detect": "mocap reconstruct",
    "background": "mocap reconstruct",
    "reconstruct": "mocap reconstruct",
    "replan": "mocap replan-compare",
    "film": "mocap replan-compare --render 5",
    "report": "mocap report",
}
"""The command that makes each stage, in the order in which they may run."""

STAGES = tuple(COMMANDS)


@dataclass(frozen=True)
class Stage:
    """A stage of a session; its revision grows when equal inputs and settings give other results."""

    name: str
    revision: int

    def __post_init__(self) -> None:
        if self.name not in STAGES:
            raise ValueError(f"{self.name} is not a stage of a session")


@dataclass(frozen=True)
class StageRecord:
    """The content of a finished stage's `stage.json`."""

    stage: str
    revision: int
    key: str
    settings: dict[str, Any]
    inputs: dict[str, str]  # name to sha256
    outputs: dict[str, str]  # path relative to the session, to sha256
    counts: dict[str, Any]
    warnings: list[str]


def key_of(stage: Stage, settings: Mapping[str, object], inputs: Mapping[str, str]) -> str:
    """Compute the SHA-256 of everything that determines a stage's result: equal keys, equal bytes."""
    ingredients = {"stage": stage.name, "revision": stage.revision, "settings": settings, "inputs": inputs}
    return hash_of(ingredients)


def outdated(records: Mapping[str, StageRecord], recorded: Mapping[str, str]) -> list[str]:
    """List the stages of which something that they were made of, or a recording's hash, has changed."""
    made = {**recorded, **{stage: record.key for stage, record in records.items()}}
    for record in records.values():
        made |= record.outputs
    return [
        stage
        for stage, record in records.items()
        if stage != "ingest"
        and any(made.get(name, digest) != digest for name, digest in record.inputs.items())
    ]


def read_record(path: Path) -> StageRecord:
    """Read a `stage.json`; DataError if it is damaged or of a later version."""
    remedy = "run the stage again with --force"
    document = read_json(path, remedy)
    refuse_newer(path, document, remedy)
    kinds = {"stage": str, "revision": int, "key": str, "warnings": list}
    kinds |= dict.fromkeys(("settings", "inputs", "outputs", "counts"), dict)
    wrong = [name for name, kind in kinds.items() if not isinstance(document.get(name), kind)]
    if not wrong and any(PurePosixPath(name).is_absolute() or ".." in name for name in document["outputs"]):
        wrong = ["outputs"]
    if wrong:
        raise DataError(path, f"has no usable {', '.join(wrong)}", remedy, code="damaged")
    return StageRecord(**{name: document[name] for name in kinds})


def usable_record(path: Path) -> StageRecord | None:
    """Read a `stage.json`; None if it is missing or damaged, a NewerSchemaError if of a later version."""
    try:
        return read_record(path) if path.exists() else None
    except NewerSchemaError:
        raise
    except DataError:
        return None


_LIBRARIES = (
    *("numpy", "scipy", "numba", "pandas", "pyarrow", "matplotlib"),
    *("opencv-python-headless", "av", "ai-edge-litert", "onnxruntime", "pycolmap", "mcap", "rosbags"),
)
"""The libraries on which results depend; those that are installed are noted."""


@dataclass(frozen=True)
class Stopwatch:
    """A clock that starts when a run begins."""

    started: datetime = field(default_factory=lambda: datetime.now(UTC))
    started_s: float = field(default_factory=time.monotonic)

    def note(self, session: Path, stage: str) -> None:
        """Add the run, which ends now, to the session's run.json."""
        entry = {
            "stage": stage,
            "started": self.started.isoformat(timespec="seconds"),
            "seconds": round(time.monotonic() - self.started_s, 3),
            "version": version("mocap-pipeline"),
            "libraries": _libraries(),
            "platform": platform.platform(),
        }
        _write(session, {"runs": [*_runs(session), entry]})


def versions_of(folder: Path) -> dict[str, dict[str, str]]:
    """Return the versions of mocap, Python and libraries with which each stage last ran, from run.json."""
    versions: dict[str, dict[str, str]] = {}
    for run in _runs(folder):
        versions[str(run.get("stage"))] = {"mocap": str(run.get("version")), **run.get("libraries", {})}
    return versions


def note_sources(session: Path, hashes: Mapping[str, str], stamps: Mapping[str, str]) -> None:
    """Note in run.json where the session lies, and each source's content hash with its stamp, by its name."""
    sources = {name: {"sha256": digest, "stamp": stamps[name]} for name, digest in hashes.items()}
    noted = {"sources": sources, "folder": str(session.absolute())}
    known = _read(session)
    if any(known.get(key) != value for key, value in noted.items()):
        _write(session, noted)


def noted_stamps(session: Path, hashes: Mapping[str, str]) -> dict[str, str]:
    """Return the noted stamps of the sources whose hashes are unchanged; empty without a usable run.json."""
    try:
        noted = _read(session).get("sources")
    except DataError:
        return {}
    if not isinstance(noted, dict):
        return {}
    return {
        name: noted[name].get("stamp", "")
        for name, digest in hashes.items()
        if isinstance(noted.get(name), dict) and noted[name].get("sha256") == digest
    }


def _runs(session: Path) -> list[dict[str, Any]]:
    runs: list[dict[str, Any]] = _read(session).get("runs", [])
    return runs


def _read(session: Path) -> dict[str, Any]:
    path = session / "run.json"
    remedy = "remove it: it holds only times of day"
    return read_json(path, remedy) if path.exists() else {}


def _write(session: Path, changes: Mapping[str, object]) -> None:
    write_json(session / "run.json", {**_read(session), "schema": SCHEMA, **changes})


@cache
def _libraries() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


_AT_ROOT = {
    "ingest": (
        *("cameras", "actor.parquet", "map", "plan.parquet", "truth.parquet", "truth_poses.parquet"),
        *("truth_body.parquet", "truth_body_shape.parquet", "session.json"),
    )
}
"""Names that a stage publishes beside its own folder instead of inside it; only that stage writes them."""

_LOCK = ".lock"
_LEFT_BY_KILLED_INGEST = {".lock", ".lock.pid", ".partial", "ingest.new", "run.json", "run.json.new"}


class Session:
    """A session to read."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def record(self, stage: str) -> StageRecord | None:
        """Read the record of a stage; None if it was never finished, a DataError if the record is damaged."""
        path = self.folder / stage / "stage.json"
        return read_record(path) if path.exists() else None

    def intact_record(self, stage: str) -> StageRecord | None:
        """Return a stage's record if all its files are as written, None without one; else DataError."""
        record = self.record(stage)
        if record is None:
            return None
        command = COMMANDS[stage]
        for path in self._changed(record):
            problem = f"is not what `{command}` wrote (other SHA-256): it was changed since"
            if not path.is_file():
                kept = "no file any more" if path.exists() else "gone"
                problem = f"is {kept} although `{command}` wrote it"
            raise DataError(path, problem, f"run `{command}` again, which makes it anew", code="changed")
        return record

    def _changed(self, record: StageRecord) -> Iterator[Path]:
        for name, expected in record.outputs.items():
            path = self.folder / name
            if not path.is_file() or is_special(path) or sha256_of(path) != expected:
                yield path

    def ingested(self) -> StageRecord:
        """Return the record of the ingest as `intact_record` does; DataError for a part of a session."""
        record = self.intact_record("ingest")
        if record is None:
            problem, remedy = "was never ingested completely", "run `mocap ingest` again, or copy all of it"
            raise DataError(self.folder, problem, remedy, code="not-a-session")
        return record

    def finished(
        self, stage: Stage, settings: Mapping[str, object], inputs: Mapping[str, str]
    ) -> StageRecord | None:
        """Return the record of a stage that these settings and inputs made, if its files are undamaged."""
        record = usable_record(self.folder / stage.name / "stage.json")
        key = key_of(stage, settings, inputs)
        unchanged = record is not None and record.key == key and not any(self._changed(record))
        return record if unchanged else None


class WritableSession(Session):
    """A session that no other process writes; `locked` makes it."""

    def begin(
        self, stage: Stage, *, settings: Mapping[str, object], inputs: Mapping[str, str], force: bool = False
    ) -> Run:
        """Begin a stage, or find it finished with the same settings and inputs, and undamaged.

        `settings` are everything that determines the result, without paths or thread counts; `inputs` the
        SHA-256 of everything read, by a name that is the same on every machine. `force` runs it again, from
        the start.
        """
        key = key_of(stage, settings, inputs)
        before = usable_record(self.folder / stage.name / "stage.json")
        if force:
            _remove_partials(self.folder, stage.name)
        elif self.finished(stage, settings, inputs) is not None:
            _remove_partials(self.folder, stage.name)  # of a --force that was interrupted
            return Run(self.folder, stage, key, settings, inputs, before=before, finished=True)
        new = _new_folder(self.folder, stage.name)
        remove_tree(new)
        new.mkdir()
        return Run(self.folder, stage, key, settings, inputs, before=before, finished=False)

    def reusable(self, stage: Stage) -> StageRecord | None:
        """Return the record of a finished stage of this revision whose files a new run may take over."""
        before = usable_record(self.folder / stage.name / "stage.json")
        if before is None or before.revision != stage.revision or any(self._changed(before)):
            return None
        return before


class Run:
    """One run of a stage, which writes into `folder`.

    `finished`: nothing is to be done, and `record` describes the existing result. `replaces`: settings that
    differ from the earlier run's, name to (before, now).
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
        self.folder = _new_folder(session, stage.name)
        self.finished = finished
        self._session = session
        self._stage = stage
        self._key = key
        self._settings: dict[str, Any] = jsonable(settings)
        self._inputs = dict(inputs)
        self._record = before if finished else None
        self._stopwatch = Stopwatch()
        old = {} if before is None else before.settings
        names = () if before is None else sorted({*old, *self._settings})
        self.replaces = {
            name: (old.get(name), self._settings.get(name))
            for name in names
            if old.get(name) != self._settings.get(name)
        }

    @property
    def record(self) -> StageRecord:
        """The record of the finished or published stage."""
        if self._record is None:
            raise RuntimeError(f"{self._stage.name} is not published yet")
        return self._record

    def chunk(self, name: str, produce: Callable[[Path], None]) -> Path:
        """Return the folder of a finished part of a stage; call `produce` if no earlier run finished it."""
        return finished_part(self._chunks / name, produce)

    def has_chunk(self, name: str) -> bool:
        """Return True if an earlier run finished this part."""
        return (self._chunks / name).is_dir()

    @property
    def _chunks(self) -> Path:
        return self._session / ".partial" / f"{self._stage.name}-{self._key}"

    def publish(self, *, counts: Mapping[str, object], warnings: Sequence[str] = ()) -> StageRecord:
        """End the stage: the content of `folder` replaces its earlier files, completely or not at all."""
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
        # Before the record, with which a kill no longer undoes the stage: the report states these versions.
        self._stopwatch.note(self._session, self._stage.name)
        write_json(self.folder / "stage.json", {"schema": SCHEMA, **asdict(self._record)})
        sync(self._session)
        _roll_forward(self._session, self._stage.name)
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


def session_name(folder: Path) -> str:
    """Return the name of a session: the name of its resolved folder without `.session`."""
    return folder.resolve().name.removesuffix(".session")


def names_of(paths: Sequence[Path]) -> list[str]:
    """Return the names of flights: the file's, or the folder's of a `flight.yaml`; DataError: two alike."""
    named: dict[str, Path] = {}
    for path in paths:
        whole = path.resolve()
        name = whole.stem if whole.stem != "flight" else whole.parent.name
        if name in named:
            problem = f"would be called {name}, as {named[name]} is"
            raise DataError(path, problem, "leave --output out, or rename one of them", code="exists")
        named[name] = path
    return list(named)


def open_session(folder: Path) -> Session:
    """Open a session for reading; DataError: it is none, damaged, newer, or was interrupted."""
    with on_disk(folder):
        for stage in STAGES:
            new, old = _new_folder(folder, stage), _old(folder, stage)
            if (new / "stage.json").exists() and old.exists() and not (new.is_symlink() or old.is_symlink()):
                problem = f"was interrupted while `{COMMANDS[stage]}` published its result"
                remedy = f"run `{COMMANDS[stage]}` again, which completes it"
                raise DataError(folder, problem, remedy, code="not-a-session")
        _check_session(folder)
    return Session(folder)


def refuse_no_session(folder: Path) -> None:
    """Refuse a folder that is no session, before work that takes long; an interrupted one passes."""
    if not was_interrupted(folder):
        open_session(folder)


@contextmanager
def locked(folder: Path, *, create: bool = False, overwrite: bool = False) -> Iterator[WritableSession]:
    """Lock a session for writing; leftovers of a killed writer are completed or removed first.

    An exception inside leaves every stage as it was. `create` allows a folder that does not exist yet (if the
    ingest fails, it is removed), and with `overwrite` one with other files in it, which stay.

    DataError: not a session, or with `create` something else; of a later version; cannot be written.
    BusyError: another process holds it.
    """
    with on_disk(folder):
        is_new = create and not folder.exists()
        _refuse_newer_session(folder)
        if create:
            marks = ("ingest/stage.json", "ingest.new/stage.json")
            is_free = overwrite or any((folder / mark).is_file() for mark in marks)
            refuse_others(
                folder,
                lambda name: is_free or name in _LEFT_BY_KILLED_INGEST,
                "no session, but other files",
                way="write into it",
            )
            make_folder(folder)
        elif not was_interrupted(folder):
            _check_session(folder)
        with held(folder / _LOCK, folder):
            try:
                _drop_links(folder)
                _repair(folder)
                if not create:
                    _check_session(folder)
                yield WritableSession(folder)
            except BaseException as error:
                # What cannot be repaired now is repaired when the session is opened next.
                with suppress(OSError):
                    _repair(folder)
                    if is_new and isinstance(error, MocapError):
                        # The user will change an input, so finished parts are useless; after an interrupt
                        # they are useful.
                        remove_tree(folder / ".partial")
                raise
            finally:
                if is_new and not (folder / "session.json").exists():
                    remove_if_unused(folder, _LOCK)


def _check_session(folder: Path) -> None:
    path = folder / "session.json"
    if not path.is_file():
        problem = "is not a session"
        raise DataError(folder, problem, "make one with `mocap ingest FLIGHT.yaml`", code="not-a-session")
    remedy = "run `mocap ingest` again"
    refuse_newer(path, read_json(path, remedy), remedy)


def _refuse_newer_session(folder: Path) -> None:
    try:
        _check_session(folder)
    except NewerSchemaError:
        raise
    except DataError:
        pass  # missing or damaged: its readers report this, and ingest writes it again


def _new_folder(folder: Path, stage: str) -> Path:
    """Return the folder in which a stage writes until it is published."""
    return folder / f"{stage}.new"


def _old(folder: Path, stage: str) -> Path:
    # Hidden, because a user may keep a copy of a result as `reconstruct.old`, which must not be removed.
    return folder / f".{stage}.old"


def was_interrupted(folder: Path) -> bool:
    """Return True if the publication of a stage was interrupted; links of somebody else are none of ours."""
    news = (_new_folder(folder, stage) for stage in STAGES)
    olds = (_old(folder, stage) for stage in STAGES)
    return any((new / "stage.json").exists() and not new.is_symlink() for new in news) or any(
        old.exists() and not old.is_symlink() for old in olds
    )


def tidy(folder: Path) -> None:
    """Remove what a kill left of making a stage, if the session can be written."""
    left = [_new_folder(folder, stage) for stage in STAGES]
    if any(new.exists() and not new.is_symlink() for new in left):
        with suppress(MocapError), locked(folder):
            pass


def _drop_links(folder: Path) -> None:
    """Remove symbolic links in the places of hidden and unfinished folders; see `drop_link`."""
    partial = folder / ".partial"
    drop_link(partial)
    of_stages = [place(folder, stage) for stage in STAGES for place in (_new_folder, _old)]
    for path in [*partial.glob("*"), *of_stages, *folder.glob("*.json.new")]:
        drop_link(path)


def _repair(folder: Path) -> None:
    """Complete interrupted publications, and remove the folders of stages that did not reach theirs."""
    for stage in STAGES:
        if usable_record(_new_folder(folder, stage) / "stage.json") is not None:
            _roll_forward(folder, stage)
        remove_tree(_new_folder(folder, stage))
        remove_tree(_old(folder, stage))
    remove_tree(folder / "run.json.new")


def _roll_forward(folder: Path, stage: str) -> None:
    """Publish a complete `<stage>.new` by steps that can be repeated; the stage's folder is renamed last."""
    new, old = _new_folder(folder, stage), _old(folder, stage)
    record = read_record(new / "stage.json")
    published = {name.partition("/")[0] for name in record.outputs}
    _remove_partials(folder, stage)
    old.mkdir(exist_ok=True)
    for entry in _AT_ROOT.get(stage, ()):
        is_in_place = entry in published and not (new / entry).exists()
        if not is_in_place:
            _move(folder / entry, old / entry)
            _move(new / entry, folder / entry)
    for changed in (old, new, folder):  # else the last rename might reach the disk before the others
        sync(changed)
    _move(folder / stage, old / stage)
    new.rename(folder / stage)
    sync(folder)
    remove_tree(old)


def _move(source: Path, target: Path) -> None:
    if source.exists():
        source.rename(target)


def _remove_partials(folder: Path, stage: str) -> None:
    """Remove the stored finished parts of a stage, which no run needs any more."""
    partial = folder / ".partial"
    for chunks in sorted(partial.glob(f"{stage}-*")):
        remove_tree(chunks)
    if partial.is_dir() and not any(partial.iterdir()):
        partial.rmdir()


# --- copies of sessions --------------------------------------------------------------------------------

_ORIGIN = "copied_from.json"


def copy_session(folder: Path, target: Path) -> None:
    """Copy a session without its videos, so that stages can run on it; a copy of it already is kept."""
    record = open_session(folder).ingested()
    with on_disk(target):
        if (target / _ORIGIN).is_file():
            stated = read_json(target / _ORIGIN, "choose another --output")
            if stated == {"session": str(origin_of(folder).resolve()), "ingest": record.key}:
                return
        if target.exists():
            problem = "exists, and is no copy of this session"
            raise DataError(target, problem, "choose another --output", code="exists")
        make_folder(target.absolute().parent)
        new = target.with_name(f".{target.name}.copying")
        remove_tree(new)
        hidden = shutil.ignore_patterns(".*", "*.new")
        shutil.copytree(folder, new, ignore=hidden, symlinks=True, copy_function=_copy_file)
        for path in [new, *new.rglob("*")]:
            if not path.is_symlink():
                path.chmod(path.stat().st_mode | stat.S_IWUSR)
        write_json(new / _ORIGIN, {"session": str(origin_of(folder).resolve()), "ingest": record.key})
        new.rename(target)


def _copy_file(source: str, target: str) -> None:
    """Copy a file; another kind of file is refused, because reading it may never end."""
    refuse_special(Path(source))
    shutil.copy2(source, target)


def origin_of(folder: Path) -> Path:
    """Return the folder to which the paths in a session are relative: of a copy, that of the original."""
    note = folder / _ORIGIN
    return Path(str(read_json(note).get("session", folder))) if note.is_file() else folder


def first_place_of(folder: Path) -> Path:
    """Return the folder in which a session was ingested, as run.json notes it; else the folder itself."""
    try:
        return Path(str(_read(folder).get("folder", folder)))
    except DataError:
        return folder
