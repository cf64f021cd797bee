"""ONNX model with one picture as input, and the decoding of pose networks' outputs to joints in it.

Outputs are SimCC or heatmaps of top-down networks. Positions are pixels of the network's input, the
centre of the top left one at (0, 0).

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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.registries import need

Layout = Literal["nchw", "nhwc"]

_PROVIDER_OPTIONS = {"cuda": {"cudnn_conv_algo_search": "HEURISTIC"}}
"""Their settings. Unasked, CUDA times its algorithms and takes the fastest, so that two runs may differ."""
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
# This is ONNX Runtime's quietest level, because failures are reported here as DataError.
_FATAL = 4


@dataclass(frozen=True)
class Colours:
    """Pixel normalisation of a network: (value 0..255 - mean) / std, in its own order of channels."""

    order: Literal["rgb", "bgr"]
    mean: tuple[float, float, float]
    std: tuple[float, float, float]


IMAGENET_MEAN, IMAGENET_STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)


def provider_name(text: str) -> str:
    """Return the short name of an execution provider: `cuda` for `CUDAExecutionProvider` and `CUDA`."""
    return text.lower().removesuffix("executionprovider")


def provider_with_options(name: str) -> str:
    """Return a provider's short name with the options that it is given: what decides the last digits."""
    options = _PROVIDER_OPTIONS.get(name, {})
    return ":".join([name, *(f"{option}={value}" for option, value in sorted(options.items()))])


