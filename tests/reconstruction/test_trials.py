"""Disturbed poses: independence of the random draws, refused options, and the summary of several trials."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import t

from pipelines.geometry.arrays import Intrinsics
from pipelines.geometry.poses import look_at, matrix_from_quaternion
from pipelines.reconstruction.clocks import FoundClocks
from pipelines.reconstruction.loading import PoseDisturbance, disturbed
from pipelines.reconstruction.observations import Camera, Candidates
from pipelines.reconstruction.refining import with_clocks
from pipelines.reconstruction.results import GOOD_MM, USABLE_MM, summary_of_trials, verdict
from pipelines.reconstruction.solving import placed_by_size, ray_sigma
from pipelines.session.description import Interpolation
from pipelines.session.errors import DataError
from pipelines.session.records import Detections, Trajectory


def camera(name: str) -> Camera:
    nothing = np.empty(0, dtype=np.int64)
    log = Trajectory(np.arange(5, dtype=np.int64) * 10**8, np.zeros((5, 3)), np.tile([0.0, 0, 0, 1], (5, 1)))
    return Camera(
        name=name,
        intrinsics=Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0, "none", ()),
        frame_number=np.arange(5),
        frame_t_ns=log.t_ns,
        follows=np.ones(5, dtype=np.bool_),
        trajectory=log,
        static=False,
        sigma=np.full((5, 2), 0.1),
        detections=Detections(("nose",), nothing, nothing, np.empty((0, 1, 2)), np.empty((0, 1)), nothing),
    )


def moved(models: str, *, seed: int = 0, trial: int = 0, count: int = 2) -> Any:
    cameras = [camera(f"drone{k}") for k in range(count)]
    after = disturbed(cameras, PoseDisturbance.parse(models).models, seed, trial)
    assert all((a.sigma == b.sigma).all() for a, b in zip(after, cameras, strict=True) if a.sigma is not None)
    return np.stack([each.trajectory.position for each in after])


def test_each_camera_and_trial_has_its_own_chance_whatever_else_is_asked() -> None:
    two, three = moved("white:position_m=0.1"), moved("white:position_m=0.1", count=3)
    np.testing.assert_array_equal(two, three[:2])
    np.testing.assert_allclose(moved("white:position_m=0.2"), 2 * two)
    assert not np.allclose(two[0], two[1])
    assert not np.allclose(two, moved("white:position_m=0.1", trial=1))
    assert not np.allclose(two, moved("white:position_m=0.1", seed=1))
    assert not moved("latency:latency_ms=50").any()  # of cameras that stand still


def test_a_late_log_moves_against_its_pictures() -> None:
    """Stamp a log that moves by 1 m/s 0.2 s too late: its camera is 0.2 m further on than it says."""
    names, none = ("late", "early", "late film"), np.zeros(3)
    moving = [replace(camera(name), frame_t_ns=np.array([2 * 10**8])) for name in names]
    logs = [replace(each.trajectory, position=np.arange(5)[:, None] * [0.1, 0, 0]) for each in moving]
    moving = [replace(each, trajectory=log) for each, log in zip(moving, logs, strict=True)]
    found = FoundClocks(
        np.array([0.2, -0.1, 0.2]), np.full(3, 0.01), none, wrong=dict.fromkeys(names, "background")
    )
    clocks = found.with_late_logs(names, np.array([True, True, False]))
    assert clocks.wrong == {"late": "log", "early": "log", "late film": "background"}
    after = with_clocks(moving, clocks.with_others(FoundClocks(none, none, none)))
    assert [each.frame_t_ns[0] / 1e9 for each in after] == [0.2, 0.2, 0.4]
    between = Interpolation(max_gap_s=1.0, max_extrapolation_s=1.0)
    at = [each.poses_at(each.frame_t_ns, between)[0][0, 0] for each in after]
    np.testing.assert_allclose(at, [0.4, 0.1, 0.4], atol=1e-9)
    shown = clocks.as_metrics(names)["clocks_moved"]
    assert [shown[name]["offset_s"] for name in names] == [-0.2, 0.1, 0.2]


def test_cameras_that_are_metres_off_start_where_people_have_their_size() -> None:
    person, times = np.array([[0, 0, 1.53], [0, 0.1, 0], [0, -0.1, 0]]), 6  # of 1.70 m
    at, off = np.array([[9.0, 1, 4], [-2, 8, 3]]), np.array([[4.0, -6, 3], [-3, 5, 2]])
    rotation = matrix_from_quaternion(look_at(at, np.zeros((2, 3))))
    seen = np.einsum("cji,ckj->cki", rotation, person - at[:, None])
    each = seen[:, None, :, :2] / seen[:, None, :, 2:], np.ones((2, 1, 3)), at + off, rotation
    every = [np.tile(part, (times, *(1,) * part.ndim)) for part in each]
    found = Candidates(np.arange(times), np.zeros((times, 2), np.int64), *every)
    joints = ("nose", "left_ankle", "right_ankle")
    left = placed_by_size(joints, found, [50.0, 50.0], None, 1.7) + off
    assert np.ptp(left, axis=0).max() < 0.1  # all are off alike
    hips = np.tile([0.0, 0.0, 0.77], (times, 1))
    assert np.abs(placed_by_size(joints, found, [50.0, 50.0], hips, 1.7) + off).max() < 0.1
    near = replace(found, position=found.position - 0.9 * off)
    assert not placed_by_size(joints, near, [50.0, 50.0], hips, 1.7).any()


def test_rays_are_as_sure_as_people_are_far() -> None:
    """Two cameras 4 m apart look at somebody 10 m away, who is not amid them."""
    at = np.array([[-2.0, -np.sqrt(96.0), 0.0], [2.0, -np.sqrt(96.0), 0.0]])
    rotation = matrix_from_quaternion(look_at(at, np.zeros((2, 3))))
    seen = np.zeros((1, 2, 1, 3, 2)), np.ones((1, 2, 1, 3))
    found = Candidates(np.zeros(1, np.int64), np.zeros((1, 2), np.int64), *seen, at[None], rotation[None])
    stated = np.tile([1.0, 0.0], (5, 1))
    sigma = ray_sigma([replace(camera(name), sigma=stated) for name in "ab"], found)
    # A weight of 0.01 about the point amid them, against rays at an angle of 23 degrees, takes a fifth.
    assert np.abs(sigma - 0.1).max() < 0.03


@pytest.mark.parametrize(
    ("text", "models", "trials", "seed"),
    [
        ("white:position_m=0.3", 1, 1, 0),
        ("white:position_m=0.3,rotation_deg=1 + bias:position_m=1e+0 x20 seed=3", 2, 20, 3),
        ("drift:position_m_per_sqrt_s=0.1 seed=7", 1, 1, 7),
        ("white:position_m=0.3   x4 ", 1, 4, 0),
    ],
)
def test_trials_and_seed_stand_behind_the_models(text: str, models: int, trials: int, seed: int) -> None:
    parsed = PoseDisturbance.parse(text)
    assert (len(parsed.models), parsed.trials, parsed.seed) == (models, trials, seed)


@pytest.mark.parametrize(
    "text",
    [
        *("loud", "pink:position_m=1", "white:position_m=-1", "x5", "white:position_m=1 x0"),
        *("white:position_m=0 + bias:rotation_deg=0", "white:position_m=1 x5000", "white:position_m=1 5"),
    ],
)
def test_nonsense_is_refused_in_a_line(text: str) -> None:
    with pytest.raises(DataError) as refused:
        PoseDisturbance.parse(text)
    assert refused.value.source == "--disturb-poses"
    assert "\n" not in str(refused.value)


def metrics_of(mpjpe_mm: float | None) -> dict[str, Any]:
    names = (
        "mpjpe_mm root_mpjpe_mm pa_mpjpe_mm e_recon_m2 e_recon_terms e_recon_per_joint_frame_m2 pck150"
        " pck150_auc acceleration_error_mm_s2 reconstructed_share"
    )
    return {**dict.fromkeys(names.split()), "mpjpe_mm": mpjpe_mm, "reprojection_px": {"median": 2.0}}


def test_trials_together() -> None:
    said = summary_of_trials(
        [metrics_of(100.0), metrics_of(None), metrics_of(140.0)], "white:position_m=1", 0
    )
    assert (said["count"], said["stored"], said["seed"]) == (3, 0, 0)
    assert [each["mpjpe_mm"] for each in said["each"]] == [100.0, None, 140.0]
    assert said["mean"]["mpjpe_mm"] == 120
    assert said["std"]["mpjpe_mm"] == pytest.approx(20 * np.sqrt(2))
    half = t.ppf(0.975, 1) * 20  # Student's interval of the mean of two
    assert said["intervals"]["mpjpe_mm"] == pytest.approx([120 - half, 120 + half])
    assert said["mean"]["pa_mpjpe_mm"] is None
    assert said["std"]["reprojection_px_median"] == 0
    alone = summary_of_trials([metrics_of(100.0)], "white:position_m=1", 0)
    assert alone["mean"]["mpjpe_mm"] == 100
    assert alone["std"]["mpjpe_mm"] is alone["intervals"]["mpjpe_mm"] is None


FIGURES: dict[str, Any] = {
    "reconstructed_share": 0.99,
    "reprojection_px_per_camera": {"drone1": {}, "drone2": {}, "drone3": {}},
    "method_used": {"pose_noise": "stated", "background": {"cameras": ["drone1"]}},
    "doubts": [],
}


def judged(folder: Path, sigma_m: float, **figures: Any) -> dict[str, Any]:
    """Judge a skeleton of which each coordinate has this standard deviation; one joint is missing."""
    table = pd.DataFrame({name: [sigma_m**2, sigma_m**2, float("nan")] for name in ("cxx", "cyy", "czz")})
    table["status"] = ["ok", "ok", "few_views"]
    table.to_parquet(folder / "skeleton.parquet")
    return verdict(folder, FIGURES | figures, guessed_lenses=[])


def test_the_expected_error_grows_with_the_covariances(tmp_path: Path) -> None:
    near, far = (judged(tmp_path, sigma_m)["expected_error_mm"] for sigma_m in (0.01, 0.1))
    assert near[0] < near[1] < near[2]
    assert far == pytest.approx([10 * value for value in near], rel=0.02)  # rounded to 0.1 mm


@pytest.mark.parametrize(("sigma_m", "grade"), [(0.01, "good"), (0.08, "usable"), (0.5, "poor")])
def test_the_grade_follows_the_expected_error(tmp_path: Path, sigma_m: float, grade: str) -> None:
    found = judged(tmp_path, sigma_m)
    assert found["grade"] == grade
    assert len(found["why"]) == (grade == "poor")  # then the stated poses are the cause
    assert found["next"].startswith("mocap report")
    median_mm = found["expected_error_mm"][1]
    assert {"good": median_mm <= GOOD_MM, "poor": median_mm > USABLE_MM}.get(grade, True)


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    alone = judged(
        tmp_path,
        0.01,
        reprojection_px_per_camera={"drone1": {}, "drone2": {}},
        method_used={"pose_noise": "estimated", "background": {"cameras": []}},
    )
    assert len(alone["why"]) == 3  # backgrounds, cameras, pose noise


def test_a_doubted_flight_is_wrong_and_little_is_poor(tmp_path: Path) -> None:
    doubt = {"what": "the positions are in ft", "remedy": "cameras.drone1.pose.unit: ft"}
    wrong = judged(tmp_path, 0.01, doubts=[doubt])
    assert wrong["grade"] == "wrong"
    assert wrong["why"][0] == doubt["what"]
    assert "--fix" in wrong["next"]
    assert judged(tmp_path, 0.01, reconstructed_share=0.3)["grade"] == "poor"
