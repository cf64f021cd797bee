"""ONNX model with one picture as input: its size, batch, layout and colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.session.errors import DataError
from pipelines.session.registries import need

Layout = Literal["nchw", "nhwc"]

_PROVIDER_OPTIONS = {"cuda": {"cudnn_conv_algo_search": "HEURISTIC"}}
"""Their settings. Unasked, CUDA times its algorithms and takes the fastest, so that two runs may differ."""
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
_FATAL = 4  # ONNX Runtime's quietest level: failures are reported here as DataError


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
        path: the model.
        colours: how it wants its pixels.
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
        raise DataError(path, "does not exist", "give the path of an ONNX model")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _FATAL
    there = {provider_name(full): full for full in runtime.get_available_providers()}
    if provider not in there:
        raise DataError(
            f"--provider {provider}",
            "is not in this ONNX Runtime",
            f"there are {', '.join(sorted(there))}; other builds of it, such as onnxruntime-gpu, have others",
        )
    wanted = there[provider]
    given = [(wanted, _PROVIDER_OPTIONS.get(provider, {}))]
    try:
        session = runtime.InferenceSession(str(path), options, providers=given)
    except Exception as error:  # ONNX Runtime's exceptions share no other base
        raise DataError(path, f"is no model that ONNX Runtime can run ({_line(error)})") from None
    if session.get_providers()[0] != wanted:
        raise DataError(f"--provider {provider}", "could not be started", "leave it out: the CPU runs it")
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
