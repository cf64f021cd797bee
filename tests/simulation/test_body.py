from __future__ import annotations

import itertools
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.poses import multiply, quaternion_from_rotation_vector, rotate
from pipelines.simulation.body import Person, make_body, moving_weights
from pipelines.simulation.rig import BONE, BONES, PARENT, SIDES, BodyMotion, joint_centres, sole_points
from pipelines.simulation.scenario import Body

SEXES, BUILDS = ("female", "male"), ("slim", "average", "heavy")
OUTFITS = ("casual", "sport", "dark", "bright")
STILL = np.tile([0.0, 0.0, 0.0, 1.0], (len(BONES), 1))


@pytest.fixture(scope="module", params=list(itertools.product(SEXES, BUILDS)), ids="-".join)
def person(request: pytest.FixtureRequest) -> Person:
    sex, build = request.param
    return make_body(Body.model_validate({"sex": sex, "build": build}))


def random_motion(person: Person, frames: int = 5, seed: int = 0) -> BodyMotion:
    """Turn every bone by up to about a right angle from the neutral pose."""
    draw = np.random.default_rng(seed)
    rotation = quaternion_from_rotation_vector(draw.normal(0.0, 0.5, (frames, len(BONES), 3)))
    return BodyMotion(np.arange(frames) / 30, draw.normal(0.0, 5.0, (frames, 3)), rotation)


def neutral(person: Person) -> BodyMotion:
    return BodyMotion(np.zeros(1), person.rig.offset[:1], STILL[None])


def test_it_stands_on_the_ground_as_tall_as_stated(person: Person) -> None:
    vertices = person.surface(person.rig.offset[0], STILL).vertices
    assert vertices[:, 2].min() == pytest.approx(0.0, abs=1e-12)
    # The crown is level, so soles (16 mm) and hair (16 mm or 10 mm) add to the height as they are.
    above = vertices[:, 2].max() - 1.75
    assert min(abs(above - 0.032), abs(above - 0.026)) < 1e-3
    assert above < 0.02 * 1.75


@pytest.mark.parametrize("height_m", [1.2, 2.2])
def test_everything_grows_with_the_height(height_m: float) -> None:
    usual, other = make_body(Body()), make_body(Body(height_m=height_m))
    np.testing.assert_allclose(other.rig.offset, usual.rig.offset * height_m / 1.75, atol=1e-12)
    np.testing.assert_allclose(other.rig.sole, usual.rig.sole * height_m / 1.75, atol=1e-12)
    grown = other.surface(np.zeros(3), STILL).vertices
    np.testing.assert_allclose(grown, usual.surface(np.zeros(3), STILL).vertices * height_m / 1.75, atol=1e-9)


def test_the_rig_is_neutral_and_the_same_on_both_sides(person: Person) -> None:
    offset = person.rig.offset
    for bone, name in enumerate(BONES):
        if name.startswith("left_"):
            mirrored = offset[BONE["right_" + name.removeprefix("left_")]] * [1, -1, 1]
            np.testing.assert_allclose(offset[bone], mirrored, atol=1e-12)
        elif not name.startswith("right_"):
            assert offset[bone, 1] == 0
    for side in SIDES:
        for hanging in ("shank", "foot"):
            assert tuple(offset[BONE[f"{side}_{hanging}"], :2]) == (0.0, 0.0)
        arm, forearm = offset[BONE[f"{side}_forearm"]], offset[BONE[f"{side}_hand"]]
        assert np.linalg.norm(np.cross(arm, forearm)) < 1e-12
        assert arm[0] == 0
        assert np.degrees(np.arctan2(abs(arm[1]), -arm[2])) < 20
        assert offset[BONE[f"{side}_toes"], 0] > 0
        assert offset[BONE[f"{side}_toes"], 1] == 0


