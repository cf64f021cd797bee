"""Exchanges of left and right in a walk with known joints, in one camera that circles it."""

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import look_at
from pipelines.keypoints.corrections import exchange, mirrored_pairs, undo_swaps
from pipelines.simulation.detector_errors import see
from tests.synthetic.flights import LENS
from tests.synthetic.walk import COCO17, walk

FPS, SECONDS, NOISE_PX = 30, 20, 2.0
PAIRS = mirrored_pairs(COCO17)
LEGS = [PAIRS[f"left_{part}"] for part in ("hip", "knee", "ankle")]
ARMS = [PAIRS[f"left_{part}"] for part in ("shoulder", "elbow", "wrist")]
T_S = np.arange(SECONDS * FPS) / FPS


def pixels(turn_deg: float, tilt_deg: float = 20.0, noise_px: float = NOISE_PX, seed: int = 0) -> Float:
    """Project a walk along a circle to [T, 17, 2] px, from 10 m: from all sides in its 21 s."""
    joints = walk(T_S, radius_m=4.0)
    tilt, turn = np.radians(tilt_deg), np.radians(turn_deg)
    away = 10 * np.array([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)])
    target = joints[:, 11:13].mean(axis=1)
    xy = see(joints, target + away, look_at(target + away, target), LENS)
    return xy + np.random.default_rng(seed).normal(0.0, noise_px, xy.shape)


@pytest.mark.parametrize("noise_px", [0.0, 2.0])
@pytest.mark.parametrize("turn_deg", [0.0, 120.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 45.0])
def test_what_is_not_exchanged_stays_to_the_last_bit(
    noise_px: float, turn_deg: float, tilt_deg: float
) -> None:
    xy = pixels(turn_deg, tilt_deg, noise_px)
    confidence = np.random.default_rng(1).uniform(0.3, 1.0, xy.shape[:2])
    found, sure, counts = undo_swaps(T_S, xy, confidence, COCO17)
    assert counts == {}
    np.testing.assert_array_equal(found, xy)
    np.testing.assert_array_equal(sure, confidence)


@pytest.mark.parametrize("turn_deg", [0.0, 60.0, 120.0])
def test_nothing_is_exchanged_between_pictures_that_are_too_far_apart(turn_deg: float) -> None:
    """Legs cross every half second, so nothing predicts them over 0.4 s."""
    xy = pixels(turn_deg)[::12]
    assert undo_swaps(T_S[::12], xy, np.ones(xy.shape[:2]), COCO17)[2] == {}


def test_gaps_and_outliers_are_no_exchanges() -> None:
    xy = pixels(30.0)
    rng = np.random.default_rng(2)
    xy[rng.random(xy.shape[:2]) < 0.05] = np.nan
    outliers = rng.random(xy.shape[:2]) < 0.02
    xy[outliers] += rng.normal(0.0, 60.0, (outliers.sum(), 2))
    xy[200:260] = np.nan
    found, _, counts = undo_swaps(T_S, xy, np.ones(xy.shape[:2]), COCO17)
    assert sum(counts.values()) <= 0.01 * len(T_S)
    assert np.isnan(found).sum() == np.isnan(xy).sum()


@pytest.mark.parametrize("turn_deg", [0.0, 90.0, 200.0])
@pytest.mark.parametrize("longest", [1, 5, 20])
@pytest.mark.parametrize("what", ["whole body", "legs"])
def test_exchanges_are_undone(what: str, longest: int, turn_deg: float) -> None:
    group, limbs = (list(PAIRS.values()), [ARMS, LEGS]) if what == "whole body" else (LEGS, [LEGS])
    truth = pixels(turn_deg)
    swapped = runs(len(T_S), longest, np.random.default_rng(3))
    xy = truth.copy()
    exchange(xy, swapped, group)

    found, _, counts = undo_swaps(T_S, xy, np.ones(xy.shape[:2]), COCO17)

    # An end of a run makes the two joints of a pair jump by their distance, which adds g = 2 / 3 of the
    # pairs' squared distances, in variances of a coordinate, to the wrong path, with a deviation of
    # 2 sqrt(g). It is seen above the price of a change, 16.5: with four deviations on top from g = 94 on,
    # 141 of those variances, in each limb and on both sides of both ends. Pairs nearer to each other than 0.3
    # of the body's size, 36 px, may be crossing, and jumps count where two of three pairs do not: with the
    # noise of a distance on top from 11 + 4 px on, in two pictures on either side, which predictions take.
    distance2 = np.min([squared_distance(truth, limb) for limb in limbs], axis=0)
    without_noise = pixels(turn_deg, noise_px=0.0)
    pairs_apart = np.min(
        [
            np.sum([squared_distance(without_noise, [pair]) > 15**2 for pair in limb], axis=0)
            for limb in limbs
        ],
        axis=0,
    )
    visible = swapped.copy()
    for first, stop in np.flatnonzero(np.diff(swapped, prepend=False, append=False)).reshape(-1, 2):
        ends = np.r_[first - 2 : first + 2, stop - 2 : stop + 2]
        visible[first:stop] = distance2[ends].min() > 141 * NOISE_PX**2 and pairs_apart[ends].min() >= 2
    assert visible.sum() > 0.15 * swapped.sum()
    columns = [side for pair in group for side in pair]
    restored = (found[:, columns] == truth[:, columns]).all(axis=(1, 2))
    assert restored[visible].mean() >= 0.95
    # The others stay, except those up to a crossing that are fewer than the exchanged ones beyond it.
    assert restored[~swapped].mean() >= 0.98
    assert sum(counts.values()) >= 0.9 * visible.sum()


