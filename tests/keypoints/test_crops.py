"""Crops of pictures: positions equal to OpenCV's own, on which the agreement of the networks depends."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipelines.keypoints.crops import fixed_point_maps

NUMBERS = st.floats(-40, 40, width=32)
PLACES = st.floats(-70_000, 70_000)  # OpenCV's maps end at 32,767 pixels


@given(axes=st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS), corner=st.tuples(PLACES, PLACES))
def test_maps_are_those_that_opencv_makes_of_the_positions(
    axes: tuple[float, float, float, float], corner: tuple[float, float]
) -> None:
    picture_from_crop = np.column_stack([np.reshape(axes, (2, 2)), corner])
    row, column = np.mgrid[:5, :19]  # 19: more columns than are processed at once
    x, y = (a * column + (b * row + c) for a, b, c in picture_from_crop)
    whole, part = cv2.convertMaps(x.astype(np.float32), y.astype(np.float32), cv2.CV_16SC2)
    found_whole, found_part = fixed_point_maps(picture_from_crop, 19, 5)
    np.testing.assert_array_equal(found_whole, whole)
    np.testing.assert_array_equal(found_part, part)
