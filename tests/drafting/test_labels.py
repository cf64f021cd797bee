"""Drafts: what names and notes say, and what pictures and logs show of motion."""

import re
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

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
from pipelines.drafting.motion import TrackedPoints, explain_motion, explains_better
from pipelines.geometry.arrays import Float


@pytest.mark.parametrize(
    "name",
    [
        *("drone1", "drone1_poses", "Drone_01", "drone-1.keypoints", "/drone1/odometry", "rosbag2_drone1"),
        *("/drone1/camera/color/image_raw/compressed", "drone1_halpe26_1080p_30fps", "drone1_true"),
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


Motion = Callable[[Float], tuple[Float, Rotation]]
"""Positions m [N, 3] and attitudes [N] of a camera at times s [N]."""

EPOCH_NS = 1_700_000_000_000_000_000
START_S = 17.3456
POINTS, STRETCH_S = 40, 0.2
SCATTER = 5e-4  # rad: a tenth of a pixel of pictures 320 px wide
LOG_S = np.arange(0.0, 40.0, 0.01)


def turning(t_s: Float) -> tuple[Float, Rotation]:
    """Rotate a camera in one place; the frequencies have no common period, so the motion never repeats."""
    yaw = 0.5 * np.sin(0.7 * t_s) + 0.2 * np.sin(2.3 * t_s)
    pitch = 0.1 * np.sin(1.1 * t_s + 1)
    return np.zeros((len(t_s), 3)), Rotation.from_euler("YX", np.stack([yaw, pitch], axis=1))


def flying(t_s: Float) -> tuple[Float, Rotation]:
    """Fly a swaying camera beside a walking person and aim at them, so that points move by parallax."""
    x = 1.3 * t_s + 0.5 * np.sin(0.9 * t_s)
    z = 0.8 * np.sin(0.55 * t_s)
    yaw = np.arctan2(1.3 * t_s - x, 10 - z)
    return np.stack([x, 0.3 * np.sin(1.7 * t_s), z], axis=1), Rotation.from_euler("Y", yaw[:, None])


def standing(t_s: Float) -> tuple[Float, Rotation]:
    return np.zeros((len(t_s), 3)), Rotation.from_euler("Y", np.zeros((len(t_s), 1)))


def seen(motion: Motion, seconds: float = 10.0) -> TrackedPoints:
    """Make points 5 to 50 m away, new ones in every stretch, with some scatter in the picture."""
    rng = np.random.default_rng(8)
    begin_s = np.arange(0.0, seconds - STRETCH_S, STRETCH_S)
    end_s = begin_s + STRETCH_S
    (from_place, from_attitude), (to_place, to_attitude) = motion(begin_s + START_S), motion(end_s + START_S)
    stretch = np.repeat(np.arange(len(begin_s)), POINTS)
    begin = rng.uniform(-0.5, 0.5, (len(stretch), 2))
    depth = rng.uniform(5, 50, (len(stretch), 1))
    in_world = from_attitude[stretch].apply(depth * np.column_stack([begin, np.ones(len(begin))]))
    there = to_attitude[stretch].inv().apply(in_world + from_place[stretch] - to_place[stretch])
    return TrackedPoints(
        np.round(begin_s * 1e9).astype(np.int64),
        np.round(end_s * 1e9).astype(np.int64),
        stretch,
        begin,
        there[:, :2] / there[:, 2:] + SCATTER * rng.standard_normal((len(stretch), 2)),
    )


def explained(motion: Motion, log_s: Float, followed: TrackedPoints) -> tuple[Float, int] | None:
    place, attitude = motion(log_s)
    t_ns = EPOCH_NS + np.round(log_s * 1e9).astype(np.int64)
    return explain_motion(t_ns, place, attitude.as_quat(), followed, max_gap_ns=500_000_000)


@pytest.mark.parametrize(("motion", "other"), [(turning, flying), (flying, turning)])
def test_a_camera_s_own_poses_explain_its_video_from_its_start_on(motion: Motion, other: Motion) -> None:
    followed = seen(motion)
    own, others = explained(motion, LOG_S, followed), explained(other, LOG_S, followed)
    assert own is not None
    assert others is not None
    assert explains_better(own[0], others[0])
    assert not explains_better(others[0], own[0])
    # Half of a step of the search, and what 2000 points scatter.
    assert (own[1] - EPOCH_NS) / 1e9 == pytest.approx(START_S, abs=0.01)


def test_a_still_camera_is_explained_by_nothing() -> None:
    followed = seen(standing)
    found = explained(turning, LOG_S, followed)
    assert found is not None
    assert not explains_better(found[0], np.zeros_like(found[0]))


def test_poses_of_another_time_are_no_match() -> None:
    followed = seen(turning)
    assert explained(turning, LOG_S[:200], followed) is None
    none = followed.stretch[:0]
    empty = TrackedPoints(followed.begin_ns, followed.end_ns, none, followed.begin[:0], followed.end[:0])
    assert explained(turning, LOG_S, empty) is None
