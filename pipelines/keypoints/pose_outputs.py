"""Decoding of the outputs of top-down pose networks, SimCC and heatmaps, to joints in their input.

Positions are pixels of the network's input, the centre of the top left one at (0, 0).

- SimCC (Li et al., "SimCC: a Simple Coordinate Classification Perspective", 2022; RTMPose): one score for
  each bin of x and of y, `split` bins to a pixel; bin b lies at b / split, as MMPose encodes and decodes.
  Networks are trained on Gaussians of several bins, so their scores are about the logarithm of a Gaussian: a
  parabola. It is fitted by least squares to the best bin and two on either side; the joint is at its top.
  A soft argmax over all bins would be biased to the middle by other people and noise.
- Heatmaps (HRNet, ViTPose, AlphaPose's FastPose): cell k of w lies at k (W - 1) / (w - 1) where they were
  trained unbiased (`udp`: Huang et al., "The Devil Is in the Details", 2020; ViTPose), and at k W / w where
  not (`msra`: HRNet and FastPose as published). Between the cells, the logarithm of the smoothed map is
  developed to the second order about the best cell (DARK: Zhang et al., "Distribution-Aware Coordinate
  Representation", 2020): exact for a Gaussian.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.keypoints.onnx_network import written_shapes
from pipelines.session.errors import DataError

HeatmapCells = Literal["udp", "msra"]

_SMOOTHING_CELLS, _SMOOTHING_SIGMA = 11, 2.0  # DARK's kernel for 64 x 48 cells
_REACH = 2  # bins on either side of the best one
_FLOOR = 1e-10


@dataclass(frozen=True)
class PoseDecoder:
    """Decoder of one network's outputs.

    Attributes:
        outputs: names of the x and y scores, or of the heatmaps.
        count: number of joints.
        per_px: [2] bins or cells for each pixel of the input, in x and y.
    """

    outputs: tuple[str, ...]
    count: int
    per_px: tuple[float, float]

    @property
    def kind(self) -> str:
        """Kind of outputs: SimCC or heatmaps."""
        return "SimCC" if len(self.outputs) == 2 else "heatmaps"

    def decode(self, outputs: dict[str, NDArray[Any]]) -> tuple[Float, Float]:
        """Decode joints [N, K, 2] in pixels of the input, NaN if no score is above 0, and scores [N, K]."""
        maps = [outputs[name].astype(np.float64) for name in self.outputs]
        place, score = simcc_peaks(*maps) if len(maps) == 2 else heatmap_peaks(maps[0])
        xy = place / np.array(self.per_px)
        return np.where((score > 0)[..., None], xy, np.nan), np.clip(score, 0.0, 1.0)


def decoder_for(
    path: Path, shapes: Mapping[str, tuple[int, ...]], size: tuple[int, int], cells: HeatmapCells
) -> PoseDecoder:
    """Choose the decoder of a network's outputs from their shapes.

    Args:
        path: path of the model, for the message.
        shapes: shapes of the outputs for one picture, by name.
        size: width and height of the network's input.
        cells: convention for the place of heatmap cells.

    Raises:
        DataError: they are of no known kind.
    """
    width, height = size
    lines = {name: shape for name, shape in shapes.items() if len(shape) == 3}
    if len(lines) == 2 and len({shape[1] for shape in lines.values()}) == 1:
        for x, y in (tuple(lines), tuple(lines)[::-1]):
            split = lines[x][2] / width
            if split >= 1 and split == lines[y][2] / height:
                return PoseDecoder((x, y), lines[x][1], (split, split))
    maps = {name: shape for name, shape in shapes.items() if len(shape) == 4}
    if len(maps) == 1:
        ((name, (_, count, rows, columns)),) = maps.items()
        if 1 < rows <= height and 1 < columns <= width and columns * height == rows * width:
            if cells == "udp":
                return PoseDecoder((name,), count, ((columns - 1) / (width - 1), (rows - 1) / (height - 1)))
            return PoseDecoder((name,), count, (columns / width, rows / height))
    raise DataError(
        path,
        f"its outputs are not understood: {written_shapes(shapes)} for an input of {width}x{height}",
        f"expected SimCC, [N,K,{width}s] and [N,K,{height}s], or heatmaps, [N,K,{height}/s,{width}/s]",
    )


def simcc_peaks(x: Float, y: Float) -> tuple[Float, Float]:
    """Find joints [N, K, 2] in bins and their scores [N, K], the smaller of the best scores in x and y."""
    places, scores = zip(*(_line_peaks(line) for line in (x, y)), strict=True)
    return np.stack(places, axis=-1), np.minimum(*scores)


def _line_peaks(scores: Float) -> tuple[Float, Float]:
    """Find the tops [N, K] of parabolas around the best bins of [N, K, B], at most one bin away.

    Least squares of a + b d + c d^2 to d = -2..2: b = sum(d s) / 10, c = sum((d^2 - 2) s) / 14. Near
    either end of the line the best bin is kept. Also returns the scores [N, K] of the best bins.
    """
    last = scores.shape[-1] - 1
    best = scores.argmax(axis=-1)
    offset = np.arange(-_REACH, _REACH + 1)
    around = np.take_along_axis(scores, np.clip(best[..., None] + offset, 0, last), axis=-1)
    slope = np.einsum("nkd,d->nk", around, offset) / 10
    bend = np.einsum("nkd,d->nk", around, offset**2 - 2) / 14
    inside = (best >= _REACH) & (best <= last - _REACH) & (bend < 0)
    shift = np.where(inside, -slope / np.where(inside, 2 * bend, 1.0), 0.0)
    return best + np.clip(shift, -1.0, 1.0), around[..., _REACH]


def heatmap_peaks(maps: Float) -> tuple[Float, Float]:
    """Find joints [N, K, 2] in cells and the largest values [N, K] of maps [N, K, h, w].

    One Newton step from the best cell, at most one cell in each direction; none at the border, where the
    derivatives are not known, or where the map bends upwards.
    """
    people, joints, rows, columns = maps.shape
    flat = maps.reshape(people * joints, rows, columns)
    index = flat.reshape(len(flat), -1).argmax(axis=1)
    row, column = np.divmod(index, columns)
    score = flat[np.arange(len(flat)), row, column]
    place = np.column_stack([column, row]).astype(np.float64)
    inside = (row > 0) & (row < rows - 1) & (column > 0) & (column < columns - 1) & (score > 0)
    place[inside] += _newton_steps(_log_around(flat[inside], row[inside], column[inside]))
    return place.reshape(people, joints, 2), score.reshape(people, joints)


def _log_around(maps: Float, row: NDArray[np.intp], column: NDArray[np.intp]) -> Float:
    """Compute the logarithm [M, 3, 3] of smoothed maps [M, h, w] around one cell each, padded with 0."""
    reach = _SMOOTHING_CELLS // 2
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / _SMOOTHING_SIGMA) ** 2)
    shifted = np.stack([np.pad(kernel / kernel.sum(), (shift, 2 - shift)) for shift in range(3)])
    padded = np.pad(np.maximum(maps, 0.0), ((0, 0), (reach + 1, reach + 1), (reach + 1, reach + 1)))
    offset = np.arange(_SMOOTHING_CELLS + 2)
    which = np.arange(len(maps))[:, None, None]
    part = padded[which, (row[:, None] + offset)[:, :, None], (column[:, None] + offset)[:, None, :]]
    smoothed = np.einsum("mrj,cj->mrc", np.einsum("mij,ri->mrj", part, shifted), shifted)
    around: Float = np.log(np.maximum(smoothed, _FLOOR))
    return around


def _newton_steps(around: Float) -> Float:
    """Compute steps [M, 2] (x, y) from the middle of [M, 3, 3] values to the tops of their paraboloids."""
    dx, dy = (around[:, 1, 2] - around[:, 1, 0]) / 2, (around[:, 2, 1] - around[:, 0, 1]) / 2
    dxx = around[:, 1, 2] - 2 * around[:, 1, 1] + around[:, 1, 0]
    dyy = around[:, 2, 1] - 2 * around[:, 1, 1] + around[:, 0, 1]
    dxy = (around[:, 2, 2] - around[:, 2, 0] - around[:, 0, 2] + around[:, 0, 0]) / 4
    determinant = dxx * dyy - dxy**2
    has_top = (dxx < 0) & (determinant > 0)
    step = np.stack([dxy * dy - dyy * dx, dxy * dx - dxx * dy], axis=1)
    step = step / np.where(has_top, determinant, 1.0)[:, None]
    return np.where(has_top[:, None], np.clip(step, -1.0, 1.0), 0.0)
