"""Default detector against MediaPipe itself, and its parts against closed forms."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.geometry.arrays import Float, Picture
from pipelines.keypoints import blazepose
from pipelines.keypoints.blazepose import DETECTOR, BlazePose
from pipelines.session.errors import DataError
from pipelines.session.registries import Person, Region
from tests.real_data import real_data

REFERENCE = Path(__file__).with_name("reference_blazepose.json")
CROP = 256


@pytest.fixture(scope="module")
def networks() -> BlazePose:
    """Load the real networks; skip without the files and without an internet connection."""
    try:
        DETECTOR.fetch()
    except DataError as error:
        pytest.skip(str(error))
    return DETECTOR.load(threads=1)


@dataclass(frozen=True)
class Sample:
    """Real picture with MediaPipe's results, converted to our convention."""

    picture: Picture
    region: Region
    next_region: Region
    score: float
    xy: Float


@pytest.fixture(scope="module")
def samples() -> list[Sample]:
    folder = real_data("pose2sim_single/videos")
    return [sample(folder, entry) for entry in json.loads(REFERENCE.read_text())["frames"]]


def sample(folder: Path, entry: dict[str, Any]) -> Sample:
    import cv2

    capture = cv2.VideoCapture(str(folder / entry["video"]))
    for _ in range(entry["frame"] + 1):
        read, picture = capture.read()
        assert read
    # Numbers of other pixels would compare decoders, not detectors.
    assert hashlib.sha256(picture.tobytes()).hexdigest() == entry["sha256"]
    x, y, side, angle = entry["region"]
    # MediaPipe reports u + 1/2 crop pixels for a position u that is counted from pixel centres.
    half = crop_pixel(side, angle) @ (0.5, 0.5)
    next_x, next_y, next_side, next_angle = entry["next_region"]
    return Sample(
        picture,
        Region((x - half[0], y - half[1]), side, angle),
        Region((next_x - half[0], next_y - half[1]), next_side, next_angle),
        entry["score"],
        np.array(entry["landmarks"]) - half,
    )


