"""Reader of DJI's subtitles, which log the drone's position and the gimbal's angles beside the video.

Generations have only the form of subtitles in common. All of these are read:

- `[latitude: 41.4] [longitude: 2.2] [rel_alt: 3.6 abs_alt: 6.4] [gb_yaw: 30.0 gb_pitch: -45.0 gb_roll: 0.0]`
  (since 2018). Blanks before the colons are optional; some drones spell `longitude` as `longtitude`. Only
  enterprise models log gimbal angles. Some log one height called `altitude`, without its reference (for a
  Mavic Air 2 it is the take-off);
- `GPS(149.0251,-20.2533,16)`: longitude, latitude, satellites (until 2018), with `Hb:1.9`, `BAROMETER:20.1`
  or `H 85.80m` as height above take-off, and `F.PRY (...)`, `G.PRY (...)` as the angles of body and gimbal;
- `GPS(36.6146,-6.1120,0.0M)`: latitude, longitude, height (Matrice 300): the M tells them apart.

Angles are those of an FRD body and gimbal in NED (docs/drones.md).
"""

import re
from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.formats.common.files import read_head
from pipelines.formats.common.rows import describe_times, longest_rising
from pipelines.formats.drone_logs.subtitles import Subtitles, parse_subtitles, read_subtitles
from pipelines.formats.drone_logs.telemetry_rows import (
    attitude_track,
    between_refreshed_angles,
    between_repeats,
    of_angles,
    position_track,
    turned_as_stated,
    whatever_from,
)
from pipelines.geometry.arrays import Float, Int64
from pipelines.session.errors import DataError
from pipelines.session.telemetry import AttitudeTrack, Height, Telemetry, TelemetryChoice

_NUMBER = r"([-+]?\d+(?:\.\d+)?)"
_BRACKETS = re.compile(r"\[([^\[\]\n]{1,300})\]")
_PAIR = re.compile(rf"([A-Za-z_]+)\s*:\s*{_NUMBER}(?![\d/])")
_GPS = re.compile(rf"GPS\s*\(\s*{_NUMBER}\s*,\s*{_NUMBER}\s*,\s*{_NUMBER}\s*(M?)")
_ANGLES = {
    part: re.compile(rf"\b{letter}\.PRY\s*\(\s*{_NUMBER}[^,\d]*,\s*{_NUMBER}[^,\d]*,\s*{_NUMBER}")
    for part, letter in (("drone", "F"), ("gb", "G"))
}
_ABOVE_TAKE_OFF = re.compile(rf"(?:\bBAROMETER\s*:\s*|\bHb\s*:\s*|\bH\s+){_NUMBER}")

_NAMES = {"longtitude": "longitude"} | {
    f"{old}{angle}": f"{new}_{angle}"
    for old, new in (("gimbal_", "gb"), ("gb_", "gb"), ("drone_", "drone"), ("uav_", "drone"))
    for angle in ("yaw", "pitch", "roll")
}
_COLUMNS = (
    *("latitude", "longitude", "relative", "absolute", "altitude"),
    *("gb_yaw", "gb_pitch", "gb_roll", "drone_yaw", "drone_pitch", "drone_roll"),
)
_HEIGHTS = {"rel_alt": "relative", "abs_alt": "absolute"}
_HIGHEST_M = 500  # above the take-off: the largest height that DJI's drones reach


class DjiSrtFormat:
    """Reader of subtitles that hold the drone's position."""

    name = "dji"
    title = "DJI telemetry (subtitles)"
    suffixes: tuple[str, ...] = (".srt",)

    def recognises(self, path: Path) -> bool:
        """Return True if there are subtitles and one of the first holds a position."""
        return bool(
            np.isfinite(_columns(parse_subtitles(read_head(path, self.suffixes)).texts)["latitude"]).any()
        )

    def describe(self, path: Path) -> dict[str, object]:
        """Describe subtitles, times, ranges of the positions, heights and angles."""
        subtitles = read_subtitles(path)
        columns = _columns(subtitles.texts)
        t_ns, timed = subtitles.times()
        placed = np.isfinite(columns["latitude"])
        facts: dict[str, object] = {
            "subtitles": len(subtitles.texts),
            "positions": int(np.count_nonzero(placed)),
            **describe_times(np.unique(t_ns[timed])),
            "clock": _clock_name(subtitles),
        }
        for name in ("latitude", "longitude"):
            facts[f"{name}_deg"] = _range(columns[name], 7)
        heights = {
            "height_above_take_off_m": "relative",
            "height_absolute_m": "absolute",
            "height_m": "altitude",
        }
        facts |= {label: _range(columns[name], 3) for label, name in heights.items() if _any(columns[name])}
        for label, part in (("gimbal", "gb"), ("body", "drone")):
            angles = _angles(columns, part)
            if _any(angles):
                facts[f"{label}_angles"] = int(np.count_nonzero(np.isfinite(angles).all(axis=1)))
                facts[f"{label}_pitch_deg"] = _range(angles[:, 1], 2)
        if not any(name.endswith("_angles") for name in facts):
            facts["orientation"] = "none: state a gimbal in the manifest"
        return facts

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:
        """Read positions, and the angles of body and gimbal if the subtitles have them.

        A position that is repeated until the next measurement is replaced by linear interpolation.

        Raises:
            DataError: no subtitles, no position in any, or no height while the user states none.
        """
        subtitles = read_subtitles(path)
        columns = _columns(subtitles.texts)
        t_ns, timed = subtitles.times()
        height, which, note_on_height = _height(path, columns, choice)
        dropped: dict[str, int] = {}
        track = position_track(
            path,
            "its GPS",
            t_ns,
            np.stack([columns["latitude"], columns["longitude"], height], axis=1),
            dropped,
            on_earth=True,
            height=which,
            unusable={"no time": ~timed, "no position": ~np.isfinite(columns["latitude"])},
        )
        values, moved = between_repeats(track.t_ns, track.values)
        return Telemetry(
            position=replace(track, values=values),
            body=_attitude("F.PRY", t_ns[timed], _angles(columns, "drone")[timed], dropped),
            gimbal=_attitude("its gimbal angles", t_ns[timed], _angles(columns, "gb")[timed], dropped),
            clock=_clock_name(subtitles),
            notes=tuple(f"{path}: {note}" for note in _notes(subtitles, note_on_height, moved, len(values))),
            dropped=dropped,
        )


