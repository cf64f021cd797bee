from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from pipelines.reporting.content import SessionContent, items
from pipelines.reporting.summary import summarise
from pipelines.reporting.verdict import Verdict, give_verdict
from pipelines.reporting.wording import STATUS_REASONS, STATUS_REMEDIES, joint_label

from .conftest import STAGES, make_skeleton
from .reading import numbers, one


def _verdict(content: SessionContent) -> Verdict:
    return give_verdict(content, summarise(content))


def _all_lost_to(word: str, skeleton: pd.DataFrame) -> pd.DataFrame:
    lost = skeleton.assign(status=word)
    lost[["x", "y", "z", "reprojection_px"]] = np.nan
    return lost


def test_verdict_with_truth(content: SessionContent) -> None:
    verdict = _verdict(content)
    assert numbers(verdict.lead) == [81.1, 10_200]
    absolute, shared, reprojection = verdict.quality
    assert numbers(absolute)[:2] == [22.4, 0.0]  # mm from truth, and relative to the hips
    assert "shift" in shared
    assert numbers(reprojection) == [4.4]
    assert [numbers(said) for said in verdict.certainty] == [[15.0], [100, 95]]


def test_verdict_names_what_is_doubtful(content: SessionContent) -> None:
    doubts = _verdict(content).doubts
    assert numbers(one(doubts, STATUS_REASONS["few_views"], "(few_views)")) == [9.9]
    seldom = [joint_label(name) for name in ("left_wrist", "right_ear", "right_ankle")]
    assert numbers(one(doubts, *seldom)) == [45.0, 68.0, 75.0]
    assert numbers(one(doubts, "mast:")) == [30, 600]
    # The warnings of the stages, each once.
    warnings = [*content.session.warnings, *items(STAGES["reconstruct"], "warnings")]
    assert [doubts.count(str(warning)) for warning in warnings] == [1, 1]


def test_verdict_without_truth_says_so_and_uses_the_bones(content: SessionContent) -> None:
    metrics: dict[str, object] = {
        "method": "robust",
        "mpjpe_mm": None,
        "reprojection_px": {"median": 4.41, "mean": 4.27},
    }
    verdict = _verdict(replace(content, truth=None, metrics=metrics))
    missing, reprojection, bones = verdict.quality
    assert "truth" in missing
    assert numbers(missing) == []
    assert numbers(reprojection) == [4.4]
    assert "Bone" in bones
    assert len(numbers(bones)) == 2  # the spread of the bones, and the largest
    assert [numbers(said) for said in verdict.certainty] == [[15.0]]  # nothing to check it by


def test_joints_far_from_truth_are_doubtful_however_few(content: SessionContent) -> None:
    assert content.skeleton is not None
    assert not [doubt for doubt in _verdict(content).doubts if "(ok)" in doubt]
    skeleton = content.skeleton.copy()
    at = np.unique(skeleton["t_ns"])[[60, 90]]
    rows = skeleton["t_ns"].isin(at) & (skeleton["joint"] == "left_knee") & (skeleton["status"] == "ok")
    assert rows.sum() == 2
    skeleton.loc[rows, "x"] += 0.5
    found = one(_verdict(replace(content, skeleton=skeleton)).doubts, "(ok)", joint_label("left_knee"))
    limit_mm, count, largest_mm, *times = numbers(found)
    assert (limit_mm, count, times) == (300, 2, [2, 2.0, 3.0])
    assert 500 <= largest_mm < 600


@pytest.mark.parametrize("word", ["rejected", "few_views", "no_pose", "low_parallax", "not_detected"])
def test_nothing_reconstructed_names_the_gate(content: SessionContent, word: str) -> None:
    lost = replace(content, skeleton=_all_lost_to(word, make_skeleton(50)), metrics={})
    lead = _verdict(lost).lead
    assert numbers(lead) == [850]
    assert all(part in lead for part in (STATUS_REASONS[word], STATUS_REMEDIES[word], f"({word})"))


def test_a_doubt_comes_before_everything_else(content: SessionContent) -> None:
    doubt = {"code": "mount", "cameras": ["mast"], "what": "W1", "evidence": {}, "remedy": "R1"}
    doubted = replace(content, metrics={**(content.metrics or {}), "doubts": [doubt]})
    verdict, right = give_verdict(doubted, summarise(doubted)), give_verdict(content, summarise(content))
    assert verdict.lead.index("W1") < verdict.lead.index("81.1")
    assert right.lead.split()[0] not in verdict.lead
    assert "R1" in verdict.doubts[0]
