"""Files and folders that survive a kill, reproducible JSON, hashes of files, locks.

`whole_folder` makes a folder that appears complete or not at all: it is written in a hidden folder beside the
target. Its finished parts are stored by key and survive an interrupt.
"""

import codecs
import errno
import hashlib
import json
import math
import os
import re
import shutil
import stat
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal
from urllib.parse import unquote

import numpy as np
from filelock import FileLock, Timeout

from pipelines.session.errors import BusyError, DataError

CAMERA_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")

# Spreadsheets and some editors begin a file with one of these marks.
_UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)

_SPACE = ("disk-full", "free some space and run the command again")
_PERMISSIONS = ("no-permission", "check its permissions, or choose another place with --output")
_MEND = "mend that and run the command again"
_ERRORS = {  # code and remedy
    errno.ENOENT: ("no-such-file", "check the path; those in a flight.yaml are relative to it"),
    **dict.fromkeys((errno.ENOTDIR, errno.EISDIR), ("not-a-folder", _MEND)),
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), _SPACE),
    **dict.fromkeys((errno.EACCES, errno.EPERM), _PERMISSIONS),
    errno.EROFS: (
        "no-permission",
        "choose another place with --output, or copy it to where files can be written",
    ),
    errno.ENOMEM: ("out-of-memory", _MEND),
}


def as_data_error(error: OSError, path: Path) -> DataError:
    """Make a one-line error of an operating system's error; `path` is used if the error names no file."""
    code, remedy = _ERRORS.get(error.errno or 0, ("unreadable", _MEND))
    return DataError(error.filename or path, error.strerror or str(error), remedy, code=code)


@contextmanager
def on_disk(path: Path) -> Iterator[None]:
    """Make errors of the operating system within it those of `as_data_error`."""
    try:
        yield
    except OSError as error:
        raise as_data_error(error, path) from error


def refuse_names(names: Collection[str], of: Literal["camera", "person"]) -> None:
    """Refuse, with a ValueError, names that cannot be of files each, or that unnamed people have."""
    for name in names:
        if not CAMERA_NAME.fullmatch(name):
            raise ValueError(f"name {name!r} of a {of}: use 1 to 64 of A-Z a-z 0-9 _ -, it names files")
        if of == "person" and name.lower().startswith("person") and name[6:].isdigit():
            raise ValueError(f"name {name!r} of a person: people without a log are called so")
    if len({name.lower() for name in names}) < len(names):
        raise ValueError(f"names of a {of} differ in case only: their files would be one on some systems")


# The largest JSON that mocap writes is the metrics of an eight-hour flight, of some megabytes.
MAX_JSON_BYTES = 1 << 26

# Files of the kernel look like files of a size that they do not have, and reading some never ends.
_OF_THE_KERNEL = ("/proc/", "/sys/")


# fsspec has many more, some of which open files of this machine, archives, or other URLs.
SCHEMES = ("s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "adl", "http", "https", "file")

_URL = re.compile(r"(?is)(?P<scheme>[a-z][a-z0-9+.-]+):(?P<chained>:.*:)?/+(?P<rest>[^/].*)")
_IPV6 = re.compile(r"(?i)^\[[0-9a-f:.]+\]")
# Each part between = & / is read once: backtracking took minutes for some texts of 10 kB.
_SECRET = re.compile(
    r"(?i)(?:(?:^|[=/])[^=&/?#;]*[?#;]|&)(?=[^=&/]*(?:[=&]|$))"
    r"[^=&/]*(?:sig|token|key|secret|credential|pass|pw|auth|jwt|code|\bsas\b)"
)


def url_of(place: Path | str) -> str | None:
    """Return the URL that a place is; None for a path. DataError: it holds a secret or is not fetched."""
    text = str(place)
    found = _URL.fullmatch(text)
    if found is None or os.path.lexists(text):
        return None
    scheme, rest = found["scheme"].lower(), found["rest"].rstrip("/")
    if found["chained"] or "::" in _IPV6.sub("", rest) or scheme not in SCHEMES:
        problem = f"is a kind of URL that mocap does not open (it opens {', '.join(SCHEMES)})"
        remedy = "copy the file to this machine, and give its path"
        raise DataError(f"{scheme}://...", problem, remedy, code="url-refused")
    if "@" in unquote(rest.partition("/")[0]) or _SECRET.search(unquote(rest)):
        remedy = "leave them out of it, and set them where the store's own tools look for them"
        raise DataError(f"{scheme}://...", "is a URL with credentials in it", remedy, code="url-with-secret")
    return f"{scheme}:///{rest}" if scheme == "file" else f"{scheme}://{rest}"


# A file of holes takes no place on a disk, and seconds for each gigabyte to read; less is soon read.
MIN_HOLLOW_BYTES = 1 << 30
# No compression that file systems use makes a table or film so small.
MAX_HOLLOW_SHARE = 1e-3


def is_special(path: Path) -> bool:
    """Return True for what may never end: a pipe, a socket, a device, a file of the kernel or of holes."""
    try:
        status = path.stat()
        if os.path.realpath(path).startswith(_OF_THE_KERNEL):
            return True
        if stat.S_ISREG(status.st_mode) and status.st_size > MIN_HOLLOW_BYTES and hasattr(os, "SEEK_HOLE"):
            with path.open("rb") as file:  # some file systems count no blocks, but tell no holes either
                has_hole = os.lseek(file.fileno(), 0, os.SEEK_HOLE) < status.st_size
            return has_hole and status.st_blocks * 512 < MAX_HOLLOW_SHARE * status.st_size
    except (OSError, ValueError):  # missing, or an impossible name: the function that opens it reports this
        return False
    return not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode))


