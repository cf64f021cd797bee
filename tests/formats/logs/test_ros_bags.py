"""ROS 1 and ROS 2 bags: every storage gives the same messages; a damaged bag gives its readable ones."""

import shutil
import sqlite3
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipelines.formats.logs.recordings import TAIL, TRUNCATED, UNCLOSED
from pipelines.formats.logs.ros2_bag import MISSING_FILES, NOT_IN_FILES
from tests.formats.log_entries import (
    OTHER,
    PICTURE,
    POSE,
    START_NS,
    entries,
    everything,
    everything_or_one_line,
    log_format,
    positions,
    recognised_by,
)
from tests.synthetic.logs import (
    CONTAINERS,
    ROS2,
    Container,
    cut,
    write_log,
    write_ros1,
    write_ros2,
    write_split_ros2,
)

FLIGHT = entries()
ALL = [(e.topic, e.stamp_ns) for e in FLIGHT]


@pytest.mark.parametrize("container", CONTAINERS)
def test_every_container_gives_the_same_messages(tmp_path: Path, container: Container) -> None:
    path = write_log(tmp_path, "flight", container, FLIGHT)
    with log_format(path).open_log([path]) as log:
        assert {t.name: (t.type, t.count) for t in log.topics} == {
            POSE: ("nav_msgs/msg/Odometry", 100),
            PICTURE: ("sensor_msgs/msg/CompressedImage", 10),
            OTHER: ("std_msgs/msg/String", 10),
        }
        assert log.topics[0].first_ns == START_NS + 3_000_000
        messages = list(log.messages([POSE, PICTURE]))
        assert not log.dropped
    wanted = [e for e in FLIGHT if e.topic != OTHER]
    assert [(m.topic.name, m.receive_ns) for m in messages] == [(e.topic, e.stamp_ns) for e in wanted]
    for message, entry in zip(messages, wanted, strict=True):
        stamp = message.value.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == entry.fields["header"]["stamp"]
        if entry.topic == POSE:
            assert message.value.pose.pose.position.x == entry.fields["pose"]["pose"]["position"]["x"]
        else:
            assert message.value.data.tobytes() == entry.fields["data"]


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_ros1_compressions(tmp_path: Path, compression: Literal["none", "bz2", "lz4"]) -> None:
    path = write_ros1(tmp_path / "a.bag", FLIGHT, compression=compression, chunk_size=10_000)
    assert everything(path) == (ALL, {})
    assert log_format(path).describe(path)["storage"] == [compression]


@pytest.mark.parametrize("compression", ["message", "file"])
@pytest.mark.parametrize("metadata", [True, False])
def test_ros2_compressions(tmp_path: Path, compression: Literal["message", "file"], metadata: bool) -> None:
    path = write_ros2(tmp_path / "bag", FLIGHT, compression=compression, metadata=metadata)
    # rosbags calls the file bag.db3.zstd; rosbag2 would call it bag_0.db3.zstd.
    for file in path.glob("bag.db3*"):
        if not metadata:
            file.rename(file.with_name(file.name.replace("bag.", "bag_0.")))
    assert positions(path) == ([float(k) for k in range(100)], {})


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("metadata", [True, False])
def test_split_bags_are_merged(tmp_path: Path, storage: Literal["sqlite3", "mcap"], metadata: bool) -> None:
    # Files that overlap in time, more than ten of them: file 10 comes after file 9.
    parts = [FLIGHT[k::12] for k in range(12)]
    path = write_split_ros2(tmp_path / "flight", parts, storage=storage, metadata=metadata)
    found, dropped = everything(path)
    assert [stamp for _, stamp in found] == sorted(e.stamp_ns for e in FLIGHT)
    assert (sorted(found), dropped) == (sorted(ALL), {})
    assert recognised_by(path) == ["ros2"]
    files = sorted(path.glob("flight_*"))
    with log_format(files[0]).open_log(files) as log:
        assert sum(topic.count for topic in log.topics) == len(FLIGHT)
        assert len(list(log.messages([POSE]))) == 100
    assert log_format(path).describe(path)["files"] == 12


def test_a_missing_part_costs_its_messages_and_is_said(tmp_path: Path) -> None:
    path = write_split_ros2(tmp_path / "flight", [FLIGHT[:40], FLIGHT[40:80], FLIGHT[80:]])
    (path / "flight_1.db3").unlink()
    found, dropped = everything(path)
    assert found == ALL[:40] + ALL[80:]
    assert dropped == {MISSING_FILES: 1, NOT_IN_FILES: 40}


