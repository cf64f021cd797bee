"""MCAP in every encoding and layout: whole, without end or index, cut, damaged, and with absurd lengths."""

import shutil
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer

from pipelines.formats.logs.message_decoders import Schema, decoder
from pipelines.formats.logs.messages import bytes_of
from pipelines.formats.logs.recordings import DAMAGED, TAIL, TRUNCATED, UNCLOSED
from tests.formats.log_entries import entries, everything, everything_or_one_line, log_format, positions
from tests.synthetic.logs import Entry, McapCompression, cut, write_mcap

FLIGHT = entries()
ALL = [(e.topic, e.stamp_ns) for e in FLIGHT]
_CHUNK, _MESSAGE, _MESSAGE_INDEX = 6, 5, 7


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
@pytest.mark.parametrize("summary", [True, False])
def test_encodings_and_compressions(
    tmp_path: Path, encoding: Literal["cdr", "ros1"], compression: McapCompression, summary: bool
) -> None:
    path = write_mcap(
        tmp_path / "a.mcap", FLIGHT, encoding, compression=compression, chunk_size=9_000, summary=summary
    )
    assert everything(path) == (ALL, {})
    assert positions(path)[0] == [float(k) for k in range(100)]
    described = log_format(path).describe(path)
    assert described["storage"] == ["uncompressed" if compression == "none" else compression]


@pytest.mark.parametrize("summary", [True, False])
def test_messages_outside_chunks(tmp_path: Path, summary: bool) -> None:
    # Out of order, and more than one run of 1 MB.
    shuffled = [e for k in range(3) for e in entries(20.0)[k::3]]
    path = write_mcap(tmp_path / "a.mcap", shuffled, chunked=False, summary=summary)
    found, dropped = everything(path)
    assert [stamp for _, stamp in found] == sorted(e.stamp_ns for e in shuffled)
    assert not dropped


def test_foxglove_as_json(tmp_path: Path) -> None:
    data = bytes(range(256))
    fields = {"timestamp": {"sec": 5, "nsec": 7}, "frame_id": "camera", "format": "png", "data": data}
    path = write_mcap(tmp_path / "a.mcap", [Entry("/c", "foxglove.CompressedImage", 9, fields)], "json")
    with log_format(path).open_log([path]) as log:
        assert [(t.type, t.encoding) for t in log.topics] == [("foxglove.CompressedImage", "json")]
        (message,) = log.messages(["/c"])
    assert (bytes_of(message.value.data).tobytes(), message.value.timestamp.nsec, message.receive_ns) == (
        data,
        7,
        9,
    )


def test_foxglove_as_protobuf(tmp_path: Path) -> None:
    pose = {"position": {"x": 1.5}, "orientation": {"w": 1.0}}
    rows = [
        Entry("/p", "foxglove.PoseInFrame", 9, {"timestamp": {"seconds": 5, "nanos": 7}, "pose": pose}),
        Entry("/c", "foxglove.CompressedImage", 10, {"format": "png", "data": b"\x00\xff"}),
    ]
    path = write_mcap(tmp_path / "a.mcap", rows, "protobuf")
    with log_format(path).open_log([path]) as log:
        first, second = log.messages(["/p", "/c"])
    assert (first.value.timestamp.seconds, first.value.timestamp.nanos) == (5, 7)
    assert (first.value.pose.position.x, first.value.pose.orientation.w) == (1.5, 1.0)
    assert second.value.data == b"\x00\xff"


def raw_mcap(path: Path, encoding: str, schema: tuple[str, str, bytes] | None, *messages: bytes) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema_id = writer.register_schema(*schema) if schema else 0
        channel = writer.register_channel("/t", encoding, schema_id)
        for stamp, message in enumerate(messages):
            writer.add_message(channel, stamp, message, stamp)
        writer.finish()  # type: ignore[no-untyped-call]  # the library left this one without annotations
    return path


