"""Logs that stay open between readings, so that their indices are read once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pipelines.formats.logs.recordings import OpenLog
from pipelines.session.registries import Log, LogFormat, recognise

_KEPT_MESSAGES = 4_000_000  # of all logs that stay open: their tables have 160 MB
_KEPT_FILES = 64


class OpenLogs:
    """Recordings by their files; those of our own formats stay open, within the bounds."""

    def __init__(self) -> None:
        self._kept: dict[tuple[Path, ...], OpenLog] = {}  # the most recently used one is last

    @contextmanager
    def reading(self, files: Sequence[Path]) -> Iterator[Log]:
        """Yield a recording for one reading.

        Raises:
            DataError: a file is missing, damaged beyond use, or no log.
        """
        paths = tuple(files)
        recording: Log | None = self._kept.pop(paths, None)
        if recording is None:
            recording = recognise(paths[0], LogFormat, "log").open_log(paths)
        if not isinstance(recording, OpenLog):
            with recording:
                yield recording
            return
        self._kept[paths] = recording
        self._close_all_beyond_bounds()
        recording.forget()  # losses counted while another topic was read
        yield recording

    def close(self) -> None:
        """Close all files."""
        for paths in list(self._kept):
            self._close(paths)

    def _close_all_beyond_bounds(self) -> None:
        while len(self._kept) > 1 and (
            sum(topic.count for log in self._kept.values() for topic in log.topics) > _KEPT_MESSAGES
            or sum(len(log.parts) for log in self._kept.values()) > _KEPT_FILES
        ):
            self._close(next(iter(self._kept)))

    def _close(self, paths: tuple[Path, ...]) -> None:
        with self._kept.pop(paths):
            pass
