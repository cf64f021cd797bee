"""DJI's flight records as the CSV that log services export.

Columns are those of Airdata (`time(millisecond),datetime(utc),latitude,...,gimbal_pitch(degrees)`), Flight
Reader (`CUSTOM.updateTime [local],OSD.flyTime [s],OSD.latitude,...,GIMBAL.pitch`), PhantomHelp
(`Time(seconds),...,Altitude(feet),...,Pitch,Roll,Yaw`) and dji-log-parser (`CUSTOM.dateTime,...`), in feet or
metres, often both. Angles are those of an FRD body and gimbal in NED.
"""

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

import numpy as np

from pipelines.formats.common.files import read_head
from pipelines.formats.common.rows import since_epoch_ns
from pipelines.formats.drone_logs.dji_subtitles import (
    NAMES,
    DjiRows,
    any_finite,
    attitudes_of_rows,
    telemetry_of_rows,
)
from pipelines.formats.drone_logs.telemetry_rows import DroneLog
from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.session.errors import DataError
from pipelines.session.records import Attitudes, Telemetry
from pipelines.session.registries import TelemetryChoice
from pipelines.session.storage import empty, on_disk, refuse_special, text_encoding

_FIRST_YEAR, _LAST_YEAR = 1970, 2200  # of dates; others are damage
# No flight lasts twelve days, so a larger time is damage.
_LONGEST_S = 1e6
_METRES = {"": 1.0, "m": 1.0, "meters": 1.0, "metres": 1.0, "ft": 0.3048, "feet": 0.3048}
_SECONDS = {"millisecond": 1e-3, "ms": 1e-3, "seconds": 1.0, "s": 1.0}
_IN_SECONDS = ("osd.flytime",)  # without a unit
_ELAPSED = ("time", "osd.flytime")
_FILMS = ("isvideo", "camera.isvideo", "istakingvideo")
_HEADING = re.compile(r"([^\[(]+?)\s*(?:[\[(]([^\])]*)[\])]+)?")
_CLOCK = re.compile(
    r"(\d{1,4})[-/.](\d{1,2})[-/.](\d{1,4})[ T]+(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d{1,9}))?)?"
    r"\s*([aApP])?\.?[mM]?\.?Z?"
)
_DAY_OF_NAME = re.compile(r"(\d{4})[-_](\d{2})[-_](\d{2})")
_MARK = re.compile(r"[.,](?=\d)")


class DjiRecordFormat(DroneLog):
    """Reader of a flight record as CSV; every column but times and positions may be absent."""

    name = "dji_record"
    title = "DJI flight record (CSV)"
    suffixes: tuple[str, ...] = (".csv",)
    choices: tuple[str, ...] = ("altitude",)

    def recognises(self, path: Path) -> bool:
        """Return True if the heading names times, positions on Earth, and heights or angles."""
        return _find_heading(read_head(path, self.suffixes)) is not None

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:
        """Read positions, interpolated where they are repeated, and angles of body and gimbal."""
        return telemetry_of_rows(path, _read(path)[0], choice)

    def read_attitudes(self, path: Path) -> Attitudes:
        """Read the gimbal's angles, also where the drone had no position."""
        return attitudes_of_rows(path, _read(path)[0])


@dataclass(frozen=True)
class _RecordHeading:
    """The line that names the columns."""

    line: int
    delimiter: str
    cells: int
    numbers: Mapping[str, tuple[int, float]]  # by name: the column, and what one of its units is
    clock: tuple[int, ...]  # columns of date and time, or of both in one
    utc: bool  # the clock's zone, else local
    films: int | None


def recordings_of(path: Path) -> list[tuple[int, int]]:
    """Read first and last time (ns) of every video that a flight record says was recorded."""
    rows, filming = _read(path)
    edges = np.flatnonzero(np.diff([0, *filming.astype(int), 0]))
    films = zip(edges[::2].tolist(), (edges[1::2] - 1).tolist(), strict=True)
    return [(int(rows.t_ns[a]), int(rows.t_ns[b])) for a, b in films if rows.timed[a] and rows.timed[b]]


