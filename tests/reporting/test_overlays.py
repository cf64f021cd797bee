"""Overlays of pictures: residuals, the worst moment, status and spread of joints between pictures."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipelines.geometry.arrays import Intrinsics
from pipelines.geometry.cameras import project
from pipelines.geometry.triangulation import STATUS
from pipelines.reporting.content import SessionContent, motion_from_skeleton
from pipelines.reporting.overlays import (
    MOMENTS,
    OverlayView,
    angles_at,
    choose_moments,
    collect_moments,
    match_people,
    seen_spread,
    status_at,
)
from pipelines.reporting.summary import summarise

from .conftest import ASIDE_PX, CAMERAS, JOINTS, START_NS, make_skeleton, true_pixels


def _views(content: SessionContent, camera: str) -> list[OverlayView]:
    moments = collect_moments(content, summarise(content), None)
    return [view for moment in moments for view in moment.views if view.camera == camera]


def _with_error(at: int, joints: list[str], px: float) -> pd.DataFrame:
    """Return the skeleton with some joints this far from their keypoints at one time."""
    table = make_skeleton()
    rows = (table["t_ns"] == START_NS + round(at / 30 * 1e9)) & table["joint"].isin(joints)
    table.loc[rows & (table["status"] == "ok"), "reprojection_px"] = px
    return table


@pytest.mark.parametrize("camera", CAMERAS)
def test_residuals_are_the_distance_that_the_keypoints_were_put_aside(
    content: SessionContent, camera: str
) -> None:
    views = [view for view in _views(content, camera) if view.has_pose]
    assert len(views) == MOMENTS - (camera == "drone2")  # one lies in its gap
    for view in views:
        # Poses 20 ms apart, linear between them: errors below 0.1 mm and 0.1 mrad, that is 0.15 px.
        assert view.residual_px[np.isfinite(view.residual_px)] == pytest.approx(5.0, abs=0.15)
        expected = true_pixels(CAMERAS.index(camera), np.array([view.t_s]))[0]
        seen = np.isfinite(view.reprojected[0, : len(JOINTS), 0])
        assert seen.sum() >= 15
        assert view.reprojected[0, : len(JOINTS)][seen] == pytest.approx(expected[seen], abs=0.15)
        assert view.found[0][seen] == pytest.approx(expected[seen] + ASIDE_PX, abs=0.15)


def test_the_worst_moment_is_that_of_the_largest_error_where_truth_is_known() -> None:
    """The views agree worst at 433 and well at 100, where a leg lies 600 mm from truth."""
    motion = motion_from_skeleton(_with_error(433, list(JOINTS), 80.0))
    error_mm = np.where(motion.measured, 20.0, np.nan)
    row, person, joint = np.argwhere(motion.measured[100:101])[0] + (100, 0, 0)
    error_mm[row, person, joint] = 600.0
    chosen, worst = choose_moments(motion, error_mm)
    assert worst == 100
    assert 100 in chosen
    assert choose_moments(motion, np.full_like(error_mm, np.nan))[1] == 433


BODY = np.array([[100.0, 100.0], [140.0, 100.0], [100.0, 300.0], [140.0, 300.0]])


@given(st.permutations(range(4)), st.floats(-9.0, 9.0))
def test_people_are_found_in_any_order_and_each_once(order: list[int], jitter: float) -> None:
    people = BODY + 60.0 * np.arange(4)[:, None, None]
    matches = match_people(people, people[order] + jitter)
    assert matches == [order.index(person) for person in range(4)]


def test_status_holds_where_the_skeleton_is_interpolated_and_nowhere_else() -> None:
    table = make_skeleton(30).assign(status="ok", x=1.0, y=0.0, z=0.0)
    stamps = np.unique(table["t_ns"])
    late = table["t_ns"] >= stamps[10]
    table.loc[late, "status"] = "rejected"
    table = table[~table["t_ns"].isin(stamps[20:25])]  # a gap of five
    motion = motion_from_skeleton(table)
    step = int(stamps[1] - stamps[0])
    at = np.array(
        [
            stamps[0] - 1,
            stamps[0],
            stamps[9] + step // 3,
            stamps[9] + 2 * step // 3,
            stamps[19] + 1,
            stamps[25],
            stamps[29] + 1,
        ]
    )
    ok, rejected = STATUS.index("ok"), STATUS.index("rejected")
    assert status_at(motion, at)[:, 0, 0].tolist() == [-1, ok, ok, rejected, -1, rejected, -1]
    lone = motion_from_skeleton(make_skeleton(1).assign(status="ok"))
    assert status_at(lone, at[:2])[:, 0, 0].tolist() == [-1, ok]


def test_spread_is_what_samples_of_a_joint_show() -> None:
    rng = np.random.default_rng(5)
    lens = Intrinsics(1280, 720, 762.0, 763.0, 641.0, 358.0, "radtan", (-0.031, 0.012, 0.0004, -0.0003))
    turn = Rotation.from_euler("xyz", [-100.0, 10.0, 30.0], degrees=True).as_matrix()
    half = rng.normal(size=(3, 3)) * 0.02
    covariance = half @ half.T
    joint = np.array([1.5, -1.0, 9.0])  # in the camera
    upper = covariance[*np.triu_indices(3)]
    spread = seen_spread(joint, upper, turn, lens)
    samples = rng.multivariate_normal(np.zeros(3), covariance, 40_000)
    pixels = project(joint + samples @ turn, lens)
    # Of 40,000 samples a variance is known to 0.7 %; four of these, and the lens bends by less.
    largest = float(np.linalg.norm(spread))
    np.testing.assert_allclose(spread, np.cov(pixels.T), rtol=0, atol=0.03 * largest)
    assert np.isnan(seen_spread(joint, np.full(6, np.nan), turn, lens)).all()


def test_angles_are_interpolated_the_short_way_round_and_never_across_a_gap() -> None:
    skeleton = make_skeleton(frames=5)
    motion = motion_from_skeleton(skeleton)
    values, sigmas = [170.0, -170.0, 20.0, np.nan, 30.0], [1.0, 3.0, 3.0, np.nan, 2.0]
    angles = pd.DataFrame(
        {"t_ns": motion.t_ns, "person": 0, "angle": "left_knee_flexion", "value_deg": values}
    ).assign(sigma_deg=sigmas, status="ok")
    at = motion.t_ns[[0, 0, 2, 2, 4]] + np.array([0, 16_666_667, 0, 16_666_667, 0])
    found = angles_at(motion, angles, "left_knee_flexion", at)[:, 0]
    assert np.abs(found[:, 0]) == pytest.approx([170.0, 180.0, 20.0, np.nan, 30.0], abs=1e-4, nan_ok=True)
    assert found[:, 1] == pytest.approx([1.0, 2.0, 3.0, np.nan, 2.0], abs=1e-4, nan_ok=True)
