"""Association of people across cameras, on people with known paths and identities.

Rigid bodies of 17 points walk on closed-form paths inside a ring of cameras 10 m away that look down at
15 degrees. Identity is the index of the body; detections are shuffled before association.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.cameras import undistort
from pipelines.geometry.poses import look_at, matrix_from_quaternion
from pipelines.keypoints.association import Association, Surroundings, associate, associate_one_camera
from pipelines.keypoints.bodies import SightLines
from pipelines.keypoints.corrections import Pair, mirrored_pairs, swaps_across_views
from pipelines.reconstruction.observations import on_sides
from pipelines.simulation.detector_errors import see
from tests.synthetic.flights import LENS
from tests.synthetic.walk import COCO17, walk

Int64 = NDArray[np.int64]
Path = Callable[[Float], Float]  # seconds [T] to places on the ground [T, 2]
Shape = Callable[[Float], Float]  # joints [T, J, 3] to other joints

RATE_HZ = 15.0
RANGE_M = 10.0
PIXEL = 2.0 / 1000.0  # 2 px at a focal length of 1000 px
JOINTS = 17


@dataclass(frozen=True)
class Scene:
    """Views of the cameras: arguments of `associate`, and the true person of each detection."""

    time_s: Float
    xy: Float  # [T, C, D, J, 2]
    confidence: Float  # [T, C, D, J]
    position: Float
    rotation: Float
    sigma: Float
    who: Int64 = field(repr=False)  # [T, C, D] the person, -1 none

    def associate(
        self, people: int | None = 1, *logs: Path, sigma_m: float = 0.5, reach: float = 1.0
    ) -> Association:
        heights, cameras = np.ones(len(self.time_s)), self.xy.shape[1]
        actors = [np.c_[log(self.time_s), heights] for log in logs]
        return associate(
            self.time_s,
            self.xy,
            self.confidence,
            self.position,
            self.rotation,
            self.sigma,
            actors=np.stack(actors, axis=1) if actors else None,
            actor_sigma_m=sigma_m,
            people=people,
            scene=None
            if people
            else Surroundings(_level, np.tile([-reach, -reach, reach, reach], (cameras, 1))),
        )

    def chosen(self, result: Association, person: int = 0) -> Int64:
        """Return the true person [T, C] of each chosen detection, -1 for none."""
        choice = result.choice[..., person]
        found = np.take_along_axis(self.who, np.maximum(choice, 0)[..., None], -1)[..., 0]
        return np.where(choice >= 0, found, -1)

    def hide(self, person: int, camera: int, times: slice = slice(None)) -> Scene:
        """Return the scene without one person in one camera."""
        xy = self.xy.copy()
        xy[times, camera][self.who[times, camera] == person] = np.nan
        return replace(self, xy=xy, who=np.where(np.isfinite(xy[..., 0, 0]), self.who, -1))


def _level(points: Float) -> tuple[Float, Float]:
    return np.zeros(len(points)), np.full(len(points), 0.1)


def straight(start: tuple[float, float], velocity: tuple[float, float]) -> Path:
    return lambda t: np.array(start) + np.array(velocity) * t[:, None]


def bodies(paths: list[Path], time_s: Float) -> Float:
    """Simulate bodies [T, P, J, 3] 1.7 m tall and 0.4 m wide, turned differently, that swing as they walk."""
    j = np.arange(JOINTS)
    upright = np.stack([0.2 * np.sin(2.4 * j), 0.1 * np.cos(1.7 * j), 0.1 + 0.1 * j], -1)
    joints = np.empty((len(time_s), len(paths), JOINTS, 3))
    for p, path in enumerate(paths):
        yaw = 1.1 * p
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        joints[:, p] = upright @ turn.T
        joints[:, p, :, :2] += path(time_s)[:, None]
        joints[:, p, :, 0] += 0.1 * np.sin(6.0 * time_s[:, None] + j)
    return joints


def rotations(vectors: Float) -> Float:
    """Compute rotation matrices of small rotation vectors [..., 3], Rodrigues to machine precision."""
    from scipy.spatial.transform import Rotation

    matrices: Float = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)
    return matrices


def film(
    paths: list[Path],
    *,
    seconds: float = 6.0,
    cameras: int = 5,
    white: tuple[float, float] = (0.0, 0.0),
    bias: tuple[float, float] = (0.0, 0.0),
    missing: float = 0.0,
    outliers: float = 0.0,
    seed: int = 0,
    shapes: dict[int, Shape] | None = None,
) -> Scene:
    """Film all people with a ring of cameras; pose errors are (m, deg) per axis, and included in sigma."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    joints = bodies(paths, time_s)
    for person, shape in (shapes or {}).items():
        joints[:, person] = shape(joints[:, person])
    times, people = joints.shape[:2]

    angle = 2 * np.pi * np.arange(cameras) / cameras + 0.3
    tilt = np.deg2rad(15.0)
    ring = np.stack(
        [np.cos(angle) * np.cos(tilt), np.sin(angle) * np.cos(tilt), np.full(cameras, np.sin(tilt))], -1
    )
    middle = np.append(paths[0](time_s).mean(0), 1.0)
    position = middle + RANGE_M * ring
    forward = -ring
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    rotation = np.stack([right, np.cross(forward, right), forward], -1)

    seen = np.einsum("cba,tpjcb->tcpja", rotation, joints[:, :, :, None] - position)
    xy = seen[..., :2] / seen[..., 2:] + PIXEL * rng.standard_normal((*seen.shape[:-1], 2))
    stray = rng.random(xy.shape[:-1]) < outliers
    xy[stray] += rng.uniform(-0.3, 0.3, (int(stray.sum()), 2))
    gone = rng.random(xy.shape[:3]) < missing
    xy[gone] = np.nan

    order = rng.permuted(np.tile(np.arange(people), (times, cameras, 1)), axis=-1)
    xy = np.take_along_axis(xy, order[..., None, None], 2)
    here = np.isfinite(xy[..., 0, 0])

    noise_m = white[0] * rng.standard_normal((times, cameras, 3)) + bias[0] * rng.standard_normal(
        (cameras, 3)
    )
    noise_rad = np.deg2rad(
        white[1] * rng.standard_normal((times, cameras, 3)) + bias[1] * rng.standard_normal((cameras, 3))
    )
    sigma = np.sqrt(
        PIXEL**2
        + np.deg2rad(white[1]) ** 2
        + np.deg2rad(bias[1]) ** 2
        + (white[0] ** 2 + bias[0] ** 2) / RANGE_M**2
    )
    return Scene(
        time_s,
        xy,
        np.where(np.isfinite(xy[..., 0]), 0.8, 0.0),
        position + noise_m,
        rotation @ rotations(noise_rad),
        np.full((times, cameras), sigma),
        np.where(here, order, -1),
    )