def _find_heading(text: str) -> _RecordHeading | None:
    """Parse the heading, also below a line `sep=,`; None if it is no flight record's."""
    lines = text.split("\n", 2)
    line = 1 if lines[0].strip().strip('"').lower().startswith("sep=") else 0
    if len(lines) <= line:
        return None
    delimiter = max(",;\t", key=lines[line].count)
    try:
        cells = next(csv.reader([lines[line]], delimiter=delimiter), [])
    except csv.Error:
        return None
    matches = [_HEADING.fullmatch(cell.strip().lower()) for cell in cells]
    names = [(match[1], match[2] or "") if match else ("", "") for match in matches]
    numbers: dict[str, tuple[int, float]] = {}
    for name, known in NAMES["columns"].items():
        if (column := _column(names, known)) is not None:
            numbers[name] = (column, 1.0)
    for name, known in NAMES["lengths"].items():
        if found := _measured(names, known, _METRES):
            numbers[name] = found
    if found := _measured(names, _ELAPSED, _SECONDS) or _measured(names, _IN_SECONDS, {"": 1.0}):
        numbers["elapsed"] = found
    zone, clock = next(
        ((zone, c) for zone in NAMES["clocks"] if (c := _clock_columns(names, zone))), ("", ())
    )
    told = numbers.keys() & {"relative", "absolute", "drone_pitch", "gb_pitch"}
    if not numbers.keys() >= {"latitude", "longitude"} or not told or not ("elapsed" in numbers or clock):
        return None
    return _RecordHeading(line, delimiter, len(cells), numbers, clock, zone == "utc", _column(names, _FILMS))


def _column(names: Sequence[tuple[str, str]], known: Sequence[str]) -> int | None:
    plain = [name for name, _ in names]
    return next((plain.index(name) for name in known if name in plain), None)


def _measured(
    names: Sequence[tuple[str, str]], known: Sequence[str], units: Mapping[str, float]
) -> tuple[int, float] | None:
    """Return the column of the first known name in a known unit, and that unit; 1.0 is preferred."""
    for wanted in known:
        found = [(units[u], k) for k, (name, u) in enumerate(names) if name == wanted and u in units]
        if found:
            unit, column = min(found, key=lambda each: each[0] != 1.0)
            return column, unit
    return None


def _clock_columns(names: Sequence[tuple[str, str]], zone: str) -> tuple[int, ...]:
    """Return the columns of the date and the time of day in a zone; empty without."""
    for wanted in NAMES["clocks"][zone]:
        if all(tuple(name) in names for name in wanted):
            return tuple(names.index(tuple(name)) for name in wanted)
    return ()


def _read(path: Path) -> tuple[DjiRows, Bool]:
    """Read all rows, and in which of them [N] the camera films."""
    refuse_special(path)
    heading = _find_heading(read_head(path))
    if heading is None:
        problem = "has no heading that names times, latitude, longitude, and heights or angles"
        raise DataError(path, problem, "export the flight record with these columns", code="missing-column")
    values: dict[str, list[float]] = {name: [] for name in heading.numbers}
    clocks: list[str] = []
    filming: list[bool] = []
    damaged = 0
    decimal_commas = heading.delimiter != ","  # until a latitude shows which mark is decimal
    with on_disk(path):
        for row in _rows(path, heading):
            try:
                if (mark := _MARK.search(row[heading.numbers["latitude"][0]])) is not None:
                    decimal_commas = mark[0] == ","
                numbers = {
                    name: _number(row[column], decimal_commas=decimal_commas)
                    for name, (column, _) in heading.numbers.items()
                }
                clock = " ".join(row[column].strip() for column in heading.clock)
                films = heading.films is not None and row[heading.films].strip().lower() in {"1", "true"}
            except (ValueError, IndexError):
                damaged += 1
                continue
            for name, number in numbers.items():
                values[name].append(number)
            clocks.append(clock)
            filming.append(films)
    if not clocks:
        raise empty(path, f"holds no rows ({damaged} damaged)")
    blank = np.full(len(clocks), np.nan)
    names = (*NAMES["columns"], *NAMES["lengths"], "elapsed", "altitude")
    columns = {
        name: np.array(values[name]) * heading.numbers[name][1] if name in values else blank for name in names
    }
    columns["latitude"] = np.where(np.isfinite(columns["longitude"]), columns["latitude"], np.nan)
    notes: list[str] = []
    clock_ns, fine = _parse_clocks(path, clocks, notes)
    clock = "UTC" if heading.utc else "local time"
    if not clock_ns.any():
        clock = "the record's start"
        notes.append("shows no date: its times count from the record's start")
    elif not heading.utc:
        notes.append("its clock is local time, taken as UTC")
    t_ns, timed = _times(clock_ns, columns["elapsed"], fine=fine)
    dropped = {"damaged row": damaged} if damaged else {}
    rows = DjiRows(t_ns, timed, columns, clock, zero_is_none=True, dropped=dropped, notes=notes)
    return rows, np.array(filming, np.bool_)


