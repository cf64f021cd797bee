"""Tables of numbers that no stage writes are refused when they are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pipelines.session import tables
from pipelines.session.errors import DataError
from pipelines.session.tables import KEYPOINTS, POSES, read_table, write_table


def poses(rows: int = 3) -> pd.DataFrame:
    numbers = {name: np.zeros(rows) for name in POSES.names}
    return pd.DataFrame(numbers | {"t_ns": np.arange(rows), "qw": np.ones(rows)})


@pytest.mark.parametrize(
    ("column", "value"), [("x", 1e308), ("z", -1e16), ("qw", np.inf), ("t_ns", 2**62), ("t_ns", 0)]
)
def test_a_pose_that_no_flight_has_is_refused(tmp_path: Path, column: str, value: float) -> None:
    table = poses()
    table.loc[2, column] = value
    write_table(tmp_path / "poses.parquet", table, POSES)
    with pytest.raises(DataError):
        read_table(tmp_path / "poses.parquet", POSES)


def test_missing_numbers_and_large_ones_are_read(tmp_path: Path) -> None:
    table = poses()
    table.loc[1, "x"], table.loc[2, "y"] = np.nan, 1e14
    write_table(tmp_path / "poses.parquet", table, POSES)
    pd.testing.assert_frame_equal(read_table(tmp_path / "poses.parquet", POSES), table)


def test_a_table_far_larger_than_its_file_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "MAX_BYTES_OF_ANY_TABLE", 1 << 20)
    rows = 50_000  # of 7 columns of 8 bytes: 2.8 MB in some kilobytes
    numbers = {name: np.zeros(rows) for name in KEYPOINTS.names} | {"joint": np.full(rows, "nose")}
    write_table(tmp_path / "keypoints.parquet", pd.DataFrame(numbers), KEYPOINTS)
    with pytest.raises(DataError):
        read_table(tmp_path / "keypoints.parquet", KEYPOINTS)