def test_a_single_pair_is_undone_with_its_confidence() -> None:
    truth = pixels(0.0)
    left, right = PAIRS["left_wrist"]
    confidence = np.random.default_rng(1).uniform(0.3, 1.0, truth.shape[:2])
    apart = np.linalg.norm(truth[:, left] - truth[:, right], axis=-1)
    at = int(np.argmax(apart))
    xy, sure = truth.copy(), confidence.copy()
    rows = np.zeros(len(T_S), np.bool_)
    rows[at] = True
    exchange(xy, rows, [(left, right)])
    exchange(sure, rows, [(left, right)])
    found, restored, counts = undo_swaps(T_S, xy, sure, COCO17)
    assert counts == {"wrist": 1}
    np.testing.assert_array_equal(found, truth)
    np.testing.assert_array_equal(restored, confidence)


def squared_distance(xy: Float, pairs: list[tuple[int, int]]) -> Float:
    """Compute the squared distance [T] of left and right, summed over some pairs."""
    total: Float = np.sum([((xy[:, a] - xy[:, b]) ** 2).sum(-1) for a, b in pairs], axis=0)
    return total


def runs(count: int, longest: int, rng: np.random.Generator) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Draw runs of up to `longest` pictures, about 10 % of all, none at the ends."""
    where = np.zeros(count, np.bool_)
    while where.mean() < 0.1:
        first = int(rng.integers(3, count - longest - 3))
        where[first : first + int(rng.integers(1, longest + 1))] = True
    return where


def step_sideways(crossing_s: float, step_s: float = 0.5, seconds: float = 4.0) -> tuple[Float, Float]:
    """Simulate knees and feet of a walker seen from the side at 30 Hz: [T] s, [T, 17, 2] px, no noise.

    Left and right swing against each other by 25 px and cross every half second, one time at `crossing_s`.
    Where they are nearer than 12 px, one hides the other, and detectors find both in the middle.
    """
    t_s = np.arange(round(seconds * FPS)) / FPS
    swing = np.sin(np.pi * (t_s - crossing_s) / step_s)
    xy = np.zeros((len(t_s), 17, 2))
    xy[..., 0] = 640.0
    xy[..., 1] = 250.0 + 10.0 * np.arange(17)
    for part, share in (("hip", 0.0), ("knee", 0.6), ("ankle", 1.0)):
        left, right = PAIRS[f"left_{part}"]
        aside = np.where(np.abs(50.0 * share * swing) < 12.0, 0.0, 25.0 * share * swing)
        xy[:, left, 0] += aside
        xy[:, right, 0] -= aside
    return t_s, xy


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("pictures", [2, 3, 4, 5])
def test_an_exchange_from_or_to_a_crossing_is_undone_and_no_other_picture_is_exchanged(
    pictures: int, behind: bool
) -> None:
    """Exchange legs up to the picture where they cross, so that only the other end jumps.

    The exchange covers less than half of the 15 pictures between two crossings. Exchanging the rest of these
    instead would remove the same jump.
    """
    t_s, truth = step_sideways(crossing_s=2.0 + 0.5 / FPS)
    truth += np.random.default_rng(4).normal(0.0, 0.5, truth.shape)
    rows = slice(61, 61 + pictures) if behind else slice(60 - pictures + 1, 61)
    xy = truth.copy()
    swapped = np.zeros(len(t_s), np.bool_)
    swapped[rows] = True
    exchange(xy, swapped, LEGS[1:])

    found, _, _ = undo_swaps(t_s, xy, np.ones(xy.shape[:2]), COCO17)

    feet = list(PAIRS["left_ankle"])
    off_px = np.abs(found[:, feet] - truth[:, feet]).max(axis=(1, 2))
    apart_px = np.abs(truth[:, feet[0], 0] - truth[:, feet[1], 0])
    assert (off_px[~swapped] == 0).all()
    assert (off_px[swapped & (apart_px > 15)] == 0).all()
