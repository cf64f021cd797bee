"""Pictures of a camera by frame number, from a video file or from a topic of a log."""

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import TypeAlias

from pipelines.formats.logs.messages import all_samples
from pipelines.formats.logs.pictures import KNOWN, decode, is_known, later_pictures
from pipelines.formats.videos.picture_folder import FolderPictures
from pipelines.formats.videos.video import VideoReader
from pipelines.geometry.arrays import Picture
from pipelines.session.description import Description, MediaEntry
from pipelines.session.errors import DataError
from pipelines.session.recognition import recognise
from pipelines.session.records import PictureSample
from pipelines.session.registries import Log, LogFormat
from pipelines.session.stages import noted_stamps
from pipelines.session.storage import file_stamp, is_folder, sha256_of
from pipelines.session.urls import located

CameraPictures: TypeAlias = "VideoReader | FolderPictures | LoggedPictures"
"""Readers of pictures by number, which are context managers."""


@contextmanager
def open_pictures(session: Path, description: Description, camera: str) -> Iterator[CameraPictures]:
    """Open the pictures of a session; DataError: missing, unreadable, or other ones, also at the end."""
    media = _media(description, camera)
    refuse_changed_pictures(session, description, [camera])
    paths = [located(session, path) for path in media.paths]
    with open_files(paths, media.topic, media.stamps) as pictures:
        yield pictures
    refuse_changed_pictures(session, description, [camera])


def open_files(paths: list[Path], topic: str | None, stamps: str) -> CameraPictures:
    """Open a video, a folder of pictures, or the pictures in a topic of a log."""
    if topic is not None:
        return LoggedPictures(paths, topic, stamps)
    return FolderPictures(paths[0]) if is_folder(paths[0]) else VideoReader(paths[0])


def refuse_changed_pictures(session: Path, description: Description, cameras: Iterable[str]) -> None:
    """Refuse pictures with another content than was ingested, by size and time or hash; missing pass."""
    noted = noted_stamps(session, description.sources)
    for camera in cameras:
        media = _media(description, camera)
        for stated, source in zip(media.paths, media.sources, strict=True):
            path = located(session, stated).resolve()
            if not (path.exists() or is_folder(path)):
                continue
            stamp = file_stamp(path)
            if stamp != noted.get(source) and _content(path, stamp) != description.sources.get(source):
                problem = f"does not hold the pictures of {camera} that were ingested (other SHA-256)"
                remedy = "run `mocap ingest` again, or put back the file that was ingested"
                raise DataError(path, problem, remedy, code="changed")


@cache
def _content(path: Path, stamp: str) -> str:  # noqa: ARG001  # the stamp is part of the cache key
    """Compute the SHA-256 of a source; the result is cached for as long as its stamp stays."""
    return sha256_of(path)


def _media(description: Description, camera: str) -> MediaEntry:
    media = description.cameras[camera].media
    if media is None:
        raise ValueError(f"{camera} has no pictures")
    return media


class LoggedPictures(AbstractContextManager["LoggedPictures"]):
    """Pictures of a topic, numbered as in ingest; reading backward restarts. DataError: cannot be read."""

    def __init__(self, paths: list[Path], topic: str, stamps: str) -> None:
        self._source = paths[0]
        self._topic = topic
        self._stamps = stamps
        self._stack = ExitStack()
        log_format = recognise(paths[0], LogFormat, "log")
        self._log: Log = self._stack.enter_context(log_format.open_log(paths))
        self._next = 0
        self._samples = self._begin()
        with ExitStack() as unless_known:
            unless_known.callback(self._stack.close)
            self._refuse_unknown()
            unless_known.pop_all()

    def __exit__(self, *exception: object) -> None:
        self._stack.close()

    def read(self, number: int) -> Picture | None:
        """Read one picture, BGR; None if it cannot be decoded or the log ends before it."""
        if number < self._next:
            self._next, self._samples = 0, self._begin()
        for sample in self._samples:
            self._next += 1
            if self._next > number:
                return decode(sample)
        return None

    def _refuse_unknown(self) -> None:
        """Refuse a topic with an unknown encoding at once, because all its pictures share the encoding."""
        first = next(self._begin(), None)
        if first is not None and not is_known(first):
            problem = f"the pictures of {self._topic} are encoded as {first.encoding!r}, which is not known"
            remedy = f"convert them to one of {', '.join(KNOWN)}, or give the camera a video"
            raise DataError(self._source, problem, remedy, code="unsupported")

    def _begin(self) -> Iterator[PictureSample]:
        samples = all_samples(self._log.messages([self._topic]), self._source)
        pictures = (sample for sample in samples if isinstance(sample, PictureSample))
        return later_pictures(pictures, self._stamps)
