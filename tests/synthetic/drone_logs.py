"""Logs in the formats of drones, byte for byte: DJI's subtitles, DataFlash (.bin), ULog (.ulg).

Written by the published formats with `struct` alone, without the libraries that the readers use.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Place
from pipelines.geometry.geodesy import place_at
from pipelines.geometry.poses import matrix_from_quaternion, multiply, quaternion_from_rotation_vector, rotate
from tests.synthetic.flights import SyntheticFlight

Int64 = NDArray[np.int64]

HOME = Place(40.4433, -79.9436, 280.0)
LEVER_ARM = np.array([0.12, -0.03, -0.08])
BOOT_NS = 83_000_000_000  # on the autopilot's clock when the flight's own time begins
GPS_LEAP_S = 18


@dataclass(frozen=True)
class DroneTruth:
    """True values that a drone with one camera of a flight would log: [N] rows each."""

    t_ns: Int64  # UTC
    enu: Float  # [N, 3] m from HOME, of the body
    latitude_deg: Float
    longitude_deg: Float
    altitude_m: Float
    body: Float  # [N, 4] ENU from FLU
    body_ypr_deg: Float  # [N, 3] of FRD in NED
    gimbal_ypr_deg: Float  # [N, 3] of FRD in NED

    @property
    def boot_us(self) -> Int64:
        """Time [N] of the autopilot's own clock (us since boot)."""
        since_boot: Int64 = (self.t_ns - self.t_ns[0] + BOOT_NS) // 1000
        return since_boot


def drone_of(flight: SyntheticFlight, k: int) -> DroneTruth:
    """Simulate the drone that carries camera k below it on a gimbal, at LEVER_ARM of its body.

    The body heads elsewhere than the camera, pitched and rolled. Angles are taken from where things point,
    not by the formulas of the readers.
    """
    yaw = 0.4 + 0.8 * k + 0.3 * (flight.t_ns - flight.t_ns[0]) / 1e9
    still = np.zeros_like(yaw)
    body = quaternion_from_rotation_vector(np.stack([still, still, yaw], axis=1))
    lean = np.broadcast_to([0.05, -0.08, 0.0], (len(yaw), 3))
    body = multiply(body, quaternion_from_rotation_vector(lean))
    enu = flight.camera_position[k] - rotate(body, LEVER_ARM)
    places = [place_at(row, HOME) for row in enu]
    axes = matrix_from_quaternion(flight.camera_quaternion[k])
    return DroneTruth(
        t_ns=flight.t_ns,
        enu=enu,
        latitude_deg=np.array([place.latitude_deg for place in places]),
        longitude_deg=np.array([place.longitude_deg for place in places]),
        altitude_m=np.array([place.altitude_m for place in places]),
        body=body,
        body_ypr_deg=angles_of(rotate(body, np.array([1.0, 0, 0])), -rotate(body, np.array([0, 1.0, 0]))),
        gimbal_ypr_deg=angles_of(axes[:, :, 2], axes[:, :, 0]),
    )


def angles_of(ahead: Float, right: Float) -> Float:
    """Compute yaw, pitch, roll [N, 3] (deg) of an FRD body in NED, from its nose and right side in ENU."""
    yaw = np.arctan2(ahead[:, 0], ahead[:, 1])  # from north to east
    pitch = np.arcsin(np.clip(ahead[:, 2], -1, 1))  # up
    level_right = np.stack([np.cos(yaw), -np.sin(yaw), np.zeros_like(yaw)], axis=1)
    level_down = np.cross(ahead, level_right)
    roll = np.arctan2(np.sum(right * level_down, axis=1), np.sum(right * level_right, axis=1))
    angles: Float = np.degrees(np.stack([yaw, pitch, roll], axis=1))
    return angles


