"""Reader of DJI's subtitles, which log the drone's position and the gimbal's angles beside the video.

Three generations, with angles of an FRD body and gimbal in NED:

- `[latitude: 41.4] [longitude: 2.2] [rel_alt: 3.6 abs_alt: 6.4] [gb_yaw: 30.0 gb_pitch: -45.0 gb_roll: 0.0]`
  (since 2018); `longitude` may be spelled `longtitude`, and the height `altitude`, without its reference;
- `GPS(149.0251,-20.2533,16)`: longitude, latitude, satellites (until 2018), with `Hb:1.9`, `BAROMETER:20.1`
  or `H 85.80m` as height above take-off, and `F.PRY (...)`, `G.PRY (...)` as the angles of body and gimbal;
- `GPS(36.6146,-6.1120,0.0M)`: latitude, longitude, height (Matrice 300): the M tells them apart.
"""

import re
from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path

import numpy as np

from pipelines.formats.common.files import read_bytes, read_head
from pipelines.formats.common.rows import longest_rising, since_epoch_ns
from pipelines.formats.drone_logs.telemetry_rows import (
    DroneLog,
    attitude_track,
    between_refreshed_angles,
    between_repeats,
    of_angles,
    position_track,
    same_angles_for_every_reference,
    turned_as_stated,
)
from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.session.errors import DataError
from pipelines.session.records import Attitudes, AttitudeTrack, Height, Telemetry
from pipelines.session.registries import TelemetryChoice
from pipelines.session.storage import empty, own_table, plain_text

NAMES = own_table(__file__, "dji")
"""Names of columns of flight records and of tags of pictures, by what they hold."""
# DJI's drones fly no higher than this above their take-off.
_HIGHEST_M = 500


@dataclass(frozen=True)
class DjiRows:
    """Rows of a file of DJI's, of whatever kind; NaN where a row does not hold a value."""

    t_ns: Int64  # [N]
    timed: Bool  # [N] True where the time is known
    # [N] by name: latitude, longitude (deg), relative, absolute, altitude (m), drone_yaw, gb_yaw, ... (deg)
    columns: Mapping[str, Float]
    clock: str  # as in `Telemetry`
    names: tuple[str, str] = ("its body's angles", "its gimbal angles")
    rows: str = "rows"  # name of the rows where losses are counted
    repeats: bool = True  # a position is repeated until the next measurement
    zero_is_none: bool = False  # angles of a gimbal that are 0 throughout
    level: bool = True  # a missing roll is 0
    dropped: Mapping[str, int] = field(default_factory=dict)
    notes: Sequence[str] = ()

    def angles(self, part: str) -> Float:
        """Return yaw, pitch, roll [N, 3] in degrees of `drone` or `gb`."""
        yaw, pitch, roll = (self.columns[f"{part}_{angle}"] for angle in ("yaw", "pitch", "roll"))
        if self.level:
            roll = np.where(np.isnan(roll) & np.isfinite(yaw), 0.0, roll)
        found = np.stack([yaw, pitch, roll], axis=1)
        is_none = self.zero_is_none and part == "gb" and not np.nan_to_num(found).any()
        return np.full_like(found, np.nan) if is_none else found


def telemetry_of_rows(path: Path, found: DjiRows, choice: TelemetryChoice) -> Telemetry:
    """Build positions and attitudes; a repeated position is replaced by linear interpolation."""
    columns, dropped = found.columns, dict(found.dropped)
    height, which, note_on_height = choose_height(path, columns, choice)
    track = position_track(
        path,
        "its GPS",
        found.t_ns,
        np.stack([columns["latitude"], columns["longitude"], height], axis=1),
        dropped,
        on_earth=True,
        height=which,
        unusable={"no time": ~found.timed, "no position": ~np.isfinite(columns["latitude"])},
    )
    said = [*found.notes, note_on_height]
    if found.repeats:
        values, moved = between_repeats(track.t_ns, track.values)
        track = replace(track, values=values)
        if moved:
            said.append(
                f"{moved} of {len(values)} positions repeat the one before: taken between measurements"
            )
    body, gimbal = (
        angles_track(name, found.t_ns[found.timed], found.angles(part)[found.timed], dropped, rows=found.rows)
        for name, part in zip(found.names, ("drone", "gb"), strict=True)
    )
    return Telemetry(
        position=track,
        body=body,
        gimbal=gimbal,
        clock=found.clock,
        notes=tuple(f"{path}: {note}" for note in said),
        dropped=dropped,
    )


