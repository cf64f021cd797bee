"""Ground stations' telemetry logs (.tlog): MAVLink packets, each behind the station's clock.

Layout: 8 bytes of microseconds since 1970 (big endian), then one packet of MAVLink 1 or 2, found here by its
checksum, also behind damaged bytes; pymavlink (extra `drones`) knows the messages. Position, attitude and
gimbal become the columns of PX4's topics. Pictures are timed by CAMERA_FEEDBACK or by CAMERA_TRIGGER.
"""

from __future__ import annotations

import binascii
import mmap
import re
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, MutableMapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipelines.formats.common.files import first_bytes
from pipelines.formats.drone_logs.telemetry_rows import (
    Boots,
    DroneLog,
    find_boots,
    fit_gps_time,
    of_angles,
    on_gps_time,
    pictures_on_gps_time,
    refuse_marks,
)
from pipelines.formats.drone_logs.ulog import Columns, UlogTopic, telemetry_of
from pipelines.geometry.arrays import ClockFit, Float, Int64
from pipelines.geometry.clocks import fit_clock
from pipelines.session.errors import DataError
from pipelines.session.records import Telemetry
from pipelines.session.registries import TelemetryChoice, need
from pipelines.session.storage import damaged

# The station's clock takes this many bytes before each packet.
_STAMP = 8
_MARKS = re.compile(rb"[\xfd\xfe]")
# Chance makes so many marks without a packet in 25 MB; a log full of damage has more.
_MOST_WRONG = (
    200_000  # marks without a packet, and ten for each packet: 25 MB of chance in a log full of damage
)
_SIGNED, _SIGNATURE = 1, 13  # flag in a packet of MAVLink 2, and the bytes of its signature
_REVERSED = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))
# Larger stamps do not fit int64 in nanoseconds.
_LARGEST_US = 2**62
_LIKE_PACKETS = re.compile(
    rb"\0[\0-\x0f].{6}[\xfd\xfe]", re.DOTALL
)  # a clock until 2100, and a packet's first byte
# Packets must begin within so many bytes of a file with the name of a log.
_SEARCHED = 64 * 1024
_FIRST_US, _LAST_US = 946_684_800_000_000, 4_102_444_800_000_000  # the years 2000 and 2100
# Stamps in microseconds above this count from 1970, others from boot.
_UNIX_US = 10**15
_YAW_IN_VEHICLE, _YAW_IN_EARTH = 32, 64  # GIMBAL_DEVICE_FLAGS

_SYSTEM_TIME, _GPS_RAW_INT, _ATTITUDE, _ATTITUDE_QUATERNION = 2, 24, 30, 31
_LOCAL_POSITION, _GLOBAL_POSITION, _ORIGIN = 32, 33, 49
_MOUNT_ORIENTATION, _GIMBAL_DEVICE = 265, 285
_CAMERA_TRIGGER, _CAMERA_FEEDBACK = 112, 180
_POSITIONS = frozenset({_GLOBAL_POSITION, _LOCAL_POSITION, _GPS_RAW_INT})
_PICTURES = frozenset({_CAMERA_FEEDBACK, _CAMERA_TRIGGER})
_WANTED = frozenset(
    _POSITIONS
    | _PICTURES
    | {_SYSTEM_TIME, _ATTITUDE, _ATTITUDE_QUATERNION, _ORIGIN, _MOUNT_ORIENTATION, _GIMBAL_DEVICE}
)


