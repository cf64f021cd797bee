"""Doubts that the logs of a flight's cameras raise by themselves, without any picture."""

from collections.abc import Iterable, Mapping
from itertools import combinations

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.poses import interpolate_poses
from pipelines.session.description import CameraEntry, Doubt
from pipelines.session.records import Trajectory

# Paths are compared at so many moments, which is enough for drones.
_MOMENTS = 60
# No team films one person from places that are farther apart.
_ONE_FLIGHT_M = 5000.0
# Cameras that film one person together are nearer to each other than this.
_TEAM_M = 200.0
# Eastings of UTM begin at 166 km, so positions beyond this are projected ones.
_PROJECTED_M = 100_000.0
# No drone that films people flies faster than this.
_TOO_FAST_MPS = 60.0
_UNITS_M = {"cm": 0.01, "mm": 0.001}
# Two drones cannot fly within this distance of each other all the time.
_SAME_PATH_M = 0.1
# Two drones cannot start at places that are nearer to each other than this.
_SAME_START_M = 0.5
# Cameras of one rig are farther apart than this, as in the narrowest stereo cameras.
_LEAST_BASELINE_M = 0.05
# Cameras that film one person together are about so far apart, which tells cm from mm.
_USUALLY_APART_M = 10.0
# Cameras that are together and look alike to this angle are on one drone.
_ONE_BODY_DEG = 45.0


def doubts_of_logs(cameras: Mapping[str, tuple[CameraEntry, Trajectory]]) -> list[Doubt]:
    """Find cameras that fly the same path, or whose logs start at the same place."""
    moving = {name: camera for name, camera in cameras.items() if not camera[0].poses.static}
    doubts = []
    for (first, (entry, one)), (second, (beside, other)) in combinations(moving.items(), 2):
        start, end = max(one.t_ns[0], other.t_ns[0]), min(one.t_ns[-1], other.t_ns[-1])
        if start >= end:
            continue
        t_ns = start + np.linspace(0, end - start, _MOMENTS).astype(np.int64)
        places, turns = zip(*(_poses_at(track, t_ns) for track in (one, other)), strict=True)
        apart_m = float(np.median(np.linalg.norm(places[0] - places[1], axis=1)))
        cosine = np.clip(np.abs((turns[0] * turns[1]).sum(axis=1)), 0, 1)
        turned_deg = float(np.median(np.degrees(2 * np.arccos(cosine))))
        starts_apart_m = float(np.linalg.norm(one.position[0] - other.position[0]))
        poses = entry.poses, beside.poses
        one_source = (poses[0].source, poses[0].topic) == (poses[1].source, poses[1].topic)
        pair, apart = (first, second), round(apart_m, 3)
        if apart_m < _SAME_PATH_M and (turned_deg < _ONE_BODY_DEG or one_source):
            what = f"{first} and {second} fly the same path: one of them has the other's topic or log"
            remedy = _topic({first: entry, second: beside})
            doubts.append(_doubt("pose", pair, what, remedy, apart_m=apart, turned_deg=round(turned_deg, 2)))
        elif starts_apart_m < _SAME_START_M and (apart_m > _SAME_START_M or turned_deg > _ONE_BODY_DEG):
            what = f"{first} and {second} start at the same place: each log counts from its own start"
            remedy = f"cameras.{second}.pose.world_from_source: {{translation: [east, north, up]}}"
            starts_m = round(starts_apart_m, 3)
            doubts.append(_doubt("origin", pair, what, remedy, starts_apart_m=starts_m, apart_m=apart))
    return doubts


def doubt_of_unit(cameras: Mapping[str, Trajectory], units: Mapping[str, str | None]) -> Doubt | None:
    """Find a unit, stated (None: not) or not, in which all cameras stand on one spot or too far apart."""
    middle = [np.median(track.position, axis=0) for track in cameras.values()]
    all_apart = [float(np.linalg.norm(one - other)) for one, other in combinations(middle, 2)]
    if not all_apart:
        return None
    still = [len(track.t_ns) == 1 for track in cameras.values()]
    stated, widest_m = next(iter(units.values())), max(all_apart)
    nearest_m = _LEAST_BASELINE_M if any(still) else _SAME_START_M
    unit = None
    if stated in _UNITS_M and set(units.values()) == {stated}:
        unit = "m" if widest_m < nearest_m and widest_m / _UNITS_M[stated] < _TEAM_M else None
    # Of two drones, one alone may be in another unit or place; still cameras come from one calibration.
    far_m = _TEAM_M if all(still) else _ONE_FLIGHT_M
    tells = (len(middle) > 2 or all(still)) and min(all_apart) > far_m
    if tells or (widest_m > _TEAM_M and all(map(_is_too_fast, cameras.values()))):
        usual = min(_UNITS_M, key=lambda unit: abs(np.log(widest_m * _UNITS_M[unit] / _USUALLY_APART_M)))
        unit = usual if widest_m * _UNITS_M[usual] < _TEAM_M else None
    if unit is None:
        return None
    apart = f"{100 * widest_m:.2g} cm" if widest_m < 1 else f"{widest_m / 1000:.2g} km"
    what = f"all cameras are {apart} apart: their positions are in {unit}"
    remedy = "; ".join(f"cameras.{name}.pose.unit: {unit}" for name in cameras)
    return _doubt("unit", cameras, what, remedy, apart_m=round(widest_m, 4))


