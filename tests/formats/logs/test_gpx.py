"""GPX tracks, written byte by byte after Topografix's schema."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.formats.logs import gpx
from pipelines.session.registries import LogFormat, recognise
from tests.formats.refusals import refuses

READER: LogFormat = gpx.FORMAT
HEAD = '<?xml version="1.0"?>\n<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1">\n'
START_NS = 1704164645_000_000_000  # 2024-01-02T03:04:05Z


def point(k: int, time: str | None = None, ele: str = "<ele>500.5</ele>") -> str:
    time = f"2024-01-02T03:04:{5 + k:02d}.250Z" if time is None else time
    return f'<trkpt lat="48.{k}" lon="-11.5">{ele}<time>{time}</time></trkpt>\n'


def track(*points: str) -> str:
    return f"<trk><name>walk</name><trkseg>{''.join(points)}</trkseg></trk>\n"


def write(folder: Path, *tracks: str, end: str = "</gpx>") -> Path:
    path = folder / "walk.gpx"
    path.write_text(HEAD + "".join(tracks) + end)
    return path


def test_points_are_fixes_by_time(tmp_path: Path) -> None:
    path = write(tmp_path, track(point(0), point(1)))
    assert recognise(path, LogFormat, "log") is READER
    with READER.open_log([path]) as log:
        [topic] = log.topics
        assert (topic.name, topic.type, topic.count) == ("/track", "sensor_msgs/msg/NavSatFix", 2)
        first, second = log.messages(["/track"])
        assert log.dropped == {}
    assert first.receive_ns == START_NS + 250_000_000
    assert (first.value.header.stamp.sec, first.value.header.stamp.nanosec) == (1704164645, 250_000_000)
    assert (second.value.latitude, second.value.longitude, second.value.altitude) == (48.1, -11.5, 500.5)


def test_a_prefix_of_the_schema_changes_nothing(tmp_path: Path) -> None:
    path = write(tmp_path, track(point(0)))
    text = path.read_text().replace("xmlns=", "xmlns:g=").replace("<", "<g:").replace("<g:/", "</g:")
    path.write_text(text.replace("<g:?", "<?"))
    assert recognise(path, LogFormat, "log") is READER
    with READER.open_log([path]) as log:
        assert [topic.count for topic in log.topics] == [1]


def test_several_tracks_are_several_topics(tmp_path: Path) -> None:
    path = write(tmp_path, track(point(0)), track(point(5), point(6)))
    with READER.open_log([path]) as log:
        assert {topic.name: topic.count for topic in log.topics} == {"/track1": 1, "/track2": 2}
        assert len(list(log.messages(["/track2"]))) == 2
    assert READER.describe(path)["messages"] == 3


def test_zones_are_followed(tmp_path: Path) -> None:
    path = write(tmp_path, track(point(0, "2024-01-02T04:04:05+01:00"), point(1, "2024-01-02T03:04:06")))
    with READER.open_log([path]) as log:
        assert [m.receive_ns for m in log.messages(["/track"])] == [START_NS, START_NS + 10**9]


def test_points_without_time_place_or_height_are_counted(tmp_path: Path) -> None:
    bad = [point(1, ""), point(2).replace('lat="48.2"', 'lat="x"'), point(3, ele="")]
    with READER.open_log([write(tmp_path, track(point(0), *bad))]) as log:
        assert [topic.count for topic in log.topics] == [1]
        assert set(log.dropped.values()) == {1}
        assert len(log.dropped) == 3


def test_a_cut_file_gives_the_points_before_the_cut(tmp_path: Path) -> None:
    path = write(tmp_path, track(point(0), point(1)))
    path.write_text(path.read_text()[:-60])
    with READER.open_log([path]) as log:
        assert [topic.count for topic in log.topics] == [1]
        assert sum(log.dropped.values()) == 1


@pytest.mark.parametrize("content", ["", "<gpx", HEAD + "</gpx>", HEAD + track(point(0, "")) + "</gpx>"])
def test_files_without_points_are_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "walk.gpx"
    path.write_text(content)
    READER.recognises(path)
    with refuses(path):
        READER.open_log([path])
