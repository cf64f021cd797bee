"""Places in object stores: sources that are named by URL, and sessions that are read and published there.

A URL is anything that fsspec opens (`s3://bucket/flight/drone1.mp4`). Sources are fetched into the user's
cache. A session is worked on in a copy on this machine's disk and published whole:

    x.session/00000002.json         which version is the newest: its folder, and the SHA-256 of its files
    x.session/00000002-9f3a51c0/    the files of that version, under the names that they have in a session

All of a version's files are written before its `NUMBER.json`, which the store creates only if it is not there
yet. So of two writers one publishes, and the other is told; a kill leaves the version before. Credentials
come from where the store's own library looks for them, never from a URL, and no message repeats what a store
says.
"""

import errno
import json
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from filelock import FileLock

from pipelines.session.errors import BusyError, DataError, MocapError
from pipelines.session.registries import need
from pipelines.session.storage import (
    as_data_error,
    hash_of,
    read_json,
    remove_tree,
    sha256_of,
    sync,
    sync_tree,
    write_json,
)
from pipelines.session.whole_folders import held

_URL = re.compile(r"(?P<scheme>[a-z][a-z0-9+.-]+):/+(?P<rest>[^/].*)", re.DOTALL)
_SECRET = re.compile(r"[?&][^=&]*(sig|token|key|secret|credential|password)[^=&]*=", re.IGNORECASE)
_POINTER = re.compile(r"(\d{8})\.json")
_VERSION = re.compile(r"(\d{8})-[0-9a-f]{8}")
_REFUSED = {"PermissionError", "NoCredentialsError", "PartialCredentialsError", "TokenRetrievalError"}
_FULL = {errno.ENOSPC, errno.EDQUOT}
_SCHEMA = 1
_ATTEMPTS = 5  # at a version that another writer replaces while it is read
_SPARE_BYTES = 1 << 30  # of the disk, that sources leave free

T = TypeVar("T")

_staged: dict[Path, "Copy"] = {}  # by its folder: the sessions that this process works on


def url_of(place: Path | str) -> str | None:
    """Return the URL that a place is; None for a place on this machine.

    A URL that has become a Path has lost one of its two slashes. A path that exists is no URL.

    Raises:
        DataError: the URL holds a secret, which results and messages would repeat.
    """
    text = str(place)
    found = _URL.fullmatch(text)
    if found is None or os.path.lexists(text):
        return None
    scheme, rest = found["scheme"], found["rest"].rstrip("/")
    if "@" in rest.partition("/")[0] or _SECRET.search(rest):
        raise DataError(
            f"{scheme}://...",
            "is a URL with credentials in it",
            "leave them out of it, and set them where the store's own tools look for them",
            code="url-with-secret",
        )
    return f"{scheme}:///{rest}" if scheme == "file" else f"{scheme}://{rest}"


def located(base: Path, stated: str | Path) -> Path:
    """Return the path of a file or folder that is stated by a path relative to `base`, or by URL.

    What is stated by URL is fetched if it is not in the cache. If `base` itself was fetched, the path is
    relative to its URL.

    Raises:
        DataError: the store cannot be read, or holds no such thing.
    """
    url = source_url(base, stated)
    return base / stated if url is None else fetched(url)


def source_url(base: Path, stated: str | Path) -> str | None:
    """Return the URL of a source; None if it lies on this machine. See `located`."""
    url = url_of(stated)
    if url is not None or not str(stated) or Path(stated).is_absolute():
        return url
    if base.parent != _cache() / "sources":
        return None
    origin = read_json(base.with_suffix(".json"), "remove it")["url"]
    return f"{origin.rpartition('/')[0]}/{PurePosixPath(stated)}"


def named(base: Path, stated: str) -> Path | str:
    """Return a source's name for messages; nothing is fetched."""
    return source_url(base, stated) or base / stated


def is_there(base: Path, stated: str) -> bool:
    """Return True if a source exists; what is stated by URL is fetched."""
    try:
        return located(base, stated).exists()
    except DataError:
        return False


