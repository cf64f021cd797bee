"""Person detectors as ONNX models: YOLOX and RTMDet, as exported by OpenMMLab and by their authors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Picture
from pipelines.keypoints.crops import sampled
from pipelines.keypoints.onnx_network import OnnxNetwork, written_shapes
from pipelines.session.errors import DataError

_SURE = 0.3  # as RTMLib draws boxes
_SAME_PERSON = 0.45  # intersection over union, YOLOX's own
_STRIDES = (8, 16, 32)
_AROUND = 114  # grey beside the picture, which these networks were trained with
_PERSON = 0  # the class, in COCO and in every list of persons alone


class OnnxPeople:
    """Person detector. Not thread-safe."""

    def __init__(self, network: OnnxNetwork) -> None:
        self._network = network
        width, height = network.size
        self._grid = _grid(width, height)

    def find(self, picture: Picture) -> tuple[Float, Float]:
        """Find people in a picture [H, W, 3] BGR, best first.

        The picture is fitted into the top left of the network's input. The network counts from the edge of
        the first pixel, the boxes returned from its centre.

        Returns:
            Boxes [N, 4] (left, top, right, bottom) in px, and scores [N].

        Raises:
            DataError: the network's outputs are of no known kind.
        """
        width, height = self._network.size
        scale = max(picture.shape[1] / width, picture.shape[0] / height)
        placed = np.array([[scale, 0.0, (scale - 1) / 2], [0.0, scale, (scale - 1) / 2]])
        fitted = sampled(picture, placed, (width, height), beyond="edge")
        fitted[int(np.ceil(picture.shape[0] / scale)) :] = _AROUND
        fitted[:, int(np.ceil(picture.shape[1] / scale)) :] = _AROUND
        boxes, score = self._read(self._network.single(fitted))
        sure = score >= _SURE
        boxes, score = boxes[sure], score[sure]
        kept = distinct(boxes, score)
        return boxes[kept] * scale - 0.5, score[kept]

    def _read(self, outputs: Mapping[str, NDArray[Any]]) -> tuple[Float, Float]:
        """Read boxes [N, 4] in pixels of the input and scores [N], before any filtering."""
        tables = [np.asarray(v, np.float64) for v in outputs.values() if v.dtype.kind == "f"]
        tables = [table[0] if table.ndim == 3 and len(table) == 1 else table for table in tables]
        labels = [np.ravel(v) for v in outputs.values() if v.dtype.kind in "iu"]
        if len(tables) == 1 and tables[0].ndim == 2:
            (table,) = tables
            count, columns = table.shape
            if columns >= 6 and count == len(self._grid):
                return _raw_yolox(table, self._grid)
            if columns == 5 and len(labels) <= 1:
                persons = labels[0] == _PERSON if labels and len(labels[0]) == count else np.full(count, True)
                return table[persons, :4], table[persons, 4]
            if columns == 6 and not labels:
                persons = table[:, 5] == _PERSON
                return table[persons, :4], table[persons, 4]
        shapes = {name: values.shape for name, values in outputs.items()}
        raise DataError(
            self._network.path,
            f"its outputs are not understood: {written_shapes(shapes)}",
            "expected boxes with scores, [1,N,5] and labels [1,N], or [N,6], or"
            f" YOLOX's [1,{len(self._grid)},5+C]",
        )


def distinct(boxes: Float, score: Float) -> NDArray[np.intp]:
    """Return row numbers of boxes [N, 4], best first, without those that overlap a better one (greedy)."""
    size = np.maximum(boxes[:, 2:] - boxes[:, :2], 0.0)
    area = size[:, 0] * size[:, 1]
    left = np.argsort(-score, kind="stable")
    kept = []
    while len(left):
        best, rest = left[0], left[1:]
        kept.append(best)
        low = np.maximum(boxes[best, :2], boxes[rest, :2])
        high = np.minimum(boxes[best, 2:], boxes[rest, 2:])
        common = np.prod(np.maximum(high - low, 0.0), axis=1)
        left = rest[common <= _SAME_PERSON * (area[best] + area[rest] - common)]
    return np.array(kept, dtype=np.intp)


def _grid(width: int, height: int) -> Float:
    """Return column, row and stride [G, 3] of the cells to which YOLOX's rows belong."""
    levels = []
    for stride in _STRIDES:
        x, y = np.meshgrid(np.arange(width // stride), np.arange(height // stride))
        levels.append(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, stride)]))
    return np.concatenate(levels).astype(np.float64)


def _raw_yolox(table: Float, grid: Float) -> tuple[Float, Float]:
    """Decode raw YOLOX rows [G, 5 + C]: centre, log size, objectness and class probabilities.

    Ge et al., "YOLOX: Exceeding YOLO Series in 2021", the authors' `demo_postprocess`.
    """
    stride = grid[:, 2:]
    centre = (table[:, :2] + grid[:, :2]) * stride
    half = np.exp(np.minimum(table[:, 2:4], 20.0)) * stride / 2
    is_person = table[:, 5:].argmax(axis=1) == _PERSON
    return np.hstack([centre - half, centre + half]), np.where(is_person, table[:, 4] * table[:, 5], 0.0)
