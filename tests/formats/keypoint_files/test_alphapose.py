"""AlphaPose results: the real file, and small ones with every special case of the format."""

import json
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.keypoint_files.result_files import ALPHAPOSE as FORMAT
from pipelines.session.registries import FORMATS
from tests.real_data import facts, real_data


def entry(picture: object, idx: object = 0.0, x: float = 10.0, count: int = 17) -> dict[str, object]:
    keypoints = [value for joint in range(count) for value in (x + joint, 20.0, 0.5)]
    return {"image_id": picture, "keypoints": keypoints, "score": 2.5, "box": [0, 0, 1, 1], "idx": idx}


def written(folder: Path, content: object) -> Path:
    path = folder / "alphapose-results.json"
    path.write_text(json.dumps(content))
    return path


def test_the_real_file_holds_what_is_known_of_it() -> None:
    path = real_data("keypoints/alphapose_halpe26_video.json")
    told = facts("keypoints/alphapose_halpe26_video.json")
    found = FORMAT.read_keypoints(path, skeleton=None, first_frame=0)
    assert len(found.frame) == told["entries"]
    assert len(found.frames_listed) == told["images"]
    assert len(found.joints) == told["keypoints"][0]
    assert np.unique(found.frame, return_counts=True)[1].max() == told["max_persons_per_image"]
    np.testing.assert_allclose([*found.xy[0, 0], found.confidence[0, 0]], told["first_keypoint"], atol=5e-4)
    np.testing.assert_allclose(np.nanmin(found.xy, axis=(0, 1)), told["xy_bbox"]["min"], atol=0.005)
    np.testing.assert_allclose(np.nanmax(found.xy, axis=(0, 1)), told["xy_bbox"]["max"], atol=0.005)
    confidence = np.concatenate([entry["keypoints"][2::3] for entry in json.loads(path.read_text())])
    assert confidence.max() == pytest.approx(told["conf_range"][1], abs=5e-4)
    assert told["conf_range"][1] > 1  # AlphaPose's heatmaps slightly exceed 1
    assert found.confidence.max() == 1
    assert list(found.adjusted.values()) == [np.count_nonzero(confidence > 1)]
    # Everybody's idx is 0 (no tracker). The second person of a frame must not count as a repeat of the first.
    assert found.dropped == {}
    assert sorted(set(found.person.tolist())) == [0, 1]


@pytest.mark.parametrize(("people", "keypoints"), [("bodies", "joints"), ("people", "pose_keypoints_2d")])
def test_the_formats_cmu_and_open(tmp_path: Path, people: str, keypoints: str) -> None:
    content = {
        f"{k}.jpg": {
            "version": "AlphaPose v0.3",
            people: [{keypoints: entry("", x=x, count=18)["keypoints"]}],
        }
        for k, x in ((7, 1.0), (9, 2.0))
    }
    path = written(tmp_path, content)
    assert [f.name for f in FORMATS.all() if f.recognises(path)] == ["alphapose"]
    found = FORMAT.read_keypoints(path, skeleton=None, first_frame=0)
    assert (found.frame.tolist(), found.xy[:, 0, 0].tolist()) == ([7, 9], [1.0, 2.0])
    assert found.joints[1] == "neck"


def test_two_people_under_one_id_are_two_people(tmp_path: Path) -> None:
    path = written(
        tmp_path, [entry("1.jpg", 4), entry("1.jpg", 4, x=500.0), entry("2.jpg", 4), entry("2.jpg", 5)]
    )
    found = FORMAT.read_keypoints(path, skeleton=None, first_frame=0)
    assert found.frame.tolist() == [1, 1, 2, 2]
    assert found.person.tolist() == [4, 6, 4, 5]
    assert (found.dropped, list(found.adjusted.values())) == ({}, [1])
