"""Boxes of person detectors, in each form in which they are exported."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.keypoints.onnx_network import OnnxNetwork
from pipelines.keypoints.onnx_pose import DETECTOR, OnnxPeople
from tests.keypoints.onnx_graphs import constant_model, heatmap_model

SIZE = (320, 320)
BOX, BESIDE, CAR = (40.0, 30.0, 80.0, 130.0), (200.0, 30.0, 240.0, 130.0), (100.0, 100.0, 200.0, 150.0)
PICTURE = np.zeros((720, 1280, 3), np.uint8)  # 4 of its pixels for one of the input

Outputs = dict[str, NDArray[np.float32] | NDArray[np.int64]]


def with_labels() -> Outputs:
    """Return outputs of RTMDet, and of YOLOX as MMDeploy exports it."""
    boxes = [(*BESIDE, 0.6), (*BOX, 0.9), (*CAR, 0.95), (0, 0, 9, 9, 0.1)]
    return {"dets": np.array([boxes], np.float32), "labels": np.array([[0, 0, 2, 0]], np.int64)}


def with_classes() -> Outputs:
    boxes = [(*BOX, 0.9, 0), (*CAR, 0.95, 2), (*BESIDE, 0.6, 0)]
    return {"output": np.array(boxes, np.float32)}


def alone() -> Outputs:
    return {"dets": np.array([(*BOX, 0.9), (*BESIDE, 0.6)], np.float32)}


def raw_yolox() -> Outputs:
    """Encode the same boxes in the cells of stride 8 and 16 around their centres; each twice."""
    table = np.zeros((1, 40 * 40 + 20 * 20 + 10 * 10, 7), np.float32)
    for (left, top, right, bottom), score, kind in ((BOX, 0.9, 0), (BESIDE, 0.6, 0), (CAR, 0.95, 1)):
        x, y = (left + right) / 2, (top + bottom) / 2
        for stride, first, worse in ((8, 0, 0.0), (16, 1600, 0.1)):
            column, row = int(x // stride), int(y // stride)
            place = x / stride - column, y / stride - row
            size = np.log((right - left) / stride), np.log((bottom - top) / stride)
            classes = (1.0, 0.0) if kind == 0 else (0.0, 1.0)
            table[0, first + row * (320 // stride) + column] = (*place, *size, score - worse, *classes)
    return {"output": table}


@pytest.mark.parametrize("outputs", [with_labels, with_classes, alone, raw_yolox])
def test_persons_of_every_export_come_best_first(tmp_path: Path, outputs: object) -> None:
    assert callable(outputs)
    boxes, score = people(constant_model(tmp_path / "m.onnx", SIZE, outputs())).find(PICTURE)
    # Edges of the input's pixels times 4, counted from the centre of the first pixel; float32 in between.
    np.testing.assert_allclose(boxes, 4 * np.array([BOX, BESIDE]) - 0.5, atol=1e-3)
    np.testing.assert_allclose(score, [0.9, 0.6], atol=1e-6)


def test_the_picture_is_fitted_into_the_top_left(tmp_path: Path) -> None:
    class Seen(OnnxNetwork):
        def single(self, rgb: NDArray[np.uint8]) -> Outputs:
            self.seen = rgb
            return super().single(rgb)

    finder = people(constant_model(tmp_path / "m.onnx", SIZE, alone()), Seen)
    picture = PICTURE.copy()
    picture[400:404, 800:804] = (10, 20, 30)
    finder.find(picture)
    seen = finder._network.seen  # type: ignore[attr-defined]
    assert seen[100, 200].tolist() == [30, 20, 10]
    assert not seen[:180].sum() - 60
    assert (seen[180:] == 114).all()


def test_boxes_become_regions_with_the_aspect_of_the_pose_model(tmp_path: Path) -> None:
    pose = heatmap_model(tmp_path / "pose.onnx", size=(96, 128))
    finder = constant_model(tmp_path / "p.onnx", SIZE, alone())
    networks = DETECTOR.configured(f"{pose},people={finder}").load(threads=1)
    (region, score), _ = networks.find_people(PICTURE)
    assert score == pytest.approx(0.9)
    np.testing.assert_allclose(region.centre, (4 * 60 - 0.5, 4 * 80 - 0.5), atol=1e-3)
    assert region.side == pytest.approx(1.25 * 4 * 100)  # 160 wide would do for 40: the height decides
    wide = constant_model(tmp_path / "w.onnx", SIZE, {"dets": np.array([(*CAR, 0.9)], np.float32)})
    networks = DETECTOR.configured(f"{pose},people={wide}").load(threads=1)
    ((region, _),) = networks.find_people(PICTURE)
    assert region.side == pytest.approx(1.25 * 4 * 100 * 128 / 96)


def people(path: Path, kind: type[OnnxNetwork] = OnnxNetwork) -> OnnxPeople:
    options = DETECTOR.configured(str(path)).options
    return OnnxPeople(kind(path, options.people_colours, provider="cpu", threads=1))
