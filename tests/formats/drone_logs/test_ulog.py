"""PX4's logs: real ones against facts.json, and written ones with known truth."""

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.formats.drone_logs.ulog import FORMAT
from pipelines.geometry.geodesy import place_at
from pipelines.geometry.poses import conjugate, multiply
from pipelines.session.records import Telemetry
from pipelines.session.registries import TelemetryChoice
from tests.raising import refused
from tests.real_data import facts, real_data
from tests.synthetic.drone_logs import BOOT_NS, HOME, DroneTruth, drone_of, ulog_record, ulog_rows, write_ulog
from tests.synthetic.flights import write_flight

NAMES = ["sample.ulg", "sample_log_small.ulg", "sample_px4_events.ulg"]


def read(path: Path, **choice: Any) -> Telemetry:
    return FORMAT.read_telemetry(path, TelemetryChoice(**choice))


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> DroneTruth:
    return drone_of(write_flight(tmp_path_factory.mktemp("flight"), cameras=1, seconds=0.5, clean=True), 0)


@pytest.mark.parametrize("name", NAMES)
def test_real_logs_are_read_as_their_facts_state(name: str) -> None:
    path, told = real_data(f"logs/ulog/{name}"), facts(f"logs/ulog/{name}")
    assert FORMAT.recognises(path)
    telemetry = read(path)
    assert telemetry.body is not None
    assert len(telemetry.body.t_ns) == told["attitude_samples"]
    local = read(path, position="local")
    counted = len(local.position.t_ns) + sum(local.dropped.values())
    assert counted == told["topics"]["vehicle_local_position:0"]
    if "gps_samples" in told:
        gps = read(path, position="gps")
        assert len(gps.position.t_ns) + sum(gps.dropped.values()) == told["gps_samples"]
        off = np.abs(gps.position.values[0] - told["gps_lat_lon_alt_first"])
        assert (off < [1e-6, 1e-6, 0.02]).all()  # the very first one may be no 3D fix


def test_axes_and_times(tmp_path: Path, truth: DroneTruth) -> None:
    telemetry = read(write_ulog(tmp_path / "a.ulg", ulog_rows(truth)))
    # Floats of 32 bits: 10 m to 1e-6, a quaternion to 1e-7.
    np.testing.assert_allclose(telemetry.position.values, truth.enu, atol=2e-6)
    assert telemetry.position.origin == HOME
    assert telemetry.position.accuracy_m == pytest.approx((0.3 / 2**0.5, 0.5))
    assert telemetry.body is not None
    assert telemetry.gimbal is not None
    assert np.abs(multiply(conjugate(truth.body), telemetry.body.quaternion_xyzw)[:, :3]).max() < 1e-6
    # The time of sampling is used, not that of publication 2 ms later; both clocks in whole microseconds.
    assert np.abs(telemetry.position.t_ns - truth.t_ns).max() <= 1001
    assert telemetry.fit is not None
    assert abs(telemetry.fit.offset_ns - (int(truth.t_ns[0]) - BOOT_NS)) <= 1001


def test_a_gimbal_that_counts_from_the_nose(tmp_path: Path, truth: DroneTruth) -> None:
    by_north = read(write_ulog(tmp_path / "a.ulg", ulog_rows(truth))).gimbal
    by_nose = read(write_ulog(tmp_path / "b.ulg", ulog_rows(truth, from_north=False))).gimbal
    assert by_north is not None
    assert by_nose is not None
    off = multiply(conjugate(by_north.quaternion_xyzw), by_nose.quaternion_xyzw)
    # Yaw from the nose, for a body with a lean of 5 deg, from 32-bit floats.
    assert np.abs(off[:, :3]).max() < 1e-6


def test_an_estimator_that_moves_its_origin_is_followed(tmp_path: Path, truth: DroneTruth) -> None:
    away = np.array([35.0, -20.0, 4.0])
    there = place_at(away, HOME)
    rows, moved = ulog_rows(truth), ulog_rows(truth, origin=there)
    half = len(rows) // 2 // 5 * 5
    later = []
    for name, instance, fields in moved[half:]:
        if name == "vehicle_local_position":
            place = fields[5] - away[1], fields[6] - away[0], fields[7] + away[2]
            later.append((name, instance, (*fields[:5], *place, *fields[8:])))
        else:
            later.append((name, instance, fields))
    telemetry = read(write_ulog(tmp_path / "a.ulg", rows[:half] + later))
    # The vertical 40 m away is turned by 6e-6: 0.1 mm. Heights of 280 m fit 32-bit floats to 3e-5.
    np.testing.assert_allclose(telemetry.position.values, truth.enu, atol=5e-4)
    assert any(re.search(r"origin 1\b", note) for note in telemetry.notes)


def test_triggers(tmp_path: Path, truth: DroneTruth) -> None:
    path = write_ulog(tmp_path / "a.ulg", ulog_rows(truth))
    assert np.abs(FORMAT.picture_times(path, TelemetryChoice()) - truth.t_ns).max() <= 2000
    boot = FORMAT.picture_times(path, TelemetryChoice(time="boot"))
    np.testing.assert_array_equal(boot, truth.boot_us * 1000)
    rows = [row for row in ulog_rows(truth) if row[0] != "camera_trigger"]
    path = write_ulog(tmp_path / "b.ulg", rows)
    with refused("data", path, "camera_capture", "camera_trigger"):
        FORMAT.picture_times(path, TelemetryChoice())


def test_definitions_that_unfold_without_end_are_refused(tmp_path: Path) -> None:
    head = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    nested = [f"m{k}:m{k + 1}[60000] a;" for k in range(8)] + ["m8:float[60000] a;"]
    bomb = tmp_path / "bomb.ulg"
    bomb.write_bytes(head + b"".join(ulog_record("F", text.encode()) for text in nested))
    with refused("damaged", bomb, "fields"):
        read(bomb)
    bomb.write_bytes(head + ulog_record("F", b"loop:loop a;"))
    with refused("damaged", bomb, "loop"):
        read(bomb)
