"""Pictures of a camera by frame number, from a video file or from a topic of a log."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import NamedTuple, Protocol, Self, TypeVar

import numpy as np

from pipelines.formats.flights.picture_encodings import KNOWN, decode, is_known
from pipelines.formats.logs.messages import all_samples
from pipelines.formats.logs.picture_layouts import HEAD_LENGTH, picture_decoder, read_stamps
from pipelines.formats.logs.recordings import OpenLog, messages_alike
from pipelines.formats.videos.video import VideoReader
from pipelines.geometry.arrays import Picture
from pipelines.session.description import Description, MediaEntry
from pipelines.session.errors import DataError
from pipelines.session.records import Int64, PictureSample, Sample
from pipelines.session.registries import Log, LogFormat, recognise
from pipelines.session.stage_records import noted_stamps
from pipelines.session.storage import file_stamp, sha256_of

_MAY_LEAP_NS = 1_000_000_000  # transport and decoding take less time


class Pictures(Protocol):
    """Reader of pictures; a context manager."""

    def read(self, number: int) -> Picture | None:
        """Read one picture, BGR; None if it cannot be decoded."""

    def __enter__(self) -> Self:
        """Return the reader itself."""

    def __exit__(self, *exception: object) -> None:
        """Close the files."""


class Stamped(Protocol):
    """Stamps of a picture, without its pixels."""

    @property
    def stamp_ns(self) -> int:
        """Stamp of its header; 0 without one."""

    @property
    def receive_ns(self) -> int:
        """Stamp of its receipt."""


class _Stamps(NamedTuple):
    stamp_ns: int
    receive_ns: int


_Stamped = TypeVar("_Stamped", bound=Stamped)


@contextmanager
def open_pictures(session: Path, description: Description, camera: str) -> Iterator[Pictures]:
    """Open the pictures that a session was made from; check before and after that they did not change.

    Args:
        session: its folder.
        description: its session.json.
        camera: name of a camera that has pictures.

    Raises:
        DataError: they are missing, differ from those that were ingested, or cannot be read.
    """
    media = _media(description, camera)
    refuse_changed_pictures(session, description, [camera])
    paths = [session / path for path in media.paths]
    opened: Pictures = (
        VideoReader(paths[0]) if media.topic is None else LoggedPictures(paths, media.topic, media.stamps)
    )
    with opened as pictures:
        yield pictures
    refuse_changed_pictures(session, description, [camera])


def refuse_changed_pictures(session: Path, description: Description, cameras: Iterable[str]) -> None:
    """Refuse pictures that differ from those that were ingested.

    A file with the size and the time of change that ingest noted is taken to be the same. The content of any
    other file is hashed, so copies pass. Missing files pass too; opening them fails later.

    Args:
        session: its folder.
        description: its session.json.
        cameras: names of cameras that have pictures.

    Raises:
        DataError: a file has other content than the one that was ingested.
    """
    noted = noted_stamps(session, description.sources)
    for camera in cameras:
        media = _media(description, camera)
        for stated, source in zip(media.paths, media.sources, strict=True):
            path = (session / stated).resolve()
            if not path.exists():
                continue
            stamp = file_stamp(path)
            if stamp != noted.get(source) and _content(path, stamp) != description.sources.get(source):
                raise DataError(
                    path,
                    f"does not hold the pictures of {camera} that were ingested (other SHA-256)",
                    "run `mocap ingest` again, or put back the file that was ingested",
                )


@cache
def _content(path: Path, stamp: str) -> str:  # noqa: ARG001  # the stamp is part of the cache key
    """Compute the SHA-256 of a source; the result is cached for as long as its stamp stays."""
    return sha256_of(path)


def _media(description: Description, camera: str) -> MediaEntry:
    media = description.cameras[camera].media
    if media is None:
        raise ValueError(f"{camera} has no pictures")
    return media


class LoggedPictures:
    """Pictures of a topic, numbered as in ingest; reading forward is cheap, reading backward restarts.

    Args:
        paths: the files of the recording.
        topic: the topic.
        stamps: which stamps order the pictures: header or receive.

    Raises:
        DataError: the log cannot be opened, or the encoding of its pictures is unknown.
    """

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

    def __enter__(self) -> Self:
        """Return the pictures themselves."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the files."""
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
            raise DataError(
                self._source,
                f"the pictures of {self._topic} are encoded as {first.encoding!r}, which is not known",
                f"convert them to one of {', '.join(KNOWN)}, or give the camera a video",
            )

    def _begin(self) -> Iterator[PictureSample]:
        samples = picture_samples(self._log, self._topic, self._source)
        pictures = (sample for sample in samples if isinstance(sample, PictureSample))
        return later_pictures(pictures, self._stamps)


