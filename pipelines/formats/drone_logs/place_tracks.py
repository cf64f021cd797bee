"""Places over time without attitudes: GPX tracks, and tables with latitude and longitude or x, y and z."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.formats.common.files import read_head
from pipelines.formats.common.rows import Heading, describe_times, find_heading, parse_stamps, rows_below
from pipelines.formats.drone_logs.dji_records import FORMAT as DJI_RECORD
from pipelines.formats.drone_logs.telemetry_rows import position_track
from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.session.errors import DataError
from pipelines.session.records import PositionTrack, Telemetry
from pipelines.session.registries import TelemetryChoice
from pipelines.session.storage import read_text

_POINT = re.compile(r"(?s)<(?:\w+:)?trkpt\b([^>]*)>(.*?)</(?:\w+:)?trkpt>")
_ATTRIBUTE = r"\b{}\s*=\s*[\"']([^\"']*)[\"']"
_ELEMENT = r"<(?:\w+:)?{0}>([^<]*)</(?:\w+:)?{0}>"
_ON_EARTH = (
    ("latitude", "lat", "latitude_deg"),
    ("longitude", "lon", "lng", "longitude_deg"),
    ("altitude", "alt", "ele", "elevation", "height", "altitude_m"),
)
_METRES = (("x",), ("y",), ("z",))
_ATTITUDE = {"qw", "q_w", "yaw", "heading", "pitch", "roll"}


@dataclass(frozen=True)
class PlaceTrack:
    """Reader of places: `is_known` recognises the beginning of a file, `read` returns its rows."""

    name: str
    title: str
    suffixes: tuple[str, ...]
    is_known: Callable[[str], bool]
    read: Callable[[Path], tuple[Int64, Bool, Float, bool]]
    """Times [N], if they are known [N], places [N, 3], and True for degrees and metres of height."""

    def recognises(self, path: Path) -> bool:
        """Return True if the file begins as such files do."""
        return self.is_known(read_head(path, self.suffixes)) and not DJI_RECORD.recognises(path)

    def describe(self, path: Path) -> dict[str, object]:
        """Describe rows, times and losses."""
        found = self.read_telemetry(path, TelemetryChoice())
        return {
            "positions": len(found.position.t_ns),
            **describe_times(found.position.t_ns),
            "attitudes": "none",
            **{f"dropped: {cause}": count for cause, count in found.dropped.items()},
        }

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:  # noqa: ARG002  # has none
        """Read the places; unusable rows are dropped and counted."""
        t_ns, timed, values, on_earth = self.read(path)
        if not len(t_ns):
            raise DataError(path, "holds no places", "export the track again", code="empty")
        dropped: dict[str, int] = {}
        track: PositionTrack = position_track(
            path, "its track", t_ns, values, dropped, on_earth=on_earth, unusable={"no time": ~timed}
        )
        # Receivers repeat a place with its time; heights are those of the sea or of an ellipsoid.
        return Telemetry(replace(track, name="its track"), None, None, "UTC by GPS", dropped=dropped)


def _read_gpx(path: Path) -> tuple[Int64, Bool, Float, bool]:
    """Read the points of all tracks of a GPX file (topografix.com/GPX/1/1); a point without height is NaN."""

    def of(pattern: str, text: str) -> str:
        match = re.search(pattern, text)
        return match[1].strip() if match else ""

    stamps, rows = [], []
    for point in _POINT.finditer(read_text(path)):
        stamps.append(of(_ELEMENT.format("time"), point[2]))
        texts = [of(_ATTRIBUTE.format(name), point[1]) for name in ("lat", "lon")]
        rows.append([_number(text) for text in (*texts, of(_ELEMENT.format("ele"), point[2]))])
    t_ns, timed = parse_stamps(path, stamps)
    return t_ns, timed, np.array(rows, np.float64).reshape(-1, 3), True


def _number(text: str) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return float("nan")


def _columns(text: str) -> tuple[Heading, dict[str, int], bool] | None:
    """Return the heading of a table of places, its three columns, and True for degrees; None without."""
    heading = find_heading(text.partition("\n")[0])
    if heading is None or (_ATTITUDE | {"joint"}) & heading.names.keys():  # poses, or joints of people
        return None
    for on_earth, wanted in ((True, _ON_EARTH), (False, _METRES)):
        columns = {
            names[0]: heading.names[name]
            for names in wanted
            for name in reversed(names)
            if name in heading.names
        }
        if len(columns) == len(wanted):
            return heading, columns, on_earth
    return None


def _read_table(path: Path) -> tuple[Int64, Bool, Float, bool]:
    """Read a table whose heading names a time and places, separated by commas, semicolons or tabs."""
    text = read_text(path)
    found = _columns(text)
    if found is None:
        problem = "has no heading that names times and places"
        raise DataError(path, problem, "name t, latitude, longitude, altitude", code="missing-column")
    heading, columns, on_earth = found
    table = rows_below(path, heading, text, {}, columns)
    t_ns, timed = parse_stamps(path, table.text["stamp"], heading.unit, unit_stated=heading.unit_stated)
    return t_ns, timed, table.stack([*columns]), on_earth


GPX = PlaceTrack("gpx", "GPX track", (".gpx",), lambda head: "<gpx" in head, _read_gpx)
PLACES_CSV = PlaceTrack(
    "places", "places as CSV", (".csv", ".txt", ".tsv"), lambda head: _columns(head) is not None, _read_table
)
