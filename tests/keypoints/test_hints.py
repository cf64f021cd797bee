"""Place of the actor in the picture, against a pinhole computed by hand."""

import math

import numpy as np
import pytest

from pipelines.geometry.arrays import Intrinsics
from pipelines.keypoints.search import Hint, project_actor

CAMERA = Intrinsics(width=1280, height=720, fx=800.0, fy=800.0, cx=639.5, cy=359.5)
# At the origin, looking along the world's x: camera x is the world's -y, camera y its -z.
POSE = (np.zeros(3), np.array([-0.5, 0.5, -0.5, 0.5]))


def _hint(x: float, y: float, z: float, sigma_m: float = 0.0, sigma_rad: float = 0.0) -> Hint | None:
    return project_actor(np.array([x, y, z]), POSE, CAMERA, sigma_m=sigma_m, sigma_rad=sigma_rad)


def test_an_actor_ahead_is_in_the_middle_and_as_tall_as_the_range_says() -> None:
    hint = _hint(10, 0, 0, sigma_m=0.3, sigma_rad=math.radians(1))

    assert hint is not None
    assert hint.centre == pytest.approx((639.5, 359.5))
    assert hint.height_px == pytest.approx(800 * 1.75 / 10, rel=1e-3)
    assert hint.margin_px == pytest.approx(3 * 800 * math.hypot(0.03, math.radians(1)), rel=1e-3)


@pytest.mark.parametrize("place", [(-10, 0, 0), (0, 1, 0), (10, 9, 0), (10, 0, -6), (10, math.nan, 0)])
def test_no_hint_behind_beside_outside_or_unknown(place: tuple[float, float, float]) -> None:
    assert _hint(*place) is None


def test_an_actor_outside_by_less_than_the_margin_is_hinted_at() -> None:
    # 40 px beyond the left border; the margin is 3 x 800 x 0.2 / 10 = 48 px there or more.
    y = (639.5 + 40) / 80

    assert _hint(10, y, 0, sigma_m=0.1) is None
    assert _hint(10, y, 0, sigma_m=0.25) is not None