ACTOR = straight((-3.0, 0.0), (1.0, 0.0))
CROSSING = straight((3.0, 0.6), (-1.0, 0.0))  # passes the actor at 0.6 m
ACROSS = straight((0.5, -3.0), (0.0, 1.1))  # and this one crosses both paths

NONE, MEDIUM = (0.0, 0.0), (0.3, 1.0)


@pytest.mark.slow  # compiles much
def test_three_people_who_cross_keep_their_identities() -> None:
    """Expect every detection at its person: without pose noise a wrong pair is tens of sigma off."""
    scene = film([ACTOR, CROSSING, ACROSS], missing=0.1, outliers=0.05)
    result = scene.associate(people=3)
    chosen = [scene.chosen(result, person) for person in range(3)]
    identity = [int(np.bincount(c[c >= 0]).argmax()) for c in chosen]
    assert sorted(identity) == [0, 1, 2]
    for c, person in zip(chosen, identity, strict=True):
        present = (scene.who == person).any(-1)
        assert np.array_equal(c == person, present)
        assert np.array_equal(c >= 0, present)
    assert np.median(result.people) == 3
    assert result.unused.tolist() == [0] * 5
    alone = scene.associate(people=1)
    others = (scene.who >= 0).sum((0, 2)) - (alone.choice[..., 0] >= 0).sum(0)
    assert alone.unused.tolist() == others.tolist()
    assert not result.resumed.any()
    assert result.reasons == ()


