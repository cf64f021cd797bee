"""Segments of a long flight: their division, the seam between two of them, and figures of all of them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from pipelines.geometry.arrays import Float, Int64
from pipelines.reconstruction import segments
from pipelines.reconstruction.clocks import agreed_clocks
from pipelines.reconstruction.segments import (
    Segment,
    divided,
    doubts_of_flight,
    joined,
    mean_angles,
    mean_poses,
    mean_skeleton,
    merged,
    nothing_seen,
    numbered,
    places,
    rows_of_people,
    same_people,
    warnings_of_flight,
)
from pipelines.session.records import POINT_COVARIANCE_COLUMNS
from pipelines.session.tables import ANGLES, SKELETON

SECOND = 1_000_000_000
STEP = SECOND // 30


def times(seconds: float) -> Int64:
    return 1_700_000_000 * SECOND + STEP * np.arange(round(30 * seconds))


def skeleton(t_ns: Int64, place: Float, variance: float = 1e-4, people: int = 1) -> pd.DataFrame:
    """Make the rows of one joint of people who stand beside each other, of whom the first is at `place`."""
    table = pd.DataFrame({"t_ns": np.repeat(t_ns, people), "person": np.tile(np.arange(people), len(t_ns))})
    table["joint"] = "nose"
    table[["x", "y", "z"]] = np.repeat(place, people, axis=0)
    table["x"] += 5.0 * table["person"]
    table[list(POINT_COVARIANCE_COLUMNS)] = 0.0
    table[["cxx", "cyy", "czz"]] = variance
    table["views"], table["reprojection_px"], table["status"] = 3, 1.0, "ok"
    return pd.DataFrame(table[SKELETON.names])


def test_a_short_flight_is_a_single_segment() -> None:
    (one,) = divided(times(segments.LENGTH_S), 51)
    assert one.own == slice(0, len(one.t_ns))
    assert divided(times(0), 51) == []


@pytest.mark.parametrize("seconds", [181.0, 1234.5, 3600.0])
def test_every_time_is_the_own_of_one_segment(seconds: float) -> None:
    t_ns = times(seconds)
    parts = divided(t_ns, 51)
    assert np.array_equal(np.concatenate([part.t_ns[part.own] for part in parts]), t_ns)
    assert max(np.ptp(part.t_ns[part.own]) for part in parts) <= segments.LENGTH_S * SECOND
    for before, after in pairwise(parts):
        shared = np.intersect1d(before.t_ns, after.t_ns)
        assert np.ptp(shared) == pytest.approx(segments.OVERLAP_S * SECOND, abs=2 * STEP)


def test_many_keypoints_have_shorter_segments_down_to_a_limit_and_pauses_none() -> None:
    hour = times(3600)
    for keypoints in (3 * 17, 3 * 33, 8 * 33):
        most = max(len(part.t_ns[part.own]) for part in divided(hour, keypoints))
        assert most * keypoints <= segments.MOST_KEYPOINTS
    fast = np.arange(600 * 240, dtype=np.int64) * (SECOND // 240)
    assert len(divided(fast, 20 * 133)) == np.ceil(600 / segments.SHORTEST_S)
    assert len(divided(times(segments.SHORTEST_S), 10**6)) == 1
    paused = np.concatenate([times(100), times(100) + 3000 * SECOND])
    parts = divided(paused, 51)
    assert np.array_equal(np.concatenate([part.t_ns[part.own] for part in parts]), paused)
    assert all(len(part.t_ns) for part in parts)


def test_at_a_seam_the_acceleration_is_that_of_the_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segments, "LENGTH_S", 20.0)
    t_ns = times(60)
    parts = divided(t_ns, 51)
    assert len(parts) == 3
    away = [np.array([0.05 * k, -0.03 * k, 0.0]) for k in range(3)]  # estimates differ by constants

    def motion(at_ns: Int64) -> Float:
        s = (at_ns - t_ns[0]) / SECOND
        return np.stack([np.sin(2 * s), np.cos(2 * s), 0.1 * s], axis=1)

    tables = [(part, skeleton(part.t_ns, motion(part.t_ns) + away[part.number])) for part in parts]
    flight = pd.concat(list(joined(iter(tables), ("t_ns", "person", "joint"), mean_skeleton)))
    assert np.array_equal(flight["t_ns"].to_numpy(), t_ns)
    left = flight[["x", "y", "z"]].to_numpy() - motion(t_ns)
    step_s = STEP / SECOND
    acceleration = np.linalg.norm(np.diff(left, 2, axis=0), axis=1) / step_s**2
    # The second derivative of 10 u^3 - 15 u^4 + 6 u^5 is at most 10 / sqrt(3); it grows to that from 0, so
    # that differences exceed it by no more than rounding.
    apart, lasts_s = np.linalg.norm(away[1]), segments._BLENDED_NS / SECOND
    assert acceleration.max() < 10 / np.sqrt(3) * apart / lasts_s**2 + 1e-9 / step_s**2
    assert acceleration.max() < 0.01
    assert np.abs(left[t_ns < parts[0].own_ns[1] - 3.1 * SECOND]).max() == pytest.approx(0.0, abs=1e-12)
    assert left[-1] == pytest.approx(away[2], abs=1e-12)


@pytest.mark.parametrize("correlation", [-0.9, 0.0, 0.9, 1.0])
def test_covariances_at_a_seam_hold_whatever_the_estimates_have_in_common(correlation: float) -> None:
    rng = np.random.default_rng(0)
    draws, sigma = 20_000, (0.02, 0.01)
    first = rng.normal(size=(draws, 3))
    second = correlation * first + np.sqrt(1 - correlation**2) * rng.normal(size=(draws, 3))
    left, right = (
        skeleton(np.arange(draws, dtype=np.int64), of * s, s**2)
        for of, s in zip((first, second), sigma, strict=True)
    )
    made = mean_skeleton(left, right, np.full(draws, 0.5))
    squares = sum(made[name] ** 2 / made[f"c{name}{name}"] for name in "xyz")
    # Of three numbers; the mean of so many squares is known to 1 %.
    exact = 3 * (sigma[0] ** 2 + sigma[1] ** 2 + 2 * correlation * sigma[0] * sigma[1]) / 4
    assert np.mean(squares) == pytest.approx(2 * exact / (sigma[0] ** 2 + sigma[1] ** 2), rel=0.05)
    assert np.mean(squares) <= 3 * 1.03


def test_angles_go_over_by_the_shorter_way_and_poses_stay_rotations() -> None:
    share = np.array([0.0, 0.5, 1.0])
    left = pd.DataFrame({"value_deg": [179.0, 179.0, 179.0], "sigma_deg": [1.0, 1.0, 1.0]})
    right = pd.DataFrame({"value_deg": [-179.0, -179.0, -179.0], "sigma_deg": [2.0, 2.0, np.nan]})
    made = mean_angles(left, right, share)
    assert made["value_deg"].tolist() == [179.0, 180.0, -179.0]
    assert made["sigma_deg"][:2].tolist() == [1.0, np.sqrt(2.5)]
    turns = [Rotation.from_euler("z", angle, degrees=True).as_quat() for angle in (10.0, 30.0)]

    def poses(quaternion: Float) -> pd.DataFrame:
        table = pd.DataFrame({"x": [0.0] * 3, "y": [1.0] * 3, "z": [2.0] * 3})
        table[["qx", "qy", "qz", "qw"]] = np.tile(quaternion, (3, 1))
        return table

    made = mean_poses(poses(turns[0]), poses(-turns[1]), share)
    turned = Rotation.from_quat(np.stack([made[name] for name in ("qx", "qy", "qz", "qw")], axis=1))
    assert turned.as_euler("zyx", degrees=True)[:, 0] == pytest.approx([10.0, 20.0, 30.0])


def test_a_joint_that_one_segment_did_not_measure_is_that_of_the_nearer_one() -> None:
    t_ns = np.arange(3, dtype=np.int64)
    left, right = skeleton(t_ns, np.zeros((3, 3))), skeleton(t_ns, np.ones((3, 3)))
    right.loc[:, ["x", "y", "z"]] = np.nan
    made = mean_skeleton(left, right, np.array([0.2, 0.4, 0.6]))
    assert np.array_equal(made["x"], [0.0, 0.0, np.nan], equal_nan=True)


def test_people_keep_their_numbers_over_a_seam() -> None:
    t_ns = times(10)
    here = skeleton(t_ns, np.zeros((len(t_ns), 3)), people=2)
    there = here.assign(x=5.0 - here["x"])  # the same people in the other order
    span = int(t_ns[0]), int(t_ns[-1])
    distance = segments.apart_m(places(here, span), places(there, span))
    matched = same_people(distance, 0)
    assert matched == {0: 1, 1: 0}
    assert numbered(matched, 2, [0, 1]) == [1, 0]
    assert numbered({}, 2, [1, 0]) == [0, 1]  # nobody is known
    assert numbered({1: 0}, 2, [2]) == [0, 2]  # one is new
    assert same_people(distance, 2) == {0: 0, 1: 1}  # both were logged

    three = rows_of_people(there, [1, 0], 3, "joint")
    assert len(three) == 3 * len(t_ns)
    assert three[three["person"] == 0]["x"].unique().tolist() == [0.0]
    assert three[three["person"] == 2]["status"].unique().tolist() == ["not_detected"]
    assert rows_of_people(here, [0, 1], 2, "joint") is here


def test_figures_of_segments_are_added_or_their_weighted_means() -> None:
    one = {"mpjpe_mm": 10.0, "status_counts": {"ok": 30, "all": 40}, "people": {"asked": 1}, "method": "auto"}
    two = {"mpjpe_mm": 20.0, "status_counts": {"ok": 10, "all": 40, "rejected": 3}, "people": {"asked": 2}}
    whole = merged([one, two | {"method": "auto", "shape": {"jerk_m_s3": None}}], [30.0, 10.0])
    assert whole["mpjpe_mm"] == 12.5
    assert whole["status_counts"] == {"ok": 40, "all": 80, "rejected": 3}
    assert whole["people"] == {"asked": 2}
    assert whole["method"] == "auto"
    assert whole["shape"] == {"jerk_m_s3": None}


def test_the_interval_of_independent_segments_is_narrower_by_the_root_of_their_number() -> None:
    each = {
        "intervals": {"mpjpe_mm": [8.0, 12.0], "level": 0.95, "per_joint": {"nose": {"mpjpe_mm": [4.0, 6.0]}}}
    }
    whole = merged([each] * 4, [1.0] * 4)["intervals"]
    assert whole["mpjpe_mm"] == pytest.approx([9.0, 11.0])
    assert whole["per_joint"]["nose"]["mpjpe_mm"] == pytest.approx([4.5, 5.5])
    assert whole["level"] == 0.95


def test_clocks_are_those_of_most_segments() -> None:
    def found(offset_s: float, prior_s: float) -> dict[str, dict[str, float]]:
        held = {"offset_s": 0.0, "sigma_s": 0.0, "prior_s": 0.0}
        moved = {"offset_s": offset_s, "sigma_s": 1e-3, "prior_s": prior_s}
        return {"a": held, "b": moved if prior_s else held, "": {"common_sigma_s": 0.0}}

    agreed = agreed_clocks(["a", "b"], [found(0.12, 0.5), found(0.0, 0.0), found(0.13, 0.5)])
    assert agreed.offset_s.tolist() == pytest.approx([0.0, 0.125])
    assert agreed.sigma_s.tolist() == pytest.approx([0.0, 1e-3])
    agreed = agreed_clocks(["a", "b"], [found(0.12, 0.5), found(0.0, 0.0), found(0.0, 0.0)])
    assert agreed.offset_s.tolist() == [0.0, 0.0]


def test_clocks_by_backgrounds_are_not_mixed_with_clocks_by_a_reference() -> None:
    """A background shows that a is 0.5 s late, and rays that b is 0.02 s later. Elsewhere a is held."""

    def found(a_s: float, sigma_s: float, b_s: float) -> dict[str, dict[str, float]]:
        first = {"offset_s": a_s, "sigma_s": sigma_s, "prior_s": 0.0}
        second = {"offset_s": b_s, "sigma_s": 0.03, "prior_s": 0.5}
        return {"a": first, "b": second, "": {"common_sigma_s": 0.0}}

    agreed = agreed_clocks(["a", "b"], [found(0.0, 0.0, 0.02), found(0.5, 2e-3, 0.52), found(0.0, 0.0, 0.02)])
    assert agreed.offset_s.tolist() == [0.5, 0.52]
    assert agreed.sigma_s.tolist() == [2e-3, 0.03]
    assert agreed.prior_s.tolist() == [0.0, 0.5]


def test_doubts_and_warnings_of_segments() -> None:
    doubt = {"code": "clock", "cameras": ["a"], "what": "it is late", "evidence": {}, "remedy": "x"}
    [often], seldom = doubts_of_flight([[doubt], [], [doubt]])
    assert (often.code, seldom) == ("clock", [])
    assert doubts_of_flight([[], [], [doubt]]) == ([], [(often, 1, 2)])
    said = warnings_of_flight([["a: 3 left out"], ["a: 5 left out", "b"], ["a: 0.5 left out"]])
    assert said == ["a: 3 left out", "b (so, or alike, in 1 of 3 segments)"]


def test_a_segment_without_cameras_has_all_its_rows() -> None:
    part = Segment(0, times(2), (0, 2**62))
    rows, angles = nothing_seen(part, ("nose", "left_hip"), 2)
    assert len(rows) == 60 * 2 * 2
    assert set(rows["status"]) == {"few_views"}
    assert set(rows.columns) == set(SKELETON.names)
    assert set(angles.columns) == set(ANGLES.names)
    assert not np.isfinite(angles["value_deg"]).any()
