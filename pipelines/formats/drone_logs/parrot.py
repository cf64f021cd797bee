"""Parrot's telemetry track inside a video: positions, and attitudes of the body and of the pictures' view.

There is one record for each picture (libvideo-metadata, versions 2 and 3; ExifTool's tables name the same
places). Numbers are big-endian. A record begins with its name, `P2` or `P3`, and the length of what follows
in words of four bytes. Quaternions turn an FRD body, or the FRD view of the picture, into north, east, down.
Records since ANAFI Ai are messages of protobuf without a name, which are not read.
"""

import struct
from collections import Counter
from pathlib import Path

import numpy as np

from pipelines.formats.drone_logs.telemetry_rows import attitude_track, position_track
from pipelines.formats.drone_logs.video_tracks import track_packets, video_made_ns
from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.mounting import attitude_in_enu
from pipelines.session.errors import DataError
from pipelines.session.telemetry import Telemetry, TelemetryChoice

# Latitude, longitude, height with the number of satellites; w, x, y, z of the body and of the picture's view.
_RECORDS = {b"P2": struct.Struct(">8x3i8x8h12x"), b"P3": struct.Struct(">8x3i8x4h8x4h20x")}
_DEGREE, _METRE, _WHOLE = 1 << 22, 1 << 8, 1 << 14


class ParrotVideoFormat:
    """Reader of the positions and attitudes in the videos of Parrot's drones whose records are P2 or P3."""

    name = "parrot"
    title = "Parrot's telemetry (in a video)"
    suffixes: tuple[str, ...] = (".mp4", ".mov")

    def recognises(self, path: Path) -> bool:
        """Return True if a video has a data track that begins with a record of Parrot's."""
        try:
            return path.is_file() and next(track_packets(path, _is_record), None) is not None
        except (DataError, OSError):
            return False

    def describe(self, path: Path) -> dict[str, object]:
        """Describe the version, the number of records, and ranges of positions and of the view's pitch."""
        version, _, places, _, view, clock, dropped = _read(path)
        there = np.isfinite(places[:, 0])
        facts: dict[str, object] = {
            "version": version,
            "records": len(places),
            "positions": int(np.count_nonzero(there)),
            "clock": clock,
        }
        for column, (label, decimals) in enumerate(
            (("latitude_deg", 7), ("longitude_deg", 7), ("height_above_sea_m", 3))
        ):
            if there.any():
                values = places[there, column]
                facts[label] = [round(float(v), decimals) for v in (values.min(), values.max())]
        if (turned := view[np.linalg.norm(view, axis=1) > 0.5]).size:
            x, y, z, w = turned.T
            pitch = np.degrees(np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)))
            facts["view_pitch_deg"] = [round(float(v), 2) for v in (pitch.min(), pitch.max())]
        return facts | {f"dropped: {cause}": count for cause, count in dropped.items()}

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:  # noqa: ARG002 - the protocol's
        """Read positions above the sea, the body's attitude, and that of the pictures' view in the world.

        Raises:
            DataError: no such track, or no position in any record.
        """
        _, t_ns, places, body, view, clock, counted = _read(path)
        dropped = dict(counted)
        position = position_track(
            path,
            "its GPS",
            t_ns,
            places,
            dropped,
            on_earth=True,
            height="sea level",
            unusable={"no position": ~np.isfinite(places[:, 0])},
        )
        attitudes = [attitude_in_enu(each, relative_to="world", axes="ned") for each in (body, view)]
        dated = clock != "the video's start"
        remedy = ", whole seconds: let clock.sigma_s be 1" if dated else ""
        return Telemetry(
            position=position,
            body=attitude_track("its body's attitude", t_ns, attitudes[0], dropped),
            gimbal=attitude_track("its pictures' view", t_ns, attitudes[1], dropped, stated={"world": view}),
            clock=clock,
            notes=(f"{path}: its times count from {clock}{remedy}",),
            dropped=dropped,
        )


def _is_record(content: bytes) -> bool:
    record = _RECORDS.get(content[:2])
    words = int.from_bytes(content[2:4])
    return record is not None and record.size <= 4 + 4 * words <= len(content)


def _read(
    path: Path,
) -> tuple[str, Int64, Float, Float, Float, str, Counter[str]]:
    """Return version, times (ns), places [N, 3], quaternions xyzw [N, 4] of body and view, clock, losses.

    Places are latitude, longitude (deg) and height above the sea (m), NaN without a fix. Quaternions are 0
    where the drone states none.

    Raises:
        DataError: no such track.
    """
    version = ""
    dropped: Counter[str] = Counter()
    at_ns: list[int] = []
    rows: list[tuple[int, ...]] = []
    for start_ns, _, content in track_packets(path, _is_record):
        if not _is_record(content) or (version and content[:2].decode() != version):
            dropped["damaged records"] += 1
            continue
        version = content[:2].decode()
        at_ns.append(start_ns)
        rows.append(_RECORDS[content[:2]].unpack_from(content))
    if not rows:
        remedy = (
            "name another log of poses; of videos since ANAFI Ai, export a table with Parrot's vmeta-extract"
        )
        raise DataError(path, "has no track of Parrot's telemetry (P2 or P3)", remedy)
    table = np.array(rows, dtype=np.int64)
    places = table[:, :3] / np.array([_DEGREE, _DEGREE, 1])
    places[:, 2] = (table[:, 2] >> 8) / _METRE  # the low byte counts satellites
    outside = (np.abs(places[:, 0]) > 90) | (np.abs(places[:, 1]) > 180)  # 500 says that there is none
    places[outside | ~places[:, :2].any(axis=1)] = np.nan
    body, view = (np.roll(table[:, k : k + 4] / _WHOLE, -1, axis=1) for k in (3, 7))
    made = video_made_ns(path)
    clock = "the video's start" if made is None else "the video's time of creation"
    return version, np.array(at_ns, dtype=np.int64) + (made or 0), places, body, view, clock, dropped


FORMAT = ParrotVideoFormat()
