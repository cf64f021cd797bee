"""MMPose predictions in each form that its inferencer and demos save."""

import json
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.keypoint_files.result_files import MMPOSE as FORMAT
from pipelines.session.people import get_skeleton
from pipelines.session.recognition import recognise
from pipelines.session.registries import FORMATS, KeypointFormat
from tests.raising import refused
from tests.real_data import real_data

KIND = "keypoint file"

HALPE = get_skeleton("halpe26").joints


def instance(x: float = 10.0, count: int = 17) -> dict[str, object]:
    return {
        "keypoints": [[x + joint, 20.0] for joint in range(count)],
        "keypoint_scores": [0.5] * count,
        "bbox": [[0, 0, 100, 200]],
        "bbox_score": 0.9,
    }


def video(*people_of_frames: list[dict[str, object]], first: int = 0) -> list[dict[str, object]]:
    return [{"frame_id": first + k, "instances": people} for k, people in enumerate(people_of_frames)]


def written(path: Path, content: object) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def test_a_video(tmp_path: Path) -> None:
    path = written(tmp_path / "walk.json", video([instance(1.0), instance(2.0)], [], [instance(3.0)]))
    assert recognise(path, KeypointFormat, KIND).name == "mmpose"
    found = FORMAT.read_keypoints(path, skeleton=None, first_frame=0)
    assert found.joints == get_skeleton("coco17").joints
    assert found.frame.tolist() == [0, 0, 2]
    assert found.person.tolist() == [0, 1, 0]
    assert found.xy[:, 0, 0].tolist() == [1.0, 2.0, 3.0]
    assert found.frames_listed.tolist() == [0, 1, 2]
    assert (found.confidence == 0.5).all()


def test_a_demo_counts_from_one_and_names_its_joints(tmp_path: Path) -> None:
    meta = {"keypoint_id2name": {str(index): joint for index, joint in enumerate(HALPE)}}
    content = {"meta_info": meta, "instance_info": video([instance(count=26)], [instance(count=26)], first=1)}
    path = written(tmp_path / "results_walk.json", content)
    assert recognise(path, KeypointFormat, KIND).name == "mmpose"
    found = FORMAT.read_keypoints(path, skeleton=None, first_frame=1)
    assert found.joints == HALPE
    assert found.frame.tolist() == [0, 1]
    other = {"keypoint_id2name": {str(index): f"h36m_{index}" for index in range(26)}}
    path = written(tmp_path / "other.json", content | {"meta_info": other})
    with refused("data", path, 26, "h36m_0"):
        FORMAT.read_keypoints(path, skeleton=None, first_frame=0)


def test_a_real_picture_is_frame_0() -> None:
    """The inferencer's file of one picture is a list of people, and its name holds no number."""
    path = real_data("second/mmpose_demo_image.json")
    stated = json.loads(path.read_text())
    found = FORMAT.read_keypoints(path, skeleton=None, first_frame=0)
    assert found.frame.tolist() == [0] * len(stated)
    assert found.joints == get_skeleton("coco17").joints
    np.testing.assert_array_equal(found.xy, [person["keypoints"] for person in stated])


@pytest.mark.parametrize(
    "relative",
    [
        "keypoints/alphapose_halpe26_video.json",
        "keypoints/openpose_gait",
        "keypoints/coco_det_mmpose_AP_H_56.json",
        "keypoints/coco_gt_mmpose_test_coco.json",
        "facts.json",
        "calib",
        "pose2sim_single",
    ],
)
def test_real_files_are_of_one_keypoint_format_at_most(relative: str) -> None:
    path = real_data(relative)
    names = ("alphapose", "coco", "mmpose", "openpose")
    matches = [name for name in names if FORMATS.get(name).recognises(path)]
    assert len(matches) == relative.startswith("keypoints/")
    assert "mmpose" not in matches