def refuse_special(path: Path) -> None:
    """Refuse, with a DataError, what `is_special`."""
    if is_special(path):
        problem = "is a pipe, a socket, a device, or a large sparse file that is all but empty"
        remedy = "copy the file anew, or write what comes out of it to a file, and name that"
        raise DataError(path, problem, remedy, code="special-file")


def text_encoding(content: bytes) -> str:
    """Return the encoding of a text by its first bytes: UTF-16 if they are its mark, else UTF-8."""
    return "utf-16" if content.startswith(_UTF16_MARKS) else "utf-8-sig"


def plain_text(content: bytes, errors: str = "replace") -> str:
    r"""Decode UTF-8, or UTF-16 with its mark, lines ending in LF; UnicodeDecodeError with `strict`."""
    return content.decode(text_encoding(content), errors).replace("\r\n", "\n").replace("\r", "\n")


def read_text(path: Path, *, most_bytes: int | None = None) -> str:
    r"""Read a file as UTF-8, or UTF-16 with its mark, lines ending in LF; DataError: it is no such text."""
    refuse_special(path)
    try:
        if most_bytes is not None and path.stat().st_size > most_bytes:
            raise DataError(path, f"is larger than {most_bytes} bytes", "name another file", code="too-large")
        return plain_text(path.read_bytes(), errors="strict")
    except OSError as error:
        raise as_data_error(error, path) from error
    except UnicodeDecodeError as error:
        problem = f"is not UTF-8 text (byte {error.start})"
        remedy = "name a text file here, or save it as UTF-8"
        raise DataError(path, problem, remedy, code="damaged") from error


def own_table(module: str, name: str) -> dict[str, Any]:
    """Read a TOML file of this program, which lies in the folder `data` beside a module."""
    return tomllib.loads((Path(module).parent / "data" / f"{name}.toml").read_text(encoding="utf-8"))


def sha256_of(path: Path) -> str:
    """Hash the content of a file, or of a folder: the relative names and contents of its files, sorted.

    Empty folders and the content of linked folders are ignored. DataError if something cannot be read.
    """
    refuse_special(path)
    with on_disk(path):
        if not is_folder(path):
            return _file_digest(path).hex()
        digest = hashlib.sha256()
        for name, file in sorted(_files(path)):
            # Zero byte after the name, a digest of fixed length: no two folders run together.
            digest.update(os.fsencode(name) + b"\0" + _file_digest(file))
        return digest.hexdigest()


def file_stamp(path: Path) -> str:
    """Hash sizes and times of change of a file, or a folder's files: unchanged if nothing was written."""
    with on_disk(path):
        if not is_folder(path):
            return hash_of(_size_and_change(path))
        return hash_of([[name, *_size_and_change(file)] for name, file in sorted(_files(path))])


def _size_and_change(path: Path) -> list[int]:
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


def _file_digest(path: Path) -> bytes:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").digest()


def _files(folder: Path) -> list[tuple[str, Path]]:
    """Return names and paths of all files of a folder, or of a pattern."""
    if not folder.is_dir():
        return [(file.name, file) for file in files_in(folder)]
    return [(file.relative_to(folder).as_posix(), file) for file in folder.rglob("*") if file.is_file()]


def files_in(path: Path) -> list[Path]:
    """Return the files of a folder, without those below, or of a pattern of names (`images/left_*.png`)."""
    folder, pattern = (path, "*") if path.is_dir() else (path.parent, re.sub(r"\*+", "*", path.name))
    return [file for file in folder.glob(pattern) if file.is_file()] if "*" in pattern else []


def is_folder(path: Path) -> bool:
    """Return True for a folder, and for a pattern that names files of one."""
    return path.is_dir() or bool(files_in(path))


