"""MISB KLV (ST 0601, STANAG 4609) in a video or in a file of its own: positions, attitudes, angle of view.

A packet is a universal key of 16 bytes, its length (BER), and items of tag (BER-OID), length and value; the
last is a checksum, the sum of all 16-bit words before it. Angles and heights are integers mapped to a range.
The most negative signed integer says that a value is out of its range. The tags are those of ST 0601.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipelines.formats.common.files import first_bytes
from pipelines.formats.drone_logs.telemetry_rows import (
    attitude_track,
    of_angles,
    position_track,
    turned_as_stated,
    whatever_from,
)
from pipelines.formats.drone_logs.video_tracks import has_track, track_packets
from pipelines.geometry.arrays import Float, Int64
from pipelines.session.errors import DataError
from pipelines.session.telemetry import AttitudeTrack, Height, Telemetry, TelemetryChoice

_KEY = bytes.fromhex("060E2B34020B01010E01030101000000")
_CHECKSUM, _TIME = 1, 2

# Tag: bytes, signed, smallest and largest value. Of two tags of one column, the later one is finer.
_TAGS: dict[int, tuple[str, int, bool, float, float]] = {
    5: ("yaw", 2, False, 0, 360),
    6: ("pitch", 2, True, -20, 20),
    7: ("roll", 2, True, -50, 50),
    13: ("latitude", 4, True, -90, 90),
    14: ("longitude", 4, True, -180, 180),
    15: ("sea", 2, False, -900, 19000),
    16: ("across", 2, False, 0, 180),
    18: ("azimuth", 4, False, 0, 360),
    19: ("elevation", 4, True, -180, 180),
    20: ("turn", 4, False, 0, 360),
    75: ("ellipsoid", 2, False, -900, 19000),
    90: ("pitch", 4, True, -90, 90),
    91: ("roll", 4, True, -90, 90),
}
_COLUMNS = tuple(dict.fromkeys(name for name, *_ in _TAGS.values()))


@dataclass
class _Packets:
    """Values of all packets of a file."""

    t_ns: list[int] = field(default_factory=list)  # UTC
    video_ns: list[int] = field(default_factory=list)  # of the same packets in the video; -1 outside one
    rows: list[dict[str, float]] = field(default_factory=list)
    dropped: Counter[str] = field(default_factory=Counter)

    def columns(self) -> dict[str, Float]:
        """Return all columns [N] by name, NaN where a packet does not hold the value."""
        return {name: np.array([row.get(name, np.nan) for row in self.rows]) for name in _COLUMNS}


class KlvFormat:
    """Reader of MISB ST 0601: the sensor's position, the platform's attitude, the sensor's angles in it."""

    name = "klv"
    title = "MISB KLV (ST 0601)"
    suffixes: tuple[str, ...] = (".klv", ".ts", ".mts", ".m2ts", ".mpg", ".mpeg", ".mp4", ".mov")

    def recognises(self, path: Path) -> bool:
        """Return True for a file that begins with the key, or a video with a data track of such packets."""
        return _is_bare(path) or has_track(path, _has_key)

    def describe(self, path: Path) -> dict[str, object]:
        """Describe packets, times, ranges of the values, and when the video began by them."""
        found = _read(path)
        columns = found.columns()
        facts: dict[str, object] = {
            "packets": len(found.rows),
            "positions": int(np.count_nonzero(np.isfinite(columns["latitude"]))),
            "clock": "UTC",
        }
        if (start_ns := _video_start_ns(found)) is not None:
            facts["video_began_s"] = round(start_ns / 1e9, 3)
        labels = {
            "latitude": "latitude_deg",
            "longitude": "longitude_deg",
            "sea": "height_above_sea_m",
            "ellipsoid": "height_above_ellipsoid_m",
            "yaw": "heading_deg",
            "pitch": "pitch_deg",
            "roll": "roll_deg",
            "azimuth": "sensor_azimuth_deg",
            "elevation": "sensor_elevation_deg",
            "across": "angle_of_view_deg",
        }
        for name, label in labels.items():
            finite = columns[name][np.isfinite(columns[name])]
            if len(finite):
                facts[label] = [round(float(v), 7) for v in (finite.min(), finite.max())]
        return facts | {f"dropped: {cause}": count for cause, count in found.dropped.items()}

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:  # noqa: ARG002 - the protocol's
        """Read the sensor's position, the platform's attitude and the sensor's angles, at UTC.

        Heights are above the ellipsoid if all positions have them, else above the sea.

        Raises:
            DataError: no packet of ST 0601, or no position with a height in any.
        """
        found = _read(path)
        columns, dropped = found.columns(), dict(found.dropped)
        t_ns = np.array(found.t_ns, dtype=np.int64)
        there = np.isfinite(columns["latitude"])
        level: Height = "ellipsoid" if np.isfinite(columns["ellipsoid"][there]).all() else "sea level"
        height = columns["ellipsoid" if level == "ellipsoid" else "sea"]
        position = position_track(
            path,
            "the sensor's position",
            t_ns,
            np.stack([columns["latitude"], columns["longitude"], height], axis=1),
            dropped,
            on_earth=True,
            height=level,
            unusable={"no position": ~there},
        )
        body, gimbal = (
            _angles(columns, names) for names in (("yaw", "pitch", "roll"), ("azimuth", "elevation", "turn"))
        )
        looking = np.isfinite(gimbal).all(axis=1)
        notes = []
        if (start_ns := _video_start_ns(found)) is not None:
            notes.append(f"{path}: the video began at {start_ns / 1e9:.3f} by the times of its packets")
        return Telemetry(
            position=position,
            body=_of_rows(t_ns, body, dropped),
            gimbal=attitude_track(
                "the sensor's angles",
                t_ns[looking],
                turned_as_stated(gimbal[looking], relative_to="body"),
                dropped,
                relative_to="body",
                stated=whatever_from(of_angles(gimbal[looking])),
            ),
            clock="UTC",
            notes=tuple(notes),
            dropped=dropped,
            video_began=None if start_ns is None else (start_ns, 0.0),
        )


