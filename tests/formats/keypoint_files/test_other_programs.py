"""Keypoints of EasyMocap, Ultralytics, DeepLabCut and SLEAP: small files after the public descriptions."""

import json
from pathlib import Path

import numpy as np
import pytest

from pipelines.session.people import get_skeleton
from pipelines.session.recognition import recognise
from pipelines.session.records import Detections
from pipelines.session.registries import KeypointFormat
from tests.raising import refused
from tests.real_data import real_data

JOINTS = ("nose", "left_shoulder", "right_shoulder", "left_hip", "right_hip", "left_knee", "right_knee")
DLC_NAMES = ("nose", "leftShoulder", "right shoulder", "LHip", "hip_R", "left_knee", "rKnee", "tail_base")


def read(path: Path, name: str, **options: int) -> Detections:
    found = recognise(path, KeypointFormat, "keypoint file")
    assert found.name == name
    return found.read_keypoints(path, skeleton=None, first_frame=options.get("first_frame", 0))


def at(found: Detections, row: int, joint: str) -> list[float]:
    k = found.joints.index(joint)
    return [*found.xy[row, k].tolist(), float(found.confidence[row, k])]


def easymocap(folder: Path) -> Path:
    """Write the annotations of three pictures, with a person in two of them."""
    people = [{"personID": 3, "bbox": [0, 0, 9, 9, 1], "keypoints": [[k, 2 * k, 0.5] for k in range(1, 26)]}]
    for frame, annots in ((0, people), (1, []), (2, people[:1])):
        content = {"filename": f"images/a/{frame:06d}.jpg", "height": 720, "width": 1280, "annots": annots}
        (folder / f"{frame:06d}.json").write_text(json.dumps(content))
    return folder


def test_easymocap(tmp_path: Path) -> None:
    found = read(easymocap(tmp_path), "easymocap_keypoints")
    assert (found.frame.tolist(), found.person.tolist()) == ([0, 2], [3, 3])
    assert (found.joints, found.image_size) == (get_skeleton("body25").joints, (1280, 720))
    assert found.frames_listed.tolist() == [0, 1, 2]
    assert at(found, 1, "right_shoulder") == [3, 6, 0.5]


def test_easymocap_of_a_real_recording() -> None:
    found = read(real_data("third/pose/16-easymocap/annots/cam02"), "easymocap_keypoints")
    assert found.frames_listed.tolist() == [0, 1, 2, 3, 4]
    assert found.image_size == (1088, 1920)


def person(x: float, **more: object) -> dict[str, object]:
    points = {"x": [x + k for k in range(17)], "y": [10.0 * k for k in range(17)], "visible": [0.75] * 17}
    box = {"x1": 0, "y1": 0, "x2": 9, "y2": 9}
    return {"name": "person", "class": 0, "confidence": 0.9, "box": box, "keypoints": points, **more}


PICTURES = [[person(1, track_id=7), person(100, track_id=4)], [], [person(3, track_id=7)]]


@pytest.mark.parametrize("whole", [True, False])
def test_ultralytics_in_one_file_or_in_one_for_each_picture(tmp_path: Path, whole: bool) -> None:
    path = tmp_path
    for k, picture in enumerate([] if whole else PICTURES):
        (path / f"clip_{k + 10}.json").write_text(json.dumps(picture))
    if whole:
        path = tmp_path / "results.json"
        path.write_text(json.dumps(PICTURES))
    found = read(path, "ultralytics", first_frame=0 if whole else 10)
    assert (found.frame.tolist(), found.person.tolist()) == ([0, 0, 2], [4, 7, 7])
    assert found.frames_listed.tolist() == [0, 1, 2]
    assert at(found, 2, "left_hip") == [3 + 11, 110, 0.75]


