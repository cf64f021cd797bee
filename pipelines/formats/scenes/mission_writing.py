"""Export to mission: the flights of a planner's arms as autopilots and ground stations take them.

The home of a drone lies under its first place, as high as the ground under the actor at the start. Heights,
and north, east and down of setpoints, are relative to it. The nose of the drone looks where the camera does.
Waypoints and setpoints keep the times of the flight. docs/outputs.md describes the files.
"""

import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pandas as pd

from pipelines.formats.common.exporting import safe_file_name, thinned
from pipelines.formats.scenes.mcap_writing import Ros2Recording, topics_of
from pipelines.geometry.arrays import Float, Int64, Place
from pipelines.geometry.geodesy import geodetic_from_enu, place_at
from pipelines.geometry.poses import matrix_from_quaternion
from pipelines.session.errors import DataError
from pipelines.session.records import PlannedArm, Recording, Trajectory

# Between waypoints a drone flies straight at one speed: so far it may then be from its place at any time.
_WAYPOINT_ERROR_M = 0.25
# A camera that looks this far beside the planned direction still has its person in the middle of the picture.
_WAYPOINT_ERROR_DEG = 5.0
# DJI drones refuse waypoints that are nearer to each other than this.
_SHORTEST_LEG_M = 0.5
# Autopilots hold slower speeds badly: a drone waits and then flies at this one.
_SLOWEST_MPS = 0.5
# PX4 leaves offboard mode below 2 Hz.
_SETPOINTS_HZ = 10.0
# DJI drones take off to at least this height.
_LOWEST_TAKE_OFF_M = 1.2
# The namespaces of WPML 1.0.2, which the most drones read.
_KML, _WPML = "http://www.opengis.net/kml/2.2", "http://www.dji.com/wpmz/1.0.2"
# Zip files cannot hold an earlier date, and any other one would differ from run to run.
_ZIP_DATE = (1980, 1, 1, 0, 0, 0)
# The numbers of MAVLink for commands.
_WAYPOINT, _RETURN, _TAKE_OFF, _SPEED, _GIMBAL = 16, 20, 22, 178, 205
# The number of MAVLink for commands without a frame.
_NO_FRAME = 2
# How QGroundControl and MAVLink say that a height counts from home.
_ABOVE_HOME = {"frame": 3, "AltitudeMode": 1, "AMSLAltAboveTerrain": None}
# MAVSDK Drone Show counts a row as part of the trajectory by this number.
_IN_TRAJECTORY = 70
# What MAVSDK Drone Show reads (north, east, down of home; yaw in degrees), then what else operators need.
_COLUMNS = "idx t px py pz vx vy vz ax ay az yaw mode ledr ledg ledb gimbal_pitch latitude longitude height"


@dataclass(frozen=True)
class _Flight:
    """The flight of one drone at T times, as its autopilot counts."""

    home: Place
    t_s: Float  # [T] since the start
    ned: Float  # [T, 3] m, north, east and down of home
    latitude_deg: Float  # [T]
    longitude_deg: Float  # [T]
    heading_deg: Float  # [T] clockwise from north, continuous
    pitch_deg: Float  # [T] of the camera, above the horizon

    @property
    def height_m(self) -> Float:
        """Heights [T] above home."""
        return -self.ned[:, 2]


@dataclass(frozen=True)
class _Waypoint:
    """A waypoint: where it is, and how to come and stay."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    heading_deg: float  # -180 to 180
    pitch_deg: float
    speed_mps: float  # on the way to it
    hold_s: float


class MissionExport:
    """Writer of the missions of every arm that the last comparison flew without breaking a limit."""

    name = "mission"
    title = "a planner's flights for drones: QGroundControl .plan, DJI .kmz, PX4 offboard .csv, ROS 2 .mcap"

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write the missions; note which arms are left out, and what heights count from."""
        arms = recording.planned()
        if not arms:
            raise DataError(recording.name, "holds no planned flights", "run `mocap replan-compare` first")
        place = recording.place
        if place is None:
            problem = "has no place on Earth, where a drone could fly"
            remedy = "write world.origin (latitude_deg, longitude_deg, altitude_m) in flight.yaml"
            raise DataError(recording.name, problem, remedy, code="place-unknown")
        safe = [arm for arm in arms if not arm.broken]
        for arm in arms:
            if arm.broken:
                recording.progress.note(f"mission: {arm.name} is left out, it breaks limits: {arm.broken}")
        if not safe:
            problem, remedy = "has no flight that keeps its limits", "replan with other settings"
            raise DataError(recording.name, problem, remedy, code="limits-broken")
        recording.progress.note(
            "mission: heights count from the ground under the actor at the start: take off at that height"
        )
        paths = []
        for arm in safe:
            start = f"{safe_file_name(recording.name)}_{safe_file_name(arm.name)}"
            paths.append(folder / f"{start}.mcap")
            _write_mcap(paths[-1], arm, place)
            for drone, track in arm.drones.items():
                flight = _flight(track, arm.ground_m, place)
                waypoints = _waypoints(flight)
                own = [f"{start}_{safe_file_name(drone)}{suffix}" for suffix in (".plan", ".kmz", ".csv")]
                plan, kmz, setpoints = (folder / name for name in own)
                _write_plan(plan, flight, waypoints)
                _write_kmz(kmz, flight, waypoints)
                _write_setpoints(setpoints, flight)
                paths += [plan, kmz, setpoints]
        return sorted(paths)