def _of_rows(t_ns: Int64, angles_deg: Float, dropped: dict[str, int]) -> AttitudeTrack | None:
    known = np.isfinite(angles_deg).all(axis=1)
    return attitude_track(
        "the platform's attitude", t_ns[known], turned_as_stated(angles_deg[known]), dropped
    )


def _angles(columns: dict[str, Float], names: tuple[str, str, str]) -> Float:
    """Return yaw, pitch, roll [N, 3] in degrees; a missing roll is 0."""
    yaw, pitch, roll = (columns[name] for name in names)
    return np.stack([yaw, pitch, np.where(np.isnan(roll), 0.0, roll)], axis=1)


def _video_start_ns(found: _Packets) -> int | None:
    """Return when the video began: the median of the packets' UTC less their time in the video."""
    began = [t - at for t, at in zip(found.t_ns, found.video_ns, strict=True) if at >= 0]
    return int(np.median(np.array(began, dtype=np.int64) - began[0])) + began[0] if began else None


def _is_bare(path: Path) -> bool:
    return first_bytes(path, len(_KEY)) == _KEY


def _has_key(content: bytes) -> bool:
    return _KEY in content[:64]


def _contents(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield the time in the video (ns, -1 outside one) and the bytes of each packet of the container."""
    if _is_bare(path):
        yield -1, path.read_bytes()
        return
    for start_ns, _, content in track_packets(path, _has_key):
        yield start_ns, content


def _read(path: Path) -> _Packets:
    found = _Packets()
    for at_ns, content in _contents(path):
        place = content.find(_KEY)
        while place >= 0:
            after = _take(found, at_ns, content, place)
            place = content.find(_KEY, after)
    if not found.rows:
        raise DataError(path, "holds no packet of MISB ST 0601", "name another log of poses")
    return found


def _take(found: _Packets, at_ns: int, content: bytes, place: int) -> int:
    """Add the packet at a place; return where to look for the next one."""
    inside = place + len(_KEY)
    try:
        size, begin = _length(content, inside)
        end = begin + size
        if end > len(content):
            raise ValueError("breaks off")
        items = dict(_items(content[begin:end]))
    except ValueError:
        found.dropped["damaged packets"] += 1
        return inside
    said = items.get(_CHECKSUM)
    if said is not None and int.from_bytes(said) != _sum(content[place : end - 2]):
        found.dropped["packets with a wrong checksum"] += 1
        return inside
    if len(items.get(_TIME, b"")) != 8 or not (t_us := int.from_bytes(items[_TIME])) < 2**53:
        found.dropped["packets without a time"] += 1
        return end
    row: dict[str, float] = {}
    for tag, (name, size, signed, low, high) in _TAGS.items():
        value = items.get(tag, b"")
        if len(value) == size:
            row[name] = _mapped(int.from_bytes(value, signed=signed), size, signed, low, high)
    found.t_ns.append(t_us * 1000)
    found.video_ns.append(at_ns)
    found.rows.append(row)
    return end


def _mapped(number: int, size: int, signed: bool, low: float, high: float) -> float:
    if not signed:
        return low + number * (high - low) / ((1 << 8 * size) - 1)
    most = (1 << (8 * size - 1)) - 1
    return np.nan if number < -most else number * high / most


def _items(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield tag and value of each item; raise ValueError where they do not fit."""
    place, end = 0, len(content)
    while place < end:
        tag = 0
        while True:
            if place >= end:
                raise ValueError("breaks off")
            byte = content[place]
            tag, place = (tag << 7 | byte & 0x7F) & 0xFFFF, place + 1
            if byte < 0x80:
                break
        size, place = _length(content, place)
        if place + size > end:
            raise ValueError("breaks off")
        yield tag, content[place : place + size]
        place += size


def _length(content: bytes, place: int) -> tuple[int, int]:
    """Return a length (BER, short or long form) and where it ends; raise ValueError where it breaks off."""
    if place >= len(content):
        raise ValueError("breaks off")
    first = content[place]
    if first < 0x80:
        return first, place + 1
    count = first & 0x7F
    if not 1 <= count <= 4 or place + 1 + count > len(content):
        raise ValueError("a length of another form")
    return int.from_bytes(content[place + 1 : place + 1 + count]), place + 1 + count


def _sum(content: bytes) -> int:
    """Return the checksum of ST 0601: bytes at even places count 256 times."""
    numbers = np.frombuffer(content, np.uint8).astype(np.int64)
    return int((numbers[::2].sum() * 256 + numbers[1::2].sum()) % 65536)


FORMAT = KlvFormat()
