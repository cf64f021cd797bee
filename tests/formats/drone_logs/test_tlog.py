"""Ground stations' logs of MAVLink: a real one against pymavlink, others byte by byte."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from pipelines.formats.drone_logs.tlog import FORMAT
from pipelines.geometry.poses import rotate
from pipelines.session.records import Telemetry
from pipelines.session.registries import FORMATS, TelemetryChoice
from tests.raising import refused
from tests.real_data import real_data
from tests.synthetic.drone_logs import DroneTruth, drone_of, mavlink, tlog_pictures, write_tlog
from tests.synthetic.flights import write_flight


def read(path: Path, **choice: Any) -> Telemetry:
    return FORMAT.read_telemetry(path, TelemetryChoice(**choice))


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> DroneTruth:
    folder = tmp_path_factory.mktemp("flight")
    return drone_of(write_flight(folder, cameras=1, seconds=1.0, clean=True), 0)


def test_a_real_log_has_the_messages_that_pymavlink_finds() -> None:
    mavutil = pytest.importorskip("pymavlink.mavutil")
    path = real_data("second/vtol.tlog")
    assert [f.name for f in FORMATS.all() if f.recognises(path)] == ["tlog"]
    places: dict[int, tuple[float, ...]] = {}
    turned: dict[int, tuple[float, ...]] = {}
    count = 0
    reader = mavutil.mavlink_connection(str(path))
    while (message := reader.recv_msg()) is not None:
        count += 1
        if message.get_type() == "GLOBAL_POSITION_INT":
            places.setdefault(
                message.time_boot_ms, (message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3)
            )
        elif message.get_type() == "ATTITUDE":
            turned.setdefault(message.time_boot_ms, (message.yaw, message.pitch))
    reader.close()
    assert count == 23894
    telemetry = read(path, time="boot")
    track, body = telemetry.position, telemetry.body
    assert (track.on_earth, track.height, telemetry.gimbal, telemetry.dropped.get("cut off")) == (
        True,
        "sea level",
        None,
        None,
    )
    # Some packets came late: their stamps go back.
    assert sorted(telemetry.dropped.values()) == [2, 3]
    assert len(track.t_ns) == len(places) - 3
    np.testing.assert_allclose(track.values, [places[t // 10**6] for t in track.t_ns.tolist()], rtol=1e-12)
    assert body is not None
    yaw, pitch = np.array([turned[t // 10**6] for t in body.t_ns.tolist()]).T
    ahead = rotate(body.quaternion_xyzw, np.array([1.0, 0, 0]))
    np.testing.assert_allclose(np.arcsin(ahead[:, 2]), pitch, atol=1e-9)
    np.testing.assert_allclose(ahead[:, 0], np.sin(yaw) * np.cos(pitch), atol=1e-9)
    # UTC is that of SYSTEM_TIME: 1533737145.465 at 608.582 s since boot.
    assert (track.name, body.name) == ("GLOBAL_POSITION_INT", "ATTITUDE")
    assert not any("vehicle_" in note for note in read(path).notes)
    late_s = (read(path).position.t_ns[0] - track.t_ns[0]) / 1e9
    assert late_s == pytest.approx(1533737145.465009 - 608.582, abs=2e-3)


def test_without_gps_time_the_station_s_clock_counts(tmp_path: Path, truth: DroneTruth) -> None:
    path = write_tlog(tmp_path / "a.tlog", truth, gps_time=False)
    telemetry = read(path)
    late_ns = telemetry.position.t_ns - truth.t_ns
    assert np.abs(late_ns - 4_000_000_000).max() < 1_500_000  # the station's clock, and whole ms since boot
    assert telemetry.fit is None
    assert read(path, time="boot").position.t_ns[0] < 10**12
    with refused("clock-unknown", path, "time: gps"):
        read(path, time="gps")


@pytest.mark.parametrize("position", ["global", "gps"])
def test_a_restart_of_the_vehicle_is_told_and_its_times_go_on(
    tmp_path: Path, truth: DroneTruth, monkeypatch: pytest.MonkeyPatch, position: str
) -> None:
    half = len(truth.boot_us) // 2
    boot_us = truth.boot_us.copy()
    boot_us[half:] -= boot_us[half] - 500_000
    monkeypatch.setattr(DroneTruth, "boot_us", boot_us)
    path = write_tlog(tmp_path / "a.tlog", truth, gps_time=False)
    monkeypatch.undo()
    telemetry = read(path, position=position)
    late_ns = telemetry.position.t_ns - truth.t_ns
    assert np.abs(late_ns - 4_000_000_000).max() < 2_500_000  # the station's clock, and whole ms since boot
    assert len([note for note in telemetry.notes if "restarted 1 times" in note]) == 1


def test_a_restart_in_a_real_log_moves_nothing() -> None:
    whole = read(real_data("second/vtol.tlog")).position
    restarted = read(real_data("third/logs/08-tlog-with-a-reboot/reboot.tlog")).position
    places, first = np.unique(whole.values, axis=0, return_index=True)
    late_s = [
        (t_ns - whole.t_ns[first[same[0]]]) / 1e9
        for t_ns, place in zip(restarted.t_ns, restarted.values, strict=True)
        if len(same := np.flatnonzero((places == place).all(axis=1)))
    ]
    assert len(late_s) > 100
    assert np.abs(late_s).max() < 0.003


def test_a_mount_s_angles(tmp_path: Path, truth: DroneTruth) -> None:
    path = write_tlog(tmp_path / "a.tlog", truth, version=1)
    packets = [
        mavlink("MOUNT_ORIENTATION", round(us / 1000), 0.0, -30.0, 5.0, yaw, stamp_ns=int(t))
        for us, t, yaw in zip(truth.boot_us, truth.t_ns, [90.0] * 20 + [float("nan")] * 10, strict=True)
    ]
    path.write_bytes(path.read_bytes() + b"".join(packets))
    gimbal = read(path).gimbal
    assert gimbal is not None
    ahead = rotate(gimbal.quaternion_xyzw, np.array([1.0, 0, 0]))
    np.testing.assert_allclose(ahead[:20], [[0.75**0.5, 0, -0.5]] * 20, atol=1e-6)
    # Without the angle from north, it counts from the nose. Its yaw moves by 1 deg at most in a row.
    heading = np.radians(truth.body_ypr_deg[20:, 0] + 5)
    np.testing.assert_allclose(ahead[20:, 0], np.sin(heading) * 0.75**0.5, atol=0.02)


def with_pictures(
    path: Path, truth: DroneTruth, name: str, clock: Literal["boot", "utc"], **how: int
) -> Path:
    path.write_bytes(path.read_bytes() + tlog_pictures(truth, name, clock, **how))
    return path


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", ["CAMERA_TRIGGER", "CAMERA_FEEDBACK"])
@pytest.mark.parametrize("clock", ["boot", "utc"])
def test_times_of_pictures(
    tmp_path: Path, truth: DroneTruth, name: str, clock: Literal["boot", "utc"], version: int
) -> None:
    path = with_pictures(write_tlog(tmp_path / "a.tlog", truth), truth, name, clock, version=version)
    t_ns = FORMAT.picture_times(path, TelemetryChoice())
    # Whole microseconds, and a clock since boot that is fitted to whole milliseconds.
    assert np.abs(t_ns - truth.t_ns).max() <= (1_000 if clock == "utc" else 1_000_000)
    if clock == "boot":
        boot = FORMAT.picture_times(path, TelemetryChoice(time="boot"))
        assert boot.tolist() == (truth.boot_us * 1000).tolist()
    else:
        with refused("data", path, "time: boot"):
            FORMAT.picture_times(path, TelemetryChoice(time="boot"))


def test_damage_costs_the_packets_that_it_hits(tmp_path: Path, truth: DroneTruth) -> None:
    whole = write_tlog(tmp_path / "a.tlog", truth)
    data = bytearray(whole.read_bytes())
    rows = len(read(whole).position.t_ns)
    middle = len(data) // 2
    data[middle : middle + 10] = bytes(10)
    hit = tmp_path / "hit.tlog"
    hit.write_bytes(data)
    telemetry = read(hit)
    assert list(telemetry.dropped.values()) == [1]
    assert len(telemetry.position.t_ns) >= rows - 1
    hit.write_bytes(whole.read_bytes()[:-5])
    assert list(read(hit).dropped.values()) == [1]
    hit.write_bytes(whole.read_bytes()[: len(data) // 2])
    assert rows // 2 <= len(read(hit).position.t_ns) <= rows // 2 + 1
