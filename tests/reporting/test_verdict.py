from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from pipelines.reporting.content import SessionContent, items
from pipelines.reporting.summary import Verdict, give_verdict, summarise
from pipelines.reporting.wording import STATUS_REASONS, STATUS_REMEDIES, joint_label

from .conftest import STAGES, make_skeleton
from .reading import numbers, one


def _verdict(content: SessionContent) -> Verdict:
    return give_verdict(content, summarise(content))


def _all_lost_to(word: str, skeleton: pd.DataFrame) -> pd.DataFrame:
    lost = skeleton.assign(status=word)
    lost[["x", "y", "z", "reprojection_px"]] = np.nan
    return lost


def _sentences(verdict: Verdict) -> list[str]:
    return [sentence for _, sentence in verdict.doubts]


def test_the_verdict_of_the_metrics_is_shown(content: SessionContent) -> None:
    given = {
        "grade": "poor",
        "expected_error_mm": [50, 80.4, 120],
        "why": ["a", "b", "c", "d"],
        "next": "mocap x",
    }
    verdict = _verdict(replace(content, metrics={**(content.metrics or {}), "verdict": given}))
    assert (verdict.grade, verdict.why, verdict.next) == ("poor", ("a", "b", "c"), "mocap x")
    assert numbers(verdict.error) == [80, 50, 120, 22]  # and the one against truth
    assert numbers(verdict.lead) == [81.1, 10_200]


def test_without_a_verdict_the_error_is_that_from_truth_and_something_comes_next(
    content: SessionContent,
) -> None:
    verdict = _verdict(content)
    assert (verdict.grade, numbers(verdict.error)) == ("", [22])
    assert verdict.next.startswith("mocap export")
    assert _verdict(replace(content, skeleton=None, metrics=None)).next.startswith("mocap reconstruct")


def test_verdict_names_what_is_doubtful(content: SessionContent) -> None:
    verdict = _verdict(content)
    doubts = _sentences(verdict)
    assert numbers(one(doubts, STATUS_REASONS["few_views"], "(few_views)")) == [9.9]
    seldom = [joint_label(name) for name in ("left_wrist", "right_ear", "right_ankle")]
    assert numbers(one(doubts, *seldom)) == [45.0, 68.0, 75.0]
    assert numbers(one(doubts, "mast:")) == [30, 600]
    # The warnings of the stages, each once, before what was lost.
    warnings = [*content.session.warnings, *items(STAGES["reconstruct"], "warnings")]
    assert [kind for kind, sentence in verdict.doubts if sentence in warnings] == ["doubt", "doubt"]
    assert verdict.why == tuple(str(warning) for warning in warnings)


@pytest.mark.parametrize("word", ["rejected", "few_views", "no_pose", "low_parallax", "not_detected"])
def test_nothing_reconstructed_names_the_gate(content: SessionContent, word: str) -> None:
    lost = replace(content, skeleton=_all_lost_to(word, make_skeleton(50)), metrics={})
    lead = _verdict(lost).lead
    assert numbers(lead) == [850]
    assert all(part in lead for part in (STATUS_REASONS[word], STATUS_REMEDIES[word], f"({word})"))


def test_a_doubt_comes_before_everything_else(content: SessionContent) -> None:
    doubt = {"code": "mount", "cameras": ["mast"], "what": "W1", "evidence": {}, "remedy": "R1"}
    verdict = _verdict(replace(content, metrics={**(content.metrics or {}), "doubts": [doubt]}))
    kind, sentence = verdict.doubts[0]
    assert kind == "wrong"
    assert "W1" in sentence
    assert "R1" in sentence
    assert verdict.why[0] == sentence
