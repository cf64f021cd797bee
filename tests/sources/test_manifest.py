"""Sources of a manifest: their formats by content, and the options of each."""

from typing import Any

import pytest

from pipelines.session.errors import DataError
from pipelines.session.manifest import GimbalSource, read_flight
from pipelines.sources.files import FlightFiles
from pipelines.sources.logs import FlightLogs
from pipelines.sources.poses import FlightPoses
from tests.synthetic.drone_logs import drone_of, write_dataflash, write_srt
from tests.synthetic.flights import SyntheticFlight, write_flight
from tests.synthetic.logged_flights import header
from tests.synthetic.logs import Entry, write_mcap

FIXES = [
    Entry(
        "/fix",
        "sensor_msgs/msg/NavSatFix",
        k * 10**9,
        {"header": header(k * 10**9, "gps"), "latitude": 47.5, "longitude": 8.5, "altitude": 400.0},
    )
    for k in range(1, 4)
]
"""Log with positions of a receiver."""


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> SyntheticFlight:
    flight = write_flight(tmp_path_factory.mktemp("flight"), cameras=2, seconds=0.2, clean=True)
    folder, truth = flight.manifest.parent, drone_of(flight, 0)
    write_srt(folder / "a.SRT", truth)
    write_dataflash(folder / "a.bin", truth)
    write_mcap(folder / "a.mcap", FIXES)
    return flight


def checked(flight: SyntheticFlight, change: dict[str, Any]) -> None:
    """Check the sources of a flight whose first camera is changed."""
    stated = flight.settings["cameras"]["drone1"]
    camera = {**stated, **change}
    settings = {**flight.settings, "cameras": {**flight.settings["cameras"], "drone1": camera}}
    path = flight.manifest.with_name("changed.yaml")
    SyntheticFlight(path, settings, *list(vars(flight).values())[2:]).save()
    read = read_flight(path)
    files = FlightFiles(read, path)
    files.refuse_other_options()
    with FlightLogs(read, path.parent, lambda _: None) as logs:
        FlightPoses(read, path, logs, files, max_gap_ns=10**9, note=lambda _: None).refuse_unfit()


@pytest.mark.parametrize(
    ("file", "options", "code", "key"),
    [
        ("a.SRT", {"instance": 1}, "wrong-option", "instance"),
        ("a.SRT", {"attitude": "/imu"}, "wrong-option", "attitude"),
        ("a.SRT", {"unit": "cm"}, "wrong-option", "unit"),
        ("a.SRT", {"axes": "ned"}, "wrong-option", "axes"),
        ("a.SRT", {"topic": "/pose"}, "wrong-option", "topic"),
        ("a.SRT", {"altitude": "high"}, "bad-value", "altitude"),
        ("a.bin", {"altitude": 3}, "wrong-option", "altitude"),
        ("a.mcap", {"attitude": "/imu"}, "wrong-option", "attitude"),
        ("a.mcap", {"parent": "map"}, "bad-value", "parent"),
        ("drone1.tum", {"camera": "left"}, "wrong-option", "camera"),
        ("drone1.tum", {"instanc": 1}, "bad-value", "'instance'"),
    ],
)
def test_an_option_belongs_to_the_format_of_its_file(
    flight: SyntheticFlight, file: str, options: dict[str, Any], code: str, key: str
) -> None:
    with pytest.raises(DataError) as caught:
        checked(flight, {"pose": {"file": file, **options}, "mount": None})
    assert caught.value.code == code
    assert key in caught.value.problem


@pytest.mark.parametrize(
    "options",
    [
        {"file": "a.SRT", "altitude": 30},
        {"file": "a.bin", "position": "local", "instance": 1, "time": "boot"},
        {"file": "a.mcap", "topic": "/fix", "attitude": "/imu"},
        {"file": "drone1.tum", "inverse": True, "quaternion": "wxyz", "z": "down", "unit": "mm"},
        {"file": "drone1.tum", "format": "tum"},
    ],
)
def test_an_option_is_taken_by_the_format_of_its_file(
    flight: SyntheticFlight, options: dict[str, Any]
) -> None:
    checked(flight, {"pose": options})


@pytest.mark.parametrize(
    ("gimbal", "key"),
    [
        ({"relative_to": "world"}, "gimbal"),
        ({"file": "a.bag", "topic": "/g"}, "relative_to"),
        ({"topic": "/g", "relative_to": "world"}, "topic"),
        ({"yaw_deg": 3, "pitch_deg": 2, "file": "a.bag"}, "file"),
        ({"yaw_deg": 3}, "pitch_deg"),
        ({}, "relative_to"),
    ],
)
def test_angles_of_a_gimbal_come_from_one_place(
    flight: SyntheticFlight, gimbal: dict[str, Any], key: str
) -> None:
    with pytest.raises(DataError) as caught:
        checked(flight, {"pose": {"file": "drone1.tum", "of": "body"}, "gimbal": gimbal})
    assert key in caught.value.problem


@pytest.mark.parametrize(
    "change",
    [
        {"pose": {"file": "drone1.tum"}, "mount": {"looks": "forward"}},
        {"pose": {"file": "still.toml", "of": "body"}, "mount": {"looks": "forward"}},
    ],
)
def test_a_mount_belongs_to_the_pose_of_a_body(flight: SyntheticFlight, change: dict[str, Any]) -> None:
    still = write_flight(flight.manifest.parent / "still", cameras=1, seconds=0.1, static=True)
    calibration = (still.manifest.parent / "calibration.toml").read_text(encoding="utf-8")
    flight.manifest.with_name("still.toml").write_text(calibration, encoding="utf-8")
    with pytest.raises(DataError) as caught:
        checked(flight, change)
    assert caught.value.code == "wrong-option"


def test_keys_of_earlier_versions_are_read(flight: SyntheticFlight) -> None:
    def read(pose: dict[str, Any]) -> Any:
        cameras = flight.settings["cameras"]
        changed = {**cameras["drone1"], "pose": pose, "mount": None}
        settings = {**flight.settings, "cameras": {**cameras, "drone1": changed}}
        path = flight.manifest.with_name("earlier.yaml")
        SyntheticFlight(path, settings, *list(vars(flight).values())[2:]).save()
        return read_flight(path).cameras["drone1"].pose

    today = read({"file": "drone1.tum", "of": "camera"})
    assert read({"tum": "drone1.tum", "of": "camera"}) == today
    assert read({"static": {"path": "drone1.tum", "of": "camera"}}) == today
    angles = {"yaw_deg": 90, "pitch_deg": -30}
    assert GimbalSource.model_validate({"fixed": angles}) == GimbalSource.model_validate(angles)