@pytest.mark.parametrize("cameras", [2, 5])
@pytest.mark.parametrize("noise", ["white", "bias"])
def test_a_lone_actor_never_loses_a_view_to_outliers_and_pose_noise(cameras: int, noise: str) -> None:
    """Refuse no right view: pairs lie within 3 sigma with p = 0.997, and within 5 sigma once known."""
    for seed in range(3):
        white, bias = (MEDIUM, NONE) if noise == "white" else (NONE, MEDIUM)
        scene = film([ACTOR], cameras=cameras, outliers=0.05, white=white, bias=bias, seed=seed)
        result = scene.associate()
        assert result.views[0] == scene.who.size
        assert result.refused[0] == 0


@pytest.mark.parametrize("cameras", [2, 3, 5])
def test_the_logged_actor_is_found_among_people_under_pose_noise(cameras: int) -> None:
    """Test at 0.3 m and 1 deg: a ray is 0.35 m wide and the log 0.7 m; people pass at 0.6 m."""
    right, wrong = [], []
    for seed in range(6):
        scene = film([ACTOR, CROSSING, ACROSS], cameras=cameras, white=MEDIUM, missing=0.1, seed=seed)
        chosen = scene.chosen(scene.associate(1, ACTOR))
        right.append((chosen == 0).sum() / (scene.who == 0).any(-1).sum())
        wrong.append(((chosen >= 0) & (chosen != 0)).mean())
    assert np.mean(right) >= 0.97
    assert np.mean(wrong) <= 0.03


def test_a_log_that_is_near_nobody_is_reported() -> None:
    scene = film([ACTOR])
    result = scene.associate(1, straight((80.0, 0.0), (0.0, 0.0)))
    assert result.views[0] == scene.who.size
    assert "nobody is near the logged actor (nearest 77.0 m, median 80.0 m)" in result.reasons[0]


def test_one_camera_gives_nobody_the_name_of_a_person_who_is_elsewhere() -> None:
    """Log A, who is not filmed, and B, who is, with somebody else; then only somebody who is far away."""
    scene, away = film([ACTOR, ACROSS], cameras=1), straight((80.0, 0.0), (0.0, 0.0))
    views = SightLines(scene.xy, scene.confidence, scene.position, scene.rotation, scene.sigma)
    heights = np.ones(len(scene.time_s))
    a, b = (np.c_[log(scene.time_s), heights] for log in (away, ACTOR))
    result = associate_one_camera(scene.time_s, views, actors=np.stack([a, b], axis=1), people=None)
    assert result.unseen == (0,)
    assert (result.choice[:, 0, 0] < 0).all()
    taken = np.take_along_axis(scene.who[:, 0], result.choice[:, 0, 1:2], axis=1)
    assert (taken == 0).mean() > 0.97
    result = associate_one_camera(scene.time_s, views, actors=a[:, None])
    assert len(result.reasons) == 1
    assert (result.choice[:, 0, 0] >= 0).all()


def test_several_logged_people_are_the_bodies_that_fit_all_logs_best() -> None:
    """Let two people walk 1 m apart, both logged 0.8 m to one side: the second is nearer to both logs.

    In any order of the logs each person is in their place; person by person, the first would take the body
    between the logs.
    """
    beside = straight((-3.0, 1.0), (1.0, 0.0))
    logs = [straight((-3.0, 0.8), (1.0, 0.0)), straight((-3.0, 1.8), (1.0, 0.0))]
    scene = film([ACTOR, beside])
    for order in ((0, 1), (1, 0)):
        result = scene.associate(2, *(logs[k] for k in order), sigma_m=1.0)
        for person, who in enumerate(order):
            assert np.array_equal(scene.chosen(result, person), np.full_like(scene.who[..., 0], who))


