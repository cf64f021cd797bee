from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from pipelines.reporting.content import SessionContent
from pipelines.reporting.summary import errors_per_camera, give_verdict, measures, summarise
from pipelines.reporting.wording import THIN

from .conftest import FRAMES, JOINTS, OFFSET_M, described, make_session, make_skeleton, statuses


def _said(content: SessionContent) -> str:
    verdict = give_verdict(content, summarise(content))
    said = " ".join([verdict.lead, *verdict.quality, *verdict.certainty, *verdict.doubts])
    return said.replace(THIN, " ")


def _all_lost_to(word: str, skeleton: pd.DataFrame) -> pd.DataFrame:
    lost = skeleton.assign(status=word)
    lost[["x", "y", "z", "reprojection_px"]] = np.nan
    return lost


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
    summary = summarise(replace(content, metrics={}))
    assert summary.joints[0].mpjpe_mm == pytest.approx(1000 * np.linalg.norm(OFFSET_M))
    assert summary.joints[0].root_mpjpe_mm is None
    assert 3 <= (summary.joints[0].reprojection_px or 0) <= 5


def test_cameras_count_from_the_first_frame_of_all(content: SessionContent) -> None:
    summary = summarise(content)
    drone2 = summary.cameras[1]
    assert (drone2.first_s, drone2.last_s) == pytest.approx((0.0, 599 / 30))
    (gap,) = drone2.gaps_s
    assert gap == pytest.approx((12.0, 13.2))
    assert drone2.gap_total_s == pytest.approx(1.2)
    assert summary.duration_s == pytest.approx(599 / 30)


def test_rigid_bones_have_no_spread(content: SessionContent) -> None:
    bones = {(bone.name, bone.side): bone for bone in summarise(content).bones}
    # Shoulders and hips of the walk move together: 2 x 0.19 m and 2 x 0.13 m apart.
    assert bones["shoulders", ""].median_m == pytest.approx(0.38)
    assert bones["shoulders", ""].spread == pytest.approx(0, abs=1e-9)
    assert bones["hips", ""].median_m == pytest.approx(0.26)
    assert bones["thigh", "left"].spread > 0.01  # the walk's legs swing without bending: they stretch


def test_verdict_with_truth(content: SessionContent) -> None:
    said = _said(content)
    assert "Most of the motion was reconstructed: 81.1 % of 10 200 joint-frames." in said
    assert "off by 22.4 mm on average; by 0.0 mm relative to the hips" in said
    assert "shift common to all joints" in said
    assert "uncertainty of a joint is 15.0 mm per axis" in said
    assert "100 % of the true positions lie inside the stated 95 % ellipsoids" in said


def test_verdict_names_what_is_doubtful(content: SessionContent) -> None:
    said = _said(content)
    assert "9.9 % of the joint-frames: fewer than two cameras saw the joint" in said
    assert "Seldom measured: left wrist (45.0 %), right ear (68.0 %) and right ankle (75.0 %)." in said
    assert "mast: no person was detected in 30 of 600 frames." in said
    assert said.count("drone2: calibrated for 3840 x 2160") == 1
    assert "no pose noise is stated" in said


def test_verdict_without_truth_says_so_and_uses_the_bones(content: SessionContent) -> None:
    metrics: dict[str, object] = {
        "method": "robust",
        "mpjpe_mm": None,
        "reprojection_px": {"median": 4.41, "mean": 4.27},
    }
    said = _said(replace(content, truth=None, metrics=metrics))
    assert "no truth to compare with" in said
    assert "4.4 px from the keypoints" in said
    assert "Bone lengths, which should not change, vary by" in said
    assert "true positions" not in said


def test_optimistic_covariance_is_called_so(content: SessionContent) -> None:
    assert content.skeleton is not None
    narrow = content.skeleton.assign(cxx=1e-6, cyy=1e-6, czz=1e-6)
    said = _said(replace(content, skeleton=narrow))
    assert "0 % of the true positions" in said
    assert "too small: do not rely on it" in said


@pytest.mark.parametrize(
    ("word", "reason", "remedy"),
    [
        ("rejected", "views disagreed by more than", "state a larger pose noise"),
        ("few_views", "fewer than two cameras saw", "overlap in time"),
        ("no_pose", "cameras had no pose", "pose logs cover the time"),
        ("low_parallax", "nearly the same line", "more different directions"),
        ("not_detected", "detector found the joint in no camera", "belong to these videos"),
    ],
)
def test_nothing_reconstructed_names_the_gate(
    content: SessionContent, word: str, reason: str, remedy: str
) -> None:
    lost = replace(content, skeleton=_all_lost_to(word, make_skeleton(50)), metrics={})
    lead = give_verdict(lost, summarise(lost)).lead
    assert lead.startswith("Nothing was reconstructed")
    assert all(part in lead for part in (reason, remedy, f"({word})"))


def test_the_most_frequent_gate_is_named(content: SessionContent) -> None:
    skeleton = _all_lost_to("rejected", make_skeleton(50))
    skeleton.loc[skeleton.index[:340], "status"] = "no_pose"  # 340 of 850
    lead = give_verdict(
        lost := replace(content, skeleton=skeleton, metrics={}), summarise(lost)
    ).lead.replace(THIN, " ")
    assert "In 60.0 % of them the views disagreed" in lead


def test_not_reconstructed_yet(content: SessionContent) -> None:
    ingested = replace(content, skeleton=None, metrics=None, truth=None)
    assert "not reconstructed yet" in give_verdict(ingested, summarise(ingested)).lead


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
    assert shown["PCK at 150 mm"] == "84.0 %"
    assert shown["Bone length spread"] == "12.3 mm"
    assert shown["Jerk"] == "567 m/s³"
    assert shown["Reprojection, median"] == "4.41 px"
    assert shown["new_measure"] == "3.14"
    (row,) = errors_per_camera(summary)
    assert (row.name, row.median_px, row.mean_px, row.left_out_median_px) == ("drone1", 2.0, 3.0, 9.0)


def test_a_camera_that_disagrees_with_the_others_is_doubtful(content: SessionContent) -> None:
    medians = {"drone1": 5.0, "drone2": 6.0, "mast": 20.0}
    metrics = (content.metrics or {}) | {
        "reprojection_px_per_camera": {name: {"median": m, "mean": m} for name, m in medians.items()}
    }
    said = _said(replace(content, metrics=metrics))
    assert "mast: its keypoints lie 20.0 px from the joints, those of the usual camera 6.0 px" in said
    assert said.count("its keypoints lie") == 1


def test_no_warnings_no_doubts(content: SessionContent) -> None:
    session = make_session() | {"warnings": []}
    cameras = session["cameras"]
    assert isinstance(cameras, dict)
    session["cameras"] = {"drone1": cameras["drone1"]}
    skeleton = make_skeleton(20)
    complete = skeleton.assign(status="ok", x=1.0, y=2.0, z=0.5)
    quiet = replace(content, session=described(session), skeleton=complete, stages={})
    verdict = give_verdict(quiet, summarise(quiet))
    assert verdict.lead.startswith("All of the motion was reconstructed: 100")
    assert verdict.doubts == ()
