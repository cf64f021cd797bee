"""Times and numbers in drafted manifests, from descriptions alone."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from pipelines.drafting.found import (
    Calibration,
    Findings,
    Joints,
    Keypoints,
    Lens,
    Map,
    Poses,
    Recording,
    Span,
    TopicFound,
    Video,
)
from pipelines.drafting.manifest_text import ManifestText, write_manifest
from pipelines.drafting.matching import match

SECOND = 10**9
EPOCH_NS = 1_700_000_000 * SECOND


def about(name: str, format_: str = "x") -> tuple[Path, tuple[str, ...], str, str]:
    return Path("/flight") / name, (Path(name).stem,), format_, f"title of {format_}"


def keypoints(first: int, last: int, name: str = "drone1.json") -> Keypoints:
    return Keypoints(*about(name), last - first + 1, first, last)


def video(frames: int, length_s: int = 10) -> Video:
    return Video(*about("drone1.mp4"), frames, length_s * SECOND)


def poses(first_ns: int, last_ns: int) -> Poses:
    return Poses(*about("drone1.tum", "tum"), Span(first_ns, last_ns))


def written(findings: Findings) -> tuple[ManifestText, dict[str, Any]]:
    text = write_manifest(match(findings), "flight", lambda path: path.name)
    return text, YAML(typ="safe", pure=True).load(text.text)


@pytest.mark.parametrize(
    ("listed", "frames", "expected"),
    [
        ((0, 99), 100, None),
        ((1, 100), 100, 1),  # counted from 1: the last would lie beyond the video
        ((1, 99), 100, None),
        ((7, 42), None, None),  # a detector that found no person before
        ((785, 884), None, 785),  # more frames before the first than after it
        ((0, 400), 100, None),  # another video's: no first frame mends that
    ],
)
def test_first_frame_is_stated_where_the_numbers_cannot_count_from_0(
    listed: tuple[int, int], frames: int | None, expected: int | None
) -> None:
    videos = [] if frames is None else [video(frames)]
    text, stated = written(Findings([keypoints(*listed), *videos]))
    said = stated["cameras"]["drone1"]["keypoints"]
    assert (said["first_frame"] if isinstance(said, dict) else None) == expected
    assert any("first_frame" in remark for remark in text.assumed) == (expected is not None)


def test_a_video_that_the_poses_outlast_needs_no_start() -> None:
    text, stated = written(Findings([video(300), poses(-SECOND, 20 * SECOND)]))
    assert "frame_times" not in stated["cameras"]["drone1"]
    assert not text.assumed


def test_a_video_that_counts_from_elsewhere_starts_with_the_first_pose_rounded_up() -> None:
    first_ns = EPOCH_NS + 123_456_789
    text, stated = written(Findings([video(300), poses(first_ns, first_ns + 20 * SECOND)]))
    assert stated["cameras"]["drone1"]["frame_times"] == {"start": 1700000000.124, "assumed": True}
    [remark] = text.assumed
    assert remark.startswith("drone1: frame_times: start,")


@pytest.mark.parametrize(
    ("name", "format_", "axes"),
    [
        ("truth.csv", "joints_csv", "metres, z up"),
        ("truth.c3d", "c3d", "as it says"),
        ("truth.bvh", "bvh", "y up"),
    ],
)
def test_the_axes_of_true_joints_are_told_as_they_are_read(name: str, format_: str, axes: str) -> None:
    truth = Joints(*about(name, format_), Span(0, SECOND))
    text, stated = written(Findings([keypoints(0, 9), poses(0, SECOND), truth]))
    assert stated["truth"] == {"joints": name}
    assert f"{axes}; where it is not so" in text.text


def test_truth_of_another_time_is_told_but_not_stated() -> None:
    truth = Joints(*about("truth.csv"), Span(0, 10 * SECOND))
    findings = Findings([keypoints(0, 9), poses(EPOCH_NS, EPOCH_NS + SECOND), truth])
    text, stated = written(findings)
    assert "truth" not in stated
    assert "truth: {joints: {path: truth.csv, offset_s: 0}}" in text.text
    assert stated["cameras"]["drone1"]["frame_times"] == {
        "start": 1700000000,
        "fps": 30,
        "assumed": True,
    }


def test_a_camera_of_a_calibration_is_named_where_its_name_is_another() -> None:
    calibration = Calibration(*about("calib.toml"), {"cam_1": Lens(True, True), "cam_2": Lens(True, True)})
    findings = Findings([keypoints(0, 9), keypoints(0, 9, "cam_2.json"), calibration])
    _, stated = written(findings)
    assert stated["cameras"]["drone1"]["pose"] == {"static": {"path": "calib.toml", "camera": "cam_1"}}
    assert stated["cameras"]["cam_2"]["intrinsics"] == "calib.toml"


def test_keypoints_of_several_formats_state_one() -> None:
    two = Keypoints(*about("drone1.json", "coco"), 10, 0, 9, ambiguous=True)
    text, stated = written(Findings([two]))
    assert stated["cameras"]["drone1"]["keypoints"] == {
        "path": "drone1.json",
        "format": "coco",
        "assumed": True,
    }
    assert any(r.startswith("drone1: keypoints: ") and r.endswith(" coco's") for r in text.assumed)


def test_poses_logged_at_another_time_than_the_pictures_are_missing() -> None:
    def topic(name: str, kind: Any, first_s: int) -> TopicFound:
        return TopicFound(name, f"x/msg/{kind}", kind, 9, Span(first_s * SECOND, (first_s + 9) * SECOND))

    log = Recording(
        *about("d1.mcap"),
        (Path("/flight/d1.mcap"),),
        (topic("/drone1/image", "pictures", 0), topic("/drone1/odometry", "poses", 100)),
    )
    text, _ = written(Findings([log]))
    assert any(remark.startswith("drone1: pose: ") for remark in text.missing)
    assert "9 s from 0.000" in text.text, "the times of the film stand beside the poses"


def test_one_map_is_stated_and_the_others_are_told() -> None:
    text, stated = written(Findings([video(9), Map(*about("a.bt")), Map(*about("b.pcd"))]))
    assert stated["map"] == "a.bt"
    assert re.search(r"^# .* map: b\.pcd  # ", text.text, re.MULTILINE)


def test_without_a_camera_a_template_stands_in_a_comment() -> None:
    text, stated = written(Findings([Map(*about("a.bt"))]))
    assert "cameras" not in stated
    [remark] = text.missing
    assert remark.startswith("cameras: ")
    assert "#     pose: {tum: drone1.tum}" in text.text


def test_topics_of_a_log_that_has_no_place_are_named() -> None:
    truth = TopicFound("/ground_truth", "nav_msgs/msg/Odometry", "poses", 5, Span(0, SECOND))
    empty = TopicFound("/odometry", "nav_msgs/msg/Odometry", "poses", 0, Span(0, 0))
    log = Recording(*about("site.bag"), (Path("/flight/site.bag"),), (truth, empty))
    text, _ = written(Findings([log]))
    [line] = [line for line in text.text.splitlines() if "site.bag" in line]
    assert line.startswith("# ")
    assert line.endswith(" /ground_truth)")


def test_many_cameras_are_told_in_short() -> None:
    text, _ = written(Findings([*[keypoints(0, 9, f"cam{k}.json") for k in range(9)]]))
    assert any(remark.startswith("cam0, cam1, cam2, cam3, cam4, ...: pose: ") for remark in text.missing)