def attitudes_of_rows(path: Path, found: DjiRows) -> Attitudes:
    """Build the attitudes of the camera, whatever the rows say of positions."""
    dropped = dict(found.dropped)
    camera = angles_track(
        found.names[1], found.t_ns[found.timed], found.angles("gb")[found.timed], dropped, rows=found.rows
    )
    if camera is None:
        problem = "holds no gimbal angles"
        raise DataError(path, problem, "name the log and topic that do, or fixed angles", code="no-attitude")
    notes = tuple(f"{path}: {note}" for note in found.notes)
    return Attitudes(replace(camera, dropped=dropped), found.clock, notes)


def choose_height(
    path: Path, columns: Mapping[str, Float], choice: TelemetryChoice
) -> tuple[Float, Height, str]:
    """Choose the height of each position from columns [N] m; return its reference and a note, too."""
    stated, unnamed = choice.altitude, columns["altitude"]
    if isinstance(stated, int | float):
        throughout = np.full(len(columns["latitude"]), float(stated))
        return throughout, "stated", "its height is the one stated, throughout"
    both = ("relative", "absolute")
    named = {name: columns[name] for name in both if any_finite(columns[name])}
    there = (dict.fromkeys(both, unnamed) if any_finite(unnamed) else {}) | named
    if not there:
        remedy = "state it, in metres above the take-off: pose: {file: ..., altitude: 30}"
        raise DataError(path, "holds no height", remedy, code="no-positions")
    if stated is not None and stated not in there:
        problem = f"holds no {stated} height"
        raise DataError(path, problem, f"write altitude: {next(iter(there))}, or the metres")
    if stated is None and not named:
        highest_m = float(np.nanmax(unnamed))
        if highest_m > _HIGHEST_M:
            problem = f"its altitude of up to {highest_m:.0f} m is no height above the take-off"
            return unnamed, "unknown", f"{problem}: taken as absolute, from a barometer"
        problem = "its altitude does not say what it counts from"
        return unnamed, "take-off", f"{problem}: taken from the take-off (else write altitude: absolute)"
    name = stated or ("relative" if "relative" in named else "absolute")
    if name == "relative":
        return there[name], "take-off", "heights count from the take-off"
    return (
        there[name],
        "unknown",
        "heights are absolute (barometer or terrain model): drones differ by many metres",
    )


def angles_track(
    name: str,
    t_ns: Int64,
    yaw_pitch_roll_deg: Float,
    dropped: MutableMapping[str, int],
    *,
    rows: str = "subtitles",
) -> AttitudeTrack | None:
    """Build the attitude from angles [N, 3], interpolated where they are repeated; None without any."""
    stated = np.isfinite(yaw_pitch_roll_deg).all(axis=1)
    if not stated.any():
        return None
    if missing := int(np.count_nonzero(~stated)):
        dropped[f"{rows} without {name}"] = missing
    kept = np.flatnonzero(stated)
    kept = kept[longest_rising(t_ns[kept])]
    if late := int(np.count_nonzero(stated)) - len(kept):
        dropped[f"{name} out of order"] = late
    continuous = np.degrees(np.unwrap(np.radians(yaw_pitch_roll_deg[kept]), axis=0))
    between = between_refreshed_angles(t_ns[kept], continuous)
    as_logged = same_angles_for_every_reference(of_angles(between))
    return attitude_track(name, t_ns[kept], turned_as_stated(between), dropped, stated=as_logged)


def any_finite(values: Float) -> bool:
    """Return True if there is any number."""
    return bool(np.isfinite(values).any())


_TIMECODE = r"(\d+):([0-5]\d):([0-6]\d)[,.](\d{3})"  # a Matrice 300 ends its 60th second at :60
_BLOCK = re.compile(rf"(?m)^{_TIMECODE} --> {_TIMECODE}[ \t]*$")
_CLOCK = re.compile(
    r"(\d{4})[-./](\d{1,2})[-./](\d{1,2}) +(\d{1,2}):(\d{2}):(\d{2})(?:[.,](\d{3}))?(?:,(\d{3}))?(?!\d)"
)
# Some Mavic 2 write no display times: a number, then the clock time on a line of its own.
_UNTIMED = re.compile(r"(?m)^\d+[ \t]*\n(?=\d{4}[-./]\d{1,2}[-./]\d{1,2} +\d)")
# Drones' cameras have focal lengths up to this; larger numbers count tenths.
MAX_FOCAL_35_MM = 170.0
# Stamps are int64, which ends in the year 2262.
_LARGEST_NS = 2**63
# Subtitles further apart than this come once a second and show whole seconds.
_SLOW_NS = 500_000_000


