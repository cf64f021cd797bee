from dataclasses import replace

import numpy as np
import pytest

from pipelines.reporting.content import SessionContent
from pipelines.reporting.summary import summarise, tables_of_errors
from pipelines.reporting.wording import THIN

from .conftest import FRAMES, JOINTS, OFFSET_M


def test_joint_rows_add_up(content: SessionContent) -> None:
    rows = {row.name: row for row in summarise(content).joints}
    assert tuple(rows) == JOINTS
    assert all(sum(row.counts.values()) == FRAMES for row in rows.values())
    # Of 600 times: the first 300 rejected, of which 180 to 240 were few_views, the last 30 without pose.
    wrist = rows["left_wrist"]
    assert wrist.counts["rejected"] == 240
    assert wrist.counts["few_views"] == 60
    assert wrist.counts["no_pose"] == 30
    assert wrist.share == pytest.approx(270 / 600)
    assert wrist.sigma_mm == pytest.approx(15.0)
    assert wrist.mpjpe_mm == pytest.approx(1000 * np.linalg.norm(OFFSET_M))


def test_measures_state_every_overall_number(content: SessionContent) -> None:
    metrics = (content.metrics or {}) | {
        "shape": {"bone_spread_mm": 12.34, "jerk_m_s3": 567.0},
        "reprojection_px_per_camera": {"drone1": {"median": 2.0, "mean": 3.0}},
        "leave_one_camera_out_px": {"drone1": {"median": 9.0, "mean": 10.0}},
    }
    summary = summarise(replace(content, metrics=metrics))
    measures, cameras = tables_of_errors(summary)
    shown = {str(row[0]): str(row[1]).replace(THIN, " ") for row in measures.rows}
    assert shown["MPJPE"] == "22.4 mm"
    assert shown["Jerk"] == "567 m/s³"
    named = list(shown.items())
    for word, value in (("PCK at", "84.0 %"), ("Bone", "12.3 mm"), ("Reprojection", "4.41 px")):
        assert next(text for label, text in named if label.startswith(word)) == value, word
    assert cameras.rows == [["drone1", "2.00", "3.00", "9.00"]]
