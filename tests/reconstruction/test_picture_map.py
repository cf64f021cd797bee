"""Attitudes by pictures, on features and places with known truth."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.geometry.arrays import Float, Int64, Intrinsics
from pipelines.geometry.cameras import project
from pipelines.geometry.noise import PoseErrors, White, pose_errors
from pipelines.geometry.poses import (
    conjugate,
    invert,
    look_at,
    matrix_from_quaternion,
    multiply,
    quaternion_from_rotation_vector,
    rotate,
    rotation_vector_from_quaternion,
    transform,
)
from pipelines.reconstruction.background_tracks import Tracks
from pipelines.reconstruction.body_fit import landmarks_of
from pipelines.reconstruction.picture_map import (
    JOINED,
    KeyFeatures,
    LaidMap,
    NoAttitudesError,
    PeopleSeen,
    PictureMap,
    first_similarity,
    followed_features,
    join_maps,
    lay_on_places,
    map_pictures,
    poses_of_pictures,
)

LENS = Intrinsics(1280, 720, 1000.0, 1000.0, 639.5, 359.5)
STEP_NS = 200_000_000
KEYS = 24
T_NS: Int64 = np.arange(KEYS, dtype=np.int64) * STEP_NS
CENTIMETRE = pose_errors([White(position_m=0.01)])


def flown(*, straight: bool = False, along_view: bool = False) -> tuple[Float, Float]:
    """Return places and attitudes of a camera that flies a curve about what it films, or a line."""
    angle = np.linspace(0, 1.2, KEYS)
    places = np.stack([12 * np.cos(angle), 12 * np.sin(angle), 4 + np.sin(2 * angle)], axis=1)
    if straight:
        places = np.array([14.0, 0, 5]) + np.linspace(0, 6, KEYS)[:, None] * [0.0, 1.0, 0.0]
    if along_view:
        places = np.array([20.0, 0, 5]) + np.linspace(0, 6, KEYS)[:, None] * [-1.0, 0.0, 0.0]
    target = np.tile([0.0, 0.0, 1.0], (KEYS, 1))
    return places, look_at(places, places + np.array([-12.0, 0, -3]) if straight or along_view else target)


def mapped(places: Float, turned: Float) -> PictureMap:
    """Return an exact map in another frame and scale, with 40 points before each of four cameras."""
    turn = quaternion_from_rotation_vector(np.array([0.4, -1.0, 0.7]))
    position = 0.3 * rotate(turn, places - [5.0, 1.0, 2.0])
    ahead = np.random.default_rng(8).uniform([-5, -3, 8], [5, 3, 20], (4, 40, 3))
    some = range(0, len(places), len(places) // 4 + 1)
    world = np.concatenate(
        [transform((places[k], turned[k]), near) for k, near in zip(some, ahead, strict=True)]
    )
    seen_in, seen_point, seen_xy = [], [], []
    for picture, pose in enumerate(zip(places, turned, strict=True)):
        seen = transform(invert(*pose), world)
        xy = seen[:, :2] / seen[:, 2:]
        point = np.flatnonzero((seen[:, 2] > 1) & (np.abs(xy) < 0.7).all(axis=1))
        seen_in.append(np.full(len(point), picture))
        seen_point.append(point)
        seen_xy.append(xy[point])
    names = np.unique(np.concatenate(seen_point), return_inverse=True)[1]
    sightings = np.concatenate(seen_in), names, np.concatenate(seen_xy)
    return PictureMap(np.arange(len(places)), position, multiply(turn, turned), *sightings)


def laid_on(found: PictureMap, places: Float, errors: PoseErrors | None) -> LaidMap:
    """Lay a map on a place at each key picture."""
    return lay_on_places(found, LENS, T_NS, T_NS, places, errors)


def errors_deg(laid: LaidMap, turned: Float) -> Float:
    """Return the rotation vectors [K, 3] from true attitudes to found ones, about the world's axes, deg."""
    return np.degrees(rotation_vector_from_quaternion(multiply(laid.quaternion_xyzw, conjugate(turned))))


def features_of_points(
    places: Float, turned: Float, lens: Intrinsics, height_m: float, seen: float = 0.7
) -> list[KeyFeatures]:
    """Return 300 points up to a height as they are followed, off by 0.3 px; `lens` is what is known of it."""
    rng, point, xy = np.random.default_rng(7), [], []
    world = rng.uniform([-6, -6, 0], [6, 6, height_m], (300, 3))
    for pose in zip(places, turned, strict=True):
        pixels = project(transform(invert(*pose), world), LENS)
        inside = ((pixels > 0) & (pixels < [1279, 719])).all(axis=1)
        point.append(np.flatnonzero(inside & (rng.random(300) < seen)))
        xy.append(pixels[point[-1]] + rng.normal(0, 0.3, (len(point[-1]), 2)))
    picture, rows = np.repeat(np.arange(KEYS), [len(each) for each in point]), np.arange(KEYS)
    tracks = Tracks(picture, np.concatenate(point), np.concatenate(xy))
    return followed_features(tracks, rows, rows, lens, T_NS)


