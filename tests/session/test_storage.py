"""Storage: JSON is reproducible, hashes detect every change, errors are one line."""

import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.session.errors import DataError
from pipelines.session.storage import (
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