# --- DJI's subtitles -----------------------------------------------------------------------------------
def write_srt(path: Path, truth: DroneTruth, *, gimbal: bool = True, newline: str = "\n") -> Path:
    """Write subtitles of each frame in the form since 2018, with more decimals than drones."""
    blocks = []
    for row, stamp_ns in enumerate(truth.t_ns.tolist()):
        since = (stamp_ns - int(truth.t_ns[0])) // 1_000_000
        shown = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=stamp_ns // 1000)
        yaw, pitch, roll = truth.gimbal_ypr_deg[row]
        said = [
            f"[latitude: {truth.latitude_deg[row]:.9f}]",
            f"[longitude: {truth.longitude_deg[row]:.9f}]",
            f"[rel_alt: {truth.enu[row, 2]:.6f} abs_alt: {truth.altitude_m[row]:.6f}]",
        ]
        if gimbal:
            said.append(f"[gb_yaw: {yaw:.6f} gb_pitch: {pitch:.6f} gb_roll: {roll:.6f}]")
        lines = [
            str(row + 1),
            f"{_timecode(since)} --> {_timecode(since + 33)}",
            f'<font size="28">FrameCnt: {row + 1}, DiffTime: 33ms',
            f"{shown:%Y-%m-%d %H:%M:%S},{shown.microsecond // 1000:03d},{shown.microsecond % 1000:03d}",
            f"[iso: 100] [shutter: 1/80.0] [fnum: 280] [color_md : default] {' '.join(said)} </font>",
            "",
        ]
        blocks.append(newline.join(lines))
    path.write_bytes(newline.join(blocks).encode())
    return path


def _timecode(milliseconds: int) -> str:
    seconds, rest = divmod(milliseconds, 1000)
    return f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d},{rest:03d}"


