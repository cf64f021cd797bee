"""Exchanges of left and right in some of the cameras around a walk with known joints."""

import numpy as np
import pytest

from pipelines.geometry.arrays import Float
from pipelines.geometry.cameras import undistort
from pipelines.geometry.poses import look_at, matrix_from_quaternion
from pipelines.keypoints.corrections import Pair, mirrored_pairs, swaps_across_views
from pipelines.reconstruction.observations import on_sides
from pipelines.simulation.detector_errors import see
from tests.synthetic.flights import LENS
from tests.synthetic.walk import COCO17, walk

NOISE_PX = 2.0
T_S = np.arange(150) / 15
PAIRS = mirrored_pairs(COCO17)
LEGS = [PAIRS[f"left_{part}"] for part in ("hip", "knee", "ankle")]
SIGMA = NOISE_PX / LENS.fx


class Views:
    """Views of cameras on a ring of 10 m; pixels of [C, T, 17, 2]."""

    def __init__(self, cameras: int, noise_px: float = NOISE_PX) -> None:
        joints = walk(T_S, radius_m=2.0)
        turn = 2 * np.pi * np.arange(cameras) / cameras if cameras > 2 else np.radians([0.0, 100.0])
        places = np.stack([10 * np.cos(turn), 10 * np.sin(turn), np.full(cameras, 4.0)], axis=1)
        position = np.repeat(places[:, None], len(T_S), axis=1)
        quaternion = look_at(position, joints[None, :, 11])
        pixels = np.stack([see(joints, p, q, LENS) for p, q in zip(position, quaternion, strict=True)])
        self.pixels = pixels + np.random.default_rng(0).normal(0.0, noise_px, pixels.shape)
        self.position = np.moveaxis(position, 0, 1)
        self.rotation = np.moveaxis(matrix_from_quaternion(quaternion), 0, 1)
        self.sigma = np.full((len(T_S), cameras), SIGMA)
        self.xy = np.moveaxis(undistort(self.pixels, LENS), 0, 2)

    def undone(self, xy: Float) -> tuple[Float, dict[str, int]]:
        sides, counts = swaps_across_views(xy, self.position, self.rotation, self.sigma, COCO17)
        seen = np.ones(xy.shape[:-1])
        found, kept = (values[:, 0] for values in on_sides(xy[:, None], seen[:, None], sides[:, None]))
        assert ((sides >= 0) == (kept == 1)).all()
        return found, counts


def exchanged(xy: Float, camera: int, rows: slice, pairs: list[Pair]) -> Float:
    swapped = xy.copy()
    for left, right in pairs:
        swapped[rows, left, camera], swapped[rows, right, camera] = (
            xy[rows, right, camera],
            xy[rows, left, camera],
        )
    return swapped


@pytest.mark.parametrize("cameras", [2, 3, 5])
@pytest.mark.parametrize("noise_px", [0.0, 2.0])
def test_views_that_agree_stay_to_the_last_bit(cameras: int, noise_px: float) -> None:
    views = Views(cameras, noise_px)
    found, counts = views.undone(views.xy)
    np.testing.assert_array_equal(found, views.xy)
    assert counts == {}


@pytest.mark.parametrize("cameras", [3, 4, 5])
@pytest.mark.parametrize("pairs", [list(PAIRS.values()), LEGS], ids=["whole body", "legs"])
def test_an_exchange_in_one_camera_is_undone(cameras: int, pairs: list[Pair]) -> None:
    views = Views(cameras)
    found, counts = views.undone(exchanged(views.xy, 1, slice(20, 120), pairs))
    # Left and right are apart along the horizon, where three cameras have three rays for two unknowns: a pair
    # that is s apart misses by s / 3 in the exchanged camera, in more cameras by more. Over the six rays of
    # the legs that makes m = 2 / 9 of the squared distances, in variances of a coordinate, with a deviation
    # of 2 sqrt(m). Seen are 6 * 5 of them: with four deviations on top m = 116, or 522.
    apart = views.pixels[1]
    distance2 = np.sum([((apart[:, a] - apart[:, b]) ** 2).sum(-1) for a, b in LEGS], axis=0)
    visible = np.zeros(len(T_S), np.bool_)
    visible[20:120] = distance2[20:120] > 522 * NOISE_PX**2
    assert visible.sum() > 20
    legs = np.ravel(LEGS)
    restored = (found[:, legs] == views.xy[:, legs]).all(axis=(1, 2, 3))
    assert restored[visible].mean() >= 0.95
    outside = np.r_[0:20, 120:150]
    np.testing.assert_array_equal(found[outside], views.xy[outside])
    assert counts["undone"] >= 2 * len(LEGS) * restored[visible].sum()


def test_of_two_cameras_neither_is_believed() -> None:
    views = Views(2)
    found, counts = views.undone(exchanged(views.xy, 1, slice(20, 120), LEGS))
    assert counts.keys() == {"dropped"}
    dropped = np.asarray(np.isnan(found).any(axis=(1, 2, 3)))
    assert dropped[20:120].mean() > 0.1
    assert not dropped[:20].any()
    assert not dropped[120:].any()
    assert (np.isnan(found).any(-1).all(-1) == np.isnan(found).any(-1).any(-1)).all()  # both views or none
