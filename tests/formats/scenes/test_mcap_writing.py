"""Export to MCAP: the mcap library finds valid schemas, and rosbags decodes the messages."""

from __future__ import annotations

import re
import shutil
import struct
import subprocess
import zlib
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader, breakup_chunk, get_chunk_data_stream
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipelines.formats.common.exporting import CHI2_95
from pipelines.formats.scenes import mcap_writing
from pipelines.session.records import Recording
from pipelines.session.registries import Export
from tests.formats.exported import (
    LENS,
    LOOKING_NORTH,
    SIGMA_M,
    START_NS,
    VOXEL_M,
    Listener,
    angles_of_two,
    flown,
    recording,
    stamps,
)
from tests.formats.refusals import refuses

WRITER: Export = mcap_writing.EXPORT
LINE_LIST, SPHERE_LIST, DELETE_ALL = 5, 7, 3


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    (path,) = WRITER.write(recording(), tmp_path_factory.mktemp("mcap"))
    assert path.name == "Mound_walk.mcap"
    return path


def messages(path: Path, topic: str) -> list[tuple[int, Any]]:
    with AnyReader([path]) as reader:
        wanted = [connection for connection in reader.connections if connection.topic == topic]
        return [
            (stamp, reader.deserialize(data, connection.msgtype))
            for connection, stamp, data in reader.messages(connections=wanted)
        ]


def test_the_mcap_reader_finds_every_topic_with_a_schema_that_parses(log: Path) -> None:
    with log.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        stamps_ns = [message.log_time for _, _, message in reader.iter_messages()]
    assert summary is not None
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    assert {channel.topic: counts[key] for key, channel in summary.channels.items()} == {
        "/map": 1,
        "/cam_1/path": 1,
        "/tf": 60,
        "/frustums": 2,
        "/cam_1/camera_info": 4,
        "/cam_1/image/video": 4,
        "/skeleton": 60,
        "/uncertainty": 20,
        "/sigma": 60,
    }
    assert stamps_ns == sorted(stamps_ns)
    reference = get_typestore(Stores.ROS2_HUMBLE)
    # As Foxglove publishes it.
    video = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format"
    reference.register(get_types_from_msg(video, "foxglove_msgs/msg/CompressedVideo"))
    for schema in summary.schemas.values():
        assert schema.encoding == "ros2msg"
        stated = get_types_from_msg(schema.data.decode(), schema.name)
        assert stated[schema.name][1] == reference.fielddefs[schema.name][1]


def test_the_log_is_as_the_mcap_program_demands(log: Path) -> None:
    """The checks of `mcap doctor`, which no package of Python's brings, by the library's strict reader."""
    data = log.read_bytes()
    with log.open("rb") as file:
        records = list(StreamReader(file, emit_chunks=True, validate_crcs=True).records)
    at, places = len(b"\x89MCAP0\r\n"), []
    for _ in records:
        length = 9 + struct.unpack_from("<Q", data, at + 1)[0]
        places.append((at, length))
        at += length
    header, footer = records[0], records[-1]
    assert isinstance(header, Header)
    assert (header.profile, header.library) == ("ros2", "mocap")
    assert isinstance(footer, Footer)
    end = next(k for k, record in enumerate(records) if isinstance(record, DataEnd))
    assert {type(record) for record in records[1:end]} == {Chunk, MessageIndex}

    known: dict[tuple[type, int], Any] = {}
    counts: dict[int, int] = {}
    indexed: list[ChunkIndex] = []
    last_ns = 0
    chunks = [k for k, record in enumerate(records) if isinstance(record, Chunk)]
    for k, following in zip(chunks, [*chunks[1:], end], strict=True):
        chunk = records[k]
        assert isinstance(chunk, Chunk)
        stamps_ns = []
        for record in breakup_chunk(chunk, validate_crc=True):
            if isinstance(record, Message):
                assert (Channel, record.channel_id) in known
                stamps_ns.append(record.log_time)
                counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
                continue
            assert isinstance(record, Schema | Channel)
            assert record.id > 0 or isinstance(record, Channel)
            assert asdict(known.setdefault((type(record), record.id), record)) == asdict(record)
            if isinstance(record, Channel):
                assert (Schema, record.schema_id) in known
        assert stamps_ns == sorted(stamps_ns)
        assert last_ns <= stamps_ns[0] == chunk.message_start_time
        assert stamps_ns[-1] == chunk.message_end_time
        last_ns = stamps_ns[-1]
        indexes = records[k + 1 : following]
        rows = []
        for index in indexes:
            assert isinstance(index, MessageIndex)
            rows += [(index.channel_id, *row) for row in index.records]
        assert len(rows) == len(stamps_ns)
        for channel, stamp_ns, offset in rows:
            stream, _ = get_chunk_data_stream(chunk)
            stream.read(offset)
            stream.read1()
            message = Message.read(ReadDataStream(stream._stream), stream.read8())
            assert (message.channel_id, message.log_time) == (channel, stamp_ns)
        start, length = places[k]
        indexed.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=start,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=sum(size for _, size in places[k + 1 : following]),
                message_index_offsets={
                    index.channel_id: place
                    for index, (place, _) in zip(indexes, places[k + 1 : following], strict=True)
                    if isinstance(index, MessageIndex)
                },
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
        )
    summary = records[end + 1 : -1]
    assert [asdict(record) for record in summary if isinstance(record, ChunkIndex)] == [
        asdict(index) for index in indexed
    ]
    (statistics,) = (record for record in summary if isinstance(record, Statistics))
    assert statistics.channel_message_counts == counts
    assert statistics.message_count == sum(counts.values())
    assert (statistics.channel_count, statistics.schema_count) == tuple(
        sum(kind is each for each, _ in known) for kind in (Channel, Schema)
    )
    assert statistics.chunk_count == len(indexed)
    assert statistics.message_end_time == last_ns
    assert footer.summary_start == places[end + 1][0]
    # All of the summary and the footer up to the sum itself.
    assert footer.summary_crc == zlib.crc32(data[footer.summary_start : places[-1][0] + 9 + 16])


