"""DJI's djmd, Parrot's records and MISB KLV, written byte by byte after their public descriptions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.drone_logs import djmd, klv, parrot
from pipelines.formats.videos.video import FORMAT as VIDEO
from pipelines.session.registries import VideoFormat, recognise
from pipelines.session.telemetry import TelemetryChoice
from tests.formats.refusals import refuses
from tests.synthetic.drone_logs import DroneTruth, drone_of
from tests.synthetic.flights import write_flight
from tests.synthetic.video_tracks import (
    djmd_messages,
    klv_packet,
    klv_packets,
    parrot_messages,
    parrot_records,
    proto,
    write_djmd,
    write_klv,
    write_parrot,
    write_track,
)

DJI, MISB, PARROT = djmd.FORMAT, klv.FORMAT, parrot.FORMAT


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> DroneTruth:
    return drone_of(write_flight(tmp_path_factory.mktemp("f"), cameras=1, seconds=0.5, clean=True), 0)


def places(truth: DroneTruth) -> np.ndarray:
    return np.stack([truth.latitude_deg, truth.longitude_deg], axis=1)


def test_djmd_beside_pictures_is_read_from_the_time_of_creation(tmp_path: Path, truth: DroneTruth) -> None:
    path = write_djmd(tmp_path / "DJI_0001.MP4", truth, pictures=10)
    assert DJI.recognises(path)
    assert not MISB.recognises(path)
    assert recognise(path, VideoFormat, "video") is VIDEO
    telemetry = DJI.read_telemetry(path, TelemetryChoice())
    # Times are whole ticks of 1/90000 s.
    np.testing.assert_allclose(telemetry.position.t_ns, truth.t_ns, rtol=0, atol=6000)
    np.testing.assert_allclose(telemetry.position.values[:, :2], places(truth), rtol=0, atol=1e-12)
    np.testing.assert_allclose(telemetry.position.values[:, 2], truth.enu[:, 2], rtol=0, atol=1e-6)
    assert telemetry.position.height == "take-off"
    absolute = DJI.read_telemetry(path, TelemetryChoice(altitude="absolute")).position
    np.testing.assert_allclose(absolute.values[:, 2], truth.altitude_m, rtol=0, atol=6e-4)
    facts = DJI.describe(path)
    assert (facts["protocol"], facts["messages"]) == ("dvtm_Air3s", len(truth.t_ns))
    assert facts["gimbal_angles"] == facts["body_angles"] == len(truth.t_ns)


@pytest.mark.parametrize(
    ("protocol", "place", "scale"),
    [
        ("dvtm_AVATA2", (4, 4), np.pi / 180),
        ("dvtm_ac204", (4, 2), np.pi / 180),
        ("dvtm_Mini5Pro", (3, 4), 1.0),
    ],
)
def test_models_keep_their_fields_elsewhere(
    tmp_path: Path, protocol: str, place: tuple[int, int], scale: float
) -> None:
    def message(k: int) -> bytes:
        fix = proto(2, (48.1 + k) * scale, double=True) + proto(3, -11.2 * scale, double=True)
        inner = proto(1, fix) + proto(2, -2500)
        head = proto(1, proto(1, proto(1, f"{protocol}.proto".encode()))) if k == 0 else b""
        return head + proto(3, proto(place[0], proto(place[1], inner)))

    path = write_track(tmp_path / "a.mp4", [(k * 10**8, message(k)) for k in range(3)], codec="bin_data")
    telemetry = DJI.read_telemetry(path, TelemetryChoice())
    expected = [[48.1 + k, -11.2, -2.5] for k in range(3)]
    np.testing.assert_allclose(telemetry.position.values, expected, rtol=1e-12)
    assert telemetry.gimbal is telemetry.body is None
    assert telemetry.clock == "the video's start"
    assert telemetry.position.t_ns.tolist() == [0, 10**8, 2 * 10**8]


def test_a_model_that_nobody_described_is_refused_by_name(tmp_path: Path, truth: DroneTruth) -> None:
    path = write_djmd(tmp_path / "a.mp4", truth, "dvtm_wm999.proto")
    assert DJI.recognises(path)
    with refuses(path, "dvtm_wm999"):
        DJI.read_telemetry(path, TelemetryChoice())


def test_damaged_messages_are_counted(tmp_path: Path, truth: DroneTruth) -> None:
    messages = djmd_messages(truth)
    messages[3] = (messages[3][0], messages[3][1][:-4])
    path = write_track(tmp_path / "a.mp4", messages, codec="bin_data")
    telemetry = DJI.read_telemetry(path, TelemetryChoice())
    assert list(telemetry.dropped.values()) == [1]
    assert len(telemetry.position.t_ns) == len(messages) - 1


@pytest.mark.parametrize("version", [2, 3])
def test_parrots_records_hold_place_body_and_view(tmp_path: Path, truth: DroneTruth, version: int) -> None:
    path = write_parrot(tmp_path / "P.MP4", truth, version, pictures=10)
    assert [DJI.recognises(path), MISB.recognises(path), PARROT.recognises(path)] == [False, False, True]
    telemetry = PARROT.read_telemetry(path, TelemetryChoice())
    np.testing.assert_allclose(telemetry.position.t_ns, truth.t_ns, rtol=0, atol=6000)
    # 22 bits of a degree, 8 of a metre, 14 of a quaternion's part, half of each.
    np.testing.assert_allclose(telemetry.position.values[:, :2], places(truth), rtol=0, atol=1.2e-7)
    np.testing.assert_allclose(telemetry.position.values[:, 2], truth.altitude_m, rtol=0, atol=0.002)
    assert telemetry.position.height == "sea level"
    assert telemetry.body is not None
    assert telemetry.gimbal is not None
    assert telemetry.gimbal.relative_to == "world"
    alike = np.abs((telemetry.body.quaternion_xyzw * truth.body).sum(axis=1))
    np.testing.assert_allclose(alike, 1, rtol=0, atol=1e-8)
    facts = PARROT.describe(path)
    assert (facts["version"], facts["records"]) == (f"P{version}", len(truth.t_ns))
    pitch = truth.gimbal_ypr_deg[:, 1]
    assert facts["view_pitch_deg"] == pytest.approx([pitch.min(), pitch.max()], abs=0.02)


def test_parrots_records_without_a_fix_or_cut_off_are_counted(tmp_path: Path, truth: DroneTruth) -> None:
    records = [content for _, content in parrot_records(truth)]
    nowhere = (500 << 22).to_bytes(4)
    records[1] = records[1][:8] + 2 * nowhere + records[1][16:]
    records[2] = records[2][:60]
    path = write_track(
        tmp_path / "a.mp4", [(k * 10**8, each) for k, each in enumerate(records)], codec="bin_data"
    )
    telemetry = PARROT.read_telemetry(path, TelemetryChoice())
    assert list(telemetry.dropped.values()) == [1, 1]
    assert len(telemetry.position.t_ns) == len(records) - 2
    with refuses(write_djmd(tmp_path / "b.mp4", truth)):
        PARROT.read_telemetry(tmp_path / "b.mp4", TelemetryChoice())


@pytest.mark.parametrize(("utc", "sea"), [(True, True), (False, False)])
def test_parrots_messages_of_protobuf(tmp_path: Path, truth: DroneTruth, utc: bool, sea: bool) -> None:
    messages = parrot_messages(truth, utc=utc, sea=sea)
    path = write_track(tmp_path / "P.MP4", messages, codec="bin_data", made_s=1_700_000_123)
    assert [DJI.recognises(path), MISB.recognises(path), PARROT.recognises(path)] == [False, False, True]
    telemetry = PARROT.read_telemetry(path, TelemetryChoice())
    # UTC is whole microseconds; the track's own times are ticks of 1/90000 s.
    expected_ns = truth.t_ns if utc else truth.t_ns - truth.t_ns[0] + 1_700_000_123 * 10**9
    np.testing.assert_allclose(telemetry.position.t_ns, expected_ns, rtol=0, atol=1000 if utc else 6000)
    np.testing.assert_allclose(telemetry.position.values[:, :2], places(truth), rtol=0, atol=1e-12)
    height = truth.altitude_m + (0 if sea else 47)
    np.testing.assert_allclose(telemetry.position.values[:, 2], height, rtol=0, atol=1e-9)
    assert telemetry.position.height == ("sea level" if sea else "ellipsoid")
    assert telemetry.body is not None
    assert telemetry.gimbal is not None
    alike = np.abs((telemetry.body.quaternion_xyzw * truth.body).sum(axis=1))
    np.testing.assert_allclose(alike, 1, rtol=0, atol=1e-6)  # single precision
    facts = PARROT.describe(path)
    assert (facts["version"], facts["records"]) == ("protobuf", len(truth.t_ns))
    assert facts.get("video_began_s") == (pytest.approx(truth.t_ns[0] / 1e9, abs=1e-3) if utc else None)
    pitch = truth.gimbal_ypr_deg[:, 1]
    assert facts["view_pitch_deg"] == pytest.approx([pitch.min(), pitch.max()], abs=0.02)


def test_parrots_messages_without_a_place_a_time_or_an_end(tmp_path: Path, truth: DroneTruth) -> None:
    messages = parrot_messages(truth)
    without = proto(2, proto(3, proto(1, 1.0)))  # a view and nothing else
    messages[4], messages[5] = (messages[4][0], without), (messages[5][0], messages[5][1][:40])
    path = write_track(tmp_path / "P.MP4", messages, codec="bin_data")
    telemetry = PARROT.read_telemetry(path, TelemetryChoice())
    assert list(telemetry.dropped.values())[:2] == [1, 1]
    assert len(telemetry.position.t_ns) == len(truth.t_ns) - 2
    assert telemetry.gimbal is not None
    # The message without a time is where the video has it.
    np.testing.assert_allclose(telemetry.gimbal.t_ns[3], truth.t_ns[3], rtol=0, atol=12_000)


@pytest.mark.parametrize("name", ["film.ts", "film.klv"])
def test_klv_holds_the_sensors_place_and_angles(tmp_path: Path, truth: DroneTruth, name: str) -> None:
    path = write_klv(tmp_path / name, truth, pictures=10)
    assert MISB.recognises(path)
    assert not DJI.recognises(path)
    telemetry = MISB.read_telemetry(path, TelemetryChoice())
    assert telemetry.position.t_ns.tolist() == (truth.t_ns // 1000 * 1000).tolist()
    # 32 bits of 180 and of 360 deg; 16 bits of 19900 m.
    np.testing.assert_allclose(telemetry.position.values[:, :2], places(truth), rtol=0, atol=5e-8)
    np.testing.assert_allclose(telemetry.position.values[:, 2], truth.altitude_m, rtol=0, atol=0.16)
    assert telemetry.position.height == "sea level"
    assert telemetry.gimbal is not None
    assert telemetry.gimbal.relative_to == "body"
    began = MISB.describe(path).get("video_began_s")
    assert began == (pytest.approx(truth.t_ns[0] / 1e9, abs=1e-3) if name == "film.ts" else None)


def test_klv_of_the_ranges_of_the_standard(tmp_path: Path) -> None:
    """The standard gives an example for each tag: its bytes, and the value in degrees or metres."""
    items = {
        2: (1_700_000_000_000_000).to_bytes(8),
        5: bytes.fromhex("71C2"),
        6: bytes.fromhex("FD3D"),
        7: bytes.fromhex("08B8"),
        13: bytes.fromhex("5595B66D"),
        14: bytes.fromhex("5B5360C4"),
        15: bytes.fromhex("C221"),
        16: bytes.fromhex("CD9C"),
    }
    (tmp_path / "a.klv").write_bytes(klv_packet(items))
    facts = MISB.describe(tmp_path / "a.klv")
    for name, expected, within in (
        ("heading_deg", 159.9744, 3e-3),
        ("pitch_deg", -0.4315251, 1e-4),
        ("roll_deg", 3.405814, 1e-4),
        ("latitude_deg", 60.1768229669783, 1e-7),
        ("longitude_deg", 128.426759042045, 1e-7),
        ("height_above_sea_m", 14190.72, 5e-3),
        ("angle_of_view_deg", 144.5713, 1e-4),
    ):
        assert facts[name] == pytest.approx([expected] * 2, abs=within), name


def test_damaged_klv_is_counted(tmp_path: Path, truth: DroneTruth) -> None:
    packets = [content for _, content in klv_packets(truth)]
    wrong = bytearray(packets[2])
    wrong[40] ^= 1
    (tmp_path / "a.klv").write_bytes(b"".join([*packets[:2], bytes(wrong), *packets[3:], packets[0][:50]]))
    telemetry = MISB.read_telemetry(tmp_path / "a.klv", TelemetryChoice())
    assert list(telemetry.dropped.values()) == [1, 1]
    assert len(telemetry.position.t_ns) == len(packets) - 1


def test_klv_without_positions_is_refused(tmp_path: Path, truth: DroneTruth) -> None:
    (tmp_path / "a.klv").write_bytes(klv_packet({2: (10**15).to_bytes(8), 5: b"\0\0"}))
    with refuses(tmp_path / "a.klv", "position"):
        MISB.read_telemetry(tmp_path / "a.klv", TelemetryChoice())
    assert not MISB.recognises(write_djmd(tmp_path / "a.mp4", replace(truth)))
