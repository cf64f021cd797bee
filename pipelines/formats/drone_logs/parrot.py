"""Parrot's telemetry track inside a video: positions, and attitudes of the body and of the pictures' view.

There is one record for each picture (Parrot's libvideo-metadata; ExifTool's tables name the same places of
versions 2 and 3). Quaternions turn an FRD body, or the FRD view of the picture, into north, east, down.

- `P2`, `P3` (until ANAFI): big-endian numbers behind the record's name and its length in words of four bytes.
- Since ANAFI Ai: messages of protobuf without a name (vmeta.proto, `TimedMetadata`), known by their fields.
  In them, the camera (2) has the UTC of the picture (10, us, if its accuracy, 11, is not 0) and the view (3);
  the drone (1) has its attitude (1) and its location (2). An empty sample may stand before the first.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.formats.drone_logs.telemetry_rows import attitude_track, position_track
from pipelines.formats.drone_logs.video_tracks import (
    field_at,
    fields_of,
    has_track,
    real_number,
    track_packets,
    video_made_ns,
)
from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.mounting import attitude_in_enu
from pipelines.session.errors import DataError
from pipelines.session.telemetry import Attitudes, AttitudeTrack, Height, Telemetry, TelemetryChoice

# Latitude, longitude, height with the number of satellites; w, x, y, z of the body and of the picture's view.
_RECORDS = {b"P2": struct.Struct(">8x3i8x8h12x"), b"P3": struct.Struct(">8x3i8x4h8x4h20x")}
_DEGREE, _METRE, _WHOLE = 1 << 22, 1 << 8, 1 << 14

_EMPTY = b"_ATEMON_"  # a sample that only holds a time open
_PARTS = range(1, 11)  # numbers of the fields of TimedMetadata, which are all messages
_DRONE, _CAMERA = 1, 2
_LATITUDE, _LONGITUDE, _ELLIPSOID, _SEA = 1, 2, 3, 7  # of a location
_START = "the video's start"
_UNIT = 0.01  # by how much the length of a quaternion may differ from 1


@dataclass(frozen=True)
class _Row:
    """Content of one record; NaN or 0 for what it does not state."""

    latitude_deg: float
    longitude_deg: float
    sea_m: float
    ellipsoid_m: float
    body_xyzw: tuple[float, ...]
    view_xyzw: tuple[float, ...]
    utc_ns: int = 0


@dataclass(frozen=True)
class _Track:
    """Content of all records."""

    version: str
    t_ns: Int64  # [N]
    places: Float  # [N, 3] latitude and longitude, deg, and height, m; NaN where none is known
    height: Height
    body: Float  # [N, 4] quaternions xyzw in north, east, down; 0 where the drone states none
    view: Float  # [N, 4] likewise, of the picture
    clock: str
    began_ns: int | None  # when the video began, if the records state UTC
    made_ns: int | None  # else its time of creation
    dropped: Counter[str]


class ParrotVideoFormat:
    """Reader of the positions and attitudes in the videos of Parrot's drones."""

    name = "parrot"
    title = "Parrot's telemetry (in a video)"
    suffixes: tuple[str, ...] = (".mp4", ".mov")

    def recognises(self, path: Path) -> bool:
        """Return True if a video has a data track that begins with a record of Parrot's."""
        return has_track(path, _is_record)

    def describe(self, path: Path) -> dict[str, object]:
        """Describe the version, the number of records, and ranges of positions and of the view's pitch."""
        track = _read(path)
        there = np.isfinite(track.places).all(axis=1)
        facts: dict[str, object] = {
            "version": track.version,
            "records": len(track.places),
            "positions": int(np.count_nonzero(there)),
            "clock": track.clock,
        }
        if track.began_ns is not None:
            facts["video_began_s"] = round(track.began_ns / 1e9, 3)
        level = "sea" if track.height == "sea level" else "ellipsoid"
        labels = (("latitude_deg", 7), ("longitude_deg", 7), (f"height_above_{level}_m", 3))
        for (label, decimals), values in zip(labels, track.places[there].T, strict=True):
            if there.any():
                facts[label] = [round(float(v), decimals) for v in (values.min(), values.max())]
        if (turned := track.view[np.linalg.norm(track.view, axis=1) > 0.5]).size:
            x, y, z, w = turned.T
            pitch = np.degrees(np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)))
            facts["view_pitch_deg"] = [round(float(v), 2) for v in (pitch.min(), pitch.max())]
        return facts | {f"dropped: {cause}": count for cause, count in track.dropped.items()}

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:  # noqa: ARG002 - the protocol's
        """Read positions, the body's attitude, and that of the pictures' view in the world.

        Heights are above the sea; those of protobuf above the ellipsoid if one of them lacks that of the sea.

        Raises:
            DataError: no such track, or no position in any record.
        """
        track = _read(path)
        dropped = dict(track.dropped)
        position = position_track(
            path,
            "its GPS",
            track.t_ns,
            track.places,
            dropped,
            on_earth=True,
            height=track.height,
            unusable={"no position": np.asarray(~np.isfinite(track.places).all(axis=1))},
        )
        body = attitude_in_enu(track.body, relative_to="world", axes="ned")
        if track.began_ns is not None:
            note = f"{path}: the video began at {track.began_ns / 1e9:.3f} by the times of its records"
        else:
            remedy = ", whole seconds: let clock.sigma_s be 1" if track.clock != _START else ""
            note = f"{path}: its times count from {track.clock}{remedy}"
        return Telemetry(
            position=position,
            body=attitude_track("its body's attitude", track.t_ns, body, dropped),
            gimbal=_view_of(track, dropped),
            clock=track.clock,
            notes=(note,),
            dropped=dropped,
            video_began=(track.made_ns or 0, 1.0) if track.began_ns is None else (track.began_ns, 0.0),
        )

    def read_attitudes(self, path: Path) -> Attitudes:
        """Read the attitude of the pictures' view, also where the drone had no position.

        Raises:
            DataError: no such track, or no attitude in any record.
        """
        track = _read(path)
        dropped = dict(track.dropped)
        view = _view_of(track, dropped)
        if view is None:
            raise DataError(path, "holds no attitude of its pictures", "name gimbal angles of another log")
        began_ns = (track.made_ns or 0) if track.began_ns is None else track.began_ns
        return Attitudes(replace(view, dropped=dropped), track.clock, video_began_ns=began_ns)


