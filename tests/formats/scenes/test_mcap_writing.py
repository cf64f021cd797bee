"""Export to MCAP: the mcap library finds valid schemas, and rosbags decodes the messages."""

from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipelines.formats.common.exporting import CHI2_95
from pipelines.formats.scenes import mcap_writing
from pipelines.session.registries import Export
from tests.formats.exported import LENS, LOOKING_NORTH, SIGMA_M, flown, recording, stamps

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
