"""Peaks between the bins of SimCC and the cells of heatmaps."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipelines.geometry.arrays import Float
from pipelines.keypoints.onnx_network import heatmap_peaks, simcc_peaks

inner = st.floats(9.0, 38.0)


@given(x=inner, y=st.floats(9.0, 54.0), sigma=st.floats(1.5, 3.0), height=st.floats(0.05, 1.0))
def test_a_gaussian_in_a_heatmap_is_read_exactly(x: float, y: float, sigma: float, height: float) -> None:
    row, column = np.mgrid[:64, :48]
    heatmap = height * np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * sigma**2))
    place, score = heatmap_peaks(heatmap[None, None])
    # Smoothing stops 5 cells away. For a sigma of 3, at 1.5 cells from the top, the weights of the full sum
    # are normal about 1.5 * 4 / 13 with the variance 1 / (1/4 + 1/9): 0.32 % lies beyond. The slope is then
    # wrong by at most half of that, and the step by 13 times as much.
    np.testing.assert_allclose(place[0, 0], (x, y), atol=13 * 0.0032 / 2)
    assert score[0, 0] == heatmap.max()


@given(x=inner, y=inner, sigma=st.floats(4.0, 8.0))
def test_scores_that_are_a_logarithm_are_read_exactly(x: float, y: float, sigma: float) -> None:
    bins = np.arange(48, dtype=np.float64)
    lines: list[Float] = [10 - (bins - at) ** 2 / (2 * sigma**2) for at in (x, y)]
    place, score = simcc_peaks(lines[0][None, None], lines[1][None, None])
    np.testing.assert_allclose(place[0, 0], (x, y), atol=1e-9)
    assert score[0, 0] == min(line.max() for line in lines)