@dataclass(frozen=True)
class Subtitles:
    """Subtitles of a video, with their display times and the clock times in their text."""

    media_ns: Int64  # [B] since the video's start
    clock_ns: Int64  # [B] since the epoch, local time taken as UTC; 0 where none is shown
    texts: list[str]  # [B]

    @property
    def has_clock(self) -> Bool:
        """[B] True if a clock time is shown."""
        shown: Bool = self.clock_ns != 0
        return shown

    @property
    def are_slow(self) -> bool:
        """True if subtitles come about once a second, and not with each frame."""
        return len(self.media_ns) > 1 and float(np.median(np.diff(self.media_ns))) >= _SLOW_NS

    def start_ns(self) -> int | None:
        """Return the clock time at the video's start, by the first subtitle with a clock; None without."""
        shown = np.flatnonzero(self.has_clock)
        return int(self.clock_ns[shown[0]] - self.media_ns[shown[0]]) if len(shown) else None

    def focal_35_mm(self) -> float | None:
        """Return the last focal length, mm on 36 mm film: `[focal_len: 24.00]`, or `280` in tenths."""
        found = re.search(r"\[focal_len *: *(\d+(?:\.\d+)?)", self.texts[-1])
        stated = float(found[1]) if found else 0.0
        return (stated / 10 if stated > MAX_FOCAL_35_MM else stated) or None

    def times(self) -> tuple[Int64, Bool]:
        """Return when each subtitle was written [B] (else the video's own time), and if that is known [B]."""
        start_ns = self.start_ns()
        if start_ns is None:
            return self.media_ns, np.ones(len(self.media_ns), dtype=np.bool_)
        if self.are_slow:
            return self.media_ns + start_ns, np.ones(len(self.media_ns), dtype=np.bool_)
        return self.clock_ns, self.has_clock


def read_subtitles(path: Path) -> Subtitles:
    """Read all subtitles of a file; bytes that are not UTF-8 become a sign that no number contains."""
    text = plain_text(read_bytes(path))
    subtitles = parse_subtitles(text)
    if not subtitles.texts:
        raise empty(path, "holds no subtitles" if text.strip() else "is empty")
    return subtitles


@lru_cache(maxsize=2)  # places, angles and times of pictures are read from one file
def parse_subtitles(text: str) -> Subtitles:
    """Parse subtitles; those without display times are shown from their clock times on, the first at 0."""
    blocks = list(_BLOCK.finditer(text))
    timed = bool(blocks)
    blocks = blocks or list(_UNTIMED.finditer(text))
    ends = [block.start() for block in blocks[1:]] + [len(text)]
    texts = [text[block.end() : end] for block, end in zip(blocks, ends, strict=False)]
    clock_ns = np.array([_clock_ns(each) or 0 for each in texts], dtype=np.int64)
    if timed:
        parts = [[int(part[-6:]) for part in block.groups()[:4]] for block in blocks]
        media_ns = np.array(parts, np.int64) @ np.array([3_600_000, 60_000, 1000, 1], np.int64) * 1_000_000
    else:  # since the first clock time; a subtitle without one has the time of the one before
        shown = np.maximum.accumulate(clock_ns)
        media_ns = shown - clock_ns[:1]
    return Subtitles(media_ns=media_ns, clock_ns=clock_ns, texts=texts)


def _clock_ns(text: str) -> int | None:
    """Parse the clock time of a subtitle: 2022-08-07 13:40:40,774,808 and its variants."""
    match = _CLOCK.search(text)
    if match is None:
        return None
    year, month, day, hour, minute, second, ms, us = (int(part or 0) for part in match.groups())
    try:
        moment = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return None
    t_ns = since_epoch_ns(moment) + ms * 1_000_000 + us * 1000
    return t_ns if abs(t_ns) < _LARGEST_NS else None


_NUMBER = r"([-+]?\d+(?:\.\d+)?)"
_BRACKETS = re.compile(r"\[([^\[\]\n]{1,300})\]")
_PAIR = re.compile(r"([A-Za-z_]+)\s*:\s*([-+]?\d+(?:[.,]\d+)?)(?![\d/])")  # with a decimal dot or comma
_GPS = re.compile(rf"GPS\s*\(\s*{_NUMBER}\s*,\s*{_NUMBER}\s*,\s*{_NUMBER}\s*(M?)")
_ANGLES = {
    part: re.compile(rf"\b{letter}\.PRY\s*\(\s*{_NUMBER}[^,\d]*,\s*{_NUMBER}[^,\d]*,\s*{_NUMBER}")
    for part, letter in (("drone", "F"), ("gb", "G"))
}
_ABOVE_TAKE_OFF = re.compile(rf"(?:\bBAROMETER\s*:\s*|\bHb\s*:\s*|\bH\s+){_NUMBER}")

