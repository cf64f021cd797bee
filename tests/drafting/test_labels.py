import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.drafting.found import (
    EQUAL,
    NUMBER,
    OTHER,
    PART,
    UNNAMED,
    affinity,
    camera_names,
    label_of,
    label_of_place,
)


@pytest.mark.parametrize(
    "name",
    [
        "drone1",
        "drone1_poses",
        "Drone_01",
        "drone-1.keypoints",
        "/drone1/odometry",
        "/drone1/camera/color/image_raw/compressed",
        "rosbag2_drone1",
        "drone1_halpe26_1080p_30fps",
        "drone1_true",
    ],
)
def test_names_of_the_same_drone_bear_one_label(name: str) -> None:
    assert affinity(label_of(name), label_of("drone1")) == EQUAL


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ("drone1", "drone1", EQUAL),
        ("drone1", "drone1_front", PART),
        ("flight3_drone1", "/drone1/odometry", PART),
        ("d1", "drone1", NUMBER),
        ("cam02", "drone2", NUMBER),
        ("cam02", "camera_2", NUMBER),
        ("drone1", "drone2", OTHER),
        ("drone1", "drone10", OTHER),
        ("alice", "bob", OTHER),
        ("drone1", "odometry", UNNAMED),
    ],
)
def test_affinity(one: str, other: str, expected: int) -> None:
    assert affinity(label_of(one), label_of(other)) == expected
    assert affinity(label_of(other), label_of(one)) == expected


def test_numbered_folders_tell_files_of_one_name_apart() -> None:
    one, other = label_of_place(("drone1", "DJI_0001")), label_of_place(("drone2", "DJI_0001"))
    assert affinity(one, other) == OTHER
    assert affinity(one, label_of("drone1")) == PART


@pytest.mark.parametrize(
    ("labels", "names"),
    [
        (["drone1", "drone2"], ["drone1", "drone2"]),
        (["cam01", "cam02"], ["cam01", "cam02"]),
        (["flight3_drone1", "flight3_drone2"], ["drone1", "drone2"]),
        (["20260501_red_left", "20260501_red_right"], ["red_left", "red_right"]),
        (["drone1_DJI_0001", "drone2_DJI_0002"], ["drone1", "drone2"]),
        (["drone1 front", "drone1 back"], ["front", "back"]),
        (["Дрон 1", "!"], ["camera1", "camera2"]),
        (["flight3 drone1"], ["flight3_drone1"]),
    ],
)
def test_camera_names_say_as_much_as_it_takes(labels: list[str], names: list[str]) -> None:
    assert camera_names([label_of(label) for label in labels]) == names


@given(st.lists(st.text(max_size=90), max_size=8))
def test_camera_names_are_always_fit_to_name_folders(texts: list[str]) -> None:
    names = camera_names([label_of(text) for text in texts])
    assert len(names) == len(texts)
    assert all(re.fullmatch(r"[A-Za-z0-9_-]{1,64}", name) for name in names)
    assert len({name.lower() for name in names}) == len(names)