def _view_of(track: _Track, dropped: dict[str, int]) -> AttitudeTrack | None:
    view = attitude_in_enu(track.view, relative_to="world", axes="ned")
    return attitude_track("its pictures' view", track.t_ns, view, dropped, stated={"world": track.view})


def _is_record(content: bytes) -> bool:
    return content == _EMPTY or _version(content) != ""


def _version(content: bytes) -> str:
    """Return P2, P3 or protobuf; empty for other bytes."""
    if (record := _RECORDS.get(content[:2])) is not None:
        words = int.from_bytes(content[2:4])
        return content[:2].decode() if record.size <= 4 + 4 * words <= len(content) else ""
    try:
        numbered = all(number in _PARTS and isinstance(part, bytes) for number, part in fields_of(content))
        row = _of_message(content) if numbered else None
    except ValueError:
        return ""
    lengths = [np.linalg.norm(each) for each in (row.body_xyzw, row.view_xyzw)] if row else []
    return "protobuf" if any(abs(length - 1) < _UNIT for length in lengths) else ""


def _of_record(content: bytes) -> _Row:
    values = _RECORDS[content[:2]].unpack_from(content)
    body, view = (tuple(part / _WHOLE for part in _xyzw(values[k : k + 4])) for k in (3, 7))
    latitude, longitude = (value / _DEGREE for value in values[:2])
    sea_m = (values[2] >> 8) / _METRE  # the low byte counts satellites
    return _Row(latitude, longitude, sea_m, np.nan, body, view)