class TlogFormat(DroneLog):
    """Reader of ground stations' logs of MAVLink (Mission Planner, QGroundControl, MAVProxy)."""

    name = "tlog"
    title = "ground station's log (MAVLink)"
    suffixes: tuple[str, ...] = (".tlog", ".mavlink")
    choices: tuple[str, ...] = ("position", "instance", "time")

    def recognises(self, path: Path) -> bool:
        """Return True if it begins with three packets behind plausible times, by its name after damage."""
        if _are_packets(first_bytes(path, 1024), 0):
            return True
        head = first_bytes(path, _SEARCHED, suffixes=self.suffixes)
        return any(_are_packets(head, match.start()) for match in _LIKE_PACKETS.finditer(head))

    def vehicles(self, path: Path) -> list[int]:
        """List the numbers of the systems that say where they are; errors as for `read_telemetry`."""
        return _read(path).vehicles()

    def read_telemetry(self, path: Path, choice: TelemetryChoice) -> Telemetry:
        """Read position, attitude and gimbal of one vehicle; `instance` is its system's number."""
        log = _read(path)
        system = _vehicle(path, log, choice.instance, _POSITIONS)
        notes = [f"took vehicle {system}"] if len(log.vehicles()) > 1 else []
        notes += log.boots(system).notes()
        fit, station = log.gps_time(system), None
        if fit is None and choice.time is None:
            fit = station = log.station_time(system)
            if fit is not None:
                notes.append("holds no GPS time: its stamps are turned to the ground station's clock")
        else:
            fit = on_gps_time(path, fit, choice.time, notes)
        topics = _topics(log, system)
        kinds = {"vehicle_global_position": "global", "vehicle_local_position": "local"}
        there = next((kind for name, kind in kinds.items() if any(t.name == name for t in topics)), None)
        asked = choice.model_copy(update={"instance": None, "position": choice.position or there})
        found = telemetry_of(path, topics, asked, fit, notes)
        found = replace(found, dropped=dict(Counter(found.dropped) + Counter(log.dropped)))
        return replace(found, clock="the ground station's clock", fit=None) if station else found

    def picture_times(self, path: Path, choice: TelemetryChoice) -> Int64:
        """Read the times of pictures, ns [N], increasing: CAMERA_FEEDBACK, else CAMERA_TRIGGER."""
        log = _read(path)
        system = _vehicle(path, log, choice.instance, _PICTURES)
        kind = _CAMERA_FEEDBACK if (system, _CAMERA_FEEDBACK) in log.payloads else _CAMERA_TRIGGER
        columns = log.columns(system, kind)
        number = columns["img_idx" if kind == _CAMERA_FEEDBACK else "seq"].astype(np.int64)
        stamps_us = columns["time_usec"].astype(np.float64)
        timed = (stamps_us > 0) & (stamps_us < _LAST_US)
        stamps_us, numbers = columns["time_usec"][timed].astype(np.int64), np.unique(number[timed])
        drones_own = "take the times of frames from the drone's own log (.bin, .ulg) or otherwise"
        is_utc = stamps_us > _UNIX_US
        if not len(stamps_us) or (is_utc.any() and not is_utc.all()):
            problem = (
                "mixes times of its pictures since boot and in UTC" if len(stamps_us) else "states no time"
            )
            raise DataError(path, f"{problem} for its pictures", drones_own, code="clock-unknown")
        if (lost := int(numbers[-1] - numbers[0]) + 1 - len(numbers)) > 0:
            problem = f"lacks {lost} of the pictures between {numbers[0]} and {numbers[-1]}"
            raise DataError(path, f"{problem}: their packets did not arrive", drones_own)
        if is_utc.all():
            if choice.time == "boot":
                raise DataError(path, "states the times of its pictures in UTC", "leave time: boot out")
            return np.unique(stamps_us * 1000)
        fit = log.gps_time(system)
        if fit is None and choice.time is None:
            fit = log.station_time(system)
        return pictures_on_gps_time(path, stamps_us * 1000, fit, choice)


def _vehicle(path: Path, log: _Packets, stated: int | None, messages: frozenset[int]) -> int:
    """Return the system's number that is stated, or the only one that sent any of the messages."""
    vehicles = log.vehicles(messages)
    listed = ", ".join(map(str, vehicles)) or "none"
    names = " or ".join(sorted(log.dialect.mavlink_map[message].msgname for message in messages))
    if stated is not None:
        if stated not in vehicles:
            raise DataError(path, f"has no {names} of system {stated}", f"there are systems {listed}")
        return stated
    if not vehicles:
        raise DataError(path, f"has no {names}", "give another log")
    if len(vehicles) > 1:
        problem = f"holds {len(vehicles)} vehicles (systems {listed})"
        raise DataError(path, problem, "say which with `instance:`", code="ambiguous")
    return vehicles[0]