def test_neighbours_whom_one_camera_sees_each_are_not_joined_if_logs_are_exact() -> None:
    """Let the rays to two neighbours 2 m apart cross between them: by the rays they are one body.

    The neighbours mirror each other about the axis of their two cameras, 14 m from these. With a noise of 1 m
    both logs fit that body. The actor, whom three cameras place at the log, shows that logs are exact.
    """
    axis = 0.3 + np.pi / 3  # between cameras 0 and 1 of three
    along, across = np.array([np.cos(axis), np.sin(axis)]), np.array([-np.sin(axis), np.cos(axis)])
    places = [(0.0, 0.0), *((x, y) for x, y in (-5.0 * along + across, -5.0 * along - across))]
    still = [straight(place, (0.0, 0.0)) for place in places]
    scene = film(still, cameras=3, bias=(0.1, 0.3))
    for person, only in ((1, 0), (2, 1)):
        for camera in {0, 1, 2} - {only}:
            scene = scene.hide(person, camera)
    alone = scene.associate(3)
    assert np.all(scene.chosen(alone, 1)[:, :2] == [1, 2])  # one body without logs
    result = scene.associate(3, *still, sigma_m=1.0)
    assert np.all(scene.chosen(result) == 0)
    for person in (1, 2):
        assert ((result.choice[..., person] >= 0).sum(axis=1) < 2).all()


def test_as_many_people_are_found_as_there_are() -> None:
    """Expect all who are seen by two cameras for a second, each once, whether or not they are logged."""
    scene = film([ACTOR, CROSSING, ACROSS], missing=0.1, outliers=0.05)
    for logs in ((), (ACTOR,), (ACTOR, CROSSING)):
        result = scene.associate(None, *logs)
        who = [scene.chosen(result, person) for person in range(result.choice.shape[2])]
        assert sorted(int(np.bincount(own[own >= 0]).argmax()) for own in who) == [0, 1, 2]
        assert not result.phantoms
    assert film([ACTOR], cameras=2).associate(None).choice.shape[2] == 1


@pytest.mark.parametrize(
    ("cause", "shape"),
    [
        ("ground", lambda joints: joints + np.array([0.0, 0.0, 1.0])),  # its middle is 1.9 m up
        ("size", lambda joints: 0.35 * joints + 0.65 * joints.mean(axis=1, keepdims=True)),  # 0.6 m
    ],
)
def test_phantoms_are_refused_and_counted(cause: str, shape: Shape) -> None:
    """Bodies that all cameras agree on, but in a tree's crown, or of a small child's size, are nobody."""
    scene = film([ACTOR, straight((1.0, 2.0), (0.0, 0.0)), ACROSS], shapes={1: shape})
    result = scene.associate(None)
    assert result.phantoms == {cause: 1}
    who = [scene.chosen(result, person) for person in range(result.choice.shape[2])]
    assert sorted(int(np.bincount(own[own >= 0]).argmax()) for own in who) == [0, 2]


@pytest.mark.parametrize("away_m", [13.0, 7.0])
def test_a_bystander_stands_beyond_the_cameras_and_is_never_in_all_pictures(away_m: float) -> None:
    """Let two opposite cameras see somebody behind camera 0, or in front of it, where they are a person.

    The cameras stand 9.7 m from the middle of the actor's way, and show 45 degrees to each side.
    """
    stands = straight((away_m * np.cos(0.3), away_m * np.sin(0.3)), (0.0, 0.0))
    scene = film([straight((-0.5, 0.0), (0.2, 0.0)), stands])
    for camera in (0, 1, 4):
        scene = scene.hide(1, camera)
    result = scene.associate(None)
    behind = away_m > RANGE_M
    assert result.choice.shape[2] == (1 if behind else 2)
    assert result.phantoms == ({"bystander": 1} if behind else {})


def test_a_bystander_is_not_taken_for_the_actor_where_the_actor_is_hidden() -> None:
    """Hide the actor in one camera for good: the bystander there is refused and counted."""
    bystander = straight((1.0, 2.0), (0.0, 0.0))
    scene = film([ACTOR, bystander]).hide(0, camera=2)
    for camera in (0, 1, 3, 4):
        scene = scene.hide(1, camera)
    result = scene.associate()
    chosen = scene.chosen(result)
    assert np.all(chosen[:, 2] == -1)
    assert np.all(chosen[:, [0, 1, 3, 4]] == 0)
    assert result.refused[0] == len(scene.time_s)
    assert np.all(result.people == 1)