def _doubt(code: str, cameras: Iterable[str], what: str, remedy: str, **evidence: float) -> Doubt:
    return Doubt(code=code, cameras=list(cameras), what=what, evidence=dict(evidence), remedy=remedy)


def doubts_of_places(cameras: Mapping[str, Trajectory], map_box: tuple[Float, Float] | None) -> list[Doubt]:
    """Find cameras, and a map (by its corners), that lie too far from the others to be of one flight."""
    middle = {name: np.median(track.position, axis=0) for name, track in cameras.items()}
    doubts = []
    for name, place in middle.items():
        others = [other for key, other in middle.items() if key != name]
        if not others or min(_apart_m(place, other) for other in others) < _ONE_FLIGHT_M:
            continue
        if len(others) == 1 and np.linalg.norm(place[:2]) < np.linalg.norm(others[0][:2]):
            continue  # of two, the one that is farther from the origin
        unit = _unit(place, cameras[name], others)
        apart_m, what = min(_apart_m(place, other) for other in others), f"{name} is far from the others: "
        if unit:
            code, what, remedy = "unit", what + "its unit is another", f"unit: {unit}"
        else:
            what += _elsewhere(place)
            code, remedy = "origin", "world_from_source: {translation: [east, north, up]}"
        remedy = f"cameras.{name}.pose.{remedy}"
        doubts.append(_doubt(code, [name], what, remedy, apart_m=round(apart_m, 1)))
    if map_box is not None:
        low, high = map_box
        away_m = min(_apart_m(place, np.clip(place, low, high)) for place in middle.values())
        if away_m > _ONE_FLIGHT_M:
            what = f"the map lies far from all cameras: {_elsewhere((low + high) / 2)}"
            remedy = "map.crs: EPSG:32632  # that of its coordinates"
            doubts.append(_doubt("origin", [], what, remedy, apart_m=round(away_m, 1)))
    return doubts


def _apart_m(one: Float, other: Float) -> float:
    return float(np.linalg.norm(one[:2] - other[:2]))


def _unit(place: Float, track: Trajectory, others: list[Float]) -> str | None:
    """Return the unit in which a place would lie beside others, if the drone flew too fast for metres."""
    if not _is_too_fast(track):
        return None
    apart_m = {unit: min(_apart_m(place * m, other) for other in others) for unit, m in _UNITS_M.items()}
    nearest = min(apart_m, key=lambda unit: apart_m[unit])
    return nearest if apart_m[nearest] < _ONE_FLIGHT_M / 10 else None


def _is_too_fast(track: Trajectory) -> bool:
    flown_m = float(np.linalg.norm(np.diff(track.position, axis=0), axis=1).sum())
    return flown_m / _TOO_FAST_MPS > float(track.t_ns[-1] - track.t_ns[0]) / 1e9


def _elsewhere(place: Float) -> str:
    """Explain where a place lies, by its numbers."""
    x_m, y_m = place[:2].tolist()
    projected = max(abs(x_m), abs(y_m)) > _PROJECTED_M
    reason = "coordinates of a map projection (UTM)" if projected else "it counts from elsewhere"
    return f"about x {x_m:.0f} m, y {y_m:.0f} m, {reason}"


def _poses_at(track: Trajectory, t_ns: Int64) -> tuple[Float, Float]:
    """Interpolate positions [N, 3] and rotations [N, 4], also across gaps of the log."""
    gap_ns = int(track.t_ns[-1] - track.t_ns[0]) + 1
    return interpolate_poses(track.t_ns, track.position, track.quaternion_xyzw, t_ns, max_gap_ns=gap_ns)


def _topic(pair: Mapping[str, CameraEntry]) -> str:
    """Return the pose of the camera that has the other's, where names tell it; else ask for both."""
    for name, other in (tuple(pair), tuple(pair)[::-1]):
        poses = pair[name].poses
        pose = poses.topic or poses.source
        if other in pose and name not in pose:
            stated = {"pose.file": poses.source, "pose.topic": poses.topic}
            stated |= {"gimbal.file": poses.gimbal_log, "gimbal.topic": poses.gimbal_topic}
            return "; ".join(
                f"cameras.{name}.{key}: {value.replace(other, name)}"
                for key, value in stated.items()
                if value and other in value and (key == "pose.file" or name not in value)
            )
    return "; ".join(f"cameras.{name}.pose: {{file: ..., topic: ...}}  # that of {name}" for name in pair)