def write_record(path: Path, truth: DroneTruth) -> Path:
    """Write a flight record as Flight Reader exports it, with more decimals."""
    names = [
        *("CUSTOM.date [utc]", "CUSTOM.updateTime [utc]", "OSD.flyTime [s]", "OSD.latitude", "OSD.longitude"),
        *("OSD.height [ft]", "OSD.altitude [ft]", "OSD.pitch", "OSD.roll", "OSD.yaw"),
        *("GIMBAL.pitch", "GIMBAL.roll", "GIMBAL.yaw"),
    ]
    lines = ["sep=,", ",".join(names)]
    for row, stamp_ns in enumerate(truth.t_ns.tolist()):
        shown = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=stamp_ns // 1000)
        heights = truth.enu[row, 2] / 0.3048, truth.altitude_m[row] / 0.3048
        angles = [part[row, [1, 2, 0]].tolist() for part in (truth.body_ypr_deg, truth.gimbal_ypr_deg)]
        numbers = [truth.latitude_deg[row], truth.longitude_deg[row], *heights, *angles[0], *angles[1]]
        since_s = (stamp_ns - int(truth.t_ns[0])) / 1e9
        cells = [f"{shown:%Y-%m-%d}", f"{shown:%H:%M:%S.%f}", f"{since_s:.1f}"]
        lines.append(",".join([*cells, *(f"{number:.9f}" for number in numbers)]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8-sig")
    return path


# --- DataFlash -----------------------------------------------------------------------------------------
DATAFLASH = {
    "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"),
    "GPS": (8, "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "POS": (10, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "ATT": (11, "QccccCCCCB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw,AEKF"),
    "XKF1": (12, "QBccCfffffffccce", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH"),
    "ORGN": (13, "QBLLe", "TimeUS,Type,Lat,Lng,Alt"),
    "MNT": (14, "QBffffffff", "TimeUS,I,DesRoll,Roll,DesPitch,Pitch,DesYawB,YawB,DesYawE,YawE"),
    "CAM": (15, "QBHIHLLeeefff", "TimeUS,I,Img,GPSTime,GPSWeek,Lat,Lng,Alt,RelAlt,GPSAlt,R,P,Y"),
}
_STRUCTS = {"n": "4s", "N": "16s", "Z": "64s", "c": "h", "C": "H", "e": "i", "E": "I", "L": "i", "M": "B"}


def dataflash(name: str, *values: Any) -> bytes:
    """Encode one message: two marks, its number, and its fields without any padding."""
    number, letters, _ = DATAFLASH[name]
    layout = "<" + "".join(_STRUCTS.get(letter, letter) for letter in letters)
    return b"\xa3\x95" + bytes([number]) + struct.pack(layout, *values)


def definition(name: str) -> bytes:
    """Encode the FMT message that defines another."""
    number, letters, columns = DATAFLASH[name]
    layout = "<" + "".join(_STRUCTS.get(letter, letter) for letter in letters)
    length = 3 + struct.calcsize(layout)
    return dataflash("FMT", number, length, name.encode(), letters.encode(), columns.encode())


def write_dataflash(
    path: Path,
    truth: DroneTruth,
    *,
    kinds: Sequence[str] = ("GPS", "POS", "ATT", "XKF1", "ORGN", "MNT", "CAM"),
    yaw_from_north: bool = True,
) -> Path:
    """Write a log of ArduCopter."""
    log = [definition(name) for name in ("FMT", *kinds)]
    if "ORGN" in kinds:
        place = [round(v) for v in (HOME.latitude_deg * 1e7, HOME.longitude_deg * 1e7, HOME.altitude_m * 100)]
        log += [dataflash("ORGN", BOOT_NS // 1000, 1, 0, 0, 0), dataflash("ORGN", BOOT_NS // 1000, 0, *place)]
    for row, stamp_ns in enumerate(truth.t_ns.tolist()):
        us = int(truth.boot_us[row])
        week, ms = divmod(stamp_ns // 1_000_000 + GPS_LEAP_S * 1000 - 315_964_800_000, 7 * 86_400_000)
        lat, lng = round(truth.latitude_deg[row] * 1e7), round(truth.longitude_deg[row] * 1e7)
        alt_cm = round(truth.altitude_m[row] * 100)
        yaw, pitch, roll = truth.body_ypr_deg[row].tolist()
        turned = round(roll * 100), round(pitch * 100), round(yaw % 360 * 100)
        mount_yaw, mount_pitch, mount_roll = truth.gimbal_ypr_deg[row].tolist()
        from_nose = (mount_yaw - yaw + 180) % 360 - 180
        from_north = mount_yaw if yaw_from_north else float("nan")
        east, north, up = truth.enu[row].tolist()
        messages = {
            "GPS": (us, 0, 3 if row else 1, ms, week, 12, 80, lat, lng, alt_cm, 0, 0, 0, 0, 1),
            "POS": (us, lat, lng, truth.altitude_m[row], up, up),
            "ATT": (us, 0, turned[0], 0, turned[1], 0, turned[2], 0, 0, 3),
            "XKF1": (us, 0, *turned, 0, 0, 0, 0, north, east, -up, 0, 0, 0, 0),
            "MNT": (us, 0, 0, mount_roll, 0, mount_pitch, 0, from_nose, 0, from_north),
            "CAM": (us, 0, row, ms, week, lat, lng, alt_cm, 0, alt_cm, roll, pitch, yaw % 360),
        }
        log += [dataflash(name, *messages[name]) for name in kinds if name in messages]
    path.write_bytes(b"".join(log))
    return path


# --- MAVLink of ground stations ------------------------------------------------------------------------
# Number, checksum's extra byte and layout of each message (common.xml).
MAVLINK = {
    "SYSTEM_TIME": (2, 137, "<QI"),
    "GPS_RAW_INT": (24, 24, "<QiiiHHHHBB"),
    "ATTITUDE": (30, 39, "<Iffffff"),
    "LOCAL_POSITION_NED": (32, 185, "<Iffffff"),
    "GLOBAL_POSITION_INT": (33, 104, "<IiiiihhhH"),
    "GPS_GLOBAL_ORIGIN": (49, 39, "<iii"),
    "CAMERA_TRIGGER": (112, 174, "<QI"),
    "CAMERA_FEEDBACK": (180, 52, "<QiiffffffHBBB"),
    "MOUNT_ORIENTATION": (265, 26, "<Iffff"),
    "GIMBAL_DEVICE_ATTITUDE_STATUS": (285, 137, "<I4ffffIHBB"),
}


def mavlink(
    name: str, *values: Any, stamp_ns: int, system: int = 1, sequence: int = 0, version: int = 2
) -> bytes:
    """Encode one packet behind the station's stamp; version 2 leaves zeros at the end out."""
    number, extra, layout = MAVLINK[name]
    payload = struct.pack(layout, *values)
    if version == 2:
        payload = payload.rstrip(b"\0") or b"\0"
        head = bytes([0xFD, len(payload), 0, 0, sequence % 256, system, 1]) + number.to_bytes(3, "little")
    else:
        head = bytes([0xFE, len(payload), sequence % 256, system, 1, number])
    checksum = 0xFFFF
    for byte in head[1:] + payload + bytes([extra]):  # bit by bit, as X.25 defines it
        checksum ^= byte
        for _ in range(8):
            checksum = checksum >> 1 ^ 0x8408 * (checksum & 1)
    return (stamp_ns // 1000).to_bytes(8, "big") + head + payload + checksum.to_bytes(2, "little")


def write_tlog(
    path: Path, truth: DroneTruth, *, system: int = 1, gps_time: bool = True, version: int = 2
) -> Path:
    """Write the log of a ground station whose clock is 4 s ahead of UTC."""
    log: list[bytes] = []
    place = round(HOME.latitude_deg * 1e7), round(HOME.longitude_deg * 1e7), round(HOME.altitude_m * 1000)
    for row, us in enumerate(truth.boot_us.tolist()):
        ms = round(us / 1000)
        stamp_ns = int(truth.t_ns[row]) + 4_000_000_000
        yaw, pitch, roll = np.radians(truth.body_ypr_deg[row]).tolist()
        lat, lon = round(truth.latitude_deg[row] * 1e7), round(truth.longitude_deg[row] * 1e7)
        alt = round(truth.altitude_m[row] * 1000)
        east, north, up = truth.enu[row].tolist()
        gimbal = _wxyz(*truth.gimbal_ypr_deg[row])
        messages: list[tuple[str, tuple[Any, ...]]] = [
            ("SYSTEM_TIME", ((int(truth.t_ns[row]) // 1000 + ms * 1000 - us) * gps_time, ms)),
            ("GLOBAL_POSITION_INT", (ms, lat, lon, alt, round(up * 1000), 0, 0, 0, 0)),
            ("LOCAL_POSITION_NED", (ms, north, east, -up, 0, 0, 0)),
            ("GPS_GLOBAL_ORIGIN", place),
            ("GPS_RAW_INT", (us, lat, lon, alt, 100, 100, 0, 0, 3, 12)),
            ("ATTITUDE", (ms, roll, pitch, yaw, 0, 0, 0)),
        ]
        if version == 2:
            messages.append(("GIMBAL_DEVICE_ATTITUDE_STATUS", (ms, *gimbal, 0, 0, 0, 0, 64, 0, 0)))
        for name, values in messages:
            about: Any = {"stamp_ns": stamp_ns, "system": system, "version": version}
            log.append(mavlink(name, *values, sequence=len(log), **about))
    path.write_bytes(b"".join(log))
    return path


def tlog_pictures(
    truth: DroneTruth,
    name: str = "CAMERA_FEEDBACK",
    clock: Literal["boot", "utc"] = "utc",
    *,
    lost: int | None = None,
    version: int = 2,
) -> bytes:
    """Encode the packet of a picture for each row, at the row's time; that of the row `lost` is left out."""
    stamps_us = truth.boot_us if clock == "boot" else truth.t_ns // 1000
    packets = []
    for row, us in enumerate(stamps_us.tolist()):
        values = (us, *(0,) * 8, 300 + row, 1, 0, 0) if name == "CAMERA_FEEDBACK" else (us, row)
        if row != lost:
            packets.append(mavlink(name, *values, stamp_ns=int(truth.t_ns[row]), version=version))
    return b"".join(packets)


# --- ULog ----------------------------------------------------------------------------------------------
ULOG = {
    # Padding at the end of a message is defined but not written.
    "vehicle_local_position": (
        "uint64_t timestamp;uint64_t timestamp_sample;uint64_t ref_timestamp;double ref_lat;double ref_lon;"
        "float x;float y;float z;float ref_alt;float eph;float epv;bool xy_valid;bool z_valid;"
        "uint8_t xy_reset_counter;bool xy_global;bool z_global;uint8_t[3] _padding0;",
        "<QQQddffffff??B??",
    ),
    "vehicle_attitude": ("uint64_t timestamp;uint64_t timestamp_sample;float[4] q;", "<QQffff"),
    "vehicle_gps_position": (
        "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;float eph;float epv;"
        "uint8_t fix_type;uint8_t[3] _padding0;",
        "<QQiiiffB",
    ),
    "gimbal_device_attitude_status": (
        "uint64_t timestamp;float[4] q;uint16_t device_flags;uint8_t[6] _padding0;",
        "<QffffH",
    ),
    "camera_trigger": (
        "uint64_t timestamp;uint64_t timestamp_utc;uint32_t seq;uint8_t[4] _padding0;",
        "<QQI",
    ),
}


def ulog_record(kind: str, body: bytes) -> bytes:
    """Encode a record: length, kind and body."""
    return struct.pack("<HB", len(body), ord(kind)) + body


def write_ulog(path: Path, rows: Sequence[tuple[str, int, tuple[Any, ...]]]) -> Path:
    """Write a log of rows (topic, instance, fields in the order of ULOG), stamps in us since boot."""
    log = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", BOOT_NS // 1000), ulog_record("B", bytes(40))]
    log += [ulog_record("F", f"{name}:{fields}".encode()) for name, (fields, _) in ULOG.items()]
    numbers = {key: number for number, key in enumerate(dict.fromkeys(row[:2] for row in rows))}
    for (name, instance), number in numbers.items():
        log.append(ulog_record("A", struct.pack("<BH", instance, number) + name.encode()))
    for name, instance, fields in rows:
        body = struct.pack("<H", numbers[name, instance]) + struct.pack(ULOG[name][1], *fields)
        log.append(ulog_record("D", body))
    path.write_bytes(b"".join(log))
    return path


def ulog_rows(
    truth: DroneTruth, *, from_north: bool = True, origin: Place | None = HOME
) -> list[tuple[str, int, tuple[Any, ...]]]:
    """List PX4's messages: local position, attitude, GPS, gimbal and a trigger for each row."""
    rows: list[tuple[str, int, tuple[Any, ...]]] = []
    for row, us in enumerate(truth.boot_us.tolist()):
        east, north, up = truth.enu[row].tolist()
        reference = (origin.latitude_deg, origin.longitude_deg) if origin else (float("nan"),) * 2
        height = origin.altitude_m if origin else float("nan")
        known = origin is not None
        stamps = (us + 2000, us)  # published 2 ms after it was sampled
        place = (*stamps, 0, *reference, north, east, -up, height, 0.3, 0.5, True, True, 0, known, known)
        utc_us = int(truth.t_ns[row]) // 1000
        lat, lon = round(truth.latitude_deg[row] * 1e7), round(truth.longitude_deg[row] * 1e7)
        fix = (us, utc_us, lat, lon, round(truth.altitude_m[row] * 1000), 1.2, 2.0, 3)
        yaw, pitch, roll = truth.gimbal_ypr_deg[row]
        flags = 4 | 8 | (64 if from_north else 32)
        counted = yaw if from_north else yaw - truth.body_ypr_deg[row, 0]
        rows += [
            ("vehicle_local_position", 0, place),
            ("vehicle_attitude", 0, (*stamps, *_wxyz(*truth.body_ypr_deg[row]))),
            ("vehicle_gps_position", 0, fix),
            ("gimbal_device_attitude_status", 0, (us, *_wxyz(counted, pitch, roll), flags)),
            ("camera_trigger", 0, (us, utc_us, row)),
        ]
    return rows


def _wxyz(*yaw_pitch_roll_deg: float) -> tuple[float, ...]:
    """Compute the quaternion of yaw, pitch, roll by the textbook formula (Diebel 2006, eq. 290), w first."""
    half = np.radians(yaw_pitch_roll_deg) / 2
    (cy, cp, cr), (sy, sp, sr) = np.cos(half).tolist(), np.sin(half).tolist()
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    return w, x, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