def deeplabcut(path: Path, *, individuals: bool, broken: bool = False) -> Path:
    """Write two frames of the table that DeepLabCut's analyze_videos makes; `wolf` is seen once."""
    who = ("dog", "wolf") if individuals else ("",)
    names = [(one, part, axis) for one in who for part in DLC_NAMES for axis in ("x", "y", "likelihood")]
    lines = [["scorer", *["net"] * len(names)]]
    if individuals:
        lines.append(["individuals", *[one for one, _, _ in names]])
    lines += [["bodyparts", *[part for _, part, _ in names]], ["coords", *[axis for _, _, axis in names]]]
    for frame in (0, 1):
        cells = [
            ""
            if one == "wolf" and frame
            else str({"x": 10.0 + k, "y": 20.0 + frame, "likelihood": 0.5}[axis])
            for k, (one, _, axis) in enumerate(names)
        ]
        lines.append([str(frame), *cells])
    text = "\n".join(map(",".join, lines)) + "\n"
    path.write_text(text[:-30] if broken else text)
    return path


def test_deeplabcut_of_one_and_of_several(tmp_path: Path) -> None:
    found = read(deeplabcut(tmp_path / "a.csv", individuals=False), "deeplabcut")
    assert found.joints == get_skeleton("coco17").joints
    assert set(found.joints) - {j for k, j in enumerate(found.joints) if np.isfinite(found.xy[0, k, 0])} == {
        *get_skeleton("coco17").joints
    } - {*JOINTS}
    assert [at(found, row, "right_knee") for row in (0, 1)] == [[28, 20, 0.5], [28, 21, 0.5]]
    assert sum(found.dropped.values()) == 2  # the tail, in two frames
    found = read(deeplabcut(tmp_path / "b.csv", individuals=True), "deeplabcut")
    assert (found.frame.tolist(), found.person.tolist()) == ([0, 0, 1], [0, 1, 0])
    found = read(deeplabcut(tmp_path / "c.csv", individuals=False, broken=True), "deeplabcut")
    assert found.frame.tolist() == [0]


def test_deeplabcut_labels_of_a_mouse_and_hdf5_are_refused(tmp_path: Path) -> None:
    path = deeplabcut(tmp_path / "a.csv", individuals=False)
    path.write_text(path.read_text().replace("Knee", "Paw").replace("knee", "ear tip").replace("ip,", "x,"))
    with refused("unsupported", path):
        read(path, "deeplabcut")
    (tmp_path / "a.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(50))
    with refused("wrong-kind", tmp_path / "a.h5", "DeepLabCut"):
        read(tmp_path / "a.h5", "deeplabcut")


def sleap() -> str:
    """Return the analysis of two tracks in two frames; the left shoulder was not found."""
    cells = [f"{part}.{axis}" for part in JOINTS for axis in ("x", "y", "score")]
    lines = [["track", "frame_idx", "instance.score", *cells]]
    for track, frame in (("one", 4), ("two", 4), ("one", 5)):
        values = [str(value) for k in range(len(JOINTS)) for value in (k + frame, 2.0, 0.25)]
        values[3:6] = ["", "", ""]
        lines.append([track, str(frame), "0.9", *values])
    return "\n".join(map(",".join, lines)) + "\n"


def test_sleap(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(sleap())
    found = read(tmp_path / "a.csv", "sleap")
    assert (found.frame.tolist(), found.person.tolist()) == ([4, 4, 5], [0, 1, 0])
    assert at(found, 2, "left_hip") == [8, 2, 0.25]
    assert np.isnan(found.xy[:, found.joints.index("left_shoulder")]).all()


def caliscope() -> str:
    """Return three pictures of one camera; in the first the points up to number 8 were not found."""
    head = "sync_index,port,frame_index,frame_time,point_id,img_loc_x,img_loc_y"
    rows = [f"{k + 3},2,{k},,{j},{j + 10 * k},{j}" for k in range(3) for j in range(0 if k else 9, 26)]
    return "\n".join([head, *rows])


def test_caliscope_of_one_camera(tmp_path: Path) -> None:
    path = tmp_path / "xy_HALPE26.csv"
    path.write_text(caliscope())
    found = read(path, "caliscope_keypoints")
    assert (found.joints, found.frame.tolist()) == (get_skeleton("halpe26").joints, [0, 1, 2])
    assert at(found, 2, "right_shoulder") == [26, 6, 1]
    path.write_text(caliscope().replace("\n4,2,", "\n4,1,"))
    with refused("ambiguous", path):
        read(path, "caliscope_keypoints")
