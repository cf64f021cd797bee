"""Real logs: `describe` and `messages` agree with the reference readers of the same files."""

import pytest

from pipelines.formats.logs import recordings
from pipelines.formats.logs.messages import bytes_of
from pipelines.session.recognition import recognise
from pipelines.session.registries import FORMATS, LogFormat
from tests.raising import refused
from tests.real_data import facts, real_data

LOGS = {
    "logs/ros1/husky_gps_imu_odom.bag": "ros1",
    "logs/ros1/foxglove_example.bag": "ros1",
    "logs/ros1/foxglove_example-bz2.bag": "ros1",
    "logs/ros1/foxglove_no-messages.bag": "ros1",
    "logs/ros1/cruise_example-unsorted-chunks.bag": "ros1",
    "logs/ros1/embag_pointcloud2_lidar.bag": "ros1",
    "logs/ros2/plotjuggler_rosbag2_test": "ros2",
    "logs/ros2/rosbag2_wbag_sqlite3": "ros2",
    "logs/ros2/rosbag2_wbag_mcap": "ros2",
    "logs/ros2/rosbag2_empty_bag": "ros2",
    "logs/mcap/json_camera_calibration_images.mcap": "mcap",
    "logs/mcap/conformance_TenMessages.mcap": "mcap",
    "logs/mcap/edge_bad_schema.mcap": "mcap",
    "logs/mcap/edge_publish_vs_log_time.mcap": "mcap",
    "logs/mcap/edge_unsupported_encoding.mcap": "mcap",
}
# Messages that cannot be decoded: encoding "a", an invalid definition, protobuf as text.
UNDEFINED = {
    "logs/mcap/conformance_TenMessages.mcap": {"example"},
    "logs/mcap/edge_bad_schema.mcap": {"/bad/data"},
    "logs/mcap/edge_unsupported_encoding.mcap": {"/proto/data"},
}
# Their metadata.yaml states another time than their messages; the reference reader repeats it.
WRONG_METADATA = {"logs/ros2/rosbag2_wbag_sqlite3", "logs/ros2/rosbag2_wbag_mcap"}


def ros2_spelling(name: str) -> str:
    return name if "/msg/" in name else name.replace("/", "/msg/")


@pytest.mark.parametrize("path", LOGS)
def test_counts_spans_and_topics(path: str) -> None:
    expected = facts(path)
    described = FORMATS.get(LOGS[path]).describe(real_data(path))
    assert described["messages"] == expected["messages"]
    topics = described["topics"]
    assert isinstance(topics, dict)
    assert {name: (topic["type"], topic["messages"]) for name, topic in topics.items()} == {
        name: (ros2_spelling(topic["type"]), topic["count"]) for name, topic in expected["topics"].items()
    }
    assert ("first_ns" in described) == bool(expected["messages"])
    if expected["messages"] and path not in WRONG_METADATA:
        assert described["first_ns"] == expected["start_ns"]
        assert described["span_s"] == pytest.approx(expected["duration_s"], abs=1e-12)
    assert not any(key.startswith("dropped") for key in described)
    undecodable = {name for name, topic in topics.items() if "cannot be decoded" in topic}
    assert undecodable == UNDEFINED.get(path, set())


@pytest.mark.parametrize("path", LOGS)
def test_every_message_comes_in_the_order_of_receipt(path: str) -> None:
    log_format = FORMATS.get(LOGS[path])
    assert isinstance(log_format, LogFormat)
    with log_format.open_log([real_data(path)]) as log:
        stamps = []
        counts = dict.fromkeys((topic.name for topic in log.topics), 0)
        for message in log.messages(counts):
            stamps.append(message.receive_ns)
            counts[message.topic.name] += 1
        assert stamps == sorted(stamps)
        undefined = UNDEFINED.get(path, set())
        assert counts == {t.name: 0 if t.name in undefined else t.count for t in log.topics}
        lost = sum(topic.count for topic in log.topics if topic.name in undefined)
        assert log.dropped == ({recordings.UNDEFINED: lost} if lost else {})


def test_values_are_those_the_ordinary_reader_saw() -> None:
    path = "logs/ros1/husky_gps_imu_odom.bag"
    expected = facts(path)["topics"]["/husky_velocity_controller/odom"]
    with recognise(real_data(path), LogFormat, "log").open_log([real_data(path)]) as log:
        first, *_, last = log.messages(["/husky_velocity_controller/odom"])
    for message, position in ((first, expected["position_first"]), (last, expected["position_last"])):
        point = message.value.pose.pose.position
        assert [point.x, point.y, point.z] == pytest.approx(position, abs=1e-6)
    stamps = [m.value.header.stamp for m in (first, last)]
    assert [s.sec + s.nanosec * 1e-9 for s in stamps] == pytest.approx(
        expected["header_stamp_range"], abs=1e-6
    )


def test_pictures_in_json_are_bytes() -> None:
    path = real_data("logs/mcap/json_camera_calibration_images.mcap")
    with recognise(path, LogFormat, "log").open_log([path]) as log:
        picture = next(log.messages(["/image/compressed"])).value
        lens = next(log.messages(["/camera_calibration"])).value
    assert bytes_of(picture.data)[:3].tobytes() == b"\xff\xd8\xff"  # the first bytes of a JPEG
    assert (lens.width, lens.K[:3]) == (640, [800, 0, 320])


def test_an_empty_file_is_refused_in_one_line() -> None:
    path = real_data("logs/ros1/foxglove_empty-file.bag")
    with refused("damaged", path, "0 bytes"):
        recognise(path, LogFormat, "log").open_log([path])