def _topics(log: _Packets, system: int) -> list[UlogTopic]:
    """Make PX4's topics of the messages of one vehicle; each is labelled with the name of its message."""
    topics: list[UlogTopic] = []

    def add(name: str, message: int, columns: Columns) -> None:
        if len(columns["timestamp"]):
            topics.append(UlogTopic(name, 0, columns, log.dialect.mavlink_map[message].msgname))

    place = log.columns(system, _GLOBAL_POSITION)
    scaled = {"lat": place["lat"] * 1e-7, "lon": place["lon"] * 1e-7, "alt": place["alt"] * 1e-3}
    if place["lat"].any() or place["lon"].any():
        add("vehicle_global_position", _GLOBAL_POSITION, {"timestamp": _boot_us(place), **scaled})
    local, origin = log.columns(system, _LOCAL_POSITION), log.columns(system, _ORIGIN)
    columns = {"timestamp": _boot_us(local), **{axis: local[axis] for axis in "xyz"}}
    if len(origin["latitude"]):
        names = (("ref_lat", "latitude", 1e-7), ("ref_lon", "longitude", 1e-7), ("ref_alt", "altitude", 1e-3))
        columns |= {ref: np.full(len(local["x"]), origin[name][-1] * unit) for ref, name, unit in names}
    columns["xy_global"] = np.full(len(local["x"]), len(origin["latitude"]))
    add("vehicle_local_position", _LOCAL_POSITION, columns)
    gps = log.columns(system, _GPS_RAW_INT)
    since_boot = gps["time_usec"] < _UNIX_US
    fit = log.gps_time(system)
    ahead_us = 0 if fit is None else fit.offset_ns // 1000
    stamps = np.where(since_boot, gps["time_usec"], gps["time_usec"] - ahead_us)
    fixes = {name: gps[name] for name in ("lat", "lon", "alt", "fix_type")}
    add("vehicle_gps_position", _GPS_RAW_INT, {**fixes, "timestamp": stamps.astype(np.int64)})
    turned, attitude = log.columns(system, _ATTITUDE_QUATERNION), _ATTITUDE_QUATERNION
    if len(turned["q1"]):
        body = np.stack([turned[f"q{k}"] for k in range(1, 5)], axis=1)
    else:
        turned, attitude = log.columns(system, _ATTITUDE), _ATTITUDE
        body = _wxyz(np.stack([turned[name] for name in ("yaw", "pitch", "roll")], axis=1))
    add("vehicle_attitude", attitude, {"timestamp": _boot_us(turned), **_quaternion(body)})
    device = log.columns(system, _GIMBAL_DEVICE)
    if len(device["flags"]):
        gimbal = np.stack([device[f"q[{k}]"] for k in range(4)], axis=1)
        columns = {"timestamp": _boot_us(device), "device_flags": device["flags"], **_quaternion(gimbal)}
        add("gimbal_device_attitude_status", _GIMBAL_DEVICE, columns)
        return topics
    mount = log.columns(system, _MOUNT_ORIENTATION)  # degrees; yaw_absolute is NaN where it is not known
    from_north = np.isfinite(mount["yaw_absolute"])
    yaw = np.where(from_north, mount["yaw_absolute"], mount["yaw"])
    gimbal = _wxyz(np.radians(np.stack([yaw, mount["pitch"], mount["roll"]], axis=1)))
    flags = np.where(from_north, _YAW_IN_EARTH, _YAW_IN_VEHICLE)
    columns = {"timestamp": _boot_us(mount), "device_flags": flags, **_quaternion(gimbal)}
    add("gimbal_device_attitude_status", _MOUNT_ORIENTATION, columns)
    return topics


def _boot_us(columns: Columns) -> Int64:
    return np.asarray(columns["time_boot_ms"] * 1000).astype(np.int64)


def _wxyz(yaw_pitch_roll_rad: Float) -> Float:
    x, y, z, w = of_angles(np.degrees(yaw_pitch_roll_rad)).T
    return np.stack([w, x, y, z], axis=1)


def _quaternion(wxyz: Float) -> dict[str, Float]:
    return {f"q[{k}]": column for k, column in enumerate(wxyz.T)}


class _MavlinkPacket(NamedTuple):
    stamp_us: int
    system: int
    message: int
    payload: bytes


