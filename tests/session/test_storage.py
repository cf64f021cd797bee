"""Storage: JSON is reproducible, hashes detect every change, errors are one line."""

from __future__ import annotations

import errno
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.session.errors import DataError
from pipelines.session.storage import (
    file_stamp,
    jsonable,
    read_json,
    sha256_of,
    write_json,
)

NUMBERS = st.integers(-(2**53), 2**53) | st.floats(allow_nan=False, allow_infinity=False)
VALUES = st.recursive(
    st.none() | st.booleans() | NUMBERS | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)
DOCUMENTS = st.dictionaries(st.text(), VALUES, max_size=5)


@settings(max_examples=40)  # each one is synced to the disk
@given(DOCUMENTS)
def test_what_is_json_already_survives_unchanged(
    tmp_path_factory: pytest.TempPathFactory, document: Any
) -> None:
    path = tmp_path_factory.getbasetemp() / "round_trip.json"
    write_json(path, jsonable(document))
    assert read_json(path) == document
    assert list(read_json(path)) == list(document), "objects keep their order"


def test_numpy_scalars_become_plain_ones() -> None:
    plain = jsonable(
        {"flag": np.bool_(True), "count": np.int64(2**62), "share": np.float32(0.5), "name": np.str_("a")}
    )
    assert plain == {"flag": True, "count": 2**62, "share": 0.5, "name": "a"}
    assert [type(value) for value in plain.values()] == [bool, int, float, str]


def test_names_that_are_not_utf8_can_be_written(tmp_path: Path) -> None:
    name = os.fsdecode(b"caf\xe9.mp4")
    write_json(tmp_path / "a.json", jsonable({name: name}))
    assert read_json(tmp_path / "a.json") == {"caf?.mp4": "caf?.mp4"}


def test_nan_is_never_written_and_the_old_file_stays(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, {"n": 1})
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"n": math.nan})
    assert read_json(path) == {"n": 1}
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b'{"n": NaN}',
        b'{"n": -Infinity}',
        b"[1]",
        b"3",
        b"\xff\xfe{",
        b"[" * 100_000,
        b'{"n": 1} {}',
    ],
)
def test_damaged_json_is_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        read_json(path, "mend it")
    assert (caught.value.source, caught.value.remedy) == (path, "mend it")
    assert "\n" not in str(caught.value)


def test_hash_of_a_folder_sees_names_contents_and_nothing_else(tmp_path: Path) -> None:
    def folder(name: str, files: dict[str, bytes]) -> Path:
        for file, content in files.items():
            path = tmp_path / name / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        return tmp_path / name

    files = {"a": b"1", "b/c": b"2", "b.c": b"3"}
    reference = sha256_of(folder("reference", files))
    assert sha256_of(folder("again", dict(reversed(files.items())))) == reference
    changed = [
        {"a": b"1", "b/c": b"2", "b.c": b"4"},
        {"a": b"1", "b/d": b"2", "b.c": b"3"},
        {"a": b"1", "c": b"2", "b.c": b"3"},
        {"a": b"1", "b/c": b"2"},
        {**files, "d": b""},
        {"a": b"2", "b/c": b"1", "b.c": b"3"},
    ]
    hashes = [sha256_of(folder(f"changed{k}", other)) for k, other in enumerate(changed)]
    assert len({reference, *hashes}) == 1 + len(changed)


def test_the_stamp_of_a_file_tells_sizes_and_times_of_change(tmp_path: Path) -> None:
    for place in (tmp_path / "one" / "a", tmp_path / "one" / "b"):
        place.parent.mkdir(exist_ok=True)
        place.write_bytes(b"12")
        os.utime(place, ns=(0, 1_000_000_007))
    file, folder = tmp_path / "one" / "a", tmp_path / "one"
    before = file_stamp(file), file_stamp(folder)
    assert file_stamp(tmp_path / "one" / "b") == before[0]
    assert file_stamp(folder) == before[1]
    os.utime(file, ns=(0, 1_000_000_008))
    after = file_stamp(file), file_stamp(folder)
    os.utime(file, ns=(0, 1_000_000_007))
    assert (file_stamp(file), file_stamp(folder)) == before
    file.write_bytes(b"123")
    os.utime(file, ns=(0, 1_000_000_007))
    grown = file_stamp(file), file_stamp(folder)
    file.write_bytes(b"12")
    os.utime(file, ns=(0, 1_000_000_007))
    file.rename(tmp_path / "one" / "c")
    assert len({before[0], after[0], grown[0]}) == 3
    assert len({before[1], after[1], grown[1], file_stamp(folder)}) == 4
    with pytest.raises(DataError, match=os.strerror(errno.ENOENT)):
        file_stamp(file)
