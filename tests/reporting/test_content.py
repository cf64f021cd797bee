"""Content of a page: poses and clocks as reconstructed, film strips, errors, verdicts and words."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from pipelines.geometry.triangulation import STATUS
from pipelines.reporting.content import (
    SessionContent,
    as_reconstructed,
    errors_mm,
    items,
    motion_from_skeleton,
    share_inside_95,
)
from pipelines.reporting.overlays import collect_moments
from pipelines.reporting.pictures import make_strips
from pipelines.reporting.summary import Verdict, give_verdict, summarise, truth_at
from pipelines.reporting.viewer import make_scene
from pipelines.reporting.wording import STATUS_REASONS, STATUS_REMEDIES, cell_text, joint_label

from .conftest import ASIDE_PX, CAMERAS, FRAMES, JOINTS, OFFSET_M, STAGES, make_skeleton, make_truth, statuses
from .reading import numbers, one

TURN_RAD = 0.01
"""Error of the logged pose of drone1: 14 px at a focal length of 1400 px."""
OFFSET_S = 0.2


def _misplaced(content: SessionContent) -> SessionContent:
    """Turn the logged drone1 about its own x axis; the refined poses are right."""
    from scipy.spatial.transform import Rotation

    logged = content.poses["drone1"].copy()
    turn = Rotation.from_rotvec([TURN_RAD, 0, 0])
    columns = ["qx", "qy", "qz", "qw"]
    logged[columns] = (Rotation.from_quat(logged[columns].to_numpy()) * turn).as_quat()
    poses = content.poses | {"drone1": logged}
    return replace(content, poses=poses, refined={"drone1": content.poses["drone1"]})


def _residual_px(content: SessionContent, camera: str) -> float:
    medians = [
        view.median_px
        for moment in collect_moments(content, summarise(content), None)
        for view in moment.views
        if view.camera == camera and view.median_px is not None
    ]
    return float(np.median(medians))


def test_residuals_are_those_of_refined_poses(content: SessionContent) -> None:
    misplaced, aside = _misplaced(content), float(np.linalg.norm(ASIDE_PX))
    assert _residual_px(misplaced, "drone1") > aside + 4  # 14 px across or along 5 px leave 9 px at least
    assert _residual_px(as_reconstructed(misplaced), "drone1") == pytest.approx(aside, abs=0.05)
    assert _residual_px(as_reconstructed(misplaced), "drone2") == _residual_px(misplaced, "drone2")


def test_frames_come_by_the_clocks_that_were_estimated(content: SessionContent) -> None:
    early = content.frames["drone1"].assign(t_ns=content.frames["drone1"]["t_ns"] - round(OFFSET_S * 1e9))
    metrics = {**(content.metrics or {}), "clock_offsets_s": {"drone1": OFFSET_S, "drone2": None}}
    late = replace(content, frames=content.frames | {"drone1": early}, metrics=metrics)
    mended = as_reconstructed(late)
    for name in CAMERAS:
        assert mended.frames[name]["t_ns"].tolist() == content.frames[name]["t_ns"].tolist()


def test_pictures_keep_to_their_budget_and_show_the_person(content: SessionContent) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (1080, 1920, 3), dtype=np.uint8)  # nothing is larger
    summary = summarise(content)
    strips = make_strips(as_reconstructed(content), summary, lambda _camera, _frame: noise, "small")
    assert [strip.camera for strip in strips] == list(content.keypoints)
    assert sum(len(picture) for strip in strips for picture in strip.pictures) <= 3_000_000
    for strip in strips:
        assert len(strip.pictures) == len(strip.t_ns) == len(strip.joints) > 1
        assert (np.diff(strip.t_ns) > 0).all()
        known = strip.joints[np.isfinite(strip.joints)]
        assert np.percentile(known, 5) > 0
        assert np.percentile(known, 95) < 1
        motion, row = summary.motion, len(strip.t_ns) // 2
        assert motion is not None
        joints = motion.measured_position[np.abs(motion.t_ns - strip.t_ns[row]).argmin(), 0]
        seen = np.column_stack([joints, np.ones(len(joints))]) @ strip.projection[row].T
        away = seen[:, :2] / seen[:, 2:] - strip.joints[row, 0, : len(joints)]
        assert np.nanmedian(np.abs(away)) < 0.03
    scene = make_scene(summary, content.poses, strips=strips)
    assert scene is not None
    apart_s = max(float(np.median(np.diff(strip.t_ns))) / 1e9 for strip in strips)
    assert apart_s > 0.2  # which the page says
    assert numbers(scene.notes[-1]) == [pytest.approx(apart_s, abs=0.05)]


def test_error_is_the_offset_wherever_the_joint_was_measured() -> None:
    motion = motion_from_skeleton(make_skeleton())
    error = errors_mm(motion, truth_at(make_truth(), motion))
    measured = statuses(FRAMES) == "ok"
    assert np.array_equal(np.isfinite(error[:, 0]), measured)
    # sqrt(20^2 + 10^2) mm, to the rounding of metres at a distance of some metres.
    np.testing.assert_allclose(error[:, 0][measured], 1000 * np.linalg.norm(OFFSET_M), atol=1e-9)


def test_truth_is_interpolated_but_not_beside_a_hole_nor_outside() -> None:
    motion = motion_from_skeleton(make_skeleton(20))
    truth = make_truth(20)
    # Every second stamp: those between are the mean of their neighbours, a straight line in time.
    stamps = motion.t_ns
    coarse = truth[truth["t_ns"].isin(stamps[::2])]
    between = truth_at(coarse, motion)
    dense = truth_at(truth, motion)
    np.testing.assert_allclose(between[1], (dense[0] + dense[2]) / 2, atol=1e-9)
    assert np.isnan(between[-1]).all()  # after the last stamp
    # Without the stamp 6 the hole is two usual steps of two.
    holed = coarse[coarse["t_ns"] != stamps[6]]
    assert np.flatnonzero(np.isnan(truth_at(holed, motion)).all(axis=(1, 2, 3))).tolist() == [5, 6, 7, 19]
    # A joint that is missing at one stamp is missing on both sides of it.
    nose = coarse[~((coarse["joint"] == "nose") & (coarse["t_ns"] == stamps[6]))]
    result = truth_at(nose, motion)[:, 0, JOINTS.index("nose"), 0]
    assert np.array_equal(np.isnan(result), np.isin(np.arange(20), [5, 6, 7, 19]))


def test_a_calibrated_covariance_holds_95_percent_of_the_truth() -> None:
    motion = motion_from_skeleton(make_skeleton(400))
    rng = np.random.default_rng(7)
    factor = np.array([[0.03, 0.0, 0.0], [0.01, 0.02, 0.0], [-0.02, 0.005, 0.05]])
    covariance = (factor @ factor.T)[np.triu_indices(3)]
    motion = replace(
        motion,
        status=np.full(motion.status.shape, STATUS.index("ok"), dtype=np.int8),
        position=np.zeros(motion.position.shape),
        covariance=np.broadcast_to(covariance, motion.covariance.shape),
    )
    truth = rng.standard_normal(motion.position.shape) @ factor.T
    share = share_inside_95(motion, truth)
    # 6 800 draws: the standard deviation of the share is sqrt(.95 * .05 / 6800) = 0.0026; 4 of them.
    assert share == pytest.approx(0.95, abs=0.011)


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
    assert numbers(verdict.lead) == [81.1]


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


@pytest.mark.parametrize("start", "=+-@\t\r\n＝＋－＠")
def test_texts_of_cells_are_no_formulas(start: str) -> None:
    assert cell_text(f"{start}1") == f"'{start}1"
    assert cell_text(f"a{start}1") == f"a{start}1"
    assert cell_text(f"a;{start}1") == f"a;'{start}1"
    assert cell_text(-1.5) == -1.5
    assert cell_text(None) is None
