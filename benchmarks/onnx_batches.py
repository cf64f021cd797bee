"""Cost of a crop for `--detector onnx:`, alone and in batches: `python -m benchmarks.onnx_batches`.

The model has the size of a real one: the ResNet-50 of Xiao et al., "Simple Baselines for Human Pose
Estimation and Tracking" (ECCV 2018), for crops of 192 x 256 and 17 joints. Its 34 million weights are random.
Batches take turns, and of each the fastest turn counts, in seconds of the processor on the CPU, of the clock
elsewhere.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from pipelines.keypoints.onnx_network import IMAGENET_MEAN, IMAGENET_STD, Colours, OnnxNetwork

SIZE = (192, 256)
JOINTS = 17
_LAYERS = ((64, 3), (128, 4), (256, 6), (512, 3))


def main() -> None:
    """Print the table of docs/detector.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--provider", default="cpu")
    parser.add_argument("--batches", type=int, nargs="*", default=[1, 2, 4, 8])
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    crops = rng.integers(0, 256, (max(arguments.batches), *SIZE[::-1], 3), np.uint8)
    with tempfile.TemporaryDirectory(prefix="mocap-") as name:
        path = simple_baseline(Path(name) / "pose.onnx")
        network = OnnxNetwork(
            path, Colours("rgb", IMAGENET_MEAN, IMAGENET_STD), provider=arguments.provider, threads=1
        )
        clock = time.process_time if arguments.provider == "cpu" else time.perf_counter
        took_s = np.array(
            [
                [taken(network, crops[:batch], clock) for batch in arguments.batches]
                for _ in range(arguments.repeats)
            ]
        )
        alone = np.concatenate([network.batch(crop[None], ["heatmap"])["heatmap"] for crop in crops])
        apart = np.abs(network.batch(crops, ["heatmap"])["heatmap"] - alone).max() / np.abs(alone).max()
    print("| batch | ms a crop |")
    print("| --- | --- |")
    for batch, best_s in zip(arguments.batches, took_s.min(axis=0), strict=True):
        print(f"| {batch} | {1e3 * best_s / batch:.1f} |")
    print(f"\na batch of {len(crops)} differs from one by one by at most {apart:.1g} of the largest value")


def taken(network: OnnxNetwork, crops: NDArray[np.uint8], clock: Callable[[], float]) -> float:
    """Return the seconds of one run."""
    begun = clock()
    network.batch(crops, ["heatmap"])
    return clock() - begun


def simple_baseline(path: Path) -> Path:
    """Write the model: ResNet-50 and three transposed convolutions, batch normalisations folded in."""
    graph = _Graph()
    value = graph.conv("input", 3, 64, kernel=7, stride=2)
    value = graph.add("MaxPool", [value], kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1])
    channels = 64
    for stage, (width, blocks) in enumerate(_LAYERS):
        for block in range(blocks):
            stride = 2 if stage and not block else 1
            inner = graph.conv(value, channels, width)
            inner = graph.conv(inner, width, width, kernel=3, stride=stride)
            inner = graph.conv(inner, width, 4 * width, relu=False)
            if not block:
                value = graph.conv(value, channels, 4 * width, stride=stride, relu=False)
            value = graph.add("Relu", [graph.add("Add", [inner, value])])
            channels = 4 * width
    for _ in range(3):
        weight = graph.weight((channels, 256, 4, 4))
        value = graph.add(
            "ConvTranspose", [value, weight], kernel_shape=[4, 4], strides=[2, 2], pads=[1, 1, 1, 1]
        )
        value, channels = graph.add("Relu", [value]), 256
    graph.nodes.append(helper.make_node("Conv", [value, graph.weight((JOINTS, channels, 1, 1))], ["heatmap"]))
    width, height = SIZE
    made = helper.make_graph(
        graph.nodes,
        "simple_baseline",
        [helper.make_tensor_value_info("input", TensorProto.FLOAT, ["n", 3, height, width])],
        [helper.make_tensor_value_info("heatmap", TensorProto.FLOAT, ["n", JOINTS, height // 4, width // 4])],
        graph.weights,
    )
    onnx.save(helper.make_model(made, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), str(path))
    return path


class _Graph:
    """Nodes and weights as they are added."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.weights: list[onnx.TensorProto] = []
        self._rng = np.random.default_rng(0)

    def add(self, kind: str, inputs: list[str], **attributes: Any) -> str:
        """Add a node; return the name of its output."""
        name = f"value{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def weight(self, shape: tuple[int, ...]) -> str:
        """Add random numbers that keep the size of what goes through; return their name."""
        name = f"weight{len(self.weights)}"
        spread = np.sqrt(2 / np.prod(shape[1:]))
        values = (spread * self._rng.standard_normal(shape)).astype(np.float32)
        self.weights.append(numpy_helper.from_array(values, name))
        return name

    def conv(
        self, value: str, channels: int, made: int, *, kernel: int = 1, stride: int = 1, relu: bool = True
    ) -> str:
        """Add a convolution whose output has its input's size divided by the stride; return its name."""
        around = [kernel // 2] * 4
        weight = self.weight((made, channels, kernel, kernel))
        value = self.add(
            "Conv", [value, weight], kernel_shape=[kernel] * 2, strides=[stride] * 2, pads=around
        )
        return self.add("Relu", [value]) if relu else value


if __name__ == "__main__":
    main()