def _flight(track: Trajectory, ground_m: float, world: Place) -> _Flight:
    look = matrix_from_quaternion(track.quaternion_xyzw)[..., 2]
    home = place_at(np.array([*track.position[0, :2], ground_m]), world)
    latitude, longitude, _ = geodetic_from_enu(track.position, world)
    return _Flight(
        home,
        (track.t_ns - track.t_ns[0]) / 1e9,
        (track.position - [*track.position[0, :2], ground_m])[:, [1, 0, 2]] * [1.0, 1.0, -1.0],
        latitude,
        longitude,
        np.degrees(np.unwrap(np.arctan2(look[:, 0], look[:, 1]))),
        np.degrees(np.arcsin(look[:, 2].clip(-1.0, 1.0))),
    )


# --- waypoints -----------------------------------------------------------------------------------------


def _waypoints(flight: _Flight) -> list[_Waypoint]:
    """Return few waypoints, with speeds and waiting times by which the drone keeps to its times."""
    rows, leaving = _bends(flight)
    length_m = np.linalg.norm(np.diff(flight.ned[rows], axis=0), axis=1)
    speed = np.maximum(length_m / (flight.t_s[rows[1:]] - flight.t_s[leaving[:-1]]), _SLOWEST_MPS)
    hold_s = np.append((np.diff(flight.t_s[rows]) - length_m / speed).clip(0.0).round(2), 0.0)
    return [
        _Waypoint(
            float(flight.latitude_deg[row]),
            float(flight.longitude_deg[row]),
            float(flight.height_m[row]),
            float((flight.heading_deg[row] + 180.0) % 360.0 - 180.0),
            float(flight.pitch_deg[row]),
            float(speed[max(k - 1, 0)]),
            float(hold_s[k]),
        )
        for k, row in enumerate(rows.tolist())
    ]


def _bends(flight: _Flight) -> tuple[Int64, Int64]:
    """Choose the rows of waypoints (Ramer, Douglas and Peucker), and for each the row at which it is left."""
    values = np.column_stack(
        [
            flight.ned / _WAYPOINT_ERROR_M,
            flight.heading_deg / _WAYPOINT_ERROR_DEG,
            flight.pitch_deg / _WAYPOINT_ERROR_DEG,
        ]
    )
    last = len(values) - 1
    chosen, spans = {0, last}, [(0, last)]
    while spans:
        a, b = spans.pop()
        share = ((flight.t_s[a : b + 1] - flight.t_s[a]) / (flight.t_s[b] - flight.t_s[a]))[:, None]
        off = values[a : b + 1] - ((1.0 - share) * values[a] + share * values[b])
        off_by = np.maximum(np.linalg.norm(off[:, :3], axis=1), np.abs(off[:, 3:]).max(axis=1))
        bend = a + int(off_by.argmax())
        if off_by.max() > 1.0:
            chosen.add(bend)
            spans += [(a, bend), (bend, b)]
    rows, leaving = [0], [0]
    for row in sorted(chosen)[1:-1]:
        if np.linalg.norm(flight.ned[row] - flight.ned[rows[-1]]) < _SHORTEST_LEG_M:
            leaving[-1] = row
        else:
            rows.append(row)
            leaving.append(row)
    if len(rows) > 1 and np.linalg.norm(flight.ned[last] - flight.ned[rows[-1]]) < _SHORTEST_LEG_M:
        del rows[-1], leaving[-1]
    return np.array([*rows, last]), np.array([*leaving, last])


# --- MAVLink -------------------------------------------------------------------------------------------


