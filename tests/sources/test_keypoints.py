"""Keypoints that cannot be pixels of their picture or of their time: zeros, shares, repeats."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.geometry.arrays import Intrinsics
from pipelines.session.records import Detections
from pipelines.sources.keypoints import doubt_numbers, in_pixels, without_repeats, without_zeros
from pipelines.sources.parts import CameraFrames
from tests.raising import refused

LENS = Intrinsics(width=1280, height=720, fx=800.0, fy=800.0, cx=640.0, cy=360.0)


def walking(frames: int = 90, people: int = 1, seed: int = 0) -> Detections:
    """Draw people of six joints who move in every picture."""
    rng = np.random.default_rng(seed)
    frame, person = np.repeat(np.arange(frames), people), np.tile(np.arange(people), frames)
    xy = rng.uniform(100, 600, (frames * people, 6, 2))
    return Detections(tuple("abcdef"), frame, person, xy, np.ones((frames * people, 6)), np.arange(frames))


def film(frames: int, hz: float = 30.0) -> CameraFrames:
    t_ns = np.round(np.arange(frames) * 1e9 / hz).astype(np.int64)
    return CameraFrames(np.arange(frames), t_ns, t_ns)


def test_zeros_are_missing_joints_and_who_has_no_other_is_nobody() -> None:
    seen = walking(3)
    seen.xy[0, 2] = 0.0
    seen.xy[1] = 0.0
    seen.xy[2, 0] = [0.0, 5.0]  # at the left edge

    kept = without_zeros(seen)

    assert kept.frame.tolist() == [0, 2]
    assert np.isnan(kept.xy[0, 2]).all()
    assert kept.confidence[0, 2] == 0.0
    assert np.isfinite(kept.xy).sum() == 11 * 2
    assert sorted(kept.dropped.values()) == [1, 7]


def test_shares_of_the_picture_become_pixels_and_pixels_stay() -> None:
    seen = walking(5)
    shares = replace(seen, xy=(seen.xy + 0.5) / [1280, 720])

    adjusted = in_pixels(shares, LENS, "a.json")

    assert adjusted.xy == pytest.approx(seen.xy)
    assert list(adjusted.adjusted.values()) == [30]
    assert in_pixels(seen, LENS, "a.json") is seen


@pytest.mark.parametrize("height", [1.0, 720 / 1280])
def test_shares_from_the_middle_are_refused(height: float) -> None:
    seen = walking(5)
    centred = replace(seen, xy=2 * seen.xy / [1280, 720 / height] - [1, height])

    with refused("keypoints-normalised", "a.json"):
        in_pixels(centred, LENS, "a.json")


@given(st.integers(11, 40), st.integers(0, 40), st.integers(1, 3))
def test_held_detections_are_left_out(pictures: int, first: int, people: int) -> None:
    """The person last seen new is kept; 11 pictures at 30 Hz are the first stretch above 0.3 s."""
    seen = walking(120, people)
    rows = np.flatnonzero(seen.person == 0)
    seen.xy[rows[first + 1 : first + pictures]] = seen.xy[rows[first]]

    kept, notes = without_repeats(seen, film(120))

    assert len(notes) == 1
    assert kept.dropped == {"repeated detections": pictures - 1}
    left = set(zip(kept.frame.tolist(), kept.person.tolist(), strict=True))
    everybody = set(zip(seen.frame.tolist(), seen.person.tolist(), strict=True))
    assert everybody - left == {(frame, 0) for frame in range(first + 1, first + pictures)}


def test_short_repeats_and_scenes_without_motion_stay() -> None:
    short, still = walking(), walking()
    short.xy[11:20] = short.xy[10]
    still.xy[:] = still.xy[0]

    for seen in (short, still):
        assert without_repeats(seen, film(90)) == (seen, [])


@pytest.mark.parametrize(("first", "last", "doubted"), [(1, 90, True), (0, 90, False), (1, 89, False)])
def test_numbers_from_1_beside_a_video_are_doubted(first: int, last: int, doubted: bool) -> None:
    frame = np.arange(first, last + 1)
    seen = replace(walking(len(frame)), frame=frame, frames_listed=frame)
    assert bool(doubt_numbers(seen, film(90), from_video=True)) is doubted
    assert bool(doubt_numbers(seen, film(90), from_video=False)) is (first == 1)
