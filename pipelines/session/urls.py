"""Places that are named by URL: sources are fetched into the user's cache, sessions are uploaded when done.

A session at a URL of fsspec is worked on in a copy on this machine, which is uploaded once, at the end.
Credentials come from where the store's own library looks for them, never from a URL, and no message repeats
what a store says.
"""

import errno
import ipaddress
import os
import re
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from filelock import FileLock

from pipelines.session.errors import DataError, MocapError
from pipelines.session.registries import need
from pipelines.session.stages import first_place_of, origin_of
from pipelines.session.storage import (
    hash_of,
    held,
    is_folder,
    on_disk,
    read_json,
    remove_tree,
    sha256_of,
    sync_tree,
    url_of,
    write_json,
)

# A disk that is filled to the last byte stops every other program of the user.
MIN_FREE_BYTES_BESIDE_SOURCES = 1 << 30

_REFUSED = {"PermissionError", "NoCredentialsError", "PartialCredentialsError", "TokenRetrievalError"}
_FULL = {errno.ENOSPC, errno.EDQUOT}

T = TypeVar("T")


def located(base: Path, stated: str | Path) -> Path:
    """Return the path of a file or folder stated by a path relative to `base`, or by URL, which is fetched.

    If `base` itself was fetched, the path is relative to its URL; if it is a session that was copied without
    its sources, to where it was ingested. DataError if the store cannot be read.
    """
    url = source_url(base, stated)
    if url is not None:
        return fetched(url)
    origin = origin_of(base)
    path = origin / stated
    left = first_place_of(origin) / stated
    return left if not (path.exists() or is_folder(path)) and (left.exists() or is_folder(left)) else path


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
        path = located(base, stated)
        return path.exists() or is_folder(path)
    except DataError:
        return False


def as_urls(text: str) -> str:
    """Replace the paths of copies in a text by the URLs that they were made from."""
    cache = str(_cache())
    if cache not in text:
        return text

    def url(match: re.Match[str]) -> str:
        return str(_noted(_cache() / match[1] / f"{match[2]}.json").get("url", match[0]))

    return re.sub(re.escape(cache) + r"/(sources|sessions)/([0-9a-f]{16})(?:/[^/\s:;,]+)?", url, text)


def media_path(base: Path, stated: str, session: Path) -> str:
    """Write where a source lies: its URL, or its path from the session's folder (whole for a URL's)."""
    url = source_url(base, stated or ".")
    if url is not None:
        return url
    if session.absolute().parent.parent == _cache() / "sessions":
        return (base / stated).absolute().as_posix()
    return Path(os.path.relpath(base / stated, session)).as_posix()