def test_a_type_of_the_user_is_decoded_by_its_definition(tmp_path: Path) -> None:
    definition = (
        b"my_msgs/Inner inner\nuint8 mode\n" + b"=" * 80 + b"\nMSG: my_msgs/Inner\nfloat64[2] range\n"
    )
    schema = ("my_msgs/msg/Outer", "ros2msg", definition)
    message = bytes([0, 1, 0, 0]) + bytes(8) + b"\0\0\0\0\0\0\xf0\x3f" + b"\x07"
    path = raw_mcap(tmp_path / "a.mcap", "cdr", schema, message)
    with log_format(path).open_log([path]) as log:
        (value,) = (m.value for m in log.messages(["/t"]))
    assert (value.inner.range.tolist(), value.mode) == ([0.0, 1.0], 7)


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 0.999))
def test_a_cut_file_gives_its_beginning(tmp_path: Path, compression: McapCompression, share: float) -> None:
    whole = tmp_path / "whole.mcap"
    if not whole.exists():
        write_mcap(whole, FLIGHT, compression=compression, chunk_size=8_000)
    path = cut(Path(shutil.copy(whole, tmp_path / "cut.mcap")), share)
    found, dropped = everything_or_one_line(path)
    if not found:
        # The definitions, some 5 kB, come before the first message.
        assert path.stat().st_size < 5_000 + 10_000
        return
    assert found == ALL[: len(found)]
    assert dropped.keys() <= {TRUNCATED, UNCLOSED, TAIL}
    assert (TRUNCATED in dropped) != (UNCLOSED in dropped)
    if compression == "none":
        # 5 kB come before the first message, 5 kB of summary after the last; the cut costs up to 3 messages.
        assert len(found) >= len(ALL) * share * (1 - 10_000 / whole.stat().st_size) - 10


def test_a_wrong_checksum_costs_its_chunk(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", FLIGHT, compression="none", chunk_size=9_000)
    content = bytearray(path.read_bytes())
    third = records(bytes(content))[_CHUNK][2]
    content[third + 2_000] ^= 1
    path.write_bytes(content)
    found, dropped = everything(path)
    lost = dropped.pop(DAMAGED)
    assert 0 < lost < 20
    assert not dropped
    assert len(found) == len(ALL) - lost
    # Losses of the requested topic alone.
    pose, dropped = positions(path)
    assert dropped == {DAMAGED: 100 - len(pose)}


def records(content: bytes) -> dict[int, list[int]]:
    """Return the positions of the records of each kind, outside chunks."""
    found: dict[int, list[int]] = {}
    position = 8
    while position < len(content) - 8:
        found.setdefault(content[position], []).append(position)
        position += 9 + int.from_bytes(content[position + 1 : position + 9], "little")
    return found


# A TFMessage by pycdr2 (Eclipse Cyclone): of final, appendable and mutable types.
CDR2 = [
    "0006000000000054000000010000000500000006000000026d00000000000002620000003ff00000000000004000000000000000"
    "40080000000000000000000000000000000000000000000000000000000000003ff0000000000000",
    "00090000700000006c000000010000006400000012000000080000000500000006000000020000006d0000000200000062000000"
    "4000000018000000000000000000f03f000000000000004000000000000008402000000000000000000000000000000000000000"
    "0000000000000000000000000000f03f",
    "000b0000d000000000000050c800000001000000c0000000000000402e0000002a00000000000040140000001000000000000020"
    "0500000001000020060000000100004006000000020000006d000000010000400600000002000000620000000200004070000000"
    "6c00000000000040280000002400000000000030000000000000f03f010000300000000000000040020000300000000000000840"
    "01000040340000003000000000000030000000000000000001000030000000000000000002000030000000000000000003000030"
    "000000000000f03f",
]


@pytest.mark.parametrize("message", CDR2)
def test_version_2_of_cdr_is_read(message: str) -> None:
    (found,) = decoder(Schema("tf2_msgs/msg/TFMessage", "cdr"))(bytes.fromhex(message)).transforms
    assert (found.header.stamp.sec, found.header.stamp.nanosec) == (5, 6)
    assert (found.header.frame_id, found.child_frame_id) == ("m", "b")
    moved, turned = found.transform.translation, found.transform.rotation
    assert (moved.x, moved.y, moved.z, turned.x, turned.w) == (1, 2, 3, 0, 1)
