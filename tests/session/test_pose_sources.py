"""Sources of poses that a manifest may state."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pipelines.session.errors import DataError
from pipelines.session.manifest import read_flight
from tests.synthetic.flights import write_flight


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("flight")


@pytest.mark.parametrize(
    ("pose", "problem"),
    [
        ({"dji": "a.SRT", "instance": 1}, "instance: only a pose by ulog, ardupilot or tlog has that"),
        ({"dji": "a.SRT", "preset": "mavros"}, "preset: only a pose from a log has that"),
        ({"log": "a.bag", "preset": "mavos"}, "preset: .*'dji_osdk', 'mavros' or 'px4'"),
        ({"ulog": "a.ulg", "altitude": 3}, "altitude: only a pose by dji has that"),
        ({"ulog": "a.ulg", "instanc": 3}, "unknown key, did you mean 'instance'"),
        ({"ardupilot": "a.bin", "dji": "b"}, "needs exactly one of"),
        ({"log": "a.bag", "attitude": "/imu"}, "attitude: needs the topic of the positions"),
        ({"dji": "a.SRT", "axes": "ned"}, "axes: only a pose that is no drone's own log"),
    ],
)
def test_what_cannot_be_meant(folder: Path, pose: dict[str, Any], problem: str) -> None:
    flight = write_flight(folder, cameras=1, seconds=0.1, clean=True)
    flight.settings["cameras"]["drone1"]["pose"] = pose
    flight.save()
    with pytest.raises(DataError, match=problem):
        read_flight(flight.manifest)


@pytest.mark.parametrize(
    ("gimbal", "problem"),
    [
        ({"relative_to": "world"}, "needs log and topic, or fixed"),
        ({"log": "a.bag", "topic": "/g"}, "lacks relative_to"),
        ({"topic": "/g", "relative_to": "world"}, "topic: needs the log that holds it"),
        ({"fixed": {"yaw_deg": 3, "pitch_deg": 2}, "log": "a.bag"}, "has a log and fixed angles"),
        ({"fixed": {"yaw_deg": 3}}, "pitch_deg: is missing"),
        ({}, "needs log and topic, fixed angles"),
    ],
)
def test_gimbals_that_cannot_be_meant(folder: Path, gimbal: dict[str, Any], problem: str) -> None:
    flight = write_flight(folder, cameras=1, seconds=0.1, clean=True)
    camera = flight.settings["cameras"]["drone1"]
    camera |= {"pose": {"tum": "drone1.tum", "of": "body"}, "gimbal": gimbal}
    flight.save()
    with pytest.raises(DataError, match=problem):
        read_flight(flight.manifest)
