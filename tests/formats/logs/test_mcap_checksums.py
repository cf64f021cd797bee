"""Checksum of the data section, as written by the mcap library."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from mcap.writer import Writer

from pipelines.formats.logs.mcap_log import CheckedHash, stated_checksum


def write(path: Path, *, checked: bool = True, chunked: bool = True, summary: bool = True) -> Path:
    with path.open("wb") as file:
        writer = Writer(
            file,
            use_chunking=chunked,
            enable_data_crcs=checked,
            use_statistics=summary,
            use_summary_offsets=summary,
            repeat_channels=summary,
            repeat_schemas=summary,
        )
        writer.start(profile="", library="test")
        channel = writer.register_channel("/numbers", "json", writer.register_schema("Number", "", b""))
        for k in range(1000):
            writer.add_message(channel, k, str(k).encode() * 1000, publish_time=k)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def hashed(path: Path) -> CheckedHash:
    found = CheckedHash(stated_checksum(path))
    with path.open("rb") as file:
        hashlib.file_digest(file, lambda: found)  # type: ignore[arg-type, return-value]
    assert found.digest() == hashlib.sha256(path.read_bytes()).digest()
    return found


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("summary", [True, False])
def test_a_changed_byte_of_the_data_shows(tmp_path: Path, chunked: bool, summary: bool) -> None:
    path = write(tmp_path / "a.mcap", chunked=chunked, summary=summary)
    stated = stated_checksum(path)
    assert stated is not None
    assert not hashed(path).differs
    whole = path.read_bytes()
    for place in (8, 1000, stated.size // 2, stated.size - 1):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        assert hashed(path).differs
