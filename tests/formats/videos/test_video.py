"""Videos with known stamps; FFmpeg's plain decoding and OpenCV give the expected values."""

from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from pipelines.formats.videos import video
from pipelines.formats.videos.video import VideoReader, black_bars, created_ns
from pipelines.geometry.arrays import Picture
from pipelines.session.recognition import recognise
from pipelines.session.records import UNTIMED
from pipelines.session.registries import VideoFormat
from tests.raising import refused
from tests.real_data import real_data
from tests.synthetic.videos import SIZE, TICK_S, even_ticks, read_bar_code, uneven_ticks, write_video

READER: VideoFormat = video.FORMAT


def relative_ns(ticks: list[int], tick_s: Fraction = TICK_S) -> list[int]:
    return [round(Fraction(t - ticks[0]) * tick_s * 10**9) for t in ticks]


def packets(path: Path) -> list[tuple[int, int]]:
    """Return position and size of each coded frame in the file, in the order of decoding."""
    with av.open(str(path)) as container:
        return [(p.pos, p.size) for p in container.demux(video=0) if p.size and p.pos is not None]


def decoded_by_opencv(path: Path) -> tuple[list[Picture], list[float]]:
    capture = cv2.VideoCapture(str(path))
    pictures, milliseconds = [], []
    while (answer := capture.read())[0]:
        pictures.append(answer[1])
        milliseconds.append(capture.get(cv2.CAP_PROP_POS_MSEC))
    capture.release()
    return pictures, milliseconds


@pytest.mark.parametrize("b_frames", [0, 2])
@pytest.mark.parametrize("ticks", [even_ticks(40), uneven_ticks(40)], ids=["constant", "variable"])
def test_stamps_are_those_written(tmp_path: Path, ticks: list[int], b_frames: int) -> None:
    path = write_video(tmp_path / "v.mp4", ticks, b_frames=b_frames)
    index = READER.index(path)
    assert index.pts_ns.tolist() == relative_ns(ticks)
    assert index.start_ns == 0
    assert index.rate_hz == pytest.approx(39 / ((ticks[-1] - ticks[0]) / 90_000), rel=1e-9)
    assert (index.width, index.height, index.codec, index.rotation_deg) == (*SIZE, "h264", 0)
    assert index.dropped == {}