def as_urls(text: str) -> str:
    """Replace the paths of copies in a text by the URLs that they were made from."""
    if str(_cache()) not in text:
        return text

    def url(match: re.Match[str]) -> str:
        note = _cache() / match[1] / f"{match[2]}.json"
        return str((_noted(note) or {}).get("url", match[0]))

    return re.sub(re.escape(str(_cache())) + r"/(sources|sessions)/([0-9a-f]{16})(?:/[^/\s:;,]+)?", url, text)


def media_path(base: Path, stated: str, session: Path) -> str:
    """Write where a source lies, for a session: its URL, or its path relative to the session's folder.

    A session that is published in a store holds the whole path instead.

    Args:
        stated: empty for `base` itself.
    """
    url = source_url(base, stated or ".")
    if url is not None:
        return url
    if is_copy(session.absolute()):
        return (base / stated).absolute().as_posix()
    return Path(os.path.relpath(base / stated, session)).as_posix()


def is_copy(session: Path) -> bool:
    """Return True for the copy of a session that lies in a store."""
    return session.parent.parent == _cache() / "sessions"


def published_version(session: Path) -> str | None:
    """Return the URL of the version that a copy was made of or published as last; None for other sessions."""
    root = session.absolute().parent
    if not is_copy(session.absolute()):
        return None
    url = (_noted(root.with_suffix(".json")) or {}).get("url")
    folder = (_noted(root / "base.json") or {}).get("folder")
    return f"{url}/{folder}" if url and folder else None


def publish_meanwhile(session: Path) -> None:
    """Publish what is finished of a session, so that other machines can read it, if this process staged it.

    Raises:
        BusyError: another writer published a version since the copy was made.
        DataError: the store cannot be written.
    """
    copy = _staged.get(session.absolute())
    if copy is not None:
        with _own_disk(copy.folder):
            copy.publish()


