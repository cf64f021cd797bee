"""Places without attitudes: GPX by an independent program, and tables."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.drone_logs.place_tracks import AIRSIM, GPX, PLACES_CSV
from pipelines.formats.drone_logs.tlog import FORMAT as TLOG
from pipelines.geometry.poses import rotate
from pipelines.session.errors import DataError
from pipelines.session.recognition import recognise
from pipelines.session.registries import TelemetryChoice, TelemetryFormat
from tests.real_data import real_data

GPX_TEXT = """<?xml version="1.0"?><gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
<trkpt lat="47.5" lon="8.25"><ele>410.5</ele><time>2026-05-01T10:00:00.500Z</time></trkpt>
<trkpt lon='8.26' lat='47.6'><time>2026-05-01T10:00:01.500Z</time><ele>411</ele></trkpt>
<trkpt lat="47.7" lon="8.27"><ele>412</ele></trkpt>
</trkseg></trk></gpx>"""


def test_a_gpx_track_has_places_and_times(tmp_path: Path) -> None:
    path = tmp_path / "a.gpx"
    path.write_text(GPX_TEXT, encoding="utf-8")
    assert recognise(path, TelemetryFormat, "log") is GPX
    found = GPX.read_telemetry(path, TelemetryChoice())
    assert found.position.values.tolist() == [[47.5, 8.25, 410.5], [47.6, 8.26, 411.0]]
    assert np.diff(found.position.t_ns).tolist() == [10**9]
    assert found.position.t_ns[0] == 1_777_629_600_500_000_000
    assert found.dropped == {"no time": 1}
    assert found.body is None
    assert found.gimbal is None


@pytest.mark.parametrize(
    ("text", "values", "on_earth"),
    [
        ("t_ns,x,y,z\n1000,1,2,3\n2000,1.5,2,3\n", [[1, 2, 3], [1.5, 2, 3]], False),
        ("time;lat;lon;ele\n1.0;47.5;8.5;4\n2.0;47.5;8.6;5\n", [[47.5, 8.5, 4], [47.5, 8.6, 5]], True),
        ("z,y,x,timestamp [ms]\n3,2,1,1\n3,2,1.5,2\n", [[1, 2, 3], [1.5, 2, 3]], False),
        (
            "# walk\nutc,GPS Lat,gps_long,Height (ft)\n1,47,8,10\n2,47,9,10\n",
            [[47, 8, 3.048], [47, 9, 3.048]],
            True,
        ),
        ("date,time,East,North,Up,speed,heading\n2026-05-01,10:00:00,1,2,3,4,5\n", [[1, 2, 3]], False),
        ("date,t,lat,lon,alt\n2026-05-01,7,47,8,4\n", [[47, 8, 4]], True),
    ],
)
def test_a_table_of_places_is_read(
    tmp_path: Path, text: str, values: list[list[float]], on_earth: bool
) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8")
    assert recognise(path, TelemetryFormat, "log") is PLACES_CSV
    track = PLACES_CSV.read_telemetry(path, TelemetryChoice()).position
    assert track.values.tolist() == values
    assert track.on_earth is on_earth


@pytest.mark.parametrize(
    "text",
    [
        "t,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n",  # poses
        "time(millisecond),latitude,longitude,height_above_takeoff(feet)\n1,47,8,3\n",  # a flight record
    ],
)
def test_other_tables_are_no_places(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8")
    assert not PLACES_CSV.recognises(path)


def test_a_track_by_pymavlink_is_read(tmp_path: Path) -> None:
    """pymavlink's converter and our reader of the same log find the same places, to its printed digits."""
    converter = Path(sys.executable).with_name("mavtogpx.py")
    if not converter.exists():
        pytest.skip("pymavlink is not installed")
    log = tmp_path / "vtol.tlog"
    log.write_bytes(real_data("second/vtol.tlog").read_bytes())
    subprocess.run([sys.executable, converter, log], check=True, capture_output=True, timeout=120)
    found = GPX.read_telemetry(Path(f"{log}.gpx"), TelemetryChoice()).position.values
    (listed,) = Path(f"{log}.gpx").read_text(encoding="utf-8").split("<trkseg>")[1:]
    ours = TLOG.read_telemetry(log, TelemetryChoice(position="gps")).position.values
    assert listed.count("<trkpt") >= len(found) > 100
    apart = np.abs(ours[None, :, :2] - found[:, None, :2]).max(axis=2).min(axis=1)
    assert np.median(apart) < 1e-6


def test_airsims_recording_is_turned_to_east_north_up(tmp_path: Path) -> None:
    """Two drones 34 m above the ground that head 90 deg, to the east, and look level."""
    half, path = 0.5**0.5, tmp_path / "airsim_rec.txt"
    rows = ["VehicleName TimeStamp POS_X POS_Y POS_Z Q_W Q_X Q_Y Q_Z ImageFile"]
    for k in range(2):
        pose = f"{1_700_000_000_000 + 40 * k} {1 + k} 2.0 -34 {half} 0 0 {half}"
        later = pose.replace(" 2.0 ", " 7 ").replace("0 ", "5 ", 1)
        rows += [f"Drone1 {pose} a.png", f"Drone2 {later} b.png"]
    path.write_text("\n".join(rows).replace(" ", "\t") + "\n", encoding="utf-8")
    assert recognise(path, TelemetryFormat, "log") is AIRSIM
    with pytest.raises(DataError, match="Drone1, Drone2"):
        AIRSIM.read_telemetry(path, TelemetryChoice())
    for instance, east_m in ((0, 2), (1, 7)):
        found = AIRSIM.read_telemetry(path, TelemetryChoice(instance=instance))
        np.testing.assert_allclose(found.position.values, [[east_m, 1, 34], [east_m, 2, 34]])
        assert found.body is not None
        ahead, up = (rotate(found.body.quaternion_xyzw[0], axis) for axis in (np.eye(3)[0], np.eye(3)[2]))
        np.testing.assert_allclose([ahead, up], [[1, 0, 0], [0, 0, 1]], atol=1e-9)
        times = AIRSIM.picture_times(path, TelemetryChoice(instance=instance)) - 1_700_000_000_000_000_000
        assert times.tolist() == [5_000_000 * instance, 5_000_000 * instance + 40_000_000]
