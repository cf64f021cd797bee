"""Reading of a file in all ways that commands use, by every reader that takes it."""

import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from pipelines.formats.videos.frame_times import read_frame_times
from pipelines.formats.videos.picture_folder import FolderPictures
from pipelines.formats.videos.video import VideoReader
from pipelines.ingest import ingest
from pipelines.reconstruct import reconstruct
from pipelines.report import report
from pipelines.session.errors import MocapError
from pipelines.session.registries import (
    FORMATS,
    AttitudeFormat,
    CalibrationFormat,
    Format,
    JointFormat,
    KeypointFormat,
    LogFormat,
    MapFormat,
    TelemetryChoice,
    TelemetryFormat,
    TrajectoryFormat,
    TriggerFormat,
    VideoFormat,
)


class NotOneLineError(AssertionError):
    """Refusal that a terminal would show on several lines."""


def read_or_refuse(path: Path, stated: str, lines: list[str] | None = None) -> tuple[int, int]:
    """Read a file in every way; count the ways that worked, and those that refused it in one line.

    `stated` is a format independent of the content. `lines` takes the refusals. Other errors are raised.
    """
    read = refused = 0
    for way in _ways(path, stated):
        try:
            way()
            read += 1
        except MocapError as error:
            refused += 1
            if lines is not None:
                lines.append(str(error))
            if "\n" in str(error).strip():
                raise NotOneLineError(str(error)) from error
    return read, refused


def _ways(path: Path, stated: str) -> Iterator[Callable[[], object]]:
    if path.name == "flight.yaml":
        yield partial(_ingest, path)
        return
    if path.suffix == ".session":
        yield partial(reconstruct, path)
        yield partial(report, path)
        return
    for format_ in FORMATS.all():
        if format_.recognises(path) or format_.name == stated:  # the first never raises, as it promises
            yield partial(format_.describe, path)
            yield from _ways_of(format_, path)
    if stated == "frame_times":
        yield partial(read_frame_times, path)


def _ways_of(format_: Format, path: Path) -> Iterator[Callable[[], object]]:
    if isinstance(format_, KeypointFormat):
        yield lambda: format_.read_keypoints(path, skeleton=None, first_frame=0)
        yield lambda: format_.read_keypoints(path, skeleton="coco17", first_frame=3)
    if isinstance(format_, TrajectoryFormat):
        yield lambda: format_.read_trajectory(path)
    if isinstance(format_, CalibrationFormat):
        yield lambda: format_.read_calibration(path)
    if isinstance(format_, JointFormat):
        yield lambda: format_.read_joints(path, unit=None, axes=None)
        yield lambda: format_.read_joints(path, unit="mm", axes="y-up")
    if isinstance(format_, MapFormat):
        yield lambda: format_.read_map(path)
    if isinstance(format_, LogFormat):
        yield lambda: _messages(format_, path)
    if isinstance(format_, VideoFormat):
        yield lambda: format_.index(path)
        yield partial(_look, path)
    if isinstance(format_, TelemetryFormat):
        yield lambda: format_.read_telemetry(path, TelemetryChoice())
    if isinstance(format_, AttitudeFormat):
        yield lambda: format_.read_attitudes(path)
    if isinstance(format_, TriggerFormat):
        yield lambda: format_.picture_times(path, TelemetryChoice())


def _look(path: Path) -> None:
    with FolderPictures(path) if path.is_dir() else VideoReader(path) as pictures:
        for _ in pictures.frames():
            pass


def _messages(format_: LogFormat, path: Path) -> None:
    with format_.open_log([path]) as log:
        for _ in log.messages([topic.name for topic in log.topics]):
            pass
        _ = log.dropped


def _ingest(flight: Path) -> None:
    session = flight.with_suffix(".session")
    try:
        ingest(flight, session)
    finally:
        shutil.rmtree(session, ignore_errors=True)
