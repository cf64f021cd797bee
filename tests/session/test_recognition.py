"""Files that no format reads: the line says their likely kind, and recognising them never raises."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipelines.session.errors import DataError
from pipelines.session.recognition import EXPECTED, describe_unknown, recognise
from pipelines.session.registries import CalibrationFormat, MapFormat
from pipelines.survey import survey
from tests.real_data import real_data

SUBTITLE = "1\n00:00:00,000 --> 00:00:01,000\nHello\n"


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("empty.csv", b"", "empty"),
        ("a.mcap", b"version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 16384\n", "16384"),
        ("a.srt", SUBTITLE.encode("utf-16"), "subtitles"),
        ("a.csv", "Höhe,Länge\n1,2\n".encode("cp1252"), "not UTF-8"),
        ("a.fit", bytes([14, 16, 0, 0, 1, 0, 0, 0]) + b".FIT" + bytes(9), "FIT"),
        ("a.nmea", b"$GPGGA,1,2,N,3,E,1\n", "NMEA"),
        ("a.csv", b"Time,Latitude,Longitude,Yaw\n1,2,3,4\n", "writer is not known"),
        ("a.srt", SUBTITLE.encode("utf-16-le"), "UTF-16"),
        ("a.toml", b"[cam1]\nsize = [9, 9]\nmatrix = [[1, 0, 4], [0, 1, 4], [0, 0, 1]]\n", "distortions"),
        ("FLY012.DAT", b"\xff\x01" * 200, "DJI"),
        ("a.DAT", bytes(16) + b"BUILD" + bytes(221) + b"DJI_LOG_V3" + bytes(100), "DJI"),
        ("a.txt", b"\x18\x02\0\0\0\0\0\0\xb4\x01\x0e\0" + bytes(range(256)), "DJI"),
        ("DJIFlightRecord_2024-05-01_[10-00-00].txt", b"\xff\x01" * 9, "DJI"),
        ("a.srt", SUBTITLE.encode(), "subtitles"),
        ("a.mcap", b"\x89MCAQ0\r\n" + bytes(100), "MCAP"),
        ("a.bag", b"#ROSBOG V2.0\n", "#ROSBAG"),
        ("a.db3", bytes(100), "SQLite"),
        ("a.ulg", b"ULog\x02", "PX4"),
        ("a.jpg", b"\xff\xd8\xff\xe0" + bytes(20), "JPEG"),
        ("a.zip", b"PK\x03\x04" + bytes(30), "ZIP"),
        ("a.json", b'{"one": 1, "two": 2}', "one, two"),
        ("a.json", b'{"one": 1', "JSON"),
        ("a.toml", b"[first]\nb = 1\n", "first"),
        ("a.toml", b"[first", "TOML"),
        ("a.yaml", b"%YAML:1.0\nfirst: 1\n", "first"),
        ("a.csv", b"lap,speed,gear\n1,2,3\n", "lap, speed, gear"),
        ("a.mp4", bytes(range(200)), "is called .mp4 but holds nothing of that kind"),
        ("a.dat", b"\x01\x02\x03\x04\0\0", "01 02 03 04"),
        ("a.txt", b"Dear diary\n", "text"),
        ("a.npz", b"PK\x03\x04" + bytes(26) + b"camera.npy", "NumPy"),
        ("a.obj", b"# a\nmtllib a.mtl\nv 0.1 -2 3\n", "mesh"),
        ("a.csv", b"time,x,y,z,roll,pitch,yaw\n0,1,2,3,4,5,6\n", "angles"),
    ],
)
def test_the_line_names_what_the_file_looks_like(
    tmp_path: Path, name: str, content: bytes, word: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        survey(path)
    assert word in caught.value.problem
    assert caught.value.remedy
    assert "\n" not in str(caught.value)


def test_a_file_of_another_kind_is_called_by_its_kind() -> None:
    path = real_data("maps/pcl_bunny_ascii.pcd")
    assert recognise(path, MapFormat, "map").name == "pcd"
    with pytest.raises(DataError) as caught:
        recognise(path, CalibrationFormat, "calibration")
    assert "PCD" in caught.value.problem
    assert "opencv" in caught.value.remedy


@pytest.mark.parametrize(
    ("relative", "word"),
    [
        ("calib/colmap_maupertuis_txt/images.txt", "COLMAP"),
        ("calib/pose2sim_Calib.qca.txt", "Qualisys"),
        ("logs/ros2/rosbag2_empty_bag/metadata.yaml", "ROS 2"),
        ("maps/nav2_depot.pgm", "PGM"),
    ],
)
def test_a_part_of_something_larger_leads_to_the_whole(relative: str, word: str) -> None:
    like = describe_unknown(real_data(relative))
    assert word in like.problem
    assert like.remedy not in {"", EXPECTED}


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.binary(max_size=200), st.sampled_from([".json", ".toml", ".yaml", ".csv", ".srt", ".bin", ".mcap", ""])
)
def test_no_content_makes_it_raise(tmp_path: Path, content: bytes, suffix: str) -> None:
    path = tmp_path / f"file{suffix}"
    path.write_bytes(content)
    like = describe_unknown(path)
    assert like.problem
    assert "\n" not in like.problem + like.remedy
