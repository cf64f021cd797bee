"""DJI's flight records: a real one of PhantomHelp's viewer; Airdata's and Flight Reader's by their headings.

The headings are those that these services document and that public readers of their files name.
"""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.formats.drone_logs.dji_records import FORMAT, recordings_of
from pipelines.geometry.arrays import Place
from pipelines.geometry.geodesy import enu_from_geodetic
from pipelines.geometry.poses import rotate
from pipelines.session.records import Telemetry
from pipelines.session.registries import FORMATS, TelemetryChoice
from tests.commands.runner import refused
from tests.real_data import real_data

REAL = "second/upteko_dji_flight_record50m_30m"
AIRDATA = (
    "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),"
    "height_above_ground_at_drone_location(feet),altitude_above_seaLevel(feet),satellites,"
    " compass_heading(degrees), pitch(degrees), roll(degrees),isPhoto,isVideo,gimbal_heading(degrees),"
    "gimbal_pitch(degrees),gimbal_roll(degrees),message"
)
READER = (
    "CUSTOM.date [local],CUSTOM.updateTime [local],OSD.flyTime,OSD.flyTime [s],OSD.latitude,OSD.longitude,"
    "OSD.height [ft],OSD.altitude [ft],OSD.pitch,OSD.roll,OSD.yaw,OSD.yaw [360],GIMBAL.pitch,GIMBAL.roll,"
    "GIMBAL.yaw,CAMERA.isVideo"
)
FOOT_M = 0.3048


def read(path: Path, **choice: Any) -> Telemetry:
    return FORMAT.read_telemetry(path, TelemetryChoice(**choice))


def airdata(path: Path, rows: int = 60, *, gimbal: bool = True) -> Path:
    """Write rows every 100 ms, of a drone that climbs a foot a row; it films rows 20 to 39."""
    lines = [AIRDATA]
    for k in range(rows):
        since_ms = 250 + 100 * k  # the clock ticks between rows: at 10:00:01 and every second after
        angles = (90, -30, 0.5) if gimbal else (0, 0, 0)
        cells = [
            *(
                since_ms,
                f"2024-05-01 10:00:{since_ms // 1000:02d}",
                47.5,
                8.25 + 1e-6 * k,
                k,
                0,
                1000 + k,
                15,
            ),
            *(180, 2, 1, 0, int(20 <= k < 40), *angles, ""),
        ]
        lines.append(",".join(map(str, cells)))
    path.write_text("\n".join(lines) + "\n")
    return path


def reader(path: Path, *dates: str, separator: str = ",") -> Path:
    """Write one row of Flight Reader for each date and time."""
    lines = [f"sep={separator}", READER.replace(",", separator)]
    for k, date in enumerate(dates):
        cells = [*date.split(" ", 1), "0m 1s", "1.0", "47.5", "8.25", "10.0", f"{500 + k}.0"]
        cells += ["1.0", "2.0", "-90.0", "270.0", "-45.0", "0.0", "-80.0", "False"]
        lines.append(separator.join(c if separator == "," else c.replace(".", ",") for c in cells))
    path.write_text("\n".join(lines), encoding="utf-8-sig")
    return path


def test_a_real_record_has_the_numbers_of_its_metric_columns() -> None:
    path = real_data(f"{REAL}.csv")
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [f.name for f in FORMATS.all() if f.recognises(path)] == ["dji_record"]
    telemetry = read(path)
    track = telemetry.position
    assert len(track.t_ns) == len(rows) == 2598
    assert (telemetry.dropped, telemetry.gimbal, track.height) == ({}, None, "take-off")
    for name, values in (("Altitude(meters)", track.values[:, 2]), ("Time(seconds)", track.t_ns / 1e9)):
        stated = np.array([float(row[name]) for row in rows])
        changed = np.append(True, np.diff(stated) != 0)  # a repeated height is interpolated
        np.testing.assert_allclose(values[changed], stated[changed], atol=1e-9)
    # The record's own distance from home (0.1 m) is that of the positions, at every row.
    home = Place(float(rows[-1]["HomeLatitude"]), float(rows[-1]["HomeLongitude"]), 0.0)
    enu = enu_from_geodetic(track.values[:, 0], track.values[:, 1], np.zeros(len(rows)), home)
    after = [k for k, row in enumerate(rows) if row["HomeLatitude"] == rows[-1]["HomeLatitude"]]
    stated = np.array([float(row["HomeDistance(meters)"]) for row in rows])
    off_m = np.hypot(enu[after, 0], enu[after, 1]) - stated[after]
    assert np.abs(off_m).max() < 0.05 + 0.004 * stated.max()  # a sphere for the ellipsoid: 0.3 % across
    assert telemetry.body is not None
    ahead = rotate(telemetry.body.quaternion_xyzw, np.array([1.0, 0, 0]))
    pitch = np.array([float(row["Pitch"]) for row in rows])
    off_deg = np.degrees(np.arcsin(ahead[:, 2])) - pitch
    assert np.median(np.abs(off_deg)) < 1e-9  # where it is not between two measurements