def test_the_actor_is_taken_up_again_after_all_cameras_lost_him() -> None:
    """Lose the actor for three seconds at 1 m/s; a bystander 4 m away stays, so the place identifies him."""
    scene = film([ACTOR, straight((2.0, 5.0), (0.0, 0.0))])
    for camera in range(5):
        scene = scene.hide(0, camera, slice(30, 75))
    result = scene.associate(people=2)
    for person in range(2):
        seen = scene.chosen(result, person)
        assert len(np.unique(seen[seen >= 0])) == 1
    actor = next(p for p in range(2) if np.any(scene.chosen(result, p) == 0))
    assert np.array_equal(scene.chosen(result, actor) == 0, (scene.who == 0).any(-1))


def test_a_camera_without_a_pose_and_a_lone_camera_get_no_choice() -> None:
    scene = film([ACTOR])
    position = scene.position.copy()
    position[10:20, 2] = np.nan
    choice = replace(scene, position=position).associate().choice[..., 0]
    assert np.all(choice[10:20, 2] == -1)
    assert np.all(np.delete(choice, 2, axis=1) == 0)
    assert np.all(choice[np.r_[0:10, 20:90], 2] == 0)

    alone = scene
    for camera in range(1, 5):
        alone = alone.hide(0, camera)
    result = alone.associate()
    assert np.all(result.choice == -1)
    assert "no two cameras" in result.reasons[0]


CROWD = film([ACTOR, CROSSING, ACROSS], seconds=2.0, white=MEDIUM, missing=0.2, outliers=0.05)
CROWD_RESULT: list[Association] = []


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_order_of_detections_does_not_matter(seed: int) -> None:
    """Shuffle the detections: the same bodies are chosen, also where the choice is ambiguous."""
    if not CROWD_RESULT:
        CROWD_RESULT.append(CROWD.associate(people=3))
    times, cameras, detections = CROWD.who.shape
    indices = np.tile(np.arange(detections), (times, cameras, 1))
    order = np.random.default_rng(seed).permuted(indices, axis=-1)
    shuffled = replace(
        CROWD,
        xy=np.take_along_axis(CROWD.xy, order[..., None, None], 2),
        confidence=np.take_along_axis(CROWD.confidence, order[..., None], 2),
        who=np.take_along_axis(CROWD.who, order, 2),
    )
    result = shuffled.associate(people=3)
    for person in range(3):
        assert np.array_equal(shuffled.chosen(result, person), CROWD.chosen(CROWD_RESULT[0], person))


def test_people_are_told_apart_under_constant_pose_errors() -> None:
    """Let three people cross, with 3 cameras, 0.3 m and 1 deg: 0.0035 of the choices are wrong."""
    across = straight((0.5, -3.0), (0.0, 1.1))
    wrong = []
    for seed in range(3):
        scene = film([ACTOR, CROSSING, across], cameras=3, bias=(0.3, 1.0), missing=0.1, seed=seed)
        wrong.append((scene.chosen(scene.associate(1, ACTOR)) > 0).mean())
    assert np.mean(wrong) < 0.01


def test_nobody_is_lost_where_keypoints_err_more_than_stated() -> None:
    """Let keypoints err by 6 px where 2 px are stated."""
    scene = film([ACTOR, CROSSING, ACROSS], seconds=4.0)
    rng = np.random.default_rng(4)
    noisy = replace(scene, xy=scene.xy + 6.0 / 1000.0 * rng.standard_normal(scene.xy.shape))
    result = noisy.associate(None)
    assert not result.phantoms
    chosen = [noisy.chosen(result, person) for person in range(result.choice.shape[2])]
    assert sorted(int(np.bincount(own[own >= 0]).argmax()) for own in chosen) == [0, 1, 2]
    right = sum(np.bincount(own[own >= 0]).max() for own in chosen)
    assert right > 0.99 * (noisy.who >= 0).sum()


NOISE_PX = 2.0
T_S = np.arange(150) / 15
PAIRS = mirrored_pairs(COCO17)
LEGS = [PAIRS[f"left_{part}"] for part in ("hip", "knee", "ankle")]
SIGMA = NOISE_PX / LENS.fx


