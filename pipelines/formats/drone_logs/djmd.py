"""DJI's telemetry track (djmd) inside a video: one message of protobuf for each picture.

DJI publishes no definition. The numbers of the fields are those of ExifTool's tables (Image::ExifTool::DJI),
by the protocol that the first message names (`dvtm_Air3s.proto`). Field 3 is the picture. In it are a
position (`GPSInfo`: 1 unit, 2 latitude, 3 longitude, in radians unless the unit is 1), the height absolute
(mm) and above the take-off (mm), and angles in tenths of a degree: of the body as roll, pitch, yaw and of
the gimbal as pitch, roll, yaw. A field that is 0 is left out, as everywhere in protobuf.

The track has no date. Its times are those of the video, from its time of creation on.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.formats.drone_logs.dji_rows import (
    DjiRows,
    any_finite,
    attitudes_of_rows,
    range_of,
    telemetry_of_rows,
)
from pipelines.formats.drone_logs.video_tracks import (
    Place,
    field_at,
    has_track,
    real_number,
    signed_number,
    track_packets,
    video_made_ns,
)
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.telemetry import Attitudes, Telemetry, TelemetryChoice

_PROTOCOL = re.compile(rb"dvtm_[A-Za-z0-9_-]{1,40}\.proto")
_PICTURE = 3
_OTHER_WAY = "turn on subtitles on the drone and name the .SRT, or name a flight record: pose: {dji: ...}"


@dataclass(frozen=True)
class _Layout:
    """Places of the fields in the message of a picture; None where the tables name none."""

    position: Place = (3, 4)
    relative: Place | None = (3, 5, 1)
    body: Place | None = (3, 3)
    gimbal: Place | None = (4, 3)
    degrees: bool = False  # whatever the unit says


_DRONE = _Layout()
_RACER = _Layout(position=(4, 4), relative=(4, 5, 1), body=(4, 3), gimbal=None)
_HAND = _Layout(position=(4, 2), relative=None, body=None, gimbal=None)
_LAYOUTS = {
    **dict.fromkeys(("Mini4_Pro", "Air3", "Air3s", "wm265e", "wm261", "pm320", "wa345e"), _DRONE),
    **dict.fromkeys(("AVATA2", "dji_neo"), _RACER),
    **dict.fromkeys(("ac203", "ac204", "ac206", "oq101"), _HAND),
    "Mavic4": _Layout(gimbal=None, degrees=True),
    "Mini5Pro": _Layout(relative=None, body=None, gimbal=None, degrees=True),
}


class DjiVideoFormat:
    """Reader of the positions and angles in a DJI drone's video, for the models whose fields are public."""

    name = "dji_video"
    title = "DJI telemetry (djmd, in a video)"
    suffixes: tuple[str, ...] = (".mp4", ".mov")

    def recognises(self, path: Path) -> bool:
        """Return True if a video has a data track whose first message names a protocol of DJI's."""
        return has_track(path, _names_a_protocol)

    def describe(self, path: Path) -> dict[str, object]:
        """Describe the model's protocol, and ranges of positions, heights and angles."""
        protocol, rows = _read(path)
        columns = rows.columns
        facts: dict[str, object] = {
            "protocol": protocol,
            "messages": len(rows.t_ns),
            "positions": int(np.count_nonzero(np.isfinite(columns["latitude"]))),
            "clock": rows.clock,
        }
        for label, name, decimals in (
            ("latitude_deg", "latitude", 7),
            ("longitude_deg", "longitude", 7),
            ("height_above_take_off_m", "relative", 3),
            ("height_absolute_m", "absolute", 3),
        ):
            if any_finite(columns[name]):
                facts[label] = range_of(columns[name], decimals)
        for label, angles in (("gimbal", rows.gimbal), ("body", rows.body)):
            if any_finite(angles):
                facts[f"{label}_angles"] = int(np.count_nonzero(np.isfinite(angles).all(axis=1)))
                facts[f"{label}_pitch_deg"] = range_of(angles[:, 1], 2)
        return facts | {f"dropped: {cause}": count for cause, count in rows.dropped.items()}

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:
        """Read positions, and the angles of body and gimbal where the model's fields are public.

        Raises:
            DataError: no such track, a model whose fields are not public, no position, or no height.
        """
        _, rows = _read(path)
        dated = rows.clock != "the video's start"
        made = "its times count from the video's time of creation, whole seconds: let clock.sigma_s be 1"
        notes = [made if dated else "its times count from the video's start"]
        telemetry = telemetry_of_rows(path, rows, choice, notes)
        return replace(telemetry, video_began=(video_made_ns(path) or 0, 1.0 if dated else 0.0))

    def read_attitudes(self, path: Path) -> Attitudes:
        """Read the gimbal's angles, also where the drone had no position.

        Raises:
            DataError: no such track, a model whose fields are not public, or no angles.
        """
        return attitudes_of_rows(path, _read(path)[1], video_made_ns(path) or 0)


