"""Export to mission: other readers find each waypoint and setpoint on the circle that was planned."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pandas as pd
import pytest
from rosbags.highlevel import AnyReader

from pipelines.formats.scenes.mission_writing import EXPORT
from pipelines.geometry.arrays import Float, Place
from pipelines.geometry.geodesy import enu_from_geodetic
from pipelines.geometry.poses import look_at, matrix_from_quaternion
from pipelines.session.records import PlannedArm, Recording, Trajectory
from tests.formats.exported import START_NS, Listener
from tests.raising import refused

WORLD = Place(47.4, 8.5, 420.0)
GROUND_M, HIPS = 2.0, np.array([5.0, -3.0, 3.0])
T_S = np.arange(0, 40.01, 0.05)
KML = {"kml": "http://www.opengis.net/kml/2.2", "wpml": "http://www.dji.com/wpmz/1.0.2"}


def circling() -> Trajectory:
    """Make a drone that flies a circle of 10 m about the hips, 5 m above, at 1.6 m/s after 4 s."""
    angle = 0.16 * (T_S - 4.0).clip(0.0)
    position = HIPS + np.stack([10 * np.cos(angle), 10 * np.sin(angle), np.full(len(angle), 5.0)], axis=1)
    return Trajectory(START_NS + (T_S * 1e9).astype(np.int64), position, look_at(position, HIPS))


def planned(**changes: Any) -> Recording:
    arm = PlannedArm("adaptive", {"drone 1": circling()}, GROUND_M)
    broken = replace(arm, name="fixed", broken="clearance 3 times")
    return replace(Recording("Walk", None, {}, planned=lambda: [arm, broken], place=WORLD), **changes)


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mission")
    written = EXPORT.write(planned(), folder)
    named = [f"Walk_adaptive{end}" for end in (".mcap", "_drone_1.csv", "_drone_1.kmz", "_drone_1.plan")]
    assert [path.name for path in written] == named  # nothing of the arm that breaks a limit
    return folder


def positions(latitude: Any, longitude: Any, height: Any) -> Float:
    """Return world positions [N, 3] of latitudes and longitudes, with heights above home."""
    heights = np.asarray(height) + GROUND_M + WORLD.altitude_m
    return enu_from_geodetic(np.asarray(latitude), np.asarray(longitude), heights, WORLD)


def assert_flown(position: Float, speed_mps: Float, hold_s: Float) -> None:
    """Require that straight legs at these speeds, with waits, keep the place at every time."""
    track = circling()
    length_m = np.linalg.norm(np.diff(position, axis=0), axis=1)
    arrives_s = np.concatenate([[0.0], np.cumsum(hold_s[:-1] + length_m / speed_mps[1:])])
    t_s = np.column_stack([arrives_s, arrives_s + hold_s + 1e-9]).ravel()
    there = np.column_stack([np.interp(T_S, t_s, np.repeat(axis, 2)) for axis in position.T])
    assert len(position) < 40
    assert np.linalg.norm(there - track.position, axis=1).max() < 0.6


def test_mavlink_packs_every_item_of_the_plan(mission: Path) -> None:
    plan = json.loads((mission / "Walk_adaptive_drone_1.plan").read_text(encoding="utf-8"))
    assert (plan["fileType"], plan["version"], plan["mission"]["version"]) == ("Plan", 1, 2)
    items = plan["mission"]["items"]
    mavlink = pytest.importorskip("pymavlink.dialects.v20.common")
    sender = mavlink.MAVLink(None)
    packed = []
    for number, item in enumerate(items, 1):
        assert (item["type"], item["doJumpId"]) == ("SimpleItem", number)
        p, (x, y, z) = item["params"][:4], item["params"][4:]
        there = (round(x * 1e7), round(y * 1e7), z)
        frame, command = item["frame"], item["command"]
        sent = mavlink.MAVLink_mission_item_int_message(1, 1, number, frame, command, 0, 1, *p, *there)
        packed.append(mavlink.MAVLink(None).decode(bytearray(sent.pack(sender))))
    assert packed[0].command == mavlink.MAV_CMD_NAV_TAKEOFF
    assert packed[-1].command == mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH
    points = [item for item in packed if item.command == mavlink.MAV_CMD_NAV_WAYPOINT]
    assert {item.frame for item in points} == {mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT}
    speeds = [item.param2 for item in packed if item.command == mavlink.MAV_CMD_DO_CHANGE_SPEED]
    pitches = [item.param1 for item in packed if item.command == mavlink.MAV_CMD_DO_MOUNT_CONTROL]
    position = positions([i.x / 1e7 for i in points], [i.y / 1e7 for i in points], [i.z for i in points])
    assert_flown(position, np.array(speeds), np.array([item.param1 for item in points]))
    np.testing.assert_allclose(pitches, np.degrees(np.arctan2(-5, 10)), atol=0.06)
    aim = HIPS - position
    turned = np.radians([item.param4 for item in points]) - np.arctan2(aim[:, 0], aim[:, 1])
    np.testing.assert_allclose(np.cos(turned), 1.0, atol=1e-4)
    latitude, longitude, height = np.array(plan["mission"]["plannedHomePosition"])
    home = enu_from_geodetic(latitude, longitude, height, WORLD)
    np.testing.assert_allclose(home, [*position[0, :2], GROUND_M], atol=0.02)


def test_dji_has_the_same_waypoints_in_template_and_wayline(mission: Path) -> None:
    with zipfile.ZipFile(mission / "Walk_adaptive_drone_1.kmz") as archive:
        assert archive.namelist() == ["wpmz/template.kml", "wpmz/waylines.wpml"]
        template, wayline = (ET.parse(archive.open(name)) for name in archive.namelist())  # noqa: S314
    found = {}
    for root, height in ((template, "height"), (wayline, "executeHeight")):
        points = root.findall(".//kml:Placemark", KML)
        assert [point.findtext("wpml:index", "", KML) for point in points] == list(
            map(str, range(len(points)))
        )
        places = [point.findtext("kml:Point/kml:coordinates", "", KML).split(",") for point in points]
        longitude, latitude = np.array(places, dtype=float).T
        heights = [float(point.findtext(f"wpml:{height}", "", KML)) for point in points]
        found[height] = positions(latitude, longitude, heights)
    np.testing.assert_array_equal(found["height"], found["executeHeight"])
    speeds = [float(point.findtext("wpml:waypointSpeed", "", KML)) for point in points]
    holds = [float(point.findtext(".//wpml:hoverTime", "0", KML)) for point in points]
    assert_flown(found["height"], np.array(speeds), np.array(holds))
    pitches = [float(point.findtext(".//wpml:gimbalPitchRotateAngle", "", KML)) for point in points]
    np.testing.assert_allclose(pitches, np.degrees(np.arctan2(-5, 10)), atol=0.06)


def test_offboard_setpoints_are_ten_a_second_from_home(mission: Path) -> None:
    table = pd.read_csv(mission / "Walk_adaptive_drone_1.csv", index_col="idx")
    track = circling()
    np.testing.assert_allclose(table["t"], np.arange(len(table)) / 10, atol=1e-9)
    north_east_down = np.column_stack(
        [
            track.position[:, 1] - track.position[0, 1],
            track.position[:, 0] - track.position[0, 0],
            GROUND_M - track.position[:, 2],
        ]
    )
    np.testing.assert_allclose(table[["px", "py", "pz"]], north_east_down[::2], atol=1e-4)
    np.testing.assert_allclose(np.hypot(table["vx"], table["vy"])[50:], 1.6, atol=0.01)
    there = positions(table["latitude"], table["longitude"], table["height"])
    np.testing.assert_allclose(there, track.position[::2], atol=2e-3)


def test_ros_gets_the_drone_level_and_its_camera_as_planned(mission: Path) -> None:
    with AnyReader([mission / "Walk_adaptive.mcap"]) as reader:
        read: dict[str, Any] = {
            c.topic: reader.deserialize(data, c.msgtype) for c, _, data in reader.messages()
        }
    place, flight = read["/origin"], read["/drone_1/trajectory"]
    assert (place.latitude, place.longitude, place.altitude) == (47.4, 8.5, 420.0)
    assert flight.joint_names == ["drone 1", "drone 1/camera"]
    track = circling()
    for point, row in zip(flight.points, range(0, len(T_S), 2), strict=True):
        since_s = point.time_from_start.sec + point.time_from_start.nanosec / 1e9
        assert since_s == pytest.approx(T_S[row])
        drone, camera = ([t.rotation.x, t.rotation.y, t.rotation.z, t.rotation.w] for t in point.transforms)
        np.testing.assert_allclose(camera, track.quaternion_xyzw[row])
        nose, up = matrix_from_quaternion(np.array(drone))[:, [0, 2]].T
        look = matrix_from_quaternion(np.array(camera))[:, 2]
        np.testing.assert_allclose(up, [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose(nose[:2], look[:2] / np.linalg.norm(look[:2]), atol=1e-9)


def test_what_cannot_be_flown_is_refused(tmp_path: Path) -> None:
    listener = Listener()
    with refused("place-unknown"):
        EXPORT.write(planned(place=None), tmp_path)
    with refused("data"):
        EXPORT.write(planned(planned=tuple), tmp_path)
    broken = PlannedArm("fixed", {"drone1": circling()}, GROUND_M, broken="actor 1 times")
    with refused("limits-broken"):
        EXPORT.write(planned(planned=lambda: [broken], progress=listener), tmp_path)
    assert len(listener.notes) == 1
    assert not list(tmp_path.iterdir())
