"""Doubts that the logs of a flight's cameras raise by themselves, without any picture."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.session.description import CameraEntry, Doubt
from pipelines.session.records import Trajectory

_MOMENTS = 60
_SAME_PATH_M = 0.1
_SAME_START_M = 0.5
_ONE_BODY_DEG = 45.0  # cameras that are together and look alike are on one drone


def doubts_of_logs(cameras: Mapping[str, tuple[CameraEntry, Trajectory]]) -> list[Doubt]:
    """Find cameras that fly the same path, or whose logs start at the same place.

    Args:
        cameras: entry and logged poses by name.
    """
    moving = {name: camera for name, camera in cameras.items() if not camera[0].poses.static}
    found = (_doubt_of_two(dict(pair)) for pair in combinations(moving.items(), 2))
    return [doubt for doubt in found if doubt is not None]


def _doubt_of_two(pair: Mapping[str, tuple[CameraEntry, Trajectory]]) -> Doubt | None:
    one, other = (track for _, track in pair.values())
    start, end = max(one.t_ns[0], other.t_ns[0]), min(one.t_ns[-1], other.t_ns[-1])
    if start >= end:
        return None
    t_ns = np.linspace(start, end, _MOMENTS)
    apart_m = float(np.median(np.linalg.norm(_place(one, t_ns) - _place(other, t_ns), axis=1)))
    turned_deg = float(np.median(_turned_deg(one, other, t_ns)))
    starts_apart_m = float(np.linalg.norm(one.position[0] - other.position[0]))
    first, second = pair
    if apart_m < _SAME_PATH_M and turned_deg < _ONE_BODY_DEG:
        return Doubt(
            code="pose",
            cameras=[first, second],
            what=f"{first} and {second} fly the same path: one of them has the other's topic or log",
            evidence={"apart_m": round(apart_m, 3), "turned_deg": round(turned_deg, 2)},
            remedy=_topic({name: entry for name, (entry, _) in pair.items()}),
        )
    if starts_apart_m < _SAME_START_M and (apart_m > _SAME_START_M or turned_deg > _ONE_BODY_DEG):
        return Doubt(
            code="origin",
            cameras=[first, second],
            what=f"{first} and {second} start at the same place: each log counts from its own start",
            evidence={"starts_apart_m": round(starts_apart_m, 3), "apart_m": round(apart_m, 3)},
            remedy=f"cameras.{second}.pose.world_from_source: {{translation: [east, north, up]}}",
        )
    return None


def _place(track: Trajectory, t_ns: Float) -> Float:
    since = (track.t_ns - track.t_ns[0]).astype(np.float64)
    at = t_ns - track.t_ns[0]
    return np.stack([np.interp(at, since, track.position[:, axis]) for axis in range(3)], axis=1)


def _turned_deg(one: Trajectory, other: Trajectory, t_ns: Float) -> Float:
    """Return the angles [N] between two attitudes, each the next that was logged."""
    nearest = [
        track.quaternion_xyzw[np.minimum(np.searchsorted(track.t_ns, t_ns), len(track.t_ns) - 1)]
        for track in (one, other)
    ]
    cosine = np.abs((nearest[0] * nearest[1]).sum(axis=1))
    angle: Float = np.degrees(2 * np.arccos(np.clip(cosine, 0, 1)))
    return angle


def _topic(pair: Mapping[str, CameraEntry]) -> str:
    """Return the pose of the camera that has the other's, where names tell it; else ask for both."""
    for name, other in (tuple(pair), tuple(pair)[::-1]):
        poses = pair[name].poses
        stated = poses.topic or poses.source
        if other in stated and name not in stated:
            return f"cameras.{name}.pose.{poses.key}: {stated.replace(other, name)}"
    return "; ".join(f"cameras.{name}.pose: {{log: ..., topic: ...}}  # that of {name}" for name in pair)