def _of_message(content: bytes) -> _Row:
    """Return the content of a message.

    Raises:
        ValueError: it is damaged.
    """
    drone, camera = (_message(content, (number,)) for number in (_DRONE, _CAMERA))
    place = _message(drone, (2,)) or _message(camera, (13,))
    degrees = [
        real_number(field_at(place, (number,))) if place else np.nan for number in (_LATITUDE, _LONGITUDE)
    ]
    heights = [real_number(field_at(place, (number,))) or np.nan for number in (_SEA, _ELLIPSOID)]
    quaternions = [_message(drone, (1,)), _message(camera, (3,))]
    body, view = (
        _xyzw(tuple(real_number(field_at(each, (number,))) for number in (1, 2, 3, 4)))
        for each in quaternions
    )
    utc_us = field_at(camera, (10,)) if field_at(camera, (11,)) else 0
    if not isinstance(utc_us, int) or utc_us >= 2**53:
        raise ValueError("states no time")
    return _Row(degrees[0], degrees[1], heights[0], heights[1], body, view, utc_us * 1000)


def _message(content: bytes, place: tuple[int, ...]) -> bytes:
    found = field_at(content, place)
    return found if isinstance(found, bytes) else b""


def _number(content: bytes, number: int) -> float:
    return real_number(field_at(content, (number,)))


def _xyzw(wxyz: tuple[float, ...]) -> tuple[float, ...]:
    return (*wxyz[1:], wxyz[0])


def _read(path: Path) -> _Track:
    """Read all records.

    Raises:
        DataError: no such track.
    """
    version = ""
    dropped: Counter[str] = Counter()
    at: list[int] = []
    rows: list[_Row] = []
    for start_ns, _, content in track_packets(path, _is_record):
        if content == _EMPTY:
            continue
        try:
            found = version if version == "protobuf" else _version(content)
            if not found or (version and found != version):
                raise ValueError("is no record")
            row = _of_message(content) if found == "protobuf" else _of_record(content)
        except ValueError:
            dropped["damaged records"] += 1
            continue
        version = found
        at.append(start_ns)
        rows.append(row)
    if not rows:
        raise DataError(path, "has no track of Parrot's telemetry", "name another log of poses")
    at_ns = np.array(at, dtype=np.int64)
    places = np.array([(row.latitude_deg, row.longitude_deg) for row in rows])
    outside = (np.abs(places[:, 0]) > 90) | (np.abs(places[:, 1]) > 180)  # 500 says that there is none
    places[outside | ~places.any(axis=1)] = np.nan
    heights = np.array([(row.sea_m, row.ellipsoid_m) for row in rows])
    by_sea = bool(np.isfinite(heights[np.isfinite(places[:, 0]), 0]).all())
    made_ns = video_made_ns(path)
    t_ns, clock, began_ns = _times(at_ns, np.array([row.utc_ns for row in rows], dtype=np.int64), made_ns)
    return _Track(
        version=version,
        t_ns=t_ns,
        places=np.column_stack([places, heights[:, 0 if by_sea else 1]]),
        height="sea level" if by_sea else "ellipsoid",
        body=np.array([row.body_xyzw for row in rows]),
        view=np.array([row.view_xyzw for row in rows]),
        clock=clock,
        began_ns=began_ns,
        made_ns=made_ns,
        dropped=dropped,
    )


def _times(at_ns: Int64, utc_ns: Int64, made_ns: int | None) -> tuple[Int64, str, int | None]:
    """Return the times of records [N], their clock, and when the video began if they state UTC (0: no).

    A record without UTC is where its time in the video puts it among the others.
    """
    if len(stated := np.flatnonzero(utc_ns)):
        began = utc_ns[stated] - at_ns[stated]
        began_ns = int(np.median(began - began[0])) + int(began[0])
        return np.where(utc_ns > 0, utc_ns, at_ns + began_ns), "UTC", began_ns
    return at_ns + (made_ns or 0), _START if made_ns is None else "the video's time of creation", None


FORMAT = ParrotVideoFormat()