def test_metadata_cannot_name_files_outside_the_bag(tmp_path: Path) -> None:
    write_ros2(tmp_path / "other", FLIGHT)
    path = write_ros2(tmp_path / "bag", FLIGHT[:10])
    text = (path / "metadata.yaml").read_text(encoding="utf-8")
    (path / "metadata.yaml").write_text(text.replace("bag.db3", "../other/other.db3"), encoding="utf-8")
    _, dropped = everything(path)
    assert dropped[MISSING_FILES] == 1


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 0.999))
def test_a_cut_ros1_bag_gives_its_beginning(
    tmp_path: Path, compression: Literal["none", "bz2", "lz4"], share: float
) -> None:
    whole = tmp_path / "whole.bag"
    if not whole.exists():
        write_ros1(whole, FLIGHT, compression=compression, chunk_size=8_000)
    path = cut(Path(shutil.copy(whole, tmp_path / "cut.bag")), share)
    found, dropped = everything_or_one_line(path)
    if not found:
        # 4117 bytes of magic and header, then a chunk of 8 kB.
        assert path.stat().st_size < 4117 + 10_000
        return
    assert found == ALL[: len(found)]
    assert dropped.keys() <= {TRUNCATED, TAIL, UNCLOSED}
    assert (TRUNCATED in dropped) != (UNCLOSED in dropped)
    if compression == "none":
        # At the cut at most a message of 2.1 kB, an index and a connection can be lost.
        assert len(found) >= len(ALL) * (share - 4117 / whole.stat().st_size) - 10


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 0.999))
def test_a_cut_database_gives_what_its_pages_hold(tmp_path: Path, share: float) -> None:
    whole = tmp_path / "whole"
    if not whole.exists():
        write_ros2(whole, FLIGHT)
    path = cut(Path(shutil.copy(whole / "whole.db3", tmp_path / "cut.db3")), share)
    found, dropped = everything_or_one_line(path)
    assert found == [message for message in ALL if message in set(found)]
    assert dropped


@pytest.mark.parametrize("unmerged", [True, False])
def test_messages_in_the_write_ahead_log_are_read(tmp_path: Path, unmerged: bool) -> None:
    """A recorder that lost its power leaves its last messages there, and on the first run all of them."""
    whole = write_ros2(tmp_path / "bag", FLIGHT) / "bag.db3"
    source = sqlite3.connect(whole)
    target = sqlite3.connect(tmp_path / "a_0.db3", isolation_level=None)
    target.execute("PRAGMA journal_mode = WAL")
    target.execute("PRAGMA wal_autocheckpoint = 0")
    for k, statement in enumerate(source.iterdump()):
        if statement not in {"BEGIN TRANSACTION;", "COMMIT;"}:
            target.execute(statement)
        if k == 60 and not unmerged:
            target.execute("PRAGMA wal_checkpoint(PASSIVE)")
    lost = tmp_path / "lost"
    lost.mkdir()
    for name in ("a_0.db3", "a_0.db3-wal"):
        shutil.copyfile(tmp_path / name, lost / name)
    before = (lost / "a_0.db3").read_bytes()
    for path in (lost / "a_0.db3", lost):
        assert recognised_by(path) == ["ros2"]
        assert everything(path)[0] == everything(whole)[0]
        assert everything(path)[1] == {}
    assert (lost / "a_0.db3").read_bytes() == before
    assert sorted(each.name for each in lost.iterdir()) == ["a_0.db3", "a_0.db3-wal"]
    target.close()


def test_big_endian_messages(tmp_path: Path) -> None:
    path = write_ros2(tmp_path / "bag", FLIGHT[:1])
    value = ROS2.types["std_msgs/msg/Float64"](3.5)
    data = bytes(ROS2.serialize_cdr(value, "std_msgs/msg/Float64", little_endian=False))
    database = sqlite3.connect(path / "bag.db3")
    with database:
        database.execute("UPDATE topics SET type = 'std_msgs/msg/Float64'")
        database.execute("UPDATE messages SET data = ?", (data,))
    database.close()
    with log_format(path).open_log([path]) as log:
        assert [m.value.data for m in log.messages([POSE])] == [3.5]
