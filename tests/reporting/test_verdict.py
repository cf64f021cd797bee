from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from pipelines.reporting.content import SessionContent
from pipelines.reporting.summary import summarise
from pipelines.reporting.verdict import give_verdict
from pipelines.reporting.wording import THIN

from .conftest import described, make_session, make_skeleton


def _said(content: SessionContent) -> str:
    verdict = give_verdict(content, summarise(content))
    said = " ".join([verdict.lead, *verdict.quality, *verdict.certainty, *verdict.doubts])
    return said.replace(THIN, " ")


def _all_lost_to(word: str, skeleton: pd.DataFrame) -> pd.DataFrame:
    lost = skeleton.assign(status=word)
    lost[["x", "y", "z", "reprojection_px"]] = np.nan
    return lost


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


def test_joints_far_from_truth_are_doubtful_however_few(content: SessionContent) -> None:
    assert content.skeleton is not None
    assert "called measured (ok), up to" not in _said(content)
    skeleton = content.skeleton.copy()
    at = np.unique(skeleton["t_ns"])[[60, 90]]
    rows = skeleton["t_ns"].isin(at) & (skeleton["joint"] == "left_knee") & (skeleton["status"] == "ok")
    assert rows.sum() == 2
    skeleton.loc[rows, "x"] += 0.5
    said = _said(replace(content, skeleton=skeleton))
    assert "Errors of more than 300 mm in 2 joint-frames called measured (ok), up to 5" in said
    assert "at 2 times from 2.00 s to 3.00 s; most often of the left knee." in said


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
    quiet = replace(content, session=described(session), skeleton=complete, truth=None, stages={})
    verdict = give_verdict(quiet, summarise(quiet))
    assert verdict.lead.startswith("All of the motion was reconstructed: 100")
    assert verdict.doubts == ()
