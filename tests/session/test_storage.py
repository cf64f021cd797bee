"""Storage: reproducible JSON, hashes, codes of errors, arrays that wait in files, tables read in parts."""

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.arrays import Float
from pipelines.geometry.triangulation import STATUS
from pipelines.session.errors import DataError
from pipelines.session.parallel import Waiting
from pipelines.session.records import POINT_COVARIANCE_COLUMNS
from pipelines.session.storage import jsonable, read_json, sha256_of, write_json
from pipelines.session.tables import SKELETON, join_tables, motion_from, read_motion, read_table

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


@dataclass(frozen=True)
class Held:
    name: str
    values: dict[str, Float]
    nothing: None = None


def test_waiting_arrays_keep_their_values_and_changes(tmp_path: Path) -> None:
    waiting = Waiting(tmp_path)
    values = {"a": np.arange(12.0).reshape(3, 4), "b": np.empty((0, 2)), "c": np.full(3, np.nan)}
    held = waiting.put(Held("drone1", values))
    assert held.name == "drone1"
    held.values["a"][1, 2] = -1.0
    waiting.release()
    expected = values["a"].copy()
    expected[1, 2] = -1.0
    np.testing.assert_array_equal(held.values["a"], expected)
    np.testing.assert_array_equal(held.values["c"], values["c"])
    assert held.values["b"].shape == (0, 2)
    assert values["a"][1, 2] == 6.0  # a copy
    assert all(array.ctypes.data % 64 == 0 and array.flags.writeable for array in held.values.values())
    assert list(tmp_path.iterdir()) == []


JOINTS = ("nose", "left_hip", "right_hip")


def skeleton(seed: int, times: int, people: int) -> pd.DataFrame:
    """Return rows of a skeleton in any order, a third of them left out."""
    rng = np.random.default_rng(seed)
    t, person, joint = (axis.ravel() for axis in np.indices((times, people, len(JOINTS))))
    kept = rng.permutation(len(t))[: max(2 * len(t) // 3, 1)]
    numbers = rng.normal(size=(len(kept), 10))
    numbers[rng.random(numbers.shape) < 0.2] = np.nan
    columns = ("x", "y", "z", *POINT_COVARIANCE_COLUMNS, "reprojection_px")
    return pd.DataFrame(
        {
            "t_ns": 1_000_000_000 + 33_000_000 * t[kept],
            "person": person[kept],
            "joint": np.array(JOINTS, dtype=object)[joint[kept]],
            **dict(zip(columns, numbers.T, strict=True)),
            "views": rng.integers(0, 4, len(kept)),
            "status": np.array(STATUS, dtype=object)[rng.integers(0, len(STATUS), len(kept))],
        }
    )


@given(
    seed=st.integers(0, 2**32 - 1),
    times=st.integers(1, 30),
    people=st.integers(1, 3),
    parts=st.integers(1, 5),
    joints=st.none() | st.permutations(JOINTS).map(lambda names: tuple(names[:2])),
)
def test_a_motion_read_in_parts_is_that_of_the_whole_table(
    seed: int, times: int, people: int, parts: int, joints: tuple[str, ...] | None
) -> None:
    table = skeleton(seed, times, people)
    rows = np.array_split(np.arange(len(table)), parts)
    with tempfile.TemporaryDirectory() as place:
        path = Path(place, "skeleton.parquet")
        join_tables(path, (table.iloc[some] for some in rows), SKELETON)
        whole = read_table(path, SKELETON)
        expected = motion_from(whole, joints or tuple(dict.fromkeys(whole["joint"])))
        found = read_motion(path, SKELETON, joints)
    assert found.joints == expected.joints
    for name in ("t_ns", "position", "status", "views", "reprojection_px", "covariance"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
