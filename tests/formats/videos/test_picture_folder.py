"""Folders of pictures: EXIF written by Pillow, XMP by DJI's names, pixels by OpenCV."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from pipelines.formats.videos import picture_folder
from pipelines.formats.videos.picture_folder import FolderPictures, Tags, picture_times, read_tags
from pipelines.geometry.poses import rotate
from pipelines.session.recognition import recognise
from pipelines.session.records import UNTIMED
from pipelines.session.registries import TelemetryChoice, VideoFormat
from tests.commands.runner import succeeds
from tests.raising import refused

READER: VideoFormat = picture_folder.PICTURES
TAGS = picture_folder.PICTURE_TAGS
COUNT = 4
START_NS = 1704164645_250_000_000  # 2024-01-02 03:04:05.25
XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description drone-dji:GpsLatitude="{lat:.9f}"
 drone-dji:GpsLongtitude="11.5" drone-dji:RelativeAltitude="+30.{k}0" drone-dji:AbsoluteAltitude="+530.00"
 drone-dji:GimbalYawDegree="+90.00" drone-dji:GimbalPitchDegree="-30.00" drone-dji:GimbalRollDegree="+0.00"
 drone-dji:FlightYawDegree="+45.00" drone-dji:FlightPitchDegree="0.00" drone-dji:FlightRollDegree="0.00"
 drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.03" drone-dji:RtkStdLat="0.04"/></x:xmpmeta>"""


def write(
    folder: Path,
    *,
    exif: bool = True,
    xmp: str = XMP,
    offset: str | None = None,
    gps: bool = False,
    parts: bool = True,
) -> Path:
    """Write pictures 9, 10, 11, ... half a second apart: the order of numbers is not that of text."""
    folder.mkdir(exist_ok=True)
    for k in range(COUNT):
        path = folder / f"DJI_{9 + k}.JPG"
        picture = Image.fromarray(np.full((48, 64, 3), 40 * k, np.uint8))
        tags = Image.Exif()
        if exif:
            half = 25 + 50 * k
            own = {36867: f"2024:01:02 03:04:{5 + half // 100:02d}"}
            own |= {37521: f"{half % 100:02d}"} if parts else {}
            tags[0x8769] = own | {41989: 24} | ({36881: offset} if offset else {})
        if gps:
            degrees = {1: "N", 2: (48.0, 6.0, 0.0036 * k), 3: "E", 4: (11.0, 30.0, 0.0), 6: 530.0}
            tags[0x8825] = degrees
        text = xmp.format(lat=48.1 + 1e-6 * k, k=k).encode()
        extra = {"xmp": text} if xmp else {}
        picture.save(path, "JPEG", quality=95, exif=tags, **extra)
    return folder


def test_pictures_are_in_the_order_of_their_numbers_with_exif_times(tmp_path: Path) -> None:
    folder = write(tmp_path / "film")
    assert recognise(folder, VideoFormat, "video") is READER
    index = READER.index(folder)
    assert index.pts_ns.tolist() == [500_000_000 * k for k in range(COUNT)]
    assert (index.start_ns, index.width, index.height) == (START_NS, 64, 48)
    with FolderPictures(folder) as pictures:
        grey = [float(picture.mean()) for _, picture in pictures.frames()]
        assert pictures.read(COUNT) is None
    np.testing.assert_allclose(grey, [0, 40, 80, 120], atol=1.5)  # JPEG of an even grey


def test_tags_of_dji_are_poses(tmp_path: Path) -> None:
    folder = write(tmp_path / "film")
    assert TAGS.recognises(folder)
    assert read_tags(folder / "DJI_9.JPG").focal_35_mm == 24
    telemetry = TAGS.read_telemetry(folder, TelemetryChoice())
    assert telemetry.position.t_ns.tolist() == [START_NS + 500_000_000 * k for k in range(COUNT)]
    expected = [[48.1 + 1e-6 * k, 11.5, 30 + 0.1 * k] for k in range(COUNT)]
    np.testing.assert_allclose(telemetry.position.values, expected, rtol=0, atol=1e-9)
    assert telemetry.position.height == "take-off"
    assert telemetry.gimbal is not None
    assert telemetry.body is not None
    looks = rotate(telemetry.gimbal.quaternion_xyzw[0], np.array([1.0, 0, 0]))
    np.testing.assert_allclose(looks, [np.cos(np.pi / 6), 0, -0.5], atol=1e-9)  # east, 30 deg down
    nose = rotate(telemetry.body.quaternion_xyzw[0], np.array([1.0, 0, 0]))
    np.testing.assert_allclose(nose, [np.sqrt(0.5), np.sqrt(0.5), 0], atol=1e-9)  # north-east
    assert any("0.050 m" in note for note in telemetry.notes)  # of 0.03 and 0.04 m
    absolute = TAGS.read_telemetry(folder, TelemetryChoice(altitude="absolute"))
    assert absolute.position.values[:, 2].tolist() == [530.0] * COUNT


