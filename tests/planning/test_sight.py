"""Sight lines against a plain and slow reference."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipelines.planning.distance_field import DistanceField, distance_field, visible
from pipelines.session.records import Occupancy

RES = 0.5


def random_field(seed: int, share: float) -> tuple[DistanceField, NDArray[np.bool_]]:
    occupied = np.random.default_rng(seed).random((12, 10, 8)) < share
    return distance_field(Occupancy(occupied.astype(np.float32), np.zeros(3), RES)), occupied


def crossed_boxes(occupied: NDArray[np.bool_], a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Measure the longest piece of the segment inside one occupied box (slab test of every box)."""
    low = np.argwhere(occupied) * RES
    with np.errstate(divide="ignore", invalid="ignore"):
        first, last = (low - a) / (b - a), (low + RES - a) / (b - a)
    near = np.nanmax(np.minimum(first, last), axis=1).clip(0, 1)
    far = np.nanmin(np.maximum(first, last), axis=1).clip(0, 1)
    return float((far - near).max(initial=0.0) * np.linalg.norm(b - a))


@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.02, 0.3]))
def test_traversal_finds_every_box_that_is_crossed(seed: int, share: float) -> None:
    field, occupied = random_field(seed, share)
    rng = np.random.default_rng(seed)
    camera, actor = rng.uniform(-2, 7, (2, 20, 3))
    seen = visible(field, camera, actor, start_m=0.0)
    for k in range(20):
        longest = crossed_boxes(occupied, camera[k], actor[k])
        if longest > 1e-9 or longest == 0.0:  # not where a corner is grazed
            assert seen[k] == (longest == 0.0)


@given(st.integers(0, 10_000), st.sampled_from([0.001, 0.02, 0.98]))
def test_within_a_leap_all_is_alike(seed: int, share: float) -> None:
    """Every voxel within the leap of any point of a voxel has its state; far off, leaps are long."""
    field, occupied = random_field(seed, share)
    bricks = field.sight.bricks
    apart = np.transpose(bricks.reshape(*bricks.shape[:3], 4, 4, 4), (0, 3, 1, 4, 2, 5))
    byte = apart.reshape([4 * n for n in bricks.shape[:3]])[:12, :10, :8]
    assert np.array_equal(byte % 2 == 1, occupied)
    places = np.argwhere(np.ones_like(occupied))
    for at in places[np.random.default_rng(seed).choice(len(places), 20)]:
        gap = np.maximum(np.abs(places - at) - 1, 0)  # between the boxes
        other = occupied[tuple(places.T)] != occupied[tuple(at)]
        leap = byte[tuple(at)] // 2
        if not other.any():
            assert leap == 127
            continue
        assert leap / 2 <= np.sqrt((gap[other] ** 2).sum(axis=1)).min()
        # D of the voxel's centre, less a diagonal, to the half voxel below
        centres = np.sqrt(((places[other] - at) ** 2).sum(axis=1)).min()
        assert leap >= 2 * (centres - np.sqrt(3)) - 1.01


def test_the_end_at_the_actor_is_left_out() -> None:
    occupied = np.zeros((40, 3, 3), dtype=np.float32)
    occupied[0:2] = 1  # the actor's own voxels, x < 1
    field = distance_field(Occupancy(occupied, np.zeros(3), RES))
    actor, camera = np.array([0.75, 0.75, 0.75]), np.array([10.75, 0.75, 0.75])
    assert not visible(field, camera, actor, start_m=0.0)
    assert visible(field, camera, actor, start_m=1.5)
    assert visible(field, actor + np.array([0, 0, 1.0]), actor, start_m=1.5)
