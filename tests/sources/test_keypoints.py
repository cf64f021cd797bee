"""Keypoints that cannot be pixels of their picture or of their time: zeros, shares, repeats, sizes."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.geometry.arrays import Float, Intrinsics
from pipelines.session.errors import DataError
from pipelines.session.manifest import CameraSources, Manifest
from pipelines.session.records import Detections
from pipelines.sources.cameras import FlightCameras
from pipelines.sources.files import FlightFiles
from pipelines.sources.keypoints import doubt_numbers, in_pixels, without_repeats, without_zeros
from pipelines.sources.logs import FlightLogs
from pipelines.sources.parts import CameraFrames
from tests.commands import runner
from tests.commands.runner import succeeds
from tests.raising import refused
from tests.synthetic.flights import SyntheticFlight, write_flight

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
    seen.xy[0, 2] = -1.0
    seen.xy[1] = 0.0
    seen.xy[2, 0] = [0.0, 5.0]  # at the left edge

    kept = without_zeros(seen)

    assert kept.frame.tolist() == [0, 2]
    assert np.isnan(kept.xy[0, 2]).all()
    assert kept.confidence[0, 2] == 0.0
    assert np.isfinite(kept.xy).sum() == 11 * 2
    assert sorted(kept.dropped.values()) == [1, 1, 6]


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


@pytest.mark.parametrize(("first", "last", "doubted"), [(1, 90, True), (0, 90, False), (2, 89, False)])
def test_numbers_from_1_beside_a_video_are_doubted(first: int, last: int, doubted: bool) -> None:
    frame = np.arange(first, last + 1)
    seen = replace(walking(len(frame)), frame=frame, frames_listed=frame)
    assert bool(doubt_numbers(seen, film(90), from_video=True)) is doubted
    assert bool(doubt_numbers(seen, film(90), from_video=False)) is (first == 1)


WIDTH, HEIGHT = 1280, 720
LENS_OF = {"width": WIDTH, "height": HEIGHT, "fx": 800, "fy": 800, "cx": 640, "cy": 360}
CAMERA = CameraSources.model_validate(
    {"pose": {"file": "a.tum"}, "intrinsics": LENS_OF, "keypoints": "a.json"}
)


def check(xy: Float, confidence: Float) -> None:
    """Request the intrinsics of a camera with these keypoints [N, 2]."""
    flight = Manifest.model_validate({"schema": 1, "cameras": {"drone1": CAMERA}})
    manifest, files, logs = (
        Path("flight.yaml"),
        FlightFiles(flight, Path()),
        FlightLogs(flight, Path(), print),
    )
    cameras = FlightCameras(manifest, logs, files, lambda _: None, print)
    number = np.arange(len(xy))
    seen = Detections(("nose",), number, number * 0, xy[:, None], confidence[:, None], number)
    cameras.intrinsics("drone1", CAMERA, None, seen)


@st.composite
def entering(draw: st.DrawFn) -> tuple[Float, Float]:
    """Draw people inside; the detector extrapolates up to a tenth of the keypoints beyond each border."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    inside = rng.uniform(0, [WIDTH - 1, HEIGHT - 1], (draw(st.integers(20, 100)), 2))
    for axis, size in enumerate((WIDTH, HEIGHT)):
        for edge, sign in ((0.0, -1), (size, 1)):
            some = rng.choice(len(inside), draw(st.integers(0, len(inside) // 10)), replace=False)
            inside[some, axis] = edge + sign * rng.uniform(1, draw(st.floats(1, 5000)), len(some))
    return inside, np.ones(len(inside))


@given(entering())
def test_people_at_the_border_refuse_no_flight(found: tuple[Float, Float]) -> None:
    check(*found)


@given(st.integers(0, 2**32), st.floats(1.5, 8.0), st.booleans())
def test_keypoints_of_larger_pictures_are_refused_with_numbers_outside(
    seed: int, times: float, all_alike: bool
) -> None:
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, [times * WIDTH, times * HEIGHT], (500, 2))  # a share 1 - 1 / times^2 lies outside
    confidence = np.full(500, 0.9 if all_alike else 0.0)
    with pytest.raises(DataError) as caught:
        check(xy, confidence)
    right, bottom = (int(n) for n in re.findall(r"to x = (-?\d+), y = (-?\d+)\)", str(caught.value))[0])
    assert right > WIDTH or bottom > HEIGHT
    assert right <= times * WIDTH
    assert bottom <= times * HEIGHT


@given(st.integers(0, 2**32))
def test_keypoints_that_count_from_elsewhere_are_refused_with_numbers_outside(seed: int) -> None:
    """Count pixels from the middle of the picture: in three quarters of it a coordinate is negative."""
    xy = np.random.default_rng(seed).uniform(-0.5, 0.5, (500, 2)) * [WIDTH, HEIGHT]
    with pytest.raises(DataError) as caught:
        check(xy, np.ones(500))
    left, top = (int(n) for n in re.findall(r"from x = (-?\d+), y = (-?\d+) to", str(caught.value))[0])
    assert -WIDTH / 2 - 1 <= left < 0
    assert -HEIGHT / 2 - 1 <= top < 0


def test_what_a_detector_makes_up_of_legs_below_the_picture_refuses_no_flight() -> None:
    """Put half of every person below the border, with a tenth of the confidence of the rest."""
    below = np.arange(1000) % 2 == 0
    xy = np.stack([np.full(1000, 600.0), np.where(below, HEIGHT + 40.0, 500.0)], axis=1)
    check(xy, np.where(below, 0.08, 0.8))
    with pytest.raises(DataError, match=r"\b50%"):
        check(xy, np.full(1000, 0.8))


def moved(flight: SyntheticFlight, x_by_frame: dict[int, list[float]]) -> None:
    """Set x of the first joints of drone1's people in some frames."""
    path = flight.manifest.parent / "drone1.json"
    people = json.loads(path.read_text(encoding="utf-8"))
    for frame, values in x_by_frame.items():
        for joint, x in enumerate(values):
            people[frame]["keypoints"][3 * joint : 3 * joint + 3] = [x, 300.0, 0.9]
    path.write_text(json.dumps(people), encoding="utf-8")


@pytest.mark.parametrize("slightly", [-LENS.width / 8, LENS.width * 9 / 8 - 1])
def test_keypoints_slightly_outside_are_kept_and_far_ones_left_out(tmp_path: Path, slightly: float) -> None:
    flight = write_flight(tmp_path, cameras=2, seconds=0.5, clean=True)
    succeeds("ingest", flight.manifest)
    before = len(keypoints_of(flight))
    # The detector extrapolates in frame 2; in 3 a joint lies beyond any box, in 4 a whole person.
    moved(flight, {2: [slightly] * 5, 3: [-300.0], 4: [3000.0] * 17})
    succeeds("ingest", flight.manifest)
    kept = keypoints_of(flight)
    assert len(kept) == before - 18
    assert np.count_nonzero(kept["x"] == slightly) == 5
    entry = json.loads((tmp_path / "flight.session" / "session.json").read_text(encoding="utf-8"))
    dropped = entry["cameras"]["drone1"]["keypoints"]["dropped"]
    assert {cause.split()[0]: count for cause, count in dropped.items()} == {"keypoints": 18, "people": 1}
    assert "cameras.drone1.keypoints: 18 " in runner.refused("ingest", flight.manifest, "--strict")


def keypoints_of(flight: SyntheticFlight) -> pd.DataFrame:
    folder = flight.manifest.with_suffix(".session") / "cameras" / "drone1"
    return pd.read_parquet(folder / "keypoints.parquet")
