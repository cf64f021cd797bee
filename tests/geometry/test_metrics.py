"""Errors calculated by hand for skeletons of a few joints, and changes that a metric must ignore."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.metrics import (
    STRETCH_S,
    bone_lengths,
    intervals,
    measure,
    measure_shape,
    stretch_samples,
    tracking_errors,
    world_errors,
)

JOINTS = ("left_hip", "right_hip", "left_knee", "right_knee", "nose")
STANCE = np.array([[0.0, 0.1, 1.0], [0, -0.1, 1.0], [0.02, 0.12, 0.5], [-0.02, -0.12, 0.5], [0.05, 0, 1.7]])
MS = 1_000_000


def stamps(count: int, step_ms: int = 40) -> Int64:
    return 1_700_000_000_000_000_000 + np.arange(count, dtype=np.int64) * step_ms * MS


def walk(count: int = 6) -> Float:
    """Make one person who walks along x at 1.2 m/s, [T, 1, J, 3]."""
    path = np.arange(count)[:, None] * np.array([1.2 * 0.04, 0, 0])
    return np.asarray(STANCE + path[:, None, None])


def shifted(truth: Float, joint: str, by: tuple[float, float, float]) -> Float:
    estimate = truth.copy()
    estimate[:, :, JOINTS.index(joint)] += by
    return estimate


def test_the_truth_itself_has_no_error() -> None:
    found = measure(walk(), walk(), JOINTS, stamps(6))
    assert found["mpjpe_mm"] == found["root_mpjpe_mm"] == found["e_recon_m2"] == 0
    # Coordinates near 1 m through a rotation and back: 1e-15 m.
    assert found["pa_mpjpe_mm"] == pytest.approx(0, abs=1e-11)
    # Differences of zeros.
    assert found["acceleration_error_mm_s2"] == 0
    assert found["pck150"] == found["pck150_auc"] == found["reconstructed_share"] == 1


def test_one_joint_off_by_a_known_distance() -> None:
    # The nose is 30 mm, 40 mm off: 50 mm in one joint of five.
    found: Any = measure(shifted(walk(), "nose", (0.03, 0, 0.04)), walk(), JOINTS, stamps(6))
    assert found["mpjpe_mm"] == pytest.approx(10)
    assert found["root_mpjpe_mm"] == pytest.approx(10)
    assert found["e_recon_m2"] == pytest.approx(6 * 0.05**2)
    assert found["e_recon_terms"] == 30
    assert found["e_recon_per_joint_frame_m2"] == pytest.approx(0.05**2 / 5)
    assert found["pck150"] == 1
    # Four joints are right at every threshold, the nose from a third of the range on.
    assert found["pck150_auc"] == pytest.approx((4 + 2 / 3) / 5)
    assert found["per_joint"]["nose"]["mpjpe_mm"] == pytest.approx(50)
    assert found["per_joint"]["nose"]["pck150_auc"] == pytest.approx(2 / 3)
    assert found["per_joint"]["left_knee"]["mpjpe_mm"] == 0


def test_a_hip_joint_is_the_root_and_does_not_dilute_the_mean() -> None:
    joints = ("hip", "nose", "neck")
    truth = np.arange(9.0).reshape(1, 1, 3, 3) ** 1.1
    estimate = truth + 0.5
    estimate[0, 0, 1, 0] += 0.008
    found: Any = measure(estimate, truth, joints, stamps(1))
    assert found["root_mpjpe_mm"] == pytest.approx(4)  # nose 8 mm, neck 0; the hip is not counted
    assert found["per_joint"]["hip"]["root_mpjpe_mm"] is None
    assert found["acceleration_error_mm_s2"] is None


@given(
    shift=st.tuples(*[st.floats(-2, 2)] * 3), turn=st.tuples(*[st.floats(-1, 1)] * 3), scale=st.floats(0.5, 2)
)
def test_each_metric_is_blind_to_what_it_removes(
    shift: tuple[float, float, float], turn: tuple[float, float, float], scale: float
) -> None:
    truth = walk()
    moved = measure(truth + shift, truth, JOINTS, stamps(6))
    assert moved["mpjpe_mm"] == pytest.approx(1e3 * np.linalg.norm(shift), abs=1e-9)
    assert moved["root_mpjpe_mm"] == pytest.approx(0, abs=1e-9)
    rotation = Rotation.from_rotvec(turn).as_matrix()
    similar = measure(scale * truth @ rotation.T + shift, truth, JOINTS, stamps(6))
    assert similar["pa_mpjpe_mm"] == pytest.approx(0, abs=1e-9)


def test_missing_joints_are_wrong_for_pck_and_lower_only_the_share() -> None:
    estimate = shifted(walk(), "nose", (0.2, 0, 0))
    estimate[:3, 0, JOINTS.index("left_knee")] = np.nan
    found: Any = measure(estimate, walk(), JOINTS, stamps(6))
    # 30 joint-frames: 3 missing, 6 noses 200 mm off.
    assert found["joint_frames"] == 30
    assert found["reconstructed_share"] == pytest.approx(27 / 30)
    assert found["pck150"] == pytest.approx(21 / 30)
    assert found["mpjpe_mm"] == pytest.approx(6 * 200 / 27)
    assert found["e_recon_terms"] == 27
    assert found["per_joint"]["left_knee"]["reconstructed_share"] == 0.5
    assert found["per_joint"]["left_knee"]["pck150"] == 0.5


def test_frames_without_a_root_or_an_alignment_are_counted() -> None:
    estimate = walk()
    estimate[0, 0, 0] = np.nan  # no left hip: no root, four joints still align
    estimate[1, 0, [0, 1, 2]] = np.nan  # two joints left: neither
    estimate[2] = np.nan  # nothing at all: nothing is left out of anything
    found = measure(estimate, walk(), JOINTS, stamps(6))
    assert found["root_frames_left_out"] == 2
    assert found["pa_frames_left_out"] == 1


def test_acceleration_is_exact_for_any_steps() -> None:
    t_ns = stamps(5) + np.array([0, 7, -5, 11, 2], dtype=np.int64) * MS
    t_s = (t_ns - t_ns[0])[:, None, None, None] / 1e9
    truth = np.broadcast_to(STANCE, (5, 1, 5, 3))
    estimate = truth + np.array([0.3, -0.4, 0]) * t_s**2 + np.array([1.0, 2, 3]) * t_s
    found = measure(estimate, truth, JOINTS, t_ns)
    # Twice 0.5 m/s^2. Second differences of 1e-16 m rounding over (40 ms)^2 leave 1e-13.
    assert found["acceleration_error_mm_s2"] == pytest.approx(1000, abs=1e-8)


def test_no_acceleration_across_missing_samples_or_gaps() -> None:
    truth = walk(7)
    estimate = truth.copy()
    estimate[::2] += 0.01
    alternating: Any = measure(estimate, truth, JOINTS, stamps(7))
    # +-0.01 m in three axes at 40 ms: 2 * 0.01 * sqrt(3) / 0.04^2 m/s^2.
    expected = 1e3 * 2 * 0.01 * np.sqrt(3) / 0.04**2
    assert alternating["acceleration_error_mm_s2"] == pytest.approx(expected)
    estimate[[2, 5]] = np.nan  # no three in a row are left
    assert measure(estimate, truth, JOINTS, stamps(7))["acceleration_error_mm_s2"] is None
    late = stamps(4) + np.array([0, 0, 1000, 1000], dtype=np.int64) * MS
    assert measure(truth[:4], truth[:4], JOINTS, late)["acceleration_error_mm_s2"] is None


def test_a_place_that_is_wrong_is_no_error_of_the_motion() -> None:
    moved = walk(150) + np.array([3.0, 4.0, 0.0])
    found = world_errors(moved, walk(150), JOINTS, stamps(150))
    # Coordinates of some metres through a rotation and back: 1e-12 mm.
    for name in ("w_mpjpe_mm", "wa_mpjpe_mm", "rte_percent", "jitter", "shifted_mpjpe_mm"):
        assert found[name] == pytest.approx(0, abs=1e-6)
    assert found["foot_sliding_mm"] is None  # it has no feet


def test_a_way_that_is_too_long_is_an_error_of_the_world() -> None:
    """Walk 10 % too fast: the error grows from 0 to 4.8 mm a step, and rigid motion halves it."""
    truth = walk(101)
    along = np.arange(101)[:, None] * np.array([0.0048, 0, 0])
    found = world_errors(truth + along[:, None, None], truth, JOINTS, stamps(101))
    assert found["rte_percent"] == pytest.approx(100 * 0.0048 * 101 / 4 / 4.8, rel=0.02)
    assert found["w_mpjpe_mm"] == pytest.approx(4.8 * 49.5, rel=0.1)  # of segments of 100 and of 1
    assert found["w_mpjpe_mm"] is not None
    assert found["wa_mpjpe_mm"] is not None
    assert found["wa_mpjpe_mm"] < found["w_mpjpe_mm"]


def test_feet_that_stand_slide_as_far_as_the_estimate_moves_them() -> None:
    joints = (*JOINTS[:-1], "left_ankle")
    truth = np.repeat(walk(1), 10, axis=0)
    found = world_errors(
        truth + np.arange(10)[:, None, None, None] * [0.004, 0, 0], truth, joints, stamps(10)
    )
    # 4 mm in 40 ms are 3.33 mm in a thirtieth of a second.
    assert found["foot_sliding_mm"] == pytest.approx(4 / 0.04 / 30)


# --- without truth -------------------------------------------------------------------------------------
BONES = (("left_hip", "left_knee"), ("right_hip", "right_knee"), ("left_hip", "right_hip"))


def test_bones_have_their_lengths() -> None:
    position = walk(3)
    position[1, 0, JOINTS.index("left_knee")] = np.nan
    lengths = bone_lengths(position, JOINTS, BONES)
    thigh = np.sqrt(0.02**2 + 0.02**2 + 0.5**2)
    np.testing.assert_allclose(
        lengths[:, 0], [[thigh, thigh, 0.2], [np.nan, thigh, 0.2], [thigh, thigh, 0.2]], atol=1e-15
    )
    with pytest.raises(ValueError, match="tail"):
        bone_lengths(position, JOINTS, (("nose", "tail"),))


def test_shape_tells_spread_asymmetry_and_jerk() -> None:
    t_ns = stamps(9)
    t_s = (t_ns - t_ns[0]) / 1e9
    position = np.zeros((9, 2, 4, 3)) + (2 * t_s**3)[:, None, None, None] * [1.0, 0, 0]
    # Left bone 400 mm +- {-4..4}, right bone 410 mm; the second person is 100 mm longer all over.
    position[:, :, 1, 2] = 0.4 + np.arange(-4, 5)[:, None] * 1e-3 + [0, 0.1]
    position[:, :, 3, 2] = 0.41 + np.array([0, 0.1])
    joints = ("left_hip", "left_knee", "right_hip", "right_knee")
    found: Any = measure_shape(position, joints, BONES[:2], t_ns)
    # The absolute deviations are 0 1 1 2 2 3 3 4 4 mm: their median is 2, whatever the person's size.
    assert found["bones"]["left_hip-left_knee"]["spread_mm"] == pytest.approx(1.4826 * 2)
    assert found["bones"]["right_hip-right_knee"]["spread_mm"] == pytest.approx(0, abs=1e-9)
    assert found["asymmetry_mm"]["hip-knee"] == pytest.approx(10)
    # Half of the joints have 12 m/s^3 alone, and the moving bone end adds nothing to a third difference.
    assert found["jerk_m_s3"] == pytest.approx(12, abs=1e-8)


def test_who_was_missed_and_confused_is_counted() -> None:
    """Count by hand: two people 3 m apart for 10 times, who exchange their numbers at the sixth.

    The first is not found at times 0 and 1, and a third number is 2 m from everybody at time 9. That is 20
    true ones, 2 misses, 1 phantom and 2 switches; each number is the same person at 5 times at most, the
    first at 5 and the second at 5 (or at 3 and 5).
    """
    truth = np.zeros((10, 2, 2, 3))
    truth[:, 1, :, 0] = 3.0
    position = np.full((10, 3, 2, 3), np.nan)
    position[:5, :2], position[5:, :2] = truth[:5], truth[5:, ::-1]
    position[:2, 0] = np.nan
    position[9, 2] = [-2.0, 0.0, 0.0]
    found = tracking_errors(position + np.array([0.3, 0.0, 0.0]), truth)
    assert (found["present"], found["misses"], found["phantoms"], found["switches"]) == (20, 2, 1, 2)
    assert found["by_person"] == [
        {
            "phantoms": 0,
            "misses": 0,
            "switches": 1,
        },  # at five times the second true one, and at three the first
        {"phantoms": 0, "misses": 2, "switches": 1},
        {"phantoms": 1, "misses": None, "switches": None},
    ]
    assert found["mota"] == pytest.approx(1 - 5 / 20)
    assert found["idf1"] == pytest.approx(2 * 10 / (20 + 19))


RATE = 30
SAMPLES = 60 * RATE
ONE = np.ones(SAMPLES)
NORMAL_95 = 2 * 1.959964


def times_of(count: int = SAMPLES) -> NDArray[np.int64]:
    return 1_700_000_000_000_000_000 + np.arange(count, dtype=np.int64) * (1_000_000_000 // RATE)


def mean_width(series: Float) -> float:
    """Compute the mean width of the intervals of many series [K, T]."""
    widths = []
    for k, values in enumerate(series):
        found = intervals({"x": (values, ONE)}, times_of(), seed=k)["x"]
        assert found is not None
        widths.append(found[1] - found[0])
    return float(np.mean(widths))


def test_independent_errors_give_the_interval_of_the_textbook() -> None:
    series = np.random.default_rng(1).normal(5, 2, (40, SAMPLES))
    # 12 stretches: the variance of so few sums scatters by sqrt(2/12) = 41 % and a width by half of that;
    # the ends of 2000 draws by 4 % of half a width; 40 series: 3.3 %, and the mean width of a chi with 12
    # degrees is 2 % short. Three times the one, and the other.
    expected = NORMAL_95 * 2 / np.sqrt(SAMPLES)
    assert mean_width(series) == pytest.approx(expected, rel=0.12)


def test_errors_that_last_widen_the_interval_by_what_their_memory_asks_for() -> None:
    memory = RATE // 2
    rng = np.random.default_rng(2)
    noise = rng.normal(0, 1, (40, SAMPLES + memory - 1))
    total = np.cumsum(np.pad(noise, ((0, 0), (1, 0))), axis=1)
    series = (total[:, memory:] - total[:, :-memory]) / memory  # moving averages over half a second
    # The variance of a mean is sum (1 - |h| / L) gamma(h) / T in stretches of L samples (Kuensch 1989), with
    # gamma(h) = (1 - |h| / K) / K for the moving average over K.
    length = stretch_samples(times_of())
    lag = np.abs(np.arange(1 - memory, memory))
    variance = float(np.sum((1 - lag / length) * (1 - lag / memory) / memory)) / SAMPLES
    assert length == STRETCH_S * RATE
    assert mean_width(series) == pytest.approx(NORMAL_95 * np.sqrt(variance), rel=0.12)
    # Taken as independent, they would seem four times as sure (sqrt(15)).
    assert mean_width(series) > 3 * NORMAL_95 * float(series.std()) / np.sqrt(SAMPLES)


def test_nothing_to_draw_from_has_no_interval() -> None:
    nothing = np.zeros(SAMPLES)
    assert intervals({"a": (nothing, nothing)}, times_of()) == {"a": None}
    assert intervals({"a": (ONE[:9], ONE[:9])}, times_of(9)) == {"a": None}
    # One sample in a minute: some resampled minutes miss it.
    rare = nothing.copy()
    rare[40] = 1
    assert intervals({"a": (rare, rare)}, times_of()) == {"a": None}


@pytest.mark.parametrize(("trials", "low", "high"), [(3, 0.92, 0.98), (100, 0.93, 0.97)])
def test_the_interval_of_trials_holds_the_mean_as_often_as_it_says(
    trials: int, low: float, high: float
) -> None:
    """Skewed errors, as those of joints: 1,000 draws know a share of 95 % to 0.7 %."""
    values = np.random.default_rng(5).gamma(8.0, 1.0, (1000, trials))
    found = [intervals({"x": (own, np.ones(trials))}, None)["x"] for own in values]
    assert low < np.mean([ends is not None and ends[0] <= 8.0 <= ends[1] for ends in found]) < high


def test_trials_pair_sums_with_weights() -> None:
    values = np.random.default_rng(5).normal(5, 2, 400)
    found = intervals({"x": (values, np.ones(400)), "ratio": (3 * values, values)}, None)
    assert found["x"] is not None
    assert np.diff(found["x"]) == pytest.approx(NORMAL_95 * 2 / np.sqrt(400), rel=0.15)
    assert found["ratio"] == pytest.approx((3.0, 3.0))
    assert intervals({"x": (values[:1], ONE[:1])}, None) == {"x": None}
