"""Left and right exchanged in a walk whose joints are known, in one camera that circles it."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.geometry.poses import look_at
from pipelines.keypoints.swaps import exchange, mirrored_pairs, undo_swaps
from pipelines.session.records import Float
from pipelines.simulation.observe import see
from pipelines.simulation.walk import COCO17, walk
from tests.synthetic.flights import LENS

FPS, SECONDS, NOISE_PX = 30, 20, 2.0
PAIRS = mirrored_pairs(COCO17)
LEGS = [PAIRS[f"left_{part}"] for part in ("hip", "knee", "ankle")]
ARMS = [PAIRS[f"left_{part}"] for part in ("shoulder", "elbow", "wrist")]
T_S = np.arange(SECONDS * FPS) / FPS


def pixels(turn_deg: float, tilt_deg: float = 20.0, noise_px: float = NOISE_PX, seed: int = 0) -> Float:
    """[T, 17, 2] px of a walk along a circle, seen from 10 m: from all sides in its 21 s."""
    joints = walk(T_S, radius_m=4.0)
    tilt, turn = np.radians(tilt_deg), np.radians(turn_deg)
    away = 10 * np.array([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)])
    target = joints[:, 11:13].mean(axis=1)
    xy = see(joints, target + away, look_at(target + away, target), LENS)
    return xy + np.random.default_rng(seed).normal(0.0, noise_px, xy.shape)


@pytest.mark.parametrize("noise_px", [0.0, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("turn_deg", [0.0, 120.0, 240.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 45.0, 80.0])
def test_what_is_not_exchanged_stays_to_the_last_bit(
    noise_px: float, turn_deg: float, tilt_deg: float
) -> None:
    xy = pixels(turn_deg, tilt_deg, noise_px)
    confidence = np.random.default_rng(1).uniform(0.3, 1.0, xy.shape[:2])
    found, sure, counts = undo_swaps(T_S, xy, confidence, COCO17)
    assert counts == {}
    np.testing.assert_array_equal(found, xy)
    np.testing.assert_array_equal(sure, confidence)


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
    # 141 of those variances, in each limb and on both sides of both ends.
    distance2 = np.min([squared_distance(truth, limb) for limb in limbs], axis=0)
    visible = swapped.copy()
    for first, stop in np.flatnonzero(np.diff(swapped, prepend=False, append=False)).reshape(-1, 2):
        ends = [first - 1, first, stop - 1, stop]
        visible[first:stop] = distance2[ends].min() > 141 * NOISE_PX**2
    assert visible.sum() > 0.5 * swapped.sum()
    columns = [side for pair in group for side in pair]
    restored = (found[:, columns] == truth[:, columns]).all(axis=(1, 2))
    assert restored[visible].mean() >= 0.95
    # The others stay.
    assert restored[~swapped].mean() >= 0.99
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


def test_short_or_empty_tracks_are_left_alone() -> None:
    for rows in (0, 1, 2):
        xy = np.full((rows, 17, 2), np.nan)
        found, _, counts = undo_swaps(T_S[:rows], xy, np.zeros((rows, 17)), COCO17)
        assert counts == {}
        assert found.shape == xy.shape


def squared_distance(xy: Float, pairs: list[tuple[int, int]]) -> Float:
    """[T] of left and right, summed over some pairs."""
    total: Float = np.sum([((xy[:, a] - xy[:, b]) ** 2).sum(-1) for a, b in pairs], axis=0)
    return total


def runs(count: int, longest: int, rng: np.random.Generator) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Runs of up to so many pictures, about 10 % of all, none at the ends."""
    where = np.zeros(count, np.bool_)
    while where.mean() < 0.1:
        first = int(rng.integers(3, count - longest - 3))
        where[first : first + int(rng.integers(1, longest + 1))] = True
    return where
