"""GPX tracks (Topografix, GPX 1.0 and 1.1) of phones and watches: a log with a topic of NavSatFix a track.

Points without a time are left out and counted. Heights are above the sea, as the receiver or its map states
them. GPX has no accuracy.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace as Fields
from typing import IO, Self
from xml.etree import ElementTree as ET

from pipelines.formats.common.files import first_bytes
from pipelines.session.errors import DataError
from pipelines.session.records import Message, Topic
from pipelines.session.storage import as_data_error, plain_text

_TYPE = "sensor_msgs/msg/NavSatFix"
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_Fix = tuple[int, float, float, float]  # ns, degrees, degrees, m


class GpxFormat:
    """Reader of the points of tracks; routes and waypoints have no times of a motion."""

    name = "gpx"
    title = "GPX tracks"
    suffixes: tuple[str, ...] = (".gpx",)

    def recognises(self, path: Path) -> bool:
        """Return True if the file's first element is gpx."""
        head = plain_text(first_bytes(path, 4096, suffixes=self.suffixes))
        return re.search(r"<(?:\w+:)?gpx\b", head) is not None

    def describe(self, path: Path) -> dict[str, object]:
        """Describe every track by its topic, points and times, and the losses."""
        with self.open_log([path]) as log:
            return {
                "messages": sum(topic.count for topic in log.topics),
                "topics": {
                    topic.name: {
                        "type": topic.type,
                        "messages": topic.count,
                        "first_ns": topic.first_ns,
                        "last_ns": topic.last_ns,
                    }
                    for topic in log.topics
                },
                **{f"dropped: {cause}": count for cause, count in log.dropped.items()},
            }

    def open_log(self, paths: Sequence[Path]) -> GpxLog:
        """Read the tracks of one file or several."""
        return GpxLog(paths)


class GpxLog:
    """Tracks of GPX files: /track, or /track1, /track2, ... if there are several.

    Raises:
        DataError: a file cannot be read, or no point has a place and a time.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._dropped: Counter[str] = Counter()
        tracks = [track for path in paths for track in _tracks(path, self._dropped) if track]
        if not tracks:
            lost = ", ".join(f"{count} {cause}" for cause, count in self._dropped.items()) or "no track"
            raise DataError(paths[0], f"holds no point with a place and a time ({lost})", "export it again")
        self._tracks: dict[Topic, list[_Fix]] = {}
        for number, track in enumerate(tracks, 1):
            name = f"/track{number}" if len(tracks) > 1 else "/track"
            stamps = [fix[0] for fix in track]
            self._tracks[Topic(name, _TYPE, "gpx", len(track), min(stamps), max(stamps))] = track

    @property
    def topics(self) -> Sequence[Topic]:
        """The tracks, in the order of the files."""
        return list(self._tracks)

    @property
    def dropped(self) -> Mapping[str, int]:
        """Counts by cause of points that were left out."""
        return +self._dropped

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Yield the points of some tracks by their times."""
        rows = [
            (fix, topic) for topic, track in self._tracks.items() if topic.name in topics for fix in track
        ]
        for (t_ns, latitude, longitude, height), topic in sorted(rows, key=lambda row: (row[0], row[1].name)):
            seconds, nanoseconds = divmod(t_ns, 1_000_000_000)
            value = Fields(
                header=Fields(stamp=Fields(sec=seconds, nanosec=nanoseconds), frame_id="gpx"),
                status=Fields(status=0, service=1),
                latitude=latitude,
                longitude=longitude,
                altitude=height,
                position_covariance=[0.0] * 9,
                position_covariance_type=0,
            )
            yield Message(topic, t_ns, value)

    def __enter__(self) -> Self:
        """Return the log itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close nothing: no file stays open."""


def _tracks(path: Path, dropped: Counter[str]) -> list[list[_Fix]]:
    """Read the points of each track, one by one; a file that is cut off gives those before the cut."""
    tracks: list[list[_Fix]] = []
    try:
        with path.open("rb") as file:
            for event, element in ET.iterparse(_Growing(file), events=("start", "end")):  # noqa: S314
                name = element.tag.rpartition("}")[2]
                if event == "start" and name == "trk":
                    tracks.append([])
                elif event == "end" and name == "trkpt" and tracks:
                    fix = _fix(element, dropped)
                    if fix is not None:
                        tracks[-1].append(fix)
                    element.clear()
    except OSError as error:
        raise as_data_error(error, path) from error
    except ET.ParseError as error:
        if not any(tracks):
            raise DataError(path, f"is no valid XML ({str(error)[:80]})", "export it again") from error
        dropped["file cut off or damaged"] += 1
    return tracks


class _Growing:
    """File that is read in parts as large as all before.

    The parser reads an unfinished tag anew with each part.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.close = file.close

    def read(self, length: int = 0, /) -> bytes:
        """Return at least `length` bytes; fewer at the end."""
        return self._file.read(max(length, self._file.tell()))


def _fix(point: ET.Element, dropped: Counter[str]) -> _Fix | None:
    texts = {child.tag.rpartition("}")[2]: (child.text or "").strip() for child in point}
    try:
        latitude, longitude = float(point.get("lat", "")), float(point.get("lon", ""))
        height = float(texts["ele"]) if texts.get("ele") else 0.0
    except ValueError:
        dropped["points without a place"] += 1
        return None
    try:
        taken = datetime.fromisoformat(texts.get("time", ""))
    except ValueError:
        dropped["points without a time"] += 1
        return None
    if not all(math.isfinite(each) for each in (latitude, longitude, height)):
        dropped["points without a place"] += 1
        return None
    if not texts.get("ele"):
        dropped["points without a height"] += 1
        return None
    elapsed = (taken if taken.tzinfo else taken.replace(tzinfo=UTC)) - _EPOCH
    return elapsed // timedelta(microseconds=1) * 1000, latitude, longitude, height


FORMAT = GpxFormat()
