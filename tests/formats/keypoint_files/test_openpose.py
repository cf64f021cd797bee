"""OpenPose folders: the real recordings, and small ones with every special case of the format."""

import json
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.keypoint_files.result_files import OPENPOSE as FORMAT
from pipelines.session.people import take_joints
from pipelines.session.recognition import recognise
from pipelines.session.registries import KeypointFormat
from tests.raising import refused
from tests.real_data import facts, real_data

KIND = "keypoint file"


def person(x: float = 10.0, count: int = 17, track: int = -1) -> dict[str, object]:
    keypoints = [value for joint in range(count) for value in (x + joint, 20.0, 0.5)]
    return {"person_id": [track], "pose_keypoints_2d": keypoints}


def frame_file(folder: Path, name: str, *people: object) -> None:
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(json.dumps({"version": 1.3, "people": people}))


def test_the_real_gait_recording_holds_what_is_known_of_it() -> None:
    folder = real_data("keypoints/openpose_gait")
    told = facts("keypoints/openpose_gait")
    found = FORMAT.read_keypoints(folder, skeleton=None, first_frame=0)
    assert found.frames_listed.tolist() == list(range(told["frames"]))
    assert len(found.frame) == told["people_total"]
    assert len(set(found.frame.tolist())) == told["frames"] - told["frames_without_people"]
    assert found.person.max() + 1 == told["max_people"]
    assert found.joints[1] == "neck"
    assert found.joints[8] == "hip"
    assert [*found.xy[0, 0], found.confidence[0, 0]] == told["first_keypoint"]
    box = told["xy_bbox_conf_gt_0"]
    np.testing.assert_allclose(np.nanmin(found.xy, axis=(0, 1)), box["min"], atol=0.005)
    np.testing.assert_allclose(np.nanmax(found.xy, axis=(0, 1)), box["max"], atol=0.005)
    assert (np.isnan(found.xy[..., 0]) == (found.confidence == 0)).all()
    assert recognise(folder, KeypointFormat, KIND).name == "openpose"


@pytest.mark.parametrize("camera", ["cam01", "cam02", "cam03", "cam04"])
@pytest.mark.parametrize("kind", ["pose", "pose-associated"])
def test_the_real_four_camera_recording_is_recognised_as_body25b(camera: str, kind: str) -> None:
    folder = real_data(f"pose2sim_single/{kind}/{camera}_json")
    found = FORMAT.read_keypoints(folder, skeleton=None, first_frame=0)
    stated = FORMAT.read_keypoints(folder, skeleton="body25b", first_frame=0)
    assert found.joints == stated.joints
    assert found.frames_listed.tolist() == list(range(100))
    assert recognise(folder, KeypointFormat, KIND).name == "openpose"
    assert FORMAT.describe(folder)["skeleton"] == "body25b (25 keypoints)"
    # An upright person: in the median frame the head is above the neck, and the ankles below the knees.
    order = ("head", "neck", "left_hip", "left_knee", "left_ankle")
    first_person = take_joints(found.xy[found.person == 0], found.joints, order)
    assert np.all(np.diff(np.nanmedian(first_person[..., 1], axis=0)) > 0)


def test_places_frames_and_missing_joints(tmp_path: Path) -> None:
    folder = tmp_path / "cam1"
    unseen = person()
    unseen["pose_keypoints_2d"] = [0.0] * 51
    partly = person(x=50.0)
    partly["pose_keypoints_2d"][3:6] = [0, 0, 0]  # type: ignore[index]  # a list by construction above
    frame_file(folder, "video1_000000000007_keypoints.json", {}, person(x=30.0))
    frame_file(folder, "video1_000000000005_keypoints.json", partly, unseen)
    frame_file(folder, "video1_000000000006_keypoints.json")
    found = FORMAT.read_keypoints(folder, skeleton=None, first_frame=5)
    assert found.frame.tolist() == [0, 2]
    assert found.person.tolist() == [0, 1]
    assert found.frames_listed.tolist() == [0, 1, 2]
    assert np.isnan(found.xy[0, 1]).all()
    assert found.confidence[0, 1] == 0
    assert found.xy[1, 0].tolist() == [30.0, 20.0]
    assert list(found.dropped.values()) == [1]


def test_damaged_files_among_many_are_left_out_and_counted(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    for frame in range(4):
        frame_file(folder, f"cam.{frame:04}.json", person())
    (folder / "cam.0004.json").write_text('{"version": 1.3, "peop')
    (folder / "cam.0005.json").write_text("")
    (folder / "settings.json").write_text("{}")
    (folder / "cam.0006.json").write_text("[1, 2]")
    assert FORMAT.recognises(folder)
    found = FORMAT.read_keypoints(folder, skeleton=None, first_frame=0)
    assert found.frames_listed.tolist() == [0, 1, 2, 3]
    assert sorted(found.dropped.values()) == [2, 2]  # no list of people, unreadable


def test_bad_folders_are_one_clear_line(tmp_path: Path) -> None:
    def read(name: str) -> None:
        FORMAT.read_keypoints(tmp_path / name, skeleton=None, first_frame=0)

    (tmp_path / "empty").mkdir()
    with refused("data", tmp_path / "empty", "JSON"):
        read("empty")
    assert not FORMAT.recognises(tmp_path / "empty")
    frame_file(tmp_path / "two", "cam1.0001.json", person())
    frame_file(tmp_path / "two", "cam2.0001.json", person())
    with refused("data", tmp_path / "two", "'cam1.0001'", "'cam2.0001'", 1):
        read("two")
    frame_file(tmp_path / "mixed", "cam.0001.json", person())
    frame_file(tmp_path / "mixed", "cam.0002.json", person(count=25))
    with refused("data", f"{tmp_path / 'mixed' / 'cam.0002.json'}, people [0]", 25, 17):
        read("mixed")
    with refused("no-such-file", tmp_path / "absent"):
        read("absent")


def test_the_coco_model_and_the_key_of_its_time(tmp_path: Path) -> None:
    old = person(count=18)
    old["pose_keypoints"] = old.pop("pose_keypoints_2d")
    frame_file(tmp_path / "a", "a_0.json", old)
    found = FORMAT.read_keypoints(tmp_path / "a", skeleton=None, first_frame=0)
    assert (found.joints[1], found.joints[2], found.joints[-1]) == ("neck", "right_shoulder", "left_ear")
    assert found.xy[0, 17].tolist() == [27.0, 20.0]
