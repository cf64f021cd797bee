"""GoPro's telemetry track (GPMF) inside a video: positions by GPS, and a Karma drone's own flight data.

Layout (GoPro, "GPMF Introduction"): key of four letters, type, size of a structure, number of structures,
then big-endian values padded to four bytes; type 0 holds further items. `DEVC` is a device, `STRM` a stream,
in which `SCAL` divides the values, and `TYPE` lists the types of a structure of type `?`. `GPS5` (latitude,
longitude, height, two speeds) has the UTC `GPSU` and fix `GPSF` of its packet, `GPS9` in each row; rows of a
packet are evenly spaced. A Karma logs `GLPI` (position), `ATTD` (roll, pitch, yaw, as MAVLink) and `SYST`
(boot, UTC).
"""

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.formats.common.files import first_bytes
from pipelines.formats.drone_logs.telemetry_rows import (
    DroneLog,
    attitude_track,
    fit_gps_time,
    on_gps_time,
    on_one_clock,
    position_track,
    turned_as_stated,
)
from pipelines.geometry.arrays import Bool, ClockFit, Float, Int64
from pipelines.session.errors import DataError
from pipelines.session.records import Height, Telemetry
from pipelines.session.registries import TelemetryChoice
from pipelines.session.storage import damaged

_KINDS = dict(zip("bBsSlLjJfd", ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"), strict=True))
# GPMF marks a fix with height by this number.
_FIX_3D = 3
# A packet of a second has one time only, so its rows are known to about this.
_PACKET_S = 0.2
# GPS9 counts days from 2000, which are so many after 1970.
_DAYS_TO_2000 = 10_957


@dataclass
class _Track:
    """Content of a telemetry track: rows of each stream, and the video time of each row."""

    rows: dict[str, list[Float]] = field(default_factory=dict)
    at_ns: dict[str, list[Int64]] = field(default_factory=dict)  # since the video's start
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


class GoProFormat(DroneLog):
    """Reader of positions in a GoPro's video, and of the flight of a Karma."""

    name = "gopro"
    title = "GoPro telemetry (GPMF)"
    suffixes: tuple[str, ...] = (".mp4", ".mov", ".360", ".lrv")

    def recognises(self, path: Path) -> bool:
        """Return True if a video has a track of GPMF whose first packet begins with a device."""
        try:
            return path.is_file() and next(_packets(path), None) is not None
        except (DataError, OSError):
            return False

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
        problem = f"its telemetry holds no position (streams: {', '.join(sorted(track.rows))[:100]})"
        raise DataError(path, problem, "name another log of poses", code="no-positions")
    at_ns, rows = found
    fixed = np.concatenate([each[:, 0] for each in track.rows["fixed"]]) >= _FIX_3D
    clock = track.stream("GPSU", 1)
    fit = fit_gps_time(clock[0], _ns(clock[1][:, 0])) if clock is not None else None
    return at_ns, rows[:, :3], np.asarray(fixed), fit


def _packets(path: Path) -> Iterator[tuple[int, int, bytes]]:
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
        raise damaged(path, f"cannot be read ({str(error)[:100]})") from error


def _read(path: Path) -> _Track:
    track = _Track()
    for start_ns, length_ns, content in _packets(path):
        for key, _, _, device in _items(content, track):
            if key == "DEVC":
                for inner, _, _, stream in _items(device, track):
                    if inner == "STRM":
                        _take_stream(track, start_ns, length_ns, stream)
    if not track.rows:
        problem = "has no track of GoPro's telemetry"
        raise DataError(path, problem, "name another log of poses", code="wrong-kind")
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