@dataclass
class _Packets:
    """Wanted packets of a log, and the number of all."""

    dialect: Any
    count: int = 0
    payloads: dict[tuple[int, int], bytearray] = field(default_factory=dict)  # by system and message
    stamps_us: dict[tuple[int, int], array[int]] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)
    _boots: dict[int, Boots] = field(default_factory=dict)  # by system

    def vehicles(self, messages: frozenset[int] = _POSITIONS) -> list[int]:
        """List the systems that sent any of the messages; by default, those that say where they are."""
        return sorted({system for system, message in self.payloads if message in messages})

    def columns(self, system: int, message: int) -> dict[str, Any]:
        """Return the fields of all messages of a kind, [N] each; those of an array are `q[0]`, `q[1]`, ..."""
        kind = self.dialect.mavlink_map[message]
        names: list[str] = []
        for name, length in zip(kind.ordered_fieldnames, kind.array_lengths, strict=True):
            names += [f"{name}[{k}]" for k in range(length)] if length else [name]
        rows = list(kind.unpacker.iter_unpack(bytes(self.payloads.get((system, message), b""))))
        columns = zip(*rows, strict=True) if rows else ((),) * len(names)
        found = {name: np.array(column) for name, column in zip(names, columns, strict=True)}
        for name, unit_ns in (("time_boot_ms", 1_000_000), ("time_usec", 1000)):
            if rows and name in found and self.boots(system).places.size:
                stamps_us = np.array(self.stamps_us[system, message], dtype=np.int64)
                stated = found[name].astype(np.int64)
                going_on = self.boots(system).going_on(stated * unit_ns, stamps_us) // unit_ns
                # Times in UTC go on by themselves.
                found[name] = np.where((stated >= 0) & (stated < _UNIX_US), going_on, stated)
        return found

    def boots(self, system: int) -> Boots:
        """Find the restarts of a vehicle; places are stamps of the station, us."""
        if system not in self._boots:
            none = np.zeros(0, np.int64)
            self._boots[system] = find_boots(none, none, none, none, none)
            frequent = next(
                (m for m in (_ATTITUDE, _GLOBAL_POSITION, _LOCAL_POSITION) if (system, m) in self.stamps_us),
                None,
            )
            if frequent is not None:
                boot_ns = _boot_us(self.columns(system, frequent)) * 1000
                stamps_us = np.array(self.stamps_us[system, frequent], dtype=np.int64)
                utc = self.columns(system, _SYSTEM_TIME)
                utc_us = utc["time_unix_usec"].astype(np.int64)
                utc_places = np.array(self.stamps_us.get((system, _SYSTEM_TIME), ()), dtype=np.int64)
                found = find_boots(boot_ns, stamps_us, _boot_us(utc) * 1000, utc_us * 1000, utc_places)
                if (utc_us < _UNIX_US).any() or not found.known.all():
                    found = find_boots(boot_ns, stamps_us, boot_ns, stamps_us * 1000, stamps_us)
                self._boots[system] = found
        return self._boots[system]

    def gps_time(self, system: int) -> ClockFit | None:
        """Fit UTC to the time since boot; None if the vehicle does not know it."""
        columns = self.columns(system, _SYSTEM_TIME)
        unix_us = columns["time_unix_usec"].astype(np.int64)
        known = unix_us > _UNIX_US
        return fit_gps_time(_boot_us(columns)[known] * 1000, unix_us[known] * 1000)

    def station_time(self, system: int) -> ClockFit | None:
        """Fit the station's clock to the time since boot."""
        for message in (_ATTITUDE, _GLOBAL_POSITION, _LOCAL_POSITION):
            if stamps_us := self.stamps_us.get((system, message)):
                boot_us = _boot_us(self.columns(system, message))
                return fit_clock(boot_us * 1000, np.array(stamps_us, dtype=np.int64) * 1000)
        return None