def _write_plan(path: Path, flight: _Flight, waypoints: Sequence[_Waypoint]) -> None:
    items = [
        {
            "type": "SimpleItem",
            "doJumpId": number,
            "autoContinue": True,
            "command": command,
            "frame": _NO_FRAME,
            "params": params,
            **(_ABOVE_HOME | {"Altitude": params[6]} if command in (_TAKE_OFF, _WAYPOINT) else {}),
        }
        for number, (command, params) in enumerate(_items(waypoints), 1)
    ]
    home, speed = flight.home, max(waypoint.speed_mps for waypoint in waypoints)
    plan = _template("plan")
    plan["mission"] |= {
        "cruiseSpeed": round(speed, 2),
        "hoverSpeed": round(speed, 2),
        "items": items,
        "plannedHomePosition": [home.latitude_deg, home.longitude_deg, home.altitude_m],
    }
    path.write_text(json.dumps(plan, indent=1) + "\n", encoding="utf-8", newline="\n")


def _template(part: str) -> dict[str, Any]:
    """Return what is the same in all missions: of a plan for PX4, of WPML for a Mavic 3E."""
    content = (Path(__file__).parent / "data" / "mission.json").read_text(encoding="utf-8")
    found: dict[str, Any] = json.loads(content)[part]
    return found


def _items(waypoints: Sequence[_Waypoint]) -> Iterator[tuple[int, list[float]]]:
    """Yield command and parameters of each item; speed and gimbal hold on the way to a waypoint."""
    for k, waypoint in enumerate(waypoints):
        heading, height = round(waypoint.heading_deg, 1), round(waypoint.height_m, 2)
        there = [heading, round(waypoint.latitude_deg, 9), round(waypoint.longitude_deg, 9), height]
        if k == 0:
            yield _TAKE_OFF, [0, 0, 0, *there]
        # A speed of 1 is that over the ground; -1 leaves the throttle alone.
        yield _SPEED, [1, round(waypoint.speed_mps, 2), -1, 0, 0, 0, 0]
        # The last parameter, 2, says that the angles come from here.
        yield _GIMBAL, [round(waypoint.pitch_deg, 1), 0, 0, 0, 0, 0, 2]
        yield _WAYPOINT, [waypoint.hold_s, 0, 0, *there]
    yield _RETURN, [0, 0, 0, 0, 0, 0, 0]


# --- DJI -----------------------------------------------------------------------------------------------

_Values = Mapping[str, Any]


def _write_kmz(path: Path, flight: _Flight, waypoints: Sequence[_Waypoint]) -> None:
    speed = f"{max(waypoint.speed_mps for waypoint in waypoints):.2f}"
    lengths = np.linalg.norm(np.diff(flight.ned, axis=0), axis=1)
    config = _template("config") | {
        "takeOffSecurityHeight": f"{max(waypoints[0].height_m, _LOWEST_TAKE_OFF_M):.2f}",
        "globalTransitionalSpeed": speed,
    }
    template = _template("template") | {"autoFlightSpeed": speed}
    wayline = _template("wayline") | {
        "distance": f"{lengths.sum():.2f}",
        "duration": f"{flight.t_s[-1]:.2f}",
        "autoFlightSpeed": speed,
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, folder in (("template.kml", template), ("waylines.wpml", wayline)):
            points = [
                _placemark(k, waypoint, flight, last=k + 1 == len(waypoints), planned=folder is template)
                for k, waypoint in enumerate(waypoints)
            ]
            info = zipfile.ZipInfo(f"wpmz/{name}", _ZIP_DATE)
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, _document(config, folder, points))


def _placemark(
    index: int, waypoint: _Waypoint, flight: _Flight, *, last: bool, planned: bool
) -> dict[str, Any]:
    """Return the elements of a waypoint, for the template or for the wayline that is flown."""
    height, pitch = f"{waypoint.height_m:.2f}", f"{waypoint.pitch_deg:.1f}"
    stops = index == 0 or last or waypoint.hold_s > 0.0
    if planned:
        heights = {
            "ellipsoidHeight": f"{flight.home.altitude_m + waypoint.height_m:.2f}",
            "height": height,
            **{f"useGlobal{what}": "0" for what in ("Height", "Speed", "HeadingParam", "TurnParam")},
            "gimbalPitchAngle": pitch,
        }
    else:
        heights = {"executeHeight": height}
    actions = {"gimbalRotate": _template("gimbal") | {"gimbalPitchRotateAngle": pitch}}
    if waypoint.hold_s > 0.0:
        actions["hover"] = {"hoverTime": f"{waypoint.hold_s:.2f}"}
    return {
        "index": str(index),
        **heights,
        "waypointSpeed": f"{waypoint.speed_mps:.2f}",
        "waypointHeadingParam": _template("heading")
        | {"waypointHeadingAngle": f"{waypoint.heading_deg:.1f}"},
        "waypointTurnParam": {
            "waypointTurnMode": f"toPointAnd{'Stop' if stops else 'Pass'}WithContinuityCurvature",
            "waypointTurnDampingDist": "0",
        },
        "useStraightLine": "1",
        "actionGroup": {
            "actionGroupId": str(index),
            "actionGroupStartIndex": str(index),
            "actionGroupEndIndex": str(index),
            "actionGroupMode": "sequence",
            "actionTrigger": {"actionTriggerType": "reachPoint"},
            "action": [
                {"actionId": str(k), "actionActuatorFunc": name, "actionActuatorFuncParam": values}
                for k, (name, values) in enumerate(actions.items())
            ],
        },
        "coordinates": f"{waypoint.longitude_deg:.9f},{waypoint.latitude_deg:.9f}",
    }


