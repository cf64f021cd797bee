"""Disturbed poses: independence of the random draws, refused options, and the summary of several trials."""

from typing import Any

import numpy as np
import pytest
from scipy.stats import t

from pipelines.geometry.arrays import Intrinsics
from pipelines.reconstruction.loading import PoseDisturbance, disturbed
from pipelines.reconstruction.observations import Camera
from pipelines.reconstruction.results import summary_of_trials
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
    # Latency does not change a camera that stands still.
    assert not moved("latency:latency_ms=50").any()


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
