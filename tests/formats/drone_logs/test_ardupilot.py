"""ArduPilot's logs, written byte by byte in the published format, with known truth."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.formats.drone_logs.ardupilot import FORMAT
from pipelines.geometry.geodesy import enu_from_geodetic
from pipelines.geometry.poses import conjugate, multiply, rotate
from pipelines.session.records import Telemetry
from pipelines.session.registries import TelemetryChoice
from tests.raising import refused
from tests.real_data import real_data
from tests.synthetic.drone_logs import BOOT_NS, HOME, DroneTruth, drone_of, write_dataflash
from tests.synthetic.flights import write_flight


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> DroneTruth:
    return drone_of(write_flight(tmp_path_factory.mktemp("flight"), cameras=1, seconds=0.5, clean=True), 0)


def read(path: Path, **choice: Any) -> Telemetry:
    return FORMAT.read_telemetry(path, TelemetryChoice(**choice))


@pytest.mark.parametrize(
    ("position", "tolerance_m"),
    [("local", 2e-6), ("global", 0.013), ("gps", 0.013)],  # floats; 1e-7 deg, and heights in cm
)
def test_positions(tmp_path: Path, truth: DroneTruth, position: str, tolerance_m: float) -> None:
    telemetry = read(write_dataflash(tmp_path / "a.bin", truth), position=position)
    track = telemetry.position
    latitude, longitude, height = track.values.T
    values = enu_from_geodetic(latitude, longitude, height, HOME) if track.on_earth else track.values
    lost = len(truth.t_ns) - len(values)
    assert telemetry.dropped == ({"no 3D fix": 1} if position == "gps" else {})
    np.testing.assert_allclose(values, truth.enu[lost:], atol=tolerance_m)
    if position == "local":
        assert track.origin is not None
        assert track.origin.latitude_deg == pytest.approx(HOME.latitude_deg, abs=1e-7)


def test_attitudes(tmp_path: Path, truth: DroneTruth) -> None:
    telemetry = read(write_dataflash(tmp_path / "a.bin", truth))
    assert telemetry.body is not None
    assert telemetry.gimbal is not None
    off = multiply(conjugate(truth.body), telemetry.body.quaternion_xyzw)
    # Three angles rounded to 0.01 deg: at most 0.009 deg together, half of that in the quaternion.
    assert np.abs(off[:, :3]).max() < np.radians(0.009) / 2
    ahead = rotate(telemetry.gimbal.quaternion_xyzw, np.array([1.0, 0, 0]))
    yaw = np.degrees(np.arctan2(ahead[:, 0], ahead[:, 1]))
    np.testing.assert_allclose(yaw, truth.gimbal_ypr_deg[:, 0], atol=1e-4)
    np.testing.assert_allclose(np.degrees(np.arcsin(ahead[:, 2])), truth.gimbal_ypr_deg[:, 1], atol=1e-4)


def test_a_mount_that_counts_from_the_nose_alone(tmp_path: Path, truth: DroneTruth) -> None:
    by_north = read(write_dataflash(tmp_path / "a.bin", truth)).gimbal
    by_nose = read(write_dataflash(tmp_path / "b.bin", truth, yaw_from_north=False)).gimbal
    assert by_north is not None
    assert by_nose is not None
    off = multiply(conjugate(by_north.quaternion_xyzw), by_nose.quaternion_xyzw)
    assert np.abs(off[:, :3]).max() < np.radians(0.01)  # the body's yaw is rounded to 0.01 deg


def test_time_by_gps(tmp_path: Path, truth: DroneTruth) -> None:
    path = write_dataflash(tmp_path / "a.bin", truth)
    telemetry = read(path)
    assert telemetry.fit is not None
    # GPS gives truncated ms: half a ms on average, and the autopilot's clock 1 us.
    assert np.abs(telemetry.position.t_ns - truth.t_ns).max() < 1_000_000
    np.testing.assert_array_equal(read(path, time="boot").position.t_ns, truth.boot_us * 1000)
    assert np.abs(FORMAT.picture_times(path, TelemetryChoice()) - truth.t_ns).max() < 1_000_000
    no_gps = write_dataflash(tmp_path / "b.bin", truth, kinds=("POS", "ATT"))
    assert read(no_gps).clock == "boot"
    assert int(read(no_gps).position.t_ns[0]) == BOOT_NS


def test_a_log_from_2014_as_pymavlink_reads_it() -> None:
    # Stamps are ms since boot, but ms of the GPS week in GPS messages.
    path = real_data("second/erle_25.bin")
    mavutil = pytest.importorskip("pymavlink.mavutil")
    theirs = mavutil.mavlink_connection(str(path))
    fixes, turned = [], []
    while (message := theirs.recv_msg()) is not None:
        kind = message.get_type()
        if kind == "ATT":
            turned.append((message.TimeMS * 1_000_000, message.Yaw))
        elif kind == "GPS" and message.Status >= 3:
            fixes.append((message.T * 1_000_000, message.Lat, message.Lng, message.Alt, message.TimeMS))
    theirs.close()

    telemetry = read(path, time="boot")
    assert telemetry.dropped == {"no 3D fix": 658 - len(fixes)}
    assert telemetry.position.t_ns.tolist() == [fix[0] for fix in fixes]
    np.testing.assert_allclose(telemetry.position.values, [fix[1:4] for fix in fixes], atol=1e-9)
    assert telemetry.body is not None
    ahead = rotate(telemetry.body.quaternion_xyzw, np.array([1.0, 0, 0]))
    yaw = np.degrees(np.arctan2(ahead[:, 0], ahead[:, 1])) % 360
    known = np.isin([t for t, _ in turned], telemetry.body.t_ns)
    np.testing.assert_allclose(yaw, np.array([y for _, y in turned])[known], atol=1e-4)
    # Week 1813 and 16 leap seconds. Its own clock is 9 % slow, more than the clock fit accepts as a drift,
    # so only the middle fits.
    utc_s = 315_964_800 + 1813 * 604_800 - 16 + np.array([ms / 1e3 for _, _, _, _, ms in fixes])
    late_s = read(path).position.t_ns / 1e9 - utc_s
    assert abs(np.median(late_s)) < 0.2


def test_damage(tmp_path: Path, truth: DroneTruth, capfd: pytest.CaptureFixture[str]) -> None:
    path = write_dataflash(tmp_path / "a.bin", truth)
    whole = path.read_bytes()
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + b"\x00\xa3\x17garbage" + whole[middle:-5])
    telemetry = read(path)
    assert len(telemetry.position.t_ns) >= len(truth.t_ns) - 2
    assert capfd.readouterr().err == ""  # pymavlink prints each byte that it cannot read
    path.write_bytes(whole[:700])
    with refused("no-positions", path, "POS", "XKF1", "NKF1", "GPS"):
        read(path)
    path.write_bytes(b"")
    assert not FORMAT.recognises(path)
    with refused("wrong-kind", path, "ArduPilot"):
        read(path)
