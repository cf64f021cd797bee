"""Tags of pictures: times and places in EXIF, and drones' angles, heights and RTK in XMP.

EXIF is that of JPEG and PNG (CIPA DC-008): the local time without its zone is taken as UTC, as for subtitles,
unless the offset is there. XMP has DJI's names (`drone-dji:GimbalYawDegree`, ...), as attributes or elements.
Autel has the same names behind `drone:`, Parrot its own (`drone-parrot:CameraYawDegree`), Skydio angles in
`drone-skydio:CameraOrientationNED`, as OpenAthena and OpenDroneMap read them. All count yaw from north to
east and pitch up from the horizon.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Int64

SUFFIXES = (".jpg", ".jpeg", ".png")
_HEAD = 512 * 1024  # bytes in which cameras write XMP
_SECOND_NS = 1_000_000_000
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_TAG = re.compile(rb"(?<![\w/-])drone(?:-(?:dji|parrot|skydio))?:(\w+)(?:=\"|>)\s*([^\"<]{1,60})")
_SKYDIO = re.compile(
    rb"(?s)<drone-skydio:CameraOrientationNED\b(.{1,600}?)(?:/>|</drone-skydio:CameraOrientationNED)"
)
_ANGLE = re.compile(rb"[<\s][\w-]+:(Yaw|Pitch|Roll)(?:=\"|>)\s*([^\"<]{1,60})")
_EXIF, _GPS = 0x8769, 0x8825
_TAKEN, _OFFSET, _SUBSECOND = 36867, 36881, 37521
NAMES = {
    "latitude": ("GpsLatitude", "Latitude"),
    "longitude": ("GpsLongitude", "GpsLongtitude", "Longitude"),
    "relative": ("RelativeAltitude",),
    "absolute": ("AbsoluteAltitude",),
    "gb_yaw": ("GimbalYawDegree", "CameraYawDegree"),
    "gb_pitch": ("GimbalPitchDegree", "CameraPitchDegree"),
    "gb_roll": ("GimbalRollDegree", "CameraRollDegree"),
    "drone_yaw": ("FlightYawDegree", "DroneYawDegree"),
    "drone_pitch": ("FlightPitchDegree", "DronePitchDegree"),
    "drone_roll": ("FlightRollDegree", "DroneRollDegree"),
    "rtk_flag": ("RtkFlag",),
    "rtk_std_latitude": ("RtkStdLat",),
    "rtk_std_longitude": ("RtkStdLon",),
    "rtk_std_height": ("RtkStdHgt",),
}


@dataclass(frozen=True)
class Tags:
    """Tags of one picture; `values` has the columns of `NAMES` that it states."""

    t_ns: int | None
    values: Mapping[str, float] = field(default_factory=dict)


def picture_files(folder: Path) -> list[Path]:
    """Return the pictures of a folder in the order of the numbers in their names; empty for other folders.

    Pictures must be at least half of its files, so that one picture among logs makes no sequence.
    """
    try:
        files = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    except OSError:
        return []
    found = [path for path in files if path.suffix.lower() in SUFFIXES]
    if len(found) < 2 or 2 * len(found) < len(files):
        return []
    return sorted(found, key=lambda path: [(int(part), "") if part.isdecimal() else (-1, part)
                                           for part in re.split(r"(\d+)", path.name)])  # fmt: skip


def read_tags(path: Path) -> Tags:
    """Read a picture's tags; one without them, or a damaged one, has none."""
    from PIL import Image

    try:
        with path.open("rb") as file:
            xmp = _xmp(file.read(_HEAD))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of damaged tags; the others are taken
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # no picture is decoded here
            with Image.open(path) as picture:
                exif = picture.getexif()
                taken, gps = dict(exif.get_ifd(_EXIF)), dict(exif.get_ifd(_GPS))
    except (OSError, ValueError, SyntaxError, TypeError, KeyError, Image.DecompressionBombError):
        return Tags(None)
    values = _from_gps(gps)
    for column, names in NAMES.items():
        for name in names:
            number = _number(xmp.get(name))
            if number is not None:
                values[column] = number
    return Tags(_taken_ns(taken), values)


def picture_times(tags: Sequence[Tags]) -> tuple[Int64, bool]:
    """Return the time of each picture, ns [N], 0 where it states none; True if some share a whole second.

    Cameras without parts of seconds give all pictures of a second one time. These are spread evenly over it,
    as many in the first and the last second as usual.
    """
    t_ns = np.array([each.t_ns or 0 for each in tags], dtype=np.int64)
    steps = np.diff(t_ns)
    if not t_ns.all() or (steps > 0).all() or (steps < 0).any() or (t_ns % _SECOND_NS).any():
        return t_ns, False
    _, second, counts = np.unique(t_ns, return_inverse=True, return_counts=True)
    usual = round(float(np.median(counts[1:-1]))) if len(counts) > 2 else int(counts.max())
    room = counts.copy()
    room[[0, -1]] = np.maximum(counts[[0, -1]], usual)
    before = np.arange(len(t_ns)) - (np.cumsum(counts) - counts)[second]  # pictures of the same second
    before += np.where(second == 0, room[0] - counts[0], 0)  # the first second is full at its end
    spread: Int64 = t_ns + (before * _SECOND_NS // room[second]).astype(np.int64)
    return spread, True


def _xmp(head: bytes) -> dict[str, str]:
    """Return the text of each tag by its name without the maker; Skydio's angles under DJI's names."""
    found = _TAG.findall(head)
    if skydio := _SKYDIO.search(head):
        found += [(b"Camera" + angle + b"Degree", text) for angle, text in _ANGLE.findall(skydio[1])]
    return {name.decode(): text.decode("latin-1") for name, text in found}


def _number(text: object) -> float | None:
    try:
        value = float(str(text))
    except ValueError:
        return None
    return value if np.isfinite(value) else None


def _taken_ns(exif: Mapping[int, Any]) -> int | None:
    try:
        taken = datetime.strptime(str(exif[_TAKEN])[:19], "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    except (KeyError, ValueError):
        return None
    digits = re.sub(r"\D", "", str(exif.get(_SUBSECOND, "")))[:9]
    offset = re.fullmatch(r"([+-])(\d\d):(\d\d)", str(exif.get(_OFFSET, "")).strip("\0 "))
    if offset:
        ahead = timedelta(hours=int(offset[2]), minutes=int(offset[3]))
        taken -= ahead if offset[1] == "+" else -ahead
    return (taken - _EPOCH) // timedelta(seconds=1) * 10**9 + int(digits.ljust(9, "0") or 0)


def _from_gps(gps: Mapping[int, Any]) -> dict[str, float]:
    """Return latitude, longitude and height of EXIF's own GPS tags."""
    values: dict[str, float] = {}
    for column, sign, tag in (("latitude", "S", 1), ("longitude", "W", 3)):
        try:
            degrees, minutes, seconds = (float(part) for part in gps[tag + 1])
        except (KeyError, TypeError, ValueError, ZeroDivisionError):
            continue
        angle = degrees + minutes / 60 + seconds / 3600
        if np.isfinite(angle):
            values[column] = -angle if str(gps.get(tag, "")).startswith(sign) else angle
    height = _number(gps.get(6))
    if height is not None:
        below = gps.get(5) in (1, b"\x01")
        values["absolute"] = -height if below else height
    return values
