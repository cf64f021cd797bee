"""Telemetry tracks of videos, byte for byte: DJI's djmd, GoPro's, Parrot's and MISB KLV, beside pictures."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from pipelines.geometry.poses import conjugate, multiply, rotate
from tests.synthetic.drone_logs import DroneTruth, angles_of
from tests.synthetic.videos import bar_code

KLV_KEY = bytes.fromhex("060E2B34020B01010E01030101000000")


def write_track(
    path: Path,
    stamped: Sequence[tuple[int, bytes]],
    *,
    codec: str,
    made_s: int | None = None,
    pictures: int = 0,
    last_s: float = 0.0,
) -> Path:
    """Write packets at times (ns) into a data track; `pictures` at 30 Hz go into a track of their own.

    A packet lasts until the next one; the last one for `last_s`.
    """
    kind = "mp4" if codec == "bin_data" else "mpegts"
    with av.open(str(path), "w", format=kind) as container:
        if made_s is not None:
            container.metadata["creation_time"] = datetime.fromtimestamp(made_s, UTC).isoformat()
        video: Any = None
        if pictures:
            video = container.add_stream("libx264", rate=30)
            video.width, video.height = bar_code(0).shape[1], bar_code(0).shape[0]
            video.pix_fmt = "yuv420p"
        track: Any = container.add_data_stream(codec)
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


# --- DJI -----------------------------------------------------------------------------------------------


def proto(number: int, value: bytes | int | float, *, double: bool = False) -> bytes:
    """Encode a field of protobuf: nested or text, a number (negative ones in ten bytes), or a real one."""
    if isinstance(value, bytes):
        return varint(number << 3 | 2) + varint(len(value)) + value
    if isinstance(value, int):
        return varint(number << 3) + varint(value % 2**64)
    return varint(number << 3 | (1 if double else 5)) + struct.pack("<d" if double else "<f", value)


def varint(value: int) -> bytes:
    """Encode a number in groups of seven bits, the lowest first."""
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def djmd_messages(truth: DroneTruth, protocol: str = "dvtm_Air3s.proto") -> list[tuple[int, bytes]]:
    """Encode a message for each row, with the fields of a Mini 4 Pro; zeros are left out."""
    messages = []
    for row, stamp_ns in enumerate(truth.t_ns.tolist()):
        body, gimbal = (
            [round(10 * each) for each in part[row].tolist()]
            for part in (truth.body_ypr_deg, truth.gimbal_ypr_deg)
        )
        place = b"".join(
            proto(number, float(np.radians(each[row])), double=True)
            for number, each in ((2, truth.latitude_deg), (3, truth.longitude_deg))
        )
        position = proto(1, place) + proto(2, round(1000 * float(truth.altitude_m[row])))
        flown = [
            proto(3, b"".join(proto(k, each) for k, each in zip((1, 2, 3), body[::-1], strict=True) if each)),
            proto(4, position),
            proto(5, proto(1, 1000 * float(truth.enu[row, 2]))),
        ]
        turned = [
            proto(k, each) for k, each in zip((1, 2, 3), (gimbal[1], gimbal[2], gimbal[0]), strict=True)
        ]
        since_us = int(truth.boot_us[row])
        picture = proto(1, proto(2, since_us)) + proto(3, b"".join(flown))
        picture += proto(4, proto(3, b"".join(turned)))
        head = proto(1, proto(1, proto(1, protocol.encode()))) if row == 0 else b""
        messages.append((stamp_ns - int(truth.t_ns[0]), head + proto(3, picture)))
    return messages


def write_djmd(
    path: Path, truth: DroneTruth, protocol: str = "dvtm_Air3s.proto", *, pictures: int = 0
) -> Path:
    """Write a video of DJI's whose time of creation is the first row's, which is a whole second."""
    made_s = int(truth.t_ns[0]) // 10**9
    messages = djmd_messages(truth, protocol)
    return write_track(path, messages, codec="bin_data", made_s=made_s, pictures=pictures)


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
    return write_track(path, packets, codec="bin_data", made_s=made_s, pictures=pictures, last_s=PACKET_S)


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


# --- Parrot --------------------------------------------------------------------------------------------


def parrot_records(truth: DroneTruth, version: int = 3) -> list[tuple[int, bytes]]:
    """Encode a record for each row, with a timestamp (E1) after it, as libvideo-metadata packs them."""
    records = []
    for row, stamp_ns in enumerate(truth.t_ns.tolist()):
        body, view = (
            struct.pack(">4h", *(round(16384 * part) for part in _wxyz_in_ned(angles[row])))
            for angles in (truth.body_ypr_deg, truth.gimbal_ypr_deg)
        )
        degrees = [round(float(each[row]) * 2**22) for each in (truth.latitude_deg, truth.longitude_deg)]
        height = round(float(truth.altitude_m[row]) * 256) * 256 + 12  # satellites
        flown = struct.pack(">i2ii4h", round(7.5 * 65536), *degrees, height, 256, -256, 128, -256)
        if version == 3:
            camera = bytes(8) + view + struct.pack(">6HI4B", 2048, 100, 1, 1, 17664, 11264, 5, 200, 90, 3, 0)
        else:
            camera = view + struct.pack(">2h2H4B", 0, -1234, 2048, 100, 3, 0, 200, 90)
        inside = flown + body + camera + b"E1\0\2" + int(truth.boot_us[row]).to_bytes(8)
        head = b"P%d" % version + (len(inside) // 4).to_bytes(2)
        records.append((stamp_ns - int(truth.t_ns[0]), head + inside))
    return records


def parrot_messages(truth: DroneTruth, *, utc: bool = True, sea: bool = True) -> list[tuple[int, bytes]]:
    """Encode an empty sample and a message of protobuf for each row, by the fields of vmeta.proto."""
    messages = [(0, b"_ATEMON_")]
    for row, stamp_ns in enumerate(truth.t_ns.tolist()):
        body, view = (
            b"".join(proto(k, part) for k, part in enumerate(_wxyz_in_ned(angles[row]), 1))
            for angles in (truth.body_ypr_deg, truth.gimbal_ypr_deg)
        )
        height = float(truth.altitude_m[row])
        place = [(1, float(truth.latitude_deg[row])), (2, float(truth.longitude_deg[row])), (3, height + 47)]
        place += [(7, height)] if sea else []
        location = b"".join(proto(k, value, double=True) for k, value in place) + proto(4, 12)
        camera = proto(1, int(truth.boot_us[row])) + proto(2, proto(1, 1.0)) + proto(3, view) + proto(8, 1.2)
        camera += proto(10, stamp_ns // 1000) + proto(11, 500) if utc else proto(10, 77)
        drone = proto(1, body) + proto(2, location) + proto(3, 7.5, double=True) + proto(5, 180)
        links = proto(3, proto(1, proto(1, 17664)))
        messages.append((stamp_ns - int(truth.t_ns[0]), proto(1, drone) + proto(2, camera) + links))
    return messages


def write_parrot(path: Path, truth: DroneTruth, version: int = 3, *, pictures: int = 0) -> Path:
    """Write a video of Parrot's whose time of creation is the first row's, a whole second; 4 is protobuf."""
    made_s = int(truth.t_ns[0]) // 10**9
    records = parrot_messages(truth) if version == 4 else parrot_records(truth, version)
    return write_track(path, records, codec="bin_data", made_s=made_s, pictures=pictures)


def _wxyz_in_ned(yaw_pitch_roll_deg: Any) -> tuple[float, float, float, float]:
    """Return the quaternion of Tait-Bryan angles, as vmeta_euler_to_quat computes it."""
    (cy, cp, cr), (sy, sp, sr) = (each(np.radians(yaw_pitch_roll_deg) / 2) for each in (np.cos, np.sin))
    return (
        float(cr * cp * cy + sr * sp * sy),
        float(sr * cp * cy - cr * sp * sy),
        float(cr * sp * cy + sr * cp * sy),
        float(cr * cp * sy - sr * sp * cy),
    )


# --- MISB ----------------------------------------------------------------------------------------------


def klv_packet(items: Mapping[int, bytes]) -> bytes:
    """Encode a packet of ST 0601, with its checksum."""
    inside = b"".join(bytes([tag, len(value)]) + value for tag, value in items.items()) + bytes([1, 2])
    length = len(inside) + 2
    head = KLV_KEY + (bytes([length]) if length < 128 else bytes([0x81, length]))
    summed = 0
    for place, byte in enumerate(head + inside):
        summed += byte << (8 * ((place + 1) % 2))
    return head + inside + (summed % 65536).to_bytes(2)


def klv_packets(truth: DroneTruth) -> list[tuple[int, bytes]]:
    """Encode a packet for each row: the body's place and attitude, and the camera's angles in the body."""
    yaw, pitch, roll = np.radians(truth.gimbal_ypr_deg).T
    ahead = np.stack([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)], axis=1)
    level = np.stack([np.cos(yaw), -np.sin(yaw), np.zeros_like(yaw)], axis=1)
    right = np.cos(roll)[:, None] * level + np.sin(roll)[:, None] * np.cross(ahead, level)
    in_body = [rotate(conjugate(truth.body), each) for each in (ahead, right)]  # forward, left, up
    relative = angles_of(*(np.stack([-v[:, 1], v[:, 0], v[:, 2]], axis=1) for v in in_body))
    packets = []
    for row, stamp_ns in enumerate(truth.t_ns.tolist()):
        items = {
            2: (stamp_ns // 1000).to_bytes(8),
            5: _whole(truth.body_ypr_deg[row, 0] % 360, 2, 0, 360),
            90: _part(truth.body_ypr_deg[row, 1], 4, 90),
            91: _part(truth.body_ypr_deg[row, 2], 4, 90),
            13: _part(truth.latitude_deg[row], 4, 90),
            14: _part(truth.longitude_deg[row], 4, 180),
            15: _whole(truth.altitude_m[row], 2, -900, 19000),
            18: _whole(relative[row, 0] % 360, 4, 0, 360),
            19: _part(relative[row, 1], 4, 180),
            20: _whole(relative[row, 2] % 360, 4, 0, 360),
        }
        packets.append((stamp_ns - int(truth.t_ns[0]), klv_packet(items)))
    return packets


def write_klv(path: Path, truth: DroneTruth, *, pictures: int = 0) -> Path:
    """Write the packets into a transport stream, or one after the other into a .klv."""
    packets = klv_packets(truth)
    if path.suffix == ".klv":
        path.write_bytes(b"".join(content for _, content in packets))
        return path
    return write_track(path, packets, codec="klv", pictures=pictures)


def _whole(value: float, size: int, low: float, high: float) -> bytes:
    return round((value - low) / (high - low) * ((1 << 8 * size) - 1)).to_bytes(size)


def _part(value: float, size: int, most: float) -> bytes:
    return round(value / most * ((1 << (8 * size - 1)) - 1)).to_bytes(size, signed=True)
