"""Small real ONNX models with known answers: they find bright spots, or return constants.

A pose model here divides its input into bands of equal height, two by default: joint j is the brightest
place of the band j modulo their number.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

OPSET, IR = 18, 9  # versions that ONNX Runtime 1.20 reads

Node = onnx.NodeProto


def heatmap_model(
    path: Path,
    *,
    size: tuple[int, int] = (96, 128),
    joints: int = 17,
    stride: int = 4,
    cells: str = "udp",
    batch: int | str = "n",
    layout: str = "nchw",
    open_size: bool = False,
    bands: int = 2,
    channel: tuple[float, float, float] = (1 / 3, 1 / 3, 1 / 3),
) -> Path:
    """Build a heatmap model: cell k is the brightness at pixel k (W - 1) / (w - 1) (`udp`) or k `stride`."""
    width, height = size
    columns, rows = width // stride, height // stride
    constants = _pose_constants(size, joints, channel, bands)
    if cells == "udp":
        constants["sizes"] = np.array([joints, rows, columns], np.int64)
        last = helper.make_node(
            "Resize",
            ["bright", "", "", "sizes"],
            ["heatmap"],
            axes=[1, 2, 3],
            mode="linear",
            coordinate_transformation_mode="align_corners",
        )
    else:
        constants |= {
            "from": np.array([0, 0], np.int64),
            "to": np.array([height, width], np.int64),
            "axes": np.array([2, 3], np.int64),
            "steps": np.array([stride, stride], np.int64),
        }
        last = helper.make_node("Slice", ["bright", "from", "to", "axes", "steps"], ["heatmap"])
    nodes = [*_brightness(layout), last]
    shape = _input_shape(size, batch, layout, open_size)
    return _save(path, nodes, shape, {"heatmap": [batch, joints, rows, columns]}, constants)


def simcc_model(
    path: Path, *, size: tuple[int, int] = (96, 128), joints: int = 17, split: int = 2, batch: int | str = "n"
) -> Path:
    """Build a SimCC model: bin b is the smoothed sum of columns, or rows, around b / split, over 16."""
    width, height = size
    constants = _pose_constants(size, joints, (1 / 3, 1 / 3, 1 / 3))
    nodes = _brightness("nchw")
    for name, axis, length in (("x", 2, width), ("y", 3, height)):
        apart = np.arange(length)[:, None] - np.arange(split * length) / split
        smooth = np.exp(-(apart**2) / 2) / np.sqrt(2 * np.pi) / 16
        constants |= {f"{name}_axis": np.array([axis], np.int64), f"{name}_bins": smooth.astype(np.float32)}
        nodes += [
            helper.make_node("ReduceSum", ["bright", f"{name}_axis"], [f"{name}_line"], keepdims=0),
            helper.make_node("MatMul", [f"{name}_line", f"{name}_bins"], [f"simcc_{name}"]),
        ]
    outputs: dict[str, list[int | str]] = {
        "simcc_x": [batch, joints, split * width],
        "simcc_y": [batch, joints, split * height],
    }
    return _save(path, nodes, _input_shape(size, batch, "nchw", False), outputs, constants)


def constant_model(
    path: Path, size: tuple[int, int], outputs: dict[str, NDArray[np.float32] | NDArray[np.int64]]
) -> Path:
    """Build a model that returns the same outputs for every input."""
    constants: dict[str, NDArray[np.float32] | NDArray[np.int64]] = {
        f"{name}_value": value for name, value in outputs.items()
    }
    nodes = [helper.make_node("Identity", [f"{name}_value"], [name]) for name in outputs]
    shapes: dict[str, list[int | str]] = {name: list(value.shape) for name, value in outputs.items()}
    return _save(path, nodes, _input_shape(size, 1, "nchw", False), shapes, constants)


def _pose_constants(
    size: tuple[int, int], joints: int, channel: Sequence[float], bands: int = 2
) -> dict[str, NDArray[np.float32] | NDArray[np.int64]]:
    band = np.arange(size[1]) * bands // size[1]
    mask = np.repeat((np.arange(joints)[:, None] % bands == band)[:, :, None], size[0], axis=2)
    return {
        "weight": np.array(channel, np.float32).reshape(1, 3, 1, 1),
        "mask": mask[None].astype(np.float32),
    }


def _brightness(layout: str) -> list[Node]:
    first = [helper.make_node("Transpose", ["input"], ["planes"], perm=[0, 3, 1, 2])]
    planes = "planes" if layout == "nhwc" else "input"
    return [
        *(first if layout == "nhwc" else []),
        helper.make_node("Conv", [planes, "weight"], ["grey"]),
        helper.make_node("Mul", ["grey", "mask"], ["bright"]),
    ]


def _input_shape(size: tuple[int, int], batch: int | str, layout: str, open_size: bool) -> list[int | str]:
    width, height = ("w", "h") if open_size else size
    return [batch, 3, height, width] if layout == "nchw" else [batch, height, width, 3]


def _save(
    path: Path,
    nodes: Sequence[Node],
    shape: Sequence[int | str],
    outputs: dict[str, list[int | str]],
    constants: dict[str, NDArray[np.float32] | NDArray[np.int64]],
) -> Path:
    kinds = {
        name: TensorProto.INT64
        if f"{name}_value" in constants and constants[f"{name}_value"].dtype == np.int64
        else TensorProto.FLOAT
        for name in outputs
    }
    graph = helper.make_graph(
        nodes,
        "known",
        [helper.make_tensor_value_info("input", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info(name, kinds[name], of) for name, of in outputs.items()],
        [numpy_helper.from_array(np.ascontiguousarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return path


def spots(
    width: int, height: int, places: Sequence[tuple[float, float]], sigma_px: float, colour: int | None = None
) -> NDArray[np.uint8]:
    """Draw a black picture [H, W, 3] BGR with round Gaussian spots, in one BGR channel if it is given."""
    x, y = (
        np.exp(-((np.arange(length) - np.array(at)[:, None]) ** 2) / (2 * sigma_px**2))
        for length, at in zip((width, height), zip(*places, strict=True), strict=True)
    )
    grey = np.clip(np.round(255 * np.einsum("pr,pc->rc", y, x)), 0, 255).astype(np.uint8)
    picture = np.zeros((height, width, 3), np.uint8)
    picture[..., slice(None) if colour is None else colour] = grey[..., None] if colour is None else grey
    return picture