_COLUMNS = (
    *("latitude", "longitude", "relative", "absolute", "altitude"),
    *("gb_yaw", "gb_pitch", "gb_roll", "drone_yaw", "drone_pitch", "drone_roll"),
)
_NAMES = {name: name for name in _COLUMNS}
_NAMES |= {"longtitude": "longitude", "rel_alt": "relative", "abs_alt": "absolute"} | {
    f"{old}{angle}": f"{new}_{angle}"
    for old, new in (("gimbal_", "gb"), ("gb_", "gb"), ("drone_", "drone"), ("uav_", "drone"))
    for angle in ("yaw", "pitch", "roll")
}


class DjiSrtFormat(DroneLog):
    """Reader of subtitles that hold the drone's position."""

    name = "dji"
    title = "DJI telemetry (subtitles)"
    suffixes: tuple[str, ...] = (".srt",)
    choices: tuple[str, ...] = ("altitude",)

    def recognises(self, path: Path) -> bool:
        """Return True if there are subtitles and one of the first holds a position."""
        return bool(
            np.isfinite(_columns(parse_subtitles(read_head(path, self.suffixes)).texts)["latitude"]).any()
        )

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:
        """Read positions, interpolated where they are repeated, and angles of body and gimbal."""
        return telemetry_of_rows(path, _rows(read_subtitles(path)), choice)

    def read_attitudes(self, path: Path) -> Attitudes:
        """Read the gimbal's angles, also where the drone had no position."""
        return attitudes_of_rows(path, _rows(read_subtitles(path)))


def _rows(subtitles: Subtitles) -> DjiRows:
    columns, notes = _columns(subtitles.texts), [_note_on_clock(subtitles)]
    latitude, longitude = columns["latitude"], columns["longitude"]
    beyond = np.count_nonzero(np.abs(latitude) > 90)
    if 2 * beyond > np.count_nonzero(np.isfinite(latitude)) and not (np.abs(longitude) > 90).any():
        columns |= {"latitude": longitude, "longitude": latitude}
        notes.append("its latitudes are beyond 90 deg: taken for longitudes, and these for latitudes")
    t_ns, timed = subtitles.times()
    return DjiRows(
        t_ns,
        timed,
        columns,
        "the drone's clock" if subtitles.has_clock.any() else "the video's start",
        names=("F.PRY", "its gimbal angles"),
        rows="subtitles",
        notes=notes,
    )


def _columns(texts: Sequence[str]) -> dict[str, Float]:
    """Return all columns of `_COLUMNS`, [B] each, NaN if a subtitle does not hold the value."""
    columns = {name: np.full(len(texts), np.nan) for name in _COLUMNS}
    for row, text in enumerate(texts):
        for name, value in _fields(text).items():
            columns[name][row] = value
    return columns


def _fields(text: str) -> dict[str, float]:
    fields: dict[str, float] = {}
    for key, number in _PAIR.findall("]".join(_BRACKETS.findall(text))):
        if (name := _NAMES.get(key.lower())) is not None:
            fields[name] = float(number.replace(",", "."))
    if "GPS" in text and (gps := _GPS.search(text)):
        first, second, third = (float(part) for part in gps.groups()[:3])
        if gps[4]:  # the M of a height: only this form begins with the latitude
            fields |= {"latitude": first, "longitude": second, "absolute": third}
        else:
            fields |= {"longitude": first, "latitude": second}
        if above := _ABOVE_TAKE_OFF.search(text):
            fields.setdefault("relative", float(above[1]))
        for part, pattern in _ANGLES.items():
            if angles := pattern.search(text):
                pitch, roll, yaw = (float(angle) for angle in angles.groups())
                fields |= {f"{part}_pitch": pitch, f"{part}_roll": roll, f"{part}_yaw": yaw}
    if "latitude" not in fields or "longitude" not in fields:  # the text was cut between the two
        fields.pop("latitude", None)
    return fields


def _note_on_clock(subtitles: Subtitles) -> str:
    if not subtitles.has_clock.any():
        return "shows no clock: its times count from the video's start"
    if subtitles.are_slow:
        return "shows whole seconds of local time, taken as UTC: let clock.sigma_s be 1"
    return "its clock is the drone's local time, taken as UTC"


DJI_SRT = DjiSrtFormat()