def test_followed_points_give_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points are exact to 0.3 px: attitudes relative to each other come out to 0.05 deg."""
    places, turned = flown()
    features = features_of_points(places, turned, LENS, 5.0)
    found = map_pictures(features, LENS)
    assert found.key.tolist() == list(range(KEYS))
    laid = laid_on(found, places, CENTIMETRE)
    assert np.abs(errors_deg(laid, turned)).max() < 0.1
    assert np.linalg.norm(laid.position - places, axis=1).max() < 0.02
    assert (map_pictures(features, LENS).quaternion_xyzw == found.quaternion_xyzw).all()
    nothing = KeyFeatures(np.empty((0, 2)), np.empty((0, 128), np.uint8), np.empty(0, np.int64))
    for same in (features[0], nothing):  # a camera that stands, and pictures without texture
        with pytest.raises(NoAttitudesError):
            map_pictures([same] * 12, LENS)
    with pytest.raises(NoAttitudesError):
        map_pictures([features[0], *[replace(nothing, descriptors=np.empty((0, 0), np.uint8))] * 60], LENS)
    # A film is mapped from a part of it on. A point that is followed for long is another one.
    monkeypatch.setattr("pipelines.reconstruction.picture_map.BEGUN_WITH", 10)
    monkeypatch.setattr("pipelines.reconstruction.picture_map.MAX_FOLLOWED_S", 1.99)
    pieces = features_of_points(places, turned, LENS, 5.0, seen=1.0)
    assert not set(pieces[0].point.tolist()) & set(pieces[10].point.tolist())
    begun = map_pictures(pieces, LENS)
    assert begun.key.tolist() == list(range(KEYS))
    assert np.abs(errors_deg(laid_on(begun, places, CENTIMETRE), turned)).max() < 0.1
    # Over flat ground a map that contradicts its sightings begins anew on a plane.
    wrong = replace(found, position=found.position[::-1])
    monkeypatch.setattr("pipelines.reconstruction.picture_map._mapped", lambda *_, **__: wrong)
    mended = map_pictures(features_of_points(places, turned, LENS, 0.01), LENS)
    assert np.abs(errors_deg(laid_on(mended, places, CENTIMETRE), turned)).max() < 0.1


def test_a_guessed_focal_length_is_refined_where_pictures_determine_it() -> None:
    guessed = replace(LENS, fx=900.0, fy=900.0)
    places, turned = flown()
    found = map_pictures(features_of_points(places, turned, guessed, 5.0), guessed, refine_focal=True)
    assert found.focal_ratio == pytest.approx(1000 / 900, abs=0.01)

    # Straight down over flat ground it is held.
    x_m = np.linspace(-4, 4, KEYS)
    places = np.stack([x_m, 1.5 * np.sin(x_m), np.full(KEYS, 12.0)], axis=1)
    turned = look_at(places, places + np.array([0.01, 0.0, -12.0]))
    found = map_pictures(features_of_points(places, turned, guessed, 0.01), guessed, refine_focal=True)
    assert found.focal_ratio == 1.0


def test_attitudes_are_off_by_what_is_said_of_them() -> None:
    """White errors of 0.1 m on a curve of some metres: 20 draws have the predicted mean square, 3 axes."""
    places, turned = flown()
    found, rng = mapped(places, turned), np.random.default_rng(3)
    ratios = []
    for _ in range(20):
        noisy = places + rng.normal(0, 0.1, places.shape)
        laid = laid_on(found, noisy, pose_errors([White(position_m=0.1)]))
        common = np.radians(errors_deg(laid, turned).mean(axis=0))
        ratios.append(float(np.square(common).sum()) / (3 * laid.common_sigma_rad**2))
    assert 0.6 < np.mean(ratios) < 1.6


def test_the_horizon_levels_a_straight_flight_along_the_view() -> None:
    """Places on a line do not say how the map turns about it; pictures without roll do, to 2 deg."""
    places, turned = flown(along_view=True)
    laid = laid_on(mapped(places, turned), places, CENTIMETRE)
    assert np.abs(errors_deg(laid, turned)).max() < 0.05
    assert 1.0 < np.degrees(laid.common_sigma_rad) < 2.0


def test_a_bent_map_is_straightened_by_the_places_but_not_by_one_that_jumped_away() -> None:
    places, turned = flown()
    found = mapped(places, turned)
    jumped = places + np.random.default_rng(1).normal(0, 0.01, places.shape)
    jumped[5] += [30.0, -20.0, 4.0]
    assert np.abs(errors_deg(laid_on(found, jumped, CENTIMETRE), turned)).max() < 0.3
    middle = found.position - found.position.mean(axis=0)
    bent = replace(found, position=found.position + 0.2 * found.size * np.sin(3 * middle / found.size))
    assert np.abs(errors_deg(laid_on(bent, places, CENTIMETRE), turned)).max() < 0.1


@pytest.mark.parametrize(
    "what", ["straight, seen from the side", "smaller than its noise", "another path", "other points"]
)
def test_places_that_do_not_say_how_the_map_lies_are_refused(what: str) -> None:
    places, turned = flown(straight=what.startswith("straight"))
    found = mapped(places, turned)
    errors = pose_errors([White(position_m=5.0 if what.startswith("smaller") else 0.01)])
    if what == "another path":
        places = np.random.default_rng(2).normal(0, 1, places.shape).cumsum(axis=0)
    if what == "other points":  # a third of the sightings is of points elsewhere
        found.seen_xy[::3] = np.random.default_rng(3).uniform(-0.5, 0.5, found.seen_xy[::3].shape)
    with pytest.raises(NoAttitudesError):
        laid_on(found, places, errors)


def test_pictures_between_keys_get_poses_but_not_across_a_gap() -> None:
    places, turned = flown()
    kept = np.r_[0:8, 16:KEYS]  # a gap of 1.8 s
    found = replace(mapped(places[kept], turned[kept]), key=kept)
    laid = laid_on(found, places, None)
    at_ns = np.arange(0, int(T_NS[-1]) + 1, STEP_NS // 4)
    position, quaternion = poses_of_pictures(laid, T_NS[2:], places[2:], at_ns)  # places begin late
    known = np.isfinite(quaternion[:, 0])
    assert (known == ((at_ns <= T_NS[7]) | (at_ns >= T_NS[16]))).all()
    assert np.isfinite(position[known]).all()


def seen_walking(angle: float, along: Float) -> tuple[PeopleSeen, tuple[Float, Float]]:
    """Film a body of 1.80 m, arms out, that is at some places [K, 3] m; return the camera's poses, too."""
    places, turned = flown()
    about = quaternion_from_rotation_vector(np.array([0.0, 0.0, angle]))
    pose = rotate(about, places), multiply(about, turned)
    marks = landmarks_of(["left_mouth", *JOINED]) or pytest.fail("the joints are landmarks")
    body = dict(zip(marks[0].joints, 1.8 * marks[0].at_rest, strict=True))
    joints = along[:, None] + [body[name] for name in JOINED]
    seen = np.stack([transform(invert(*each), at) for *each, at in zip(*pose, joints, strict=True)])
    return PeopleSeen(f"{angle}", mapped(*pose), T_NS, (seen[..., :2] / seen[..., 2:])[:, None]), pose