def jsonable(value: object) -> Any:
    """Convert a value to JSON types: NaN to null, numpy numbers and arrays to plain ones, tuples to lists.

    TypeError for anything else (a path, a key that is no string), ValueError for an infinite number.
    """
    match value:
        case None | bool() | int():
            return value
        case np.generic() | np.ndarray():
            return jsonable(value.tolist())
        case float():
            if math.isinf(value):
                raise ValueError(f"{value} cannot be written as JSON")
            return None if math.isnan(value) else float(value)
        case str():
            # Names of files that are not UTF-8 arrive with lone surrogates, which UTF-8 cannot hold.
            return value.encode("utf-8", "replace").decode("utf-8")
        case Mapping():
            if not all(isinstance(key, str) for key in value):
                raise TypeError(f"keys of JSON objects are strings: {list(value)}")
            return {jsonable(key): jsonable(item) for key, item in value.items()}
        case list() | tuple():
            return [jsonable(item) for item in value]
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")


def hash_of(value: object) -> str:
    """Compute the SHA-256 of a value of types that `jsonable` accepts: the same for any order of keys."""
    text = json.dumps(jsonable(value), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON object so that a kill leaves the old file or the new one; ValueError: NaN or infinite."""
    text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    write_whole(path, text.encode("utf-8"))


def write_whole(path: Path, content: bytes) -> None:
    """Write a file; a kill leaves the old file or the new one, complete."""
    temporary = path.with_name(f"{path.name}.new")
    try:
        _write_anew(temporary, content)
        sync(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    sync(path.parent)


def _write_anew(path: Path, content: bytes) -> None:
    """Write a file that does not exist yet; what is in its place is removed, and no link is followed."""
    path.unlink(missing_ok=True)
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666), "wb") as file:  # noqa: PTH123
        file.write(content)


def drop_link(path: Path) -> None:
    """Remove a symbolic link in the place of a file or folder of mocap's own; what it leads to stays.

    A session of somebody else may hold one that leads to files of the user, which would be replaced.
    """
    if path.is_symlink():
        path.unlink()


def read_json(
    path: Path, remedy: str = "run the stage that wrote it again with --force", *, takes_nan: bool = False
) -> dict[str, Any]:
    """Read a JSON object; DataError: it is none, or too large. `takes_nan` makes NaN and infinities null."""
    refuse_special(path)
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise DataError(path, f"has more than {MAX_JSON_BYTES >> 20} MB", remedy, code="too-large")
        document = json.loads(
            path.read_bytes(), parse_constant=(lambda _: None) if takes_nan else _refuse_constant
        )
    except OSError as error:
        raise as_data_error(error, path) from error
    except (ValueError, RecursionError) as error:
        raise DataError(path, f"is damaged ({error})", remedy, code="damaged") from error
    if not isinstance(document, dict):
        raise DataError(path, f"holds a {type(document).__name__} where an object belongs", remedy)
    return document


SCHEMA = 1
"""Version of session.json and stage.json. Older ones are read, newer ones refused."""


class NewerSchemaError(DataError):
    """Error for a file that a later version of this program wrote."""

    code = "newer-schema"


def refuse_newer(path: Path, document: Mapping[str, Any], remedy: str) -> None:
    """Refuse, with a DataError, a file of a later version or without a version."""
    schema = document.get("schema")
    if not isinstance(schema, int):
        raise DataError(path, f"states no schema number (schema: {schema!r})", remedy, code="damaged")
    if schema > SCHEMA:
        problem = f"has schema {schema}, this version reads up to {SCHEMA}"
        raise NewerSchemaError(path, problem, "update mocap to read it")


def _refuse_constant(name: str) -> None:
    raise ValueError(f"holds {name}, which is not JSON")


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it that are missing, so that they survive a loss of power."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for path in missing:
        sync(path.parent)


def sync_tree(folder: Path) -> None:
    """Sync a folder and everything in it to disk, so that it survives a loss of power."""
    for path in [*folder.rglob("*"), folder]:
        sync(path)


def sync(path: Path) -> None:
    """Sync a file, or a folder so that renames in it survive a loss of power."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove_tree(path: Path) -> None:
    """Remove a file, a link or a folder with its content; a missing path is no error."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


SIMULATION_MARK = "simulation.json"
"""The file that is in every folder of `mocap simulate`."""

STUDY_MARK = "study.json"
"""The file that is in every folder of `mocap study`."""

_LOCK = "lock"
# A killed process can be gone some moments before the kernel has released its lock.
MAX_WAIT_FOR_LOCK_S = 0.2
_OF_SESSIONS = {"session.json": "a session", "stage.json": "a stage of a session"}


@contextmanager
def held(lock: Path, target: Path | str) -> Iterator[None]:
    """Hold a lock of the kernel, which ends with the process; BusyError if another process has it."""
    holder = lock.with_name(f"{lock.name}.pid")
    drop_link(lock)
    try:
        acquired = FileLock(lock).acquire(timeout=MAX_WAIT_FOR_LOCK_S)
    except Timeout:
        raise BusyError(f"{target} is being written by {_process(holder)}; wait for it to finish") from None
    with acquired:
        try:
            _write_anew(holder, f"{os.getpid()}\n".encode())
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
        if not folder.is_symlink() and {path.name for path in folder.iterdir()} <= {lock, f"{lock}.pid"}:
            for left in (lock, f"{lock}.pid"):
                (folder / left).unlink(missing_ok=True)
            folder.rmdir()


@contextmanager
def working_folder(work: Path, target: Path) -> Iterator[Path]:
    """Make and lock the hidden folder in which a target is written; it is removed if it ends up empty."""
    drop_link(work)
    try:
        make_folder(work)
        with held(work / _LOCK, target):
            for path in work.iterdir():
                drop_link(path)
            yield work
    finally:
        remove_if_unused(work, _LOCK)


def finished_part(finished: Path, produce: Callable[[Path], None]) -> Path:
    """Return the folder of a finished part; call `produce` with an empty folder if it does not exist yet."""
    drop_link(finished)
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
    """A folder that is being made: what is written into `folder` becomes the target when published."""

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

    `key` is equal for equal results. A target without the file `mark` is replaced only with `overwrite`, else
    a DataError. BusyError if another process makes the same folder.
    """
    target = target.absolute()
    if not (overwrite or (target / mark).is_file()):
        refuse_others(target, lambda _: False, "something else")
    with on_disk(target), working_folder(_work_of(target), target) as work:
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


def refuse_sessions(target: Path, *, mark: str, option: str) -> None:
    """Refuse, with a DataError, to replace a session, a folder that holds one, or a part of one."""
    target = target.absolute()
    for folder, _, files in os.walk(target):
        for name in filter(files.__contains__, _OF_SESSIONS):
            what, within = _OF_SESSIONS[name], Path(folder).relative_to(target).as_posix()
            problem = f"is {what}" if within == "." else f"holds {what} in {within}"
            raise DataError(target, problem, f"name another folder with {option}")
    if not (target / mark).is_file():
        refuse_inside_session(target, option)


def refuse_others(
    target: Path,
    is_ours: Callable[[str], bool],
    held: str,
    *,
    option: str = "--output",
    way: str = "replace all of it",
) -> None:
    """Refuse, with a DataError, to replace a file, or a folder that has a name in it which is not ours."""
    if not target.exists():
        return
    if not target.is_dir():
        remedy = f"choose another place with {option}"
        raise DataError(target, "is a file, not a folder", remedy, code="not-a-folder")
    if others := sorted(path.name for path in target.iterdir() if not is_ours(path.name)):
        problem = f"holds {held} ({len(others)} entries, the first {others[0]})"
        remedy = f"choose another place with {option}, or {way} with --overwrite"
        raise DataError(target, problem, remedy, code="exists")


def refuse_inside_session(target: Path, option: str) -> None:
    """Refuse, with a DataError, to write into a session, where its own stages would lose or remove it."""
    target = target.absolute()
    for folder in (target, *target.parents):
        if (folder / "session.json").is_file():
            problem = "is a session" if folder == target else f"is a part of the session {folder.name}"
            raise DataError(target, problem, f"name another folder with {option}", code="wrong-kind")


def is_made(target: Path, key: str, *, mark: str) -> bool:
    """Return True if the target's mark file states this key; remove what a kill left of making it."""
    try:
        made = bool(read_json(target / mark).get("key") == key)
    except DataError:
        return False
    work = _work_of(target)
    with suppress(OSError, BusyError):
        if made and work.is_dir() and not work.is_symlink():
            with working_folder(work, target):
                for left in [path for path in work.iterdir() if path.is_dir()]:
                    remove_tree(left)
    return made


def _work_of(target: Path) -> Path:
    return target.parent / f".{target.name}.making"


def _put_back(work: Path, target: Path) -> None:
    """Put the old target back if a kill between two renames left no new one; else remove it."""
    old = work / "old"
    if old.exists() and not target.exists():
        old.rename(target)
    remove_tree(old)


AGAIN = "copy it again, or export it again"


def damaged(source: Path | str, problem: object) -> DataError:
    """Make the error of a file whose content contradicts itself; an exception of a library is quoted."""
    if isinstance(problem, OSError):
        return as_data_error(problem, Path(source))
    if not isinstance(problem, str):
        problem = f"is damaged ({' '.join(str(problem).split())[:100] or type(problem).__name__})"
    return DataError(source, problem, AGAIN, code="damaged")


def bad_value(source: Path | str, problem: str) -> DataError:
    """Make the error of a value that is not of the expected kind."""
    return DataError(source, problem, AGAIN, code="bad-value")


def empty(source: Path | str, problem: str) -> DataError:
    """Make the error of a file without content."""
    return DataError(source, problem, AGAIN, code="empty")
