"""Spellings of earlier versions of flight.yaml, which are refused with the new one.

This module can be deleted when nobody has such files any more.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

_FILE_OF = {
    "cameras.*.video": ("path", "log"),
    "cameras.*.frame_times": ("csv", "srt", "log", "ulog", "ardupilot", "tlog"),
    "cameras.*.pose": (
        *("log", "tum", "csv", "static", "dji", "ulog", "ardupilot", "tlog", "gopro", "klv", "parrot"),
    ),
    "cameras.*.gimbal": ("log", "dji", "gopro", "parrot"),
    "cameras.*.intrinsics": ("path", "log"),
    "cameras.*.keypoints": ("path",),
    "logs.*": ("path",),
    "actor": ("log",),
    "actors.*": ("log",),
    "map": ("path", "log"),
}
"""Keys that named a file by its type, by the mapping in which they stood."""

OLD_SPELLINGS: dict[str, str] = {
    **{f"{place}.{old}": f"{place}.file" for place, keys in _FILE_OF.items() for old in keys},
    "cameras.*.gimbal.fixed": "cameras.*.gimbal: {yaw_deg, pitch_deg, roll_deg}",
    "cameras.*.mount.body_from_camera": "cameras.*.mount: {translation, rotation_xyzw}",
    "logs.*.world_from_log": "logs.*.world_from_source",
    "truth.joints": "truth.file",
    "plan.log": "plan: {CAMERA: {file, topic}}",
    "plan.topics": "plan: {CAMERA: {file, topic}}",
    "plan.files": "plan: {CAMERA: {file}}",
}
"""Old spellings and the new ones; `*` is any name."""


_UP = {"z-up": "z", "y-up": "y"}
"""Values of `truth.axes` that are values of `truth.up` now."""


def old_spellings(flight: Mapping[object, object]) -> list[str]:
    """List the old spellings in a manifest, each with the new one."""
    found = []
    for old, new in OLD_SPELLINGS.items():
        for names in _matches(flight, old.split(".")):
            place = _filled(old, names)
            found.append(f"{place}: is now {_filled(new, names).removeprefix(_parent(place))}")
    truth = flight.get("truth")
    axes = truth.get("axes") if isinstance(truth, Mapping) else None
    return found + ([f"truth.axes: {axes} is now truth.up: {_UP[axes]}"] if axes in _UP else [])


def _matches(mapping: object, keys: list[str]) -> Iterator[list[str]]:
    """Yield what stands for each `*` wherever the keys exist."""
    if not keys:
        yield []
    elif isinstance(mapping, Mapping):
        for key in list(mapping) if keys[0] == "*" else [keys[0]]:
            if key in mapping:
                for names in _matches(mapping[key], keys[1:]):
                    yield [str(key), *names] if keys[0] == "*" else names


def _filled(pattern: str, names: list[str]) -> str:
    listed = iter(names)
    return "".join(next(listed) if part == "*" else part for part in pattern)


def _parent(place: str) -> str:
    """Return what the new spelling need not repeat: the camera."""
    parts = place.split(".")
    return "".join(f"{part}." for part in parts[:-2]) if len(parts) > 3 else ""