@pytest.mark.skipif(shutil.which("mcap") is None, reason="the mcap program is not installed")
def test_the_mcap_program_finds_nothing_wrong(log: Path) -> None:
    command = ["mcap", "doctor", "--strict-message-order", str(log)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr


def test_the_skeleton_is_there_at_its_own_times(log: Path) -> None:
    motion = recording().motion
    assert motion is not None
    read = messages(log, "/skeleton")
    assert [stamp for stamp, _ in read] == motion.t_ns.tolist()
    for row, (_, message) in enumerate(read):
        cleared, bones, joints = message.markers
        assert (cleared.action, bones.type, joints.type) == (DELETE_ALL, LINE_LIST, SPHERE_LIST)
        assert joints.header.frame_id == "world"
        points = np.array([[point.x, point.y, point.z] for point in joints.points])
        seen = motion.position[row, 0][np.isfinite(motion.position[row, 0, :, 0])]
        np.testing.assert_array_equal(points[: len(seen)], seen)
        assert len(points) == len(seen) + 2  # neck and hip
        assert len(joints.colors) == len(points)
        assert len(bones.colors) == len(bones.points)
        assert len(joints.points) == 19 - (row == 7)
    # One bone ends in the wrist, which is missing in frame 7.
    assert len(read[6][1].markers[1].points) - len(read[7][1].markers[1].points) == 2


def test_sigmas_and_angles_are_series_by_name(tmp_path: Path) -> None:
    made = recording()
    assert made.motion is not None
    (path,) = WRITER.write(replace(made, angles=angles_of_two), tmp_path)
    (first, both), (second, one) = messages(path, "/angles")
    assert [first, second] == made.motion.t_ns[:2].tolist()
    assert (both.name, one.name) == (
        ["left_knee_flexion", "person1/left_knee_flexion"],
        ["left_knee_flexion"],
    )
    np.testing.assert_allclose(both.position, [np.pi, np.pi / 2], rtol=1e-15)
    sigmas = [message.position for _, message in messages(path, "/angles/sigma")]
    np.testing.assert_allclose(np.concatenate(sigmas), [np.pi / 10, np.pi / 20, np.nan], rtol=1e-15)
    read = messages(path, "/sigma")
    assert [len(message.name) for _, message in read] == [17 - (row == 7) for row in range(60)]
    # The root mean square of the three axes.
    np.testing.assert_allclose(read[0][1].position, np.sqrt(np.mean(np.square(SIGMA_M))), rtol=1e-12)


def test_doubts_are_warnings_at_the_beginning(tmp_path: Path) -> None:
    (path,) = WRITER.write(replace(recording(), doubts=lambda: ["one", "two"]), tmp_path)
    read = messages(path, "/doubts")
    assert [(stamp, entry.level, entry.msg) for stamp, entry in read] == [
        (START_NS, entry.WARN, text) for (_, entry), text in zip(read, ["one", "two"], strict=True)
    ]


def test_ellipsoids_hold_95_percent(log: Path) -> None:
    _, message = messages(log, "/uncertainty")[0]
    marker = message.markers[1]
    axes = np.array([marker.scale.x, marker.scale.y, marker.scale.z])
    np.testing.assert_allclose(sorted(axes), 2 * np.sqrt(CHI2_95) * np.sort(SIGMA_M), rtol=1e-12)
    assert {entry.ns for entry in message.markers[1:]} == {"ellipsoids_95"}
    assert len({entry.id for entry in message.markers[1:]}) == len(message.markers) - 1 == 17


def test_cameras_fly_and_look_where_they_do(log: Path) -> None:
    track = flown()
    moved = [message.transforms[0] for _, message in messages(log, "/tf")]
    assert {(entry.header.frame_id, entry.child_frame_id) for entry in moved} == {("world", "cam-1")}
    east = [entry.transform.translation.x for entry in moved]
    np.testing.assert_array_equal(east, track.position[:, 0])
    rotation = moved[0].transform.rotation
    np.testing.assert_array_equal([rotation.x, rotation.y, rotation.z, rotation.w], LOOKING_NORTH)
    ((_, path),) = messages(log, "/cam_1/path")
    assert [pose.pose.position.x for pose in path.poses] == track.position[::3, 0].tolist()
    _, frustums = messages(log, "/frustums")[0]
    corner = frustums.markers[0].points[1]
    # The picture's corner, half a pixel outside the centre of the first pixel.
    np.testing.assert_allclose(
        [corner.x, corner.y, corner.z],
        [(-0.5 - LENS.cx) / LENS.fx, (-0.5 - LENS.cy) / LENS.fy, 1.0],
        rtol=1e-12,
    )
    assert (frustums.markers[0].header.frame_id, frustums.markers[0].frame_locked) == ("cam-1", True)


def test_pictures_come_with_the_lens_of_their_size(log: Path) -> None:
    pictures, lenses = messages(log, "/cam_1/image/video"), messages(log, "/cam_1/camera_info")
    assert [stamp for stamp, _ in pictures] == stamps(60)[::15].tolist()
    decoder = av.VideoCodecContext.create("h264", "r")
    decoded: list[Any] = []
    first = bytes(pictures[0][1].data)
    assert first[:4] == b"\0\0\0\1"  # Annex B
    # 60 x 34 macroblocks at up to 60 Hz are level 3.2 (H.264, table A-1); many decoders end at 5.2.
    assert first[first.index(b"\0\0\0\1\x67") + 7] == 32
    for (stamp, picture), (_, info) in zip(pictures, lenses, strict=True):
        assert (picture.format, picture.frame_id) == ("h264", "cam-1")
        assert picture.timestamp.sec * 10**9 + picture.timestamp.nanosec == stamp
        units = decoder.decode(av.Packet(bytes(picture.data)))
        decoded.extend(frame.to_ndarray(format="bgr24") for frame in units)
        assert (info.width, info.height, info.distortion_model) == (960, 540, "plumb_bob")
        assert info.k[0] == pytest.approx(LENS.fx * 0.75)
        assert info.k[2] == pytest.approx((LENS.cx + 0.5) * 0.75 - 0.5)
        assert info.d.tolist() == [*LENS.distortion, 0.0]
    decoded.extend(frame.to_ndarray(format="bgr24") for frame in decoder.decode(None))
    assert [shown.shape for shown in decoded] == [(540, 960, 3)] * 4
    for shown, level in zip(decoded, range(40, 100, 15), strict=True):
        assert np.abs(shown.astype(int) - level).max() < 15 / 2  # half a step: it is no other picture


def test_the_map_is_its_surface(log: Path) -> None:
    ((stamp, cloud),) = messages(log, "/map")
    assert stamp == START_NS
    points = np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, 3)
    assert len(points) == cloud.width == 26
    np.testing.assert_allclose(points.min(axis=0), np.array([10, 20, 0]) + 1.5 * VOXEL_M)
    assert [field.name for field in cloud.fields] == ["x", "y", "z"]


def test_the_same_recording_gives_the_same_bytes(log: Path, tmp_path: Path) -> None:
    (again,) = WRITER.write(recording(), tmp_path)
    assert again.read_bytes() == log.read_bytes()


def test_poses_from_before_the_zero_of_a_clock_are_left_out_and_counted(tmp_path: Path) -> None:
    listener, track = Listener(), flown(10)
    early = replace(track, t_ns=track.t_ns - START_NS - 100_000_000)
    (path,) = WRITER.write(Recording("x", None, {"a": early}, progress=listener), tmp_path)
    assert len(messages(path, "/tf")) == 7
    assert re.search(r"\b3\b.* a .*\b0\b", listener.notes[0])


def test_times_that_ros_cannot_count_are_refused(tmp_path: Path) -> None:
    late = replace(flown(2), t_ns=np.array([2**31 * 10**9, 2**31 * 10**9 + 1]))
    with refuses("x", 1970, 2038):
        WRITER.write(Recording("x", None, {"a": late}), tmp_path)
    with refuses("x", "reconstruct"):
        WRITER.write(Recording("x", None, {}), tmp_path)
    assert not list(tmp_path.iterdir())
