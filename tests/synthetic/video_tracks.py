"""GoPro's telemetry tracks, byte for byte, beside pictures."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from pipelines.geometry.poses import conjugate, multiply, rotate
from tests.synthetic.drone_logs import DroneTruth
from tests.synthetic.videos import bar_code


def write_track(
    path: Path,
    stamped: Sequence[tuple[int, bytes]],
    *,
    made_s: int | None = None,
    pictures: int = 0,
    last_s: float = 0.0,
) -> Path:
    """Write packets at times (ns) into a data track; `pictures` at 30 Hz go into a track of their own.

    A packet lasts until the next one; the last one for `last_s`.
    """
    with av.open(str(path), "w", format="mp4") as container:
        if made_s is not None:
            container.metadata["creation_time"] = datetime.fromtimestamp(made_s, UTC).isoformat()
        video: Any = None
        if pictures:
            video = container.add_stream("libx264", rate=30)
            video.width, video.height = bar_code(0).shape[1], bar_code(0).shape[0]
            video.pix_fmt = "yuv420p"
        track: Any = container.add_data_stream("bin_data")
        track.time_base = Fraction(1, 90_000)
        container.start_encoding()
        for k in range(pictures):
            container.mux(video.encode(av.VideoFrame.from_ndarray(bar_code(k), format="rgb24")))
        if pictures:
            container.mux(video.encode())
        for t_ns, content in stamped:
            packet = av.Packet(content)
            packet.stream = track
            packet.time_base = Fraction(1, 90_000)
            packet.pts = packet.dts = round(t_ns * 90_000 / 10**9)
            packet.duration = max(1, round(last_s * 90_000))  # FFmpeg's reader drops a last one without any
            container.mux(packet)
    return path


# --- GoPro ---------------------------------------------------------------------------------------------

PACKET_S = 1  # a GoPro's packets last a second


def gpmf_item(key: str, kind: str, size: int, count: int, data: bytes) -> bytes:
    """Encode an item of GPMF: key, type, size and number of structures, padded data."""
    head = key.encode() + struct.pack(">BBH", ord(kind) if kind else 0, size, count)
    return head + data + bytes(-len(data) % 4)


def gpmf_numbers(key: str, kind: str, rows: Sequence[Sequence[int]]) -> bytes:
    """Encode rows of whole numbers of one type."""
    letter = {"l": "i", "s": "h", "S": "H", "L": "I"}[kind]
    data = b"".join(struct.pack(f">{len(row)}{letter}", *row) for row in rows)
    return gpmf_item(key, kind, len(data) // len(rows), len(rows), data)


def gpmf_nested(key: str, *inner: bytes) -> bytes:
    """Encode an item that holds further items."""
    data = b"".join(inner)
    return gpmf_item(key, "", 1, len(data), data)


def gopro_packets(truth: DroneTruth, per_packet: int = 10) -> list[tuple[int, bytes]]:
    """Encode packets of a second as those of a Hero 5: acceleration, and GPS with its UTC and fix."""
    scale = gpmf_numbers("SCAL", "l", [[10_000_000], [10_000_000], [1000], [1000], [100]])
    degrees = np.rint(np.stack([truth.latitude_deg, truth.longitude_deg], axis=1) * 1e7).astype(np.int64)
    since_ns = truth.t_ns - truth.t_ns[0]
    packets = []
    for k in range(int(since_ns[-1]) // 10**9 // PACKET_S + 1):
        at_ns = k * PACKET_S * 10**9 + np.arange(per_packet) * PACKET_S * 10**9 // per_packet
        rows = np.minimum(np.searchsorted(since_ns, at_ns), len(since_ns) - 1)
        places = [[*degrees[row].tolist(), round(1000 * truth.altitude_m[row]), 1500, 120] for row in rows]
        began = datetime.fromtimestamp((int(truth.t_ns[0]) + k * PACKET_S * 10**9) / 1e9, UTC)
        utc = f"{began:%y%m%d%H%M%S}.{began.microsecond // 1000:03d}".encode()
        fixes = gpmf_nested(
            "STRM",
            gpmf_item("STNM", "c", 1, 3, b"GPS"),
            gpmf_numbers("GPSF", "L", [[3]]),
            gpmf_item("GPSU", "c", 1, 16, utc),
            scale,
            gpmf_numbers("GPS5", "l", places),
        )
        shaken = gpmf_nested(
            "STRM", gpmf_numbers("SCAL", "s", [[418]]), gpmf_numbers("ACCL", "s", [[4100, 10, -20]] * 4)
        )
        packets.append((k * PACKET_S * 10**9, gpmf_nested("DEVC", shaken, fixes)))
    return packets


def write_gopro(
    path: Path, truth: DroneTruth, *, pictures: int = 0, turned: Sequence[bytes] = (), places: bool = True
) -> Path:
    """Write a video of a GoPro whose pictures begin with the first row.

    `turned` are further streams for each packet; without `places` there is no GPS.
    """
    made_s = int(truth.t_ns[0]) // 10**9
    packets = gopro_packets(truth)
    if turned:
        packets = [
            (at_ns, gpmf_nested("DEVC", more, *([content[8:]] if places else [])))
            for (at_ns, content), more in zip(packets, turned, strict=True)
        ]
    return write_track(path, packets, made_s=made_s, pictures=pictures, last_s=PACKET_S)


def gopro_turns(
    t_ns: Sequence[int], picture: Any, camera: Any = None, *, gravity: bool = True, per_packet: int = 30
) -> list[bytes]:
    """Encode a Hero 9's CORI, IORI and GRAV for packets of a second, from turns over time.

    CORI takes a vector in the axes of the camera when filming began into those of the camera now, IORI from
    these into those of the picture; the axes are right, down and forward.

    Args:
        t_ns: [N] times of the turns.
        picture: [N, 4] world_from_picture, ENU.
        camera: [N, 4] world_from_camera, which the stabilisation turned; that of the picture by default.
        gravity: False for the zeros of a Hero 8.
        per_packet: number of rows in a second.
    """
    since_ns = np.asarray(t_ns) - t_ns[0]
    packets = []
    for k in range(int(since_ns[-1]) // 10**9 // PACKET_S + 1):
        at_ns = k * PACKET_S * 10**9 + np.arange(per_packet) * PACKET_S * 10**9 // per_packet
        rows = np.minimum(np.searchsorted(since_ns, at_ns), len(since_ns) - 1)
        seen = np.asarray(picture)
        held = seen if camera is None else np.asarray(camera)
        turned = multiply(conjugate(held[rows]), held[0])
        steadied = multiply(conjugate(seen[rows]), held[rows])
        down = rotate(conjugate(held[rows]), np.array([0.0, 0.0, -1.0])) * (1.0 if gravity else 0.0)
        streams = [
            gpmf_nested(
                "STRM",
                gpmf_numbers("SCAL", "s", [[32767]]),
                gpmf_numbers(key, "s", np.rint(values * 32767).astype(int).tolist()),
            )
            for key, values in (
                ("CORI", turned[:, [3, 0, 1, 2]]),
                ("IORI", steadied[:, [3, 0, 1, 2]]),
                ("GRAV", down),
            )
        ]
        packets.append(b"".join(streams))
    return packets
