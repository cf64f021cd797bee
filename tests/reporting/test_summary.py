from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.reporting.content import SessionContent
from pipelines.reporting.summary import errors_per_camera, measures, summarise
from pipelines.reporting.wording import THIN

from .conftest import FRAMES, JOINTS, OFFSET_M, statuses


def test_counts_are_those_of_the_table(content: SessionContent) -> None:
    summary = summarise(content)
    words, counts = np.unique(statuses(FRAMES), return_counts=True)
    assert summary.counts == dict(zip(words, counts, strict=True))
    assert summary.total == FRAMES * len(JOINTS)
    assert summary.share == pytest.approx(np.mean(statuses(FRAMES) == "ok"))


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


def test_a_joint_without_metrics_is_measured_here(content: SessionContent) -> None:
    summary = summarise(replace(content, metrics={}, joint_errors=None))
    assert summary.joints[0].mpjpe_mm == pytest.approx(1000 * np.linalg.norm(OFFSET_M))
    assert summary.joints[0].root_mpjpe_mm is None
    assert 3 <= (summary.joints[0].reprojection_px or 0) <= 5


def test_cameras_count_from_the_first_frame_of_all(content: SessionContent) -> None:
    summary = summarise(content)
    drone2 = summary.cameras[1]
    assert (drone2.first_s, drone2.last_s) == pytest.approx((0.0, 599 / 30))
    (gap,) = drone2.gaps_s
    assert gap == pytest.approx((12.0, 13.2))
    assert summary.duration_s == pytest.approx(599 / 30)


def test_rigid_bones_have_no_spread(content: SessionContent) -> None:
    bones = {(bone.name, bone.side): bone for bone in summarise(content).bones}
    # Shoulders and hips of the walk move together: 2 x 0.19 m and 2 x 0.13 m apart.
    assert bones["shoulders", ""].median_m == pytest.approx(0.38)
    assert bones["shoulders", ""].spread == pytest.approx(0, abs=1e-9)
    assert bones["hips", ""].median_m == pytest.approx(0.26)
    assert bones["thigh", "left"].spread > 0.01  # the walk's legs swing without bending: they stretch


def test_measures_state_every_overall_number(content: SessionContent) -> None:
    metrics = (content.metrics or {}) | {
        "shape": {"bone_spread_mm": 12.34, "jerk_m_s3": 567.0},
        "new_measure": 3.14159,
        "reprojection_px_per_camera": {"drone1": {"median": 2.0, "mean": 3.0}},
        "leave_one_camera_out_px": {"drone1": {"median": 9.0, "mean": 10.0}},
    }
    summary = summarise(replace(content, metrics=metrics))
    shown = {row.label: row.value.replace(THIN, " ") for row in measures(summary)}
    assert shown["MPJPE"] == "22.4 mm"
    assert shown["Jerk"] == "567 m/s³"
    assert shown["new_measure"] == "3.14"
    named = list(shown.items())
    for word, value in (("PCK at", "84.0 %"), ("Bone", "12.3 mm"), ("Reprojection", "4.41 px")):
        assert next(text for label, text in named if label.startswith(word)) == value, word
    (row,) = errors_per_camera(summary)
    assert (row.name, row.median_px, row.mean_px, row.left_out_median_px) == ("drone1", 2.0, 3.0, 9.0)
