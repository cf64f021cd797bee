"""Reader of DJI's subtitles, which log the drone's position and the gimbal's angles beside the video.

Generations have only the form of subtitles in common. All of these are read:

- `[latitude: 41.4] [longitude: 2.2] [rel_alt: 3.6 abs_alt: 6.4] [gb_yaw: 30.0 gb_pitch: -45.0 gb_roll: 0.0]`
  (since 2018). Blanks before the colons are optional; some drones spell `longitude` as `longtitude`. Only
  enterprise models log gimbal angles. Some log one height called `altitude`, without its reference (for a
  Mavic Air 2 it is the take-off);
- `GPS(149.0251,-20.2533,16)`: longitude, latitude, satellites (until 2018), with `Hb:1.9`, `BAROMETER:20.1`
  or `H 85.80m` as height above take-off, and `F.PRY (...)`, `G.PRY (...)` as the angles of body and gimbal;
- `GPS(36.6146,-6.1120,0.0M)`: latitude, longitude, height (Matrice 300): the M tells them apart.

Angles are those of an FRD body and gimbal in NED (docs/formats.md).
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.formats.common.files import read_head
from pipelines.formats.common.rows import describe_times
from pipelines.formats.drone_logs.dji_rows import (
    DjiRows,
    any_finite,
    attitudes_of_rows,
    range_of,
    telemetry_of_rows,
)
from pipelines.formats.drone_logs.subtitles import Subtitles, parse_subtitles, read_subtitles
from pipelines.geometry.arrays import Float
from pipelines.session.telemetry import Attitudes, Telemetry, TelemetryChoice

_NUMBER = r"([-+]?\d+(?:\.\d+)?)"
_BRACKETS = re.compile(r"\[([^\[\]\n]{1,300})\]")
_PAIR = re.compile(r"([A-Za-z_]+)\s*:\s*([-+]?\d+(?:[.,]\d+)?)(?![\d/])")  # with a decimal dot or comma
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
            facts[f"{name}_deg"] = range_of(columns[name], 7)
        heights = {
            "height_above_take_off_m": "relative",
            "height_absolute_m": "absolute",
            "height_m": "altitude",
        }
        named = {label: name for label, name in heights.items() if any_finite(columns[name])}
        facts |= {label: range_of(columns[name], 3) for label, name in named.items()}
        for label, part in (("gimbal", "gb"), ("body", "drone")):
            angles = _angles(columns, part)
            if any_finite(angles):
                facts[f"{label}_angles"] = int(np.count_nonzero(np.isfinite(angles).all(axis=1)))
                facts[f"{label}_pitch_deg"] = range_of(angles[:, 1], 2)
        if not any(name.endswith("_angles") for name in facts):
            facts["orientation"] = "none: state a gimbal in the manifest"
        return facts

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:
        """Read positions, and the angles of body and gimbal if the subtitles have them.

        A position that is repeated until the next measurement is replaced by linear interpolation.
        """
        subtitles = read_subtitles(path)
        return telemetry_of_rows(path, _rows(subtitles), choice, [_note_on_clock(subtitles)])

    def read_attitudes(self, path: Path) -> Attitudes:
        """Read the gimbal's angles, also where the drone had no position."""
        subtitles = read_subtitles(path)
        found = attitudes_of_rows(path, _rows(subtitles))
        return replace(found, notes=(f"{path}: {_note_on_clock(subtitles)}",))


# --- content of a subtitle -----------------------------------------------------------------------------


def _rows(subtitles: Subtitles) -> DjiRows:
    columns = _columns(subtitles.texts)
    t_ns, timed = subtitles.times()
    return DjiRows(
        t_ns,
        timed,
        columns,
        _clock_name(subtitles),
        body=_angles(columns, "drone"),
        gimbal=_angles(columns, "gb"),
        names=("F.PRY", "its gimbal angles"),
        rows="subtitles",
    )


def _columns(texts: Sequence[str]) -> dict[str, Float]:
    """Return all columns of `_COLUMNS`, [B] each, NaN if a subtitle does not hold the value."""
    rows = [_fields(text) for text in texts]
    return {name: np.array([row.get(name, np.nan) for row in rows]) for name in _COLUMNS}


def _fields(text: str) -> dict[str, float]:
    fields: dict[str, float] = {}
    for bracket in _BRACKETS.findall(text):
        for key, number in _PAIR.findall(bracket):
            name = key.lower()
            fields[_HEIGHTS.get(name) or _NAMES.get(name, name)] = float(number.replace(",", "."))
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


def _angles(columns: Mapping[str, Float], part: str) -> Float:
    """Return yaw, pitch, roll [B, 3] in degrees; a missing roll is 0."""
    yaw, pitch, roll = (columns[f"{part}_{angle}"] for angle in ("yaw", "pitch", "roll"))
    return np.stack(
        [yaw, pitch, np.where(np.isnan(roll), np.where(np.isnan(yaw), np.nan, 0.0), roll)], axis=1
    )


def _clock_name(subtitles: Subtitles) -> str:
    return "the drone's clock" if subtitles.has_clock.any() else "the video's start"


def _note_on_clock(subtitles: Subtitles) -> str:
    if not subtitles.has_clock.any():
        return "shows no clock: its times count from the video's start"
    if subtitles.are_slow:
        return "shows whole seconds of local time, taken as UTC: let clock.sigma_s be 1"
    return "its clock is the drone's local time, taken as UTC"


FORMAT = DjiSrtFormat()
