"""COCO keypoint results and annotations: the real files, and small ones."""

import json
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.keypoint_files.result_files import COCO as FORMAT
from pipelines.session.errors import DataError
from pipelines.session.people import get_skeleton
from pipelines.session.recognition import recognise
from pipelines.session.registries import KeypointFormat
from tests.raising import refused
from tests.real_data import facts, real_data

KIND = "keypoint file"


def result(image: object, x: float = 10.0, count: int = 17) -> dict[str, object]:
    keypoints = [value for joint in range(count) for value in (x + joint, 20.0, 0.5)]
    return {"image_id": image, "category_id": 1, "keypoints": keypoints, "score": 0.9}


def dataset(**changes: object) -> dict[str, object]:
    keypoints = [0, 0, 0, 7, 8, 0, 1, 2, 1, *[5, 6, 2] * 14]
    content: dict[str, object] = {
        "images": [
            {"id": 100, "file_name": "cam1/0002.jpg", "width": 640, "height": 480},
            {"id": 200, "file_name": "cam1/0004.jpg", "width": 640, "height": 480},
        ],
        "annotations": [{"id": 1, "image_id": 100, "category_id": 1, "keypoints": keypoints}],
        "categories": [{"id": 1, "name": "person", "keypoints": list(get_skeleton("coco17").joints)}],
    }
    return content | changes


def written(folder: Path, content: object) -> Path:
    path = folder / "results.json"
    path.write_text(json.dumps(content))
    return path


def test_the_real_annotations_hold_what_is_known_of_them() -> None:
    path = real_data("keypoints/coco_gt_mmpose_test_coco.json")
    told = facts("keypoints/coco_gt_mmpose_test_coco.json")
    assert recognise(path, KeypointFormat, KIND).name == "coco"
    found = FORMAT.read_keypoints(path, skeleton=None, first_frame=0)
    assert len(found.frame) == told["with_keypoints"]
    assert list(found.dropped.values()) == [told["annotations"] - told["with_keypoints"]]
    assert found.frames_listed.tolist() == [int(Path(name).stem) for name in told["file_names"]]
    assert len(found.joints) == told["category_keypoints"]
    assert set(np.unique(found.confidence)) <= {0.0, 0.5, 1.0}
    # The first annotation: nose (367, 81, visible) in picture 785.
    assert found.frame[0] == 785
    assert found.xy[0, 0].tolist() == [367, 81]
    assert found.image_size is None  # four pictures of four sizes


def test_the_real_detections_are_refused_as_boxes_only() -> None:
    path = real_data("keypoints/coco_det_mmpose_AP_H_56.json")
    reader = recognise(path, KeypointFormat, KIND)
    with refused("no-keypoints", path, 118):
        reader.read_keypoints(path, skeleton=None, first_frame=0)


def test_results_by_number_or_name(tmp_path: Path) -> None:
    path = written(tmp_path, [result(12, x=1.0), result("frame_9", x=2.0), result(12.0, x=3.0)])
    found = FORMAT.read_keypoints(path, skeleton="coco17", first_frame=9)
    assert found.frame.tolist() == [0, 3, 3]
    assert found.person.tolist() == [0, 0, 1]
    assert found.xy[:, 0, 0].tolist() == [2.0, 1.0, 3.0]


def test_annotations_give_visibility_size_and_frames(tmp_path: Path) -> None:
    found = FORMAT.read_keypoints(written(tmp_path, dataset()), skeleton=None, first_frame=0)
    assert found.frames_listed.tolist() == [2, 4]
    assert found.frame.tolist() == [2]
    assert found.image_size == (640, 480)
    assert np.isnan(found.xy[0, :2]).all()
    assert found.confidence[0, :4].tolist() == [0, 0, 0.5, 1]


@pytest.mark.parametrize(
    "content",
    [
        [],
        dataset(annotations=[{"image_id": 100, "bbox": [1, 2, 3, 4]}]),
        dataset(annotations=[{"image_id": 300, "keypoints": [1, 2, 2] * 17}]),
        dataset(images=None),
    ],
)
def test_bad_content_is_one_clear_line(tmp_path: Path, content: object) -> None:
    path = written(tmp_path, content)
    assert FORMAT.recognises(path)
    with pytest.raises(DataError):
        FORMAT.read_keypoints(path, skeleton=None, first_frame=0)
