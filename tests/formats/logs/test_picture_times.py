"""Pictures read from their bytes equal decoded ones; unusual ones are left to the decoder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipelines.formats.logs.message_decoders import Schema, decoder, find_layout
from pipelines.formats.logs.messages import all_samples
from pipelines.formats.logs.pictures import (
    later_pictures,
    later_times,
    picture_stamps,
    stamp_of,
    stamps_at_once,
)
from pipelines.formats.scenes.mcap_writing import build
from pipelines.geometry.arrays import Int64
from pipelines.session.errors import DataError
from pipelines.session.records import PictureSample
from pipelines.session.registries import LogFormat, recognise
from tests.synthetic.logs import CONTAINERS, ROS1, ROS2, Container, Entry, write_log

TOPIC = "/pictures"
COMPRESSED, RAW = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"
START_NS = 1_700_000_000_000_000_000


def fields(k: int, **others: Any) -> dict[str, Any]:
    rng = np.random.default_rng(k)
    data = rng.integers(0, 256, 24 + k, dtype=np.uint8)
    data[:3] = (0xFF, 0xD8, 0xFF)
    return {
        "header": {"stamp": START_NS + k, "frame_id": "camera"},
        "format": "JPEG",
        "height": 3,
        "width": 2 + k,
        "encoding": "bgr8",
        "step": 8,
        "data": data,
    } | others


def serialized(encoding: str, type_: str, stated: dict[str, Any]) -> bytes:
    if encoding == "ros1":
        return bytes(ROS1.serialize_ros1(build(ROS1, type_, stated), type_))
    return bytes(ROS2.serialize_cdr(build(ROS2, type_, stated), type_))


def alike(k: int, received_ns: int) -> Entry:
    """Make a picture that differs from the others only in stamp and pixels, as those of a camera do."""
    stated = fields(0, header={"stamp": START_NS + k, "frame_id": "camera"})
    return Entry(TOPIC, COMPRESSED, received_ns, stated)


def stamps_of(arrays: tuple[Int64, Int64]) -> list[tuple[int, int]]:
    header_ns, receive_ns = arrays
    return list(zip(header_ns.tolist(), receive_ns.tolist(), strict=True))


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=12),
    st.sampled_from(["header", "receive"]),
)
def test_later_times_are_those_of_the_later_pictures(rows: list[tuple[int, int]], stamps: str) -> None:
    """Draw seconds that repeat, go back, leap or are missing (0), or increase as those of a camera do."""
    rows = rows if len(rows) > 3 else [(k + 1, k + 1) for k in range(len(rows))]
    header_ns, receive_ns = (np.array([r[i] for r in rows], np.int64) * 10**9 for i in range(2))
    samples = [
        PictureSample(int(h), int(r), "jpeg", None, None, None, np.zeros(1, np.uint8))
        for h, r in zip(header_ns, receive_ns, strict=True)
    ]
    expected = [stamp_of(picture, stamps) for picture in later_pictures(iter(samples), stamps)]
    assert later_times(header_ns, receive_ns, stamps).tolist() == expected


@pytest.mark.parametrize("container", CONTAINERS)
def test_stamps_at_once_are_those_of_the_pictures(tmp_path: Path, container: Container) -> None:
    """Interleave two files, with equal stamps of receipt and some out of order."""
    received = np.random.default_rng(3).integers(0, 30, 60).tolist()
    entries = [alike(k, START_NS + r) for k, r in enumerate(received)]
    paths = [
        write_log(tmp_path, name, container, part)
        for name, part in (("first", entries[:30]), ("second", entries[30:]))
    ]
    with recognise(paths[0], LogFormat, "log").open_log(paths) as log:
        expected = [(s.stamp_ns, s.receive_ns) for s in all_samples(log.messages([TOPIC]), "log")]
        found = stamps_of(picture_stamps(log, TOPIC, "log"))
        at_once = stamps_at_once(log, TOPIC)
        (topic,) = log.topics
    assert found == expected
    assert len(expected) == 60
    assert (at_once is not None) == (topic.encoding in {"cdr", "ros1"})


@pytest.mark.parametrize("name", ["bag", "log.bag", "log.mcap"])
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_costs_both_ways_the_same(tmp_path: Path, name: str, data: st.DataObject) -> None:
    container: Container = "ros2-sqlite3" if name == "bag" else "ros1" if name == "log.bag" else "mcap-cdr"
    whole = tmp_path / name
    if not whole.exists():
        # Pictures of 9 kB each, so that a database needs several pages for one.
        wide = np.arange(9000, dtype=np.uint8)
        write_log(
            tmp_path,
            name.partition(".")[0],
            container,
            [
                replace(e, fields={**e.fields, "data": wide})
                for e in (alike(k, START_NS + k) for k in range(20))
            ],
        )
    content = bytearray((whole / "bag.db3" if whole.is_dir() else whole).read_bytes())
    if data.draw(st.booleans()):
        at = data.draw(st.integers(0, len(content) // 4096)) * 4096
        content[at : at + 4096] = bytes(len(content[at : at + 4096]))
    else:
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    hurt = tmp_path / f"hurt{'.db3' if whole.is_dir() else whole.suffix}"
    hurt.write_bytes(content)
    results = []
    for at_once in (True, False):
        try:
            with recognise(hurt, LogFormat, "log").open_log([hurt]) as log:
                if at_once:
                    stamps = stamps_of(picture_stamps(log, TOPIC, "log"))
                else:
                    stamps = [(s.stamp_ns, s.receive_ns) for s in all_samples(log.messages([TOPIC]), "log")]
                results.append((stamps, log.dropped))
        except DataError as error:
            results.append(([], {str(error): 1}))
    assert results[0] == results[1]


@pytest.mark.parametrize("type_", [COMPRESSED, RAW])
@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_a_layout_fits_only_bytes_that_the_decoder_reads_alike(encoding: str, type_: str) -> None:
    """Cut anywhere, or change any of the first 60 bytes."""
    schema = Schema(type_, encoding)
    whole = serialized(encoding, type_, fields(1))
    damaged = [whole[:end] for end in range(len(whole))]
    damaged += [whole + b"\x00" * more for more in (1, 2, 3, 4)]
    for at in range(60):
        for value in (0, 1, 0x80, 0xFF):
            damaged.append(whole[:at] + bytes([value]) + whole[at + 1 :])
    decode = decoder(schema)
    read = 0
    for data in [whole, *damaged]:
        raw, size = np.frombuffer(data, np.uint8)[None], np.array([len(data)])
        layout = find_layout(schema, data)
        if layout is None or not layout.fits(raw, size):
            continue
        read += 1
        value = decode(data)
        assert layout.stamps_ns(raw) == value.header.stamp.sec * 10**9 + value.header.stamp.nanosec
        assert len(value.data) == len(data) - layout.end
    assert read > 50