class OnnxNetwork:
    """Loaded model. Not thread-safe: each thread needs its own.

    Args:
        provider: the short name of the execution provider that runs it.
        size: width and height of its input, where the graph leaves them open.
        layout: of its input, where the graph leaves it open.
        threads: on the CPU.

    Attributes:
        size: width and height of its input.
        shapes: shapes of the outputs, by name, for one picture.

    Raises:
        DataError: not a model that ONNX Runtime can run, or not one of a single picture as input; no such
            provider.
    """

    def __init__(
        self,
        path: Path,
        colours: Colours,
        *,
        provider: str,
        size: tuple[int, int] | None = None,
        layout: Layout | None = None,
        threads: int,
    ) -> None:
        self.path = path
        self._colours = colours
        self._session = _session(path, provider, threads)
        inputs = self._session.get_inputs()
        shape = inputs[0].shape
        if len(inputs) != 1 or len(shape) != 4 or inputs[0].type not in _TYPES:
            described = ", ".join(f"{i.name} {i.type} {_written(i.shape)}" for i in inputs)
            raise DataError(
                path, f"its input is {described}", "it must be one picture of floats, [N,3,H,W] or [N,H,W,3]"
            )
        self._input, self._type = inputs[0].name, _TYPES[inputs[0].type]
        self._layout = _layout(path, shape, layout)
        self._batch: int | None = shape[0] if isinstance(shape[0], int) else None
        self.size = _size(path, shape[2:] if self._layout == "nchw" else shape[1:3], size)
        width, height = self.size
        blank = np.zeros((self._batch or 1, height, width, 3), np.uint8)
        self.shapes = {name: values.shape for name, values in self._outputs(blank, None).items()}

    def batch(self, rgb: NDArray[np.uint8], outputs: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Compute some outputs [N, ...], by name, for pictures [N, H, W, 3] of RGB values 0..255, N > 0.

        A graph with a fixed batch runs several times; the last run is padded with zeros.
        """
        step = self._batch or len(rgb)
        short = -len(rgb) % step
        filled = np.concatenate([rgb, np.zeros((short, *rgb.shape[1:]), np.uint8)])
        parts = [
            self._outputs(filled[first : first + step], outputs) for first in range(0, len(filled), step)
        ]
        return {name: np.concatenate([part[name] for part in parts])[: len(rgb)] for name in outputs}

    def single(self, rgb: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """Compute all outputs, by name, for one picture [H, W, 3]; their first axis need not be the batch."""
        return self._outputs(rgb[None], None)

    def _outputs(self, rgb: NDArray[np.uint8], names: Sequence[str] | None) -> dict[str, NDArray[Any]]:
        ordered = rgb if self._colours.order == "rgb" else rgb[..., ::-1]
        mean, std = (np.array(of, np.float32) for of in (self._colours.mean, self._colours.std))
        if self._layout == "nchw":
            ordered, mean, std = np.moveaxis(ordered, -1, 1), mean[:, None, None], std[:, None, None]
        pixels = np.array(ordered, np.float32, order="C")  # in place is several times faster
        pixels -= mean
        pixels /= std
        given = {self._input: pixels.astype(self._type, copy=False)}
        wanted = [output.name for output in self._session.get_outputs()] if names is None else list(names)
        try:
            values = self._session.run(wanted, given)
        except Exception as error:  # ONNX Runtime's exceptions share no other base
            shape = _written(given[self._input].shape)
            raise DataError(self.path, f"does not run on an input of {shape} ({_line(error)})") from None
        return dict(zip(wanted, (np.asarray(value) for value in values), strict=True))


def _runtime() -> Any:
    """Import ONNX Runtime, which has no type annotations."""
    return need("onnxruntime", "onnx")


def _session(path: Path, provider: str, threads: int) -> Any:
    runtime = _runtime()
    if not path.is_file():
        raise DataError(path, "does not exist", "give the path of an ONNX model", code="no-such-file")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _FATAL
    there = {provider_name(full): full for full in runtime.get_available_providers()}
    if provider not in there:
        raise DataError(
            f"--detector ...,provider={provider}",
            "is not in this ONNX Runtime",
            f"there are {', '.join(sorted(there))}; other builds of it, such as onnxruntime-gpu, have others",
            code="missing-library",
        )
    wanted = there[provider]
    given = [(wanted, _PROVIDER_OPTIONS.get(provider, {}))]
    try:
        session = runtime.InferenceSession(str(path), options, providers=given)
    except Exception as error:  # ONNX Runtime's exceptions share no other base
        raise DataError(
            path, f"is no model that ONNX Runtime can run ({_line(error)})", code="wrong-kind"
        ) from None
    if session.get_providers()[0] != wanted:
        raise DataError(
            f"--detector ...,provider={provider}",
            "could not be started",
            "leave it out: the CPU runs it",
            code="bad-option",
        )
    return session


def _layout(path: Path, shape: Sequence[object], stated: Layout | None) -> Layout:
    could: list[Layout] = []
    if shape[1] == 3 or not isinstance(shape[1], int):
        could.append("nchw")
    if shape[3] == 3 or not isinstance(shape[3], int):
        could.append("nhwc")
    sure = [layout for layout in could if shape[1 if layout == "nchw" else 3] == 3] or could
    if stated is not None:
        sure = [stated] if stated in could else []
    if len(sure) == 1:
        return sure[0]
    raise DataError(
        path,
        f"its input {_written(shape)} " + ("could be either layout" if sure else "has no axis of 3 colours"),
        "state layout=nchw or layout=nhwc" if sure else "it must be [N,3,H,W] or [N,H,W,3]",
        code="wrong-model",
    )


def _size(path: Path, shape: Sequence[object], stated: tuple[int, int] | None) -> tuple[int, int]:
    height, width = shape
    if isinstance(height, int) and isinstance(width, int):
        if stated not in (None, (width, height)):
            raise DataError(path, f"its input is {width}x{height}", "leave the size away")
        return width, height
    if stated is None:
        raise DataError(path, "leaves the size of its input open", "state it: size=192x256 (width x height)")
    return stated


def _written(shape: Sequence[object]) -> str:
    return "[" + ",".join(str(length) if isinstance(length, int) else "?" for length in shape) + "]"


def written_shapes(shapes: Mapping[str, tuple[int, ...]]) -> str:
    """Format names and shapes for a message: `simcc_x [1,17,384], simcc_y [1,17,512]`."""
    return ", ".join(f"{name} {_written(shape)}" for name, shape in shapes.items())


def _line(error: Exception) -> str:
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0][:200]


HeatmapCells = Literal["udp", "msra"]

_SMOOTHING_CELLS, _SMOOTHING_SIGMA = 11, 2.0  # DARK's kernel for 64 x 48 cells
# The refinement looks at this many bins on either side of the best one.
_REACH_BINS = 2
# The logarithm of a heatmap needs values above 0, as in DARK.
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
    offset = np.arange(-_REACH_BINS, _REACH_BINS + 1)
    around = np.take_along_axis(scores, np.clip(best[..., None] + offset, 0, last), axis=-1)
    slope = np.einsum("nkd,d->nk", around, offset) / 10
    bend = np.einsum("nkd,d->nk", around, offset**2 - 2) / 14
    inside = (best >= _REACH_BINS) & (best <= last - _REACH_BINS) & (bend < 0)
    shift = np.where(inside, -slope / np.where(inside, 2 * bend, 1.0), 0.0)
    return best + np.clip(shift, -1.0, 1.0), around[..., _REACH_BINS]


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