def _read(path: Path) -> _Packets:
    found = _Packets(need("pymavlink.dialects.v20.ardupilotmega", "drones"))
    try:
        refuse_marks(path, b"\xfe", b"\xfd")
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            for packet in _packets(content, found.dialect.mavlink_map, found.dropped):
                if packet.stamp_us > _LARGEST_US:
                    found.dropped["absurd stamp"] = found.dropped.get("absurd stamp", 0) + 1
                    continue
                found.count += 1
                if packet.message in _WANTED:
                    key = packet.system, packet.message
                    size = found.dialect.mavlink_map[packet.message].unpacker.size
                    # MAVLink 2 leaves zeros at the end out; newer definitions are longer than older packets.
                    found.payloads.setdefault(key, bytearray()).extend(
                        packet.payload[:size].ljust(size, b"\0")
                    )
                    found.stamps_us.setdefault(key, array("q")).append(packet.stamp_us)
    except (OSError, ValueError) as error:  # ValueError: an empty file cannot be mapped
        raise damaged(path, error) from error
    if not found.count:
        problem = "holds no packet of MAVLink"
        raise DataError(path, problem, "give the .tlog that the ground station wrote", code="wrong-kind")
    return found


def _packets(
    content: mmap.mmap, definitions: Mapping[int, Any], dropped: MutableMapping[str, int]
) -> Iterator[_MavlinkPacket]:
    """Yield the packets whose checksum is right; stretches without any are counted."""
    place, in_order, right, wrong = 0, True, 0, 0
    while place + _STAMP < len(content):
        packet = _packet(content, place, definitions)
        if packet is not None:
            in_order = True
            right += 1
            yield packet
            place += _STAMP + (_packet_size(content, place + _STAMP) or 0)
            continue
        wrong += 1
        if wrong > _MOST_WRONG + 10 * right:
            raise ValueError(f"only {right} of {right + wrong} packets have the right checksum")
        following = _MARKS.search(content, place + _STAMP + 1)
        if in_order:
            cause = "cut off" if following is None else "damaged stretch"
            dropped[cause] = dropped.get(cause, 0) + 1
            in_order = False
        if following is None:
            return
        place = following.start() - _STAMP
    if place < len(content) and in_order:
        dropped["cut off"] = dropped.get("cut off", 0) + 1


def _packet(content: mmap.mmap, place: int, definitions: Mapping[int, Any]) -> _MavlinkPacket | None:
    """Read the packet behind a stamp; None if there is no whole one, or its checksum is wrong."""
    start = place + _STAMP
    size = _packet_size(content, start)
    if size is None or start + size > len(content):
        return None
    packet = content[start : start + size]
    if packet[0] == 0xFE:
        head, system, message = 6, packet[3], packet[5]
    else:
        head, system, message = 10, packet[5], int.from_bytes(packet[7:10], "little")
    end = head + packet[1]
    if message in definitions:
        stated = int.from_bytes(packet[end : end + 2], "little")
        if _checksum(packet[1:end] + bytes([definitions[message].crc_extra])) != stated:
            return None
    elif start + size + _STAMP < len(content) and content[start + size + _STAMP] not in {0xFD, 0xFE}:
        return None  # of an unknown message only its length can be tested
    stamp_us = int.from_bytes(content[place:start], "big")
    return _MavlinkPacket(stamp_us, system, message, packet[head:end])


def _are_packets(head: bytes, place: int) -> bool:
    """Test if three packets behind plausible times follow each other."""
    for _ in range(3):
        stamp_us = int.from_bytes(head[place : place + _STAMP], "big")
        size = _packet_size(head, place + _STAMP)
        if size is None or not _FIRST_US < stamp_us < _LAST_US:
            return False
        place += _STAMP + size
    return True


def _packet_size(content: bytes | mmap.mmap, start: int) -> int | None:
    """Return the size of a packet by its head; None if none begins there."""
    head = content[start : start + 3]
    if len(head) < 3 or head[0] not in {0xFD, 0xFE}:
        return None
    if head[0] == 0xFE:
        return head[1] + 8
    return int(head[1] + 12 + _SIGNATURE * (head[2] & _SIGNED))


def _checksum(content: bytes) -> int:
    """Compute MAVLink's checksum (CRC-16/MCRF4XX): that of `crc_hqx` with all bits reversed."""
    reverse = binascii.crc_hqx(content.translate(_REVERSED), 0xFFFF)
    return int(f"{reverse:016b}"[::-1], 2)


FORMAT = TlogFormat()
