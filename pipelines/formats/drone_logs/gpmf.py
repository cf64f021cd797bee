"""GoPro's telemetry track (GPMF) inside a video: positions by GPS, and a Karma drone's own flight data.

Layout (GoPro, "GPMF Introduction"): key of four letters, type, size of a structure, number of structures,
then big-endian values padded to four bytes; type 0 holds further items. `DEVC` is a device, `STRM` one of
its streams, in which `SCAL` divides the values, and `TYPE` lists the types of a structure of type `?`.

- `GPS5` (latitude, longitude, height, two speeds), with the UTC `GPSU` and fix `GPSF` of each packet;
  `GPS9` (since Hero 11) has the time and the fix in each row. Rows of a packet are evenly spaced.
- A Karma logs `GLPI` (position), `ATTD` (roll, pitch, yaw, as MAVLink counts them) and `SYST` (time since
  boot and UTC). What its `CYTS` means for the gimbal is not public.
- Since Hero 8: `CORI` turns the axes of the first picture into those of the camera, for each picture, and
  `IORI` those of the camera into those of the stabilised picture (quaternions w, x, y, z; axes right, down,
  forward). `GRAV` is the direction of gravity in the axes of the camera; a Hero 8 leaves it 0. GoPro's table
  does not name the axes: these are the ones of its answers (gpmf-parser, issues 100 and 170) and of Gyroflow.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.formats.common.files import first_bytes
from pipelines.formats.common.rows import NORM_TOLERANCE
from pipelines.formats.drone_logs.telemetry_rows import (
    attitude_track,
    describe_fit,
    fit_gps_time,
    of_angles,
    on_gps_time,
    on_one_clock,
    position_track,
    turned_as_stated,
)
from pipelines.geometry.arrays import Bool, ClockFit, Float, Int64
from pipelines.geometry.mounting import attitude_in_enu
from pipelines.geometry.poses import conjugate, interpolate_points, multiply, rotate
from pipelines.session.errors import DataError
from pipelines.session.records import Attitudes, Height, Telemetry
from pipelines.session.registries import TelemetryChoice

_KINDS = {
    "b": "i1",
    "B": "u1",
    "s": "i2",
    "S": "u2",
    "l": "i4",
    "L": "u4",
    "j": "i8",
    "J": "u8",
    "f": "f4",
    "d": "f8",
}
# GPMF marks a fix with height by this number.
_FIX_3D = 3
# A packet of a second has one time only, so its rows are known to about this.
_PACKET_S = 0.2
# Rows of gravity and of the stabilisation further apart than this are a gap.
_BRIDGED_NS = 1_000_000_000
# Accelerations turn the measured gravity by some degrees, a wrong axis by more.
_LARGEST_TILT_DEG = 20.0
_DAYS_TO_2000 = (datetime(2000, 1, 1, tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)).days
_KNOWN = ("GPS5", "GPS9", "GLPI", "ATTD", "SYST", "ACCL", "GYRO", "CORI", "IORI", "GRAV")


@dataclass
class _Track:
    """Content of a telemetry track: rows of each stream, and the video time of each row."""

    rows: dict[str, list[Float]] = field(default_factory=dict)
    at_ns: dict[str, list[Int64]] = field(default_factory=dict)  # since the video's start
    names: dict[str, str] = field(default_factory=dict)
    heights: Height = "ellipsoid"  # of GPS5 and GPS9, unless the file says sea level
    dropped: Counter[str] = field(default_factory=Counter)

    def stream(self, key: str, columns: int) -> tuple[Int64, Float] | None:
        """Return video times [N] and values [N, >= columns] of a stream; None without it."""
        rows = [each for each in self.rows.get(key, ()) if each.shape[1] >= columns]
        if not rows:
            return None
        widest = min(each.shape[1] for each in rows)
        return np.concatenate(self.at_ns[key][: len(rows)]), np.concatenate(
            [each[:, :widest] for each in rows]
        )


class GoProFormat:
    """Reader of positions and of the camera's turns in a GoPro's video, and of the flight of a Karma."""

    name = "gopro"
    title = "GoPro telemetry (GPMF)"
    suffixes: tuple[str, ...] = (".mp4", ".mov", ".360", ".lrv")

    def recognises(self, path: Path) -> bool:
        """Return True if a video has a track of GPMF whose first packet begins with a device."""
        try:
            return path.is_file() and next(_packets(path), None) is not None
        except (DataError, OSError):
            return False

    def describe(self, path: Path) -> dict[str, object]:
        """Describe the streams by their rows, the positions, and the clock."""
        track = _read(path)
        facts: dict[str, object] = {
            "streams": [f"{key} {sum(map(len, rows))}" for key, rows in sorted(track.rows.items())],
            **{f"dropped: {cause}": count for cause, count in track.dropped.items()},
        }
        with suppress(DataError):
            attitudes = self.read_attitudes(path)
            facts["camera_attitudes"] = f"{len(attitudes.camera.t_ns)}, from the first picture's heading on"
        try:
            telemetry = self.read_telemetry(path, TelemetryChoice())
        except DataError as error:
            return {**facts, "positions": 0, "why": error.problem}
        facts |= {"positions": len(telemetry.position.t_ns), "clock": telemetry.clock}
        facts["body_attitudes"] = len(telemetry.body.t_ns) if telemetry.body else 0
        if telemetry.fit and telemetry.video_began:
            facts["gps_time"] = describe_fit(telemetry.fit)
            facts["video_began_s"] = round(telemetry.video_began[0] / 1e9, 3)
        names = ("latitude_deg", "longitude_deg", "height_m")
        columns = zip(names, telemetry.position.values.T, strict=True)
        return facts | {name: [round(v, 7) for v in (c.min(), c.max())] for name, c in columns}

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:
        """Read a Karma's position and attitude, else the camera's GPS; in UTC where that is logged."""
        track = _read(path)
        dropped: dict[str, int] = dict(track.dropped)
        notes: list[str] = []
        if (flown := track.stream("GLPI", 4)) is not None:
            rows = flown[1]
            system = track.stream("SYST", 2)
            fit = fit_gps_time(_ns(system[1][:, 0]), _ns(system[1][:, 1])) if system is not None else None
            position = position_track(
                path, "GLPI", _ns(rows[:, 0]), rows[:, 1:4], dropped, on_earth=True, height="sea level"
            )
            body = None
            if (turned := track.stream("ATTD", 4)) is not None:
                angles = np.degrees(turned[1][:, [3, 2, 1]])
                body = attitude_track("ATTD", _ns(turned[1][:, 0]), turned_as_stated(angles), dropped)
            fit = on_gps_time(path, fit, choice.time, notes)
            telemetry = on_one_clock(path, position, body, None, fit=fit, notes=notes, dropped=dropped)
            began_ns = int(np.median(_ns(rows[:, 0]) - flown[0]))
            return replace(
                telemetry, video_began=(began_ns if fit is None else _on(fit, began_ns), _PACKET_S)
            )
        at_ns, places, fixed, fit = _fixes(path, track)
        position = position_track(
            path, "its GPS", at_ns, places, dropped, on_earth=True, height=track.heights,
            unusable={"no 3D fix": ~fixed},
        )  # fmt: skip
        fit = on_gps_time(path, fit, choice.time, notes)
        telemetry = on_one_clock(path, position, None, None, fit=fit, notes=notes, dropped=dropped)
        return replace(telemetry, video_began=(0, 0.0) if fit is None else (_on(fit, 0), _PACKET_S))

    def read_attitudes(self, path: Path) -> Attitudes:
        """Read how the camera turned, level by gravity, with the first picture looking north."""
        track = _read(path)
        at_ns, from_camera, from_picture = _orientations(path, track)
        dropped: dict[str, int] = dict(track.dropped)
        gravity, off_deg = _gravity(path, track, at_ns, from_camera)
        first = conjugate(from_picture[0])
        # In the axes of gimbals (forward, right, down) the first picture is turned by pitch and roll alone.
        x, y, z, w = multiply(first, from_picture).T
        right, down, forward = rotate(first, gravity)
        tilt = [0.0, -np.arcsin(np.clip(forward, -1, 1)), np.arctan2(right, down)]
        turned = multiply(of_angles(np.degrees([tilt])), np.stack([z, x, y, w], axis=1))
        name = "its camera's orientation (CORI)"
        in_enu = attitude_in_enu(turned, relative_to="world", axes="ned")
        camera = attitude_track(name, at_ns, in_enu, dropped)
        if camera is None:
            raise DataError(path, f"{name} holds no usable attitude", _OTHER_ANGLES, code="no-attitude")
        fit = _gps_fit(path, track)
        return Attitudes(
            replace(camera, t_ns=camera.t_ns if fit is None else fit.other_ns(camera.t_ns), dropped=dropped),
            "the video's start" if fit is None else "UTC by GPS",
            knows_north=False,
            video_began_ns=0 if fit is None else _on(fit, 0),
            notes=(
                f"{path}: {name} is level to {off_deg:.2g} deg (the median of its gravity), and its heading"
                " drifts: a gyroscope carries it on from the first picture",
            ),
        )


_OTHER_ANGLES = "name gimbal angles of another log, or fixed ones"


def _orientations(path: Path, track: _Track) -> tuple[Int64, Float, Float]:
    """Return video times [N], and the axes of the first picture from those of camera and picture [N, 4]."""
    found = track.stream("CORI", 4)
    if found is None:
        known = ", ".join(sorted(set(track.rows) & set(_KNOWN))) or "none that is known"
        problem = f"its telemetry holds no orientation of the camera (streams: {known})"
        raise DataError(path, problem, _OTHER_ANGLES)
    at_ns, turns = found
    of_camera = turns[:, [1, 2, 3, 0]]
    of_picture = of_camera
    if (stabilised := track.stream("IORI", 4)) is not None:
        # One row for each picture, as CORI; the next one where some are lost.
        nearest = np.searchsorted(stabilised[0], at_ns).clip(0, len(stabilised[0]) - 1)
        of_picture = multiply(stabilised[1][nearest][:, [1, 2, 3, 0]], of_camera)
    norms = np.linalg.norm(of_camera, axis=1), np.linalg.norm(of_picture, axis=1)
    usable = np.abs(np.stack(norms) - 1).max(axis=0) < NORM_TOLERANCE
    usable[1:] &= np.diff(at_ns) > 0
    if lost := int(np.count_nonzero(~usable)):
        track.dropped["orientation of the camera that is none"] += lost
    if not usable.any():
        raise DataError(path, "holds no usable orientation of the camera", _OTHER_ANGLES, code="no-attitude")
    of_camera, of_picture = (
        each[usable] / norm[usable, None] for each, norm in zip((of_camera, of_picture), norms, strict=True)
    )
    return at_ns[usable], conjugate(of_camera), conjugate(of_picture)


def _gravity(path: Path, track: _Track, at_ns: Int64, from_camera: Float) -> tuple[Float, float]:
    """Return the direction of gravity [3] in the axes of the first picture, and its median deviation, deg."""
    found = track.stream("GRAV", 3)
    if found is None or not found[1].any():
        problem = "its telemetry states no direction of gravity, so nothing says which way is down"
        raise DataError(path, problem, _OTHER_ANGLES)
    keep = np.concatenate([[True], np.diff(found[0]) > 0])
    there = interpolate_points(found[0][keep], found[1][keep], at_ns, max_gap_ns=_BRIDGED_NS)
    length = np.linalg.norm(there, axis=1)
    known = np.nan_to_num(length) > 0.5
    if not known.any():
        raise DataError(
            path, "its orientations and its gravity share no time", _OTHER_ANGLES, code="no-overlap"
        )
    down = rotate(from_camera[known], there[known] / length[known, None])
    mean = down.mean(axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-9)
    off_deg = float(np.degrees(np.median(np.arccos(np.clip(down @ mean, -1, 1)))))
    if off_deg > _LARGEST_TILT_DEG:
        raise DataError(
            path,
            f"its orientations (CORI) and its gravity (GRAV) contradict each other by {off_deg:.0f} deg",
            _OTHER_ANGLES,
        )
    return mean, off_deg


def _gps_fit(path: Path, track: _Track) -> ClockFit | None:
    with suppress(DataError):
        return _fixes(path, track)[3]
    return None


def _on(fit: ClockFit, t_ns: int) -> int:
    return int(fit.other_ns(np.array([t_ns], dtype=np.int64))[0])


def _ns(seconds: Float) -> Int64:
    return np.rint(seconds * 1e9).astype(np.int64)


def _fixes(path: Path, track: _Track) -> tuple[Int64, Float, Bool, ClockFit | None]:
    """Return video times, latitude, longitude, height, True for a 3D fix, and the fit to UTC."""
    if (found := track.stream("GPS9", 9)) is not None:
        at_ns, rows = found
        fixed = rows[:, 8] >= _FIX_3D
        utc_ns = (rows[:, 5] + _DAYS_TO_2000).astype(np.int64) * 86_400_000_000_000 + _ns(rows[:, 6])
        fit = fit_gps_time(at_ns[fixed], utc_ns[fixed]) if fixed.any() else None
        return at_ns, rows[:, :3], np.asarray(fixed), fit
    if (found := track.stream("GPS5", 3)) is None:
        known = ", ".join(sorted(set(track.rows) & set(_KNOWN))) or "none that is known"
        problem = f"its telemetry holds no position (streams: {known})"
        raise DataError(path, problem, "name another log of poses", code="no-positions")
    at_ns, rows = found
    fixed = np.concatenate([each[:, 0] for each in track.rows["fixed"]]) >= _FIX_3D
    clock = track.stream("GPSU", 1)
    fit = fit_gps_time(clock[0], _ns(clock[1][:, 0])) if clock is not None else None
    return at_ns, rows[:, :3], np.asarray(fixed), fit


# --- track ---------------------------------------------------------------------------------------------


def _packets(path: Path) -> Iterator[tuple[int, int, bytes]]:
    """Yield start and length of each packet of the first track of GPMF in video time, ns, and its bytes."""
    if first_bytes(path, 8)[4:] != b"ftyp":
        return

    import av
    from av.stream import Discard

    try:
        # Named format and protocol, as for pictures: a playlist must not make FFmpeg open other files.
        with av.open(f"file:{path.absolute()}", format="mov", metadata_errors="replace") as container:
            for track in [stream for stream in container.streams if stream.type == "data"]:
                for stream in container.streams:
                    stream.discard = Discard.default if stream is track else Discard.all
                container.seek(0)
                found = False
                for packet in container.demux(track):
                    content, step = bytes(packet), track.time_base
                    if packet.pts is None or step is None or not content:
                        continue
                    if not found and not content.startswith(b"DEVC"):
                        break
                    found = True
                    start, length = (round(n * step * 10**9) for n in (packet.pts, packet.duration or 0))
                    yield start, length, content
                if found:
                    return
    except (av.error.FFmpegError, OSError, ValueError) as error:
        problem = f"cannot be read ({str(error)[:100]})"
        raise DataError(path, problem, "copy it from the camera again") from error


def _read(path: Path) -> _Track:
    track = _Track()
    for start_ns, length_ns, content in _packets(path):
        for key, _, _, device in _items(content, track):
            if key == "DEVC":
                for inner, _, _, stream in _items(device, track):
                    if inner == "STRM":
                        _take_stream(track, start_ns, length_ns, stream)
    if not track.rows:
        raise DataError(
            path, "has no track of GoPro's telemetry", "name another log of poses", code="wrong-kind"
        )
    return track


def _items(content: bytes, track: _Track) -> Iterator[tuple[str, str, tuple[int, int], bytes]]:
    """Yield key, type, size and number of structures, and bytes of each item; damage ends them."""
    place = 0
    while place + 8 <= len(content):
        key = content[place : place + 4].decode("ascii", "replace")
        kind, size, count = struct.unpack(">BBH", content[place + 4 : place + 8])
        length = size * count
        if place + 8 + length > len(content):
            track.dropped["item of telemetry cut off"] += 1
            return
        yield key, chr(kind), (size, count), content[place + 8 : place + 8 + length]
        place += 8 + (length + 3) // 4 * 4


def _take_stream(track: _Track, start_ns: int, length_ns: int, content: bytes) -> None:
    """Add the rows of a stream; the values before its data describe them."""
    about: dict[str, Any] = {}
    for key, kind, (size, count), data in _items(content, track):
        if key in {"STNM", "TYPE", "GPSU", "GPSA"}:
            about[key] = data.decode("latin-1").rstrip("\0 ")
            continue
        if kind in "\0c" or key in {"EMPT", "TSMP", "TICK", "TOCK", "SIUN", "UNIT", "TMPC", "STMP"}:
            continue
        values = _values(kind, size, count, data, about.get("TYPE", ""))
        if values is None:
            continue
        if key in {"SCAL", "GPSF", "GPSP"}:
            about[key] = values.ravel()
            continue
        scale = about.get("SCAL", np.ones(1))
        if len(scale) not in {1, values.shape[1]} or not scale.all():
            track.dropped["telemetry with a wrong scale"] += 1
            continue
        rows = values / scale
        at_ns = start_ns + np.arange(len(rows), dtype=np.int64) * length_ns // max(len(rows), 1)
        track.rows.setdefault(key, []).append(rows)
        track.at_ns.setdefault(key, []).append(at_ns)
        track.names.setdefault(key, about.get("STNM", ""))
        if about.get("GPSA", "").startswith("MSL"):
            track.heights = "sea level"
        if key == "GPS5":
            fix = float(about["GPSF"][0]) if len(about.get("GPSF", ())) else 0.0
            track.rows.setdefault("fixed", []).append(np.full((len(rows), 1), fix))
            utc = _utc_s(about.get("GPSU", ""))
            if utc is not None and fix >= _FIX_3D:
                track.rows.setdefault("GPSU", []).append(np.array([[utc]]))
                track.at_ns.setdefault("GPSU", []).append(np.array([start_ns], dtype=np.int64))


def _values(kind: str, size: int, count: int, data: bytes, structure: str) -> Float | None:
    """Return values [count, columns]; None for types that are no plain numbers."""
    kinds = [_KINDS.get(letter) for letter in (structure if kind == "?" else kind)]
    if not kinds or None in kinds or not count:
        return None
    if kind != "?":
        kinds = kinds * (size // np.dtype(f">{kinds[0]}").itemsize)
    layout = np.dtype([(f"c{k}", f">{each}") for k, each in enumerate(kinds)])
    if layout.itemsize != size or not kinds:
        return None
    table = np.frombuffer(data, layout)
    return np.stack([table[name].astype(np.float64) for name in layout.names or ()], axis=1)


def _utc_s(text: str) -> float | None:
    """Return seconds since the epoch of GPSU: yymmddhhmmss.sss."""
    try:
        whole = datetime.strptime(text[:12], "%y%m%d%H%M%S").replace(tzinfo=UTC)
        return whole.timestamp() + float(f"0{text[12:]}")
    except ValueError:
        return None


FORMAT = GoProFormat()