def fetched(url: str, *, fresh: bool = False) -> Path:
    """Return the copy of a file or folder of a store, fetched if missing or, if `fresh`, changed."""
    folder = _cache() / "sources" / _short(url)
    target, note = folder / url.rpartition("/")[2], folder.with_suffix(".json")
    with on_disk(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(folder.with_suffix(".lock")):  # others wait, and find it there
            known = _noted(note) if target.exists() else {}
            if known and not fresh:
                return target
            files, version = _asked(url, _files_at)
            if known.get("version") != version:
                _fetch(url, files, target)
                write_json(note, {"url": url, "version": version})
    return target


def _fetch(url: str, files: dict[str, tuple[str, int]], target: Path) -> None:
    """Replace a copy by the files of a store; `files` as of `_files_at`."""
    folder = target.parent
    _refuse_full_disk(folder, sum(size for _, size in files.values()), url)
    new = folder.with_suffix(".new")
    remove_tree(new)
    folder.with_suffix(".json").unlink(missing_ok=True)
    places = {inner: new / target.name / name for name, (inner, _) in files.items()}
    for place in places.values():
        place.parent.mkdir(parents=True, exist_ok=True)
    _asked(url, lambda store, _: store.get(list(places), list(map(str, places.values()))))
    sync_tree(new)
    remove_tree(folder)
    new.rename(folder)


def _noted(note: Path) -> dict[str, Any]:
    try:
        return read_json(note)
    except DataError:
        return {}


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
    if any(".." in PurePosixPath(name).parts for name in names.values()):
        raise FileNotFoundError(path)
    return {names[name]: (name, int(own["size"] or 0)) for name, own in found.items()}, hash_of(stamps)


def _refuse_full_disk(folder: Path, size: int, url: str) -> None:
    free = shutil.disk_usage(folder.parent).free
    if free < size + MIN_FREE_BYTES_BESIDE_SOURCES:
        problem = f"has {size / 1e9:.3g} GB, and the disk of {_cache()} has {free / 1e9:.3g} GB free"
        remedy = "free some space (what was fetched lies there), or set XDG_CACHE_HOME to another disk"
        raise DataError(url, problem, remedy, code="disk-full")


@contextmanager
def session_here(place: Path | str, *, create: bool = False) -> Iterator[Path]:
    """Yield the folder of a session; one at a URL is copied here, and uploaded whole if it changed.

    After an error nothing is uploaded; what was made stays in the copy, and the same command continues.
    `create` allows a URL without a session. BusyError if another process of this machine works on it.
    """
    url = url_of(place)
    if url is None:
        yield Path(place)
        return
    folder = _cache() / "sessions" / _short(url) / url.rpartition("/")[2]
    note = folder.parent.with_suffix(".json")
    with on_disk(folder):
        note.parent.mkdir(parents=True, exist_ok=True)
    with held(folder.parent.with_suffix(".lock"), url):
        with on_disk(folder):
            before = None  # what an earlier command left has to be uploaded
            if not folder.exists():
                files = _session_at(url)
                if files:
                    _fetch(url, files, folder)
                elif create:
                    folder.parent.mkdir(exist_ok=True)
                else:
                    remedy = "make one with `mocap ingest -o` and this URL"
                    raise DataError(url, "is not a session", remedy, code="not-a-session")
                before = _digests(folder)
            write_json(note, {"url": url})
        yield folder
        with on_disk(folder):
            digests = _digests(folder)
            if "session.json" in digests and digests != before:
                _asked(url, lambda store, path: _replace(store, path, folder, list(digests)))
            remove_tree(note)
            remove_tree(folder.parent)


def holds_session(url: str) -> bool:
    """Return True if a session lies at a URL; DataError if the store cannot be read."""
    return bool(_session_at(url))


def _session_at(url: str) -> dict[str, tuple[str, int]]:
    try:
        files, _ = _asked(url, _files_at, missing=FileNotFoundError)
    except FileNotFoundError:
        return {}
    return files if "session.json" in files else {}


def _digests(folder: Path) -> dict[str, str]:
    tops = [top for top in folder.glob("[!.]*") if not top.name.endswith(".new")]
    paths = [path for top in tops for path in ([top] if top.is_file() else top.rglob("*")) if path.is_file()]
    return {path.relative_to(folder).as_posix(): sha256_of(path) for path in sorted(paths)}


def _replace(store: Any, path: str, folder: Path, names: list[str]) -> None:
    if store.exists(path):
        store.rm(path, recursive=True)
    store.put([str(folder / name) for name in names], [f"{path}/{name}" for name in names])


def put(url: str, content: bytes) -> None:
    """Write one object; DataError if the store does not take it."""
    _asked(url, lambda store, path: store.pipe_file(path, content))


def get(url: str) -> bytes | None:
    """Read one object; None if there is none. DataError if the store cannot be read."""
    try:
        content: bytes = _asked(url, lambda store, path: store.cat_file(path), missing=FileNotFoundError)
    except FileNotFoundError:
        return None
    return content


def matching(pattern: str) -> list[str]:
    """List the URLs that a pattern matches, sorted; DataError if the store cannot be read."""
    return _asked(pattern, lambda store, path: sorted(map(store.unstrip_protocol, store.glob(path))))


def _cache() -> Path:
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(cache).expanduser().absolute() / "mocap" / "stores"


def _short(url: str) -> str:
    return hash_of(url)[:16]


def _opened(url: str) -> tuple[Any, str]:
    url_to_fs = need("fsspec.core", "s3").url_to_fs
    scheme = url.partition(":")[0]
    options: dict[str, Any] = {"use_listings_cache": False}
    if scheme == "file":
        options["auto_mkdir"] = True
    if scheme.startswith("http"):
        options["get_client"] = _public_client
    try:
        store, path = url_to_fs(url, **options)
    except ImportError as error:
        problem, remedy = f"needs a library for {scheme}://", "install s3fs, gcsfs, adlfs or aiohttp"
        raise DataError(url, problem, remedy, code="missing-library") from error
    except ValueError as error:
        problem = "is no URL that fsspec opens"
        raise DataError(url, problem, "check the URL", code="url-refused") from error
    return store, path


def is_public(address: str) -> bool:
    """Return True for an address that belongs to the Internet, not to this machine or a private network."""
    ip = ipaddress.ip_address(address)
    return ip.is_global and not ip.is_multicast


class _PrivateAddressError(OSError):
    """A web server that a flight.yaml names is not on the public Internet."""


async def _public_client(**options: Any) -> Any:
    """Make a web client that connects to public addresses alone, also after a redirection."""
    import aiohttp  # s3fs brings it

    def connect(address: tuple[Any, ...]) -> socket.socket:
        family, kind, protocol, _, place = address
        if not is_public(place[0].partition("%")[0]):
            raise _PrivateAddressError
        return socket.socket(family, kind, protocol)

    return aiohttp.ClientSession(connector=aiohttp.TCPConnector(socket_factory=connect), **options)


def _asked(url: str, call: Callable[[Any, str], T], *, missing: type[Exception] | None = None) -> T:
    """Call a function with the store and the path of a URL; an error becomes one line of ours."""
    store, path = _opened(url)
    try:
        return call(store, path)
    except MocapError:
        raise
    except Exception as error:
        chain = list(_chain(error))
        names = {type(each).__name__ for each in chain}
        if any(isinstance(each, _PrivateAddressError) for each in chain):
            problem = "leads to an address of this machine or of a private network"
            remedy = "fetch the file yourself, and give its path"
            raise DataError(url, problem, remedy, code="url-refused") from None
        if isinstance(error, OSError) and error.errno in _FULL:
            raise
        lacks = isinstance(error, FileNotFoundError | NotADirectoryError)
        if lacks and url.startswith("http") and names - {"FileNotFoundError", "ClientResponseError"}:
            problem = f"cannot be asked for ({type(chain[-1]).__name__})"
            raise DataError(url, problem, "check the URL and the network", code="store-unreachable") from None
        if lacks:
            if missing is not None:
                raise missing(url) from None
            raise DataError(url, "does not exist", "check the URL", code="no-such-file") from None
        if names & _REFUSED:
            problem = "the store refuses these credentials, or there are none"
            remedy = "set them where the store's own tools look for them (of S3: AWS_PROFILE, ~/.aws)"
            raise DataError(url, problem, remedy, code="store-refused") from None
        problem = f"the store does not answer as it should ({type(error).__name__})"
        remedy = "check the network and the store's address, and run the command again, which continues"
        raise DataError(url, problem, remedy, code="store-unreachable") from None


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__