def test_cameras_are_joined_by_a_person_whom_they_see() -> None:
    """Rays are exact: attitudes beside each other, too, and lengths are those of the body."""
    along = np.stack([np.linspace(-2, 2, KEYS), np.sin(np.linspace(0, 3, KEYS)), np.full(KEYS, 1.0)], axis=1)
    cameras, poses = zip(*(seen_walking(angle, along) for angle in (0.0, 1.5, 3.4)), strict=True)
    joined = join_maps(cameras, T_NS, 1.8)
    true = np.concatenate([places for places, _ in poses])
    to_true = first_similarity(np.concatenate([laid.position for laid in joined.laid]), true)[0]
    assert to_true.scale == pytest.approx(1, abs=0.002)
    upright = matrix_from_quaternion(to_true.quaternion_xyzw)[2, 2]
    assert np.degrees(np.arccos(upright)) < 2 * np.degrees(joined.tilt_sigma_rad)
    for laid, (_, turned) in zip(joined.laid, poses, strict=True):
        now = replace(laid, quaternion_xyzw=multiply(to_true.quaternion_xyzw, laid.quaternion_xyzw))
        assert np.abs(errors_deg(now, turned)).max() < 0.05
    other = seen_walking(3.4, np.random.default_rng(4).permutation(along))[0]  # or another clock
    beside = seen_walking(0.0, np.add(along, [0, 1.0, 0]))[0].xy
    two = [replace(cameras[0], xy=np.hstack([cameras[0].xy, beside])), cameras[1]]  # which one sees whom?
    unseen = replace(cameras[2], xy=np.full_like(cameras[2].xy, np.nan))
    for wrong in ([*cameras[:2], other], [*cameras[:2], unseen], two):
        with pytest.raises(NoAttitudesError):
            join_maps(wrong, T_NS, 1.8)
