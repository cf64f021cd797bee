"""Frame times: CSV of several forms, real DJI subtitles, and damage."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.videos import frame_times
from pipelines.formats.videos.frame_times import FrameStamps, read_frame_times, times_of_frames
from tests.real_data import real_data


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def utc_ns(text: str, microseconds: int = 0) -> int:
    moment = datetime.fromisoformat(text).replace(tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)
    return moment // timedelta(microseconds=1) * 1000 + microseconds * 1000


def subtitles(clocks: list[str], step_ms: int = 40) -> str:
    """Write blocks as DJI drones do."""
    blocks = []
    for k, clock in enumerate(clocks):
        start, stop = (f"00:00:{t // 1000:02d},{t % 1000:03d}" for t in (k * step_ms, (k + 1) * step_ms))
        blocks.append(
            f'{k + 1}\n{start} --> {stop}\n<font size="36">SrtCnt : {k + 1}\n{clock}\n[iso : 1]</font>\n'
        )
    return "\n".join(blocks)


@pytest.mark.parametrize(
    "text",
    [
        "frame,t_ns\n0,1700000000123456789\n1,1700000000223456789\n3,1700000000423456789\n",
        "frame,t\n0,1700000000.123456789\n1,1700000000.223456789\n3,1700000000.423456789\n",
        "#timestamp [ns];frame_id\n1700000000123456789;0\n1700000000223456789;1\n1700000000423456789;3\n",
        "Frame\tTime\tnote\n3\t1700000000.423456789\tx\n0\t1700000000.123456789\t\n1\t1700000000.223456789\ty\n",
        "frame,sec,nanosec\n0,1700000000,123456789\n1,1700000000,223456789\n3,1700000000,423456789\n",
        "\ufefft_ns,frame\r\n1700000000123456789,0.0\r\n1700000000223456789,1.0\r\n1700000000423456789,3.0\r\n",
    ],
)
def test_forms_of_a_csv(tmp_path: Path, text: str) -> None:
    stamps = read_frame_times(written(tmp_path / "f.csv", text))
    assert stamps.frame.tolist() == [0, 1, 3]
    assert stamps.t_ns.tolist() == [1700000000123456789, 1700000000223456789, 1700000000423456789]
    assert stamps.media_ns is None
    assert stamps.dropped == {}


def test_rows_that_cannot_be_used_are_counted_by_cause(tmp_path: Path) -> None:
    text = "frame,t\n0,1\n1,nan\n,3\n-2,3\n2.5,3\n2,3\n2,3.5\n3,2.5\n4,3\n5,4\n6"
    stamps = read_frame_times(written(tmp_path / "f.csv", text))
    assert stamps.frame.tolist() == [0, 2, 5]
    assert stamps.t_ns.tolist() == [1_000_000_000, 3_000_000_000, 4_000_000_000]
    assert sorted(stamps.dropped.values()) == [1, 1, 1, 2, 3]  # cut line, time, twice; late; number


@pytest.mark.parametrize(
    ("name", "rows", "last_frame", "first_ns", "last_ns"),
    [
        (
            "MAVIC3.srt",
            12318,
            12317,
            utc_ns("2021-12-25 12:27:52", 373_000),
            utc_ns("2021-12-25 12:31:58", 710_000),
        ),
        ("air2s.srt", 17, 16, utc_ns("2022-08-07 13:40:40", 774_808), utc_ns("2022-08-07 13:40:41", 308_639)),
        # The last subtitle ends at 369.88 s: 9247 frames of 40 ms, of which 8952 have one.
        (
            "mavic_2pro_new.SRT",
            8952,
            9246,
            utc_ns("2019-09-27 10:28:08", 438_904),
            utc_ns("2019-09-27 11:11:41", 524_497),
        ),
    ],
)
def test_real_subtitles(name: str, rows: int, last_frame: int, first_ns: int, last_ns: int) -> None:
    path = real_data(f"logs/dji_srt/{name}")
    assert frame_times.FORMAT.recognises(path)
    facts = frame_times.FORMAT.describe(path)
    assert (facts["rows"], facts["first_frame"], facts["last_frame"]) == (rows, 0, last_frame)
    assert (facts["first_ns"], facts["last_ns"]) == (first_ns, last_ns)
    assert not any(key.startswith("dropped") for key in facts)


def test_clocks_of_every_spelling(tmp_path: Path) -> None:
    clocks = ["2022-08-07 13:40:40,774,808", "2022-08-07 13:40:40.875", "2022.8.7 13:40:41"]
    stamps = read_frame_times(written(tmp_path / "f.srt", subtitles(clocks)))
    assert stamps.t_ns.tolist() == [
        utc_ns("2022-08-07 13:40:40", 774_808),
        utc_ns("2022-08-07 13:40:40", 875_000),
        utc_ns("2022-08-07 13:40:41"),
    ]
    assert stamps.media_ns is not None
    assert stamps.media_ns.tolist() == [0, 40_000_000, 80_000_000]


def test_times_by_frame_number() -> None:
    stamps = FrameStamps(np.array([0, 2, 3, 9]), np.array([10, 30, 41, 90]))
    t_ns, known = times_of_frames(stamps, np.arange(5) * 7)
    assert known.tolist() == [True, False, True, True, False]
    assert t_ns.tolist() == [10, 0, 30, 41, 0]


def test_times_by_place_in_the_video() -> None:
    # The recorder skipped what would have been frame 2, so the video's frame 2 is shown at 120 ms.
    media_ns = np.array([0, 40, 120, 160]) * 1_000_000
    stamps = FrameStamps(np.array([0, 1, 3, 4]), np.array([5, 45, 125, 165]), media_ns)
    pts_ns = np.array([0, 40_000_123, 119_999_000, 160_000_000, 200_000_000])
    t_ns, known = times_of_frames(stamps, pts_ns)
    assert known.tolist() == [True, True, True, True, False]
    assert t_ns.tolist() == [5, 45, 125, 165, 0]