def _names_a_protocol(content: bytes) -> bool:
    return _PROTOCOL.search(content[:4096]) is not None


def _read(path: Path) -> tuple[str, DjiRows]:
    """Return the name of the protocol and the rows of all messages.

    Raises:
        DataError: no such track, or a protocol that the tables do not have.
    """
    protocol, layout = "", _DRONE
    at_ns: list[int] = []
    rows: list[list[float]] = []
    dropped: Counter[str] = Counter()
    for start_ns, _, content in track_packets(path, _names_a_protocol):
        if not protocol:
            protocol, layout = _layout_of(path, content)
        try:
            picture = field_at(content, (_PICTURE,))
            row = _row(picture, layout) if isinstance(picture, bytes) else [np.nan] * 10
        except ValueError:
            dropped["damaged messages"] += 1
            continue
        at_ns.append(start_ns)
        rows.append(row)
    if not protocol:
        raise DataError(path, "has no track of DJI's telemetry", _OTHER_WAY)
    table = np.array(rows, dtype=np.float64).reshape(-1, 10)
    names = ("latitude", "longitude", "relative", "absolute")
    columns = dict(zip(names, table.T[:4], strict=True)) | {"altitude": np.full(len(table), np.nan)}
    made_ns = video_made_ns(path)
    return protocol, DjiRows(
        np.array(at_ns, dtype=np.int64) + (made_ns or 0),
        np.ones(len(table), dtype=np.bool_),
        columns,
        "the video's start" if made_ns is None else "the video's time of creation",
        body=_filled(table[:, 4:7]),
        gimbal=_filled(table[:, 7:10]),
        rows="messages",
        dropped=dropped,
    )


def _layout_of(path: Path, content: bytes) -> tuple[str, _Layout]:
    named = _PROTOCOL.search(content)
    protocol = named[0].decode().removesuffix(".proto") if named else ""
    layout = _LAYOUTS.get(protocol.removeprefix("dvtm_"))
    if layout is None:
        raise DataError(path, f"holds DJI's telemetry as {protocol}, whose fields are not public", _OTHER_WAY)
    return protocol, layout


def _filled(angles_deg: Float) -> Float:
    """Return angles [N, 3] of which none is measured if all are 0: a model without them logs zeros."""
    return angles_deg if np.nan_to_num(angles_deg).any() else np.full_like(angles_deg, np.nan)


def _row(picture: bytes, layout: _Layout) -> list[float]:
    """Return latitude, longitude (deg), heights (m), and yaw, pitch, roll (deg) of body and gimbal.

    Raises:
        ValueError: the message is damaged.
    """
    latitude = longitude = relative = absolute = np.nan
    place = field_at(picture, (*layout.position, 1))
    if isinstance(place, bytes):
        unit = field_at(place, (1,))
        scale = 1.0 if layout.degrees or unit == 1 else 180.0 / np.pi
        latitude, longitude = (real_number(field_at(place, (number,))) * scale for number in (2, 3))
        if latitude == longitude == 0:  # no fix
            latitude = longitude = np.nan
    if isinstance(height := field_at(picture, (*layout.position, 2)), int):
        absolute = signed_number(height) / 1000
    if layout.relative and field_at(picture, layout.relative[:-1]) is not None:
        relative = real_number(field_at(picture, layout.relative) or bytes(4)) / 1000
    body = _angles(picture, layout.body, (3, 2, 1))
    return [latitude, longitude, relative, absolute, *body, *_angles(picture, layout.gimbal, (3, 1, 2))]


def _angles(picture: bytes, place: Place | None, order: tuple[int, int, int]) -> list[float]:
    """Return yaw, pitch, roll (deg) whose fields have these numbers; NaN without the message."""
    inner = field_at(picture, place) if place else None
    if not isinstance(inner, bytes):
        return [np.nan] * 3
    values = [field_at(inner, (number,)) or 0 for number in order]
    return [signed_number(value) / 10 if isinstance(value, int) else np.nan for value in values]


FORMAT = DjiVideoFormat()
