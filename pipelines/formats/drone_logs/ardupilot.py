"""ArduPilot's DataFlash logs (.bin), by pymavlink (extra `drones`): estimates, GPS, mounts and pictures.

pymavlink finds the messages, also behind damaged bytes. The world is NED, stamps are us since boot.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.formats.common.files import first_bytes
from pipelines.formats.drone_logs.telemetry_rows import (
    Boots,
    DroneLog,
    attitude_track,
    find_boots,
    fit_gps_time,
    fixes_track,
    of_angles,
    on_gps_time,
    on_one_clock,
    pictures_on_gps_time,
    position_track,
    refuse_marks,
    require_position,
    turned_as_stated,
    world_from_heading,
)
from pipelines.geometry.arrays import ClockFit, Float, Int64, Place, RelativeTo
from pipelines.geometry.mounting import attitude_in_enu
from pipelines.session.errors import DataError
from pipelines.session.records import AttitudeTrack, PositionTrack, Telemetry
from pipelines.session.registries import TelemetryChoice, need
from pipelines.session.storage import damaged, on_disk, own_table

_START = b"\xa3\x95\x80"  # a FMT message: the first of every log
# A log defines up to 256 types, and chance makes one definition in 16 MB.
_MOST_DEFINITIONS = 10_000
_OLD_LOCAL = ("EKF1",)  # until 2015, when the estimator was logged without being flown by: only if asked for
# DataFlash puts two marks and the type before the fields of a message.
_HEAD = 3
_3D_FIX = 3
# GPS time counts from 1980-01-06, UTC.
_GPS_EPOCH_NS = 315_964_800_000_000_000
# GPS time counts whole weeks of this length.
_WEEK_NS = 7 * 24 * 3600 * 1_000_000_000
_LEAP_SECONDS = ((1_483_228_800, 18), (1_435_708_800, 17), (1_341_100_800, 16))
"""UTC second from which GPS time is ahead by so many seconds (IERS announcements up to 2026)."""

# Number type and scale factor of each format letter (AP_Logger's README).
_LETTERS: dict[str, tuple[str, float]] = own_table(__file__, "dataflash")


@dataclass(frozen=True)
class _MessageRows:
    """Messages of one name, in the order of the log."""

    name: str
    raw: NDArray[np.void]  # [N] a field for each column
    places: Int64  # [N] in the file
    scales: Mapping[str, float]
    lost: int  # number of messages cut off at the end
    boots: Boots | None = None

    def __len__(self) -> int:
        return len(self.raw)

    def __contains__(self, field: str) -> bool:
        return bool(self.scales.get(field))  # texts have none

    def integers(self, field: str) -> Int64:
        """Return a field [N] without its scale factor."""
        return np.asarray(self.raw[field]).astype(np.int64)

    def numbers(self, *fields: str) -> Float:
        """Return one field [N], or several [N, F], in their units; NaN if there is no such field."""
        columns = [
            np.asarray(self.raw[field]).astype(np.float64) * self.scales[field]
            if self.scales.get(field)
            else np.full(len(self), np.nan)
            for field in fields
        ]
        return columns[0] if len(columns) == 1 else np.stack(columns, axis=1)

    @property
    def clock(self) -> tuple[str, int] | None:
        """Field with the time since boot, and its unit in ns; None without one."""
        units = (("TimeUS", 1000), ("T" if "Week" in self else "TimeMS", 1_000_000))
        return next((unit for unit in units if unit[0] in self), None)

    def t_ns(self) -> Int64:
        """Return stamps [N] since the first boot; 0 without a time."""
        field, unit_ns = self.clock or ("", 0)
        boot_ns = self.integers(field) * unit_ns if field else np.zeros(len(self), np.int64)
        return boot_ns if self.boots is None else self.boots.going_on(boot_ns, self.places)

    def of(self, instance: int, *columns: str) -> _MessageRows:
        """Keep the rows of one instance, by the first of `columns` that exists; all rows if none does."""
        for column in columns:
            if column in self:
                which = self.integers(column) == instance
                return replace(self, raw=self.raw[which], places=self.places[which])
        return self


class ArduPilotFormat(DroneLog):
    """Reader of the DataFlash logs of ArduPilot autopilots."""

    name = "ardupilot"
    title = "ArduPilot log"
    suffixes: tuple[str, ...] = (".bin",)
    choices: tuple[str, ...] = ("position", "instance", "time")

    def recognises(self, path: Path) -> bool:
        """Return True if the file begins with the FMT message that defines FMT itself."""
        head = first_bytes(path, 11)
        return head.startswith(_START) and head[5:9].rstrip(b"\0") == b"FMT"

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:
        """Read mount, attitude and position: POS (`global`), else XKF1 or NKF1 (`local`), else GPS."""
        log = _DataFlash(path)
        dropped: dict[str, int] = {}
        notes = [] if log.boots is None else log.boots.notes()
        fit = on_gps_time(path, _gps_time(log), choice.time, notes)
        body = _body(log, dropped)
        position = _position(log, choice, dropped, notes)
        gimbal = _mount(log, body, dropped, notes)
        return on_one_clock(path, position, body, gimbal, fit=fit, notes=notes, dropped=dropped)

    def picture_times(self, path: Path, choice: TelemetryChoice) -> Int64:
        """Read the times of pictures: CAM (by the camera's feedback if it has one), else TRIG."""
        log = _DataFlash(path)
        for name in ("CAM", "TRIG"):
            rows = log.first([name], choice.instance or 0, "I")
            if rows is None and (timed := log.rows(name)) is not None and "GPSTime" in timed and len(timed):
                week, ms = timed.integers("GPSWeek"), timed.integers("GPSTime")  # until 2014
                gps_ns = week * _WEEK_NS + ms * 1_000_000 + _GPS_EPOCH_NS
                return np.unique(gps_ns - _leap_ns(gps_ns))
            if rows is not None:
                t_ns = rows.t_ns()
                return pictures_on_gps_time(path, t_ns[t_ns > 0], _gps_time(log), choice)
        problem = "holds no CAM or TRIG message"
        raise DataError(path, problem, "take the times of frames otherwise", code="wrong-kind")


def _position(
    log: _DataFlash, choice: TelemetryChoice, dropped: MutableMapping[str, int], notes: list[str]
) -> PositionTrack:
    instance = choice.instance or 0
    there = {
        "global": None if instance else log.first(["POS"]),  # the one that the autopilot flew by
        "local": log.first(["XKF1", "NKF1", *_OLD_LOCAL[: choice.position == "local"]], instance, "C", "I"),
        "gps": log.first(["GPS"], instance, "I"),
    }
    found = {kind: rows for kind, rows in there.items() if rows is not None}
    lacking = "has no POS, XKF1, NKF1 or GPS message"
    require_position(log.path, found, choice.position, lacking, "log them (LOG_BITMASK)")
    kind: str = choice.position or next(iter(found))
    rows = found[kind]
    of_several = f" (instance {instance})" if instance else ""
    notes.append(f"took the {kind} position from {rows.name}{of_several}")
    if rows.lost:
        dropped["cut off"] = dropped.get("cut off", 0) + rows.lost
    if kind == "local":
        enu = rows.numbers("PE", "PN", "PD") * [1, 1, -1]
        placed = log.first(["ORGN"], 0, "Type")  # type 0 is the origin of the estimator's metres
        origin = None if placed is None else Place(*placed.numbers("Lat", "Lng", "Alt")[0].tolist())
        return position_track(log.path, rows.name, rows.t_ns(), enu, dropped, on_earth=False, origin=origin)
    values = rows.numbers("Lat", "Lng", "Alt")
    fixed = rows.numbers("Status") >= _3D_FIX if kind == "gps" else np.ones(len(rows), dtype=np.bool_)
    track = fixes_track(log.path, rows.name, rows.t_ns(), values, np.asarray(fixed), dropped)
    accuracy = log.first(["GPA"], instance, "I") if kind == "gps" else None
    if accuracy is None:
        return track
    across, up = np.median(accuracy.numbers("HAcc", "VAcc"), axis=0).tolist()
    return replace(track, accuracy_m=(across / float(np.sqrt(2)), up))


def _body(log: _DataFlash, dropped: MutableMapping[str, int]) -> AttitudeTrack | None:
    for name in ("ATT", "AHR2"):
        rows = log.first([name])
        if rows is not None:
            turned = turned_as_stated(rows.numbers("Yaw", "Pitch", "Roll"))
            return attitude_track(rows.name, rows.t_ns(), turned, dropped)
    return None


def _mount(
    log: _DataFlash, body: AttitudeTrack | None, dropped: MutableMapping[str, int], notes: list[str]
) -> AttitudeTrack | None:
    """Read MNT: roll and pitch against the horizon, yaw from north if it is logged, else from the nose."""
    every = log.rows("MNT")
    if every is None or "TimeUS" not in every or "Pitch" not in every:
        return None
    mounts = np.unique(every.integers("I")).tolist() if "I" in every else [0]
    if not mounts:  # every row is damaged
        return None
    rows = every.of(mounts[0], "I")
    if len(mounts) > 1:
        notes.append(f"has {len(mounts)} mounts (MNT): took the angles of the first, {mounts[0]}")
    roll, pitch, from_nose, from_north = (rows.numbers(f) for f in ("Roll", "Pitch", "YawB", "YawE"))
    world_from_mount = of_angles(np.stack([from_north, pitch, roll], axis=1))
    heading_from_mount = of_angles(np.stack([from_nose, pitch, roll], axis=1))
    turned = attitude_in_enu(world_from_mount, relative_to="world", axes="ned")
    unknown = np.isnan(from_north)
    if unknown.any() and body is not None:
        turned[unknown] = world_from_heading(body, rows.t_ns()[unknown], heading_from_mount[unknown])
    stated: dict[RelativeTo, Float] = {
        "world": np.where(unknown[:, None], heading_from_mount, world_from_mount),
        "body": heading_from_mount,
        "heading": heading_from_mount,
    }
    return attitude_track(rows.name, rows.t_ns(), turned, dropped, stated=stated)


def _gps_time(log: _DataFlash) -> ClockFit | None:
    """Fit UTC to the time since boot, by the first receiver; None if it gives no time."""
    boot_ns, utc_ns, _ = _utc(log.first(["GPS"], 0, "I"))
    return fit_gps_time(boot_ns, utc_ns) if len(utc_ns) else None


def _utc(rows: _MessageRows | None) -> tuple[Int64, Int64, Int64]:
    """Return times since boot, UTC, and places in the file [N] of a receiver's 3D fixes."""
    names = (("GWk", "GMS"), ("Week", "TimeMS"))  # today's, and those until 2014
    stated = next((pair for pair in names if rows is not None and all(name in rows for name in pair)), None)
    if rows is None or stated is None:
        none = np.zeros(0, np.int64)
        return none, none, none
    week, ms = (rows.integers(name) for name in stated)
    known = (rows.numbers("Status") >= _3D_FIX) & (week > 0)
    gps_ns = week[known] * _WEEK_NS + ms[known] * 1_000_000 + _GPS_EPOCH_NS
    return rows.t_ns()[known], gps_ns - _leap_ns(gps_ns), rows.places[known]


def _leap_ns(gps_ns: Int64) -> Int64:
    """Return by how many ns GPS time is ahead of UTC; GPS time has no leap seconds."""
    ahead = np.full(len(gps_ns), _LEAP_SECONDS[-1][1] - 1, dtype=np.int64)
    for since_s, seconds in reversed(_LEAP_SECONDS):
        ahead[gps_ns >= (since_s + seconds) * 1_000_000_000] = seconds
    return ahead * 1_000_000_000


class _DataFlash:
    """Messages of a log, found once, read by name."""

    def __init__(self, path: Path) -> None:
        self.path = path
        reader = _index(path)
        self._bytes = np.memmap(path, dtype=np.uint8, mode="r")
        self._formats = {
            reader.id_to_name[k]: reader.formats[k] for k in reader.id_to_name if k in reader.formats
        }
        self._places = {
            name: np.asarray(reader.offsets[f.type], np.int64) for name, f in self._formats.items()
        }
        self.boots: Boots | None = None
        frequent = self.first(["ATT", "GPS", "POS"])
        if frequent is not None:
            clock = _utc(self.first(["GPS"], 0, "I"))
            self.boots = find_boots(frequent.t_ns(), frequent.places, *clock)

    def first(self, names: Sequence[str], instance: int = 0, *columns: str) -> _MessageRows | None:
        """Return the messages of the first of `names` that has any of the instance; None without any."""
        for name in names:
            rows = self.rows(name)
            if rows is not None and rows.clock and len(found := rows.of(instance, *columns)):
                return found
        return None

    def rows(self, name: str) -> _MessageRows | None:
        """Return the messages of a name; None without any, or if their definition is not consistent."""
        places = self._places.get(name)
        if places is None or not len(places):
            return None
        stated = self._formats[name]
        letters, columns = str(stated.format), [str(column) for column in stated.columns]
        if len(letters) != len(columns) or len(set(columns)) < len(columns) or set(letters) - set(_LETTERS):
            return None
        layout = np.dtype([(column, _LETTERS[c][0]) for column, c in zip(columns, letters, strict=True)])
        if layout.itemsize + _HEAD != stated.len:
            return None
        whole = places + stated.len <= len(self._bytes)
        wanted = places[whole, None] + np.arange(_HEAD, stated.len)
        raw = (
            np.ascontiguousarray(self._bytes[wanted]).view(layout)[:, 0]
            if whole.any()
            else np.zeros(0, layout)
        )
        scales = {column: _LETTERS[c][1] for column, c in zip(columns, letters, strict=True)}
        return _MessageRows(name, raw, places[whole], scales, int(np.count_nonzero(~whole)), self.boots)


def _index(path: Path) -> Any:
    """Return pymavlink's reader, which lists the position of each message in the file."""
    with on_disk(path):
        with path.open("rb") as file:
            if file.read(len(_START)) != _START:
                problem = "is no ArduPilot log"
                raise DataError(path, problem, "give the .bin that the autopilot wrote", code="wrong-kind")
        refuse_marks(path, _START[:2])
        refuse_marks(path, _START, most=_MOST_DEFINITIONS)
    kind = need("pymavlink.DFReader", "drones").DFReader_binary
    reader = kind.__new__(kind)  # first without the file, which a failing __init__ leaves open
    try:
        with _silence():
            reader.__init__(str(path), zero_time_base=True)
    except Exception as error:  # damaged files raise many kinds of errors in this parser
        raise damaged(path, error) from error
    finally:
        if opened := getattr(reader, "filehandle", None):
            opened.close()  # its memory map is freed with the last reference to it
    return reader


@contextmanager
def _silence() -> Iterator[None]:
    """Keep pymavlink's output about damaged bytes off the terminal; its compiled part prints too."""
    quiet = io.StringIO()
    stderr = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        with redirect_stdout(quiet), redirect_stderr(quiet):
            yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(nowhere)


FORMAT = ArduPilotFormat()
