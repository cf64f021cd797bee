"""Usual topics of drivers: the choice of topics, with their axes, units and order."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.formats.logs.presets import (
    Preset,
    namespaces,
    parts_of,
    read_pair,
    read_positions,
    read_preset,
)
from pipelines.geometry.geodesy import enu_from_geodetic
from pipelines.geometry.poses import rotate
from pipelines.session.errors import DataError
from pipelines.session.records import Telemetry
from pipelines.session.registries import LogFormat, TelemetryChoice, recognise
from tests.real_data import real_data
from tests.synthetic.logged_flights import header
from tests.synthetic.logs import Entry, write_log, write_mcap

START_NS = 1_700_000_000_000_000_000
ROWS = 8


def stamps() -> list[int]:
    return [START_NS + k * 50_000_000 for k in range(ROWS)]


def fixes(topic: str, latitude: float = 47.5, **more: Any) -> list[Entry]:
    return [
        Entry(
            topic,
            "sensor_msgs/msg/NavSatFix",
            t,
            {
                "header": header(t, "gps"),
                "latitude": latitude,
                "longitude": 8.5 + 1e-6 * k,
                "altitude": 400.0,
                **more,
            },
        )
        for k, t in enumerate(stamps())
    ]


def vectors(topic: str, frame: str, x: float, y: float, z: float) -> list[Entry]:
    vector = {"x": x, "y": y, "z": z}
    return [
        Entry(topic, "geometry_msgs/msg/Vector3Stamped", t, {"header": header(t, frame), "vector": vector})
        for t in stamps()
    ]


def attitudes(topic: str, xyzw: tuple[float, ...]) -> list[Entry]:
    turned = dict(zip("xyzw", xyzw, strict=True))
    return [
        Entry(
            topic, "geometry_msgs/msg/QuaternionStamped", t, {"header": header(t, ""), "quaternion": turned}
        )
        for t in stamps()
    ]


def imu(topic: str, xyzw: tuple[float, ...]) -> list[Entry]:
    turned = dict(zip("xyzw", xyzw, strict=True))
    return [
        Entry(topic, "sensor_msgs/msg/Imu", t, {"header": header(t, "base_link"), "orientation": turned})
        for t in stamps()
    ]


def poses(topic: str, position: tuple[float, ...]) -> list[Entry]:
    at = {"position": dict(zip("xyz", position, strict=True)), "orientation": {"w": 1.0}}
    return [
        Entry(topic, "geometry_msgs/msg/PoseStamped", t, {"header": header(t, "map"), "pose": at})
        for t in stamps()
    ]


def read(
    folder: Path,
    preset: Preset,
    *parts: list[Entry],
    namespace: str | None = None,
    position: Any = None,
) -> Telemetry:
    entries = sorted((entry for part in parts for entry in part), key=lambda e: e.stamp_ns)
    path = write_log(folder, "log", "ros1", entries)
    choice = TelemetryChoice(position=position)
    with recognise(path, LogFormat, "log").open_log([path]) as log:
        return read_preset(log, str(path), preset, namespace, choice, "header")


@pytest.mark.parametrize(
    ("frame", "vector"),
    [
        ("", (-30.0, 0.0, 90.0)),  # pitch, roll, yaw: a subscription, as on an M210
        ("ground_ENU", (0.0, -30.0, 90.0)),  # roll, pitch, yaw: a broadcast, as on an M100
    ],
)
def test_gimbals_of_the_onboard_sdk(tmp_path: Path, frame: str, vector: tuple[float, float, float]) -> None:
    telemetry = read(
        tmp_path,
        "dji_osdk",
        fixes("/dji_sdk/gps_position"),
        vectors("/dji_sdk/gimbal_angle", frame, *vector),
        attitudes("/dji_sdk/attitude", (0.0, 0.0, 0.5**0.5, 0.5**0.5)),
    )
    assert telemetry.gimbal is not None
    assert telemetry.gimbal.relative_to == "world"
    ahead = rotate(telemetry.gimbal.quaternion_xyzw[0], np.array([1.0, 0, 0]))
    # Yaw 90 from north is east; pitch is 30 degrees down. The frame's name has no effect.
    np.testing.assert_allclose(ahead, [0.75**0.5, 0, -0.5], atol=1e-12)
    assert telemetry.body is not None
    nose = rotate(telemetry.body.quaternion_xyzw[0], np.array([1.0, 0, 0]))
    np.testing.assert_allclose(nose, [0, 1, 0], atol=1e-12)  # FLU in ENU as it stands
    np.testing.assert_array_equal(telemetry.position.t_ns, stamps())


def test_local_positions_are_placed_by_the_fixes_beside_them(tmp_path: Path) -> None:
    points = [
        Entry(
            "/dji_sdk/local_position",
            "geometry_msgs/msg/PointStamped",
            t,
            {"header": header(t, ""), "point": {"x": 5.0 + 0.0754 * k, "y": -7.0, "z": 12.0}},
        )
        for k, t in enumerate(stamps())
    ]
    telemetry = read(tmp_path, "dji_osdk", fixes("/dji_sdk/gps_position"), points, position="local")
    origin = telemetry.position.origin
    assert origin is not None
    first = enu_from_geodetic(np.array(47.5), np.array(8.5), np.array(400.0), origin)
    # Steps of 1e-6 deg of longitude are 0.07536 m here, 0.0754 in the local positions: 0.3 mm over 8 rows.
    np.testing.assert_allclose(first, [5.0, -7.0, 12.0], atol=1e-3)
    assert any(" /dji_sdk/gps_position" in note for note in telemetry.notes)


def test_mavros(tmp_path: Path) -> None:
    # The mount's quaternion has no stamp and no header: pitch -30, yaw +20 from the nose, FRD angles.
    half = np.radians([-15.0, 10.0])
    (sp, sy), (cp, cy) = np.sin(half), np.cos(half)
    xyzw = (float(-sp * sy), float(sp * cy), float(cp * sy), float(cp * cy))
    turned = dict(zip("xyzw", xyzw, strict=True))
    mount = [
        Entry("/uav1/mavros/mount_control/orientation", "geometry_msgs/msg/Quaternion", t, turned)
        for t in stamps()
    ]
    north = (0.0, 0.0, 0.5**0.5, 0.5**0.5)
    telemetry = read(
        tmp_path,
        "mavros",
        poses("/uav1/mavros/local_position/pose", (1.0, 2.0, 3.0)),
        imu("/uav1/mavros/imu/data", north),
        mount,
    )
    np.testing.assert_allclose(telemetry.position.values, [[1.0, 2.0, 3.0]] * ROWS)
    assert telemetry.gimbal is not None
    ahead = rotate(telemetry.gimbal.quaternion_xyzw[0], np.array([1.0, 0, 0]))
    level = np.cos(np.radians(30))
    expected = [level * np.sin(np.radians(20)), level * np.cos(np.radians(20)), -0.5]
    np.testing.assert_allclose(ahead, expected, atol=1e-12)


def test_several_drones(tmp_path: Path) -> None:
    topics = ["/a/mavros/local_position/pose", "/b/mavros/local_position/pose", "/dji_sdk/gps_position"]
    assert namespaces(topics) == [("dji_osdk", ""), ("mavros", "/a"), ("mavros", "/b")]
    assert parts_of("mavros", "/a", topics).position == topics[:1]
    both = [poses(topics[0], (1, 0, 0)), poses(topics[1], (2, 0, 0))]
    with pytest.raises(DataError):
        read(tmp_path / "x", "mavros", *both)
    assert read(tmp_path / "y", "mavros", *both, namespace="b").position.values[0, 0] == 2
    with pytest.raises(DataError):
        read(tmp_path / "z", "mavros", *both, namespace="/c")
    with pytest.raises(DataError):
        read(tmp_path / "w", "dji_osdk", *both)
    with pytest.raises(DataError):  # topics, but no position
        read(tmp_path / "u", "mavros", imu("/mavros/imu/data", (0, 0, 0, 1)))
    with pytest.raises(DataError):
        read(tmp_path / "v", "mavros", both[0], position="gps")


def _pair(path: Path, position: str, attitude: str) -> Telemetry:
    with recognise(path, LogFormat, "log").open_log([path]) as log:
        return read_pair(log, str(path), position, attitude, "enu", "header")


def test_a_real_gps_fix_is_where_the_nav_sat_fix_beside_it_is() -> None:
    path = real_data("second/novatel_bestpos.bag")
    own, other = (_pair(path, topic, "/novatel/oem7/odom").position for topic in ("/gps/gps", "/gps/fix"))
    assert (own.on_earth, own.height, len(own.t_ns)) == (True, "ellipsoid", len(other.t_ns))
    np.testing.assert_array_equal(own.values, other.values)
    assert np.abs(own.t_ns - other.t_ns).max() < 1_000_000  # the driver stamps one after the other


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
def test_fixes_of_foxglove(tmp_path: Path, encoding: Any) -> None:
    entries = []
    for k, t in enumerate(stamps()):
        sec, nsec = divmod(t, 10**9)
        stamp = {"sec": sec, "nsec": nsec} if encoding == "json" else {"seconds": sec, "nanos": nsec}
        place = {"latitude": 47.5 + k, "longitude": 8.5, "altitude": 400.0, "frame_id": "gps"}
        # The receipt is later: the message's own time counts.
        entries.append(Entry("/place", "foxglove.LocationFix", t + 10**8, {"timestamp": stamp, **place}))
    path = write_mcap(tmp_path / "a.mcap", entries, encoding)
    with recognise(path, LogFormat, "log").open_log([path]) as log:
        track = read_positions(log, "a", "/place", "header", {})
    assert (track.on_earth, track.t_ns.tolist()) == (True, stamps())
    np.testing.assert_array_equal(track.values, [[47.5 + k, 8.5, 400.0] for k in range(ROWS)])