def picture_samples(recording: Log, topic: str, source: Path | str) -> Iterator[Sample]:
    """Yield the samples of a topic of pictures, in the order of receipt; see `all_samples`.

    Args:
        recording: an open log.
        topic: its name.
        source: the log, for messages to the user.
    """
    if isinstance(recording, OpenLog):
        return all_samples(recording.messages([topic], picture_decoder), source)
    return all_samples(recording.messages([topic]), source)


def picture_stamps(recording: Log, topic: str, source: Path | str) -> tuple[Int64, Int64]:
    """Return header stamps [N] (0 without one) and stamps of receipt [N] of a topic's pictures.

    The order is that of receipt.

    The pictures are the same as those of `picture_samples`. If their messages have one layout, only the
    beginning of each is read.

    Raises:
        DataError: the topic holds something else.
    """
    if (at_once := _stamps_at_once(recording, topic)) is not None:
        return at_once
    header_ns, receive_ns = array("q"), array("q")
    for sample in picture_samples(recording, topic, source):
        if not isinstance(sample, PictureSample):
            raise DataError(source, f"{topic} holds no pictures", "name another topic")
        header_ns.append(sample.stamp_ns)
        receive_ns.append(sample.receive_ns)
    return np.array(header_ns, np.int64), np.array(receive_ns, np.int64)


def _stamps_at_once(recording: Log, topic: str) -> tuple[Int64, Int64] | None:
    alike = messages_alike(recording, topic)
    if alike is None:
        return None
    return read_stamps(alike.schema, alike.log.heads(alike.topic, HEAD_LENGTH))


def later_pictures(pictures: Iterator[_Stamped], stamps: str) -> Iterator[_Stamped]:
    """Yield the pictures whose stamp is above all before: frame k of a topic is the k-th of these."""
    newest: _Stamped | None = None
    leapt: _Stamped | None = None
    for picture in pictures:
        if newest is not None:
            if stamp_of(picture, stamps) <= stamp_of(newest, stamps):
                continue
            # One damaged stamp far ahead must not cost all the pictures after it. If the clock was really set
            # forward, the next picture shows the same jump.
            if _leap_ns(newest, picture) > _MAY_LEAP_NS and (
                leapt is None or abs(_leap_ns(leapt, picture)) > _MAY_LEAP_NS
            ):
                leapt = picture
                continue
        newest, leapt = picture, None
        yield picture


def later_times(header_ns: Int64, receive_ns: Int64, stamps: str) -> Int64:
    """Return the stamps of the `later_pictures`, [n], strictly increasing.

    Args:
        header_ns: [N] stamps of the headers of all pictures, in the order of receipt; 0 without one.
        receive_ns: [N] of receipt.
        stamps: which of them order the pictures: header or receive.
    """
    times = np.where((header_ns != 0) & (stamps == "header"), header_ns, receive_ns)
    leaps = np.where((header_ns[1:] != 0) & (header_ns[:-1] != 0), np.diff(header_ns - receive_ns), 0)
    if (np.diff(times) > 0).all() and (leaps <= _MAY_LEAP_NS).all():
        return times  # the usual case
    pictures = map(_Stamps, header_ns.tolist(), receive_ns.tolist())
    return np.array([stamp_of(picture, stamps) for picture in later_pictures(pictures, stamps)], np.int64)


def _leap_ns(before: Stamped, after: Stamped) -> int:
    """Return by how much the header clock advanced more than the receipt clock between two pictures, ns."""
    if not before.stamp_ns or not after.stamp_ns:
        return 0
    return (after.stamp_ns - before.stamp_ns) - (after.receive_ns - before.receive_ns)


def stamp_of(picture: Stamped, stamps: str) -> int:
    """Return the header stamp if it exists and is wanted, else the stamp of receipt."""
    return picture.stamp_ns if stamps == "header" and picture.stamp_ns else picture.receive_ns
