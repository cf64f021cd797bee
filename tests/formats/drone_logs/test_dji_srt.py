"""DJI's subtitles: real files of every generation, and the meaning of their fields."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.formats.drone_logs.dji_subtitles import DJI_SRT as FORMAT
from pipelines.formats.drone_logs.dji_subtitles import read_subtitles
from pipelines.formats.drone_logs.telemetry_rows import between_refreshed_angles, between_repeats
from pipelines.geometry.poses import rotate
from pipelines.session.records import Telemetry
from pipelines.session.registries import TelemetryChoice
from tests.real_data import facts, real_data

NAMES = [
    "MAVIC3.srt",
    "air2s.srt",
    "mavic_2pro_new.SRT",
    "matrice_300.srt",
    "old_format.SRT",
    "p4_rtk.SRT",
    "broken_incomplete.SRT",
]


def read(path: Path, **choice: Any) -> Telemetry:
    return FORMAT.read_telemetry(path, TelemetryChoice(**choice))


def test_real_subtitles_without_display_times_have_their_clock() -> None:
    """Read a Mavic 2's file: 468 numbered blocks, one a second, each with its clock time and position."""
    path = real_data("second/mavic_2_style.SRT")
    text = path.read_text(encoding="utf-8-sig")
    subtitles = read_subtitles(path)
    assert len(subtitles.texts) == text.count("latitude") == 468
    assert subtitles.media_ns[:3].tolist() == [0, 10**9, 2 * 10**9]
    telemetry = read(path, altitude=30.0)
    assert telemetry.position.t_ns[0] == 1501942311393525000  # 2017-08-05 14:11:51.393525, as if it were UTC
    assert telemetry.position.values[0].tolist() == [-20.2533, 149.0251, 30.0]


@pytest.mark.parametrize("name", NAMES)
def test_real_files_are_read_as_their_facts_state(name: str) -> None:
    path, told = real_data(f"logs/dji_srt/{name}"), facts(f"logs/dji_srt/{name}")
    assert FORMAT.recognises(path)
    telemetry = read(path, altitude=None if name != "mavic_2pro_new.SRT" else 50)
    assert len(telemetry.position.t_ns) + sum(telemetry.dropped.values()) == told["blocks"]
    box = told["lat_lon_bbox"]
    places = telemetry.position.values
    assert [places[:, :2].min(axis=0).tolist(), places[:, :2].max(axis=0).tolist()] == [
        box["min"],
        box["max"],
    ]
    if relative := told.get("rel_alt") or told.get("barometer") or told.get("H_m"):
        assert [places[:, 2].min(), places[:, 2].max()] == [relative["min"], relative["max"]]
    # The first fix is not moved, and the file gives it with these digits.
    assert telemetry.position.values[0, :2].tolist() == told["lat_lon_first"]
    assert (telemetry.gimbal is not None) == ("gimbal_pry_first" in told)


def test_the_gimbal_of_a_real_phantom_looks_where_it_flew() -> None:
    telemetry = read(real_data("logs/dji_srt/p4_rtk.SRT"))
    assert telemetry.gimbal is not None
    assert telemetry.body is not None
    pitch, _, yaw = facts("logs/dji_srt/p4_rtk.SRT")["gimbal_pry_first"]
    ahead = rotate(telemetry.gimbal.quaternion_xyzw[0], np.array([1.0, 0.0, 0.0]))
    assert np.degrees(np.arctan2(ahead[0], ahead[1])) == pytest.approx(yaw, abs=1e-9)
    assert np.degrees(np.arcsin(ahead[2])) == pytest.approx(pitch, abs=1e-9)
    assert telemetry.position.t_ns[0] < 10**15  # since the video's start, not since 1970


BLOCK = (
    '{n}\n00:00:0{n},000 --> 00:00:0{n},040\n<font size="36">2024-05-01 10:00:0{n}.000\n{text} </font>\n\n'
)


def subtitles(path: Path, *texts: str, newline: str = "\n", bom: bool = False) -> Path:
    blocks = "".join(BLOCK.format(n=n, text=text) for n, text in enumerate(texts, 1))
    data = blocks.replace("\n", newline).encode()
    path.write_bytes(b"\xef\xbb\xbf" * bom + data)
    return path


@pytest.mark.parametrize(
    ("text", "position"),
    [
        ("[latitude: 47.5] [longitude: 8.25] [rel_alt: 3.5 abs_alt: 480.0]", (47.5, 8.25, 3.5)),
        ("[latitude : 47.5] [longtitude : 8.25] [altitude: 480.0]", (47.5, 8.25, 480.0)),
        ("GPS(8.25,47.5,16) Hb:3.5 Hs:1.9", (47.5, 8.25, 3.5)),
        ("HOME(8.2,47.4) 2017.8.5 14:11:51\nGPS(8.25, 47.5, 16) BAROMETER:3.5", (47.5, 8.25, 3.5)),
        ("GPS(47.5,8.25,0.0M) BAROMETER:3.5M", (47.5, 8.25, 3.5)),
        ("GPS (8.25, 47.5, 15), HOME (8, 47, -5.0m), D 3.0m, H 3.50m, H.S 9.00m/s", (47.5, 8.25, 3.5)),
        ("GPS(-58.4563,-34.7383,19) BAROMETER:-2.0", (-34.7383, -58.4563, -2.0)),
    ],
)
@pytest.mark.parametrize(("newline", "bom"), [("\n", False), ("\r\n", True)])
def test_every_form(tmp_path: Path, text: str, position: tuple[float, ...], newline: str, bom: bool) -> None:
    path = subtitles(tmp_path / "a.SRT", text, text, newline=newline, bom=bom)
    assert FORMAT.recognises(path)
    np.testing.assert_array_equal(read(path).position.values, [position, position])