def test_soles_are_flat_on_the_ground_in_the_neutral_pose(person: Person) -> None:
    heel, ball, tip = np.moveaxis(sole_points(person.rig, neutral(person))[0], 1, 0)
    np.testing.assert_allclose([heel[:, 2], ball[:, 2], tip[:, 2]], 0.0, atol=1e-12)
    assert (heel[:, 0] < 0).all()
    assert (ball[:, 0] > 0.1).all()
    # A shoe is about 0.15 of the height long (Drillis & Contini's foot: 0.152), and a little for the shoe.
    assert tip[0, 0] - heel[0, 0] == pytest.approx(0.152 * 1.75, rel=0.1)
    np.testing.assert_allclose(heel[0], heel[1] * [1, -1, 1], atol=1e-9)


def test_hands_hang_beside_the_hips_not_in_them(person: Person) -> None:
    vertices = person.surface(person.rig.offset[0], STILL).vertices
    hand = joint_centres(person.rig, neutral(person))[0, BONE["left_hand"]]
    level = np.abs(vertices[:, 2] - hand[2]) < 0.03
    there = np.sort(vertices[level & (vertices[:, 1] > 0), 1])
    # Between thigh and wrist there is a gap, which is left of the thigh's bone and right of the hand's.
    widest = int(np.argmax(np.diff(there)))
    assert there[widest] < hand[1] < there[-1]
    assert there[widest + 1] > there[widest]


def test_transforms_agree_with_the_rig(person: Person) -> None:
    """Both bones of a joint put it at the same place, that of `joint_centres`."""
    motion = random_motion(person)
    matrix, translation = person.skinning.transforms(motion.root, motion.rotation)
    centres = joint_centres(person.rig, motion)
    for name, parent in PARENT.items():
        rest = person.skinning.rest_joint[BONE[name]]
        for holder in (name, parent or name):
            bone = BONE[holder]
            placed = np.einsum("tij,j->ti", matrix[:, bone], rest) + translation[:, bone]
            np.testing.assert_allclose(placed, centres[:, BONE[name]], atol=1e-12)


def test_what_one_bone_holds_is_rigid(person: Person) -> None:
    motion = random_motion(person, frames=1)
    alone = person.skin.weight[:, 0] > 1 - 1e-12
    moved = person.surface(motion.root[0], motion.rotation[0]).vertices
    held = 0
    for bone in range(len(BONES)):
        of_bone = np.flatnonzero(alone & (person.skin.bone[:, 0] == bone))[::7]
        held += len(of_bone)
        before, after = person.skin.rest[of_bone], moved[of_bone]
        apart = np.linalg.norm(before[:, None] - before, axis=-1)
        np.testing.assert_allclose(np.linalg.norm(after[:, None] - after, axis=-1), apart, atol=1e-12)
    assert held > 100


def test_weights_of_every_vertex_sum_to_one(person: Person) -> None:
    np.testing.assert_allclose(person.skin.weight.sum(axis=1), 1.0, atol=1e-12)
    assert person.skin.weight.min() >= 0
    np.testing.assert_allclose(person.keypoint_mass.sum(axis=1), 1.0, atol=1e-12)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_added_bones_take_what_neighbours_share(seed: int) -> None:
    draw = np.random.default_rng(seed)
    weights = np.zeros((20, len(BONES)))
    for row in weights:
        row[draw.choice(len(BONES), 4, replace=False)] = draw.dirichlet(np.ones(4))
    moving = moving_weights(weights)
    np.testing.assert_allclose(moving.sum(axis=1), 1.0, atol=1e-12)
    assert moving.min() > -1e-15