def _times(clock_ns: Int64, elapsed_s: Float, *, fine: bool) -> tuple[Int64, Bool]:
    """Return times [N] in ns, and True where they are known [N]: of a clock of whole seconds in between."""
    shown = clock_ns != 0
    if fine or not any_finite(elapsed_s):
        return clock_ns, shown
    known = np.asarray(np.abs(np.nan_to_num(elapsed_s, nan=np.inf)) < _LONGEST_S, dtype=np.bool_)
    since_ns = np.round(np.where(known, elapsed_s, 0) * 1e9).astype(np.int64)
    both = np.flatnonzero(shown & known)
    if not len(both):
        return since_ns, known
    ahead_ns = clock_ns[both] - since_ns[both]
    ticks = np.flatnonzero(np.diff(clock_ns[both]) > 0) + 1
    if len(ticks):  # the clock ticked between a row and the one before
        ahead_ns = ahead_ns[ticks] + np.diff(since_ns[both])[ticks - 1] // 2
    else:
        ahead_ns = ahead_ns + 500_000_000
    return since_ns + int(np.median(ahead_ns - ahead_ns[0])) + int(ahead_ns[0]), known


def _rows(path: Path, heading: _RecordHeading) -> Iterator[list[str]]:
    """Yield the rows below the heading that are not blank; one that is no CSV comes as an empty row."""
    with path.open("rb") as file:
        encoding = text_encoding(file.read(2))
    with path.open(encoding=encoding, errors="replace", newline="") as file:
        below = (line.replace("\0", "") for line in islice(file, heading.line + 1, None))
        rows = csv.reader(below, delimiter=heading.delimiter)
        while True:
            try:
                row = next(rows, None)
            except csv.Error:
                yield []
                continue
            if row is None:
                return
            if any(row):
                yield row


def _number(cell: str, *, decimal_commas: bool) -> float:
    """Parse a number with a decimal dot or comma; a blank cell is NaN."""
    text = cell.strip()
    if decimal_commas and text.count(",") == 1 and "." not in text:
        text = text.replace(",", ".")
    return float(text or "nan")


def _parse_clocks(path: Path, texts: Sequence[str], notes: list[str]) -> tuple[Int64, bool]:
    """Parse dates with times as ns since the epoch [N], 0 without, and say if any has parts of seconds."""
    clock_ns = np.zeros(len(texts), dtype=np.int64)
    matches = [_CLOCK.fullmatch(text) for text in texts]
    shown = [match for match in matches if match]
    if not shown:
        return clock_ns, False
    day_first = _day_comes_first(path, shown, notes)
    for row, match in enumerate(matches):
        if match:
            clock_ns[row] = _since_epoch_ns(match, day_first)
    return clock_ns, any(match[7] for match in shown)


def _day_comes_first(path: Path, shown: Sequence[re.Match[str]], notes: list[str]) -> bool:
    """Decide the order of dates without the year in front: by their numbers, else by the file's name."""
    dates = {(int(match[1]), int(match[2]), int(match[3])) for match in shown if len(match[1]) < 3}
    if any(first > 12 for first, _, _ in dates):
        return True
    if not dates or any(second > 12 for _, second, _ in dates):
        return False
    if named := _DAY_OF_NAME.search(path.name):
        year, month, day = (int(part) for part in named.groups())
        if (day, month, year) in dates:
            return True
        if (month, day, year) in dates:
            return False
    first, second, year = min(dates)
    if first != second:
        notes.append(f"its date {first}/{second}/{year} is taken as month/day/year")
    return False


def _since_epoch_ns(match: re.Match[str], day_first: bool) -> int:
    first, second, third, hour, minute = (int(part) for part in match.groups()[:5])
    if len(match[1]) > 2:
        year, month, day = first, second, third
    else:
        year, (month, day) = third, ((second, first) if day_first else (first, second))
    if match[8]:
        hour = hour % 12 + 12 * (match[8].lower() == "p")
    try:
        moment = datetime(year, month, day, hour, minute, int(match[6] or 0), tzinfo=UTC)
    except ValueError:
        return 0
    if not _FIRST_YEAR <= year < _LAST_YEAR:
        return 0
    return since_epoch_ns(moment) + int((match[7] or "").ljust(9, "0"))


FORMAT = DjiRecordFormat()
