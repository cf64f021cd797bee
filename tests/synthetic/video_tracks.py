"""GoPro's telemetry tracks, byte for byte, beside pictures."""

import struct
from collections.abc import Sequence
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

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


def write_gopro(path: Path, truth: DroneTruth, *, pictures: int = 0) -> Path:
    """Write a video of a GoPro whose pictures begin with the first row."""
    made_s = int(truth.t_ns[0]) // 10**9
    return write_track(path, gopro_packets(truth), made_s=made_s, pictures=pictures, last_s=PACKET_S)