@pytest.mark.parametrize("share", [0.0, 0.1, 0.25, 0.5, 0.75, 1.0])
def test_a_bent_knee_keeps_its_girth(share: float) -> None:
    """Neighbours differ by half of 120 degrees: the worst blend is halfway, cos(30 deg) from the joint."""
    person = make_body(Body())
    weights = np.zeros(len(BONES))
    weights[BONE["left_thigh"]], weights[BONE["left_shank"]] = 1 - share, share
    bent = STILL.copy()
    for name in ("left_shank", "left_foot", "left_toes"):
        bent[BONE[name]] = quaternion_from_rotation_vector(np.array([0.0, np.radians(120), 0.0]))
    matrix, translation = person.skinning.transforms(np.zeros(3), bent)
    knee = person.skinning.rest_joint[BONE["left_shank"]]
    thigh = matrix[BONE["left_thigh"]]
    front = knee + np.einsum("ji,j->i", thigh, [0.05, 0.0, 0.0])
    moved = np.einsum("m,mi->i", moving_weights(weights), np.einsum("mij,j->mi", matrix, front) + translation)
    centre = np.einsum("ij,j->i", thigh, knee) + translation[BONE["left_thigh"]]
    girth = np.linalg.norm(moved - centre) / 0.05
    # At rest the knee itself is bent by some degrees: cos((120 + 6)/4) is 0.853.
    assert 0.85 < girth < 1 + 1e-12
    if share in {0.0, 0.5, 1.0}:
        assert girth == pytest.approx(1.0, abs=1e-12)


def test_all_follows_a_rigid_motion(person: Person) -> None:
    motion = random_motion(person)
    turn = quaternion_from_rotation_vector(np.array([0.4, -1.1, 2.0]))
    shift = np.array([120.0, -70.0, 12.0])
    other = BodyMotion(motion.t_s, rotate(turn, motion.root) + shift, multiply(turn, motion.rotation))
    # Doubles at 150 m carry 3e-14 m; a point is the sum of some dozens of such terms.
    np.testing.assert_allclose(
        person.keypoints(other), rotate(turn, person.keypoints(motion)) + shift, atol=1e-11
    )
    before = person.surface(motion.root[0], motion.rotation[0]).vertices
    after = person.surface(other.root[0], other.rotation[0]).vertices
    np.testing.assert_allclose(after, rotate(turn, before) + shift, atol=1e-11)


def test_keypoints_lie_at_the_joints_and_the_same_on_both_sides(person: Person) -> None:
    places = dict(zip(person.joints, person.keypoints(neutral(person))[0], strict=True))
    centres = joint_centres(person.rig, neutral(person))[0]
    bones = {"knee": "shank", "ankle": "foot", "elbow": "forearm", "wrist": "hand"}
    for joint, bone in bones.items():  # within a limb: knees and elbows are 8 to 12 cm thick, and ankles
        assert np.linalg.norm(places[f"left_{joint}"] - centres[BONE[f"left_{bone}"]]) < 0.03
    for joint, bone in {"hip": "thigh", "shoulder": "upper_arm"}.items():  # thighs are 15 cm thick or more
        assert np.linalg.norm(places[f"left_{joint}"] - centres[BONE[f"left_{bone}"]]) < 0.05
    for name, place in places.items():
        if name.startswith("left_"):
            np.testing.assert_allclose(
                place, places["right_" + name.removeprefix("left_")] * [1, -1, 1], atol=1e-12
            )
    assert places["nose"][0] > places["left_ear"][0]
    assert places["left_eye"][1] > 0


def test_rig_and_keypoints_are_the_same_in_every_outfit() -> None:
    people = [make_body(Body.model_validate({"outfit": outfit})) for outfit in OUTFITS]
    motion = random_motion(people[0])
    for person in people[1:]:
        np.testing.assert_array_equal(person.rig.offset, people[0].rig.offset)
        np.testing.assert_allclose(person.rig.sole, people[0].rig.sole, atol=1e-12)
        np.testing.assert_array_equal(person.keypoints(motion), people[0].keypoints(motion))


def test_keypoints_of_long_motions_are_those_of_their_parts() -> None:
    person = make_body(Body())
    motion = random_motion(person, frames=2500)
    whole = person.keypoints(motion)
    for frame in (0, 1023, 1024, 2499):
        one = slice(frame, frame + 1)
        alone = person.keypoints(BodyMotion(motion.t_s[one], motion.root[one], motion.rotation[one]))
        np.testing.assert_allclose(whole[one], alone, atol=1e-12)