@pytest.mark.parametrize(
    ("angles", "ahead", "up"),
    [
        ("gb_yaw: 0.0 gb_pitch: 0.0 gb_roll: 0.0", (0, 1, 0), (0, 0, 1)),
        ("gb_yaw: 90.0 gb_pitch: 0.0 gb_roll: 0.0", (1, 0, 0), (0, 0, 1)),
        ("gb_yaw: 90.0 gb_pitch: -90.0 gb_roll: 0.0", (0, 0, -1), (1, 0, 0)),
        ("gb_yaw: 0.0 gb_pitch: -30.0 gb_roll: 0.0", (0, 0.75**0.5, -0.5), (0, 0.5, 0.75**0.5)),
        ("gimbal_yaw: 0.0 gimbal_pitch: 0.0 gimbal_roll: 90.0", (0, 1, 0), (1, 0, 0)),
    ],
)
def test_where_a_gimbal_looks(
    tmp_path: Path, angles: str, ahead: tuple[float, ...], up: tuple[float, ...]
) -> None:
    text = f"[latitude: 47.5] [longitude: 8.25] [rel_alt: 3.5 abs_alt: 480.0] [{angles}]"
    gimbal = read(subtitles(tmp_path / "a.srt", text, text)).gimbal
    assert gimbal is not None
    turned = gimbal.quaternion_xyzw[0]
    np.testing.assert_allclose(rotate(turned, np.array([1.0, 0, 0])), ahead, atol=1e-12)
    np.testing.assert_allclose(rotate(turned, np.array([0, 0, 1.0])), up, atol=1e-12)


def test_losses_are_counted(tmp_path: Path) -> None:
    good = "[latitude: 47.5] [longitude: 8.25] [rel_alt: 3.5 abs_alt: 480.0]"
    path = subtitles(
        tmp_path / "a.srt",
        good,
        "[latitude: 0.0] [longitude: 0.0] [rel_alt: 3.5 abs_alt: 480.0]",
        "[latitude: 147.5] [longitude: 8.25] [rel_alt: 3.5 abs_alt: 480.0]",
        "[latitude: 47.5] [longitu",
        good,
    )
    telemetry = read(path)
    assert len(telemetry.position.t_ns) == 2
    assert list(telemetry.dropped.values()) == [1, 1, 1]
    # Cut in the middle of a two-byte character.
    path.write_bytes(path.read_bytes()[:-60] + b"\xc2")
    assert len(read(path).position.t_ns) == 1


def test_repeated_measurements_become_lines() -> None:
    # 30 pictures a second, a fix every fifth: the positions of a straight flight are on a line again.
    t_ns = np.arange(31, dtype=np.int64) * 33_000_000
    true = np.stack([2.0 * t_ns / 1e9, -t_ns / 1e9], axis=1)
    seen = true[np.arange(31) // 5 * 5]
    smooth, moved = between_repeats(t_ns, seen)
    np.testing.assert_allclose(smooth, true, atol=1e-12)
    assert moved == 24
    # A drone that hovers for three seconds and then moves at once did not drift during those seconds.
    t_ns = np.arange(40, dtype=np.int64) * 100_000_000
    seen = np.where(t_ns >= 3_000_000_000, 5.0, 0.0)[:, None]
    smooth, _ = between_repeats(t_ns, seen)
    assert smooth[t_ns <= 2_000_000_000].max() == 0
    np.testing.assert_allclose(smooth[t_ns == 2_500_000_000], 2.5)
    np.testing.assert_array_equal(between_repeats(t_ns, np.ones((40, 1)))[0], 1)


@pytest.mark.parametrize("rows", [2, 3, 6])
def test_angles_that_are_repeated_become_lines_and_their_holds_stay(rows: int) -> None:
    """Turn yaw evenly; hold pitch, turn it and hold it again. Both are refreshed at a lower rate."""
    number = np.arange(60 * rows + 1)
    t_ns = number * 33_000_000
    true = np.stack(
        [1.5 * number, np.interp(number, [0, 30 * rows, 40 * rows, 60 * rows], [0, 0, 40, 40])], 1
    )
    seen = true[number // rows * rows]
    found = between_refreshed_angles(t_ns, seen)
    np.testing.assert_allclose(found[:, 0], true[:, 0], atol=1e-9)
    # The first change ends a hold. The line to it may begin one row early, because the rates differ.
    np.testing.assert_allclose(found[:, 1], true[:, 1], atol=40 / 10 / (rows + 1) + 1e-9)
    held = number < 31 * rows - (rows + 1)
    np.testing.assert_array_equal(found[held, 1], 0)
    np.testing.assert_allclose(found[31 * rows :, 1], true[31 * rows :, 1], atol=1e-9)


def test_places_whose_order_shows_in_their_numbers(tmp_path: Path) -> None:
    """116 E is no latitude: GPS(latitude, longitude, satellites)."""
    path = subtitles(tmp_path / "a.SRT", *(f"GPS(39.9042,116.407{k},16) BAROMETER:20.1" for k in range(3)))
    track = read(path).position
    assert track.values[0, :2].tolist() == [39.9042, 116.407]
    assert (
        read(subtitles(tmp_path / "a.SRT", "GPS(8.25,47.5,16) BAROMETER:20.1")).position.values[0, 0] == 47.5
    )