class Views:
    """Views of cameras on a ring of 10 m; pixels of [C, T, 17, 2]."""

    def __init__(self, cameras: int, noise_px: float = NOISE_PX) -> None:
        joints = walk(T_S, radius_m=2.0)
        turn = 2 * np.pi * np.arange(cameras) / cameras if cameras > 2 else np.radians([0.0, 100.0])
        places = np.stack([10 * np.cos(turn), 10 * np.sin(turn), np.full(cameras, 4.0)], axis=1)
        position = np.repeat(places[:, None], len(T_S), axis=1)
        quaternion = look_at(position, joints[None, :, 11])
        pixels = np.stack([see(joints, p, q, LENS) for p, q in zip(position, quaternion, strict=True)])
        self.pixels = pixels + np.random.default_rng(0).normal(0.0, noise_px, pixels.shape)
        self.position = np.moveaxis(position, 0, 1)
        self.rotation = np.moveaxis(matrix_from_quaternion(quaternion), 0, 1)
        self.sigma = np.full((len(T_S), cameras), SIGMA)
        self.xy = np.moveaxis(undistort(self.pixels, LENS), 0, 2)

    def undone(self, xy: Float) -> tuple[Float, dict[str, int]]:
        sides, counts = swaps_across_views(xy, self.position, self.rotation, self.sigma, COCO17)
        seen = np.ones(xy.shape[:-1])
        found, kept = (values[:, 0] for values in on_sides(xy[:, None], seen[:, None], sides[:, None]))
        assert ((sides >= 0) == (kept == 1)).all()
        return found, counts


def exchanged(xy: Float, camera: int, rows: slice, pairs: list[Pair]) -> Float:
    swapped = xy.copy()
    for left, right in pairs:
        swapped[rows, left, camera], swapped[rows, right, camera] = (
            xy[rows, right, camera],
            xy[rows, left, camera],
        )
    return swapped


@pytest.mark.parametrize("cameras", [2, 3, 5])
@pytest.mark.parametrize("noise_px", [0.0, 2.0])
def test_views_that_agree_stay_to_the_last_bit(cameras: int, noise_px: float) -> None:
    views = Views(cameras, noise_px)
    found, counts = views.undone(views.xy)
    np.testing.assert_array_equal(found, views.xy)
    assert counts == {}


@pytest.mark.parametrize("cameras", [3, 4, 5])
@pytest.mark.parametrize("pairs", [list(PAIRS.values()), LEGS], ids=["whole body", "legs"])
def test_an_exchange_in_one_camera_is_undone(cameras: int, pairs: list[Pair]) -> None:
    views = Views(cameras)
    found, counts = views.undone(exchanged(views.xy, 1, slice(20, 120), pairs))
    # Left and right are apart along the horizon, where three cameras have three rays for two unknowns: a pair
    # that is s apart misses by s / 3 in the exchanged camera, in more cameras by more. Over the six rays of
    # the legs that makes m = 2 / 9 of the squared distances, in variances of a coordinate, with a deviation
    # of 2 sqrt(m). Seen are 6 * 5 of them: with four deviations on top m = 116, or 522.
    apart = views.pixels[1]
    distance2 = np.sum([((apart[:, a] - apart[:, b]) ** 2).sum(-1) for a, b in LEGS], axis=0)
    visible = np.zeros(len(T_S), np.bool_)
    visible[20:120] = distance2[20:120] > 522 * NOISE_PX**2
    assert visible.sum() > 20
    legs = np.ravel(LEGS)
    restored = (found[:, legs] == views.xy[:, legs]).all(axis=(1, 2, 3))
    assert restored[visible].mean() >= 0.95
    outside = np.r_[0:20, 120:150]
    np.testing.assert_array_equal(found[outside], views.xy[outside])
    assert counts["undone"] >= 2 * len(LEGS) * restored[visible].sum()


def test_of_two_cameras_neither_is_believed() -> None:
    views = Views(2)
    found, counts = views.undone(exchanged(views.xy, 1, slice(20, 120), LEGS))
    assert counts.keys() == {"dropped"}
    dropped = np.asarray(np.isnan(found).any(axis=(1, 2, 3)))
    assert dropped[20:120].mean() > 0.1
    assert not dropped[:20].any()
    assert not dropped[120:].any()
    assert (np.isnan(found).any(-1).all(-1) == np.isnan(found).any(-1).any(-1)).all()  # both views or none
