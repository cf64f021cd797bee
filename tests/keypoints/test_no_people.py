"""Things that are no people, in front of two cameras 10 m south and west, 3 m above level ground.

A body is a column of joints, 1.6 m tall if it stands. Tracks and groups are given, so that only the
judgement is tested: tracks 0, 1, ... of each camera are the bodies in their order, and those that two
cameras follow are one group at their true place.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pipelines.geometry.arrays import Bool, Float
from pipelines.keypoints.bodies import Bodies
from pipelines.keypoints.no_people import Ground, NoPeople, Surroundings, tell_no_people

TIMES, JOINTS = 6, 17
CAMERAS = np.array([[0.0, -10.0, 3.0], [-10.0, 0.0, 3.0]])
LOOKS_NORTH = np.array(
    [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
)  # its columns: right, down, ahead
LOOKS_EAST = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
FIELDS = np.tile([-0.8, -0.45, 0.8, 0.45], (2, 1))  # of a picture of 16:9, some 77 degrees wide
BOTH, FIRST = (True, True), (True, False)


def flat(points: Float) -> tuple[Float, Float]:
    """Level ground at 0 m."""
    return np.zeros(len(points)), np.zeros(len(points))


def standing(x: float, y: float, *, foot: float = 0.05, top: float = 1.65) -> Float:
    """Return joints [J, 3] of a body of 0.4 m of width."""
    z = np.linspace(foot, top, JOINTS)
    return np.column_stack([x + 0.2 * np.sin(2.4 * np.arange(JOINTS)), np.full(JOINTS, y), z])


def lying(x: float, y: float) -> Float:
    """Return joints [J, 3] of a body on the ground, eastward."""
    along = np.linspace(-0.8, 0.8, JOINTS)
    return np.column_stack([x + along, y + 0.2 * np.sin(2.4 * np.arange(JOINTS)), np.full(JOINTS, 0.15)])


def told(
    bodies: list[tuple[Float, tuple[bool, bool]]],
    ground: Ground | None = flat,
    *,
    times: int = TIMES,
    sigma: float = 0.002,
) -> NoPeople:
    """Film bodies, each followed by the cameras that are given, and tell which are no people."""
    joints = np.stack([body for body, _ in bodies])
    followed = np.array([by for _, by in bodies]).T  # [C, D]
    rotation = np.stack([LOOKS_NORTH, LOOKS_EAST])
    seen = np.einsum("cba,djcb->cdja", rotation, joints[:, :, None] - CAMERAS)
    xy = np.where(followed[..., None, None], seen[..., :2] / seen[..., 2:], np.nan)
    views = np.where(followed, followed.sum(axis=0), 0)
    middle = np.where((views > 1)[..., None], np.median(joints, axis=1), np.nan)

    def always(values: Any) -> Any:
        return np.repeat(values[None], times, axis=0)

    return tell_no_people(
        Bodies(
            track=always(np.where(followed, np.arange(len(bodies)), -1)),
            views=always(views),
            middle=always(middle),
            spread=always(np.where(views > 1, 0.1, np.nan)),
        ),
        always(xy),
        always(np.where(followed[..., None], np.full(JOINTS, 0.8), 0.0)),
        always(CAMERAS),
        always(rotation),
        np.full((times, 2), sigma),
        Surroundings(ground, FIELDS),
    )


def whole(which: Bool) -> list[list[bool]]:
    """Return for each camera and body if it is told in every picture; a part of a track is never told."""
    assert np.array_equal(which.all(axis=0), which.any(axis=0))
    return [[bool(each) for each in camera] for camera in np.asarray(which.all(axis=0))]


PERSON = (standing(0.0, 0.0), BOTH)
NOBODY = [[False] * 2] * 2


@pytest.mark.parametrize(
    "body",
    [
        standing(2.0, 3.0),
        standing(2.0, 3.0, top=0.85),  # crouches
        standing(2.0, 3.0, foot=0.6, top=2.4),  # jumps, with arms stretched upwards
        lying(2.0, 3.0),
    ],
    ids=["stands", "crouches", "jumps", "lies"],
)
def test_people_are_never_told(body: Float) -> None:
    """Both cameras look at all of them; one whom only one camera follows is nobody, but not by the ground."""
    both = told([PERSON, (body, BOTH)])
    assert not both.ground.any()
    assert not both.alone.any()
    assert not both.kept.any()
    assert not told([PERSON, (body, FIRST)]).ground.any()


def test_a_crown_is_off_the_ground_for_one_camera_and_for_two() -> None:
    """Joints from 4 to 7 m, 13 m from the first camera.

    A body of 2.6 m looks as large at 2.6 / 3.03 x 13 = 11.2 m, where the line of sight through the middle of
    the crown is 3 + 2.5 x 11.2 / 13 = 5.2 m high: above 2.0 m, and nearer even higher above the sloping line.
    """
    crown = standing(1.0, 3.0, foot=4.0, top=7.0)
    assert whole(told([PERSON, (crown, FIRST)]).ground) == [[False, True], [False, False]]
    assert whole(told([PERSON, (crown, BOTH)]).ground) == [[False, True], [False, True]]
    assert not told([PERSON, (crown, BOTH)], None).kept.any()


def test_without_a_map_the_level_is_that_of_the_person_whom_all_see() -> None:
    """30 m up, 20 m away, the slope of 0.3 allows 7 m and the body 3 m."""
    crown = standing(0.0, 15.0, foot=30.0, top=33.0)
    assert whole(told([PERSON, (crown, FIRST)], None).ground)[0] == [False, True]
    assert told([(standing(0.0, 0.0), FIRST), (crown, FIRST)], None).ground.sum() == 0  # no level is known


def test_with_a_wrong_ground_everybody_is_kept_and_counted() -> None:
    def far_below(points: Float) -> tuple[Float, Float]:
        return np.full(len(points), -60.0), np.zeros(len(points))

    crown = standing(1.0, 3.0, foot=4.0, top=7.0)
    found = told([PERSON, (crown, BOTH)], far_below)
    assert not found.ground.any()
    assert not found.alone.any()
    assert found.kept.all()


def test_who_is_alone_though_another_camera_looks_there() -> None:
    """Camera 1 looks east and sees 38 degrees to either side; the second body is behind it."""
    assert whole(told([PERSON, (standing(2.0, 0.5), FIRST)]).alone) == [[False, True], [False, False]]
    assert whole(told([PERSON, (standing(-11.0, 2.0), FIRST)]).alone) == NOBODY


def test_a_hill_between_hides() -> None:
    """A wall of ground, 5 m high, stands between the second camera and both of the first one's people."""

    def wall(points: Float) -> tuple[Float, Float]:
        return np.where(np.abs(points[:, 0] + 5.0) < 1.0, 5.0, 0.0), np.zeros(len(points))

    assert whole(told([PERSON, (standing(2.0, 0.5), FIRST)], wall).alone) == NOBODY