def crop_pixel(side: float, angle: float) -> Float:
    """Return as columns one crop pixel to the right and one down, turned clockwise, in picture pixels."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return turn * side / CROP


def distance(person: Person, sample: Sample) -> Float:
    away: Float = np.linalg.norm(person.xy - sample.xy, axis=1)
    return away


def assert_same_region(found: Region, expected: Region, px: float) -> None:
    assert found.centre == pytest.approx(expected.centre, abs=px)
    assert found.side == pytest.approx(expected.side, abs=2 * px)
    assert found.angle_rad == pytest.approx(expected.angle_rad, abs=2 * px / expected.side)


# The goal is 0.1 px (median). The locked OpenCV gives 0.005 px from the same region and 0.006 px from the
# picture (95 %: 0.02, largest: 0.09). Warping without rounding positions to 1/32 px gives 0.09 and 0.61 px:
# the limits are tighter to detect this.
MEDIAN_PX = 0.02
LARGEST_PX = 0.5


def test_landmarks_are_those_of_mediapipe(networks: BlazePose, samples: list[Sample]) -> None:
    away = np.array([distance(networks.locate(s.picture, [s.region])[0], s) for s in samples])
    assert np.median(away) < MEDIAN_PX
    assert away.max() < LARGEST_PX


def test_people_are_found_where_mediapipe_finds_them(networks: BlazePose, samples: list[Sample]) -> None:
    for s in samples:
        region, score = networks.find_people(s.picture)[0]
        assert_same_region(region, s.region, px=0.05)
        assert score == pytest.approx(s.score, abs=0.001)


def test_from_picture_to_landmarks_as_mediapipe(networks: BlazePose, samples: list[Sample]) -> None:
    away = []
    for s in samples:
        people = networks.locate(s.picture, [networks.find_people(s.picture)[0][0]])
        assert people[0].presence > 0.9
        away.append(distance(people[0], s))
    assert np.median(away) < MEDIAN_PX
    assert np.max(away) < LARGEST_PX


def test_a_mirrored_person_has_mirrored_joints(networks: BlazePose, samples: list[Sample]) -> None:
    """Check the half-pixel convention: over many joints the network is symmetric in left and right.

    With edges taken for centres of pixels, the mirrored joints would be one crop pixel off. Measured are
    0.1 to 0.2 (the mirror is not exact, and the heatmap's window is cut to cells).
    """
    joints = networks.joints
    swapped = [
        joints.index(joint.replace("left_", "#").replace("right_", "left_").replace("#", "right_"))
        for joint in joints
    ]
    off = []
    for s in samples:
        width = s.picture.shape[1]
        mirror = Region(
            (width - 1 - s.region.centre[0], s.region.centre[1]), s.region.side, -s.region.angle_rad
        )
        person = networks.locate(s.picture, [s.region])[0]
        mirrored = networks.locate(np.ascontiguousarray(s.picture[:, ::-1]), [mirror])[0]
        sure = (person.confidence > 0.7) & (mirrored.confidence[swapped] > 0.7)
        back = np.column_stack([width - 1 - mirrored.xy[swapped, 0], mirrored.xy[swapped, 1]])
        # Along the crop's own x, the mirrored direction.
        right = crop_pixel(s.region.side, s.region.angle_rad)[:, 0] * CROP / s.region.side
        off.append(((person.xy - back)[sure] @ right) * CROP / s.region.side)
    assert abs(np.median(np.concatenate(off))) < 0.4


def test_a_turned_picture_has_turned_joints(networks: BlazePose) -> None:
    """Cut the same crop from a picture turned by 90 deg: only the last bits of the positions differ."""
    rng = np.random.default_rng(1)
    coarse = rng.integers(0, 255, (30, 40, 3)).astype(np.uint8)
    picture = np.repeat(np.repeat(coarse, 16, axis=0), 16, axis=1)
    height = picture.shape[0]
    region = Region((300.25, 200.5), 256.0, 0.0)
    # np.rot90(-1) turns clockwise: (x, y) goes to (height - 1 - y, x), and up goes to the right.
    turned = Region((height - 1 - 200.5, 300.25), 256.0, np.pi / 2)
    straight = networks.locate(picture, [region])[0]
    other = networks.locate(np.ascontiguousarray(np.rot90(picture, -1)), [turned])[0]
    expected = np.column_stack([height - 1 - straight.xy[:, 1], straight.xy[:, 0]])
    np.testing.assert_allclose(other.xy, expected, atol=1e-3)
    np.testing.assert_allclose(other.confidence, straight.confidence, atol=1e-6)


def test_nobody_is_found_in_an_empty_picture(networks: BlazePose) -> None:
    empty = np.full((480, 640, 3), 90, np.uint8)
    assert networks.find_people(empty) == []
    [person] = networks.locate(empty, [Region((320, 240), 300)])
    assert person.presence < 0.5
    assert np.isfinite(person.xy).all()
    assert person.confidence.max() < 0.5


def test_joints_outside_of_the_crop_have_no_confidence(networks: BlazePose, samples: list[Sample]) -> None:
    """Use a region around the head of half the right width: joints outside of it get confidence 0."""
    outside = 0
    for s in samples:
        region = Region((float(s.xy[0, 0]), float(s.xy[0, 1])), s.region.side / 2, s.region.angle_rad)
        [person] = networks.locate(s.picture, [region])
        assert np.isfinite(person.xy).all()
        in_crop = (person.xy - region.centre) @ np.linalg.inv(crop_pixel(region.side, region.angle_rad)).T
        beyond = (np.abs(in_crop) > CROP / 2 + 4).any(axis=1)  # a cell of the heatmap is 4 px
        outside += int(beyond.sum())
        assert not person.confidence[beyond].any()
    assert outside  # else nothing was tested


@pytest.mark.parametrize(
    ("top", "angle"),
    [((50, 0), 0.0), ((90, 40), np.pi / 2), ((50, 80), np.pi), ((10, 40), -np.pi / 2)],
)
def test_a_region_is_turned_as_its_person(top: tuple[float, float], angle: float) -> None:
    region = blazepose._region(np.array([50.0, 40.0]), np.array(top, float))
    assert region.centre == (50.0, 40.0)
    assert region.side == pytest.approx(2 * 40 * 1.25)
    assert region.angle_rad == pytest.approx(angle)
