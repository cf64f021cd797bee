"""Tables of drones: places without attitudes (GPX, CSV), and the recordings of AirSim."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.compute as pc

from pipelines.formats.common.files import TextFormat, read_head
from pipelines.formats.common.rows import (
    METRES,
    Heading,
    cell_name,
    describe_times,
    find_heading,
    parse_stamps,
    rows_below,
)
from pipelines.formats.drone_logs.dji_records import FORMAT as DJI_RECORD
from pipelines.formats.drone_logs.telemetry_rows import DroneLog, attitude_track, position_track
from pipelines.formats.poses import POSITION, QUATERNION, find_poses, is_airsim
from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.mounting import attitude_in_enu
from pipelines.session.errors import DataError
from pipelines.session.records import PositionTrack, Telemetry
from pipelines.session.registries import TelemetryChoice
from pipelines.session.storage import empty, read_text

_POINT = re.compile(r"(?s)<(?:\w+:)?trkpt\b([^>]*)>(.*?)</(?:\w+:)?trkpt>")
_ATTRIBUTE = r"\b{}\s*=\s*[\"']([^\"']*)[\"']"
_ELEMENT = r"<(?:\w+:)?{0}>([^<]*)</(?:\w+:)?{0}>"
_OF_RECEIVER = r"(?:(?:gps|gnss|pos|position|p)_?)?"
_HEIGHT = r"(?:alt|altitude|ele|elevation|height)(?:_a?msl)?(?:_m)?"
_ON_EARTH = (r"lat(?:itude)?(?:_deg)?", r"(?:lon|long|lng|longitude)(?:_deg)?", _HEIGHT)
_METRES = (r"(?:x|e|east|easting)(?:_m)?", r"(?:y|n|north|northing)(?:_m)?", rf"(?:z|u|up)(?:_m)?|{_HEIGHT}")
_UNITS = {"": 1.0, "deg": 1.0, "degrees": 1.0, "°": 1.0, **METRES}
_ATTITUDE = {"qw", "q_w", "yaw", "pitch", "roll"}


@dataclass(frozen=True)
class PlaceTrack(TextFormat):
    """Reader of places: `is_known` recognises the beginning of a file, `read` returns its rows."""

    read: Callable[[Path], tuple[Int64, Bool, Float, bool]]
    """Times [N], if they are known [N], places [N, 3], and True for degrees and metres of height."""

    def recognises(self, path: Path) -> bool:
        """Return True if the file begins as such files do."""
        return super().recognises(path) and not DJI_RECORD.recognises(path)

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

    stamps: list[str] = []
    rows: list[str] = []
    for point in _POINT.finditer(read_text(path)):
        stamps.append(of(_ELEMENT.format("time"), point[2]))
        texts = [of(_ATTRIBUTE.format(name), point[1]) for name in ("lat", "lon")]
        rows += [*texts, of(_ELEMENT.format("ele"), point[2])]
    t_ns, timed = parse_stamps(path, stamps)
    values = pd.to_numeric(pd.Series(rows, dtype=object), errors="coerce").to_numpy(np.float64)
    return t_ns, timed, values.reshape(-1, 3), True


def _columns(text: str) -> tuple[Heading, dict[str, int], list[float], bool] | None:
    """Return the heading of a table of places, its three columns, their units, and True for degrees; or None.

    Lines of comments may stand above the heading.
    """
    for index, line in enumerate(text.split("\n", 100)[:100]):
        heading = find_heading(line.lstrip("# "), index)
        of_others = _ATTITUDE | {"joint", "keypoint"}  # poses, or joints of people
        if heading is not None and not of_others & heading.names.keys():
            units = dict(cell_name(cell) for cell in reversed(line.lstrip("# ").split(heading.delimiter)))
            for on_earth, wanted in ((True, _ON_EARTH), (False, _METRES)):
                found = [
                    next(
                        (name for name in heading.names if re.fullmatch(_OF_RECEIVER + f"(?:{each})", name)),
                        "",
                    )
                    for each in wanted
                ]
                of_each = [_UNITS.get(units.get(name) or "") for name in found]
                if all(found) and None not in of_each:
                    columns = {name: heading.names[name] for name in found}
                    return heading, columns, [unit for unit in of_each if unit is not None], on_earth
        if not line.startswith("#"):
            return None
    return None


def _read_table(path: Path) -> tuple[Int64, Bool, Float, bool]:
    """Read a table whose heading names a time and places, separated by commas, semicolons or tabs.

    A date in a column of its own belongs to the time of the day, not to other times.
    """
    text = read_text(path)
    found = _columns(text)
    if found is None:
        problem = "has no heading that names times and places"
        raise DataError(path, problem, "name t, latitude, longitude, altitude", code="missing-column")
    heading, columns, units, on_earth = found
    dated = {"date": heading.names["date"]} if "date" in heading.names else {}
    table = rows_below(path, heading, text, dated, columns)
    stamps = table.text["stamp"]
    if dated:
        dates, stamps = (pc.utf8_trim_whitespace(each) for each in (table.text["date"], stamps))
        joined = pc.binary_join_element_wise(dates, stamps, " ")
        stamps = pc.if_else(pc.match_substring_regex(stamps, r"^\d{1,2}:"), joined, stamps)
    t_ns, timed = parse_stamps(path, stamps, heading.unit, unit_stated=heading.unit_stated)
    return t_ns, timed, table.stack([*columns]) * units, on_earth


GPX = PlaceTrack("gpx", "GPX track", (".gpx",), lambda head: "<gpx" in head, _read_gpx)
PLACES_CSV = PlaceTrack(
    "places", "places as CSV", (".csv", ".txt", ".tsv"), lambda head: _columns(head) is not None, _read_table
)


class AirsimRecording(DroneLog):
    """Reader of AirSim's recordings (airsim_rec.txt) of one or several vehicles: in NED, bodies in FRD."""

    name = "airsim"
    title = "AirSim recording"
    suffixes: tuple[str, ...] = (".txt",)
    choices: tuple[str, ...] = ("instance",)

    def recognises(self, path: Path) -> bool:
        """Return True if its heading is that of AirSim."""
        return is_airsim(read_head(path, self.suffixes))

    def vehicles(self, path: Path) -> dict[int, str]:
        """Return the names of the vehicles by their numbers, in the order of appearance."""
        return dict(enumerate(dict.fromkeys(_airsim_rows(path)[0])))

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:
        """Read one vehicle; `instance` is its number, from 0 in the order of appearance."""
        names, t_ns, values, dropped = _airsim_rows(path)
        vehicles = dict.fromkeys(names)
        numbered = dict(enumerate(vehicles))
        if len(vehicles) > 1 and choice.instance is None:
            problem = f"holds {len(vehicles)} vehicles ({', '.join(vehicles)})"
            raise DataError(path, problem, "say which with `instance:`, from 0", code="ambiguous")
        if (choice.instance or 0) not in numbered:
            problem = f"has no vehicle {choice.instance}"
            raise DataError(path, problem, f"there are 0 to {len(vehicles) - 1}", code="no-such-name")
        name = numbered[choice.instance or 0]
        own = np.array([each == name for each in names])
        t_ns, values = t_ns[own], values[own]
        enu = values[:, [1, 0, 2]] * [1, 1, -1]
        turned = attitude_in_enu(values[:, 3:], relative_to="world", axes="ned")
        position = position_track(path, name, t_ns, enu, dropped, on_earth=False)
        body = attitude_track(name, t_ns, turned, dropped)
        return Telemetry(position, body, None, "the simulator's clock", dropped=dropped)

    def picture_times(self, path: Path, choice: TelemetryChoice) -> Int64:
        """Read the times at which a vehicle was filmed, of all if none is chosen, ns [N]."""
        names, t_ns, *_ = _airsim_rows(path)
        chosen = dict(enumerate(dict.fromkeys(names))).get(-1 if choice.instance is None else choice.instance)
        return np.unique(t_ns[[chosen in (None, name) for name in names]])


def _airsim_rows(path: Path) -> tuple[list[str], Int64, Float, dict[str, int]]:
    """Read the vehicle, the time and the pose of each row that has a time; also return losses by cause."""
    text = read_text(path)
    found = find_poses(text)
    if found is None:
        raise DataError(path, "has no heading of AirSim", "record it again", code="missing-column")
    heading, columns = found
    named = {"vehicle": heading.names["vehiclename"]} if "vehiclename" in heading.names else {}
    table = rows_below(path, heading, text, named, columns)
    t_ns, timed = parse_stamps(path, table.text["stamp"], heading.unit, unit_stated=heading.unit_stated)
    names = table.text["vehicle"].to_pylist() if named else ["vehicle"] * len(t_ns)
    if not timed.any():
        raise empty(path, "holds no pose with a time")
    lost = {"truncated last line": table.truncated, "no time": int((~timed).sum())}
    values = table.stack((*POSITION, *QUATERNION))[timed]
    names = [str(name) for name, known in zip(names, timed, strict=True) if known]
    return names, t_ns[timed], values, {cause: count for cause, count in lost.items() if count}


AIRSIM = AirsimRecording()