@pytest.mark.parametrize(("sex", "build", "outfit"), list(itertools.product(SEXES, BUILDS, OUTFITS)))
def test_every_look_is_a_sound_surface(sex: str, build: str, outfit: str) -> None:
    """Triangles are wound alike, meet two at an edge, and end only in closed hems; they face outward."""
    person = make_body(Body.model_validate({"sex": sex, "build": build, "outfit": outfit}))
    surface = person.surface(person.rig.offset[0], STILL)
    vertices, faces = surface.vertices, surface.faces
    assert np.isfinite(vertices).all()
    assert faces.dtype == np.int32
    np.testing.assert_array_equal(np.unique(faces), np.arange(len(vertices)))
    assert surface.colour.shape == (len(vertices), 3)
    assert surface.colour.min() >= 0
    assert surface.colour.max() <= 1
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)
    directed = set(map(tuple, edges.tolist()))
    hems = [edge for edge in directed if edge[::-1] not in directed]
    assert Counter(a for a, _ in hems) == Counter(b for _, b in hems)


def first_hits(
    vertices: Float, faces: NDArray[np.int32], across: int, at: Float
) -> tuple[NDArray[np.intp], Float]:
    """Find the nearest face along -x (`across` 1) or -y (`across` 0) of level rays, and its facing.

    Rays pass through (`across` coordinate, z) `at` [R, 2]. A face of -1 is a ray that hits nothing.
    """
    along = 1 - across
    p = vertices[faces][:, :, [across, 2]]
    edges = np.roll(p, -1, axis=1) - p
    to = at[:, None, None] - p
    side = edges[..., 0] * to[..., 1] - edges[..., 1] * to[..., 0]
    hit = (side >= 0).all(axis=2) | (side <= 0).all(axis=2)
    depth = np.where(hit, vertices[faces][:, :, along].mean(axis=1), -np.inf)
    first = np.where(np.any(hit, axis=1), np.argmax(depth, axis=1), -1)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return first, np.cross(b - a, c - a)[first, along]


@pytest.mark.parametrize("outfit", OUTFITS)
@pytest.mark.parametrize("across", [0, 1])
def test_from_outside_the_outside_is_seen(outfit: str, across: int) -> None:
    """Nowhere does one look through the person at the inside of its other side."""
    person = make_body(Body.model_validate({"outfit": outfit}))
    surface = person.surface(person.rig.offset[0], STILL)
    draw = np.random.default_rng(0)
    at = np.stack([draw.uniform(-0.15, 0.15, 150), draw.uniform(0.0, 1.8, 150)], axis=1)
    first, facing = first_hits(surface.vertices, surface.faces, across, at)
    seen = first >= 0
    assert seen.sum() > 40
    # Faces of folds (nostrils, lids, between fingers) are a few millimetres wide: depth by the middle of a
    # face may take a neighbour there. One ray in fifty is more than those cover of the silhouette.
    assert (facing[seen] > 0).mean() > 0.98


def test_skin_under_the_collar_does_not_show_through_the_shirt() -> None:
    person = make_body(Body())
    surface = person.surface(person.rig.offset[0], STILL)
    neck = joint_centres(person.rig, neutral(person))[0, BONE["neck"]]
    draw = np.random.default_rng(0)
    at = np.stack([draw.uniform(-0.12, 0.12, 120), neck[2] - draw.uniform(0.04, 0.3, 120)], axis=1)
    first, _ = first_hits(surface.vertices, surface.faces, 1, at)
    assert (first >= 0).all()
    red, green, _ = surface.colour[surface.faces[first]].mean(axis=1).T
    assert (red > 4 * green).all()  # of the shirt; skin's are 1.6 to 1