def test_places_in_exif_are_positions(tmp_path: Path) -> None:
    telemetry = TAGS.read_telemetry(write(tmp_path / "film", xmp="", gps=True), TelemetryChoice())
    expected = np.stack([48.1 + 1e-6 * np.arange(COUNT), np.full(COUNT, 11.5), np.full(COUNT, 530.0)], axis=1)
    np.testing.assert_allclose(telemetry.position.values, expected, rtol=0, atol=1e-7)  # EXIF has fractions
    assert telemetry.gimbal is telemetry.body is None


def test_damaged_pictures_are_counted_and_missing_pictures_keep_the_numbers(tmp_path: Path) -> None:
    folder = write(tmp_path / "film")
    (folder / "DJI_11.JPG").write_bytes(b"\xff\xd8\xff")
    telemetry = TAGS.read_telemetry(folder, TelemetryChoice())
    assert list(telemetry.dropped.values()) == [1]
    with FolderPictures(folder) as pictures:
        assert [number for number, _ in pictures.frames()] == [0, 1, 3]
    assert READER.index(folder).codec == UNTIMED


MANIFEST = """schema: 1
cameras:
  drone1:
    video: film
    frame_times: {times}
    pose: {{file: film}}
    intrinsics: {{width: 64, height: 48, fx: 50, fy: 50, cx: 31.5, cy: 23.5}}
"""


def test_a_flight_of_pictures_has_their_times_and_poses(tmp_path: Path) -> None:
    write(tmp_path / "film")
    manifest = tmp_path / "flight.yaml"
    manifest.write_text(MANIFEST.format(times="{start: container}"))
    succeeds("ingest", manifest)
    stored = pd.read_parquet(tmp_path / "flight.session/cameras/drone1/frames.parquet")
    assert stored["t_ns"].tolist() == [START_NS + 500_000_000 * k for k in range(COUNT)]
    poses = pd.read_parquet(tmp_path / "flight.session/cameras/drone1/poses.parquet")
    assert len(poses) == COUNT
    assert poses["z"].iloc[-1] - poses["z"].iloc[0] == pytest.approx(0.3, abs=1e-5)


S_NS = 1_000_000_000


@pytest.mark.parametrize(
    ("seconds", "expected"),
    [
        ([4, 5, 5, 6], [4.5, 5.0, 5.5, 6.0]),  # two a second, from half past the first one on
        ([4, 5, 5, 5, 5, 6, 6, 6, 6, 9], [4.75, 5, 5.25, 5.5, 5.75, 6, 6.25, 6.5, 6.75, 9]),
        ([4, 4], [4, 4.5]),
        ([4, 5, 6], [4, 5, 6]),
        ([4, 4, 3], [4, 4, 3]),  # as they are: the reader refuses times that fall
    ],
)
def test_pictures_of_one_second_are_spread_over_it(seconds: list[int], expected: list[float]) -> None:
    t_ns, shared = picture_times([Tags(second * S_NS) for second in seconds])
    assert (t_ns / S_NS).tolist() == expected
    assert shared is (expected != seconds)
    fine, shared = picture_times([Tags(4 * S_NS), Tags(4 * S_NS + 1), Tags(4 * S_NS + 1)])
    assert (fine[-1] - fine[0], shared) == (1, False)


def test_several_cameras_of_airsim_in_one_folder(tmp_path: Path) -> None:
    rows = ["VehicleName TimeStamp POS_X POS_Y POS_Z Q_W Q_X Q_Y Q_Z ImageFile".replace(" ", "\t")]
    (tmp_path / "images").mkdir()
    for k in range(5):
        for vehicle in ("Drone1", "Drone2"):
            t_ms = START_NS // 10**6 + 100 * k
            for kind in (0, 5):  # the scene, and its segmentation
                picture = Image.new("RGB", (64, 48), (40 * k, 9 * kind, 0))
                picture.save(tmp_path / "images" / f"img_{vehicle}_0_{kind}_{t_ms * 10**6 + kind}.png")
            rows.append(f"{vehicle}\t{t_ms}\t{k}\t0\t-5\t1\t0\t0\t0\tx.png")
    (tmp_path / "airsim_rec.txt").write_text("\n".join(rows) + "\n", encoding="utf-8")
    with refused("ambiguous", tmp_path / "images"):
        READER.index(tmp_path / "images")
    lens = '{"CaptureSettings": [{"ImageType": 0, "Width": 64, "Height": 48}]}'
    lens = f'{{"SettingsVersion": 1.2, "SimMode": "Multirotor", "CameraDefaults": {lens}}}'
    (tmp_path / "settings.json").write_text(lens, encoding="utf-8")
    succeeds("init", tmp_path)
    succeeds("ingest", tmp_path / "flight.yaml")
    for camera in ("Drone1", "Drone2"):
        frames = pd.read_parquet(tmp_path / "flight.session" / "cameras" / camera / "frames.parquet")
        assert (frames["t_ns"] - START_NS // 10**6 * 10**6).tolist() == [k * 10**8 for k in range(5)]
    for path in (tmp_path / "images").glob("img_Drone2*"):
        path.unlink()
    assert READER.index(tmp_path / "images").count == 5
    assert READER.index(tmp_path / "images" / "**Drone1*").count == 5
