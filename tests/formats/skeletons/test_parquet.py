"""The parquet export, read by pandas alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pipelines.formats.skeletons import joint_files
from pipelines.session.registries import Export
from tests.formats.exported import flown, recording

WRITER: Export = joint_files.PARQUET_EXPORT


def test_tables_by_name_time_and_joint(tmp_path: Path) -> None:
    walked = recording()
    motion = walked.motion
    assert motion is not None
    skeleton, camera = WRITER.write(walked, tmp_path)
    assert (skeleton.name, camera.name) == ("Mound_walk.parquet", "Mound_walk_cam-1.parquet")
    table = pd.read_parquet(skeleton)
    assert len(table) == 60 * 17
    wide = table.pivot_table(index="t_ns", columns="joint", values="z", dropna=False)[list(motion.joints)]
    np.testing.assert_array_equal(wide.to_numpy(), motion.position[:, 0, :, 2])
    assert table.loc[table["joint"] == "left_wrist", "x"].isna().sum() == 1
    assert set(table["status"]) == {"ok"}
    assert table["cyy"].iloc[0] == pytest.approx(0.02**2)
    np.testing.assert_array_equal(pd.read_parquet(camera)["x"], flown().position[:, 0])
