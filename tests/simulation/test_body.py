"""The simulated body: its size, its rig and its surface."""

from collections import Counter

import numpy as np
import pytest

from pipelines.geometry.body_model import moving_weights
from pipelines.geometry.poses import quaternion_from_rotation_vector
from pipelines.geometry.rig import BONE, BONES, PARENT, SIDES, BodyMotion, joint_centres
from pipelines.simulation.body import PosablePerson, make_body
from pipelines.simulation.scenario import Body

SEXES, BUILDS = ("female", "male"), ("slim", "average", "heavy")
OUTFITS = ("casual", "sport", "dark", "bright")
LOOKS = list(zip(SEXES * 2, (*BUILDS, "slim"), OUTFITS, strict=True))
STILL = np.tile([0.0, 0.0, 0.0, 1.0], (len(BONES), 1))


@pytest.fixture(scope="module", params=[("female", "heavy"), ("male", "slim")], ids="-".join)
def person(request: pytest.FixtureRequest) -> PosablePerson:
    sex, build = request.param
    return make_body(Body.model_validate({"sex": sex, "build": build}))


def random_motion(person: PosablePerson, frames: int = 5, seed: int = 0) -> BodyMotion:
    """Turn every bone by up to about a right angle from the neutral pose."""
    draw = np.random.default_rng(seed)
    rotation = quaternion_from_rotation_vector(draw.normal(0.0, 0.5, (frames, len(BONES), 3)))
    return BodyMotion(np.arange(frames) / 30, draw.normal(0.0, 5.0, (frames, 3)), rotation)


def neutral(person: PosablePerson) -> BodyMotion:
    return BodyMotion(np.zeros(1), person.rig.offset[:1], STILL[None])


def test_it_stands_on_the_ground_as_tall_as_stated(person: PosablePerson) -> None:
    vertices = person.surface(person.rig.offset[0], STILL).vertices
    assert vertices[:, 2].min() == pytest.approx(0.0, abs=1e-12)
    # The crown is level, so soles (16 mm) and hair (16 mm or 10 mm) add to the height as they are.
    above = vertices[:, 2].max() - 1.75
    assert min(abs(above - 0.032), abs(above - 0.026)) < 1e-3
    assert above < 0.02 * 1.75


def test_the_rig_is_neutral_and_the_same_on_both_sides(person: PosablePerson) -> None:
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


def test_transforms_agree_with_the_rig(person: PosablePerson) -> None:
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


def test_keypoints_lie_at_the_joints_and_the_same_on_both_sides(person: PosablePerson) -> None:
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


@pytest.mark.parametrize(("sex", "build", "outfit"), LOOKS)
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
