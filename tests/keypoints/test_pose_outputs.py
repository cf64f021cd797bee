"""Peaks between the bins of SimCC and the cells of heatmaps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.geometry.arrays import Float
from pipelines.keypoints.onnx_network import decoder_for, heatmap_peaks, simcc_peaks
from pipelines.session.errors import DataError

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


def test_peaks_at_the_border_stay_in_their_cell() -> None:
    heatmap = np.zeros((1, 4, 64, 48))
    corners = [(0, 0), (0, 47), (63, 0), (63, 47)]
    for joint, (row, column) in enumerate(corners):
        heatmap[0, joint, row, column] = 1.0
    place, _ = heatmap_peaks(heatmap)
    np.testing.assert_array_equal(place[0], [(column, row) for row, column in corners])


def test_a_flat_map_has_no_joint() -> None:
    decoder = decoder_for(Path("m.onnx"), {"h": (1, 2, 64, 48)}, (192, 256), "msra")
    xy, score = decoder.decode({"h": np.zeros((1, 2, 64, 48), np.float32)})
    assert np.isnan(xy).all()
    assert not score.any()


def test_shapes_tell_the_kind() -> None:
    simcc = {"y": (1, 17, 512), "x": (1, 17, 384)}
    assert decoder_for(Path("m.onnx"), simcc, (192, 256), "udp").outputs == ("x", "y")
    heatmap = decoder_for(Path("m.onnx"), {"h": (1, 17, 64, 48)}, (192, 256), "udp")
    assert heatmap.per_px == (47 / 191, 63 / 255)
    assert decoder_for(Path("m.onnx"), {"h": (1, 17, 64, 48)}, (192, 256), "msra").per_px == (0.25, 0.25)
    for shapes in ({"x": (1, 17, 384)}, {"h": (1, 48, 64, 17)}, {"x": (1, 17, 384), "y": (1, 17, 384)}):
        with pytest.raises(DataError, match="not understood"):
            decoder_for(Path("m.onnx"), shapes, (192, 256), "udp")
