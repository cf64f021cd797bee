"""GoPro's telemetry: a real Karma's, and packets written byte by byte after GoPro's description."""

import struct
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.drone_logs import gpmf
from pipelines.formats.videos.video import FORMAT as VIDEO
from pipelines.geometry.poses import rotate
from pipelines.session.recognition import recognise
from pipelines.session.records import Telemetry
from pipelines.session.registries import TelemetryChoice, VideoFormat
from tests.real_data import real_data
from tests.synthetic.drone_logs import drone_of
from tests.synthetic.flights import write_flight
from tests.synthetic.video_tracks import gpmf_item, gpmf_nested, gpmf_numbers, write_gopro

READER = gpmf.FORMAT
KARMA = "second/karma.mp4"


def fixes(utc: str, fix: int, rows: list[list[int]], *, sea: bool = False) -> bytes:
    scale = gpmf_numbers("SCAL", "l", [[10_000_000], [10_000_000], [1000], [1000], [100]])
    above = gpmf_item("GPSA", "c", 1, 4, b"MSLV") if sea else b""
    about = [gpmf_numbers("GPSF", "L", [[fix]]), gpmf_item("GPSU", "c", 1, 16, utc.encode()), above, scale]
    return gpmf_nested("DEVC", gpmf_nested("STRM", *about, gpmf_numbers("GPS5", "l", rows)))


def place(k: int) -> list[int]:
    return [481_000_000 + 10 * k, 112_000_000 + 20 * k, 500_000 + 100 * k, 1000, 100]


PACKETS = [
    (0, 10**9, fixes("240102030405.500", 2, [place(0), place(1)])),
    (10**9, 10**9, fixes("240102030406.500", 3, [place(2), place(3)])),
    (2 * 10**9, 10**9, fixes("240102030407.500", 3, [place(4), place(5)])),
]


def read(monkeypatch: pytest.MonkeyPatch, packets: list[tuple[int, int, bytes]], **choice: str) -> Telemetry:
    monkeypatch.setattr(gpmf, "_packets", lambda *_: iter(packets))
    return READER.read_telemetry(Path("a.mp4"), TelemetryChoice(**choice))


def test_fixes_are_spread_over_their_packets_in_utc(monkeypatch: pytest.MonkeyPatch) -> None:
    telemetry = read(monkeypatch, PACKETS)
    # 2024-01-02 03:04:06.5 UTC is 1704164646.5 s.
    assert telemetry.position.t_ns.tolist() == [1704164646500000000 + 500_000_000 * k for k in range(4)]
    expected = [[48.1 + 1e-6 * k, 11.2 + 2e-6 * k, 500 + 0.1 * k] for k in range(2, 6)]
    np.testing.assert_allclose(telemetry.position.values, expected, rtol=0, atol=1e-9)
    assert telemetry.position.height == "ellipsoid"
    assert telemetry.dropped == {"no 3D fix": 2}
    assert telemetry.body is None
    boot = read(monkeypatch, PACKETS, time="boot")
    assert boot.position.t_ns.tolist() == [10**9 + 500_000_000 * k for k in range(4)]


def test_a_video_with_pictures_holds_the_places_in_utc(tmp_path: Path) -> None:
    truth = drone_of(write_flight(tmp_path / "f", cameras=1, seconds=1.1, clean=True), 0)
    path = write_gopro(tmp_path / "GOPR0001.MP4", truth, pictures=33)
    assert READER.recognises(path)
    assert recognise(path, VideoFormat, "video") is VIDEO
    telemetry = READER.read_telemetry(path, TelemetryChoice())
    position = telemetry.position
    at_ns = np.arange(20) * 100_000_000
    assert position.t_ns.tolist() == (truth.t_ns[0] + at_ns).tolist()
    kept = np.minimum(np.searchsorted(truth.t_ns - truth.t_ns[0], at_ns), len(truth.t_ns) - 1)
    places = np.stack([truth.latitude_deg, truth.longitude_deg], axis=1)[kept]
    np.testing.assert_allclose(position.values[:, :2], places, rtol=0, atol=0.51e-7)  # whole 1e-7 deg
    np.testing.assert_allclose(position.values[:, 2], truth.altitude_m[kept], rtol=0, atol=0.51e-3)
    assert telemetry.video_began == (int(truth.t_ns[0]), gpmf._PACKET_S)
    facts = READER.describe(path)
    assert (facts["positions"], facts["video_began_s"]) == ("20 of its GPS", truth.t_ns[0] / 1e9)


def test_a_packet_that_is_cut_costs_its_rows_only(monkeypatch: pytest.MonkeyPatch) -> None:
    start, length, content = PACKETS[2]
    telemetry = read(monkeypatch, [*PACKETS[:2], (start, length, content[:-12])])
    assert len(telemetry.position.t_ns) == 2
    assert 1 in telemetry.dropped.values()


def test_rows_of_hero_11_have_their_own_time_and_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    """2024-01-02 is day 8767 since 2000."""
    scale = [10_000_000, 10_000_000, 1000, 1000, 100, 1, 1000, 100, 1]
    rows = b"".join(struct.pack(">7i2H", *place(k)[:5], 8767, 11_045_500 + 100 * k, 120, 3) for k in range(3))
    about = [
        gpmf_item("TYPE", "c", 1, 9, b"lllllllSS"),
        gpmf_numbers("SCAL", "l", [[each] for each in scale]),
    ]
    content = gpmf_nested("DEVC", gpmf_nested("STRM", *about, gpmf_item("GPS9", "?", 32, 3, rows)))
    telemetry = read(monkeypatch, [(0, 300_000_000, content)])
    assert telemetry.position.t_ns.tolist() == [1704164645500000000 + 100_000_000 * k for k in range(3)]


def test_a_real_karma_is_where_and_when_it_was_filmed() -> None:
    """Compare with the video's time of creation, the drone's own heading and home, and gravity."""
    path = real_data(KARMA)
    assert READER.recognises(path)
    assert recognise(path, VideoFormat, "video") is VIDEO
    telemetry = READER.read_telemetry(path, TelemetryChoice())
    assert len(telemetry.position.t_ns) == 47
    made_s = 1492457277  # by ffprobe: 2017-04-17T19:27:57Z, whole seconds
    assert abs(telemetry.position.t_ns[0] / 1e9 - made_s) < 2
    track = gpmf._read(path)
    home = np.concatenate(track.rows["BPOS"])[:, :2].mean(axis=0)
    assert np.abs(telemetry.position.values[:, :2] - home).max() < 1e-3  # about 100 m
    heading = np.radians(np.concatenate(track.rows["GLPI"])[:, 8])
    assert telemetry.body is not None
    nose = rotate(telemetry.body.quaternion_xyzw, np.array([1.0, 0, 0]))
    said = np.stack([np.sin(heading), np.cos(heading)], axis=1)  # heading counts from north to east
    level = nose[:, :2] / np.linalg.norm(nose[:, :2], axis=1, keepdims=True)
    assert (level * said).sum(axis=1).min() > np.cos(np.radians(5))