def _document(config: _Values, folder: _Values, points: Sequence[dict[str, Any]]) -> bytes:
    ET.register_namespace("", _KML)
    ET.register_namespace("wpml", _WPML)
    kml = ET.Element(f"{{{_KML}}}kml")
    document = ET.SubElement(kml, f"{{{_KML}}}Document")
    _add(document, {"missionConfig": config})
    inner = ET.SubElement(document, f"{{{_KML}}}Folder")
    _add(inner, folder)
    for values in points:
        placemark = ET.SubElement(inner, f"{{{_KML}}}Placemark")
        point = ET.SubElement(placemark, f"{{{_KML}}}Point")
        ET.SubElement(point, f"{{{_KML}}}coordinates").text = values.pop("coordinates")
        _add(placemark, values)
    ET.indent(kml)
    return bytes(ET.tostring(kml, encoding="UTF-8", xml_declaration=True))


def _add(parent: ET.Element, values: _Values) -> None:
    for name, value in values.items():
        for one in value if isinstance(value, list) else [value]:
            child = ET.SubElement(parent, f"{{{_WPML}}}{name}")
            if isinstance(one, Mapping):
                _add(child, one)
            else:
                child.text = one


# --- setpoints -----------------------------------------------------------------------------------------


def _write_setpoints(path: Path, flight: _Flight) -> None:
    velocity = np.gradient(flight.ned, flight.t_s, axis=0)
    moved = [flight.ned, velocity, np.gradient(velocity, flight.t_s, axis=0)]
    rows = thinned((flight.t_s * 1e9).astype(np.int64), _SETPOINTS_HZ)
    where = [flight.latitude_deg, flight.longitude_deg, flight.height_m]
    no_light = np.zeros((len(flight.t_s), 4))
    values = [flight.t_s, *moved, flight.heading_deg % 360.0, no_light, flight.pitch_deg, *where]
    number, *names = _COLUMNS.split()
    table = pd.DataFrame(np.column_stack(values)[rows], columns=names).rename_axis(number)
    places = {name: 9 if name in ("latitude", "longitude") else 4 for name in names}
    table = table.round(places).astype({"ledr": int, "ledg": int, "ledb": int})
    table.assign(mode=_IN_TRAJECTORY).to_csv(path, lineterminator="\n")


def _write_mcap(path: Path, arm: PlannedArm, world: Place) -> None:
    """Write one message for each drone: the drone, level with its nose ahead, and its camera (z ahead)."""
    start_ns = max(0, min(int(track.t_ns[0]) for track in arm.drones.values()))
    header = {"stamp": start_ns, "frame_id": "world"}
    with Ros2Recording(path) as log:
        place = dict(zip(("latitude", "longitude", "altitude"), astuple(world), strict=True))
        log.write("/origin", "sensor_msgs/msg/NavSatFix", start_ns, {"header": header, **place})
        for drone, topic in topics_of(list(arm.drones)).items():
            track = arm.drones[drone]
            since_ns = track.t_ns - track.t_ns[0]
            rows = thinned(track.t_ns, _SETPOINTS_HZ)
            look = matrix_from_quaternion(track.quaternion_xyzw)[..., 2]
            half = np.arctan2(look[:, 1], look[:, 0]) / 2.0
            velocity = np.gradient(track.position, since_ns / 1e9, axis=0)
            points = []
            for row in rows.tolist():
                at = dict(zip("xyz", track.position[row].tolist(), strict=True))
                camera = dict(zip("xyzw", track.quaternion_xyzw[row].tolist(), strict=True))
                level = {"z": float(np.sin(half[row])), "w": float(np.cos(half[row]))}
                moved = {"linear": dict(zip("xyz", velocity[row].tolist(), strict=True))}
                points.append(
                    {
                        "transforms": [
                            {"translation": at, "rotation": level},
                            {"translation": at, "rotation": camera},
                        ],
                        "velocities": [moved, moved],
                        "time_from_start": int(since_ns[row]),
                    }
                )
            fields = {"header": header, "joint_names": [drone, f"{drone}/camera"], "points": points}
            log.write(f"{topic}/trajectory", "trajectory_msgs/msg/MultiDOFJointTrajectory", start_ns, fields)


EXPORT = MissionExport()
