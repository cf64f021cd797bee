"""Tables read in parts: the same as read as a whole, however their rows lie in the file."""

import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.geometry.triangulation import STATUS
from pipelines.session.errors import DataError
from pipelines.session.records import POINT_COVARIANCE_COLUMNS
from pipelines.session.tables import (
    SKELETON,
    TRUTH,
    join_tables,
    motion_from,
    read_motion,
    read_table,
    write_table,
)

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


def test_a_table_without_a_column_of_the_motion_is_refused(tmp_path: Path) -> None:
    write_table(tmp_path / "truth.parquet", skeleton(1, 4, 1), TRUTH)
    with pytest.raises(DataError) as caught:
        read_motion(tmp_path / "truth.parquet", SKELETON)
    assert caught.value.source == tmp_path / "truth.parquet"
    assert read_motion(tmp_path / "truth.parquet", TRUTH).covariance is None