def test_frames_that_an_edit_list_hides_are_none(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mp4", even_ticks(40), b_frames=0)
    content = bytearray(path.read_bytes())
    place = content.find(b"elst") + 4 + 8 + 4  # version and flags, count; the duration comes first
    content[place : place + 4] = (10 * 3000).to_bytes(4, "big")
    path.write_bytes(content)
    pictures, _ = decoded_by_opencv(path)
    with VideoReader(path) as reader:
        assert reader.index.count == len(pictures) == 30
        assert [read_bar_code(picture) for _, picture in reader.frames()] == list(range(10, 40))
        assert reader.missing == set()


def test_frames_that_vp9_never_shows_are_none() -> None:
    path = real_data("second/roadtrip-vp92-10bit.webm")  # 80 packets, 8 of them alternate references
    pictures, milliseconds = decoded_by_opencv(path)
    with VideoReader(path) as reader:
        assert reader.index.count == len(pictures) == 72
        assert reader.index.dropped == {}
        np.testing.assert_allclose(reader.index.pts_ns / 1e6, milliseconds, rtol=0, atol=1e-6)
        mine = dict(reader.frames())
        assert (sorted(mine), reader.missing) == (list(range(72)), set())
    # The two conversions of ten bits to eight differ by levels at edges; another frame differs far more.
    mean = [[np.abs(mine[k].astype(int) - pictures[j]).mean() for j in range(72)] for k in (0, 30, 50, 71)]
    assert np.argmin(mean, axis=1).tolist() == [0, 30, 50, 71]


def test_frames_that_vp8_never_shows_are_none(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.webm", even_ticks(40), codec="libvpx")
    with av.open(str(path)) as container:
        coded = [bytes(p) for p in container.demux(video=0) if p.size]
    content = path.read_bytes()
    for number in (7, 20, 33):  # the bit show_frame of RFC 6386, 9.1
        first = coded[number][0] & ~0b10000
        content = content.replace(coded[number], bytes([first]) + coded[number][1:])
    path.write_bytes(content)
    pictures, _ = decoded_by_opencv(path)
    shown = [number for number in range(40) if number not in (7, 20, 33)]
    with VideoReader(path) as reader:
        assert reader.index.count == len(pictures) == len(shown)
        assert [read_bar_code(picture) for _, picture in reader.frames()] == shown
        assert reader.missing == set()
        assert [round(t / 1e9 * 30) for t in reader.index.pts_ns.tolist()] == shown


@pytest.mark.parametrize(
    ("name", "codec"),
    [
        ("v.mp4", "libx264"),
        ("v.mkv", "libx264"),
        ("v.avi", "libx264"),
        ("v.ts", "libx264"),
        ("v.mov", "mjpeg"),
        ("v.webm", "libvpx-vp9"),
    ],
)
def test_a_hundred_random_reads_equal_decoding_in_order(tmp_path: Path, name: str, codec: str) -> None:
    path = write_video(tmp_path / name, uneven_ticks(100), codec=codec)
    with VideoReader(path) as reader:
        in_order = dict(reader.frames())
        assert [read_bar_code(picture) for picture in in_order.values()] == list(range(100))
        for number in np.random.default_rng(1).integers(0, 100, 100).tolist():
            picture = reader.read(number)
            assert picture is not None
            assert np.array_equal(picture, in_order[number]), f"frame {number}"
        assert reader.missing == set()


@pytest.mark.parametrize("turned_deg", [0, 90, 180, 270])
def test_pictures_are_opencvs(tmp_path: Path, turned_deg: int) -> None:
    path = write_video(tmp_path / "v.mp4", uneven_ticks(30), turned_deg=turned_deg)
    pictures, milliseconds = decoded_by_opencv(path)
    index = READER.index(path)
    assert index.rotation_deg == turned_deg
    assert (index.width, index.height) == (SIZE if turned_deg % 180 == 0 else SIZE[::-1])
    # OpenCV gives milliseconds as a float64 of seconds.
    np.testing.assert_allclose(index.pts_ns / 1e6, milliseconds, rtol=0, atol=1e-6)
    with VideoReader(path) as reader:
        mine = [picture for _, picture in reader.frames()]
    assert len(mine) == len(pictures)
    assert mine[0].shape == (index.height, index.width, 3)
    assert mine[0].flags.c_contiguous
    # The same libraries; their two conversions to BGR may round differently by a level or two.
    assert max(np.abs(a.astype(int) - b).max() for a, b in zip(mine, pictures, strict=True)) <= 2


def test_a_damaged_frame_is_missing_and_the_others_keep_their_numbers(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write_video(tmp_path / "v.mp4", uneven_ticks(30), key_every=1, b_frames=0)
    with VideoReader(path) as reader:
        whole = dict(reader.frames())
    content = bytearray(path.read_bytes())
    for number in (7, 20):
        position, size = packets(path)[number]
        content[position : position + size] = bytes(size)
    path.write_bytes(content)
    with VideoReader(path) as reader:
        assert reader.index.pts_ns.tolist() == relative_ns(uneven_ticks(30))
        left = dict(reader.frames())
        assert ["2 coded frames" in note for note in reader.index.notes] == [True]
        assert reader.missing == {7, 20}
        assert reader.read(7) is None
        again = reader.read(8)
        assert again is not None
        assert np.array_equal(again, whole[8])
    assert sorted(left) == sorted(set(range(30)) - {7, 20})
    assert all(np.array_equal(left[number], whole[number]) for number in left)
    assert capfd.readouterr().err == "", "FFmpeg's own words would stand beside ours"


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8, 0.95])
def test_a_cut_mp4_is_salvaged_and_its_losses_are_counted(tmp_path: Path, share: float) -> None:
    path = write_video(tmp_path / "v.mp4", uneven_ticks(60))
    places = packets(path)
    content = path.read_bytes()
    first = places[0][0]
    length = first + int(share * (len(content) - first))
    path.write_bytes(content[:length])
    held = sum(position + size <= length for position, size in places)
    with VideoReader(path) as reader:
        count = reader.index.count
        assert list(reader.index.dropped.values()) == [60 - count]
        # Two frames in a row refer to later ones: decoding is ahead of showing by that and one more.
        assert held - 3 <= count <= held
        assert reader.index.pts_ns.tolist() == relative_ns(uneven_ticks(60))[:count]
        assert [read_bar_code(picture) for _, picture in reader.frames()] == list(range(count))
        assert reader.missing == set()
    described = READER.describe(path)
    assert [value for key, value in described.items() if key.startswith("dropped")] == [60 - count]


def remuxed(path: Path, source: Path, pts_of: Callable[[int, int], int | None]) -> Path:
    """Copy the coded frames of a video with other stamps; those without a stamp are left out."""
    with av.open(str(source)) as read, av.open(str(path), "w") as written:
        stream = written.add_stream_from_template(read.streams.video[0])
        for number, packet in enumerate(p for p in read.demux(video=0) if p.size and p.pts is not None):
            pts = pts_of(number, packet.pts or 0)
            if pts is not None:
                packet.pts, packet.dts, packet.stream = pts, (packet.dts or 0) - 50_000, stream
                written.mux(packet)
    return path


@pytest.mark.parametrize("b_frames", [0, 2])
@pytest.mark.parametrize("lost", [range(1), range(5), range(12), range(17), [24], [24, 26, 48], [59]])
def test_a_stream_that_lost_frames_is_numbered_as_decoders_do(
    tmp_path: Path, lost: Sequence[int], b_frames: int
) -> None:
    """Frame 12 n is a key frame; without it a decoder gives few of those up to the next one."""
    whole = write_video(tmp_path / "whole.ts", even_ticks(60), b_frames=b_frames)
    path = remuxed(tmp_path / "v.ts", whole, lambda number, pts: None if number in lost else pts)
    expected = [read_bar_code(picture) for picture in decoded_by_opencv(path)[0]]
    with VideoReader(path) as reader:
        assert reader.index.count == len(expected)
        assert reader.index.pts_ns[0] == 0
        assert sum(reader.index.dropped.values()) == 60 - len(lost) - len(expected)
        shown = [read_bar_code(picture) for _, picture in reader.frames()]
        # With them, a decoder gives pictures beside a gap out of order.
        assert (b_frames and lost[0]) or shown == expected
        tenth = reader.read(10)
        assert tenth is not None
        assert read_bar_code(tenth) == expected[10]


@pytest.mark.parametrize("alike", [[5], [5, 6, 7], [3, 20, 39]])
def test_frames_of_equal_stamps_keep_the_numbers_of_a_decoder(tmp_path: Path, alike: list[int]) -> None:
    whole = write_video(tmp_path / "whole.ts", even_ticks(40), b_frames=0)
    stamps: list[int] = []

    def pts_of(number: int, pts: int) -> int:
        stamps.append(stamps[-1] if number in alike else pts)
        return stamps[-1]

    path = remuxed(tmp_path / "v.ts", whole, pts_of)
    with VideoReader(path) as reader:
        assert reader.index.count == 40
        assert [read_bar_code(picture) for _, picture in reader.frames()] == list(range(40))
        for number in (38, *alike, 0, 30):
            picture = reader.read(number)
            assert picture is not None
            assert read_bar_code(picture) == number
        assert (np.diff(reader.index.pts_ns) > 0).all()
        others = np.delete(np.arange(40), alike)
        expected = (np.array(stamps) - stamps[0])[others] * 100_000 / 9
        np.testing.assert_allclose(reader.index.pts_ns[others], expected, atol=1)
        assert [str(len(alike)) in note for note in reader.index.notes] == [True]


@pytest.mark.parametrize(
    ("suffix", "codec", "form", "b_frames"),
    [
        (".h264", "libx264", "h264", 0),
        (".264", "libx264", "h264", 2),
        (".raw", "libx264", "h264", 0),
        (".h265", "libx265", "hevc", 0),
        (".mjpeg", "mjpeg", "mjpeg", 0),
        (".mjpg", "mjpeg", "mjpeg", 0),
    ],
)
def test_raw_streams_are_numbered_and_have_no_times(
    tmp_path: Path, suffix: str, codec: str, form: str, b_frames: int
) -> None:
    path = tmp_path / f"v{suffix}"
    try:
        write_video(path, even_ticks(30), codec=codec, b_frames=b_frames, container_format=form)
    except (av.error.FFmpegError, ValueError) as error:
        pytest.skip(f"this FFmpeg does not write {codec} ({error})")
    assert recognise(path, VideoFormat, "video").name == "video"
    with VideoReader(path) as reader:
        assert (reader.index.count, reader.index.codec) == (30, UNTIMED)
        assert [read_bar_code(picture) for _, picture in reader.frames()] == list(range(30))
        for number in (17, 3, 29):
            picture = reader.read(number)
            assert picture is not None
            assert read_bar_code(picture) == number
    assert READER.describe(path)["frames"] == 30


@pytest.mark.parametrize(
    ("form", "b_frames", "key_every", "lost"),
    [
        ("h264", 0, 12, {25: b"\x55"}),
        ("h264", 0, 12, {13: b"", 23: b""}),
        ("h264", 2, 12, {7: b"", 29: b""}),
        ("hevc", 0, 12, {20: b""}),
        ("h264", 0, 12, {12: b""}),  # a key frame: of those behind it the decoder gives few or none
        ("hevc", 2, 12, {11: b"", 12: b""}),
        ("hevc", 0, 108, {2: b""}),  # of which the decoder gives six pictures
    ],
)
def test_pictures_that_a_raw_stream_lost_move_no_other(
    tmp_path: Path, form: str, b_frames: int, key_every: int, lost: dict[int, bytes]
) -> None:
    """The fourth picture from the end is a key frame, so what is shown from there on is whole."""
    count = max(36, key_every) + 4
    path, codec = tmp_path / f"v.{form}", {"h264": "libx264", "hevc": "libx265"}[form]
    write_video(
        path, even_ticks(count), codec=codec, key_every=key_every, b_frames=b_frames, container_format=form
    )
    content, places = path.read_bytes(), packets(path)
    for number, filling in sorted(lost.items(), reverse=True):
        first, end = places[number][0] + (6 if filling else 0), sum(places[number])
        content = content[:first] + filling * (end - first) + content[end:]
    path.write_bytes(content)
    with VideoReader(path) as reader:
        assert reader.index.count + sum(reader.index.dropped.values()) == count
        shown = [read_bar_code(picture) for _, picture in reader.frames()]
    t_s = (reader.index.pts_ns // 10**9).tolist()
    assert t_s[-4:] == shown[-4:] == [*range(count - 4, count)]


def test_lost_groups_of_a_raw_stream_leave_no_trace(tmp_path: Path) -> None:
    """A key frame counts from 0 again, so what is left is byte for byte a shorter recording."""
    for path, count in ((tmp_path / "whole.h264", 48), (tmp_path / "short.h264", 24)):
        write_video(path, even_ticks(count), draw=lambda _: np.full((96, 96, 3), 99, np.uint8))
    content, places = (tmp_path / "whole.h264").read_bytes(), packets(tmp_path / "whole.h264")
    assert content[: places[12][0]] + content[places[36][0] :] == path.read_bytes()
    assert (READER.index(path).count, READER.index(path).dropped) == (24, {})


def test_a_display_matrix_that_mirrors_is_refused(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mp4", even_ticks(5))
    content = path.read_bytes()
    one = (1 << 16).to_bytes(4)
    unit = one + bytes(12) + one + bytes(12)  # of the track, after that of the movie
    at = content.index(unit, content.index(unit) + 1)
    path.write_bytes(content[:at] + (-(1 << 16)).to_bytes(4, signed=True) + content[at + 4 :])
    with refused("unsupported", path):
        READER.index(path)


@pytest.mark.parametrize("name", ["cam01", "cam02"])
def test_real_recordings_decode_as_ffmpeg_does(name: str) -> None:
    path = real_data(f"pose2sim_single/videos/{name}.mp4")
    with av.open(str(path)) as container:
        tick_s = container.streams.video[0].time_base
        decoded = [frame for frame in container.decode(video=0) if frame.pts is not None]
    stamps = [frame.pts for frame in decoded if frame.pts is not None]
    with VideoReader(path) as reader:
        assert reader.index.pts_ns.tolist() == relative_ns(stamps, Fraction(tick_s or 0))
        for number in (99, 0, 55):
            picture = reader.read(number)
            assert picture is not None
            assert np.array_equal(picture, decoded[number].to_ndarray(format="bgr24"))


@pytest.mark.parametrize(
    ("stated", "made_ns"),
    [
        ("2024-05-01T10:00:03.000000Z", 1_714_557_603_000_000_000),
        ("1904-01-01T00:00:00.000000Z", None),  # MP4's zero: its clock was never set
        (None, None),
    ],
)
def test_the_stated_time_of_creation_is_read(tmp_path: Path, stated: str | None, made_ns: int | None) -> None:
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w", options={}) as container:
        if stated is not None:
            container.metadata["creation_time"] = stated
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 32, 32, "yuv420p"
        for _ in range(3):
            picture = av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    assert created_ns(path) == made_ns


@pytest.mark.parametrize("bars", [(0, 0, 0, 0), (0, 7, 0, 8), (33, 0, 21, 0)])
def test_black_bars_are_counted_to_a_pixel(tmp_path: Path, bars: tuple[int, int, int, int]) -> None:
    left, top, right, bottom = bars

    def draw(number: int) -> Picture:
        picture = np.zeros((120, 200, 3), dtype=np.uint8)
        picture[top : 120 - bottom, left : 200 - right] = (150, 110 + number, 100)
        return picture

    assert black_bars(write_video(tmp_path / "v.mp4", even_ticks(9), draw=draw)) == bars