# --- content of a subtitle -----------------------------------------------------------------------------


def _columns(texts: Sequence[str]) -> dict[str, Float]:
    """Return all columns of `_COLUMNS`, [B] each, NaN if a subtitle does not hold the value."""
    rows = [_fields(text) for text in texts]
    return {name: np.array([row.get(name, np.nan) for row in rows]) for name in _COLUMNS}


def _fields(text: str) -> dict[str, float]:
    fields: dict[str, float] = {}
    for bracket in _BRACKETS.findall(text):
        for key, number in _PAIR.findall(bracket):
            name = key.lower()
            fields[_HEIGHTS.get(name) or _NAMES.get(name, name)] = float(number)
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


def _height(path: Path, columns: Mapping[str, Float], choice: TelemetryChoice) -> tuple[Float, Height, str]:
    """Choose the height of each position; return it with its reference and a note about the choice.

    An `altitude` without a reference is used for each of the two heights that has no field of its own.
    """
    stated, unnamed = choice.altitude, columns["altitude"]
    if isinstance(stated, int | float):
        throughout = np.full(len(columns["latitude"]), float(stated))
        return throughout, "stated", "its height is the one stated, throughout"
    both = ("relative", "absolute")
    named = {name: columns[name] for name in both if _any(columns[name])}
    there = (dict.fromkeys(both, unnamed) if _any(unnamed) else {}) | named
    if not there:
        raise DataError(
            path,
            "holds no height",
            "state it, in metres above the take-off: pose: {dji: ..., altitude: 30}",
        )
    if stated is not None and stated not in there:
        raise DataError(
            path, f"holds no {stated} height", f"write altitude: {next(iter(there))}, or the metres"
        )
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
    return there[name], "unknown", "heights are absolute, from a barometer: drones differ by many metres"


def _angles(columns: Mapping[str, Float], part: str) -> Float:
    """Return yaw, pitch, roll [B, 3] in degrees; a missing roll is 0."""
    yaw, pitch, roll = (columns[f"{part}_{angle}"] for angle in ("yaw", "pitch", "roll"))
    return np.stack(
        [yaw, pitch, np.where(np.isnan(roll), np.where(np.isnan(yaw), np.nan, 0.0), roll)], axis=1
    )


def _any(values: Float) -> bool:
    return bool(np.isfinite(values).any())


def _range(values: Float, decimals: int) -> list[float]:
    finite = values[np.isfinite(values)]
    return [round(float(v), decimals) for v in (finite.min(), finite.max())] if len(finite) else []


def _attitude(
    name: str, t_ns: Int64, yaw_pitch_roll_deg: Float, dropped: MutableMapping[str, int]
) -> AttitudeTrack | None:
    """Build the attitude from angles [B, 3]; None if there are none."""
    stated = np.isfinite(yaw_pitch_roll_deg).all(axis=1)
    if not stated.any():
        return None
    if missing := int(np.count_nonzero(~stated)):
        dropped[f"subtitles without {name}"] = missing
    rows = np.flatnonzero(stated)
    rows = rows[longest_rising(t_ns[rows])]
    if late := int(np.count_nonzero(stated)) - len(rows):
        dropped[f"{name} out of order"] = late
    continuous = np.degrees(np.unwrap(np.radians(yaw_pitch_roll_deg[rows]), axis=0))
    between = between_refreshed_angles(t_ns[rows], continuous)
    as_logged = whatever_from(of_angles(between))
    return attitude_track(name, t_ns[rows], turned_as_stated(between), dropped, stated=as_logged)


def _clock_name(subtitles: Subtitles) -> str:
    return "the drone's clock" if subtitles.has_clock.any() else "the video's start"


def _notes(subtitles: Subtitles, height: str, moved: int, rows: int) -> list[str]:
    """List notes about the choices made and about doubtful data."""
    notes = []
    if not subtitles.has_clock.any():
        notes.append("shows no clock: its times count from the video's start")
    elif subtitles.are_slow:
        notes.append("shows whole seconds of local time, taken as UTC: let clock.sigma_s be 1")
    else:
        notes.append("its clock is the drone's local time, taken as UTC")
    notes.append(height)
    if moved:
        notes.append(f"{moved} of {rows} positions repeat the one before: taken between measurements")
    return notes


FORMAT = DjiSrtFormat()