def test_airdata_is_placed_by_its_clock_and_its_gimbal_looks_where_it_says(tmp_path: Path) -> None:
    path = airdata(tmp_path / "a.csv")
    telemetry = read(path)
    start_ns = 1_714_557_600_000_000_000 + 250_000_000  # 10:00:00.25
    # Rows are 0.1 s apart, so a tick of the clock is known to half of that.
    assert abs(int(telemetry.position.t_ns[0]) - start_ns) <= 50_000_000
    np.testing.assert_array_equal(np.diff(telemetry.position.t_ns), 100_000_000)
    np.testing.assert_allclose(telemetry.position.values[:, 2], FOOT_M * np.arange(60), atol=1e-9)
    assert read(path, altitude="absolute").position.values[0, 2] == pytest.approx(1000 * FOOT_M)
    assert telemetry.gimbal is not None
    assert telemetry.body is not None
    for track, ahead in ((telemetry.gimbal, (0.75**0.5, 0, -0.5)), (telemetry.body, (0, -1, 0))):
        found = rotate(track.quaternion_xyzw[0], np.array([1.0, 0, 0]))
        np.testing.assert_allclose(found, ahead, atol=0.04)  # the body pitches by 2 deg
    ((first_ns, last_ns),) = recordings_of(path)
    assert (first_ns - int(telemetry.position.t_ns[0]), last_ns - first_ns) == (2_000_000_000, 1_900_000_000)


@pytest.mark.parametrize(
    ("date", "name", "expected"),
    [
        ("5/12/2024 2:03:04.25 PM", "a.csv", "2024-05-12T14:03:04.25"),
        ("5/12/2024 12:03:04 AM", "a.csv", "2024-05-12T00:03:04"),
        ("13/5/2024 14:03:04", "a.csv", "2024-05-13T14:03:04"),
        ("5/12/2024 14:03:04", "DJIFlightRecord_2024-12-05_[14-03-04].csv", "2024-12-05T14:03:04"),
        ("2024-05-12 14:03:04", "a.csv", "2024-05-12T14:03:04"),
    ],
)
def test_dates_of_any_country(tmp_path: Path, date: str, name: str, expected: str) -> None:
    t_ns = int(read(reader(tmp_path / name, date)).position.t_ns[0])
    expected_ns = np.datetime64(expected, "ns").astype(np.int64)
    # Of one row with whole seconds, the middle of the second is taken.
    assert t_ns - expected_ns == (0 if "." in expected else 500_000_000)


def test_semicolons_and_decimal_commas(tmp_path: Path) -> None:
    dates = ["5/12/2024 14:03:04.1", "5/12/2024 14:03:04.2"]
    german, english = (read(reader(tmp_path / f"{s == ','}.csv", *dates, separator=s)) for s in ";,")
    np.testing.assert_array_equal(german.position.values, english.position.values)
    np.testing.assert_array_equal(german.position.t_ns, english.position.t_ns)
    assert german.position.values[0].tolist() == pytest.approx([47.5, 8.25, 10 * FOOT_M])
    assert german.gimbal is not None
    ahead = rotate(german.gimbal.quaternion_xyzw[0], np.array([1.0, 0, 0]))
    assert np.degrees(np.arctan2(ahead[0], ahead[1])) == pytest.approx(-80)


def test_damage_is_counted(tmp_path: Path) -> None:
    path = airdata(tmp_path / "a.csv")
    lines = path.read_text().split("\n")
    lines[5] = lines[5].replace("47.5", "47.x")
    lines[9] = lines[9].replace("47.5,", ",")
    lines[12] = lines[12].replace("47.5", "0").replace("8.250011", "0")
    path.write_text("\n".join(lines)[: -len(lines[-2]) // 2])
    telemetry = read(path)
    assert len(telemetry.position.t_ns) == 56
    assert list(telemetry.dropped.values()) == [2, 1, 1]


def test_a_real_binary_record_is_refused_with_the_way_to_a_csv() -> None:
    real = real_data(f"{REAL}.txt")
    assert [f.name for f in FORMATS.all() if f.recognises(real)] == []
    assert "dji-log-parser" in refused("info", real)