def fetched(url: str, *, fresh: bool = False) -> Path:
    """Return the copy of a file or folder of a store; fetch it if it is missing.

    Args:
        fresh: ask the store, and fetch what has changed there since.

    Raises:
        DataError: the store cannot be read, holds no such thing, or it does not fit on the disk.
    """
    folder = _cache() / "sources" / _short(url)
    target, note = folder / url.rpartition("/")[2], folder.with_suffix(".json")
    with _own_disk(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(folder.with_suffix(".lock")):  # others wait, and find it there
            known = _noted(note) if target.exists() else None
            if known is not None and not fresh:
                os.utime(note)  # what was used last is removed last
                return target
            store, path = _opened(url)
            files, version = _told(url, lambda: _files_at(store, path))
            if known is not None and known.get("version") == version:
                return target
            _make_room(folder, sum(size for _, size in files.values()), url)
            new = folder.with_suffix(".new")
            remove_tree(new)
            note.unlink(missing_ok=True)
            places = {inner: new / target.name / name for name, (inner, _) in files.items()}
            for place in places.values():
                place.parent.mkdir(parents=True, exist_ok=True)
            _told(url, lambda: store.get(list(places), list(map(str, places.values()))))
            sync_tree(new)
            remove_tree(folder)
            new.rename(folder)
            write_json(note, {"url": url, "version": version})
    return target


def _noted(note: Path) -> dict[str, Any] | None:
    try:
        return read_json(note)
    except DataError:
        return None


def _files_at(store: Any, path: str) -> tuple[dict[str, tuple[str, int]], str]:
    """List a file, or the files of a folder: relative name to (path in the store, size); with a version."""
    info = store.info(path)
    found = {path: info} if info["type"] != "directory" else store.find(path, detail=True)
    if not found:
        raise FileNotFoundError(path)
    marks = ("size", "ETag", "etag", "md5Hash", "generation", "mtime", "LastModified", "updated")
    stamps = {
        name: [str(own[mark]) for mark in marks if own.get(mark) is not None] for name, own in found.items()
    }
    names = {name: name[len(path) :].lstrip("/") for name in found}
    for name in names.values():
        if ".." in PurePosixPath(name).parts:
            raise FileNotFoundError(path)
    return {names[name]: (name, int(own["size"] or 0)) for name, own in found.items()}, hash_of(stamps)


def _make_room(folder: Path, size: int, url: str) -> None:
    """Remove the sources that were not used for longest, until one of this size fits on the disk."""
    notes = sorted(folder.parent.glob("*.json"), key=lambda note: note.stat().st_mtime_ns)
    while shutil.disk_usage(folder.parent).free < size + _SPARE_BYTES:
        if not notes:
            free = shutil.disk_usage(folder.parent).free
            raise DataError(
                url,
                f"has {size / 1e9:.3g} GB, and the disk of {folder.parent} has {free / 1e9:.3g} GB free",
                "free some space, or set XDG_CACHE_HOME to another disk",
                code="too-large",
            )
        oldest = notes.pop(0)
        remove_tree(oldest)
        remove_tree(oldest.with_suffix(""))


# --- sessions ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Version:
    """Published version of a session; number 0 is none."""

    number: int = 0
    folder: str = ""  # beside NUMBER.json
    files: Mapping[str, str] | None = None  # SHA-256 by name


class Copy:
    """Copy of a session of a store, on this machine's disk.

    Attributes:
        url: of the session in the store.
        folder: the copy, a session like any other.
    """

    def __init__(self, url: str, root: Path) -> None:
        self.url = url
        self.folder = root / url.rpartition("/")[2]
        self._root = root
        self._store, self._path = _opened(url)
        self._base = _Version()

    def begin(self, *, create: bool) -> None:
        """Bring the copy to the version of the store.

        What an interrupted run made here, from that same version, is kept.

        Raises:
            DataError: the store cannot be read or, without `create`, holds no session there.
        """
        for _ in range(_ATTEMPTS):
            self._base = _told(self.url, self._newest)
            if not self._base.number and not create:
                raise DataError(
                    self.url,
                    "is not a session",
                    "make one with `mocap ingest -o` and this URL",
                    code="not-a-session",
                )
            noted = _noted(self._root / "base.json") or {}
            if noted.get("folder", "") == self._base.folder and (self.folder.exists() or create):
                return
            try:
                self._fetch()
            except FileNotFoundError:  # another writer has just replaced this version
                continue
            write_json(self._root / "base.json", {"folder": self._base.folder})
            return
        raise BusyError(f"{self.url} is being replaced by other writers; run the command again")

    @property
    def version(self) -> str:
        """URL of the files of the version that the copy was made of or published as."""
        return f"{self.url}/{self._base.folder}"

    def publish(self) -> bool:
        """Publish the copy as the next version if it has changed; return True if it had.

        Raises:
            BusyError: another writer published a version since the copy was made.
            DataError: the store cannot be written. The copy stays, and the same command continues.
        """
        files = self._own_files()
        if "session.json" not in files or files == self._base.files:
            return False
        before = self._base
        number = before.number + 1
        folder = f"{number:08d}-{secrets.token_hex(4)}"
        kept = [name for name, digest in files.items() if (before.files or {}).get(name) == digest]
        added = [name for name in files if name not in kept]
        document = {"schema": _SCHEMA, "folder": folder, "files": files}
        text = (json.dumps(document, indent=2) + "\n").encode()

        def upload() -> None:
            inner = f"{self._path}/{folder}"
            if kept:  # inside the store
                old = f"{self._path}/{before.folder}"
                self._store.copy([f"{old}/{n}" for n in kept], [f"{inner}/{n}" for n in kept])
            self._store.put([str(self.folder / n) for n in added], [f"{inner}/{n}" for n in added])

        try:
            _told(self.url, upload, missing=FileNotFoundError)
        except FileNotFoundError:
            raise self._overtaken() from None
        self._point(number, text)
        self._base = _Version(number, folder, files)
        write_json(self._root / "base.json", {"folder": folder})
        self._remove_older()
        return True

    def remove(self) -> None:
        """Remove the copy."""
        remove_tree(self._root / "base.json")
        sync(self._root)  # else a loss of power might leave the note beside a part of the copy
        remove_tree(self.folder)

    def _own_files(self) -> dict[str, str]:
        """Compute the SHA-256 of every file that belongs to the session, by name."""
        tops = (
            top
            for top in (self.folder.iterdir() if self.folder.is_dir() else ())
            if not top.name.startswith(".") and not top.name.endswith(".new")
        )
        paths = (path for top in tops for path in ([top] if top.is_file() else top.rglob("*")))
        found = {path.relative_to(self.folder).as_posix(): path for path in paths if path.is_file()}
        return {name: sha256_of(found[name]) for name in sorted(found)}

    def _numbered(self, pattern: re.Pattern[str]) -> dict[str, int]:
        """List what lies at the session's URL with names of this pattern, with their numbers."""
        try:
            names = [PurePosixPath(name).name for name in self._store.ls(self._path, detail=False)]
        except FileNotFoundError:
            return {}
        matches = [match for name in names if (match := pattern.fullmatch(name))]
        return {match[0]: int(match[1]) for match in matches}

    def _newest(self) -> _Version:
        for _ in range(_ATTEMPTS):
            pointers = self._numbered(_POINTER)
            if not pointers:
                return _Version()
            name = max(pointers, key=lambda name: pointers[name])
            try:
                document = json.loads(self._store.cat_file(f"{self._path}/{name}"))
                if document["schema"] > _SCHEMA:
                    raise DataError(
                        f"{self.url}/{name}",
                        "is of a newer version",
                        "use a newer mocap",
                        code="newer-schema",
                    )
                inside = all(".." not in PurePosixPath(file).parts for file in document["files"])
                if not inside or not _VERSION.fullmatch(document["folder"]):
                    raise ValueError(name)
                return _Version(pointers[name], document["folder"], dict(document["files"]))
            except FileNotFoundError:  # removed by a writer since it was listed
                continue
            except (ValueError, KeyError, TypeError) as error:
                raise DataError(
                    f"{self.url}/{name}", "is damaged", "put back what mocap wrote", code="damaged"
                ) from error
        raise BusyError(f"{self.url} is being replaced by other writers; run the command again")

    def _fetch(self) -> None:
        """Replace the copy by the version of the store; finished parts of an interrupted stage stay."""
        new = self._root / "fetched"
        remove_tree(new)
        new.mkdir(parents=True)
        files = self._base.files or {}
        for name in files:
            (new / name).parent.mkdir(parents=True, exist_ok=True)
        theirs = [f"{self._path}/{self._base.folder}/{name}" for name in files]
        ours = [str(new / name) for name in files]
        if files:
            _told(self.url, lambda: self._store.get(theirs, ours), missing=FileNotFoundError)
        for name, digest in files.items():
            if sha256_of(new / name) != digest:
                raise DataError(
                    f"{self.url}/{self._base.folder}/{name}",
                    "is not what mocap wrote (other SHA-256)",
                    "put back what it wrote, or ingest again with another URL",
                    code="changed",
                )
        sync_tree(new)
        with suppress(OSError):
            (self.folder / ".partial").rename(new / ".partial")
        remove_tree(self.folder)
        if files:
            new.rename(self.folder)
        sync(self._root)

    def _point(self, number: int, text: bytes) -> None:
        """Create NUMBER.json, which makes a version the newest; BusyError if another writer has made one."""
        path = f"{self._path}/{number:08d}.json"

        def create() -> bool:
            try:
                self._store.pipe_file(path, text, mode="create")
            except Exception as error:
                # A store whose answer was lost is asked again by its library, and refuses its own success.
                if not _is_there_already(error):
                    raise
                with suppress(FileNotFoundError):
                    return bool(self._store.cat_file(path) == text)
                return False
            # The number may have been free because a later version exists and removed the earlier ones.
            return max(self._numbered(_POINTER).values(), default=0) == number

        if not _told(self.url, create):
            raise self._overtaken()

    def _overtaken(self) -> BusyError:
        return BusyError(
            f"{self.url} was published by another writer meanwhile, and stays as that made it;"
            " run the command again, which begins from there"
        )

    def _remove_older(self) -> None:
        """Remove earlier versions, and what killed writers left; later writers remove what stays."""
        with suppress(Exception):  # the version is published, whatever happens here
            own = self._base
            old = [name for name, number in self._numbered(_POINTER).items() if number < own.number]
            old += [n for n, k in self._numbered(_VERSION).items() if k <= own.number and n != own.folder]
            for name in old:
                self._store.rm(f"{self._path}/{name}", recursive=True)


@contextmanager
def staged(url: str, *, create: bool = False) -> Iterator[Copy]:
    """Work on a copy of a session of a store; at the end it is published and the copy is removed.

    After an error nothing more is published, and the copy stays for the same command to continue.

    Args:
        create: allow a URL at which there is no session yet (ingest).

    Raises:
        DataError: the store cannot be used, or holds no session there.
        BusyError: another process of this machine works on it, or another writer published meanwhile.
    """
    root = _cache() / "sessions" / _short(url)
    with ExitStack() as stack:
        with _own_disk(root):
            root.mkdir(parents=True, exist_ok=True)
            stack.enter_context(held(root / "lock", url))
            write_json(root.with_suffix(".json"), {"url": url})
            copy = Copy(url, root)
            copy.begin(create=create)
        _staged[copy.folder] = copy
        stack.callback(_staged.pop, copy.folder)
        yield copy
        with _own_disk(root):
            copy.publish()
            copy.remove()


@contextmanager
def _own_disk(place: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise as_data_error(error, place) from error


def holds_session(url: str) -> bool:
    """Return True if a session was published at a URL.

    Raises:
        DataError: the store cannot be read.
    """
    copy = Copy(url, _cache())
    return bool(_told(url, lambda: copy._numbered(_POINTER)))


def put(url: str, content: bytes) -> None:
    """Write one object; DataError if the store does not take it."""
    store, path = _opened(url)
    _told(url, lambda: store.pipe_file(path, content))


def get(url: str) -> bytes | None:
    """Read one object; None if there is none. DataError if the store cannot be read."""
    store, path = _opened(url)
    try:
        content: bytes = _told(url, lambda: store.cat_file(path), missing=FileNotFoundError)
    except FileNotFoundError:
        return None
    return content


def matching(pattern: str) -> list[str]:
    """List the URLs that a pattern matches, sorted; DataError if the store cannot be read."""
    store, path = _opened(pattern)
    found: list[str] = _told(pattern, lambda: store.glob(path))
    return sorted(store.unstrip_protocol(name) for name in found)


# --- stores --------------------------------------------------------------------------------------------


def _cache() -> Path:
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(cache).expanduser().absolute() / "mocap" / "stores"


def _short(url: str) -> str:
    return hash_of(url)[:16]


def _opened(url: str) -> tuple[Any, str]:
    """Open the store of a URL; return it and the path inside it."""
    url_to_fs = need("fsspec.core", "s3").url_to_fs
    scheme = url.partition(":")[0]
    options = {"auto_mkdir": True} if scheme == "file" else {}
    try:
        store, path = url_to_fs(url, use_listings_cache=False, **options)
    except ImportError as error:
        raise DataError(
            url, f"needs a library for {scheme}://", "install s3fs, gcsfs or adlfs", code="missing-library"
        ) from error
    except ValueError as error:
        raise DataError(
            url,
            f"{scheme}:// is nothing that fsspec reads",
            "give a path, or s3:// or gs://",
            code="missing-library",
        ) from error
    return store, path


def _told(url: str, call: Callable[[], T], missing: type[Exception] | None = None) -> T:
    """Call a function that uses a store, and turn its errors into one line that repeats none of their words.

    Args:
        missing: raised for an object that does not exist, instead of a DataError.
    """
    try:
        return call()
    except MocapError:
        raise
    except Exception as error:
        names = {type(each).__name__ for each in _chain(error)}
        if isinstance(error, OSError) and error.errno in _FULL:
            raise
        if isinstance(error, FileNotFoundError | NotADirectoryError):
            if missing is not None:
                raise missing(url) from None
            raise DataError(url, "does not exist", "check the URL", code="no-such-file") from None
        if names & _REFUSED:
            raise DataError(
                url,
                "the store refuses these credentials, or there are none",
                "set them where the store's own tools look for them (of S3: AWS_PROFILE, ~/.aws)",
                code="store-refused",
            ) from None
        raise DataError(
            url,
            f"the store does not answer as it should ({type(error).__name__})",
            "check the network and the store's address, and run the command again, which continues",
            code="store-unreachable",
        ) from None


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _is_there_already(error: Exception) -> bool:
    """Return True for the answers of stores to the creation of an object that exists."""
    texts = ("PreconditionFailed", "ConditionalRequestConflict", "412", "409")
    chain = list(_chain(error))
    return any(isinstance(e, FileExistsError) or any(t in str(e) for t in texts) for e in chain)
